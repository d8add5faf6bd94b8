"""The cameras: the site on the globe, satellite tiles, and University-1652's drone spiral.

Metres are x east, y north, z up. A heading is in degrees clockwise from north, a tilt in degrees above the horizon; -90 is
straight down.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.datasets.geo import metres_per_degree

# A property of a varied world: exposure, colours, haze, blur, noise, and compression of each picture; or the poses of drones.
Factor = Literal["cameras", "poses"]
TILE = 160.0  # metres a satellite tile shows
HIGHEST, LOWEST, ROUNDS = 256.0, 121.5, 3  # of the spiral (University-1652, section 3)
ELEVATION = 50.0  # degrees the drone stands above the horizon, seen from the building
FIELD_OF_VIEW = 41.0  # degrees across


@dataclass(frozen=True)
class Site:
    """The site of the plan's origin: in the open Atlantic, so that no real place is shown."""

    latitude: float = 46.2
    longitude: float = -31.4

    def degrees(self, x: float, y: float) -> tuple[float, float]:
        """Latitude and longitude of a point of the plan."""
        north, east = metres_per_degree(self.latitude)
        return self.latitude + y / north, self.longitude + x / east

    def metres(self, latitude: float, longitude: float) -> tuple[float, float]:
        """The point (x, y) of the plan at a latitude and longitude."""
        north, east = metres_per_degree(self.latitude)
        return (longitude - self.longitude) * east, (latitude - self.latitude) * north


@dataclass(frozen=True)
class Pose:
    """A perspective camera of square pictures: position, direction, and horizontal field of view in degrees."""

    x: float
    y: float
    z: float
    heading: float
    tilt: float
    fov: float

    def axes(self) -> Float64Array:
        """Unit vectors (3, 3): right, up, and forward of the picture, as rows."""
        h, t = np.radians(self.heading), np.radians(self.tilt)
        ahead = np.array([np.sin(h), np.cos(h), 0.0])
        forward = ahead * np.cos(t) + np.array([0, 0, np.sin(t)])
        right = np.array([np.cos(h), -np.sin(h), 0.0])
        return np.stack([right, np.cross(right, forward), forward])


def drone_poses(aim: tuple[float, float, float], views: int, rng: np.random.Generator) -> list[Pose]:
    """Return the poses of the spiral around a point.

    The first `views` - 1 are tilted at it, from 256 m down to 121.5 m in three rounds; the last looks straight down. Heights are
    above `aim`; the start and each heading vary by some degrees.
    """
    tilted = max(1, views - 1) if views > 1 else 1
    start = rng.uniform(-10, 10)
    poses = []
    for i in range(tilted):
        share = i / (tilted - 1) if tilted > 1 else 0.0
        height = HIGHEST + (LOWEST - HIGHEST) * share
        heading = (start + 360 * ROUNDS * share + rng.uniform(-6, 6)) % 360
        poses.append(_looking_at(aim, height, float(heading), ELEVATION, FIELD_OF_VIEW))
    if views > 1:
        height = rng.uniform(200, HIGHEST)
        poses.append(Pose(aim[0], aim[1], float(aim[2] + height), float(rng.uniform(0, 360)), -90.0, FIELD_OF_VIEW))
    return poses


def any_drone_poses(aim: tuple[float, float, float], views: int, sight: float, rng: np.random.Generator) -> list[Pose]:
    """Draw poses that look at a point from anywhere: 60 to 400 m above it, 40 to 90 degrees down, with any lens.

    The lens is such that the picture shows 0.6 to 2.2 times the ground of a tile side by side, where that takes a field of view
    of 25 to 80 degrees. No picture shows anything at the point's height that is farther than `sight` metres from it.
    """
    poses: list[Pose] = []
    while len(poses) < views:
        height, metres = (float(np.exp(rng.uniform(*np.log(ends)))) for ends in ((60, 400), (0.6 * TILE, 2.2 * TILE)))
        tilt = float(rng.uniform(40, 80) if rng.random() < 0.7 else rng.uniform(80, 90))
        distance = height / np.sin(np.radians(tilt))
        fov = float(np.degrees(2 * np.arctan(metres / 2 / distance)))
        heading = float(rng.uniform(0, 360))
        pose = _looking_at(aim, height, heading, tilt, fov)
        if 25 <= fov <= 80 and _farthest(pose, aim) < sight:
            poses.append(pose)
    return poses


