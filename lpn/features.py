"""Descriptors of many pictures, kept on disk: a folder that a later step can read, resume, or check.

    descriptors.npy   (N, n, D) float32, float16, or int8, memory-mapped when read; each part has norm 1/sqrt(n), and in int8
                      the direction alone, its largest number brought to 127
    manifest.json     format, model fingerprint, view, what was done to the pictures, and for each row its file with size and
                      time, and the box it was cropped to where it was

The manifest is written last, so a folder with a manifest is complete. While pictures are being described, the rows
lie in `descriptors.part`, `planned.json` is the manifest to be, and `progress.json` says how many rows are good.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, cast, get_args

import numpy as np
import numpy.typing as npt
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lpn import images
from lpn.changes import UNCHANGED, Change
from lpn.datasets import Picture, files_below
from lpn.errors import DataError, InputError, LPNError, OutputError, PictureError, StoreError
from lpn.files import alone, printable, write_whole
from lpn.integrity import check_whole
from lpn.model import FloatArray, Model
from lpn.spec import View

FORMAT = "lpn-descriptors/2"
BEFORE = "lpn-descriptors/1"
"""Knew of no shift, scale, or boxes; what it says is true of such stores still."""
STORES = "descriptors"
"""Folder of a data set in which stores of its test split may come along: `query_drone`, `gallery_satellite`, ..."""
Precision = Literal["float32", "float16", "int8"]
Box = tuple[float, float, float, float]

_BATCH = 8


@dataclass(frozen=True)
class Row:
    """The file behind one row: its path (relative to the described folder), size in bytes, time of change, and the box
    (left, top, right, bottom) in pixels that it was cropped to, None for the whole picture."""

    file: str
    size: int
    time_ns: int
    box: Box | None = None


@dataclass(frozen=True)
class Manifest:
    """What a store holds.

    Attributes:
        fingerprint: of the model; descriptors of another model cannot be compared with these.
        view: the branch used.
        rotate: degrees counter-clockwise the pictures were turned first.
        n_parts, embedding: n and D.
        rows: the file of each row.
        precision: of the numbers on disk.
        shift: pixels of the network's input they were moved to the right.
        scale: factor they were zoomed by.
        down: pixels of the network's input they were moved down; written only where they were.
        around: they are panoramas, turned by moving their columns around; written only where they were.
    """

    fingerprint: str
    view: str
    rotate: float
    n_parts: int
    embedding: int
    rows: tuple[Row, ...]
    precision: Precision = "float32"
    shift: int = 0
    scale: float = 1.0
    down: int = 0
    around: bool = False
    format: str = FORMAT

    @classmethod
    def of(
        cls, model: Model, view: View, change: Change, rows: tuple[Row, ...], precision: Precision = "float32"
    ) -> Manifest:
        """The manifest of files described by a model."""
        done = (change.shift, change.scale, change.down, change.around)
        n, embedding = model.n_parts, model.spec.embedding
        return cls(model.fingerprint, view, change.rotate, n, embedding, rows, precision, *done)

    @property
    def change(self) -> Change:
        """What was done to the pictures."""
        return Change(self.rotate, self.shift, self.scale, self.down, self.around)

    @property
    def cropped(self) -> bool:
        """Whether any picture was cropped to a box."""
        return any(row.box is not None for row in self.rows)

    def to_json(self) -> bytes:
        """The manifest as a JSON file."""
        values = asdict(self)
        for late in ("down", "around"):
            if not values[late]:
                del values[late]
        for row in values["rows"]:
            if row["box"] is None:
                del row["box"]
        return json.dumps(values, indent=1).encode()

    @classmethod
    def from_json(cls, data: bytes, name: str) -> Manifest:
        """Read what `to_json` wrote; StoreError when it is something else."""
        try:
            values: Any = json.loads(data)
            if values.pop("format") not in (FORMAT, BEFORE):
                raise ValueError("another format")
            rows = tuple(
                Row(str(r["file"]), int(r["size"]), int(r["time_ns"]), _box(r.get("box"))) for r in values.pop("rows")
            )
            if values.get("precision", "float32") not in get_args(Precision):
                raise ValueError("another precision")
            read = cls(rows=rows, **values)
            _ = read.change  # checks its numbers
            return read
        except (ValueError, KeyError, TypeError, AttributeError, InputError) as error:
            raise StoreError(
                f"{name} is not a manifest of descriptors ({FORMAT}); describe the pictures again."
            ) from error

    def comparable(self, other: Manifest) -> bool:
        """Whether rows of the same file may be taken over from another store."""
        return self._kind == other._kind

    @property
    def _kind(self) -> tuple[str, str, Change, str]:
        return self.fingerprint, self.view, self.change, self.precision


@dataclass(frozen=True, eq=False)
class Store:
    """A complete store. `descriptors` is (N, n, D) in the manifest's precision, memory-mapped, read-only.

    `identity` is a text that no other store has: of the manifest's contents, and of the array's size and time.
    """

    manifest: Manifest
    descriptors: FloatArray | npt.NDArray[np.float16] | npt.NDArray[np.int8]
    identity: str = ""

    @property
    def float32(self) -> FloatArray:
        """The descriptors (N, n, D) in float32: memory-mapped where they are stored so, else a copy."""
        values = self.descriptors.astype(np.float32, copy=False)
        if self.manifest.precision == "int8":
            norms = np.linalg.norm(values, axis=2, keepdims=True)
            values *= np.float32(self.manifest.n_parts**-0.5) / np.maximum(norms, np.float32(1e-12))
        return values


def open_store(folder: str | Path) -> Store:
    """Open a store.

    Raises:
        StoreError: when the folder is not a complete store or its files do not fit each other.
    """
    folder = Path(folder)
    if not (folder / "manifest.json").is_file():
        unfinished = (
            " (its description was not finished; run lpn describe again)" if (folder / "planned.json").is_file() else ""
        )
        raise StoreError(f"{folder} has no manifest.json, so it is not a store of descriptors{unfinished}.")
    written = (folder / "manifest.json").read_bytes()
    return _with_array(folder, Manifest.from_json(written, "manifest.json"), written)


def _with_array(folder: Path, manifest: Manifest, written: bytes) -> Store:
    """The store of a manifest and of the bytes it was read from; StoreError when its array does not fit."""
    expected = (len(manifest.rows), manifest.n_parts, manifest.embedding)
    try:
        stat = (folder / "descriptors.npy").stat()
        descriptors = np.load(folder / "descriptors.npy", mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise StoreError(f"descriptors.npy in {folder} is missing or damaged; describe the pictures again.") from error
    if descriptors.shape != expected or descriptors.dtype != np.dtype(manifest.precision):
        raise StoreError(
            f"descriptors.npy in {folder} is {descriptors.dtype} {descriptors.shape}, but its manifest says "
            f"{manifest.precision} {expected}; describe the pictures again."
        )
    told = f"{stat.st_size} {stat.st_mtime_ns}".encode()
    return Store(manifest, descriptors, hashlib.sha256(written + told).hexdigest())


def describe(
    model: Model,
    files: Sequence[Path],
    view: View,
    out: str | Path,
    root: Path | None = None,
    change: Change = UNCHANGED,
    boxes: Sequence[Box | None] | None = None,
    title: str = "Describing",
    precision: Precision = "float32",
) -> Store:
    """Describe picture files into a store, mirror included; what is there already is not computed again.

    Killed at any moment, the next call goes on where it stood. A complete store in `out` of the same model, view,
    change, and precision hands over the rows of files that did not change.

    Args:
        files: the pictures, in the order of the rows.
        out: the store's folder.
        root: folder that the file names in the manifest are relative to.
        change: what is done to each picture first.
        boxes: what each picture is cropped to before anything else, None for the whole of it; one for each file.
        title: shown beside the progress bar.
        precision: of the numbers on disk; they are computed in float32.

    Raises:
        PictureError: naming the files that are no whole pictures (see `lpn.integrity`), before anything is computed.
        InputError: when the model has no such view, or the change would leave nothing of a picture.
        StoreError: when `out` cannot be written, or holds descriptors of another model, view, change, or precision.
    """
    model.check_view(view)
    change.check(model.input_size)
    out = Path(out)
    rows = tuple(_row(file, root, box) for file, box in zip(files, boxes or [None] * len(files), strict=True))
    manifest = Manifest.of(model, view, change, rows, precision)
    before = _usable(out, manifest)
    if before is not None and before.manifest == manifest:
        return before
    check_whole(files, "pictures")
    try:
        out.mkdir(parents=True, exist_ok=True)
        with alone(out, wait=True):
            # Another process may have described the same pictures while this one waited.
            before = _usable(out, manifest)
            if before is None or before.manifest != manifest:
                _write(model, files, manifest, out, before, title)
    except OSError as error:
        raise StoreError(
            f"The store {out} cannot be written ({error.strerror}); free space or choose another folder."
        ) from error
    return open_store(out)


def _write(
    model: Model, files: Sequence[Path], manifest: Manifest, out: Path, before: Store | None, title: str
) -> None:
    if _renamed_only(out):
        os.replace(out / "descriptors.npy", out / "descriptors.part")
    _fill(model, files, manifest, out, before, title)
    # The old manifest must never lie beside the new rows, even when killed between these lines.
    (out / "manifest.json").unlink(missing_ok=True)
    os.replace(out / "descriptors.part", out / "descriptors.npy")
    write_whole(out / "manifest.json", manifest.to_json())
    for name in ("progress.json", "planned.json"):
        (out / name).unlink(missing_ok=True)


Reader = Callable[[Model, Sequence[Picture], View, Change], FloatArray]
"""Where descriptors (N, n, D) of changed pictures come from, such as `cached_descriptors`."""


def cached_descriptors(model: Model, pictures: Sequence[Picture], view: View, change: Change = UNCHANGED) -> FloatArray:
    """Descriptors (N, n, D) of pictures within their boxes, from the user's cache where they were described before.

    The cache is `$LPN_CACHE`, else `lpn-explorer` in `$XDG_CACHE_HOME` or `~/.cache`; it may be deleted at any time.
    """
    return _cached(model, pictures, view, change).descriptors


def _cached(model: Model, pictures: Sequence[Picture], view: View, change: Change) -> Side:
    files = _resolved(pictures)
    # By their folder, not by their list: when a picture is added or mended, the others' rows are taken over.
    common = os.path.commonpath({file.parent for file in files})
    boxes = [picture.box for picture in pictures]
    identity: list[Any] = [model.fingerprint, view, change.rotate, common]
    # Only what differs from a picture as it is, so that caches from before there were such changes are still found.
    identity += [f"shift {change.shift}"] if change.shift else []
    identity += [f"scale {change.scale}"] if change.scale != 1 else []
    identity += [f"down {change.down}"] if change.down else []
    identity += ["around"] if change.around else []
    identity += ["cropped"] if any(boxes) else []
    folder = cache_folder() / "descriptors" / hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:24]
    title = ", ".join(filter(None, (f"Describing {view}", change.describe())))
    try:
        if (held := _held(model, files, view, folder, change, boxes)) is not None:
            return held
        store = describe(model, files, view, folder, change=change, boxes=boxes, title=title)
        return Side(store.float32, store.identity)
    except (StoreError, OutputError) as error:
        raise StoreError(
            f"The cache of descriptors in {cache_folder()} cannot be used ({error}) Set LPN_CACHE to a folder that can be "
            "written."
        ) from error


def _resolved(pictures: Sequence[Picture]) -> list[Path]:
    """The file behind each picture, links followed; a folder is followed once for all that is in it."""
    folders: dict[Path, Path] = {}
    files = []
    for picture in pictures:
        parent = picture.path.parent
        if parent not in folders:
            folders[parent] = parent.resolve()
        file = folders[parent] / picture.path.name
        files.append(file.resolve() if file.is_symlink() else file)
    return files


def shipped_descriptors(model: Model, pictures: Sequence[Picture], view: View, store: Path) -> FloatArray | None:
    """Descriptors (N, n, D) from a store that came with the pictures, or None where it is not of this model and these.

    Files are compared by name and size: a copy of a data set has other times than its original.
    """
    found = _shipped(model, pictures, view, store)
    return None if found is None else found.descriptors


def _shipped(model: Model, pictures: Sequence[Picture], view: View, store: Path) -> Side | None:
    try:
        held = open_store(store)
    except StoreError:
        return None
    rows = [(printable(str(row.file)), row.size, row.box) for row in held.manifest.rows]
    if len(rows) != len(pictures):
        return None
    these = [(f"{p.path.parent.name}/{p.path.name}", p.path.stat().st_size, p.box) for p in pictures]
    wanted = (model.fingerprint, view, UNCHANGED, model.n_parts)
    found = (held.manifest.fingerprint, held.manifest.view, held.manifest.change, held.manifest.n_parts)
    return Side(held.float32, held.identity) if found == wanted and rows == these else None


Role = Literal["query", "gallery"]


@dataclass(frozen=True, eq=False)
class Side:
    """Descriptors (N, n, D) of one side of a test split, and a text that no other descriptors have."""

    descriptors: FloatArray
    identity: str


def known_side(model: Model, pictures: Sequence[Picture], view: View, root: Path, role: Role) -> Side:
    """One side of a test split: descriptors that came with the data set in `root`, else from the cache."""
    found = _shipped(model, pictures, view, root / STORES / f"{role}_{view}")
    return _cached(model, pictures, view, UNCHANGED) if found is None else found


def known_descriptors(model: Model, pictures: Sequence[Picture], view: View, root: Path, role: Role) -> FloatArray:
    """The descriptors (N, n, D) of `known_side` alone."""
    return known_side(model, pictures, view, root, role).descriptors


def passing_descriptors(
    model: Model, pictures: Sequence[Picture], view: View, change: Change = UNCHANGED
) -> FloatArray:
    """The same for a model that will soon be another, such as one in training: nothing is kept on disk."""
    files, boxes = [picture.path for picture in pictures], [picture.box for picture in pictures]
    with TemporaryDirectory(prefix="lpn-") as folder:
        store = describe(model, files, view, folder, change=change, boxes=boxes, title=f"Describing {view}")
        return np.array(store.descriptors)


def _held(
    model: Model, files: Sequence[Path], view: View, folder: Path, change: Change, boxes: Sequence[Box | None]
) -> Side | None:
    """Descriptors of files that a store has, all or some, so that a part of a folder does not replace the whole."""
    store = _complete(folder)
    if store is None or len(store.manifest.rows) < len(files):
        return None
    if not Manifest.of(model, view, change, ()).comparable(store.manifest):
        return None
    asked = tuple(_row(file, None, box) for file, box in zip(files, boxes, strict=True))
    if asked == store.manifest.rows:
        return Side(store.float32, store.identity)
    rows = {row: position for position, row in enumerate(store.manifest.rows)}
    wanted = [rows.get(row) for row in asked]
    if None in wanted:
        return None
    some = np.array(wanted, np.int64)
    return Side(store.float32[some], hashlib.sha256(store.identity.encode() + some.tobytes()).hexdigest())


def cache_folder() -> Path:
    """Where descriptors are kept between runs."""
    if given := os.environ.get("LPN_CACHE"):
        return Path(given)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lpn-explorer"


def pictures_below(folder: str | Path) -> list[Path]:
    """All picture files below a folder, in order of path.

    Raises:
        DataError: when there is no such folder or no picture in it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"There is no folder of pictures at {folder}; check the path.")
    files = files_below(folder)
    if not files:
        raise DataError(f"{folder} holds no pictures; expected files ending in {', '.join(images.SUFFIXES)}.")
    return files


