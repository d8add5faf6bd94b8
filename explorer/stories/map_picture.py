"""A picture of a plane, such as the ground: what lies on it, lines, dots, and on the ground a scale bar and a north arrow."""

from __future__ import annotations

import math
from collections.abc import Iterable

import cv2
import numpy as np
from PIL import Image, ImageDraw

from lpn.core.arrays import Float32Array, Float64Array, FloatingArray, UInt8Array
from lpn.drawing import captions, theme
from lpn.drawing.theme import Colour

SIZE = 1000, 620
WHITE: Colour = (245, 245, 245)
# The grey of places without a picture.
EMPTY = 26
# The longest scale bar, in pixels.
_BAR = 220
# Size of texts in pixels: 12 on a phone that shows the picture 360 pixels wide.
TEXT = 34

PlaneBounds = tuple[float, float, float, float]


class MapPicture:
    """A picture in which all given points are in sight; y points upwards.

    Args:
        points: (N, 2); NaN for what is unknown. At least one is known.
        border: the space around them, as a share.
        least: the smallest width, in units of the plane.
    """

    def __init__(self, points: FloatingArray, border: float, least: float = 0.0) -> None:
        known = points[np.isfinite(points).all(axis=1)]
        low, high = known.min(axis=0), known.max(axis=0)
        width, height = SIZE
        across, down = (high - low).tolist()
        self.middle: Float64Array = np.asarray((low + high) / 2, np.float64)
        # Units of the plane in a pixel.
        self.unit = max(across / width, down / height, least / width, 1e-12) * (1 + 2 * border)
        self._image = Image.new("RGB", SIZE, (EMPTY,) * 3)
        self.pen = ImageDraw.Draw(self._image)

    def pixels(self, point: FloatingArray) -> tuple[float, float]:
        """Return where a point of the plane lies."""
        x, y = ((point - self.middle) / self.unit).tolist()
        return SIZE[0] / 2 + x, SIZE[1] / 2 - y

    @property
    def bounds(self) -> PlaneBounds:
        """West, south, east, and north border in units of the plane."""
        half = np.array(SIZE) * self.unit / 2
        (west, south), (east, north) = (self.middle - half).tolist(), (self.middle + half).tolist()
        return west, south, east, north

    def lay(self, picture: UInt8Array, bounds: PlaneBounds) -> None:
        """Lay a picture, (H, W, 3), within its west, south, east, and north border; what was drawn before is lost."""
        canvas = np.full((SIZE[1], SIZE[0], 3), EMPTY, np.uint8)
        (rows, columns), (west, south, east, north) = picture.shape[:2], bounds
        corners = [self.pixels(np.array(corner)) for corner in ((west, north), (east, north), (west, south))]
        target: Float32Array = np.array(corners, np.float32)
        transform = cv2.getAffineTransform(np.array([(0, 0), (columns, 0), (0, rows)], np.float32), target)
        cv2.warpAffine(picture, transform, SIZE, canvas, cv2.INTER_CUBIC, cv2.BORDER_TRANSPARENT)
        self._image = Image.fromarray(canvas)
        self.pen = ImageDraw.Draw(self._image)

    def line(self, points: Iterable[FloatingArray], colour: Colour, width: int = 5) -> None:
        """Draw a line with a dark border, so that it can be seen on any ground."""
        along = [self.pixels(point) for point in points]
        self.pen.line(along, theme.BACKGROUND, width + 3, "curve")
        self.pen.line(along, colour, width, "curve")

    def dot(self, point: FloatingArray, colour: Colour, radius: float, hollow: bool = False) -> None:
        """Draw a dot, or a ring, with a dark border."""
        x, y = self.pixels(point)
        box = (x - radius, y - radius, x + radius, y + radius)
        if hollow:
            self.pen.ellipse(box, None, colour, 3)
        else:
            self.pen.ellipse(box, colour, theme.BACKGROUND, 2)

    def mark_ground(self) -> float:
        """Draw a scale bar and a north arrow for a plane in metres, and return the bar's metres."""
        power = 10.0 ** math.floor(math.log10(_BAR * self.unit))
        metres = next(n * power for n in (5, 2, 1) if n * power <= _BAR * self.unit)
        left, foot = 76, SIZE[1] - 22
        right = left + metres / self.unit
        arrow = [(34, foot - 62), (46, foot - 24), (34, foot - 34), (22, foot - 24)]
        for colour, width in ((theme.BACKGROUND, 7), (WHITE, 3)):
            self.pen.line([(left, foot - 9), (left, foot), (right, foot), (right, foot - 9)], colour, width)
        self.pen.polygon(arrow, WHITE, theme.BACKGROUND)
        words = f"{metres / 1000:g} km" if metres >= 1000 else f"{metres:g} m"
        for text, x, y, anchor in ((words, right + 14, foot - 6, "lm"), ("N", 34, foot - 4, "mm")):
            self.pen.text(
                (x, y), text, WHITE, captions.font(TEXT), anchor=anchor, stroke_width=3, stroke_fill=theme.BACKGROUND
            )
        return metres

    def picture(self) -> UInt8Array:
        """Return what was drawn, (H, W, 3) uint8."""
        return np.asarray(self._image)
