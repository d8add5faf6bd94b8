"""Describe pictures into a store. Rows on disk are used again, and a kill loses about one second of work."""

from __future__ import annotations

import errno
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from lpn.core import images
from lpn.core.arrays import AnyArray, BoolArray, Float32Array, UInt8Array
from lpn.core.errors import DataError, OutputError, PictureError, StoreError
from lpn.core.files import exclusive_lock, first_few, open_memmap, printable
from lpn.core.progress import report_progress
from lpn.core.views import View
from lpn.datasets import files_below, unread_below, warn_left_out
from lpn.datasets.integrity import check_whole
from lpn.descriptors.parallel_inference import describe_each
from lpn.descriptors.store import (
    MANIFEST,
    VECTORS,
    CropBox,
    DescriptorKind,
    Manifest,
    Part,
    PartEntry,
    Precision,
    Row,
    Store,
    check_replaceable,
    encode,
    entry_of,
    open_store,
    parts_of,
    row_of,
    sum_of,
    unwritable,
    whole_parts,
    write_part,
)
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.models.base import Model

# A kill loses the work of this many seconds.
_SAVE_SECONDS = 1.0
# Rows that are copied at a time.
_STEP = 1024


def describe(
    model: Model,
    files: Sequence[Path],
    view: View,
    out: str | Path,
    root: Path | None = None,
    change: Change = UNCHANGED,
    boxes: Sequence[CropBox | None] | None = None,
    precision: Precision = "float32",
) -> Store:
    """Describe picture files, mirror included, into a store; existing rows are not computed again.

    It reports its progress (`lpn.core.progress`). After a kill, the next call resumes. If `out` holds a store of the same kind,
    the rows of unchanged files are copied from it.

    Args:
        files: the pictures, in the order of the rows.
        out: the store's folder.
        root: file names in the store are relative to this folder.
        change: the transform of each picture.
        boxes: the crop of each picture, applied first; None for a whole picture.
        precision: precision of the numbers on disk; the computation is in float32.

    Raises:
        PictureError: if files are broken; it names the first few. Damage of header or end is reported before any computation
            (see `lpn.datasets.integrity`), other damage after all other files are described.
        InputError: if the model lacks the view, or the transform leaves nothing of a picture.
        StoreError: if `out` cannot be written, or holds other descriptors.
    """
    model.check_view(view)
    change.check(model.input_size)
    rows = [row_of(file, root, box) for file, box in zip(files, boxes or [None] * len(files), strict=True)]
    kind = DescriptorKind.of_model(model, view, change, precision)
    before = _before(Path(out), kind)
    if before is not None and before.rows == rows and len(parts_of(Path(out))) == len(before.parts):
        return before
    return write_store(Path(out), kind, rows, _describer(model, files, rows, view, change))


