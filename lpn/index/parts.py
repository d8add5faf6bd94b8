"""A part of an index: an immutable folder of tiles, whose vectors and positions are memory-mapped.

vectors.npy      (B, n D) float32
positions.npy    (B, 2) float64, NaN for a tile without a position
names.json       the names, in the order of the rows
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt

from lpn.core.arrays import AnyArray, Float32Array, Float64Array, Int64Array
from lpn.core.errors import StoreError
from lpn.core.files import open_memmap, unreadable_error
from lpn.index.base import DescriptorKind

FILES = ("vectors.npy", "positions.npy", "names.json")


class Part:
    """The tiles of one part.

    Args:
        folder: folder with the files above.
        rows: number of tiles by the manifest.

    Attributes:
        identity: of the files; it changes if other files are written into this folder.
        vectors: (B, n D) float32.
        positions: (B, 2) float64.

    Raises:
        StoreError: when a file is missing, is damaged, does not fit the others, or cannot be read.
    """

    def __init__(self, folder: Path, kind: DescriptorKind, rows: int) -> None:
        self.folder, self.rows = folder, rows
        self.identity = identity_of(folder)
        self.vectors: Float32Array = self._mapped(FILES[0], (rows, kind.numbers), np.float32)
        self.positions: Float64Array = self._mapped(FILES[1], (rows, 2), np.float64)

    @cached_property
    def names(self) -> list[str]:
        """The name of each tile."""
        with readable(self.folder / FILES[2]):
            names = msgspec.json.decode((self.folder / FILES[2]).read_bytes(), type=list[str])
            if len(names) != self.rows:
                raise ValueError("another number of names")
            return names

    @cached_property
    def row_of(self) -> dict[str, int]:
        """The row of each name."""
        return {name: row for row, name in enumerate(self.names)}

    def find(self, names: Sequence[str]) -> Int64Array:
        """Return the row of each name, -1 for a name of another part."""
        return np.array([self.row_of.get(name, -1) for name in names], np.int64)

    def _mapped(self, name: str, shape: tuple[int, ...], dtype: npt.DTypeLike) -> AnyArray:
        with readable(self.folder / name):
            mapped = open_memmap(self.folder / name)
            if mapped.shape != shape or mapped.dtype != np.dtype(dtype):
                raise ValueError("another shape")
            return np.asarray(mapped)


@contextmanager
def readable(file: Path) -> Iterator[None]:
    """Turn errors of reading an index's file into sentences."""
    try:
        yield
    except FileNotFoundError as error:
        raise StoreError(f"{file} is missing; delete the index and make it again.") from error
    except OSError as error:
        raise unreadable_error(file, error) from error
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{file.name} in {file.parent} is damaged; delete the index and make it again.") from error


def identity_of(folder: Path) -> tuple[int, int]:
    """Identify a part's files; StoreError if there are none, or they cannot be read."""
    with readable(folder / FILES[0]):
        stat = (folder / FILES[0]).stat()
    return stat.st_ino, stat.st_mtime_ns


def write_part(folder: Path, names: list[str], vectors: Float32Array, positions: Float64Array) -> dict[str, str]:
    """Write tiles into a new folder, and return the SHA-256 of each file by its name."""
    folder.mkdir()
    np.save(folder / FILES[0], vectors)
    np.save(folder / FILES[1], positions)
    (folder / FILES[2]).write_bytes(msgspec.json.encode(names))
    return {name: sum_of(folder / name) for name in FILES}


def sum_of(file: Path) -> str:
    """Return the SHA-256 of a file."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
