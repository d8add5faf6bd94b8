"""What a store of descriptors is: a folder that a later step can read, resume, or check.

    descriptors.npy   (N, n, D) float32, float16, or int8, memory-mapped when read; each part has norm 1/sqrt(n), and in int8
                      the direction alone, its largest number brought to 127
    manifest.json     format, model fingerprint, view, what was done to the pictures, and for each row its file with size and
                      time, and the box it was cropped to where it was

The manifest is written last, so a folder with a manifest is complete. It has checksums of the array, see `lpn.core.checksums`; those
of earlier versions have none.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from lpn.core.arrays import AnyArray, BoolArray, Float16Array, Float32Array, Int8Array, IntegerArray
from lpn.core.checksums import Checksums, crc_of_blocks, crc_of_values
from lpn.core.errors import InputError, NewerStoreError, PictureError, StoreError
from lpn.core.files import open_memmap, unreadable_error
from lpn.core.formats import is_newer, newer_version
from lpn.core.views import View
from lpn.descriptors.transforms import Change
from lpn.models.base import Model

FORMAT = "lpn-descriptors/2"
BEFORE = "lpn-descriptors/1"
"""Knew of no shift, scale, or boxes; what it says is true of such stores still."""
Precision = Literal["float32", "float16", "int8"]
Box = tuple[float, float, float, float]


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
        checksums: None in stores of earlier versions, and before the store is complete.
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
    checksums: Checksums | None = field(default=None, compare=False)

    @classmethod
    def for_model(
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
        values = self._values()
        if self.checksums is not None:
            values["checksums"] = asdict(self.checksums)
        return json.dumps(values, indent=1).encode()

    def checked(self, array: Path) -> Manifest:
        """The same with the checksums of the array's file, and of itself."""
        return replace(self, checksums=Checksums.compute(array, self._values()))

    @property
    def damaged(self) -> bool:
        """Whether it differs from what its checksum was made of."""
        return self.checksums is not None and self.checksums.manifest != crc_of_values(self._values())

    def _values(self) -> dict[str, Any]:
        values = asdict(self)
        del values["checksums"]
        for late in ("down", "around"):
            if not values[late]:
                del values[late]
        for row in values["rows"]:
            if row["box"] is None:
                del row["box"]
        return values

    @classmethod
    def from_json(cls, data: bytes, name: str) -> Manifest:
        """Read what `to_json` wrote; StoreError when it is something else, NewerStoreError when a later version wrote it."""
        try:
            values: Any = json.loads(data)
            found = values.pop("format")
            if is_newer(found, FORMAT):
                raise NewerStoreError(newer_version(name, found, FORMAT))
            if found not in (FORMAT, BEFORE):
                raise ValueError("another format")
            rows = tuple(
                Row(str(r["file"]), int(r["size"]), int(r["time_ns"]), box_of(r.get("box"))) for r in values.pop("rows")
            )
            if values.get("precision", "float32") not in get_args(Precision):
                raise ValueError("another precision")
            told = values.pop("checksums", None)
            read = cls(rows=rows, **values, checksums=None if told is None else Checksums.from_json(told))
            read._check()
            return read
        except (ValueError, OverflowError, KeyError, TypeError, AttributeError, RecursionError, InputError) as error:
            raise StoreError(
                f"{name} is not a manifest of descriptors ({FORMAT}); describe the pictures again."
            ) from error

    def _check(self) -> None:
        _ = self.change  # checks its numbers
        whole = all(type(number) is int and 0 < number < 2**31 for number in (self.n_parts, self.embedding))
        if not whole or not isinstance(self.fingerprint, str) or not isinstance(self.view, str):
            raise ValueError("values of another kind")

    def comparable(self, other: Manifest) -> bool:
        """Whether rows of the same file may be taken over from another store."""
        return self._kind == other._kind

    @property
    def _kind(self) -> tuple[str, str, Change, str]:
        return self.fingerprint, self.view, self.change, self.precision


