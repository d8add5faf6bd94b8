"""A tilted photo, rectified to a view straight down for matching with a map."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from lpn.core.arrays import BoolArray, Float64Array, UInt8Array
from lpn.core.homography import apply_homography, inverse, middle_pixel
from lpn.flight.files import Frame
from lpn.flight.files.cameras import rotation
from lpn.flight.locate.matchers import Complex

# Least and most tilt in degrees of photos that are levelled, and the least angle below the horizon of ground in the result.
_LEAST_TILT, _MOST_TILT, _LOWEST_RAY = 15.0, 65.0, 28.0
# Largest side of a levelled photo, as a multiple of the photo's width.
_WIDEST = 4.0
# Rows of a photo whose rays are computed at once.
_ROWS = 256


@dataclass(frozen=True, eq=False)
class Levelled:
    """A levelled photo.

    Attributes:
        picture: (H, W, 3) uint8; its middle shows the same ground as the photo's.
        valid: pixels that the photo shows, (H, W).
        matrix: the homography from pixels of the photo to those of the picture, (3, 3).
        wider: metres of ground across the picture as a multiple of those across the photo's middle row.
    """

    picture: UInt8Array
    valid: BoolArray
    matrix: Float64Array
    wider: float

    def grid(self, steps: int) -> Float64Array:
        """Return pixels of the picture on a grid over its valid part, (N, 2)."""
        rows, columns = self.valid.shape
        points = pixel_grid((columns, rows), steps)
        return np.asarray(points[self.valid[points[:, 1].astype(int), points[:, 0].astype(int)]])


class PhotoView:
    """The conversion between pixels of a photo and points u of its registered picture, see `lpn.flight.locate.registration`.

    Args:
        size: width and height of the photo in pixels.
        levelled: the registered picture; None if the photo itself was registered.
    """

    def __init__(self, size: tuple[int, int], levelled: Levelled | None) -> None:
        self.size = size
        self._matrix = np.eye(3) if levelled is None else levelled.matrix
        rows, columns = size[::-1] if levelled is None else levelled.valid.shape
        self._columns, self._middle = columns, middle_pixel(columns, rows)

    def pixels(self, u: Complex) -> Float64Array:
        """Convert points u, (N,) complex, to pixels of the photo, (N, 2)."""
        of_picture = np.stack([u.real, -u.imag], axis=1) * self._columns + self._middle
        return apply_homography(inverse(self._matrix), of_picture)

    def units(self, pixels: Float64Array) -> Complex:
        """Convert pixels of the photo, (N, 2), to points u, (N,) complex."""
        x, y = ((apply_homography(self._matrix, pixels) - self._middle) / self._columns).T
        return np.asarray(x - 1j * y, np.complex128)


def level(photo: UInt8Array, frame: Frame, assumed: bool = False) -> Levelled | None:
    """Level a photo by its tilt.

    A pixel's ray is turned by the frame's pitch and roll, and meets a plane below the camera. Ground whose rays go down by less
    than 28 degrees is left out: it is too far away.

    Args:
        photo: (H, W, 3) uint8.
        assumed: whether the pitch is a guess about the camera, whatever the source of the heading.

    Returns:
        None unless pitch and field of view are known, the pitch is the camera's and not the aircraft's, and the tilt is between
        15 and 65 degrees.
    """
    if frame.pitch is None or frame.fov is None or (frame.heading_source == "aircraft" and not assumed):
        return None
    turn = rotation(0.0, frame.pitch, frame.roll or 0.0)
    if not math.cos(math.radians(_MOST_TILT)) <= turn[2, 2] <= math.cos(math.radians(_LEAST_TILT)):
        return None
    height, width = photo.shape[:2]
    focal = width / 2 / math.tan(math.radians(frame.fov) / 2)
    x, y = middle_pixel(width, height)
    body = np.array([[0, -1 / focal, y / focal], [1 / focal, 0, -x / focal], [0, 0, 1]])
    # Rays (north, east, down) with north along the heading become columns to the east and rows to the south.
    plane = np.array([[0, focal, 0], [-focal, 0, 0], [0, 0, 1]]) @ turn @ body
    pixels = pixel_grid((width, height), 33)
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ (turn @ body).T
    kept = _meets_ground(rays)
    if not kept.any():
        return None
    centre = apply_homography(plane, np.array([[x, y]]))[0]
    reach = np.abs(apply_homography(plane, pixels[kept]) - centre).max(axis=0)
    columns, rows = (min(round(2 * float(side)), round(_WIDEST * width)) for side in reach)
    moved = np.array([[1, 0, (columns - 1) / 2 - centre[0]], [0, 1, (rows - 1) / 2 - centre[1]], [0, 0, 1]])
    matrix = moved @ plane
    visible = np.empty((height, width), np.uint8)
    for top in range(0, height, _ROWS):  # to bound the memory
        block = pixel_grid((width, min(_ROWS, height - top))) + np.array([0, top])
        rays = np.column_stack([block, np.ones(len(block))]) @ (turn @ body).T
        visible[top : top + _ROWS] = _meets_ground(rays).reshape(-1, width)
    picture = cv2.warpPerspective(photo, matrix, (columns, rows), flags=cv2.INTER_LINEAR)
    valid = cv2.warpPerspective(visible, matrix, (columns, rows), flags=cv2.INTER_NEAREST) > 0
    across = 2 * math.tan(math.radians(frame.fov) / 2) / -math.sin(math.radians(frame.pitch))
    return Levelled(np.asarray(picture, np.uint8), np.asarray(valid), matrix, columns / focal / across)


def pixel_grid(size: tuple[int, int], steps: int | None = None) -> Float64Array:
    """Return pixels on a grid over a picture of a width and height, row by row, (N, 2); all pixels without `steps`."""
    sides = [np.linspace(0, side - 1, steps or side) for side in size]
    return np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)


def _meets_ground(rays: Float64Array) -> BoolArray:
    """Return a mask, (N,), of the rays (north, east, down), (N, 3), that go down steeply enough."""
    return np.asarray(rays[:, 2] >= math.sin(math.radians(_LOWEST_RAY)) * np.linalg.norm(rays, axis=1))
