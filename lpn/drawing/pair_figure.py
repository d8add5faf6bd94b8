"""A pair and its evidence as one picture: both photographs with their cells, and each part's sum as bars."""

from __future__ import annotations

import cv2
import numpy as np
from PIL import Image, ImageDraw

from lpn.core import images
from lpn.core.arrays import Float32Array, UInt8Array
from lpn.core.views import View
from lpn.drawing import captions, overlays, theme, verdicts
from lpn.drawing.captions import font
from lpn.drawing.theme import AGAINST, BACKGROUND, DIM, FOR, TEXT
from lpn.explain import Evidence
from lpn.models.spec import ModelSpec

_WIDTH, _MARGIN, _ROW = 1200, 24, 46
NOTE = "Exact: it accounts for the score; it does not say what the score would be were a cell not there."
COVERED = "Approximate: what the score loses where a square of the query is blurred, measured; the bars are exact."


def draw(
    found: Evidence,
    pictures: tuple[UInt8Array, UInt8Array],
    titles: tuple[str, str],
    views: tuple[View, View],
    spec: ModelSpec,
    losses: Float32Array | None = None,
) -> UInt8Array:
    """The whole figure, (H, 1200, 3) uint8.

    Args:
        pictures: query and tile as their parts are cut from them.
        titles: what stands above each.
        views: the branch that described each.
        losses: shown on the query in place of the evidence, see `lpn.explain.occlusion.covered`; then the tile has none.
    """
    room = (_WIDTH - 3 * _MARGIN) // 2
    height = round(room * spec.input_size[0] / spec.input_size[1])
    names = spec.partition(views[0]).names()
    bars_top = 96 + height + 40
    image = Image.new("RGB", (_WIDTH, bars_top + _ROW * len(names) + 96), BACKGROUND)
    pen = ImageDraw.Draw(image)
    said = verdicts.describe_evidence(found, names, *views)
    pen.text((_MARGIN, 32), captions.fitted(pen, said, 22, _WIDTH - 2 * _MARGIN), TEXT, font(22), anchor="lm")
    maps = [found.query.total(found.weights), found.tile.total(found.weights)]
    if losses is not None:
        maps = [np.tensordot(found.weights, losses, 1), np.zeros((1, 1))]
    limit = max(*(float(np.abs(cells).max()) for cells in maps), 1e-9)
    for column, cells in enumerate(maps):
        left = _MARGIN + column * (room + _MARGIN)
        title = captions.fitted(pen, titles[column], 20, room)
        pen.text((left, 76), title, DIM, font(20), anchor="lm")
        partition = spec.partition(views[column])
        shown = overlays.with_evidence(images.resize(pictures[column], height, room), cells, limit)
        shown = overlays.with_rings(shown, partition, found.query.cells.shape[1:])
        image.paste(Image.fromarray(shown), (left, 96))
    _bars(pen, found, names, bars_top)
    _legend(image, pen, limit, bars_top + _ROW * len(names) + 30)
    pen.text((_MARGIN, image.height - 18), NOTE if losses is None else COVERED, DIM, font(16), anchor="lm")
    return np.asarray(image)


def _bars(pen: ImageDraw.ImageDraw, found: Evidence, names: list[str], top: int) -> None:
    """For each part what its cells add and take, the constant, and their sum, on the side of the query."""
    left, right = 420, _WIDTH - 190
    gains, losses, constants = found.sums
    high = float(np.maximum(gains + np.maximum(constants, 0), 1e-9).max())
    low = float(np.minimum(losses + np.minimum(constants, 0), 0).min())
    scale = (right - left) / (high - low)
    zero = left - low * scale
    for part, name in enumerate(names):
        y = top + _ROW * part + 8
        added = float(found.contributions[part])
        pen.text((_MARGIN, y + 9), f"part {name}", theme.part_colour(part), font(20), anchor="lm")
        said = f"cos {found.cosines[part]:+.3f}, weight {100 * found.weights[part]:.0f} %"
        pen.text((_MARGIN + 170, y + 9), said, DIM, font(18), anchor="lm")
        ends = [zero, zero]
        for value, colour in ((gains[part], FOR), (losses[part], AGAINST), (constants[part], DIM)):
            side = 1 if value >= 0 else 0
            end = ends[side] + float(value) * scale
            if abs(end - ends[side]) >= 0.5:
                pen.rectangle((min(ends[side], end), y, max(ends[side], end), y + 18), fill=colour)
            ends[side] = end
        at = zero + added * scale
        pen.rectangle((at - 2, y - 5, at + 1, y + 23), fill=TEXT)
        pen.text((_WIDTH - _MARGIN, y + 9), f"{added:+.3f}", TEXT, font(20), anchor="rm")
    pen.line((zero, top, zero, top + _ROW * len(names) - 8), fill=DIM)


def _legend(image: Image.Image, pen: ImageDraw.ImageDraw, limit: float, y: int) -> None:
    scale = overlays.evidence_scale(240, 16)
    image.paste(Image.fromarray(scale), (_MARGIN + 78, y - 8))
    pen.text((_MARGIN, y), f"{-limit:+.4f}", DIM, font(17), anchor="lm")
    pen.text((_MARGIN + 326, y), f"{limit:+.4f} of the score, each cell", DIM, font(17), anchor="lm")
    x = _MARGIN + 600
    for colour, said in ((FOR, "cells for"), (AGAINST, "cells against"), (DIM, "constant"), (TEXT, "sum")):
        pen.rectangle((x, y - 8, x + 16, y + 8), fill=colour)
        pen.text((x + 24, y), said, DIM, font(17), anchor="lm")
        x += 62 + round(pen.textlength(said, font=font(17)))


def encode(picture: UInt8Array) -> bytes:
    """A picture as a PNG file."""
    return cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes()
