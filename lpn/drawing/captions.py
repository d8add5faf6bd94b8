"""Text drawn into pictures with Pillow."""

from __future__ import annotations

from functools import lru_cache

from PIL import Image, ImageDraw, ImageFont

from lpn.drawing.theme import DARK, Palette


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

    A text that would lose more than half is left out: "46 m ..." is no place.
    """
    for whole in (text, *shorter):
        if draw.textlength(whole, font=font(size)) <= width:
            return whole
    cut = (text, *shorter)[-1]
    while cut and draw.textlength(cut + "...", font=font(size)) > width:
        cut = cut[:-1]
    return cut + "..." if 2 * len(cut) >= len((text, *shorter)[-1]) > 0 else ""
