"""Places beyond a map's edge, for flights that leave it: states of the sequence without a window."""

from __future__ import annotations

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.flight.locate.sequence import merged_coordinates
from lpn.flight.maps import Map

# Sides of a window by which the places reach beyond the windows. A drone farther away stays at the outermost places.
_REACH = 1.0
# A place within the map's bounds counts as beyond the map if the map shows less than this share of its window.
_SHOWN = 0.5
# Coordinates nearer than this share of a side are of two grids, and no step of one.
_LEAST_STEP = 0.05


def places_beyond(basemap: Map, places: Float64Array, sizes: Float64Array, overlap: float) -> Float64Array:
    """Return places beyond the windows of a map in metres, (B, 2), on the windows' grids.

    They lie up to one side away from a window, where a further window would leave the map's bounds or show less than half of its
    ground. Windows that an index has not returned are not replaced by places.

    Args:
        places: centres of the windows, (N, 2).
        sizes: their sides, (N,).
        overlap: share of a window's side that its neighbour also covers, used if no two windows of a size give the step.
    """
    found = []
    for size in np.unique(sizes):
        axes = [merged_coordinates(values) for values in places[sizes == size].T]
        told = [_step(coordinates, size) for coordinates, _ in axes]
        # The steps of both axes are equal except for an index's rounded names, whose rounding adds up along an axis.
        step = np.array([one or told[1 - i] or size * (1 - overlap) for i, one in enumerate(told)])
        origin = np.array([coordinates[0] for coordinates, _ in axes])
        reach = np.floor(_REACH * size / step + 0.01).astype(np.int64)
        # Cells are numbered row by row, with a margin on each side: comparing numbers is faster than comparing pairs.
        x, y = (
            np.rint((coordinates - coordinates[0]) / by).astype(np.int64)[group] + margin
            for (coordinates, group), by, margin in zip(axes, step, reach, strict=True)
        )
        row = int(x.max() + reach[0]) + 1
        own = near = y * row + x
        for along, by in zip((1, row), reach, strict=True):
            near = np.unique(near[:, None] + along * np.arange(-by, by + 1))
        cells = np.stack(np.divmod(np.setdiff1d(near, own), row)[::-1], axis=1)
        free = (cells - reach) * step + origin
        low, high = np.array(basemap.bounds[:2]) + size / 2, np.array(basemap.bounds[2:]) - size / 2
        out = ((free < low - step / 2) | (free > high + step / 2)).any(axis=1)
        found.append(free[out | (basemap.valid_shares(free, size) < _SHOWN)])
    return np.concatenate(found)


def _step(coordinates: Float64Array, size: float) -> float | None:
    """Return the step of a grid from some of its coordinates, (M,), ascending; None without a step up to a side."""
    gaps = np.diff(coordinates)
    gaps = gaps[gaps > _LEAST_STEP * size]
    if not len(gaps):
        return None
    gaps, group = merged_coordinates(gaps)
    step = float(gaps[np.bincount(group).argmax()])
    span = float(np.ptp(coordinates))
    return span / round(span / step) if step < 1.01 * size else None
