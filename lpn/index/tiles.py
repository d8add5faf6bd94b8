"""Tiles for an index, read from a store of descriptors with their known positions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lpn import descriptors
from lpn.core.arrays import BoolArray, Float64Array
from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.core.progress import report_progress
from lpn.datasets import geo, open_dataset
from lpn.descriptors.store import DescriptorKind, Store
from lpn.index.base import Index, check_names
from lpn.index.folder import check_role

# Bytes of the descriptors that are added at once; a killed run repeats at most this much.
_CHUNK_BYTES = 64 << 20


class TileSource(NamedTuple):
    """The tiles of a store, to be added to an index.

    Attributes:
        kind: kind of the descriptors in an index.
        store: the descriptors.
        names: names of the tiles, (N,).
        positions: latitude and longitude in degrees, (N, 2) float64, NaN for a tile without a position.
    """

    kind: DescriptorKind
    store: Store
    names: list[str]
    positions: Float64Array

    def add_to(self, index: Index, again: bool = False) -> int:
        """Add the tiles that the index lacks, or all with `again`; return their number. It reports its progress."""
        step, added = max(1, _CHUNK_BYTES // (4 * self.kind.numbers)), 0
        for start in range(0, len(self.names), step):
            names = self.names[start : start + step]
            wanted: BoolArray = np.ones(len(names), bool) if again else ~index.holds(names)
            some = start + np.flatnonzero(wanted)
            if len(some):
                index.add([self.names[i] for i in some.tolist()], self.store.some(some), self.positions[some])
            added += len(some)
            report_progress("Indexing", start + len(names), len(self.names))
        return added


def open_tiles(folder: Path, data: Path | None = None) -> TileSource:
    """Open a store.

    Args:
        data: data set with the tiles' positions, in its geo.csv (see `lpn.datasets.geo.Positions.match`) or in its lists.

    Raises:
        StoreError: when there is no complete store.
        DataError: when `data` has no positions, or they cannot be read.
        InputError: if an index cannot hold these tiles, or `data` has no position for any tile, or two for one.
    """
    store = descriptors.open_store(folder)
    if any(row.box is not None for row in store.rows):
        raise InputError(f"{folder} holds cropped pictures, of which several can share a file; index whole ones.")
    check_role(store.kind, folder)
    names = [Path(name).as_posix() for name in store.names]
    check_names(names, len(names))
    positions = store.positions if data is None else _positions(data, names)
    return TileSource(replace(store.kind, precision="float32"), store, names, positions)


def _positions(root: Path, names: list[str]) -> Float64Array:
    """Return the positions of tiles from geo.csv, or from a layout with positions, such as DenseUAV, UAV-VisLoc, or VIGOR."""
    known, reason = geo.positions(root), ""
    try:
        known = known or open_dataset(root).positions()
    except DataError as error:
        reason = f" ({str(error).rstrip('.')})"
    if known is None:
        raise DataError(
            f"{root} has no {geo.NAME}, and its lists have no positions{reason}; leave --data out, or write one (docs/data.md)."
        )
    places = known.match(names)
    if names and not any(places):
        raise InputError(
            f"{known.source} in {root} has no position for any of the {len(names)} tiles, the first being {printable(names[0])}; "
            "give the data set that was described."
        )
    nowhere = (np.nan, np.nan)
    found = [nowhere if at is None else (at.latitude, at.longitude) for at in places]
    return np.array(found, np.float64).reshape(-1, 2)
