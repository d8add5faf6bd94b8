"""Obstacles in a part of the city: the free places between them, and the lines of sight that they block."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lpn.core.arrays import Float64Array
from lpn.world.geometry import segment_distance, within

_HEDGE = 2.4  # metres high


@dataclass(frozen=True)
class Obstacles:
    """The obstacles in a part of the city.

    Attributes:
        numbers: (b,) of the buildings, as in `City.buildings`.
        bodies: (b, 6) x, y, half length, half width, angle, height of each building.
        trees: (t, 5) x, y, radius of the crown, heights of its bottom and top above the ground.
        hedges: (h, 2, 2).
        vehicles: (v, 5) x, y, half length, half width, angle, of those that are there some days.
        tall: (v,) vehicles that block the view.
        water: polygons.
    """

    numbers: NDArray[np.int_]
    bodies: Float64Array
    trees: Float64Array
    hedges: Float64Array
    vehicles: Float64Array
    tall: NDArray[np.bool_]
    water: tuple[Float64Array, ...]

    def room(self, places: Float64Array) -> NDArray[np.bool_]:
        """Return at which places (n, 2) a person can stand with a free view."""
        built = self._within(places, self.bodies, np.full((len(self.bodies), 2), 1.2))
        parked = self._within(places, self.vehicles, np.where(self.tall[:, None], (3.0, 1.8), (1.5, 0.9)))
        leafy = distances(places, self.trees[:, :2]) < self.trees[:, 2] + 0.3
        free = ~np.concatenate([built, parked, leafy], axis=1).any(axis=1)
        for polygon in self.water:
            free &= ~within(places, polygon, -1.5)
        for a, b in self.hedges:
            free &= segment_distance(places, a, b) > 1.2
        return np.asarray(free, bool)

    @staticmethod
    def _within(places: Float64Array, boxes: Float64Array, more: Float64Array) -> NDArray[np.bool_]:
        """Return which places (n, 2) are in which boxes, enlarged by `more` (m, 2) on each side: (n, m)."""
        local = np.abs(_turned_back(places[:, None] - boxes[:, :2], boxes[:, 4]))
        return np.asarray((local < boxes[:, 2:4] + more).all(axis=2))

    def clear(self, starts: Float64Array, ends: Float64Array, tops: Float64Array, own: int) -> NDArray[np.bool_]:
        """Return which lines of sight are blocked by nothing but building `own`.

        They run from `starts` (n, 2), 2 m above the ground, to `ends` (n, 2) at height `tops` (n,).
        """
        ways = ends - starts
        low, high = 0.04, 0.95  # shares of a line that count

        def heights(share: Float64Array) -> Float64Array:
            risen: Float64Array = 2.0 + share * (tops[:, None] - 2.0)
            return risen

        to = self.trees[:, :2] - starts[:, None]
        share = np.clip((to * ways[:, None]).sum(axis=2) / (ways**2).sum(axis=1)[:, None], low, high)
        off = np.linalg.norm(to - share[..., None] * ways[:, None], axis=2)
        z = heights(share)
        _, _, radius, bottom, top = self.trees.T
        hidden = ((off < 0.8 * radius) & (z > bottom) & (z < top)).any(axis=1)

        along = self.hedges[:, 1] - self.hedges[:, 0]
        to = self.hedges[:, 0] - starts[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            across = _cross(ways[:, None], along)
            share, other = _cross(to, along) / across, _cross(to, ways[:, None]) / across
            met = (share > low) & (share < high) & (other >= 0) & (other <= 1)
            hidden |= (met & (heights(share) < _HEDGE)).any(axis=1)

            boxes = self.bodies[self.numbers != own]
            begin = _turned_back(starts[:, None] - boxes[:, :2], boxes[:, 4])
            way = _turned_back(np.repeat(ways[:, None], len(boxes), axis=1), boxes[:, 4])
            sides = np.stack([(-boxes[:, 2:4] - begin) / way, (boxes[:, 2:4] - begin) / way])
        first = np.maximum(sides.min(axis=0).max(axis=2), low)
        last = np.minimum(sides.max(axis=0).min(axis=2), high)
        hidden |= ((first < last) & (heights(first) < boxes[:, 5])).any(axis=1)
        return np.asarray(~hidden, bool)


def distances(a: Float64Array, b: Float64Array) -> Float64Array:
    """Distances (n, m) between points (n, 2) and (m, 2)."""
    result: Float64Array = np.hypot(a[:, None, 0] - b[:, 0], a[:, None, 1] - b[:, 1])
    return result


def _cross(a: Float64Array, b: Float64Array) -> Float64Array:
    product: Float64Array = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product


def _turned_back(points: Float64Array, angles: Float64Array) -> Float64Array:
    """Rotate points (n, m, 2) clockwise by `angles` (m,)."""
    c, s = np.cos(angles), np.sin(angles)
    x, y = points[..., 0], points[..., 1]
    return np.stack([c * x + s * y, c * y - s * x], axis=-1)
