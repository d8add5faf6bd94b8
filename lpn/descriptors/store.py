"""A store: a folder of immutable parts, which hold descriptors of pictures or of tiles.

    store.json               format, kind of the descriptors, the parts of the store in order, checksum
    part-0000012-a1b2c3/     a part
        vectors.npy          (B, n, D) float32, float16, or int8. Each part of a descriptor has norm 1/sqrt(n); int8 stores only
                             its direction, scaled so that the largest number is 127
        rows.json            file, size, time, crop box, and position of each row, and the SHA-256 of vectors.npy

- A part is written once, and its rows.json last. A part without a whole rows.json is a leftover.
- store.json is replaced last. A part that it does not name belongs to an unfinished run: the next run takes its rows over.
- A row that a newer part replaces is listed in store.json; files of older parts stay as they are.

Resuming, adding, replacing, sharing the work among machines, searching, and verifying follow from these rules.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import secrets
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from lpn.core.arrays import AnyArray, Float32Array, Float64Array, Int64Array, IntegerArray
from lpn.core.checksums import crc_of_values
from lpn.core.errors import InputError, NewerStoreError, PictureError, StoreError
from lpn.core.files import open_memmap, raise_open_file_limit, space_remedy, unreadable_error, write_atomic
from lpn.core.formats import decode_json, is_newer, newer_version
from lpn.core.views import View
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.models.base import Model
from lpn.models.contract import Role

FORMAT = "lpn-store/1"
MANIFEST, VECTORS, ROWS = "store.json", "vectors.npy", "rows.json"
Precision = Literal["float32", "float16", "int8"]
CropBox = tuple[float, float, float, float]
# Rows that are checked at a time.
_STEP = 4096
_Count = Annotated[int, Meta(gt=0, lt=2**31)]
UNFINISHED = "its description was not finished; give the same lpn describe command again, without --part"
_PART = re.compile(r"part-(\d{7,})-[0-9a-f]{6}")


class Row(NamedTuple):
    """The picture of one row.

    Attributes:
        file: its path, relative to the described folder, or a tile's name.
        size: its size in bytes.
        time_ns: its modification time.
        box: the crop (left, top, right, bottom) in pixels; None for the whole picture.
    """

    file: str
    size: int = 0
    time_ns: int = 0
    box: CropBox | None = None


@dataclass(frozen=True)
class WindowsRecord:
    """The windows of a map in an index.

    Attributes:
        map: `Map.identity` of the map.
        sizes: their sides in metres, ascending.
        overlap: share of a side that a neighbour also covers.
        turns: number of headings at which each window is described, evenly spaced from 0 on.
        count: windows of the whole map, each counted once for all its turns.
    """

    map: str
    sizes: tuple[float, ...]
    overlap: float
    turns: int
    count: int

    def __str__(self) -> str:
        sizes = ", ".join(f"{size:g}" for size in self.sizes)
        return f"{sizes} m with an overlap of {self.overlap:g} at {self.turns} headings, of the map {self.map}"


@dataclass(frozen=True)
class DescriptorKind:
    """The kind of descriptors that a store holds.

    Attributes:
        fingerprint: fingerprint of the model; descriptors of different models cannot be compared.
        n_parts, embedding: n and D.
        windows: the record of a map's windows; None for other pictures.
        view: the branch used; empty if it is unknown.
        change: the transform of the pictures; its scale includes their zoom.
        precision: of the numbers on disk.
        role: of the branch, if branches have roles.
    """

    fingerprint: str
    n_parts: _Count
    embedding: _Count
    windows: WindowsRecord | None = None
    view: str = ""
    change: Change = UNCHANGED
    precision: Precision = "float32"
    role: Role | None = None

    @classmethod
    def of_model(
        cls, model: Model, view: View, change: Change = UNCHANGED, precision: Precision = "float32"
    ) -> DescriptorKind:
        """Return the kind of a model's descriptors of changed pictures."""
        change = replace(change, scale=change.scale * change.zoom, zoom=1.0)
        role = model.role(view) if model.contract.roles == "role" else None
        return cls(model.fingerprint, model.n_parts, model.embedding, None, view, change, precision, role)

    @property
    def numbers(self) -> int:
        """Length n D of a descriptor."""
        return self.n_parts * self.embedding

    @property
    def digest(self) -> str:
        """A hash of all values, by which parts of one kind are recognised."""
        return hashlib.sha256(msgspec.json.encode(self, order="sorted")).hexdigest()[:24]

    def __str__(self) -> str:
        view = f"{self.view} descriptors" if self.view else "descriptors"
        windows = f", of windows of {self.windows}" if self.windows else ""
        shape = f"{self.n_parts} x {self.embedding} numbers in {self.precision}"
        return f"{view} of model {self.fingerprint}, {self.change.describe() or 'unchanged'}, {shape}{windows}"


