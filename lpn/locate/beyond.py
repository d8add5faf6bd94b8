"""Places beyond the edge of a map, which a flight may leave: states of the sequence that no window shows."""

from __future__ import annotations

import math

import numpy as np

from lpn.core.arrays import BoolArray, Float64Array, Int64Array
from lpn.maps import Map

# Sides of a window by which the places reach beyond the windows. A drone that flies on stays at the outermost ones.
_REACH = 1.0
# Share of a window's ground that the map shows, below which its place counts as beyond the map where it lies within the bounds.
_SHOWN = 0.5


def places_beyond(basemap: Map, places: Float64Array, sizes: Float64Array, overlap: float) -> Float64Array:
    """Return places in metres, (B, 2), beyond windows of the map, on the grids that these lie on.

    They are up to one side away from a window, where another one would not lie within the map's bounds, or would show less than
    half of its ground. Windows that an index has not returned have none in their place.

    Args:
        places: centres of the windows, (N, 2).
        sizes: their sides, (N,).
        overlap: share of a window's side that its neighbour covers, too.
    """
    found = []
    for size in np.unique(sizes):
        own = places[sizes == size]
        step, steps = size * (1 - overlap), math.ceil(_REACH / (1 - overlap))
        origin = own.min(axis=0)
        cells = np.rint((own - origin) / step).astype(np.int64)
        near = cells
        for along in np.eye(2, dtype=np.int64):
            near = np.unique(np.concatenate([near + by * along for by in range(-steps, steps + 1)]), axis=0)
        free = near[~_among(near, cells)] * step + origin
        low, high = np.array(basemap.bounds[:2]) + size / 2, np.array(basemap.bounds[2:]) - size / 2
        out = ((free < low - step / 2) | (free > high + step / 2)).any(axis=1)
        found.append(free[out | (basemap.valid_shares(free, size) < _SHOWN)])
    return np.concatenate(found)


def _among(cells: Int64Array, others: Int64Array) -> BoolArray:
    """Return which cells (N, 2) are among others, (N,)."""
    low, span = cells.min(axis=0), int(np.ptp(cells[:, 1])) + 1
    numbers, known = ((one - low) @ np.array([span, 1]) for one in (cells, others))
    return np.isin(numbers, known)
