"""The index of a store's folder, which compares every tile (`lpn.descriptors.store` has the format).

A float32 product finds the tiles that can be among the k best, and these are scored in float64. Ties keep the order of insertion.
An inner product v . g of m numbers in float32, in any order after v is rounded, has an error up to M u / (1 - M u) |v| |g| with
M = m + 2 and u = 2^-24.

Any number of processes may search while one adds, and see the new tiles at their next search. Adds take turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Self

import msgspec
import numpy as np

from lpn.core.arrays import AnyArray, Float32Array, Float64Array, Int64Array
from lpn.core.errors import InputError, OutputError, StoreError
from lpn.core.files import exclusive_lock, printable, unreadable_error
from lpn.descriptors.store import (
    MANIFEST,
    DescriptorKind,
    Manifest,
    PartEntry,
    Row,
    Store,
    delete_part,
    open_store,
    to_float32,
    unwritable,
    write_part,
)
from lpn.index.base import LONGEST, DegreeBox, Index, TileRow, Tiles, within

_ATTEMPTS = 20
# Rows of a part that are read at a time.
_STEP = 4096
# Up to 1 / _FEW of a part's rows are read one by one; for more, all of its rows are read.
_FEW = 4
_UNIT = 2.0**-24
# Exceeds the rounding of a score in float64, for a query whose numbers are at most 1.
_ROUNDING = 1e-12


class FolderIndex(Index):
    """The index of a folder, which any number of processes may open.

    Raises:
        StoreError: when the folder is not an index, is of another engine, or is damaged.
    """

    engine = "exact"

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self._store: Store | None = None
        store = self._current()
        self.kind = store.kind
        if store.manifest.engine != self.engine:
            raise StoreError(
                f"{self.folder} is an index of the engine {store.manifest.engine}; open it with that engine, not with "
                f"{self.engine}."
            )

    @classmethod
    def create(cls, folder: str | Path, kind: DescriptorKind) -> Self:
        """Make an empty index, or open an existing one of the same kind.

        Raises:
            StoreError: when the folder holds other descriptors, or cannot be written.
        """
        folder, wanted = Path(folder), Manifest(kind=kind, engine=cls.engine)
        try:
            if folder.exists() and not folder.is_dir():
                raise StoreError(f"{folder} is a file; choose another place for the index.")
            folder.mkdir(parents=True, exist_ok=True)
            if not (folder / MANIFEST).exists():  # a whole index may lie in a folder that cannot be written
                with exclusive_lock(folder, wait=True):
                    if not (folder / MANIFEST).exists():
                        # A process that was killed before it wrote store.json leaves at most its temporary file.
                        if others := [one.name for one in folder.iterdir() if not one.name.startswith(f"{MANIFEST}.")]:
                            raise StoreError(
                                f"{folder} holds other files, such as {printable(min(others))}, and no {MANIFEST}; choose "
                                "another folder for the index."
                            )
                        wanted.write(folder)
        except (OSError, OutputError) as error:
            raise unwritable(folder, error) from error
        held = Manifest.read(folder)
        if (held.kind, held.engine) != (kind, cls.engine):
            raise StoreError(
                f"{folder} holds {held.kind}, searched by the engine {held.engine}, and this would be {kind}, searched by "
                f"{cls.engine}; choose another folder, or delete the old index."
            )
        return cls(folder)

    def tiles(self) -> Tiles:
        """See `Index.tiles`; the descriptors of a single part stay on disk."""
        store = self._current()
        return store.names, store.float32, store.positions

    def count(self) -> int:
        """See `Index.count`."""
        return len(self._current())

    def close(self) -> None:
        """See `Index.close`."""
        self._store = None

    def _add(self, names: list[str], vectors: Float32Array, places: Float64Array) -> None:
        """Add tiles; atomic, even if the process is killed."""
        try:
            with exclusive_lock(self.folder, wait=True):
                store = self._current()
                kept = _replaced(store, names)
                entry = write_part(self.folder, self.kind, list(map(Row, names)), [vectors], places)
                changed = msgspec.structs.replace(store.manifest, parts=(*kept, entry))
                try:
                    changed = self._with_codes(changed)
                except Exception:
                    delete_part(self.folder / entry.name)
                    raise
                changed.write(self.folder)
        except (OSError, OutputError) as error:
            raise unwritable(self.folder, error) from error

    def _with_codes(self, manifest: Manifest) -> Manifest:
        """Return the manifest after an add, with the engine's file if this method writes one."""
        return manifest

    def _nearest(self, wanted: Float64Array, k: int, box: DegreeBox | None) -> Tiles:
        """See `Index._nearest`; ties keep the order of insertion."""
        # A power of two changes no digit, and keeps the query within the range of float32.
        scaled = np.ldexp(wanted, -int(np.frexp(np.abs(wanted).max())[1]))
        while True:
            store = self._current()
            try:
                return _tiles_at(store, np.sort(self._candidates(store, scaled, k, box)))
            except StoreError:
                if self._read_stamp() == store.stamp:
                    raise  # otherwise another process has replaced a file meanwhile

    def _candidates(self, store: Store, wanted: Float64Array, k: int, box: DegreeBox | None) -> Int64Array:
        """Return the places of all tiles that can be among the k best."""
        places, scores = scored(store, range(len(store.parts)), wanted, box)
        if len(scores) <= k:
            return places
        least = float(np.partition(scores, len(scores) - k)[len(scores) - k]) - 2 * rounding_bound(wanted)
        near: Int64Array = places[scores >= np.nextafter(np.float32(least), np.float32(-np.inf))]
        return near

    def _rows(self, names: Sequence[str], vectors: bool = True) -> dict[str, TileRow]:
        store = self._current()
        places = store.find(names)
        there = [name for name, place in zip(names, places.tolist(), strict=True) if place >= 0]
        if not vectors:
            return dict.fromkeys(there, (None, None))
        _, found, positions = _tiles_at(store, places[places >= 0])
        return dict(zip(there, zip(found, positions, strict=True), strict=True))

    def _current(self) -> Store:
        """Return the newest version of the store, whichever process wrote it; parts that are open are used again."""
        for attempt in range(_ATTEMPTS):
            stamp = self._read_stamp()
            if self._store is not None and stamp == self._store.stamp:
                break
            before = self._store
            try:
                self._store = open_store(
                    self.folder, {} if before is None else {p.folder.name: p for p in before.parts}
                )
                self._store.stamp = stamp
                if before is not None:
                    self._store.take_names(before)
            except StoreError:
                # Another process may have removed a part since store.json was read.
                if attempt + 1 == _ATTEMPTS or self._read_stamp() == stamp:
                    raise
        assert self._store is not None
        return self._store

    def _read_stamp(self) -> tuple[int, ...]:
        """Identify the version of store.json; empty if there is none."""
        try:
            stat = (self.folder / MANIFEST).stat()
        except (FileNotFoundError, NotADirectoryError):
            return ()
        except OSError as error:
            raise unreadable_error(self.folder / MANIFEST, error) from error
        return stat.st_ino, stat.st_mtime_ns, stat.st_size