def _row(file: Path, root: Path | None, box: Box | None) -> Row:
    try:
        stat = file.stat()
    except OSError as error:
        raise PictureError(f"The picture {file} cannot be read ({error.strerror}); check the path.") from error
    return Row(str(file.relative_to(root) if root else file), stat.st_size, stat.st_mtime_ns, _box(box))


def _box(values: Any) -> Box | None:
    """A box as it is compared: four floats, as JSON gives them back."""
    if values is None:
        return None
    left, top, right, bottom = (float(value) for value in values)
    return left, top, right, bottom


def _renamed_only(folder: Path) -> bool:
    """Whether a run was killed after its rows got their name and before its manifest was written."""
    there = [
        (folder / name).exists() for name in ("progress.json", "descriptors.npy", "descriptors.part", "manifest.json")
    ]
    return there == [True, True, False, False]


def _usable(out: Path, manifest: Manifest) -> Store | None:
    """The complete store in `out` whose rows may be taken over; StoreError when they are of another kind."""
    store = _complete(out)
    if store is not None and not manifest.comparable(store.manifest):
        held = store.manifest
        raise StoreError(
            f"{out} holds {held.view} descriptors of model {held.fingerprint}, {held.change.describe() or 'unchanged'}, in "
            f"{held.precision}, and these would be {manifest.view} of {manifest.fingerprint}, "
            f"{manifest.change.describe() or 'unchanged'}, in {manifest.precision}; choose another folder, or delete that one."
        )
    return store


