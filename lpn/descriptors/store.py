"""The format of a store of descriptors: a folder that a later step can read, resume, or check.

    descriptors.npy   (N, n, D) float32, float16, or int8, memory-mapped when read. Each part has norm 1/sqrt(n);
                      int8 stores only its direction, scaled so that the largest number is 127
    manifest.json     format, model fingerprint, view, the transform of the pictures, and for each row its file with size,
                      modification time, and crop box

The manifest is written last, so a folder with a manifest is complete. It holds checksums of the array (`lpn.core.checksums`).
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from lpn.core.arrays import AnyArray, BoolArray, Float16Array, Float32Array, Int8Array, IntegerArray
from lpn.core.checksums import Checksums, crc_of_blocks, crc_of_values
from lpn.core.errors import InputError, NewerStoreError, PictureError, StoreError
from lpn.core.files import open_memmap, unreadable_error
from lpn.core.formats import is_newer, newer_version
from lpn.core.views import View
from lpn.descriptors.transforms import Change
from lpn.descriptors.weather import CLEAR, Weather
from lpn.models.base import Model
from lpn.models.contract import Role

FORMAT = "lpn-descriptors/2"
Precision = Literal["float32", "float16", "int8"]
CropBox = tuple[float, float, float, float]
_Count = Annotated[int, Meta(gt=0, lt=2**31)]


@dataclass(frozen=True)
class Row:
    """The file behind one row.

    Attributes:
        file: its path, relative to the described folder.
        size: its size in bytes.
        time_ns: its modification time.
        box: the crop (left, top, right, bottom) in pixels; None for the whole picture.
    """

    file: str
    size: int
    time_ns: int
    box: CropBox | None = None


@dataclass(frozen=True)
class Manifest:
    """The contents of a store.

    Attributes:
        fingerprint: fingerprint of the model; descriptors of different models cannot be compared.
        view: the branch used.
        rotate: degrees counter-clockwise by which the pictures were rotated first.
        n_parts, embedding: n and D.
        rows: the file of each row.
        precision: precision of the numbers on disk.
        shift: pixels of the network's input by which the pictures were shifted right.
        scale: factor by which the pictures were zoomed, their own zoom included.
        down: pixels of the network's input by which the pictures were shifted down; written only if not zero.
        around: the pictures are panoramas, rotated by rolling their columns; written only if true.
        role: of the branch, if branches have roles; written only if there is one.
        released: whether the pictures were read and rotated as in the released test; written only if true.
        weather: the weather drawn on the pictures first; written only if there is one.
        checksums: None before the store is complete.
    """

    fingerprint: str
    view: str
    rotate: float
    n_parts: _Count
    embedding: _Count
    rows: tuple[Row, ...]
    precision: Precision = "float32"
    shift: int = 0
    scale: float = 1.0
    down: int = 0
    around: bool = False
    role: Role | None = None
    released: bool = False
    weather: Weather = CLEAR
    format: str = FORMAT
    checksums: Checksums | None = field(default=None, compare=False)

    @classmethod
    def for_model(
        cls, model: Model, view: View, change: Change, rows: tuple[Row, ...], precision: Precision = "float32"
    ) -> Manifest:
        """Return the manifest of files that a model describes."""
        transform = (change.shift, change.scale * change.zoom, change.down, change.around)
        n, embedding = model.n_parts, model.embedding
        role = model.role(view) if model.contract.roles == "role" else None
        further = (role, change.released, change.weather)
        return cls(model.fingerprint, view, change.rotate, n, embedding, rows, precision, *transform, *further)

    @property
    def change(self) -> Change:
        """The transform of the pictures."""
        moves = (self.rotate, self.shift, self.scale, self.down, self.around)
        return Change(*moves, released=self.released, weather=self.weather)

    @property
    def cropped(self) -> bool:
        """True if any picture was cropped to a box."""
        return any(row.box is not None for row in self.rows)

    def to_json(self) -> bytes:
        """Return the manifest as the contents of its file."""
        values = self._values()
        if self.checksums is not None:
            values["checksums"] = asdict(self.checksums)
        return json.dumps(values, separators=(",", ":")).encode()

    def with_checksums(self, array: Path) -> Manifest:
        """Return the manifest with checksums of the array's file and of itself."""
        return replace(self, checksums=Checksums.compute(array, self._values()))

    @property
    def damaged(self) -> bool:
        """True if the manifest differs from its own checksum."""
        return self.checksums is not None and self.checksums.manifest != crc_of_values(self._values())

    def _values(self) -> dict[str, Any]:
        values = asdict(self)
        del values["checksums"]
        for optional in ("down", "around", "role", "released", "weather"):
            if not getattr(self, optional):
                del values[optional]
        for row in values["rows"]:
            if row["box"] is None:
                del row["box"]
        return values

    @classmethod
    def from_json(cls, data: bytes, name: str) -> Manifest:
        """Read the output of `to_json`; messages name the file `name`.

        Raises:
            NewerStoreError: if a later version wrote it.
            StoreError: if it is invalid.
        """
        try:
            # Names of files may be no UTF-8; msgspec's decoder refuses the lone surrogates that Python writes for them.
            values: Any = json.loads(data)
            stated = values.get("format") if isinstance(values, dict) else None
            if is_newer(stated, FORMAT):
                raise NewerStoreError(newer_version(name, str(stated), FORMAT))
            if stated != FORMAT:
                raise ValueError("another format")
            if not values.keys() <= {entry.name for entry in fields(cls)}:  # for example a transform of a later lpn
                raise ValueError("unknown entries")
            manifest = msgspec.convert(values, cls)
            _ = manifest.change  # checks its numbers
            return manifest
        except (msgspec.MsgspecError, ValueError, OverflowError, RecursionError, InputError) as error:
            raise StoreError(
                f"{name} is not a manifest of descriptors ({FORMAT}); describe the pictures again."
            ) from error

    def comparable(self, other: Manifest) -> bool:
        """Return whether rows of the same file can be copied from another store."""
        return self._kind == other._kind

    @property
    def _kind(self) -> tuple[str, str, Change, str]:
        return self.fingerprint, self.view, self.change, self.precision


