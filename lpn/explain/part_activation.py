"""Activation part by part: the channel sum of one picture's feature map in the cells of each part.

This is the paper's Figure 7 without its scaling to 0 .. 1 (wtyhub/LPN heatmap.py:90), one map for each part. It belongs to one
picture, does not depend on the other picture of a pair, and does not add up to a score; evidence does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from lpn.core.arrays import Float32Array, Float64Array
from lpn.models.trace import Trace


def part_activation(trace: Trace) -> Float32Array:
    """Return the channel sum of a picture's map in each part's cells, (n, h, w); NaN in all other cells.

    A cell is in every part that pools it: adjacent strips may share a row or column, and parts of a small map, which the
    network resizes before it cuts, share cells. A part may have a map of its own.
    """
    return cast(Float32Array, np.where(trace.cells[0] != 0, trace.part_totals, np.float32(np.nan)))


def value_ranges(pictures: Sequence[Float32Array], shared: bool) -> Float64Array:
    """Return the lowest and the highest value of each part in each picture, (pictures, n, 2).

    Args:
        pictures: maps (n, h, w) of each picture, as `part_activation` returns them.
        shared: each part has one range for all pictures, so that their colours can be compared.

    A part without a cell has the range 0 to 0.
    """
    ranges = np.array([[_range(cells[~np.isnan(cells)]) for cells in maps] for maps in pictures])
    if shared:
        ranges[..., 0], ranges[..., 1] = ranges[..., 0].min(axis=0), ranges[..., 1].max(axis=0)
    return ranges


def _range(values: Float32Array) -> tuple[float, float]:
    return (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
