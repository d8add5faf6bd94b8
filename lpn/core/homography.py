"""Homographies between two planes, in double precision, and the corners of a picture in pixels.

Points of a picture are column and row; whole numbers are the centres of pixels, as in OpenCV.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import Float64Array


def corner_pixels(width: float, height: float) -> Float64Array:
    """Return the corners of a picture, (4, 2): top left, top right, bottom right, bottom left."""
    return np.array([(0, 0), (width, 0), (width, height), (0, height)]) - 0.5


def middle_pixel(width: float, height: float) -> Float64Array:
    """Return the middle of a picture, (2,)."""
    return (np.array([width, height]) - 1) / 2


def four_point_homography(source: npt.ArrayLike, target: npt.ArrayLike) -> Float64Array:
    """Return the homography, (3, 3), that maps four points, (4, 2), to four others, (4, 2)."""
    corners = np.asarray(target, np.float64)
    (u, v), (x, y) = (
        np.asarray(source, np.float64).T,
        (corners - corners[0]).T,
    )  # small numbers keep the equations solvable
    zero, one = np.zeros(4), np.ones(4)
    along = np.stack([u, v, one, zero, zero, zero, -u * x, -v * x], axis=1)
    across = np.stack([zero, zero, zero, u, v, one, -u * y, -v * y], axis=1)
    solution = np.linalg.solve(np.concatenate([along, across]), np.concatenate([x, y]))
    return np.asarray(translation(corners[0]) @ np.append(solution, 1.0).reshape(3, 3))


def apply_homography(homography: Float64Array, points: npt.ArrayLike) -> Float64Array:
    """Map points, (..., 2), by a homography, (3, 3)."""
    mapped = np.asarray(points, np.float64) @ homography[:, :2].T + homography[:, 2]
    return np.asarray(mapped[..., :2] / mapped[..., 2:], np.float64)


def inverse(homography: Float64Array) -> Float64Array:
    """Return the inverse of a homography, (3, 3)."""
    return np.asarray(np.linalg.inv(homography), np.float64)


def translation(by: npt.ArrayLike) -> Float64Array:
    """Return the homography, (3, 3), that moves points by (2,)."""
    matrix = np.eye(3)
    matrix[:2, 2] = by
    return matrix
