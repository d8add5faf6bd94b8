"""The street network: a grid of districts bent by smooth waves, each divided recursively into blocks."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lpn.core.arrays import Float64Array
from tools.world.city import Street, StreetKind
from tools.world.geometry import Waves

SIDE = 560.0  # of a district
RIM = 420.0  # of the countryside around the city
STRIP = 200.0  # of the river with its banks
ARTERIAL = 15.0
_CARRIAGEWAY = {"arterial": ARTERIAL, "local": 7.5, "lane": 5.5}
_PAVEMENT = {"arterial": 3.2, "local": 2.2, "lane": 1.4}


@dataclass(frozen=True)
class Warp:
    """The smooth deformation of the square grid into the city: (..., 2) metres to metres."""

    east: Waves
    north: Waves

    def __call__(self, points: Float64Array) -> Float64Array:
        """Map points to the city."""
        return points + np.stack([self.east(points), self.north(points)], axis=-1)


@dataclass(frozen=True)
class Quad:
    """A quadrilateral (4, 2) of the grid's plane, counter-clockwise, with half the street's width for each edge."""

    corners: Float64Array
    margins: tuple[float, float, float, float]

    def lengths(self) -> Float64Array:
        """Length of each edge."""
        return np.asarray(np.linalg.norm(np.roll(self.corners, -1, axis=0) - self.corners, axis=1))


def densified(line: Float64Array, step: float = 12.0) -> Float64Array:
    """Resample a line (n, 2) with points at most `step` apart."""
    pieces = [
        a + (b - a) * np.arange(n := max(1, int(np.ceil(np.linalg.norm(b - a) / step))))[:, None] / n
        for a, b in pairwise(line)
    ]
    return np.concatenate([*pieces, line[-1:]])


def beside(line: Float64Array, offset: float) -> Float64Array:
    """Offset a line (n, 2) by `offset` metres to its left."""
    step = np.gradient(line, axis=0)
    step /= np.linalg.norm(step, axis=1)[:, None]
    return np.asarray(line + offset * np.stack([-step[:, 1], step[:, 0]], axis=1))


def street(line: Float64Array, kind: StreetKind, warp: Warp, rural: bool = False) -> Street:
    """Make a street along a straight line of the grid; without pavements in the countryside."""
    return Street(warp(densified(line)), _CARRIAGEWAY[kind], kind, 0.3 if rural else _PAVEMENT[kind])


def margin(kind: StreetKind) -> float:
    """Distance from a street's middle to the back of its pavement."""
    return _CARRIAGEWAY[kind] / 2 + _PAVEMENT[kind]


def divide(
    quad: Quad,
    long: float,
    short: float,
    slant: float,
    rng: np.random.Generator,
    warp: Warp,
    streets: list[Street],
    rural: bool = False,
) -> list[Quad]:
    """Cut a quad until no block is longer than `long` or wider than `short`; the cuts become streets.

    Args:
        slant: maximum slant of a cut, as a fraction of the edges it joins.
    """
    a, b, c, d = quad.lengths()
    one, other = max(a, c), max(b, d)
    longest, across = max(one, other), min(one, other)
    if longest <= long and across <= short:
        return [quad]
    # Cut the longer side, unless it is short enough already.
    cut_first = one >= other if longest > long else one == across
    corners = quad.corners if cut_first else np.roll(quad.corners, -1, axis=0)
    margins = quad.margins if cut_first else (*quad.margins[1:], quad.margins[0])
    size = one if cut_first else other
    pieces = max(2, round(size / (long if size > long else short)))
    share = (1 / pieces if pieces % 2 else 0.5) + rng.uniform(-0.08, 0.08)
    lean = rng.uniform(-slant, slant)
    foot = corners[0] + (corners[1] - corners[0]) * np.clip(share + lean, 0.25, 0.75)
    head = corners[3] + (corners[2] - corners[3]) * np.clip(share - lean, 0.25, 0.75)
    kind: StreetKind = "local" if not rural and (size > 150 or rng.random() < 0.4) else "lane"
    streets.append(street(np.stack([foot, head]), kind, warp, rural))
    half = margin(kind)
    left = Quad(np.stack([corners[0], foot, head, corners[3]]), (margins[0], half, margins[2], margins[3]))
    right = Quad(np.stack([foot, corners[1], corners[2], head]), (margins[0], margins[1], margins[2], half))
    return [
        *divide(left, long, short, slant, rng, warp, streets, rural),
        *divide(right, long, short, slant, rng, warp, streets, rural),
    ]
