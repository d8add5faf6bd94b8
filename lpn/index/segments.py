"""A segment: an immutable folder of tiles, whose vectors, names, and positions are memory-mapped.

    vectors.npy             (N, n D) float32
    positions.npy           (N, 2) float64, NaN for a tile without a position
    names.bin, ends.npy     the names in UTF-8, concatenated, and where each ends, (N,) int64
    keys.npy, rows.npy      64-bit hashes of the names, sorted, (N,) uint64, and the row of each, (N,) int64
    dead-*.npy              (N,) bool: tiles that were replaced; index.json names the valid file

Rows keep the order of insertion.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array, UInt64Array
from lpn.core.errors import StoreError
from lpn.core.files import open_memmap, unreadable_error
from lpn.index.base import DegreeBox, DescriptorKind, covers, overlaps, within

DEAD = re.compile(r"dead-\d{7,}\.npy")
# The files of a segment.
FILES = re.compile(rf"(vectors|positions|ends|keys|rows)\.npy|names\.bin|{DEAD.pattern}")
# Rows copied at once.
_BLOCK = 2048


@dataclass(frozen=True, eq=False)
class TileBatch:
    """Tiles to be written: names, vectors (B, n D) float32, positions (B, 2)."""

    names: list[str]
    vectors: Float32Array
    positions: Float64Array


class Segment:
    """The tiles of one segment.

    Args:
        folder: folder with the files above.
        rows: number of tiles according to the manifest.
        dead: name of the file that marks replaced tiles; None if there are none.

    Attributes:
        identity: identifies the files; another segment later written to this folder has another identity.
        size: number of tiles that were not replaced.
        vectors: of all tiles, (N, n D) float32, for rows here and there.
        in_order: the same vectors, to be read from the first to the last.

    Raises:
        StoreError: when a file is damaged, does not fit the others, or cannot be read.
        FileNotFoundError: when a file is missing, for example because another process replaced the segment.
    """

    def __init__(self, folder: Path, kind: DescriptorKind, rows: int, dead: str | None) -> None:
        self.folder, self.rows, self.dead = folder, rows, dead
        self.identity = identity_of(folder)
        shape = rows, kind.numbers
        self.vectors: Float32Array = self._mapped("vectors", shape, np.float32, at_random=True)
        self.in_order: Float32Array = self._mapped("vectors", shape, np.float32)
        self.positions: Float64Array = self._mapped("positions", (rows, 2), np.float64)
        self._ends: Int64Array = self._mapped("ends", (rows,), np.int64)
        self._keys: UInt64Array = self._mapped("keys", (rows,), np.uint64)
        self._by_key: Int64Array = self._mapped("rows", (rows,), np.int64)
        try:
            self._text = memoryview(np.memmap(folder / "names.bin", np.uint8, "r").data)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise unreadable_error(folder / "names.bin", error) from error
        except ValueError as error:  # the file is empty
            raise self._damaged("names.bin") from error
        if len(self._text) != self._ends[-1]:
            raise self._damaged("names.bin")
        self.alive: BoolArray | None = None
        if dead is not None:
            self.alive = ~self._mapped(dead.removesuffix(".npy"), (rows,), np.bool_)
        self.size = rows if self.alive is None else int(self.alive.sum())

    def chosen(self, box: DegreeBox | None) -> Int64Array | None:
        """Return the rows to be searched, ascending; None for all."""
        if box is not None and not overlaps(self.extent[0], box):
            return np.zeros(0, np.int64)
        if box is None or (self.extent[1] and covers(box, self.extent[0])):
            return None if self.alive is None else np.flatnonzero(self.alive)
        inside = within(self.positions, box)
        return np.flatnonzero(inside if self.alive is None else inside & self.alive)

    def names(self, rows: Int64Array) -> list[str]:
        """Return the names of rows."""
        starts = np.where(rows > 0, self._ends[rows - 1], 0)
        try:
            return [
                str(self._text[a:b], "utf-8") for a, b in zip(starts.tolist(), self._ends[rows].tolist(), strict=True)
            ]
        except UnicodeDecodeError as error:
            raise self._damaged("names.bin") from error

    def find(self, names: Sequence[str], keys: UInt64Array) -> Int64Array:
        """Return the row of each name, -1 if it is missing or was replaced.

        Args:
            keys: hashes of the names, see `keys_of`.
        """
        row_of = np.full(len(names), -1, np.int64)
        first = np.searchsorted(self._keys, keys, "left")
        last = np.searchsorted(self._keys, keys, "right")
        for position in np.flatnonzero(first < last).tolist():
            rows = self._by_key[first[position] : last[position]]
            # Two names can share a key.
            for row, name in zip(rows.tolist(), self.names(rows), strict=True):
                if name == names[position] and (self.alive is None or self.alive[row]):
                    row_of[position] = row
        return row_of

    def batches(self, alive: BoolArray | None) -> Iterator[TileBatch]:
        """Yield the tiles of a mask, in blocks; None for all tiles."""
        for start in range(0, self.rows, _BLOCK):
            rows = np.arange(start, min(start + _BLOCK, self.rows))
            if alive is not None:
                rows = rows[alive[rows]]
            if len(rows):
                yield TileBatch(self.names(rows), self.in_order[rows], self.positions[rows])

    @cached_property
    def extent(self) -> tuple[DegreeBox, bool]:
        """Bounding box of all positions, NaN if there are none, and whether every tile has one."""
        (south, west), (north, east) = (how.reduce(self.positions, axis=0).tolist() for how in (np.fmin, np.fmax))
        return (south, west, north, east), not np.isnan(self.positions).any()

    def _mapped(self, name: str, shape: tuple[int, ...], dtype: npt.DTypeLike, at_random: bool = False) -> AnyArray:
        try:
            mapped = open_memmap(self.folder / f"{name}.npy", at_random)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise unreadable_error(self.folder / f"{name}.npy", error) from error
        except ValueError as error:
            raise self._damaged(f"{name}.npy") from error
        if mapped.shape != shape or mapped.dtype != np.dtype(dtype):
            raise self._damaged(f"{name}.npy")
        return np.asarray(mapped)

    def _damaged(self, name: str) -> StoreError:
        return StoreError(f"{name} in {self.folder} is damaged; delete the index and make it again.")


def identity_of(folder: Path) -> tuple[int, int]:
    """Identify a segment's files; other files later written to the same folder have another identity.

    Raises:
        StoreError: if the files cannot be read.
        FileNotFoundError: if there are no such files.
    """
    try:
        stat = (folder / "vectors.npy").stat()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise unreadable_error(folder / "vectors.npy", error) from error
    return stat.st_ino, stat.st_mtime_ns


def write_segment(folder: Path, kind: DescriptorKind, batches: Iterable[TileBatch], rows: int) -> None:
    """Write tiles into a new folder, which no manifest names yet.

    Args:
        batches: the tiles in order.
        rows: the number of tiles in all batches.
    """
    folder.mkdir()
    lengths: list[int] = []
    keys: list[UInt64Array] = []
    with (
        _Array(folder / "vectors.npy", (rows, kind.numbers), np.float32) as vectors,
        _Array(folder / "positions.npy", (rows, 2), np.float64) as positions,
        (folder / "names.bin").open("wb") as text,
    ):
        for batch in batches:
            vectors.write(batch.vectors)
            positions.write(batch.positions)
            encoded = [name.encode() for name in batch.names]
            text.write(b"".join(encoded))
            lengths += map(len, encoded)
            keys.append(keys_of(batch.names))
    every = np.concatenate(keys)
    order = np.argsort(every, kind="stable")
    np.save(folder / "ends.npy", np.cumsum(lengths, dtype=np.int64))
    np.save(folder / "keys.npy", every[order])
    np.save(folder / "rows.npy", order.astype(np.int64))


def keys_of(names: Sequence[str]) -> UInt64Array:
    """Hash names to 64 bits."""
    digests = b"".join(hashlib.blake2b(name.encode(), digest_size=8).digest() for name in names)
    return np.frombuffer(digests, np.dtype("<u8")).astype(np.uint64)


class _Array(AbstractContextManager["_Array"]):
    """A .npy file written in blocks. A full disk raises OSError here; with a memory-mapped file it would kill the process."""

    def __init__(self, path: Path, shape: tuple[int, ...], dtype: npt.DTypeLike) -> None:
        self._file = path.open("wb")
        self._dtype = np.dtype(dtype)
        write: Callable[..., None] = np.lib.format.write_array_header_1_0
        descr = np.lib.format.dtype_to_descr(self._dtype)
        write(self._file, {"descr": descr, "fortran_order": False, "shape": shape})

    def write(self, rows: AnyArray) -> None:
        self._file.write(np.ascontiguousarray(rows, dtype=self._dtype).data)

    def __exit__(self, *_: object) -> None:
        self._file.close()
