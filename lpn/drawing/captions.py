"""Text drawn into pictures with Pillow."""

from __future__ import annotations

from functools import lru_cache

from PIL import ImageDraw, ImageFont


@lru_cache(maxsize=16)
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return Pillow's default typeface at a pixel size."""
    return ImageFont.load_default(size)


def fitted(draw: ImageDraw.ImageDraw, text: str, size: int, width: float) -> str:
    """Cut a text to a width in pixels, with an ellipsis.

    A text that would lose more than half is left out, because the rest would mislead.
    """
    if draw.textlength(text, font=font(size)) <= width:
        return text
    cut = text
    while cut and draw.textlength(cut + "...", font=font(size)) > width:
        cut = cut[:-1]
    return cut + "..." if 2 * len(cut) >= len(text) > 0 else ""