class PartEntry(msgspec.Struct, frozen=True):
    """A part of a store.

    Attributes:
        name: its folder.
        rows: number of its rows, replaced ones included.
        sum: SHA-256 of its rows.json.
        replaced: rows that newer parts replace, ascending.
    """

    name: str
    rows: Annotated[int, Meta(ge=0)]
    sum: str
    replaced: tuple[Annotated[int, Meta(ge=0)], ...] = ()


class CodesEntry(msgspec.Struct, frozen=True):
    """A file of faiss beside the parts.

    Attributes:
        name: of the file.
        parts: the oldest parts, which it covers.
        sum: its SHA-256.
    """

    name: str
    parts: tuple[str, ...]
    sum: str


class Manifest(msgspec.Struct, frozen=True, kw_only=True):
    """The contents of store.json.

    Attributes:
        engine: the engine that searches the store: "exact" or "faiss".
        parts: oldest first.
        codes: the file of faiss, if there is one.

    The file also has `checksum`, the CRC-32 of all other values.
    """

    format: str = FORMAT
    kind: DescriptorKind
    engine: str = "exact"
    parts: tuple[PartEntry, ...] = ()
    codes: CodesEntry | None = None

    @classmethod
    def read(cls, folder: Path) -> Manifest:
        """Read the store.json of a folder.

        Raises:
            NewerStoreError: if a later version wrote it.
            StoreError: if there is none, or it is damaged.
        """
        try:
            data = (folder / MANIFEST).read_bytes()
            manifest = decode_json(data, cls, f"{MANIFEST} in {folder}", FORMAT, NewerStoreError)
            values = json.loads(data)
            if values.pop("checksum", None) != crc_of_values(values):
                raise ValueError("the checksum does not match")
            return manifest
        except (FileNotFoundError, NotADirectoryError) as error:
            unfinished = f" ({UNFINISHED})" if parts_of(folder) else ""
            raise StoreError(
                f"{folder} has no {MANIFEST}, so it is not a store of descriptors and not an index{unfinished}."
            ) from error
        except OSError as error:
            raise unreadable_error(folder / MANIFEST, error) from error
        except (ValueError, RecursionError, InputError) as error:
            raise StoreError(
                f"{MANIFEST} in {folder} is damaged or not of the format {FORMAT}; describe the pictures again after you delete "
                "that file, or make the index again in another folder."
            ) from error

    def encoded(self) -> bytes:
        """Return the contents of store.json."""
        values = msgspec.to_builtins(self)
        return json.dumps(values | {"checksum": crc_of_values(values)}, indent=1).encode()

    def write(self, folder: Path) -> None:
        """Replace the store.json of a folder, and delete the parts and codes that it does not name."""
        write_atomic(folder / MANIFEST, self.encoded())
        named = {entry.name for entry in self.parts} | {self.codes.name if self.codes else MANIFEST}
        for path in folder.iterdir():
            if path.name in named or path.is_symlink():
                continue
            if _PART.fullmatch(path.name):
                delete_part(path)
            elif _PART.fullmatch(path.stem) and path.suffix == ".faiss":
                path.unlink(missing_ok=True)


