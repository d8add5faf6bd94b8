"""The picture of a photo that is matched with a map: a tilted photo is rectified to a view straight down."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np

from lpn.core.arrays import BoolArray, Float32Array, Float64Array, UInt8Array
from lpn.core.homography import apply_homography, inverse, middle_pixel, translation
from lpn.flight.files import Frame
from lpn.flight.files.cameras import rotation
from lpn.flight.locate.matchers import Complex, Matcher

# Least and most tilt in degrees of photos that are levelled, and the least angle below the horizon of ground in the result.
_LEAST_TILT, _MOST_TILT, _LOWEST_RAY = 15.0, 65.0, 28.0
# Largest side of a levelled photo, as a multiple of the photo's width.
_WIDEST = 4.0
# Rows of a photo whose rays are computed at once.
_ROWS = 256
# Maximum of a photo's features; more cost time, and raise the support of wrong places.
_FEATURES = 2048


@dataclass(frozen=True, eq=False)
class Described:
    """Features of a turned and resized picture: their points u, (N,), see `PhotoView.units`, and descriptors, (N, D)."""

    u: Complex
    descriptors: Float32Array


@dataclass(frozen=True, eq=False)
class PhotoView:
    """The picture of a photo that is registered: levelled, or the photo itself.

    Attributes:
        size: width and height of the photo in pixels.
        picture: (H, W, 3) uint8; its middle shows the same ground as the photo's middle.
        valid: pixels that the photo shows, (H, W); None for all.
        matrix: the homography from pixels of the photo to pixels of the picture, (3, 3).
        wider: metres of ground across the picture as a multiple of those across the photo's middle row.
    """

    size: tuple[int, int]
    picture: UInt8Array
    valid: BoolArray | None
    matrix: Float64Array
    wider: float
    _described: dict[tuple[str, int, float], Described] = field(default_factory=dict, init=False)

    @classmethod
    def plain(cls, photo: UInt8Array) -> PhotoView:
        """Return the view of a photo itself, (H, W, 3)."""
        return cls((photo.shape[1], photo.shape[0]), photo, None, np.eye(3), 1.0)

    @property
    def is_levelled(self) -> bool:
        """False if the picture is the photo itself."""
        return self.valid is not None

    def grid(self) -> Float64Array:
        """Return pixels of the picture on a grid over its valid part, (N, 2)."""
        rows, columns = self.picture.shape[:2]
        if self.valid is None:
            return _pixel_grid((columns, rows), 9)
        points = _pixel_grid((columns, rows), 25)
        return np.asarray(points[self.valid[points[:, 1].astype(int), points[:, 0].astype(int)]])

    def pixels(self, u: Complex) -> Float64Array:
        """Convert points u of the picture, (N,), see `lpn.flight.locate.registration`, to pixels of the photo, (N, 2)."""
        rows, columns = self.picture.shape[:2]
        of_picture = np.stack([u.real, -u.imag], axis=1) * columns + middle_pixel(columns, rows)
        return apply_homography(inverse(self.matrix), of_picture)

    def units(self, pixels: Float64Array) -> Complex:
        """Convert pixels of the photo, (N, 2), to points u of the picture, (N,) complex."""
        rows, columns = self.picture.shape[:2]
        x, y = ((apply_homography(self.matrix, pixels) - middle_pixel(columns, rows)) / columns).T
        return np.asarray(x - 1j * y, np.complex128)

    def described(self, matcher: Matcher, pixels: float, heading: float) -> Described:
        """Describe the picture, resized to a width in pixels, and turned north-up from a heading; each is described once."""
        height, width = self.picture.shape[:2]
        columns = int(np.clip(round(pixels), 64, width))
        key = (matcher.name, columns, heading % 360)
        if key in self._described:
            return self._described[key]
        rows = max(round(height * columns / width), 32)
        small = cv2.resize(self.picture, (columns, rows), interpolation=cv2.INTER_AREA)
        matrix = cv2.getRotationMatrix2D(((columns - 1) / 2, (rows - 1) / 2), -heading, 1.0)
        valid = None
        if self.valid is not None:
            valid = cv2.resize(self.valid.astype(np.uint8), (columns, rows), interpolation=cv2.INTER_NEAREST)
        if heading % 360:
            cos, sin = abs(matrix[0, 0]), abs(matrix[0, 1])
            canvas = (round(rows * sin + columns * cos), round(rows * cos + columns * sin))
            matrix[:, 2] += (np.array(canvas) - (columns, rows)) / 2
            small = cv2.warpAffine(small, matrix, canvas, flags=cv2.INTER_LINEAR)
            whole = np.ones((rows, columns), np.uint8) if valid is None else valid
            valid = cv2.warpAffine(whole, matrix, canvas, flags=cv2.INTER_NEAREST)
        features = matcher.features(np.asarray(small, np.uint8), None if valid is None else valid > 0, _FEATURES)
        points = (features.points - matrix[:, 2]) @ np.linalg.inv(matrix[:, :2]).T
        x, y = points[:, 0] - (columns - 1) / 2, (rows - 1) / 2 - points[:, 1]
        self._described[key] = seen = Described(((x + 1j * y) / columns).astype(np.complex128), features.descriptors)
        return seen


def level(photo: UInt8Array, frame: Frame) -> PhotoView:
    """Level a photo by its tilt, if pitch and field of view are known and the tilt is between 15 and 65 degrees.

    A pixel's ray is turned by the frame's pitch and roll, and meets a plane below the camera. Ground whose rays go down by less
    than 28 degrees is left out: it is too far away.

    Args:
        photo: (H, W, 3) uint8.
        frame: with its pitch; a photo with an aircraft's pitch is not levelled.
    """
    height, width = photo.shape[:2]
    plain = PhotoView.plain(photo)
    if frame.pitch is None or frame.fov is None or frame.heading_source == "aircraft":
        return plain
    turn = rotation(0.0, frame.pitch, frame.roll or 0.0)
    if not math.cos(math.radians(_MOST_TILT)) <= turn[2, 2] <= math.cos(math.radians(_LEAST_TILT)):
        return plain
    half = math.tan(math.radians(frame.fov) / 2)
    focal, (x, y) = width / 2 / half, middle_pixel(width, height)
    body = np.array([[0, -1 / focal, y / focal], [1 / focal, 0, -x / focal], [0, 0, 1]])
    # Rays (north, east, down) with north along the heading become columns to the east and rows to the south.
    plane = np.array([[0, focal, 0], [-focal, 0, 0], [0, 0, 1]]) @ turn @ body

    def shown(pixels: Float64Array) -> BoolArray:
        rays = np.column_stack([pixels, np.ones(len(pixels))]) @ (turn @ body).T
        return np.asarray(rays[:, 2] >= math.sin(math.radians(_LOWEST_RAY)) * np.linalg.norm(rays, axis=1))

    pixels = _pixel_grid((width, height), 33)
    kept = shown(pixels)
    if not kept.any():
        return plain
    centre = apply_homography(plane, np.array([[x, y]]))[0]
    reach = np.abs(apply_homography(plane, pixels[kept]) - centre).max(axis=0)
    columns, rows = (min(round(2 * float(side)), round(_WIDEST * width)) for side in reach)
    matrix = translation(middle_pixel(columns, rows) - centre) @ plane
    visible = np.empty((height, width), np.uint8)
    for top in range(0, height, _ROWS):  # to bound the memory
        block = _pixel_grid((width, min(_ROWS, height - top))) + np.array([0, top])
        visible[top : top + _ROWS] = shown(block).reshape(-1, width)
    picture = cv2.warpPerspective(photo, matrix, (columns, rows), flags=cv2.INTER_LINEAR)
    valid = cv2.warpPerspective(visible, matrix, (columns, rows), flags=cv2.INTER_NEAREST) > 0
    across = -2 * half / math.sin(math.radians(frame.pitch))
    return PhotoView(
        (width, height), np.asarray(picture, np.uint8), np.asarray(valid), matrix, columns / focal / across
    )


def _pixel_grid(size: tuple[int, int], steps: int | None = None) -> Float64Array:
    """Return pixels on a grid over a picture of a width and height, row by row, (N, 2); all pixels without `steps`."""
    sides = [np.linspace(0, side - 1, steps or side) for side in size]
    return np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
