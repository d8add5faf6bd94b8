"""Read the tiles to be indexed, with their positions if known, from a store of descriptors or from shards."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lpn import descriptors
from lpn.core.arrays import Float32Array, Float64Array, Int64Array
from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.datasets import geo, open_dataset
from lpn.flight.maps.named_window import NamedWindow
from lpn.index.base import DescriptorKind, check_names
from lpn.models.contract import Role

# Size of the descriptors that are added at once, in bytes; a killed run repeats at most this much.
_CHUNK_BYTES = 64 << 20
# The name in `lpn.cluster.shards`, which needs an extra and is imported for shards only.
_PLAN = "plan.json"


@dataclass(frozen=True)
class TileChunk:
    """Tiles that are read and added together.

    Attributes:
        names: names of the tiles.
        positions: latitude and longitude in degrees, (B, 2) float64, NaN for a tile without a position; None for no positions.
        rows: reads the descriptors (C, n, D) float32 of rows of the chunk, given in ascending order, (C,).
    """

    names: list[str]
    positions: Float64Array | None
    rows: Callable[[Int64Array], Float32Array]


@dataclass(frozen=True)
class TileSource:
    """Tiles to be added to an index; only one chunk of shards is in memory at a time.

    Attributes:
        kind: kind of the descriptors.
        count: number of tiles.
        chunks: all tiles in order, in chunks; raises StoreError if a shard is damaged or was rewritten meanwhile.
        broken: number of pictures that could not be described and are left out.
    """

    kind: DescriptorKind
    count: int
    chunks: Iterator[TileChunk]
    broken: int = 0


def open_tiles(where: str, data: Path | None = None) -> TileSource:
    """Open a store or shards of descriptors. Windows of a map have the positions in their names.

    Args:
        where: folder of a store, or folder or address of shards.
        data: folder whose geo.csv replaces the positions of shards, by `lpn.datasets.geo.Positions.match`. Without one, it is a
            data set that tells positions otherwise.

    Raises:
        StoreError: when there is neither a complete store nor complete shards.
        DataError: when `data` tells no positions, or they cannot be read.
        InputError: if an index cannot hold these tiles, or `data` has no position for any tile, or two for one.
    """
    folder = Path(where)
    is_shards = "://" in where or ((folder / _PLAN).is_file() and not (folder / "manifest.json").is_file())
    return _of_shards(where, data) if is_shards else _of_store(folder, data)


def _of_store(folder: Path, data: Path | None) -> TileSource:
    store = descriptors.open_store(folder)
    manifest = store.manifest
    if manifest.cropped:
        raise InputError(f"{folder} holds cropped pictures, of which several can share a file; index whole ones.")
    _check_role(manifest.role, str(folder))
    names = [Path(row.file).as_posix() for row in manifest.rows]
    check_names(names, len(names))
    kind = DescriptorKind(manifest.fingerprint, manifest.n_parts, manifest.embedding)
    positions = _window_positions(names) if data is None else _positions(data, names)
    step = _step(kind)

    def chunk(start: int) -> TileChunk:
        some = slice(start, start + step)
        return TileChunk(names[some], None if positions is None else positions[some], lambda at: store.rows(start + at))

    return TileSource(kind, len(names), map(chunk, range(0, len(names), step)))


def _check_role(role: Role | None, where: str) -> None:
    if role == "query":
        raise InputError(
            f"{where} is described by the model's branch for queries, and an index holds a gallery; describe the pictures "
            "again with --role gallery, into another folder."
        )


def _of_shards(where: str, data: Path | None) -> TileSource:
    from lpn.cluster.gather import open_shards
    from lpn.cluster.shards import each

    shards = open_shards(where)
    _check_role(shards.plan.role, shards.storage.where)
    kind = DescriptorKind(shards.plan.fingerprint, shards.plan.n_parts, shards.plan.embedding)

    def checked(partition: int) -> list[str]:
        # A name determines its partition, so no tile is in two of them.
        names = shards.tiles(partition).names
        return check_names(names, len(names))

    partitions = range(shards.plan.partitions)
    positions: Float64Array | None = None
    if data is None:
        seen = list(each(lambda partition: _identity(checked(partition)), partitions))
    else:
        # The paths of geo.csv are matched against all names at once.
        parts = list(each(checked, partitions))
        seen = [_identity(names) for names in parts]
        positions = _positions(data, [name for names in parts for name in names])
    starts = np.cumsum([0, *(count for count, _ in seen)])

    def chunk(group: range) -> TileChunk:
        tiles = list(each(shards.tiles, group))
        for partition, part in zip(group, tiles, strict=True):
            # A shard of the same digest may have other broken pictures by now.
            if _identity(part.names) != seen[partition]:
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
    return TileSource(kind, int(starts[-1]), map(chunk, groups), len(shards.broken))


def _identity(names: list[str]) -> tuple[int, int]:
    """Identify the tiles of a shard in little memory."""
    return len(names), hash(tuple(names))


def _step(kind: DescriptorKind) -> int:
    return max(1, _CHUNK_BYTES // (4 * kind.numbers))


def _window_positions(names: list[str]) -> Float64Array | None:
    """Return the centres of windows of a map, (N, 2); None if a name is not that of a window."""
    windows = [window for name in names if (window := NamedWindow.parse(name)) is not None]
    if not names or len(windows) < len(names):
        return None
    return np.array([(window.latitude, window.longitude) for window in windows])


def _positions(root: Path, names: list[str]) -> Float64Array:
    known = geo.positions(root) or _of_dataset(root)
    places = known.match(names)
    if names and not any(places):
        raise InputError(
            f"{known.source} in {root} has no position for any of the {len(names)} tiles, the first being {printable(names[0])}; "
            "give the data set that was described."
        )
    nowhere = (np.nan, np.nan)
    return np.array([nowhere if at is None else (at.latitude, at.longitude) for at in places], np.float64).reshape(
        -1, 2
    )


def _of_dataset(root: Path) -> geo.Positions:
    """Return the positions of a data set that has no geo.csv, such as DenseUAV, UAV-VisLoc, or VIGOR."""
    reason = ""
    try:
        known = open_dataset(root).positions()
    except DataError as error:
        known, reason = None, f" ({str(error).rstrip('.')})"
    if known is None:
        raise DataError(
            f"{root} has no {geo.NAME}, and no data set's own positions{reason}; leave --data out, or write one (docs/data.md)."
        )
    return known
