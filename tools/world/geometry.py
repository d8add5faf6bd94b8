"""Plane geometry of the plan: convex polygons as (n, 2) float64 metres, counter-clockwise, x east and y north."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lpn.core.arrays import Float64Array


def rectangle(x: float, y: float, length: float, width: float, angle: float) -> Float64Array:
    """Return the corners (4, 2) of a rectangle around (x, y) whose length points at `angle` radians from east."""
    half = np.array([[-length, -width], [length, -width], [length, width], [-length, width]]) / 2
    return np.asarray(turned(half, angle) + np.array([x, y]))


def turned(points: Float64Array, angle: float) -> Float64Array:
    """Rotate points (n, 2) counter-clockwise about the origin."""
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(points @ np.array([[c, s], [-s, c]]))


def overlap(a: Float64Array, b: Float64Array, margin: float = 0.0) -> bool:
    """Return whether two convex polygons are closer than `margin` along every separating axis."""
    for one, other in ((a, b), (b, a)):
        edges = np.roll(one, -1, axis=0) - one
        normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1)[:, None]
        reach = (one @ normals.T).max(axis=0)
        if ((other @ normals.T).min(axis=0) >= reach + margin).any():
            return False
    return True


def within(points: Float64Array, polygon: Float64Array, margin: float = 0.0) -> NDArray[np.bool_]:
    """Return which points (n, 2) are in a convex polygon, at least `margin` from its edges; a negative margin widens it."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    normals = np.stack([-edges[:, 1], edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1)[:, None]
    distance = points @ normals.T - (polygon * normals).sum(axis=1)
    return np.asarray((distance >= margin).all(axis=1))


def inset(polygon: Float64Array, distances: Float64Array) -> Float64Array:
    """Move edge i of a convex polygon inwards by `distances[i]`; the corners stay in order."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    normals = np.stack([-edges[:, 1], edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1)[:, None]
    offset = (polygon * normals).sum(axis=1) + distances
    corners = [
        np.linalg.solve(np.stack([normals[i - 1], normals[i]]), np.array([offset[i - 1], offset[i]]))
        for i in range(len(polygon))
    ]
    return np.array(corners)


def area(polygon: Float64Array) -> float:
    """Area in square metres, positive when counter-clockwise."""
    x, y = polygon[:, 0], polygon[:, 1]
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)


def ellipse(x: float, y: float, length: float, width: float, angle: float, corners: int = 28) -> Float64Array:
    """Return a polygon (corners, 2) on an ellipse of these diameters."""
    around = np.arange(corners) * 2 * np.pi / corners
    ring = np.stack([np.cos(around) * length / 2, np.sin(around) * width / 2], axis=1)
    return np.asarray(turned(ring, angle) + np.array([x, y]))


def segment_distance(points: Float64Array, start: Float64Array, end: Float64Array) -> Float64Array:
    """Distances (n,) of points (n, 2) to the segment from `start` to `end`."""
    along = end - start
    share = np.clip((points - start) @ along / max(float(along @ along), 1e-9), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - start - share[:, None] * along, axis=1))


@dataclass(frozen=True)
class Waves:
    """A smooth function of the plane: a sum of plane waves.

    Attributes:
        vectors: (k, 2) wave vectors in radians per metre.
        phases: (k,).
        heights: (k,) amplitudes in metres.
    """

    vectors: Float64Array
    phases: Float64Array
    heights: Float64Array

    @classmethod
    def draw(cls, rng: np.random.Generator, height: float, shortest: float, longest: float, count: int = 6) -> Waves:
        """Draw random waves of wavelengths between two lengths in metres, with a total of about `height`."""
        lengths = np.geomspace(shortest, longest, count) * rng.uniform(0.9, 1.1, count)
        direction = rng.uniform(0, 2 * np.pi, count)
        vectors = np.stack([np.cos(direction), np.sin(direction)], axis=1) * (2 * np.pi / lengths)[:, None]
        weights = lengths / lengths.sum()
        return cls(vectors, rng.uniform(0, 2 * np.pi, count), height * weights * 1.6)

    def __call__(self, points: Float64Array) -> Float64Array:
        return np.asarray(np.sin(points @ self.vectors.T + self.phases) @ self.heights)
