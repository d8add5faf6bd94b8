"""Overlays on pictures: part boundaries, heatmaps, evidence, and frames. Arrays in, arrays out."""

from __future__ import annotations

import base64
from collections.abc import Collection
from functools import cache
from typing import cast

import cv2
import numpy as np

from lpn.core import images
from lpn.core.arrays import BoolArray, Float32Array, FloatingArray, Int64Array, UInt8Array
from lpn.drawing.part_areas import PartAreas
from lpn.drawing.theme import HEAT, HEAT_AGAINST, UNKNOWN_COLOUR, Colour, part_colour

# Pixels of a dash.
_DASH = 7
# The weakest heat that is not painted, and the grey of the picture beneath: its light's share, and a level that is added.
_BARE, _GREY, _RAISED = 0.3, 0.61, 10.0


def square(picture: UInt8Array, size: int) -> UInt8Array:
    """Resize a whole picture to a square, as the network sees it."""
    return images.resize(picture, size, size)


def with_heat(picture: UInt8Array, activation: Float32Array, inside: BoolArray | None, opacity: float) -> UInt8Array:
    """Lay a heatmap over a picture; weak cells are transparent, so that the picture stays readable.

    Args:
        activation: (h, w), 0 to 1.
        inside: the pixels of one part, (H, W), with at least one; the heatmap is scaled to it, and the rest is darkened.
    """
    height, width = picture.shape[:2]
    heat = np.clip(cv2.resize(activation, (width, height), interpolation=cv2.INTER_CUBIC), 0.0, 1.0)
    if inside is not None:
        low, high = float(heat[inside].min()), float(heat[inside].max())
        heat = np.where(inside, np.clip((heat - low) / max(high - low, 1e-6), 0.0, 1.0), 0.0)
    colours = cv2.cvtColor(cv2.applyColorMap((255 * heat).astype(np.uint8), cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
    alpha = (opacity * heat * np.sqrt(heat)).astype(np.float32)
    blended = cv2.blendLinear(picture, colours, 1 - alpha, alpha)
    if inside is not None:
        shade = np.where(inside, 1.0, 1.0 - 0.55 * opacity).astype(np.float32)
        blended = cv2.blendLinear(blended, np.zeros_like(blended), shade, 1 - shade)
    return cast(UInt8Array, blended)


def heat_scale(width: int, height: int) -> UInt8Array:
    """Draw the colour scale of `with_heat`, from weak at the left to strong at the right."""
    ramp = np.broadcast_to(np.linspace(0, 1, width, dtype=np.float32), (height, width))
    return with_heat(np.full((height, width, 3), 90, np.uint8), ramp, None, 1.0)


def with_evidence(picture: UInt8Array, cells: FloatingArray, limit: float, opacity: float = 1.0) -> UInt8Array:
    """Paint each cell (h, w) over a greyed picture in the colours for or against, the stronger the larger its value."""
    painted = images.enlarge(heat_colours(cells / max(limit, 1e-12), signed=True), *picture.shape[:2])
    grey = (_GREY * cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32) + _RAISED)[..., None]
    alpha = (opacity / 255 * painted[..., 3:]).astype(np.float32)
    return np.asarray(grey + (painted[..., :3] - grey) * alpha, np.uint8)


def heat_colours(values: FloatingArray, signed: bool = False) -> UInt8Array:
    """Return the colours of cells (h, w) that are laid over a greyed picture, (h, w, 4) RGBA uint8.

    Args:
        values: from 0 to 1, of which the weakest 30 % are transparent; if `signed`, from -1 to 1, against to for.
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


def with_lead(picture: UInt8Array, cells: FloatingArray, colours: tuple[Colour, Colour]) -> UInt8Array:
    """Paint the cells (h, w) that decide in the first colour (positive) or the second; weak ones show the greyed picture."""
    values = images.enlarge(cells, *picture.shape[:2])
    # The centre ring of four has a sixteenth of the cells, and must not hide all others.
    strong = float(np.quantile(np.abs(cells), 0.85)) or evidence_limit(cells)
    alpha = 0.7 * np.clip(np.abs(values) / strong, 0, 1).astype(np.float32) ** 1.5
    greyed = cv2.cvtColor(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    ground = (0.25 * picture + 0.75 * greyed).astype(np.float32)
    paint = np.where(values[..., None] >= 0, *(np.array(colour, np.float32) for colour in colours))
    return np.asarray(ground * (1 - alpha[..., None]) + paint * alpha[..., None], np.uint8)


def evidence_limit(*maps: FloatingArray) -> float:
    """Return the end of one colour scale for several maps of evidence."""
    return max(float(np.abs(cells).max()) for cells in maps) or 1e-9


def evidence_scale(width: int, height: int) -> UInt8Array:
    """Draw the colour scale of `with_evidence`, from the limit against at the left to the limit for at the right."""
    values = np.broadcast_to(np.linspace(-1, 1, width), (height, width))
    return with_evidence(np.full((height, width, 3), 70, np.uint8), values, 1.0)


def heat_cells(values: FloatingArray, low: float, high: float) -> UInt8Array:
    """Return the colours of cells (h, w) from `low` to `high` in viridis, (h, w, 4) RGBA; NaN is transparent.

    Viridis is perceptually uniform: equal steps of a value are equal steps of colour. The released code uses it for its heatmaps
    (wtyhub/LPN heatmap.py:49).
    """
    share = np.nan_to_num((values - low) / max(high - low, 1e-12)) if high > low else np.full(values.shape, 0.5)
    levels = np.round(255 * np.clip(share, 0, 1)).astype(np.uint8)
    colours = cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
    return np.dstack([colours, np.where(np.isnan(values), 0, 255).astype(np.uint8)])


def with_parts(
    picture: UInt8Array, areas: PartAreas | None, thickness: int = 2, off: Collection[int] = ()
) -> UInt8Array:
    """Draw the border of each part in its colour, with a dark outline that is visible on bright ground.

    Args:
        areas: of the parts; nothing is drawn without them, and for a part that no cell belongs to most.
        off: parts that do not count, which are drawn in grey.
    """
    drawn = np.ascontiguousarray(picture).copy()
    if areas is None:
        return drawn
    if not areas.straight:
        return _with_outlines(drawn, areas.labels, thickness, off)
    height, width = picture.shape[:2]
    for part, (left, top, right, bottom) in enumerate(areas.boxes):
        inset = thickness // 2 + 1
        first = (round(left * width) + inset, round(top * height) + inset)
        second = (round(right * width) - 1 - inset, round(bottom * height) - 1 - inset)
        cv2.rectangle(drawn, first, second, (0, 0, 0), thickness + 2)
        cv2.rectangle(drawn, first, second, _border_colour(part, off), thickness)
    return drawn


def _border_colour(part: int, off: Collection[int]) -> Colour:
    return UNKNOWN_COLOUR if part in off else part_colour(part)


def _with_outlines(drawn: UInt8Array, labels: Int64Array, thickness: int, off: Collection[int]) -> UInt8Array:
    """Draw the outline of each label's cells, just inside of them."""
    spread = images.enlarge(labels, *drawn.shape[:2])
    for part in range(int(labels.max()) + 1):
        inside = (spread == part).astype(np.uint8)
        # A border of zeros makes the picture's own border an outline, too.
        outer, inner = (
            cv2.erode(
                inside, np.ones((3, 3), np.uint8), iterations=steps, borderType=cv2.BORDER_CONSTANT, borderValue=0
            )
            for steps in (1, 1 + thickness)
        )
        innermost = cv2.erode(inner, np.ones((3, 3), np.uint8))
        drawn[(inside > outer) | (inner > innermost)] = 0
        drawn[outer > inner] = _border_colour(part, off)
    return drawn


def with_box(picture: UInt8Array, cells: BoolArray) -> UInt8Array:
    """Draw the box around the cells (h, w) that are True as a dashed white line with a dark outline."""
    drawn = np.ascontiguousarray(picture).copy()
    inside = images.enlarge(cells.astype(np.float32), *picture.shape[:2]) > 0.5
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    corners = [(x, y) for x, y in ((0, 0), (-1, 0), (-1, -1), (0, -1))]
    places = [(int(columns[x]), int(rows[y])) for x, y in corners]
    for (x, y), (right, down) in zip(places, [*places[1:], places[0]], strict=True):
        length = max(abs(right - x), abs(down - y))
        count = 2 * max(round(length / (2 * _DASH)), 1) + 1
        ends = [(round(x + (right - x) * i / count), round(y + (down - y) * i / count)) for i in range(count + 1)]
        for begin, end in zip(ends[::2], ends[1::2], strict=True):
            cv2.line(drawn, begin, end, (0, 0, 0), 4)
            cv2.line(drawn, begin, end, (255, 255, 255), 2)
    return drawn


def part_layer(picture: UInt8Array, inside: BoolArray) -> UInt8Array:
    """Return the pixels of one part of a picture, (height, width, 4) RGBA; the rest is transparent."""
    alpha = np.where(inside, 255, 0).astype(np.uint8)
    return np.dstack([picture, alpha])


def framed(picture: UInt8Array, colour: Colour, width: int) -> UInt8Array:
    """Draw a frame over the border of a picture."""
    drawn = np.ascontiguousarray(picture).copy()
    drawn[:width] = drawn[-width:] = colour
    drawn[:, :width] = drawn[:, -width:] = colour
    return drawn


def outlined(size: int, colour: Colour, width: int, tint: float) -> UInt8Array:
    """Return a square with an opaque frame and an inside of opacity `tint`, 0 to 1: (size, size, 4) RGBA."""
    drawn = np.empty((size, size, 4), np.uint8)
    drawn[..., :3] = colour
    drawn[..., 3] = 255
    drawn[width:-width, width:-width, 3] = round(255 * tint)
    return drawn


def data_uri(picture: UInt8Array, quality: int = 80) -> str:
    """Return a picture, (H, W, 3) uint8, as the data URI of a JPEG."""
    return "data:image/jpeg;base64," + base64.b64encode(images.jpeg(picture, quality)).decode()


def png_data_uri(cells: UInt8Array) -> str:
    """Return a picture with transparency, (H, W, 4) RGBA uint8, as the data URI of a PNG, which is exact."""
    encoded = cv2.imencode(".png", cv2.cvtColor(cells, cv2.COLOR_RGBA2BGRA))[1]
    return "data:image/png;base64," + base64.b64encode(encoded.tobytes()).decode()