def describe_share(
    model: Model,
    files: Sequence[Path],
    view: View,
    out: str | Path,
    root: Path,
    share: tuple[int, int],
    precision: Precision = "float32",
) -> int:
    """Describe the i-th of n equal shares of files, for a share (i, n), so that n machines share the work.

    The rows become parts in `out`; a later `describe` of all files makes the store. Arguments and errors are those of `describe`.

    Returns:
        The number of files in the share.
    """
    model.check_view(view)
    out, (i, n) = Path(out), share
    kind = DescriptorKind.of_model(model, view, UNCHANGED, precision)
    _before(out, kind)
    for part, notes in whole_parts(out):
        if notes.kind != kind.digest:
            raise StoreError(
                f"{part} holds other descriptors than {kind}; give all shares the same options, or choose another folder."
            )
    files = files[(i - 1) * len(files) // n : i * len(files) // n]
    rows = [row_of(file, root, None) for file in files]
    try:
        out.mkdir(parents=True, exist_ok=True)
        partial = PartialStore(out, kind, rows)
        _fill(partial, _describer(model, files, rows, view, UNCHANGED))
    except OSError as error:
        raise unwritable(out, error) from error
    return len(rows)


def _describer(
    model: Model, files: Sequence[Path], rows: Sequence[Row], view: View, change: Change
) -> Callable[[PartialStore], None]:
    """Return a function that describes the missing rows of files; PictureError if files are broken."""

    def prepare(row: int) -> Float32Array:
        picture = images.load_picture(files[row], upright=not change.released)
        return prepare_row(model, picture, rows[row], change, view)

    def fill(partial: PartialStore) -> None:
        check_whole(files, "pictures")
        broken: dict[int, PictureError] = {}
        stage = ", ".join(filter(None, (f"Describing {view} pictures", change.describe())))
        fill_store(model, partial, prepare, view, stage, broken)
        if broken:
            raise _broken([(rows[row].file, broken[row]) for row in sorted(broken)], len(rows))

    return fill


def _broken(errors: Sequence[tuple[str, PictureError]], total: int) -> PictureError:
    """Return the error about all pictures that could not be described."""
    if len(errors) == 1:
        return errors[0][1]
    names = first_few([printable(name) for name, _ in errors], 5)
    return PictureError(f"{len(errors)} of {total} pictures cannot be described: {names}. The first: {errors[0][1]}")


class PartialStore:
    """The rows of a future store, taken from parts on disk, or set by `put` and saved as further parts."""

    def __init__(self, folder: Path, kind: DescriptorKind, rows: Sequence[Row]) -> None:
        self.folder, self.kind, self.rows = folder, kind, rows
        wanted, found = set(rows), dict[Row, tuple[Path, int]]()
        for part, notes in whole_parts(folder):
            held = notes.rows() if notes.kind == kind.digest else []
            here = {row: (part, i) for i, row in enumerate(held) if row in wanted and row not in found}
            with suppress(OSError):  # without its vectors, the part is left out
                if here and sum_of(part / VECTORS) == notes.sum:
                    found |= here
        # The part of each row, and the row's number in that part.
        self._places = [found.get(row) for row in rows]
        self._waiting: dict[int, AnyArray] = {}
        self._saved = time.monotonic()

    @property
    def good(self) -> BoolArray:
        """The finished rows, (N,)."""
        return np.array([at is not None or i in self._waiting for i, at in enumerate(self._places)], bool)

    def put(self, rows: Sequence[int], descriptors: Float32Array) -> None:
        """Set rows from descriptors (B, n, D) float32; they are saved about once a second."""
        self._waiting |= zip(rows, encode(descriptors, self.kind.precision), strict=True)
        if time.monotonic() - self._saved >= _SAVE_SECONDS:
            self.save()

    def save(self) -> None:
        """Write the waiting rows as a part."""
        if self._waiting:
            waiting = dict(sorted(self._waiting.items()))
            entry = write_part(self.folder, self.kind, [self.rows[i] for i in waiting], [np.stack([*waiting.values()])])
            for place, i in enumerate(waiting):
                self._places[i] = (self.folder / entry.name, place)
            self._waiting = {}
        self._saved = time.monotonic()

    def blocks(self) -> Iterator[AnyArray]:
        """Yield all saved rows in order, block by block; missing ones are 0."""
        shape = self.kind.n_parts, self.kind.embedding
        for start in range(0, len(self.rows), _STEP):
            places = self._places[start : start + _STEP]
            block = np.zeros((len(places), *shape), self.kind.precision)
            of_part: dict[Path, list[tuple[int, int]]] = {}
            for i, at in enumerate(places):
                if at is not None:
                    of_part.setdefault(at[0], []).append((i, at[1]))
            for part, pairs in of_part.items():
                here, there = np.array(pairs).T
                block[here] = open_memmap(part / VECTORS)[there]
            yield block

    def store(self) -> Store:
        """Return all rows in memory; missing ones are 0."""
        parts = [Part(self.folder, np.concatenate([*self.blocks()]))] if self.rows else []
        entries = tuple(PartEntry("", len(self.rows), "") for _ in parts)
        return Store(self.folder, Manifest(kind=self.kind, parts=entries), parts)

    def finish(self) -> None:
        """Make a store of one part with the rows in order; write this part unless it exists."""
        one = {at[0] for at in self._places if at is not None}
        entry = None
        if len(one) == 1 and [at[1] for at in self._places if at is not None] == list(range(len(self.rows))):
            entry = entry_of(one.pop())
        if entry is None or entry.rows != len(self.rows):
            entry = write_part(self.folder, self.kind, self.rows, self.blocks())
        Manifest(kind=self.kind, parts=(entry,)).write(self.folder)


def write_store(
    out: Path, kind: DescriptorKind, rows: Sequence[Row], fill: Callable[[PartialStore], None], whole: bool = True
) -> Store:
    """Write a store, or open the existing one.

    Args:
        out: the store's folder.
        rows: the pictures, in order.
        fill: called to put every missing row.
        whole: refuse missing rows; otherwise these are 0, and the returned store is in memory.

    Raises:
        StoreError: if `out` cannot be written or holds other descriptors, or if `fill` leaves rows of a whole store out.
    """
    rows = list(rows)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with exclusive_lock(out, wait=True):
            # Another process may have described the same pictures while this one waited.
            before = _before(out, kind)
            if before is not None and before.rows == rows:
                before.manifest.write(out)
                return before
            partial = PartialStore(out, kind, rows)
            _fill(partial, fill)
            missing = int((~partial.good).sum())
            if missing and not whole:
                return partial.store()
            if missing:
                raise StoreError(f"{missing} of {len(rows)} rows of {out} were not written; run this again to resume.")
            partial.finish()
    except (OSError, OutputError) as error:
        raise unwritable(out, error) from error
    return open_store(out)


def _fill(partial: PartialStore, fill: Callable[[PartialStore], None]) -> None:
    """Fill a store, and save its rows even if `fill` is interrupted."""
    try:
        fill(partial)
    finally:
        partial.save()


def _before(out: Path, kind: DescriptorKind) -> Store | None:
    """Return the store in a folder, which a description may replace; None if there is none, or its arrays are damaged."""
    if not (out / MANIFEST).exists():
        return None
    held, parts = Manifest.read(out), whole_parts(out)
    store: Store | None = None
    try:
        store = open_store(out)
        parts = iter([(part.folder, part.notes) for part in store.parts])
    except StoreError as error:
        cause = error.__cause__
        if isinstance(cause, OSError) and cause.errno in (errno.EMFILE, errno.ENFILE):
            raise
        store = None
    check_replaceable(held, parts, kind, out)
    return store


def fill_store(
    model: Model,
    partial: PartialStore,
    prepare: Callable[[int], Float32Array],
    view: View,
    stage: str,
    broken: dict[int, PictureError] | None = None,
) -> None:
    """Describe the missing rows of a store.

    Args:
        prepare: returns the model's input (3, H, W) of a row.
        stage: name of the work in its progress.
        broken: takes the error of each unreadable row; without it, the first error is raised.

    Raises:
        PictureError: the first that `prepare` raises.
    """
    good = partial.good
    missing, total, done = np.flatnonzero(~good).tolist(), len(good), int(good.sum())
    report_progress(stage, done, total)
    for batch in describe_each(model, missing, prepare, view):
        if batch.items:
            partial.put([missing[i] for i in batch.items], batch.descriptors)
        for i, error in batch.broken:
            if broken is None:
                raise error
            broken[missing[i]] = error
        done += len(batch.items) + len(batch.broken)
        report_progress(stage, done, total)


def prepare_row(model: Model, picture: UInt8Array, row: Row, change: Change, view: View) -> Float32Array:
    """Convert a picture (H, W, 3) to the model's input (3, H, W): crop, rotate and zoom, resize, shift, normalise."""
    cropped = images.crop(picture, row.box, printable(row.file))
    return model.normalise(change.move(model.to_input_size(change.apply(cropped), view)))


def pictures_below(folder: str | Path) -> list[Path]:
    """Return all picture files below a folder, in order of path.

    Raises:
        DataError: if the folder does not exist or holds no picture.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"There is no folder of pictures at {folder}; check the path.")
    files = files_below(folder)
    warn_left_out(folder.name, unread_below(folder), "picture")
    if not files:
        raise DataError(f"{folder} holds no pictures; expected files ending in {', '.join(images.SUFFIXES)}.")
    return files
