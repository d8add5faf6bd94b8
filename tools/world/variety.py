"""What a varied world draws at random, for training: its factors, and the materials of its districts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from lpn.core.arrays import Float64Array
from tools.world.architecture import FLAT, Architecture, Reflectance, Volume

Factor = Literal["cameras", "poses", "materials"]
"""A property of a varied world.

cameras: exposure, colours, haze, blur, noise, and compression of each picture.
poses: height, tilt, lens, and ground of each drone picture.
materials: roofs, walls, and pavements of each district.
"""
FACTORS: tuple[Factor, ...] = get_args(Factor)
_FLAT_COVERS = sorted({style for style, _ in FLAT})


@dataclass(frozen=True)
class Materials:
    """The materials of a district, the same on all its days.

    Attributes:
        seed, district: seed what an architecture has of its own.
        flat, tiles: linear reflectances of flat and of tiled roofs, from which each architecture has one.
        wall: factor of the reflectance of walls (red, green, blue).
        pavement: factor of the reflectance of hard ground (red, green, blue).
    """

    seed: int
    district: int
    flat: tuple[Reflectance, ...]
    tiles: tuple[Reflectance, ...]
    wall: Reflectance
    pavement: Reflectance

    @classmethod
    def draw(cls, seed: int, district: int) -> Materials:
        """Draw the materials of a district: flat roofs of any grey with a tint, tiles from slate to clay."""
        rng = np.random.default_rng([seed, 47, district])
        warm = np.array([1.0, 0.0, -1.0])
        flat = [np.exp(rng.uniform(*np.log((0.05, 0.6)))) * (1 + 0.2 * rng.normal() * warm) for _ in range(4)]
        tiles = [rng.uniform(0.07, 0.28) * (1 + rng.uniform(-0.25, 0.75) * warm) for _ in range(3)]
        wall, pavement = _factor(rng, 0.3), _factor(rng, 0.4)
        return cls(seed, district, tuple(map(_colour, flat)), tuple(map(_colour, tiles)), wall, pavement)

    def dress(self, architecture: Architecture, number: int) -> Architecture:
        """Give an architecture of the plan, its `number` there, the district's materials; metal and seats keep their texture."""
        rng = np.random.default_rng([self.seed, 48, self.district, number])
        flat, tiles = (colours[int(rng.integers(len(colours)))] for colours in (self.flat, self.tiles))
        flat_cover = _FLAT_COVERS[int(rng.integers(len(_FLAT_COVERS)))]

        def dressed(part: Volume) -> Volume:
            part = replace(part, wall_tint=_colour(np.array(part.wall_tint) * self.wall))
            if part.cover in _FLAT_COVERS:
                return replace(part, cover=flat_cover, cover_tint=flat)
            tints = {"tiles": tiles, "seams": flat}
            return replace(part, cover_tint=tints.get(part.cover, part.cover_tint))

        return replace(architecture, parts=tuple(map(dressed, architecture.parts)))


def _factor(rng: np.random.Generator, spread: float) -> Reflectance:
    return _colour(np.exp(rng.normal(0, spread)) * rng.normal(1, spread / 5, 3), 3.0)


def _colour(values: Float64Array, most: float = 0.8) -> Reflectance:
    red, green, blue = np.clip(values, 0.02, most).tolist()
    return red, green, blue