class PartRows(msgspec.Struct, kw_only=True):
    """The contents of rows.json.

    Attributes:
        kind: `DescriptorKind.digest` of the descriptors.
        sum: SHA-256 of vectors.npy.
        files, sizes, times, boxes: the values of each `Row`; boxes are left out where there are none.
        positions: latitude and longitude in degrees; left out where there are none.
    """

    format: str = FORMAT
    kind: str
    sum: str
    files: list[str]
    sizes: list[int]
    times: list[int]
    boxes: list[CropBox | None] = []
    positions: list[tuple[float, float] | None] = []

    @classmethod
    def read(cls, part: Path) -> PartRows:
        """Read the rows of a part.

        Raises:
            NewerStoreError: if a later version wrote them.
            OSError, ValueError, RecursionError: if they cannot be read, or are damaged.
        """
        # Names of files need not be UTF-8, and msgspec's decoder refuses the lone surrogates that Python writes for them.
        values: Any = json.loads((part / ROWS).read_bytes())
        stated = values.get("format") if isinstance(values, dict) else None
        if is_newer(stated, FORMAT):
            raise NewerStoreError(newer_version(f"{ROWS} in {part}", str(stated), FORMAT))
        rows = msgspec.convert(values, cls)
        count = len(rows.files)
        if stated != FORMAT or any(len(some) != count for some in (rows.sizes, rows.times)):
            raise ValueError("another format, or another number of values")
        if any(len(some) not in (0, count) for some in (rows.boxes, rows.positions)):
            raise ValueError("another number of values")
        return rows

    def rows(self) -> list[Row]:
        """Return the rows of the part."""
        boxes = self.boxes or [None] * len(self.files)
        return list(map(Row, self.files, self.sizes, self.times, boxes))


class Part:
    """The rows of a part, with memory-mapped descriptors.

    Attributes:
        vectors: (B, n, D) in the precision of the store.
    """

    def __init__(self, folder: Path, vectors: AnyArray) -> None:
        self.folder, self.vectors = folder, vectors

    @classmethod
    def open(cls, folder: Path, kind: DescriptorKind, rows: int) -> Part:
        """Open a part of a store.

        Raises:
            StoreError: if it is missing, is damaged, or cannot be read.
        """
        with readable(folder / VECTORS):
            vectors = open_memmap(folder / VECTORS)
            if vectors.shape != (rows, kind.n_parts, kind.embedding) or vectors.dtype != np.dtype(kind.precision):
                raise ValueError("another shape")
            return cls(folder, vectors)

    @cached_property
    def notes(self) -> PartRows:
        """The contents of rows.json."""
        with readable(self.folder / ROWS):
            notes = PartRows.read(self.folder)
            if len(notes.files) != len(self.vectors):
                raise ValueError("another number of rows")
            return notes

    @cached_property
    def positions(self) -> Float64Array:
        """Latitude and longitude in degrees, (B, 2), NaN for a row without a position."""
        nowhere = (np.nan, np.nan)
        known = self.notes.positions or [None] * len(self.vectors)
        return np.array([nowhere if at is None else at for at in known], np.float64).reshape(-1, 2)


