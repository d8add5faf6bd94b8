"""Camera views of the map, and the orientation of pictures that face the camera."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from explorer.stage.image_planes import Rotation
from lpn.core.arrays import AnyArray, Float64Array

# Centre of the map in stage units, so far from the compared pair that the camera never shows both.
MAP_CENTRE = np.array([60.0, 0.0, 0.0])
# Longer side of the map, in stage units.
SIDE = 8.0
# Side of a picture on the sign when the view shows the whole map, in stage units.
SIGN_PICTURE = 2.1
# Width of the sign's caption, between its two pictures.
SIGN_CAPTION = SIDE - 2 * SIGN_PICTURE
# The camera's field of view from bottom to top, in radians.
FOV = 0.45

_MAP_TILT = math.radians(38)
_CITY_TILT = math.radians(52)


@dataclass(frozen=True)
class Viewpoint:
    """A view from the south of a square part of the map, with a sign that shows the query and the compared tile.

    Attributes:
        middle: centre of the part, in stage units east and north of the map's centre.
        side: side of the part in stage units; everything on the map scales with it.
        depth: extent of the part from south to north, in stage units.
        tilt: angle of the view from straight down, in radians.
        floating: True to hang the sign along the top of the view, False to stand it on the far edge of the part.
    """

    middle: tuple[float, float] = (0.0, 0.0)
    side: float = SIDE
    depth: float = SIDE
    tilt: float = _MAP_TILT
    floating: bool = False

    @property
    def scale(self) -> float:
        """Scale of everything on the map; 1 for the whole map."""
        return self.side / SIDE

    @property
    def up(self) -> Float64Array:
        """Unit vector that points up in the view, (3,)."""
        return np.array([0.0, math.cos(self.tilt), math.sin(self.tilt)])

    @property
    def image_rotation(self) -> Rotation:
        """Rotation of a scene image that faces the camera upright."""
        half = (self.tilt + math.pi) / 2
        return math.cos(half), math.sin(half), 0.0, 0.0

    def sign_position(self, x: float, aspect: float) -> Float64Array:
        """Return the centre, (3,), of a picture that is `x` to the right on the sign, in the units of the whole map."""
        if self.floating:
            start, height = self._target, self._height(aspect) - SIGN_PICTURE / 2 - 0.1
        else:
            start, height = self._ground + np.array([0.0, self.depth / 2, 0.0]), SIGN_PICTURE / 2 + 0.15
        return np.asarray(start + self.scale * (np.array([x, 0.0, 0.0]) + height * self.up), np.float64)

    def camera(self, aspect: float, fov: float) -> tuple[AnyArray, AnyArray]:
        """Return the camera's position and target, (3,) each, with the part and the sign in view."""
        distance = self.scale * self._height(aspect) / math.tan(fov / 2)
        target = self._target
        return target + distance * np.array([0.0, -math.sin(self.tilt), math.cos(self.tilt)]), target

    def sign_share(self, aspect: float, fov: float) -> float:
        """Return the share of the view's height that a unit of the sign takes, in the units of the whole map."""
        height = self._height(aspect)
        distance = height / math.tan(fov / 2)
        behind = 0.0 if self.floating else self.depth / 2 * math.sin(self.tilt) / self.scale
        return distance / (distance + behind) / (2 * height)

    @property
    def _ground(self) -> Float64Array:
        return np.asarray(MAP_CENTRE + np.array([*self.middle, 0.0]), np.float64)

    @property
    def _target(self) -> Float64Array:
        """The camera's target, between the part and the sign."""
        return np.asarray(self._ground + self.scale * 0.5 * (SIGN_PICTURE + 0.2) * self.up, np.float64)

    def _height(self, aspect: float) -> float:
        """Return half the height of the view, in the units of the whole map."""
        return max((SIDE * math.cos(self.tilt) + SIGN_PICTURE) / 2 + 1.0, 4.7 / aspect)


def oblique_view(points: Float64Array, min_side: float) -> Viewpoint:
    """Return an oblique view of all points (n, 3), in stage units from the map's centre.

    Args:
        min_side: smallest side of the view.
    """
    # Seen obliquely, a high point appears further north.
    seen = points[:, :2] + np.outer(points[:, 2] * math.tan(_CITY_TILT), (0.0, 1.0))
    low, high = seen.min(axis=0), seen.max(axis=0)
    side = max(float((high - low).max()), min_side)
    x, y = (round(float(value), 4) for value in (low + high) / 2)
    return Viewpoint((x, y), round(side, 4), round(side, 4), _CITY_TILT, True)
