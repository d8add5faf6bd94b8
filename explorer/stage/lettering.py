"""Sizes of the texts that are drawn into the stage's pictures: no text is smaller than `LEAST` CSS pixels on the screen."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from explorer.layout import CAPTION, ScreenLayout
from explorer.stage.camera import FOV, HEIGHT, SIGN_CAPTION, WIDTH, Viewpoint
from explorer.stage.image_planes import CAPTION_PIXELS
from explorer.stage.viewport import Viewport

# The smallest text, in CSS pixels.
LEAST = 12
# The smallest side of a stage that texts are drawn for, in CSS pixels: for a smaller one they would burst their pictures.
_LEAST_SIDE = 240
# Sizes of pictures with text, in pixels: the caption of the map's sign, the bars between the compared pictures.
SIGN_PIXELS = 456, 252
GUTTER_COLUMN, GUTTER_ROW = (260, 660), 1280
LABEL_HEIGHT = 58


@dataclass(frozen=True)
class Lettering:
    """Sizes of texts in pixels of their pictures.

    Attributes:
        caption: above the compared pair.
        part, share: a part's name and its share, between the pictures.
        label: of a ranked tile.
        sign: of the names on the map's sign.
        ground: CSS pixels of a stage unit on the whole map.
    """

    caption: int
    part: int
    share: int
    label: int
    sign: int
    ground: float = field(compare=False)

    @classmethod
    def of(cls, layout: ScreenLayout, parts: int, viewport: Viewport) -> Lettering:
        """Return the sizes for a stage of the size that the page reports."""
        width, height = max(viewport.width, _LEAST_SIDE), max(viewport.height, _LEAST_SIDE)
        unit = min(width / WIDTH, height / HEIGHT)
        ground = height * Viewpoint().sign_share(width / height, FOV)
        if layout.stacked:
            (part, share), gutter = ((19, 15) if parts > 6 else (24, 20)), GUTTER_ROW
        else:
            (part, share), gutter = ((26, 24) if parts > 6 else (36, 34)), GUTTER_COLUMN[0]
        across = layout.gutter[1][0] * unit
        return cls(
            legible(27, CAPTION_PIXELS[0], CAPTION[0] * unit),
            legible(part, gutter, across),
            legible(share, gutter, across),
            legible(32, label_width(layout), layout.card[0] * unit),
            legible(24, SIGN_PIXELS[0], SIGN_CAPTION * ground),
            ground,
        )


def label_width(layout: ScreenLayout) -> int:
    """Return the width of a ranked tile's label in pixels."""
    return round(LABEL_HEIGHT * layout.card[0] / layout.card[2])


def legible(size: int, pixels: float, css_pixels: float) -> int:
    """Return a text's size, at least `size`, in a picture that is `pixels` wide, and `css_pixels` CSS pixels on the screen."""
    return max(size, math.ceil(LEAST * pixels / css_pixels))
