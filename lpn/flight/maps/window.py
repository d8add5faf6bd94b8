"""A window of a map: a square on the ground, and the pixels of its picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import Float64Array
from lpn.core.errors import InputError
from lpn.core.homography import corner_pixels

_MAX_WINDOWS = 10**8
# A remainder below this share of a step gets no further row of windows: sheets lie askew in the frame by some pixels.
_SLACK = 0.01


@dataclass(frozen=True)
class Window:
    """A square on the ground in a map's frame.

    Attributes:
        x, y: its centre, metres east and north of the frame's origin.
        size: its side in metres.
        heading: direction of the cut picture's top, degrees clockwise from north.
    """

    x: float
    y: float
    size: float
    heading: float = 0.0

    def __post_init__(self) -> None:
        if not (all(map(math.isfinite, (self.x, self.y, self.heading))) and 0 < self.size < math.inf):
            raise InputError(
                f"A window has x, y {self.x:g}, {self.y:g}, size {self.size:g} and heading {self.heading:g}; expected finite "
                "numbers and a size above 0 m."
            )

    @property
    def corners(self) -> Float64Array:
        """Its corners on the ground, (4, 2) metres: top left, top right, bottom right, bottom left of the cut picture."""
        return self.to_ground(corner_pixels(1, 1), 1)

    def to_ground(self, points: npt.ArrayLike, pixels: int) -> Float64Array:
        """Convert points of the picture, `pixels` a side, to metres east and north, (N, 2).

        Args:
            points: (N, 2) column and row; whole numbers are the centres of pixels, as in OpenCV.
        """
        uv = np.asarray(points, np.float64).reshape(-1, 2)
        metres = self.size / pixels
        right, up = (uv[:, 0] + 0.5 - pixels / 2) * metres, (pixels / 2 - 0.5 - uv[:, 1]) * metres
        sine, cosine = math.sin(math.radians(self.heading)), math.cos(math.radians(self.heading))
        return np.stack([self.x + right * cosine + up * sine, self.y - right * sine + up * cosine], axis=1)

    def to_pixels(self, xy: npt.ArrayLike, pixels: int) -> Float64Array:
        """Convert points on the ground, (N, 2), to column and row, (N, 2); the inverse of `to_ground`."""
        points = np.asarray(xy, np.float64).reshape(-1, 2)
        metres = self.size / pixels
        east, north = points[:, 0] - self.x, points[:, 1] - self.y
        sine, cosine = math.sin(math.radians(self.heading)), math.cos(math.radians(self.heading))
        right, up = east * cosine - north * sine, east * sine + north * cosine
        return np.stack([right / metres + pixels / 2 - 0.5, pixels / 2 - 0.5 - up / metres], axis=1)


def grid(bounds: Sequence[float], size: float, step: float) -> Float64Array:
    """Return the centres, (N, 2) metres, of windows that cover a rectangle: rows from north to south, each from west to east.

    The grid is centred on the rectangle, and overhangs it by less than a step in all.

    Args:
        bounds: west, south, east, and north in metres.
        size: side of a window in metres.
        step: metres from one centre to the next.

    Raises:
        InputError: if size or step is not above 0, or more than 10^8 windows result.
    """
    if not (0 < size < math.inf and 0 < step < math.inf):
        raise InputError(
            f"Windows of {size:g} m every {step:g} m cannot be laid; expected a size and a step above 0 m."
        )
    middle = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    steps = [math.ceil((bounds[axis + 2] - bounds[axis] - size) / step - _SLACK) for axis in (0, 1)]
    columns, rows = (max(0, count) + 1 for count in steps)
    if columns * rows > _MAX_WINDOWS:
        raise InputError(f"Windows of {size:g} m every {step:g} m would be {columns * rows:.2g}; choose a larger step.")
    x, y = np.meshgrid(
        middle[0] + (np.arange(columns) - (columns - 1) / 2) * step,
        middle[1] - (np.arange(rows) - (rows - 1) / 2) * step,
    )
    return np.stack([x.ravel(), y.ravel()], axis=1)
