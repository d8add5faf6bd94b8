"""Tiles for an index, read with their known positions from a store of descriptors or from the parts of many workers."""

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

# Bytes of the descriptors that are added at once; a killed run repeats at most this much.
_CHUNK_BYTES = 64 << 20
# The name from `lpn.cluster.parts`, which needs an extra and is imported for parts only.
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
    """Tiles to be added to an index; only one chunk of descriptors is in memory at a time.

    Attributes:
        kind: kind of the descriptors.
        count: number of tiles.
        chunks: all tiles in order, in chunks; raises StoreError if a part is damaged or was removed meanwhile.
        broken: number of pictures that could not be described and are left out.
    """

    kind: DescriptorKind
    count: int
    chunks: Iterator[TileChunk]
    broken: int = 0


def open_tiles(where: str, data: Path | None = None) -> TileSource:
    """Open a store or parts of descriptors. Windows of a map have the positions in their names.

    Args:
        where: folder of a store, or folder or address of parts.
        data: data set whose positions replace the parts': its geo.csv by `lpn.datasets.geo.Positions.match`, or its own lists.

    Raises:
        StoreError: when there is neither a complete store nor complete parts.
        DataError: when `data` has no positions, or they cannot be read.
        InputError: if an index cannot hold these tiles, or `data` has no position for any tile, or two for one.
    """
    folder = Path(where)
    is_parts = "://" in where or ((folder / _PLAN).is_file() and not (folder / "manifest.json").is_file())
    return _of_parts(where, data) if is_parts else _of_store(folder, data)


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


def _of_parts(where: str, data: Path | None) -> TileSource:
    from lpn.cluster.parts import PartContents, open_parts

    opened = open_parts(where)
    plan = opened.plan
    _check_role(plan.role, opened.storage.where)
    kind = DescriptorKind(plan.fingerprint, plan.n_parts, plan.embedding)
    names = [one.row.file for part in opened.parts for one in part.items]
    check_names(names, len(names))
    positions = None if data is None else _positions(data, names)
    starts = np.cumsum([0, *(len(part.items) for part in opened.parts)]).tolist()

    def chunk(part: PartContents, start: int) -> TileChunk:
        some = slice(start, start + len(part.items))
        places = part.positions if positions is None else positions[some]
        return TileChunk(names[some], places, lambda rows: opened.vectors(part)[rows])

    return TileSource(kind, len(names), map(chunk, opened.parts, starts), len(opened.broken))


def _step(kind: DescriptorKind) -> int:
    return max(1, _CHUNK_BYTES // (4 * kind.numbers))


def _window_positions(names: list[str]) -> Float64Array | None:
    """Return the centres of windows of a map, (N, 2); None if a name names no window."""
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
    """Return the positions of a data set without a geo.csv, such as DenseUAV, UAV-VisLoc, or VIGOR."""
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