class Store:
    """The parts that store.json named when it was read.

    Attributes:
        folder, manifest: its folder, and the contents of store.json.
        kind: the kind of descriptors.
        parts: oldest first.
        stamp: identifies the version of store.json, so that a reader notices a change.
        kept: the rows of each part that no newer part replaces, ascending; None for all.
    """

    def __init__(self, folder: Path, manifest: Manifest, parts: Sequence[Part]) -> None:
        self.folder, self.manifest, self.kind, self.parts = folder, manifest, manifest.kind, parts
        self.stamp: tuple[int, ...] = ()
        self.kept: list[Int64Array | None] = [
            np.delete(np.arange(entry.rows), list(entry.replaced)) if entry.replaced else None
            for entry in manifest.parts
        ]
        # The place of each part's first row among all rows, and the number of all rows.
        self.starts: Int64Array = np.cumsum([0, *(entry.rows for entry in manifest.parts)], dtype=np.int64)

    def __len__(self) -> int:
        return sum(entry.rows - len(entry.replaced) for entry in self.manifest.parts)

    @cached_property
    def rows(self) -> list[Row]:
        """The picture of each row."""
        found: list[Row] = []
        for part, some in zip(self.parts, self.kept, strict=True):
            rows = part.notes.rows()
            found += rows if some is None else [rows[i] for i in some.tolist()]
        return found

    @property
    def names(self) -> list[str]:
        """The file of each row."""
        return [row.file for row in self.rows]

    @property
    def positions(self) -> Float64Array:
        """Latitude and longitude in degrees, (N, 2), NaN for a row without a position."""
        return self._joined([part.positions for part in self.parts], np.zeros((0, 2)))

    @cached_property
    def places(self) -> Int64Array:
        """The place of each row among the rows of all parts, replaced ones included, (N,)."""
        found = [np.zeros(0, np.int64)]
        for start, entry, some in zip(self.starts.tolist(), self.manifest.parts, self.kept, strict=False):
            found.append(start + (np.arange(entry.rows) if some is None else some))
        return np.concatenate(found)

    @cached_property
    def descriptors(self) -> AnyArray:
        """The descriptors (N, n, D) in the store's precision; those of a single part are memory-mapped, read-only."""
        empty = np.zeros((0, self.kind.n_parts, self.kind.embedding), self.kind.precision)
        return self._joined([part.vectors for part in self.parts], empty)

    @property
    def float32(self) -> Float32Array:
        """The descriptors (N, n, D) in float32: memory-mapped if stored so in a single part, else a copy."""
        return to_float32(self.descriptors)

    def some(self, rows: IntegerArray) -> Float32Array:
        """Return some rows in float32 without reading the others."""
        places = self.places[rows]
        found = np.empty((len(places), self.kind.n_parts, self.kind.embedding), np.float32)
        for number, mine in self.by_part(places):
            found[mine] = to_float32(self.parts[number].vectors[places[mine] - self.starts[number]])
        return found

    def by_part(self, places: Int64Array) -> Iterator[tuple[int, Int64Array]]:
        """Yield the number of each part that holds some of the places, and the indices of these places."""
        owners = np.searchsorted(self.starts, places, "right") - 1
        for number in np.unique(owners).tolist():
            yield number, np.flatnonzero(owners == number)

    def find(self, names: Sequence[str]) -> Int64Array:
        """Return the place of each name among the rows of all parts, (B,), -1 for a name that is in none."""
        return np.array([self.place_of.get(name, -1) for name in names], np.int64)

    @cached_property
    def place_of(self) -> dict[str, int]:
        """The place of each name, see `find`."""
        return self._places_from(0)

    def take_names(self, before: Store) -> None:
        """Reuse the names that an earlier `Store` has read, if only parts were added since."""
        known = len(before.parts)
        if "place_of" in before.__dict__ and self.parts[:known] == before.parts:
            places = before.place_of | self._places_from(known)
            # Rows may also be replaced without a new row of their name.
            if len(places) == len(self):
                self.place_of = places

    def _places_from(self, first: int) -> dict[str, int]:
        places: dict[str, int] = {}
        for number, part in enumerate(self.parts[first:], first):
            start, files, kept = int(self.starts[number]), part.notes.files, self.kept[number]
            rows = range(len(files)) if kept is None else kept.tolist()
            places |= {files[row]: start + row for row in rows}
        return places

    def check(self) -> int:
        """Compare all files with their checksums; return the number of unfinished parts beside the store's parts.

        Raises:
            StoreError: if a file is damaged, or holds values that are not finite.
        """
        for part, entry in zip(self.parts, self.manifest.parts, strict=True):
            _check_sum(part.folder / ROWS, entry.sum)
            _check_sum(part.folder / VECTORS, part.notes.sum)
            for start in range(0, len(part.vectors), _STEP):
                self.check_finite(part.vectors[start : start + _STEP])
        if self.manifest.codes is not None:
            _check_sum(self.folder / self.manifest.codes.name, self.manifest.codes.sum)
        return len({path.name for path in parts_of(self.folder)} - {entry.name for entry in self.manifest.parts})

    def check_finite(self, values: AnyArray) -> None:
        """Raise StoreError if descriptors or scores are not finite."""
        if not np.isfinite(values).all():
            raise StoreError(
                f"{self.folder} holds values that are not finite; delete that folder, and describe the pictures again, or make "
                "the index again."
            )

    def _joined(self, arrays: Sequence[AnyArray], empty: AnyArray) -> AnyArray:
        found = [one if some is None else one[some] for one, some in zip(arrays, self.kept, strict=True)]
        return found[0] if len(found) == 1 else np.concatenate([empty, *found])