def _complete(folder: Path) -> Store | None:
    """The complete store in a folder, or None when there is none or its array is damaged.

    Raises:
        StoreError: when the folder holds files of other origin under a store's names.
    """
    manifest = folder / "manifest.json"
    if manifest.exists():
        try:
            written = manifest.read_bytes()
            read = Manifest.from_json(written, manifest.name)
        except (StoreError, OSError) as error:
            raise StoreError(
                f"{folder} has a manifest.json that is not one of {FORMAT}; choose another folder, or delete that file if it "
                "is of no use."
            ) from error
        try:
            return _with_array(folder, read, written)
        except StoreError:
            return None
    if (folder / "descriptors.npy").exists() and not (folder / "planned.json").exists():
        raise StoreError(
            f"{folder} has a descriptors.npy without a manifest.json, so it is not ours to replace; choose another folder."
        )
    return None


def _fill(model: Model, files: Sequence[Path], manifest: Manifest, out: Path, before: Store | None, title: str) -> None:
    """Compute all rows into `descriptors.part`, noting in `progress.json` how many are on disk."""
    part, planned, progress_file = (out / name for name in ("descriptors.part", "planned.json", "progress.json"))
    left = _interrupted(manifest, part, planned, progress_file)
    known = _known_rows(manifest, before)
    done = 0
    if left is not None and left.manifest == manifest:
        done = len(left.descriptors)
        array = np.lib.format.open_memmap(part, mode="r+")
    else:
        known |= _known_rows(manifest, left)
        shape = (len(files), manifest.n_parts, manifest.embedding)
        fresh_part = part.with_name(part.name + ".new")
        array = np.lib.format.open_memmap(fresh_part, mode="w+", dtype=manifest.precision, shape=shape)
        for i, row in known.items():
            array[i] = row
        array.flush()
        # What was left is let go of only when the new array has it.
        progress_file.unlink(missing_ok=True)
        os.replace(fresh_part, part)
        write_whole(planned, manifest.to_json())
    bounds = [*range(done, len(files), _BATCH), len(files)]
    batches = [range(a, b) for a, b in pairwise(bounds)]
    for batch, prepared in _prepared(model, files, manifest, known, batches, done, title):
        fresh = [i for i in batch if i not in known]
        if fresh:
            array[fresh] = _stored(model.descriptors(prepared, cast(View, manifest.view)), manifest.precision)
        array.flush()
        write_whole(progress_file, json.dumps({"done": batch.stop}).encode())
    del array


