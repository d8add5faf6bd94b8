"""Text, signs, and bars drawn into pictures with Pillow."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lpn.core.arrays import Float32Array, UInt8Array
from lpn.drawing.part_areas import PartAreas
from lpn.drawing.theme import BACKGROUND, DARK, TEXT, Colour, Palette, part_colour, verdict_colour


@lru_cache(maxsize=16)
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return Pillow's own typeface at a pixel size."""
    return ImageFont.load_default(size)


def caption(width: int, height: int, palette: Palette = DARK) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    """Return an empty caption with its drawing context."""
    image = Image.new("RGB", (width, height), palette.background)
    return image, ImageDraw.Draw(image)


def fitted(draw: ImageDraw.ImageDraw, text: str, size: int, width: float, *shorter: str) -> str:
    """Return the first of several texts that fits a width in pixels; else the last, with an ellipsis.

    Nothing is left of a text that less than half would be left of: "46 m ..." is no place.
    """
    for whole in (text, *shorter):
        if draw.textlength(whole, font=font(size)) <= width:
            return whole
    cut = (text, *shorter)[-1]
    while cut and draw.textlength(cut + "...", font=font(size)) > width:
        cut = cut[:-1]
    return cut + "..." if 2 * len(cut) >= len((text, *shorter)[-1]) > 0 else ""


def numbered(picture: UInt8Array, number: int, size: int = 30) -> UInt8Array:
    """Write a number of a size in pixels on a dark patch in the top left corner of an RGB or RGBA picture."""
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    width = draw.textlength(str(number), font=font(size))
    draw.rectangle((5, 5, 13 + width, 8 + size), fill=BACKGROUND)
    draw.text((9, 6 + size / 2), str(number), TEXT, font(size), anchor="lm")
    return np.asarray(image)


def with_part_numbers(
    picture: UInt8Array, areas: PartAreas | None, names: Sequence[str], turn: float = 0.0, size: int = 22
) -> UInt8Array:
    """Write the number of each part at the upper border of its box, in its colour; nothing without boxes.

    Args:
        names: of the parts; a name that begins with a number is written as that number, another one as the part's position.
        turn: degrees by which the picture will be turned counterclockwise, after which the numbers are upright.
        size: of the numbers in pixels.
    """
    image = Image.fromarray(picture)
    for part, (left, top, right, _) in enumerate([] if areas is None else areas.outlines):
        first = names[part].split(" ")[0]
        patch = Image.new("RGBA", (size + 4, size + 4))
        draw = ImageDraw.Draw(patch)
        draw.ellipse((0, 0, size + 3, size + 3), fill=BACKGROUND)
        middle = size / 2 + 2
        text = first if first.isdigit() else str(part + 1)
        draw.text((middle, middle), text, part_colour(part), font(round(0.8 * size)), anchor="mm")
        patch = patch.rotate(-turn, Image.Resampling.BICUBIC)
        at = round((left + right) / 2 * image.width - middle), round(top * image.height + 5)
        image.paste(patch, at, patch)
    return np.asarray(image)


def draw_sign(
    draw: ImageDraw.ImageDraw, x: float, y: float, size: float, true: bool | None, palette: Palette = DARK
) -> None:
    """Draw a tick (true) or a cross (false) with its top left corner at (x, y): a second sign beside the colour."""
    colour, width = palette.ink(verdict_colour(true)), max(2, round(size / 6))
    if true:
        draw.line(
            [(x, y + 0.55 * size), (x + 0.4 * size, y + 0.9 * size), (x + size, y + 0.1 * size)], colour, width, "curve"
        )
    elif true is not None:
        draw.line([(x, y), (x + size, y + size)], colour, width)
        draw.line([(x + size, y), (x, y + size)], colour, width)


def draw_squared(draw: ImageDraw.ImageDraw, right: float, middle: float, text: str, size: int, fill: Colour) -> float:
    """Write "d² text" so that it ends at `right`, and return where it begins; Pillow's typeface has no superscript two."""
    draw.text((right, middle), text, fill, font(size), anchor="rm")
    left = right - draw.textlength(text, font=font(size)) - 0.35 * size
    draw.text((left, middle - 0.3 * size), "2", fill, font(round(0.62 * size)), anchor="rm")
    left -= draw.textlength("2", font=font(round(0.62 * size))) + 1
    draw.text((left, middle), "d", fill, font(size), anchor="rm")
    return left - draw.textlength("d", font=font(size))


def draw_shares(
    draw: ImageDraw.ImageDraw,
    box: tuple[float, float, float, float],
    contributions: Float32Array,
    full: float,
    palette: Palette = DARK,
) -> None:
    """Draw the parts' shares of a squared distance side by side; `full` is the distance that fills the box."""
    left, top, right, bottom = box
    draw.rectangle(box, fill=palette.track)
    for part, share in enumerate(contributions):
        end = left + max(float(share), 0.0) / max(full, 1e-9) * (right - box[0])
        if end - left >= 0.5:
            draw.rectangle((left, top, min(end, right), bottom), fill=palette.mark(part_colour(part)))
        left = end
