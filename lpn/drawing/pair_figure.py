"""A pair and its evidence as one picture: both photographs with their cells, a bar for each part, and d² as one bar."""

from __future__ import annotations

import cv2
import numpy as np
from PIL import Image, ImageDraw

from lpn.core import images
from lpn.core.arrays import Float32Array, UInt8Array
from lpn.core.numbers import rounded_to_sum
from lpn.core.views import View
from lpn.drawing import captions, charts, overlays, theme, verdicts
from lpn.drawing.captions import fitted, font
from lpn.drawing.part_areas import PartAreas
from lpn.drawing.theme import AGAINST, DARK, FOR, UNKNOWN_COLOUR
from lpn.explain import Evidence
from lpn.models.contract import Contract

# Pixels.
WIDTH = 1200
_MARGIN, _ROW = 24, 46
_COLOURS = {"cells for": FOR, "cells against": AGAINST, "constant": UNKNOWN_COLOUR}
_ACCOUNT = ": it accounts for the score; it does not say what the score would be were a cell not there."
OCCLUSION_NOTE = (
    "Approximate: what the score loses where a square of the query is blurred, measured; the bars are exact."
)


def draw(
    evidence: Evidence,
    pictures: tuple[UInt8Array, UInt8Array],
    titles: tuple[str, str],
    views: tuple[View, View],
    contract: Contract,
    areas: tuple[PartAreas | None, PartAreas | None],
    losses: Float32Array | None = None,
) -> UInt8Array:
    """Draw the whole figure, (H, 1200, 3) uint8.

    Args:
        pictures: query and tile as the model partitions them.
        titles: captions of query and tile.
        views: the branches that described query and tile.
        areas: of the parts of query and tile.
        losses: of `lpn.explain.occlusion.occlude`; they are drawn on the query in place of the evidence, and the tile has none.
    """
    width = (WIDTH - 3 * _MARGIN) // 2
    height = round(width * contract.input_size[0] / contract.input_size[1])
    names = contract.names(views[0])
    bars_top = 96 + height + 40
    distance_top = bars_top + _ROW * len(names)
    image = Image.new("RGB", (WIDTH, distance_top + _ROW + 96), DARK.background)
    pen = ImageDraw.Draw(image)
    # Pillow's typeface has no minus sign.
    sentence = verdicts.describe_evidence(evidence, names, *views, contract.part_noun).replace("−", "-")
    pen.text((_MARGIN, 32), fitted(pen, sentence, 22, WIDTH - 2 * _MARGIN), DARK.text, font(22), anchor="lm")
    maps = evidence.cell_maps()
    if losses is not None:
        maps = np.tensordot(evidence.weights.astype(np.float64), losses, 1), np.zeros((1, 1))
    limit = overlays.evidence_limit(*maps)
    for column, cells in enumerate(maps):
        left = _MARGIN + column * (width + _MARGIN)
        pen.text((left, 76), fitted(pen, titles[column], 20, width), DARK.dim, font(20), anchor="lm")
        drawn = overlays.with_evidence(images.resize(pictures[column], height, width), cells, limit)
        drawn = overlays.with_parts(drawn, areas[column])
        image.paste(Image.fromarray(drawn), (left, 96))
    _draw_bars(pen, evidence, names, bars_top)
    _draw_distance(pen, evidence, distance_top)
    _draw_legend(image, pen, limit, distance_top + _ROW + 30)
    note = f"{contract.claim[0].upper()}{contract.claim[1:]}{_ACCOUNT}" if losses is None else OCCLUSION_NOTE
    pen.text((_MARGIN, image.height - 18), note, DARK.dim, font(16), anchor="lm")
    return np.asarray(image)


def _draw_bars(pen: ImageDraw.ImageDraw, evidence: Evidence, names: list[str], top: int) -> None:
    """Draw for each part its evidence in the query's cells, its constant, and a mark at their sum."""
    left, right = 420, WIDTH - 190
    low, high = charts.evidence_span([evidence])
    scale = (right - left) / (high - low)
    zero = left - low * scale
    for part, name in enumerate(names):
        y = top + _ROW * part + 8
        total = float(evidence.weighted_cosines[part])
        pen.text(
            (_MARGIN, y + 9),
            f"part {name}" if len(names) > 1 else "whole",
            DARK.ink(theme.part_colour(part)),
            font(20),
            anchor="lm",
        )
        numbers = f"cos {evidence.cosines[part]:+.3f}"
        if len(names) > 1:
            numbers += f", weight {100 * evidence.weights[part]:.0f} %"
        pen.text((_MARGIN + 170, y + 9), numbers, DARK.dim, font(18), anchor="lm")
        for kind, begin, end in charts.evidence_segments(evidence, part):
            first, last = sorted((zero + begin * scale, zero + end * scale))
            if last - first >= 0.5:
                pen.rectangle((first, y, last, y + 18), fill=DARK.mark(_COLOURS[kind]))
        mark = zero + total * scale
        pen.rectangle((mark - 2, y - 5, mark + 1, y + 23), fill=DARK.text)
        pen.text((WIDTH - _MARGIN, y + 9), f"{total:+.3f}", DARK.text, font(20), anchor="rm")
    pen.line((zero, top, zero, top + _ROW * len(names) - 8), fill=DARK.dim)


def _draw_distance(pen: ImageDraw.ImageDraw, evidence: Evidence, top: int) -> None:
    """Draw the squared distance as the parts' contributions to it, side by side, each with its number where it fits."""
    contributions = evidence.contributions.astype(np.float32)
    left, right, y, total = 420, WIDTH - 190, top + 8, float(contributions.sum())
    pen.text(
        (_MARGIN, y + 9),
        "contributions to the squared distance" if len(contributions) > 1 else "squared distance",
        DARK.text,
        font(20),
        anchor="lm",
    )
    captions.draw_shares(pen, (left, y, right, y + 18), contributions, total)
    for part, (end, number) in enumerate(
        zip(np.cumsum(np.maximum(contributions, 0)), rounded_to_sum(contributions.tolist()), strict=True)
    ):
        width = (right - left) * max(float(contributions[part]), 0.0) / max(total, 1e-9)
        text = fitted(pen, f"{number:.3f}", 15, width - 4, "")
        pen.text(
            (left + (right - left) * float(end) / max(total, 1e-9) - width / 2, y + 9),
            text,
            theme.BACKGROUND,
            font(15),
            anchor="mm",
        )
    captions.draw_squared(pen, WIDTH - _MARGIN, y + 9, f"{total:.3f}", 20, DARK.text)


def _draw_legend(image: Image.Image, pen: ImageDraw.ImageDraw, limit: float, y: int) -> None:
    image.paste(Image.fromarray(overlays.evidence_scale(240, 16)), (_MARGIN + 78, y - 8))
    pen.text((_MARGIN, y), f"{-limit:+.4f}", DARK.dim, font(17), anchor="lm")
    pen.text((_MARGIN + 326, y), f"{limit:+.4f} of the score, each cell", DARK.dim, font(17), anchor="lm")
    x = _MARGIN + 600
    for label, colour in (*_COLOURS.items(), ("sum", DARK.text)):
        pen.rectangle((x, y - 8, x + 16, y + 8), fill=DARK.mark(colour))
        pen.text((x + 24, y), label, DARK.dim, font(17), anchor="lm")
        x += 62 + round(pen.textlength(label, font=font(17)))


def encode(picture: UInt8Array) -> bytes:
    """Encode a picture, (H, W, 3) uint8, as a PNG file."""
    return cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes()
