"""The square that is cut from the middle of a frame, north up, to be compared with windows of a map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import cv2

from lpn.core import images
from lpn.core.arrays import UInt8Array
from lpn.flights.base import Frame
from lpn.flights.cameras import ground_width

# Side of the square as a share of a frame's shorter side. Its corners leave the picture at some headings.
CUT = 0.85


def cut_size(frame: Frame) -> float | None:
    """Return the side in metres of the square that is cut from a frame; None if its width on the ground is unknown."""
    width = ground_width(frame)
    return None if width is None else CUT * min(1.0, frame.height / frame.width) * width


def cut_square(picture: UInt8Array, heading: float, share: float, pixels: int) -> UInt8Array:
    """Turn a photo north-up and cut a square from its middle, (pixels, pixels, 3); beyond its edges it is mirrored.

    Args:
        heading: of the picture's top, degrees clockwise from north.
        share: of the picture's width that the square's side shows.
    """
    height, width = picture.shape[:2]
    side = share * width
    # Pixels are averaged before they are turned, so that fine texture does not alias.
    shrink = max(int(side / pixels), 1)
    if shrink > 1:
        size = (max(width // shrink, 1), max(height // shrink, 1))
        picture = cast(UInt8Array, cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
        side *= size[0] / width
        height, width = picture.shape[:2]
    scale = pixels / side
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), -heading, scale)
    matrix[:, 2] += ((pixels - width) / 2, (pixels - height) / 2)
    turned = cv2.warpAffine(
        picture, matrix, (pixels, pixels), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101
    )
    return cast(UInt8Array, turned)


@dataclass(frozen=True)
class TurnedFrame:
    """A frame turned north-up and cut to a square.

    Attributes:
        heading: of its top, degrees clockwise from north.
        share: of its width that the square shows.
        pixels: side of the square's picture.
    """

    frame: Frame
    heading: float
    share: float
    pixels: int

    def __call__(self) -> UInt8Array:
        """Return the square, (pixels, pixels, 3); PictureError if the frame cannot be read."""
        return cut_square(images.load_picture(self.frame.file), self.heading, self.share, self.pixels)
