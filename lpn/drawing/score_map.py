"""The scores of a map's windows as one small picture over the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lpn.core.arrays import Float64Array

# Maximum of cells along the longer side.
_MAX_CELLS = 1024


@dataclass(frozen=True, eq=False)
class ScoreMap:
    """Scores on a grid.

    Attributes:
        cells: (rows, columns) from the north-west corner, NaN without a window.
        bounds: west, south, east, north in metres.
        low, high: the range of the scores.
    """

    cells: Float64Array
    bounds: tuple[float, float, float, float]
    low: float
    high: float


def score_map(places: Float64Array, sizes: Float64Array, values: Float64Array) -> ScoreMap | None:
    """Paint each window's score over the ground about its centre, half way to its neighbours of equal size.

    Where windows of several sizes overlap, the highest score counts.

    Args:
        places: centres, (W, 2) metres; those of one size lie on a grid.
        sizes: sides in metres, (W,).
        values: scores, (W,).

    Returns:
        None without a window.
    """
    if not len(values):
        return None
    levels = [sizes == size for size in np.unique(sizes)]
    steps = [_step(places[level], float(sizes[level][0])) for level in levels]
    corners = [(places[m].min(0) - s / 2, places[m].max(0) + s / 2) for m, s in zip(levels, steps, strict=True)]
    west, south = np.min([low for low, _ in corners], axis=0).tolist()
    east, north = np.max([high for _, high in corners], axis=0).tolist()
    cell = max(min(steps) if len(levels) == 1 else min(steps) / 2, max(east - west, north - south) / _MAX_CELLS)
    rows, columns = max(round((north - south) / cell), 1), max(round((east - west) / cell), 1)
    cells = np.full((rows, columns), np.nan)
    for level, step, (low, high) in zip(levels, steps, corners, strict=True):
        left, top = low[0], high[1]
        grid = np.floor((places[level] - (left, top)) / (step, -step)).astype(int)
        layer = np.full(grid.max(axis=0)[::-1] + 1, np.nan)
        layer[grid[:, 1], grid[:, 0]] = values[level]
        y = north - (np.arange(rows) + 0.5) * (north - south) / rows
        x = west + (np.arange(columns) + 0.5) * (east - west) / columns
        row, column = np.floor((top - y) / step).astype(int), np.floor((x - left) / step).astype(int)
        inside = np.ix_((row >= 0) & (row < len(layer)), (column >= 0) & (column < layer.shape[1]))
        cells[inside] = np.fmax(cells[inside], layer[np.ix_(row[inside[0].ravel()], column[inside[1].ravel()])])
    return ScoreMap(cells, (west, south, east, north), float(values.min()), float(values.max()))


def _step(places: Float64Array, size: float) -> float:
    """Return the metres from a window to the next on a grid; a lone window covers its whole side."""
    gaps = np.concatenate([np.diff(np.unique(places[:, axis])) for axis in (0, 1)])
    # Coordinates of one row may differ by rounding.
    gaps = gaps[gaps > 1e-3 * size]
    return float(gaps.min()) if len(gaps) else size
