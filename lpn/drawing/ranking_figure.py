"""A query beside its nearest tiles as one picture: their parts, ranks, and distances, and which one is true."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from lpn.core import images
from lpn.core.arrays import UInt8Array
from lpn.drawing import captions, overlays
from lpn.drawing.captions import fitted, font
from lpn.drawing.pair_figure import WIDTH
from lpn.drawing.part_areas import PartAreas
from lpn.drawing.theme import DARK, Palette, verdict_colour

_MARGIN, _GAP, _FRAME, _CAPTION = 24, 12, 6, 64
# Tiles in a row at most: below narrower ones there is no room for their ranks and distances.
_IN_A_ROW = 5


@dataclass(frozen=True)
class RankedTile:
    """A tile of the figure.

    Attributes:
        picture: as the model partitions it, (H, W, 3) uint8.
        areas: of its parts; None without boxes.
        name: its caption.
        rank: 1 for the nearest.
        distance2: d², 0 to 4.
        true: it shows the query's place.
    """

    picture: UInt8Array
    areas: PartAreas | None
    name: str
    rank: int
    distance2: float
    true: bool


def draw(
    query: UInt8Array, areas: PartAreas | None, title: str, tiles: Sequence[RankedTile], palette: Palette = DARK
) -> UInt8Array:
    """Draw the query and its tiles in rows of five, (H, 1200, 3) uint8.

    The frame of a true tile is yellow and has a tick below it; that of another one is blue and has a cross, as in the paper.

    Args:
        query: as the model partitions it, (H, W, 3) uint8.
        areas: of the query's parts.
        title: the query's caption.
        tiles: one at least, in the order of their ranks.
    """
    columns = min(len(tiles), _IN_A_ROW)
    width = (WIDTH - 2 * _MARGIN - _GAP * columns) // (columns + 1)
    height = round(width * query.shape[0] / query.shape[1])
    rows = math.ceil(len(tiles) / columns)
    image = Image.new("RGB", (WIDTH, 2 * _MARGIN + rows * (height + _CAPTION)), palette.background)
    pen, below = ImageDraw.Draw(image), _MARGIN + height
    drawn = overlays.with_parts(images.resize(query, height, width), areas)
    image.paste(Image.fromarray(drawn), (_MARGIN, _MARGIN))
    pen.text((_MARGIN, below + 18), "query", palette.text, font(17), anchor="lm")
    pen.text((_MARGIN, below + 44), fitted(pen, title, 15, width), palette.dim, font(15), anchor="lm")
    for place, tile in enumerate(tiles):
        row, column = divmod(place, columns)
        left, top = _MARGIN + (column + 1) * (width + _GAP), _MARGIN + row * (height + _CAPTION)
        below = top + height
        inside = width - 2 * _FRAME, height - 2 * _FRAME
        drawn = overlays.with_parts(images.resize(tile.picture, inside[1], inside[0]), tile.areas)
        pen.rectangle((left, top, left + width - 1, below - 1), fill=verdict_colour(tile.true))
        image.paste(Image.fromarray(drawn), (left + _FRAME, top + _FRAME))
        captions.draw_sign(pen, left, below + 11, 13, tile.true, palette)
        pen.text((left + 22, below + 18), f"{tile.rank}", palette.text, font(17), anchor="lm")
        captions.draw_squared(pen, left + width, below + 18, f"{tile.distance2:.3f}", 17, palette.text)
        pen.text((left, below + 44), _ending(pen, tile.name, width), palette.dim, font(15), anchor="lm")
    return np.asarray(image)


def _ending(pen: ImageDraw.ImageDraw, name: str, width: int) -> str:
    """Return the longest end of a name that fits, as tiles of one folder begin alike."""
    fits = (
        text
        for start in range(len(name))
        if pen.textlength(text := f"{'…' if start else ''}{name[start:]}", font=font(15)) <= width
    )
    return next(fits, "")
