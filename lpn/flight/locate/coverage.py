"""The ground of each frame, and the frames that show a spot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.homography import apply_homography, corner_pixels, middle_pixel
from lpn.flight.files import footprint
from lpn.flight.locate.corrections import ground_middle
from lpn.flight.locate.located import LocatedFrame


@dataclass(frozen=True, eq=False)
class Outline:
    """The ground that a frame shows.

    Attributes:
        corners: (4, 2) metres in the map's frame: top left, top right, bottom right, bottom left of the picture.
        registered: True if by an accepted registration, False if by position, height, angles, and field of view.
    """

    corners: Float64Array
    registered: bool


def outline(located: LocatedFrame) -> Outline | None:
    """Return the ground of a frame by its registration, else by the camera's model; None with neither.

    The camera's model starts from the tag. Without a tag, the ground's middle is the sequence's answer, if that is accepted.
    """
    answer = located.stages.get("registration")
    if answer is not None and answer.matrix is not None:
        corners = corners_of(answer.matrix, located.frame.width, located.frame.height)
        return None if corners is None else Outline(corners, True)
    corners = footprint(located.frame)
    if corners is None:
        return None
    if located.tag is not None:
        return Outline(corners + located.tag, False)
    answer = located.stages.get("sequence")
    if answer is None or not answer.accepted or answer.place is None:
        return None
    return Outline(corners - ground_middle(corners) + answer.place, False)


def corners_of(homography: Float64Array, width: int, height: int) -> Float64Array | None:
    """Return the corners of a picture on the ground, (4, 2) metres; None if a corner lies beyond the horizon.

    Args:
        homography: from pixels (column, row; whole numbers are the centres of pixels) to metres, (3, 3).
        width, height: of the picture in pixels.
    """
    pixels = corner_pixels(width, height)
    depths = np.array([*pixels, middle_pixel(width, height)]) @ homography[2, :2] + homography[2, 2]
    return None if (depths[:4] * depths[4] <= 1e-9 * depths[4] ** 2).any() else apply_homography(homography, pixels)


def seen_by(outlines: Sequence[Outline | None], x: float, y: float) -> list[int]:
    """Return the indices of the outlines, borders included, that contain a spot in metres of the map's frame."""
    # Corners are relative to the spot, because OpenCV computes in single precision.
    known = {i: (one.corners - (x, y)).astype(np.float32) for i, one in enumerate(outlines) if one is not None}
    return [i for i, corners in known.items() if cv2.pointPolygonTest(corners, (0.0, 0.0), False) >= 0]