@dataclass(frozen=True, eq=False)
class Store:
    """A complete store.

    Attributes:
        manifest: its contents.
        descriptors: (N, n, D) in the manifest's precision, memory-mapped, read-only.
        identity: a digest of the manifest and of the array's size and time.
        file: the array's file.
    """

    manifest: Manifest
    descriptors: Float32Array | Float16Array | Int8Array
    identity: str = ""
    file: Path | None = None

    def damaged(self) -> BoolArray:
        """Return the mask of rows in blocks that differ from their checksums, (N,); reads the whole array."""
        damaged = np.zeros(len(self.descriptors), np.bool_)
        checksums = self.manifest.checksums
        if checksums is None or self.file is None:
            return damaged
        if -(-self.file.stat().st_size // checksums.block) != len(checksums.blocks):
            return ~damaged
        blocks = crc_of_blocks(self.file, checksums.block)
        row = self.descriptors.dtype.itemsize * self.manifest.n_parts * self.manifest.embedding
        header = self.file.stat().st_size - row * len(damaged)
        for i in (i for i, (now, then) in enumerate(zip(blocks, checksums.blocks, strict=True)) if now != then):
            start, end = i * checksums.block - header, (i + 1) * checksums.block - header
            damaged[max(start // row, 0) : max(-(-end // row), 0)] = True
            if start < 0:
                damaged[:] = True  # the array's shape may be wrong
        return damaged

    @property
    def float32(self) -> Float32Array:
        """The descriptors (N, n, D) in float32: memory-mapped if stored so, else a copy."""
        return self.rows(slice(None))

    def rows(self, rows: slice | IntegerArray) -> Float32Array:
        """Return some rows in float32 without reading the others."""
        values = self.descriptors[rows].astype(np.float32, copy=False)
        if self.manifest.precision == "int8":
            norms = np.linalg.norm(values, axis=2, keepdims=True)
            values *= np.float32(self.manifest.n_parts**-0.5) / np.maximum(norms, np.float32(1e-12))
        return values


def open_store(folder: str | Path) -> Store:
    """Open a store; StoreError if the folder is not a complete store, or its files do not match."""
    folder = Path(folder)
    if not (folder / "manifest.json").is_file():
        unfinished = (
            " (its description was not finished; run lpn describe again)"
            if (folder / "descriptors.log").is_file()
            else ""
        )
        raise StoreError(f"{folder} has no manifest.json, so it is not a store of descriptors{unfinished}.")
    written = (folder / "manifest.json").read_bytes()
    return open_array(folder, Manifest.from_json(written, "manifest.json"), written)


def open_array(folder: Path, manifest: Manifest, written: bytes) -> Store:
    """Open the array of a manifest; `written` is the manifest's file contents.

    Raises:
        StoreError: if the array does not fit the manifest.
    """
    expected = (len(manifest.rows), manifest.n_parts, manifest.embedding)
    file = folder / "descriptors.npy"
    try:
        stat = file.stat()
        descriptors = open_memmap(file)
    except (FileNotFoundError, ValueError) as error:
        raise StoreError(f"descriptors.npy in {folder} is missing or damaged; describe the pictures again.") from error
    except OSError as error:
        raise unreadable_error(file, error) from error
    if descriptors.shape != expected or descriptors.dtype != np.dtype(manifest.precision):
        raise StoreError(
            f"descriptors.npy in {folder} is {descriptors.dtype} {descriptors.shape}, but its manifest says "
            f"{manifest.precision} {expected}; describe the pictures again."
        )
    identity = hashlib.sha256(written + f"{stat.st_size} {stat.st_mtime_ns}".encode()).hexdigest()
    return Store(manifest, descriptors, identity, file)


def encode(descriptors: Float32Array, precision: Precision) -> AnyArray:
    """Convert descriptors (B, n, D) to their representation on disk."""
    if precision == "int8":
        largest = np.abs(descriptors).max(axis=2, keepdims=True)
        directions: Int8Array = np.round(descriptors * (127 / np.maximum(largest, 1e-12))).astype(np.int8)
        return directions
    return descriptors.astype(precision, copy=False)


def row_of(file: Path, root: Path | None, box: CropBox | None) -> Row:
    """Return the row of a picture file; PictureError if the file cannot be read."""
    try:
        stat = file.stat()
    except OSError as error:
        raise PictureError(f"The picture {file} cannot be read ({error.strerror or error}); check the path.") from error
    return Row(str(file.relative_to(root) if root else file), stat.st_size, stat.st_mtime_ns, float_box(box))


def float_box(values: Any) -> CropBox | None:
    """Convert a box to four floats, as JSON returns them."""
    if values is None:
        return None
    left, top, right, bottom = (float(value) for value in values)
    return left, top, right, bottom
