"""The north-up square in the middle of a frame, which is compared with windows of a map."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import cast

import cv2

from lpn.core import images
from lpn.core.arrays import UInt8Array
from lpn.flight.files.base import Frame
from lpn.flight.files.cameras import ground_width

# Numbers of pictures that a `FrameReader` keeps, and of its locks.
_KEPT, _LOCKS = 8, 16
# Side of the square as a share of a frame's shorter side. Its corners leave the picture at some headings.
CUT = 0.85


def cut_size(frame: Frame) -> float | None:
    """Return the side in metres of a frame's square; None if its width on the ground is unknown."""
    width = ground_width(frame)
    return None if width is None else CUT * min(1.0, frame.height / frame.width) * width


def cut_square(picture: UInt8Array, heading: float, share: float, pixels: int) -> UInt8Array:
    """Turn a photo north-up and cut a square from its middle, (pixels, pixels, 3); beyond its edges it is mirrored.

    Args:
        heading: of the picture's top, degrees clockwise from north.
        share: the square's side as a share of the picture's width.
    """
    picture = _reduced(picture, share, pixels)
    height, width = picture.shape[:2]
    scale = pixels / (share * width)
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), -heading, scale)
    matrix[:, 2] += ((pixels - width) / 2, (pixels - height) / 2)
    turned = cv2.warpAffine(
        picture, matrix, (pixels, pixels), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101
    )
    return cast(UInt8Array, turned)


def _reduced(picture: UInt8Array, share: float, pixels: int) -> UInt8Array:
    """Average pixels before the turn, so that fine texture does not alias; a reduced picture is returned unchanged."""
    height, width = picture.shape[:2]
    shrink = max(int(share * width / pixels), 1)
    if shrink == 1:
        return picture
    size = (max(width // shrink, 1), max(height // shrink, 1))
    return cast(UInt8Array, cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


class FrameReader:
    """Cuts squares from frames, see `cut_square`; a frame that is cut at several headings is read and reduced once.

    Threads can share it. It keeps the last eight pictures.

    Args:
        pixels: side of the squares.
    """

    def __init__(self, pixels: int) -> None:
        self._pixels = pixels
        self._read = lru_cache(_KEPT)(lambda file, share: _reduced(images.load_picture(file), share, pixels))
        # Threads that cut one frame read it once; threads that cut different frames rarely wait for each other.
        self._locks = [threading.Lock() for _ in range(_LOCKS)]

    def __call__(self, file: Path, heading: float, share: float) -> UInt8Array:
        with self._locks[hash(file) % _LOCKS]:
            picture = self._read(file, share)
        return cut_square(picture, heading, share, self._pixels)


@dataclass(frozen=True)
class TurnedFrame:
    """A frame turned north-up and cut to a square.

    Attributes:
        heading: of its top, degrees clockwise from north.
        share: the square's side as a share of the frame's width.
        pixels: side of the square's picture.
    """

    frame: Frame
    heading: float
    share: float
    pixels: int

    def __call__(self) -> UInt8Array:
        return cut_square(images.load_picture(self.frame.file), self.heading, self.share, self.pixels)
