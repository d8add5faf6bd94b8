"""What a varied world draws at random: its factors, the materials of its districts, and buildings that do not stand yet."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.world.architecture import FLAT, PITCHED, Architecture, Colour, Volume
from lpn.world.city import City

Factor = Literal["days", "cameras", "poses", "materials", "traffic", "construction", "snow", "plan"]
"""A property of a varied world.

days: two days of the year for each district, one of the drone and one of the satellite.
cameras: exposure, colours, haze, blur, noise, and compression of each picture.
poses: height, tilt, lens, and ground of each drone picture.
materials: roofs, walls, and pavements of each district.
traffic: how full streets and car parks are on each day.
construction: buildings that do not stand on the satellite's day; never one that is photographed.
snow: some days have it.
plan: bends and slants of streets, and sizes of blocks in each district.
"""
FACTORS: tuple[Factor, ...] = get_args(Factor)
_LAID = {style for style, _ in FLAT}  # coverings of flat roofs; those of pitched ones are laid in rows
_ROWS = tuple(dict.fromkeys(style for style, _ in PITCHED))


@dataclass(frozen=True)
class Materials:
    """The materials of a district, on all its days.

    Attributes:
        seed: seeds of what an architecture has of its own.
        flat, pitched: linear reflectances of roofs, from which each architecture has one.
        wall: factor of the reflectance of walls (red, green, blue).
        pavement: factor of the reflectance of hard ground (red, green, blue).
    """

    seed: tuple[int, int]
    flat: tuple[Colour, ...]
    pitched: tuple[Colour, ...]
    wall: Colour
    pavement: Colour

    @classmethod
    def draw(cls, seed: int, district: int) -> Materials:
        """Draw the materials of a district: flat roofs of any grey with a tint, pitched ones from slate to clay."""
        rng = np.random.default_rng([seed, 47, district])
        warm = np.array([1.0, 0.0, -1.0])
        flat = [np.exp(rng.uniform(*np.log((0.05, 0.6)))) * (1 + 0.2 * rng.normal() * warm) for _ in range(4)]
        pitched = [rng.uniform(0.07, 0.28) * (1 + rng.uniform(-0.25, 0.75) * warm) for _ in range(3)]
        return cls(
            (seed, district),
            tuple(map(_colour, flat)),
            tuple(map(_colour, pitched)),
            _factor(rng, 0.3),
            _factor(rng, 0.4),
        )

    def dress(self, architecture: Architecture, number: int) -> Architecture:
        """Give an architecture of the plan, its `number` there, the district's materials."""
        rng = np.random.default_rng([*self.seed, 48, number])
        flat, pitched = (colours[int(rng.integers(len(colours)))] for colours in (self.flat, self.pitched))
        laid = sorted(_LAID)[int(rng.integers(len(_LAID)))]
        rows = _ROWS[int(rng.integers(len(_ROWS)))]

        def dressed(part: Volume) -> Volume:
            wall = _colour(np.array(part.wall_tint) * self.wall)
            if part.cover in _LAID:
                return replace(part, wall_tint=wall, cover=laid, cover_tint=flat)
            if part.cover in _ROWS:
                return replace(part, wall_tint=wall, cover=rows, cover_tint=pitched)
            return replace(part, wall_tint=wall)

        return replace(architecture, parts=tuple(map(dressed, architecture.parts)))


def unbuilt(city: City, share: float, day: int) -> set[int]:
    """Draw the buildings that do not stand on a day, by their numbers: that share of those that nobody photographs."""
    photographed = {target.building for target in city.targets}
    draw = np.random.default_rng([city.seed, 14, day]).random(len(city.buildings))
    return {int(i) for i in np.flatnonzero(draw < share)} - photographed


def _factor(rng: np.random.Generator, spread: float) -> Colour:
    return _colour(np.exp(rng.normal(0, spread)) * rng.normal(1, spread / 5, 3), 3.0)


def _colour(values: Float64Array, most: float = 0.8) -> Colour:
    red, green, blue = np.clip(values, 0.02, most).tolist()
    return red, green, blue
