"""Sizes of the texts that are drawn into the map's pictures: no text is smaller than `LEAST` CSS pixels on the screen."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from explorer.stage.camera import FOV, SIGN_CAPTION, Viewpoint
from explorer.stage.viewport import Viewport

# The smallest text, in CSS pixels.
LEAST = 12
# The smallest side of a stage that texts are drawn for, in CSS pixels: for a smaller one they would burst their pictures.
_LEAST_SIDE = 240
# Size of the caption of the map's sign in pixels.
SIGN_PIXELS = 456, 252


@dataclass(frozen=True)
class Lettering:
    """Sizes of texts in pixels of their pictures.

    Attributes:
        sign: of the names on the map's sign.
        ground: CSS pixels of a stage unit on the whole map.
    """

    sign: int
    ground: float = field(compare=False)

    @classmethod
    def of(cls, viewport: Viewport) -> Lettering:
        """Return the sizes for a stage of the size that the page reports."""
        width, height = max(viewport.width, _LEAST_SIDE), max(viewport.height, _LEAST_SIDE)
        ground = height * Viewpoint().sign_share(width / height, FOV)
        return cls(legible(24, SIGN_PIXELS[0], SIGN_CAPTION * ground), ground)


def legible(size: int, pixels: float, css_pixels: float) -> int:
    """Return a text's size, at least `size`, in a picture that is `pixels` wide, and `css_pixels` CSS pixels on the screen."""
    return max(size, math.ceil(LEAST * pixels / css_pixels))
