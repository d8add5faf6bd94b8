"""From where the browser looks at the map, and how pictures that stand on it are turned towards it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from explorer.stage.image_planes import Rotation
from lpn.core.arrays import AnyArray, Float64Array

AT = np.array([60.0, 0.0, 0.0])
"""The map lies this far from the compared pair, in stage units, so that neither is in the other's picture."""
SIDE = 8.0
"""Stage units of the longer side of the map."""
PICTURE = 2.1
"""Side of the pictures on the sign of the whole map, in stage units."""

_ABOVE_MAP = math.radians(38)
_OVER_ROOFS = math.radians(52)


@dataclass(frozen=True)
class Viewpoint:
    """A view of a part of the map from the south.

    Attributes:
        middle: of the part, in stage units east and north of the map's middle.
        side: how large it is, and with it all that stands on the map, in stage units.
        depth: its extent from south to north.
        tilt: radians from straight down.
        floating: whether the sign hangs along the top of what is seen, or stands on the far edge of the part.
    """

    middle: tuple[float, float] = (0.0, 0.0)
    side: float = SIDE
    depth: float = SIDE
    tilt: float = _ABOVE_MAP
    floating: bool = False

    @property
    def ratio(self) -> float:
        """Size of things, 1 where the whole map is seen."""
        return self.side / SIDE

    @property
    def above(self) -> Float64Array:
        """Unit vector of what is up in the browser's picture."""
        return np.array([0.0, math.cos(self.tilt), math.sin(self.tilt)])

    @property
    def towards(self) -> Rotation:
        """Sets a scene image upright in that picture."""
        half = (self.tilt + math.pi) / 2
        return math.cos(half), math.sin(half), 0.0, 0.0

    def sign(self, x: float, aspect: float) -> Float64Array:
        """Where the middle of a picture is that is `x` to the right on the sign, in units of the whole map."""
        if self.floating:
            start, up = self._target, self._height(aspect) - PICTURE / 2 - 0.1
        else:
            start, up = self._ground + np.array([0.0, self.depth / 2, 0.0]), PICTURE / 2 + 0.15
        return np.asarray(start + self.ratio * (np.array([x, 0.0, 0.0]) + up * self.above), np.float64)

    def camera(self, aspect: float, fov: float) -> tuple[AnyArray, AnyArray]:
        """Where the browser's camera stands and looks to have the part and the sign in view."""
        distance = self.ratio * self._height(aspect) / math.tan(fov / 2)
        target = self._target
        return target + distance * np.array([0.0, -math.sin(self.tilt), math.cos(self.tilt)]), target

    @property
    def _ground(self) -> Float64Array:
        return np.asarray(AT + np.array([*self.middle, 0.0]), np.float64)

    @property
    def _target(self) -> Float64Array:
        """What the camera looks at: between the part and the sign above it."""
        return np.asarray(self._ground + self.ratio * 0.5 * (PICTURE + 0.2) * self.above, np.float64)

    def _height(self, aspect: float) -> float:
        """Half of what is seen from bottom to top, in units of the whole map."""
        return max((SIDE * math.cos(self.tilt) + PICTURE) / 2 + 1.0, 4.7 / aspect)


def over(points: Float64Array, least: float) -> Viewpoint:
    """An oblique view that has all of some points (n, 3) in it, in stage units from the map's middle.

    Args:
        least: its smallest side.
    """
    seen = points[:, :2] + np.outer(points[:, 2] * math.tan(_OVER_ROOFS), (0.0, 1.0))  # what is high is seen further up
    low, high = seen.min(axis=0), seen.max(axis=0)
    side = max(float((high - low).max()), least)
    x, y = (round(float(value), 4) for value in (low + high) / 2)
    return Viewpoint((x, y), round(side, 4), round(side, 4), _OVER_ROOFS, True)
