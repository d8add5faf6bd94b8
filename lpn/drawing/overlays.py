"""Overlays on pictures: borders of parts, heat, and evidence. Arrays in, arrays out."""

from __future__ import annotations

import base64
from functools import cache
from typing import cast

import cv2
import numpy as np

from lpn.core import images
from lpn.core.arrays import FloatingArray, Int64Array, UInt8Array
from lpn.drawing.part_areas import PartAreas
from lpn.drawing.theme import HEAT, HEAT_AGAINST, part_colour

# Heat values up to the first number are not painted. A greyed picture is its grey level times the second, plus the third.
_BARE, _GREY, _RAISED = 0.3, 0.61, 10.0
# Pixels of a part's border.
_LINE = 2


def with_evidence(picture: UInt8Array, cells: FloatingArray, limit: float) -> UInt8Array:
    """Paint each cell (h, w) over a greyed picture in the colours for or against, more strongly for larger values."""
    painted = images.enlarge(heat_colours(cells / max(limit, 1e-12), signed=True), *picture.shape[:2])
    grey = (_GREY * cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32) + _RAISED)[..., None]
    alpha = painted[..., 3:].astype(np.float32) / 255
    return np.asarray(grey + (painted[..., :3] - grey) * alpha, np.uint8)


def heat_colours(values: FloatingArray, signed: bool = False) -> UInt8Array:
    """Return the overlay colours of cells (h, w) for a greyed picture, (h, w, 4) RGBA uint8.

    Args:
        values: from 0 to 1, with the weakest 30 % transparent; if `signed`, from -1 (against) to 1 (for).
    """
    if not signed:
        strength = np.clip((values - _BARE) / (1 - _BARE), 0, 1) ** 1.15
        return cast(UInt8Array, _ramp(HEAT)[np.round(255 * strength).astype(np.uint8)])
    # A power of 0.6 keeps small values visible: outer rings have many cells, each with little of the ring's evidence.
    strengths = np.round(255 * np.clip(np.abs(values), 0, 1) ** 0.6).astype(np.uint8)
    return np.where((values >= 0)[..., None], _ramp(HEAT)[strengths], _ramp(HEAT_AGAINST)[strengths])


@cache
def _ramp(stops: tuple[tuple[float, float, float, float], ...]) -> UInt8Array:
    """Return the colours of 256 even steps, (256, 4) RGBA."""
    steps = np.linspace(0, len(stops) - 1, 256)
    columns = [np.interp(steps, range(len(stops)), column) for column in np.array(stops).T]
    return np.stack([*columns[:3], 255 * columns[3]], axis=1).round().astype(np.uint8)


def evidence_limit(*maps: FloatingArray) -> float:
    """Return the end of a common colour scale for several maps of evidence."""
    return max(float(np.abs(cells).max()) for cells in maps) or 1e-9


def evidence_scale(width: int, height: int) -> UInt8Array:
    """Draw the colour scale of `with_evidence`, from strongest evidence against (left) to strongest evidence for (right)."""
    values = np.broadcast_to(np.linspace(-1, 1, width), (height, width))
    return with_evidence(np.full((height, width, 3), 70, np.uint8), values, 1.0)


def heat_cells(values: FloatingArray, low: float, high: float) -> UInt8Array:
    """Return the colours of cells (h, w) from `low` to `high` in viridis, (h, w, 4) RGBA; NaN is transparent.

    Viridis is perceptually uniform: equal steps of a value are equal steps of colour. The released heatmaps use it (wtyhub/LPN
    heatmap.py:49).
    """
    share = np.nan_to_num((values - low) / max(high - low, 1e-12)) if high > low else np.full(values.shape, 0.5)
    levels = np.round(255 * np.clip(share, 0, 1)).astype(np.uint8)
    colours = cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
    return np.dstack([colours, np.where(np.isnan(values), 0, 255).astype(np.uint8)])


def with_parts(picture: UInt8Array, areas: PartAreas | None) -> UInt8Array:
    """Draw the border of each part in its colour, with a dark outline that is visible on bright ground.

    Args:
        areas: of the parts; None draws nothing. A part that has the largest weight in no cell has no border.
    """
    drawn = np.ascontiguousarray(picture).copy()
    if areas is None:
        return drawn
    if not areas.straight:
        return _with_outlines(drawn, areas.labels)
    height, width = picture.shape[:2]
    for part, (left, top, right, bottom) in enumerate(areas.boxes):
        inset = _LINE // 2 + 1
        first = (round(left * width) + inset, round(top * height) + inset)
        second = (round(right * width) - 1 - inset, round(bottom * height) - 1 - inset)
        cv2.rectangle(drawn, first, second, (0, 0, 0), _LINE + 2)
        cv2.rectangle(drawn, first, second, part_colour(part), _LINE)
    return drawn


def _with_outlines(drawn: UInt8Array, labels: Int64Array) -> UInt8Array:
    """Draw the outline of each label's cells, just inside of them."""
    spread = images.enlarge(labels, *drawn.shape[:2])
    for part in range(int(labels.max()) + 1):
        inside = (spread == part).astype(np.uint8)
        # A border of zeros turns the picture's own border into an outline, too.
        outer, inner = (
            cv2.erode(
                inside, np.ones((3, 3), np.uint8), iterations=steps, borderType=cv2.BORDER_CONSTANT, borderValue=0
            )
            for steps in (1, 1 + _LINE)
        )
        innermost = cv2.erode(inner, np.ones((3, 3), np.uint8))
        drawn[(inside > outer) | (inner > innermost)] = 0
        drawn[outer > inner] = part_colour(part)
    return drawn


def data_uri(picture: UInt8Array, quality: int = 80) -> str:
    """Return a picture, (H, W, 3) uint8, as the data URI of a JPEG."""
    return "data:image/jpeg;base64," + base64.b64encode(images.jpeg(picture, quality)).decode()


def png_data_uri(cells: UInt8Array) -> str:
    """Return a picture with transparency, (H, W, 4) RGBA uint8, as the data URI of a PNG, which is lossless."""
    encoded = cv2.imencode(".png", cv2.cvtColor(cells, cv2.COLOR_RGBA2BGRA))[1]
    return "data:image/png;base64," + base64.b64encode(encoded.tobytes()).decode()