@dataclass(frozen=True, eq=False)
class Store:
    """A complete store. `descriptors` is (N, n, D) in the manifest's precision, memory-mapped, read-only.

    `identity` is a text that no other store has: of the manifest's contents, and of the array's size and time. `file` is the
    array's.
    """

    manifest: Manifest
    descriptors: Float32Array | Float16Array | Int8Array
    identity: str = ""
    file: Path | None = None

    def damaged(self) -> BoolArray:
        """Which rows lie in blocks that differ from what their checksums were made of, (N,) bool; reads the whole array.

        None where the store has no checksums.
        """
        found = np.zeros(len(self.descriptors), np.bool_)
        told = self.manifest.checksums
        if told is None or self.file is None:
            return found
        if -(-self.file.stat().st_size // told.block) != len(told.blocks):
            return ~found
        blocks = crc_of_blocks(self.file, told.block)
        row = self.descriptors.dtype.itemsize * self.manifest.n_parts * self.manifest.embedding
        before = self.file.stat().st_size - row * len(found)
        for i in (i for i, (now, then) in enumerate(zip(blocks, told.blocks, strict=True)) if now != then):
            start, end = i * told.block - before, (i + 1) * told.block - before
            found[max(start // row, 0) : max(-(-end // row), 0)] = True
            if start < 0:
                found[:] = True  # its shape and order may be wrong
        return found

    @property
    def float32(self) -> Float32Array:
        """The descriptors (N, n, D) in float32: memory-mapped where they are stored so, else a copy."""
        return self.rows(slice(None))

    def rows(self, rows: slice | IntegerArray) -> Float32Array:
        """Some of them in float32, without reading the others."""
        values = self.descriptors[rows].astype(np.float32, copy=False)
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
    return with_array(folder, Manifest.from_json(written, "manifest.json"), written)


def with_array(folder: Path, manifest: Manifest, written: bytes) -> Store:
    """The store of a manifest and of the bytes it was read from; StoreError when its array does not fit."""
    expected = (len(manifest.rows), manifest.n_parts, manifest.embedding)
    try:
        stat = (folder / "descriptors.npy").stat()
        descriptors = open_memmap(folder / "descriptors.npy")
    except (FileNotFoundError, ValueError) as error:
        raise StoreError(f"descriptors.npy in {folder} is missing or damaged; describe the pictures again.") from error
    except OSError as error:
        raise unreadable_error(folder / "descriptors.npy", error) from error
    if descriptors.shape != expected or descriptors.dtype != np.dtype(manifest.precision):
        raise StoreError(
            f"descriptors.npy in {folder} is {descriptors.dtype} {descriptors.shape}, but its manifest says "
            f"{manifest.precision} {expected}; describe the pictures again."
        )
    told = f"{stat.st_size} {stat.st_mtime_ns}".encode()
    return Store(manifest, descriptors, hashlib.sha256(written + told).hexdigest(), folder / "descriptors.npy")


def stored(descriptors: Float32Array, precision: Precision) -> AnyArray:
    """Descriptors as they are kept on disk, see the top of this module."""
    if precision == "int8":
        largest = np.abs(descriptors).max(axis=2, keepdims=True)
        directions: Int8Array = np.round(descriptors * (127 / np.maximum(largest, 1e-12))).astype(np.int8)
        return directions
    return descriptors.astype(precision, copy=False)


def row_of(file: Path, root: Path | None, box: Box | None) -> Row:
    try:
        stat = file.stat()
    except OSError as error:
        raise PictureError(f"The picture {file} cannot be read ({error.strerror or error}); check the path.") from error
    return Row(str(file.relative_to(root) if root else file), stat.st_size, stat.st_mtime_ns, box_of(box))


def box_of(values: Any) -> Box | None:
    """A box as it is compared: four floats, as JSON gives them back."""
    if values is None:
        return None
    left, top, right, bottom = (float(value) for value in values)
    return left, top, right, bottom
