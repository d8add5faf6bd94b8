"""Pictures on planes in the 3-D stage, and the captions drawn for them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import viser
from PIL import ImageDraw

from explorer.layout import CAPTION, Box
from lpn.core.arrays import UInt8Array
from lpn.drawing import captions, words
from lpn.drawing.theme import Palette
from lpn.retrieval import Match

# Height of a caption in pixels, and its text's size: it is drawn twice as fine as the screen.
CAPTION_PIXELS, _CAPTION_TEXT = 2 * CAPTION, 28
# The grey of a plane whose picture is on its way, for bright and dark pages.
_SKELETON = 128
# A quaternion (w, x, y, z).
Rotation = tuple[float, float, float, float]
# Scene images have y down and face away from +z; half a turn about x sets them upright, facing the camera.
UPRIGHT: Rotation = (0.0, 1.0, 0.0, 0.0)


class Plane:
    """A picture on the stage, sent again only when its pixels change; the encoding "png" supports transparency."""

    def __init__(
        self,
        scene: viser.SceneApi,
        name: str,
        width: float,
        height: float,
        position: tuple[float, float, float],
        encoding: Literal["jpeg", "png"] = "jpeg",
    ) -> None:
        blank = np.full((2, 2, 3), _SKELETON, np.uint8)
        self._picture: UInt8Array = blank
        self.handle = scene.add_image(
            name,
            blank,
            width,
            height,
            format=encoding,
            jpeg_quality=88,
            cast_shadow=False,
            receive_shadow=False,
            wxyz=UPRIGHT,
            position=position,
        )

    def place(self, box: Box) -> None:
        """Move the plane to a box of the stage."""
        (x, y), (width, height) = box
        self.handle.position = (x, y, 0.0)
        self.handle.render_width, self.handle.render_height = width, height

    def show(self, picture: UInt8Array) -> None:
        """Put a picture on the plane."""
        if self._picture.shape != picture.shape or not np.array_equal(self._picture, picture):
            self._picture = picture
            self.handle.image = picture


def rank_title(match: Match, own: bool = False) -> str:
    """Return the rank of a compared tile as a headline.

    Args:
        own: of the user's own picture, whose place may be on none of the tiles.
    """
    plainly = "MOST SIMILAR" if own else "MATCH"
    return f"{plainly if words.plain() else 'RANK'} {match.rank}"


def query_title() -> str:
    """Return what the query is called as a headline."""
    return words.say("query").upper()


def title(
    headline: str,
    texts: Sequence[str],
    true: bool | None,
    palette: Palette,
    width: float,
    distance2: float | None = None,
) -> UInt8Array:
    """Draw a caption: headline, sign, a text, and on the right a distance d².

    Args:
        texts: of which the first that fits is drawn, see `captions.fitted`.
        width: of the caption on the screen, in CSS pixels.
    """
    size, width = _CAPTION_TEXT, round(2 * width)
    image, draw = captions.caption(width, CAPTION_PIXELS, palette)
    middle = CAPTION_PIXELS / 2
    draw.text((2, middle), headline, palette.text, captions.font(size + 1), anchor="lm")
    x = 2 + draw.textlength(headline, font=captions.font(size + 1)) + size / 2
    if true is not None:
        captions.draw_sign(draw, x, middle - 0.4 * size, 0.8 * size, true, palette)
        x += 1.3 * size
    right = width - 2.0
    if distance2 is not None:
        right = _draw_distance(draw, (x, right), middle, distance2, palette) - size / 2
    text = captions.fitted(draw, texts[0], size, right - x, *texts[1:])
    draw.text((x, middle + 1), text, palette.dim, captions.font(size), anchor="lm")
    return np.asarray(image)


def _draw_distance(
    draw: ImageDraw.ImageDraw, room: tuple[float, float], middle: float, distance2: float, palette: Palette
) -> float:
    """Draw a distance d² at the right of a room, by its plain word where that is spoken and fits; return where it begins."""
    left, right = room
    if not words.plain():
        return captions.draw_squared(draw, right, middle, f"{distance2:.3f}", _CAPTION_TEXT, palette.text)
    text, font = f"{words.say('d²')} {distance2:.3f}", captions.font(_CAPTION_TEXT)
    if draw.textlength(text, font=font) > right - left:
        text = f"{distance2:.3f}"
    draw.text((right, middle), text, palette.text, font, anchor="rm")
    return right - draw.textlength(text, font=font)