def _stored(descriptors: FloatArray, precision: Precision) -> npt.NDArray[Any]:
    """Descriptors as they are kept on disk, see the top of this module."""
    if precision == "int8":
        largest = np.abs(descriptors).max(axis=2, keepdims=True)
        directions: npt.NDArray[np.int8] = np.round(descriptors * (127 / np.maximum(largest, 1e-12))).astype(np.int8)
        return directions
    return descriptors.astype(precision, copy=False)


def _prepared(
    model: Model,
    files: Sequence[Path],
    manifest: Manifest,
    known: dict[int, npt.NDArray[Any]],
    batches: Sequence[range],
    done: int,
    title: str,
) -> Iterator[tuple[range, FloatArray]]:
    """Batches ready for the model, the next one decoded while the caller computes."""
    view = cast(View, manifest.view)

    def prepare(batch: range) -> FloatArray:
        ready = [_ready(model, files[i], manifest.rows[i].box, manifest.change, view) for i in batch if i not in known]
        return np.stack(ready) if ready else np.zeros((0, 3, *model.input_size), np.float32)

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with ThreadPoolExecutor(1) as pool, Progress(*columns) as bar:
        task = bar.add_task(title, total=len(files), completed=done)
        ahead = pool.submit(prepare, batches[0]) if batches else None
        for position, batch in enumerate(batches):
            assert ahead is not None
            current = ahead.result()
            ahead = pool.submit(prepare, batches[position + 1]) if position + 1 < len(batches) else None
            yield batch, current
            bar.update(task, completed=batch.stop)