def check_role(kind: DescriptorKind, where: object) -> None:
    """Raise InputError for the descriptors of queries."""
    if kind.role == "query":
        raise InputError(
            f"{where} is described by the model's branch for queries, and an index holds a gallery; describe the pictures "
            "again with --role gallery, into another folder."
        )


def scored(
    store: Store, numbers: Sequence[int], wanted: Float64Array, box: DegreeBox | None
) -> tuple[Int64Array, Float32Array]:
    """Score rows of some parts in float32 under a rescaled query (n D,).

    Returns:
        The places of the rows among all rows, (C,), and their scores, (C,).
    """
    query = wanted.astype(np.float32)
    places, scores = [np.zeros(0, np.int64)], [np.zeros(0, np.float32)]
    for number in numbers:
        vectors, rows = store.parts[number].vectors, chosen_rows(store, number, box)
        if rows is None:
            found, rows = _products(vectors, query), np.arange(len(vectors))
        elif len(rows) * _FEW <= len(vectors):
            found = _flat(vectors[rows]) @ query
        else:
            found = _products(vectors, query)[rows]
        store.check_finite(found)
        places.append(store.starts[number] + rows)
        scores.append(found)
    return np.concatenate(places), np.concatenate(scores)


def chosen_rows(store: Store, number: int, box: DegreeBox | None) -> Int64Array | None:
    """Return the searched rows of a part, ascending; None for all."""
    kept = store.kept[number]
    if box is None:
        return kept
    inside = within(store.parts[number].positions, box)
    return np.flatnonzero(inside) if kept is None else kept[inside[kept]]


def rounding_bound(wanted: Float64Array) -> float:
    """Bound the error of float32 scores of any tiles.

    Args:
        wanted: a rescaled query whose numbers are at most 1, (n D,).
    """
    share = (len(wanted) + 2) * _UNIT
    return 1.001 * share / (1 - share) * float(np.linalg.norm(wanted)) * LONGEST + _ROUNDING


def _flat(vectors: AnyArray) -> Float32Array:
    values = to_float32(vectors)
    return values.reshape(len(values), values.shape[1] * values.shape[2])


def _products(vectors: AnyArray, query: Float32Array) -> Float32Array:
    """Return the inner products of all rows, (B,); other precisions than float32 are converted block by block."""
    if vectors.dtype == np.float32:
        return _flat(vectors) @ query
    return np.concatenate([_flat(vectors[i : i + _STEP]) @ query for i in range(0, len(vectors), _STEP)])


def _tiles_at(store: Store, places: Int64Array) -> Tiles:
    """Return the tiles at places among all rows."""
    vectors = np.empty((len(places), store.kind.n_parts, store.kind.embedding), np.float32)
    positions, names = np.empty((len(places), 2)), [""] * len(places)
    for number, mine in store.by_part(places):
        part, rows = store.parts[number], places[mine] - store.starts[number]
        vectors[mine], positions[mine] = to_float32(part.vectors[rows]), part.positions[rows]
        for i, row in zip(mine.tolist(), rows.tolist(), strict=True):
            names[i] = part.notes.files[row]
    return names, vectors, positions


def _replaced(store: Store, names: list[str]) -> list[PartEntry]:
    """Return the entries of parts after tiles of these names are replaced, without those that keep no row."""
    places = store.find(names)
    places = places[places >= 0]
    entries = list(store.manifest.parts)
    for number, mine in store.by_part(places):
        gone = {*entries[number].replaced, *(places[mine] - store.starts[number]).tolist()}
        entries[number] = msgspec.structs.replace(entries[number], replaced=tuple(sorted(gone)))
    covered = () if store.manifest.codes is None else store.manifest.codes.parts
    return [entry for entry in entries if len(entry.replaced) < entry.rows or entry.name in covered]
