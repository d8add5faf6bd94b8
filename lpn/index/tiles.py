"""The tiles that an index is made of: those of a store of descriptors, or of shards; with positions where they are known."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lpn import descriptors
from lpn.core.arrays import Float32Array, Float64Array, Int64Array
from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.datasets import geo
from lpn.index.base import Kind, check_names

_LOT_BYTES = 64 << 20
"""Of descriptors added at once: what a killed run does over again."""
_PLAN = "plan.json"
"""As `lpn.cluster.shards` calls it, which is imported only for shards: it needs an extra."""


@dataclass(frozen=True)
class TileChunk:
    """Tiles that are best read and added together.

    Attributes:
        names: of its tiles, each a name that an index takes.
        positions: latitude and longitude in degrees, (B, 2) float64, NaN where a tile has none; None where none has.
        rows: gives the descriptors (C, n, D) float32 of some of them, by their ascending numbers within the lot, (C,).
    """

    names: list[str]
    positions: Float64Array | None
    rows: Callable[[Int64Array], Float32Array]


@dataclass(frozen=True)
class TileSource:
    """Tiles to be put into an index. Those of shards are read lot by lot, and only one lot is kept.

    Attributes:
        kind: of their descriptors.
        count: how many there are.
        lots: all of them in order, each tile in one lot; StoreError where a shard is damaged or was written anew meanwhile.
        broken: how many pictures could not be described, and so are not among them.
    """

    kind: Kind
    count: int
    lots: Iterator[TileChunk]
    broken: int = 0


def open_tiles(where: str, data: Path | None = None) -> TileSource:
    """Open what was described.

    Args:
        where: folder of a store, or folder or address of shards.
        data: folder whose geo.csv gives the positions, in place of those that shards have; see `lpn.datasets.geo.match` for its paths.

    Raises:
        StoreError: when there is neither a complete store nor complete shards.
        DataError: when `data` has no geo.csv, or it cannot be read.
        InputError: when an index cannot hold these tiles, or `data` has none of them, or has them in two places.
    """
    folder = Path(where)
    is_shards = "://" in where or ((folder / _PLAN).is_file() and not (folder / "manifest.json").is_file())
    return _of_shards(where, data) if is_shards else _of_store(folder, data)


def _of_store(folder: Path, data: Path | None) -> TileSource:
    store = descriptors.open_store(folder)
    manifest = store.manifest
    if manifest.cropped:
        raise InputError(f"{folder} holds cropped pictures, of which several can share a file; index whole ones.")
    names = [Path(row.file).as_posix() for row in manifest.rows]
    check_names(names, len(names))
    kind = Kind(manifest.fingerprint, manifest.n_parts, manifest.embedding)
    positions = None if data is None else _positions(data, names)
    step = _step(kind)

    def lot(start: int) -> TileChunk:
        some = slice(start, start + step)
        return TileChunk(names[some], None if positions is None else positions[some], lambda at: store.rows(start + at))

    return TileSource(kind, len(names), map(lot, range(0, len(names), step)))


def _of_shards(where: str, data: Path | None) -> TileSource:
    from lpn.cluster.gather import open_shards
    from lpn.cluster.shards import each

    shards = open_shards(where)
    kind = Kind(shards.plan.fingerprint, shards.plan.n_parts, shards.plan.embedding)

    def checked(partition: int) -> list[str]:
        # A partition is told by a name alone: none is in two of them.
        names = shards.tiles(partition).names
        return check_names(names, len(names))

    partitions = range(shards.plan.partitions)
    positions: Float64Array | None = None
    if data is None:
        seen = list(each(lambda partition: _told(checked(partition)), partitions))
    else:
        # The paths of a file of positions are matched with all names, so these must be known together.
        parts = list(each(checked, partitions))
        seen = [_told(names) for names in parts]
        positions = _positions(data, [name for names in parts for name in names])
    starts = np.cumsum([0, *(count for count, _ in seen)])

    def lot(group: range) -> TileChunk:
        tiles = list(each(shards.tiles, group))
        for partition, part in zip(group, tiles, strict=True):
            # Its digest is of pictures that it settles, of which others may be broken by now.
            if _told(part.names) != seen[partition]:
                raise shards.written_anew(partition)
        names = [name for part in tiles for name in part.names]
        first = starts[group.start]
        own = np.concatenate([part.positions for part in tiles])
        places = own if positions is None else positions[first : first + len(names)]

        def rows(at: Int64Array) -> Float32Array:
            owners = np.searchsorted(starts, first + at, "right") - 1
            read = [
                shards.descriptors(int(p), tiles[p - group.start].names)[(first + at)[owners == p] - starts[p]]
                for p in np.unique(owners)
            ]
            return np.concatenate(read)

        return TileChunk(names, places, rows)

    groups: list[range] = []
    for partition in partitions:
        start = partition
        if groups and starts[partition + 1] - starts[groups[-1].start] <= _step(kind):
            start = groups.pop().start
        groups.append(range(start, partition + 1))
    return TileSource(kind, int(starts[-1]), map(lot, groups), len(shards.broken))


def _told(names: list[str]) -> tuple[int, int]:
    """What tells the tiles of a shard from others, in little memory."""
    return len(names), hash(tuple(names))


def _step(kind: Kind) -> int:
    return max(1, _LOT_BYTES // (4 * kind.numbers))


def _positions(root: Path, names: list[str]) -> Float64Array:
    known = geo.positions(root)
    if known is None:
        raise DataError(f"{root} has no {geo.NAME}; leave --data out, or write one (docs/data.md).")
    places = known.match(names)
    if names and not any(places):
        raise InputError(
            f"{geo.NAME} in {root} has no position for any of the {len(names)} tiles, the first being {printable(names[0])}; "
            "give the data set that was described."
        )
    nowhere = (np.nan, np.nan)
    return np.array([nowhere if at is None else (at.latitude, at.longitude) for at in places], np.float64).reshape(
        -1, 2
    )
