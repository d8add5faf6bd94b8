"""Places beyond the edge of a map, which a flight may leave: states of the sequence that no window shows."""

from __future__ import annotations

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.flight.locate.sequence import merged_coordinates
from lpn.flight.maps import Map

# Sides of a window by which the places reach beyond the windows. A drone that flies on stays at the outermost ones.
_REACH = 1.0
# Share of a window's ground that the map shows, below which its place counts as beyond the map where it lies within the bounds.
_SHOWN = 0.5
# Share of a side below which the distance of two coordinates is no step: they are those of two grids.
_LEAST_STEP = 0.05


def places_beyond(basemap: Map, places: Float64Array, sizes: Float64Array, overlap: float) -> Float64Array:
    """Return places in metres, (B, 2), beyond windows of the map, on the grids that these lie on.

    They are up to one side away from a window, where another one would not lie within the map's bounds, or would show less than
    half of its ground. Windows that an index has not returned have none in their place.

    Args:
        places: centres of the windows, (N, 2).
        sizes: their sides, (N,).
        overlap: share of a window's side that its neighbour covers, too, where no two windows of a size tell it.
    """
    found = []
    for size in np.unique(sizes):
        axes = [merged_coordinates(values) for values in places[sizes == size].T]
        told = [_step(coordinates, size) for coordinates, _ in axes]
        # The steps of both axes are equal but for the rounding of an index's names, which adds up along an axis.
        step = np.array([one or told[1 - i] or size * (1 - overlap) for i, one in enumerate(told)])
        origin = np.array([coordinates[0] for coordinates, _ in axes])
        reach = np.floor(_REACH * size / step + 0.01).astype(np.int64)
        # Cells are numbered row by row, with a margin on each side, as numbers are compared faster than pairs.
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
    """Return the step of a grid with some of these coordinates, (M,), ascending; None if they tell none of a side or less."""
    gaps = np.diff(coordinates)
    gaps = gaps[gaps > _LEAST_STEP * size]
    if not len(gaps):
        return None
    gaps, group = merged_coordinates(gaps)
    step = float(gaps[np.bincount(group).argmax()])
    span = float(np.ptp(coordinates))
    return span / round(span / step) if step < 1.01 * size else None
