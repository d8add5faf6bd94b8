"""The tiles that an index is made of: those of a store of descriptors, or of shards; with positions where they are known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lpn import features, geo
from lpn.errors import DataError, InputError
from lpn.files import printable
from lpn.index.base import Exact, Kind, check_names
from lpn.model import FloatArray

_LOT_BYTES = 64 << 20
"""Of descriptors added at once: what a killed run does over again."""
_PLAN = "plan.json"
"""As `lpn.shards` calls it, which is imported only for shards: it needs an extra."""


@dataclass(frozen=True)
class Tiles:
    """Tiles to be put into an index.

    Attributes:
        kind: of their descriptors.
        names: of all of them, each a name that an index takes.
        positions: latitude and longitude in degrees, (N, 2) float64, NaN where a tile has none; None where none has.
        lots: the tiles that are best read and added together, in order.
        rows: gives the descriptors (B, n, D) float32 of some tiles of one lot, by their ascending numbers.
        broken: how many pictures could not be described, and so are not among them.
    """

    kind: Kind
    names: list[str]
    positions: Exact | None
    lots: list[range]
    rows: Callable[[npt.NDArray[np.int64]], FloatArray]
    broken: int = 0


def open_tiles(where: str, data: Path | None = None) -> Tiles:
    """Open what was described.

    Args:
        where: folder of a store, or folder or address of shards.
        data: folder whose geo.csv gives the positions, in place of those that shards have; see `lpn.geo.match` for its paths.

    Raises:
        StoreError: when there is neither a complete store nor complete shards.
        DataError: when `data` has no geo.csv, or it cannot be read.
        InputError: when an index cannot hold these tiles, or `data` has none of them, or has them in two places.
    """
    folder = Path(where)
    is_shards = "://" in where or ((folder / _PLAN).is_file() and not (folder / "manifest.json").is_file())
    return _of_shards(where, data) if is_shards else _of_store(folder, data)


def _of_store(folder: Path, data: Path | None) -> Tiles:
    store = features.open_store(folder)
    manifest = store.manifest
    if manifest.cropped:
        raise InputError(f"{folder} holds cropped pictures, of which several can share a file; index whole ones.")
    names = [Path(row.file).as_posix() for row in manifest.rows]
    check_names(names, len(names))
    kind = Kind(manifest.fingerprint, manifest.n_parts, manifest.embedding)
    step = _step(kind)
    lots = [range(start, min(start + step, len(names))) for start in range(0, len(names), step)]
    return Tiles(kind, names, None if data is None else _positions(data, names), lots, store.rows)


def _of_shards(where: str, data: Path | None) -> Tiles:
    from lpn.gather import open_shards

    shards = open_shards(where)
    kind = Kind(shards.plan.fingerprint, shards.plan.n_parts, shards.plan.embedding)
    parts = shards.tiles()
    names = [name for part in parts for name in part.names]
    check_names(names, len(names))
    positions = np.concatenate([part.positions for part in parts]) if data is None else _positions(data, names)
    starts = np.cumsum([0, *(len(part.names) for part in parts)])

    def rows(chosen: npt.NDArray[np.int64]) -> FloatArray:
        owners = np.searchsorted(starts, chosen, "right") - 1
        read = [shards.descriptors(int(p), parts[p].names)[chosen[owners == p] - starts[p]] for p in np.unique(owners)]
        return np.concatenate(read)

    lots: list[range] = []
    for start, end in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        if lots and end - lots[-1].start <= _step(kind):
            start = lots.pop().start
        lots.append(range(start, end))
    return Tiles(kind, names, positions, lots, rows, len(shards.broken))


def _step(kind: Kind) -> int:
    return max(1, _LOT_BYTES // (4 * kind.numbers))


def _positions(root: Path, names: list[str]) -> Exact:
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