def open_store(folder: str | Path, known: Mapping[str, Part] | None = None) -> Store:
    """Open a store.

    Args:
        known: open parts by name, which need not be opened again.

    Raises:
        StoreError: if the folder is not a complete store, or its files do not match.
    """
    raise_open_file_limit()
    folder = Path(folder)
    manifest, known = Manifest.read(folder), known or {}
    parts = [known.get(one.name) or Part.open(folder / one.name, manifest.kind, one.rows) for one in manifest.parts]
    return Store(folder, manifest, parts)


def check_replaceable(
    held: Manifest, parts: Iterable[tuple[Path, PartRows]], kind: DescriptorKind, where: object
) -> None:
    """Raise StoreError if a store holds other descriptors, or is an index, whose tiles could not be restored.

    Args:
        parts: parts in its folder, with their rows.
        where: its name in messages.
    """
    if held.kind != kind:
        raise StoreError(
            f"{where} holds {held.kind}, and these would be {kind}; choose another folder, or delete that one."
        )
    named = {part.name for part in held.parts}
    stats = (stat for part, notes in parts if part.name in named for stat in zip(notes.sizes, notes.times, strict=True))
    if held.engine != "exact" or not all(map(any, stats)):
        raise StoreError(f"{where} is an index, which descriptors would replace; choose another folder for them.")


def write_part(
    folder: Path,
    kind: DescriptorKind,
    rows: Sequence[Row],
    blocks: Iterable[AnyArray],
    positions: Float64Array | None = None,
    number: int | None = None,
) -> PartEntry:
    """Write a part that no store.json names yet.

    Args:
        rows: the pictures, (B,).
        blocks: their descriptors in the precision of the kind, block by block, (B, n, D) in all.
        positions: latitude and longitude in degrees, (B, 2), NaN for a row without a position; None for no positions.
        number: position of the part in the order of parts; by default the last.
    """
    number = number or 1 + max((int(path.name.split("-")[1]) for path in parts_of(folder)), default=0)
    part = folder / f"part-{number:07d}-{secrets.token_hex(3)}"
    part.mkdir()
    try:
        with (part / VECTORS).open("wb") as file:
            _write_header(file, kind, len(rows))
            for block in blocks:
                file.write(block.tobytes())
        known = [] if positions is None or np.isnan(positions).all() else positions.tolist()
        notes = PartRows(
            kind=kind.digest,
            sum=sum_of(part / VECTORS),
            files=[row.file for row in rows],
            sizes=[row.size for row in rows],
            times=[row.time_ns for row in rows],
            boxes=[row.box for row in rows] if any(row.box for row in rows) else [],
            positions=[None if at[0] != at[0] else (at[0], at[1]) for at in known],
        )
        data = json.dumps(msgspec.to_builtins(notes), separators=(",", ":")).encode()
        (part / ROWS).write_bytes(data)
    except OSError:
        delete_part(part)
        raise
    return PartEntry(part.name, len(rows), hashlib.sha256(data).hexdigest())


def vectors_size(kind: DescriptorKind, rows: int) -> int:
    """Return the size in bytes of the vectors.npy of a part with this number of rows."""
    _write_header(header := io.BytesIO(), kind, rows)
    return len(header.getvalue()) + rows * kind.numbers * np.dtype(kind.precision).itemsize


def _write_header(file: BinaryIO, kind: DescriptorKind, rows: int) -> None:
    described = {"descr": np.lib.format.dtype_to_descr(np.dtype(kind.precision)), "fortran_order": False}
    np.lib.format.write_array_header_1_0(file, described | {"shape": (rows, kind.n_parts, kind.embedding)})


