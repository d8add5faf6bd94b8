"""A pair and its evidence as one picture: both photographs with their cells, a bar for each part, and d² as one bar."""

from __future__ import annotations

import cv2
import numpy as np
from PIL import Image, ImageDraw

from lpn.core import images
from lpn.core.arrays import Float32Array, UInt8Array
from lpn.core.numbers import rounded_to_sum
from lpn.core.views import View
from lpn.drawing import charts, overlays, theme, verdicts
from lpn.drawing.captions import fitted, font
from lpn.drawing.part_areas import PartAreas
from lpn.drawing.theme import AGAINST, DARK, FOR, UNKNOWN_COLOUR, Colour
from lpn.explain import Evidence
from lpn.models.contract import Contract

# In pixels: the figure, its margin, a part's row, and the ends of the bars.
WIDTH = 1200
_MARGIN, _ROW, _LEFT, _RIGHT = 24, 46, 420, WIDTH - 190
_COLOURS = {"cells for": FOR, "cells against": AGAINST, "constant": UNKNOWN_COLOUR}
_ACCOUNT = ": it accounts for the score; it does not say what the score would be without a cell."
OCCLUSION_NOTE = "Approximate: the measured loss of score where a square of the photo is blurred; the bars are exact."


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
        pictures: photo and tile as the model partitions them.
        titles: captions of photo and tile.
        views: the branches that described photo and tile.
        areas: of the parts of photo and tile.
        losses: of `lpn.explain.occlusion.occlude`; they replace the photo's evidence, and the tile then has none.
    """
    width = (WIDTH - 3 * _MARGIN) // 2
    height = round(width * contract.input_size[0] / contract.input_size[1])
    names, noun = contract.names(views[0]), contract.part_noun
    top = 136 + height
    figure = _Figure(top + _ROW * len(names) + 142)
    # Pillow's typeface has no minus sign.
    sentence = verdicts.describe_evidence(evidence, names, *views, noun).replace("−", "-")
    figure.write(_MARGIN, 32, sentence, 22, width=WIDTH - 2 * _MARGIN)
    maps = evidence.cell_maps()
    if losses is not None:
        maps = np.tensordot(evidence.weights.astype(np.float64), losses, 1), np.zeros((1, 1))
    limit = overlays.evidence_limit(*maps)
    for column, cells in enumerate(maps):
        left = _MARGIN + column * (width + _MARGIN)
        figure.write(left, 76, titles[column], 20, DARK.dim, width=width)
        drawn = overlays.with_evidence(images.resize(pictures[column], height, width), cells, limit)
        figure.paste(overlays.with_parts(drawn, areas[column]), left, 96)
    low, high = charts.evidence_span([evidence])
    scale = (_RIGHT - _LEFT) / (high - low)
    zero = _LEFT - low * scale
    for part, name in enumerate(names):
        y, total = top + _ROW * part + 17, float(evidence.weighted_cosines[part])
        title, cosine = f"{noun} {name}" if len(names) > 1 else "whole", f"cos {evidence.cosines[part]:+.3f}"
        weight = f", weight {100 * evidence.weights[part]:.0f} %" if len(names) > 1 else ""
        figure.write(_MARGIN, y, title, 20, DARK.ink(theme.part_colour(part)))
        figure.write(_MARGIN + 170, y, cosine + weight, 18, DARK.dim)
        for kind, begin, end in charts.evidence_segments(evidence, part):
            figure.bar(zero + begin * scale, zero + end * scale, y, _COLOURS[kind])
        figure.bar(zero + total * scale - 2, zero + total * scale + 2, y, DARK.text, 5)
        figure.write(WIDTH - _MARGIN, y, f"{total:+.3f}", 20, anchor="rm")
    y = top + _ROW * len(names)
    figure.pen.line((zero, top, zero, y - 8), fill=DARK.dim)
    figure.shares(evidence, noun, y + 17)
    y += 76
    figure.paste(overlays.evidence_scale(240, 16), _MARGIN + 78, y - 8)
    figure.write(_MARGIN, y, f"{-limit:+.4f}", 17, DARK.dim)
    figure.write(_MARGIN + 326, y, f"{limit:+.4f} of the score, each cell", 17, DARK.dim)
    x = _MARGIN + 600.0
    for label, colour in (*_COLOURS.items(), ("sum", DARK.text)):
        figure.bar(x, x + 16, y, colour)
        x = figure.write(x + 24, y, label, 17, DARK.dim) + 38
    note = f"{contract.claim[0].upper()}{contract.claim[1:]}{_ACCOUNT}" if losses is None else OCCLUSION_NOTE
    figure.write(_MARGIN, figure.image.height - 18, note, 16, DARK.dim)
    return np.asarray(figure.image)


class _Figure:
    """A picture with bars, and texts that are vertically centred at their `y`."""

    def __init__(self, height: int) -> None:
        self.image = Image.new("RGB", (WIDTH, height), DARK.background)
        self.pen = ImageDraw.Draw(self.image)

    def write(
        self,
        x: float,
        y: float,
        text: str,
        size: int,
        colour: Colour = DARK.text,
        anchor: str = "lm",
        width: float = WIDTH,
    ) -> float:
        """Write a text, cut to a width, and return its end."""
        text = fitted(self.pen, text, size, width)
        self.pen.text((x, y), text, colour, font(size), anchor=anchor)
        return x + self.pen.textlength(text, font=font(size))

    def paste(self, picture: UInt8Array, left: int, top: int) -> None:
        self.image.paste(Image.fromarray(picture), (left, top))

    def bar(self, begin: float, end: float, y: float, colour: Colour, higher: int = 0) -> None:
        first, last = sorted((begin, end))
        if last - first >= 0.5:
            self.pen.rectangle((first, y - 9 - higher, last - 1, y + 9 + higher), fill=DARK.mark(colour))

    def shares(self, evidence: Evidence, noun: str, y: float) -> None:
        """Draw the squared distance as the shares of the parts side by side, each with its number if that fits."""
        shares = evidence.contributions.tolist()
        total, end = sum(shares), float(_LEFT)
        title = f"shares of the {noun}s in the distance" if len(shares) > 1 else "distance"
        self.write(_MARGIN, y, title, 20)
        for part, (share, number) in enumerate(zip(shares, rounded_to_sum(shares), strict=True)):
            begin, end = end, end + (_RIGHT - _LEFT) * max(share, 0.0) / max(total, 1e-9)
            self.bar(begin, min(end, _RIGHT), y, theme.part_colour(part))
            if self.pen.textlength(f"{number:.3f}", font=font(15)) <= end - begin - 4:
                middle = (begin + end) / 2, y
                self.pen.text(middle, f"{number:.3f}", DARK.background, font(15), anchor="mm")
        self.write(WIDTH - _MARGIN, y, f"{total:.3f}", 20, anchor="rm")


def encode(picture: UInt8Array) -> bytes:
    """Encode a picture, (H, W, 3) uint8, as a PNG file."""
    return cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes()
