"""The cameras of a flight over the ground: the pyramid of each solved pose, and the border of what each photo shows."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.flights.cameras import rotation
from lpn.locate.camera_pose import CameraPose

# Straight pieces of each side of a photo's border.
_PIECES = 6


def frustum(pose: CameraPose, aspect: float, depth: float) -> Float64Array:
    """Return the edges of a camera's pyramid, (8, 2, 3) metres east, north, and of altitude.

    Args:
        aspect: width of the photo over its height.
        depth: metres from the camera to the pyramid's base.
    """
    north_east_down = rotation(pose.heading, pose.pitch, pose.roll)
    up, right, forward = (north_east_down[[1, 0, 2]] * [[1], [1], [-1]]).T
    across = math.tan(math.radians(pose.fov) / 2)
    eye = np.array([pose.east, pose.north, pose.altitude])
    signs = ((-1, 1), (1, 1), (1, -1), (-1, -1))
    corners = [eye + depth * (forward + x * across * right + y * across / aspect * up) for x, y in signs]
    return np.array([(eye, corner) for corner in corners] + [(corners[i - 1], corners[i]) for i in range(4)])


def border(
    corners: Float64Array, heights: Callable[[Float64Array], Float64Array] | None, pieces: int = _PIECES
) -> Float64Array:
    """Return the border of the ground that a photo shows in straight pieces, (K, 2, 3) metres east, north, and of altitude.

    Args:
        corners: (4, 2) metres in the map's frame.
        heights: of places (N, 2), NaN where they are unknown; pieces without heights are left out. None is flat ground.
        pieces: straight ones of each side.
    """
    steps = np.arange(pieces)[:, None] / pieces
    sides = [corners[i] + steps * (corners[(i + 1) % 4] - corners[i]) for i in range(4)]
    places = np.concatenate([*sides, corners[:1]])
    up = np.zeros(len(places)) if heights is None else heights(places)
    points = np.column_stack([places, up])
    lines = np.stack([points[:-1], points[1:]], axis=1)
    return np.asarray(lines[np.isfinite(lines).all(axis=(1, 2))], np.float64)