def _ready(model: Model, file: Path, box: Box | None, change: Change, view: View) -> FloatArray:
    """A picture file as the model takes it: cropped, turned and zoomed, brought to size, shifted, normalised."""
    picture = images.crop(images.load_picture(file), box, printable(str(file)))
    return images.normalise(change.move(model.shape(change.apply(picture), view)))


def _interrupted(manifest: Manifest, part: Path, planned: Path, progress_file: Path) -> Store | None:
    """The rows that an interrupted run with this model, view, and change left on disk, under the manifest it planned."""
    try:
        saved: Any = json.loads(progress_file.read_bytes())
        plan = Manifest.from_json(planned.read_bytes(), planned.name)
        array = np.load(part, mmap_mode="r", allow_pickle=False)
        fits = array.shape == (len(plan.rows), manifest.n_parts, manifest.embedding) and array.dtype == np.dtype(
            manifest.precision
        )
        done = int(saved["done"])
        if not (fits and manifest.comparable(plan) and 0 < done <= len(plan.rows)):
            return None
        return Store(plan, array[:done])
    except (OSError, ValueError, KeyError, TypeError, AttributeError, EOFError, LPNError):
        return None


def _known_rows(manifest: Manifest, before: Store | None) -> dict[int, npt.NDArray[Any]]:
    """Rows of the same files that another store has."""
    if before is None or not manifest.comparable(before.manifest):
        return {}
    have = {row: i for i, row in enumerate(before.manifest.rows[: len(before.descriptors)])}
    return {i: before.descriptors[have[row]] for i, row in enumerate(manifest.rows) if row in have}