def parts_of(folder: Path) -> list[Path]:
    """Return the folders of all parts, whole or not and named by store.json or not, in order of their numbers."""
    with suppress(OSError):
        return sorted(path for path in folder.iterdir() if _PART.fullmatch(path.name) and not path.is_symlink())
    return []


def whole_parts(folder: Path) -> Iterator[tuple[Path, PartRows]]:
    """Yield the folder and the rows of each part of `parts_of` whose rows.json is whole."""
    for part in parts_of(folder):
        try:
            notes = PartRows.read(part)
        except (OSError, ValueError, RecursionError):
            continue
        yield part, notes


def entry_of(part: Path) -> PartEntry:
    """Return the entry of a whole part in store.json."""
    return PartEntry(part.name, len(PartRows.read(part).files), sum_of(part / ROWS))


def encode(descriptors: Float32Array, precision: Precision) -> AnyArray:
    """Convert descriptors (B, n, D) to their representation on disk."""
    if precision == "int8":
        largest = np.abs(descriptors).max(axis=2, keepdims=True)
        directions: AnyArray = np.round(descriptors * (127 / np.maximum(largest, 1e-12))).astype(np.int8)
        return directions
    return descriptors.astype(precision, copy=False)


def to_float32(stored: AnyArray) -> Float32Array:
    """Convert descriptors (B, n, D) from their representation on disk; float32 is not copied."""
    values: Float32Array = stored.astype(np.float32, copy=False)
    if stored.dtype == np.int8:
        norms = np.linalg.norm(values, axis=2, keepdims=True)
        values *= np.float32(stored.shape[1] ** -0.5) / np.maximum(norms, np.float32(1e-12))
    return values


def row_of(file: Path, root: Path | None, box: CropBox | None) -> Row:
    """Return the row of a picture file; PictureError if the file cannot be read."""
    try:
        stat = file.stat()
    except OSError as error:
        raise PictureError(f"The picture {file} cannot be read ({error.strerror or error}); check the path.") from error
    four = None if box is None else (float(box[0]), float(box[1]), float(box[2]), float(box[3]))
    return Row(str(file.relative_to(root) if root else file), stat.st_size, stat.st_mtime_ns, four)


def sum_of(file: Path) -> str:
    """Return the SHA-256 of a file."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def unwritable(folder: Path, error: Exception) -> StoreError:
    """Return the error for a store that cannot be written."""
    why = getattr(error, "strerror", None) or str(error)
    remedy = space_remedy(error) if isinstance(error, OSError) else ""
    return StoreError(f"The store {folder} cannot be written ({why}); {remedy}choose another folder.")


@contextmanager
def readable(file: Path) -> Iterator[None]:
    """Turn an error in reading a file of a store into a StoreError with a sentence for the user."""
    try:
        yield
    except FileNotFoundError as error:
        raise StoreError(f"{file} is missing; {_again(file.parent)}.") from error
    except OSError as error:
        raise unreadable_error(file, error) from error
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{file.name} in {file.parent} is damaged; {_again(file.parent)}.") from error


def _check_sum(file: Path, wanted: str) -> None:
    with readable(file):
        if sum_of(file) != wanted:
            again = _again(file.parent)
            raise StoreError(f"{file.name} in {file.parent} does not match its checksum; delete it, and {again}.")


def _again(folder: Path) -> str:
    """Return the remedy for a damaged file in a store's folder or in a part's folder."""
    folder = folder.parent if _PART.fullmatch(folder.name) else folder
    return f"describe the pictures again, or delete the folder {folder} and make the index again"


def delete_part(part: Path) -> None:
    """Delete a part's files, and its folder if nothing else is in it."""
    for name in (ROWS, VECTORS):
        # Some systems cannot delete files that another process has open.
        with suppress(OSError):
            if not (part / name).is_symlink():
                (part / name).unlink()
    with suppress(OSError):
        part.rmdir()
