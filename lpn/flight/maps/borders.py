"""White and black borders of a map: they mean no data where the file marks none."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np

from lpn.core.arrays import AnyArray, BoolArray

BorderColour = Literal["white", "black"]

# JPEG changes black and white by up to _NOISE; at least _CORE_SHARE of a border's pixels change by at most _CORE_NOISE.
_NOISE, _CORE_NOISE, _CORE_SHARE = 16, 2, 0.8
# Longest side of the overview on which borders and stretches are decided.
_OVERVIEW = 1024
# Smaller regions at the border, as a share of the overview, belong to the picture.
_MIN_SHARE = 1e-3


def find_borders(values: AnyArray, deep: bool) -> dict[BorderColour, BoolArray]:
    """Find white and black that is connected to the border.

    Args:
        values: an overview, (bands, height, width).
        deep: True if the numbers are not bytes; black is then 0 and below, and there is no white.

    Returns:
        The regions of the colours that have one, (height, width).
    """
    colours: tuple[BorderColour, ...] = ("black",) if deep else ("white", "black")
    regions = {colour: border_region(values, colour, deep) for colour in colours}
    return {colour: region for colour, region in regions.items() if region.any()}


def border_region(values: AnyArray, colour: BorderColour, deep: bool) -> BoolArray:
    """Return the pixels of a border's colour that are connected to the border, (height, width); see `find_borders`."""
    like = _like(values, colour, deep, _NOISE)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(like.astype(np.uint8), connectivity=4)
    edge = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    chosen = np.zeros(count, bool)
    chosen[edge] = True
    chosen[0] = False
    chosen &= stats[:, cv2.CC_STAT_AREA] >= _MIN_SHARE * labels.size
    # Dark water is not uniform as a border is.
    core = np.bincount(labels.ravel(), _like(values, colour, deep, _CORE_NOISE).ravel(), count)
    chosen &= core >= _CORE_SHARE * stats[:, cv2.CC_STAT_AREA]
    region: BoolArray = chosen[labels]
    return region


def overview_size(width: int, height: int) -> tuple[int, int]:
    """Return width and height of the overview on which borders and stretches are decided."""
    factor = max(1.0, max(width, height) / _OVERVIEW)
    return max(1, round(width / factor)), max(1, round(height / factor))


def _like(values: AnyArray, colour: BorderColour, deep: bool, noise: int) -> BoolArray:
    noise = 0 if deep else noise
    like: BoolArray = values.max(0) <= noise if colour == "black" else values.min(0) >= 255 - noise
    return like