def _looking_at(aim: tuple[float, float, float], height: float, heading: float, down: float, fov: float) -> Pose:
    """Return the pose `height` metres above a point that looks at it, `down` degrees below the horizon."""
    h, away = np.radians(heading), height / np.tan(np.radians(down))
    x, y = float(aim[0] - away * np.sin(h)), float(aim[1] - away * np.cos(h))
    return Pose(x, y, float(aim[2] + height), heading, -down, fov)


def _farthest(pose: Pose, aim: tuple[float, float, float]) -> float:
    """Return the distance in metres from a point to the farthest corner of what a picture shows of level ground there."""
    right, up, forward = pose.axes()
    slope = np.tan(np.radians(pose.fov / 2))
    rays = np.array([forward + slope * (a * right + b * up) for a, b in ((-1, 1), (1, 1), (1, -1), (-1, -1))])
    if (rays[:, 2] >= 0).any():
        return float("inf")
    ground = np.array([pose.x, pose.y]) + rays[:, :2] * ((pose.z - aim[2]) / -rays[:, 2])[:, None]
    return float(np.linalg.norm(ground - np.array(aim[:2]), axis=1).max())


@dataclass(frozen=True)
class Tile:
    """A satellite tile: its centre, slightly off the building's, and its rotation from north."""

    x: float
    y: float
    heading: float
    size: float = TILE


def tile_around(x: float, y: float, rng: np.random.Generator) -> Tile:
    """Draw the tile of a building at (x, y), up to 5 m off and up to 2.5 degrees from north."""
    dx, dy = rng.uniform(-5, 5, 2)
    return Tile(float(x + dx), float(y + dy), float(rng.uniform(-2.5, 2.5)))


@dataclass(frozen=True)
class SatelliteImage:
    """A large orthographic satellite image: `size` metres in `pixels` pixels around (x, y, z).

    Attributes:
        lean: angle of the satellite off the zenith in degrees.
        bearing: direction of the satellite in degrees clockwise from north.
    """

    x: float
    y: float
    z: float
    size: float
    pixels: int
    lean: float
    bearing: float

    def axes(self) -> Float64Array:
        """Unit vectors (3, 3): right, up, and forward of the picture, as rows; up is as close to north as possible."""
        lean, bearing = np.radians(self.lean), np.radians(self.bearing)
        forward = -np.array([np.sin(lean) * np.sin(bearing), np.sin(lean) * np.cos(bearing), np.cos(lean)])
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(right, forward), forward])

    def project(self, points: Float64Array) -> Float64Array:
        """Project points (n, 3) to pixels (n, 2), column and row."""
        right, up, _ = self.axes()
        local = (points - (self.x, self.y, self.z)) / (self.size / self.pixels)
        return np.stack([local @ right, -(local @ up)], axis=1) + self.pixels / 2

    def corners(self, tile: Tile) -> Float64Array:
        """Return the pixels (4, 2) of a tile's corners: top left, top right, bottom right, bottom left."""
        h = np.radians(tile.heading)
        right, up = np.array([np.cos(h), -np.sin(h)]), np.array([np.sin(h), np.cos(h)])
        half = tile.size / 2
        ground = [(tile.x, tile.y) + half * (a * right + b * up) for a, b in ((-1, 1), (1, 1), (1, -1), (-1, -1))]
        return self.project(np.concatenate([np.array(ground), np.full((4, 1), self.z)], axis=1))
