"""The appearance of a building, wherever it stands: volumes, roofs, and roof equipment in its own frame.

The frame has x along the street, y away from it, and z up, in metres, with the origin at the middle of the footprint. Two
buildings are twins if they share one `Architecture`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from lpn.core.arrays import Float64Array

Reflectance = tuple[float, float, float]
Corner = tuple[float, float]
RoofShape = Literal["flat", "gable", "hip", "sawtooth", "barrel", "dome", "cone", "open"]
BuildingShape = Literal[
    "slab", "lshape", "ushape", "tshape", "courtyard", "tower", "hall", "round", "terrace", "dormitory", "house",
    "townhouse", "church", "shop", "shed", "tank", "stand", "pavilion", "container", "barn",
]  # fmt: skip
ItemShape = Literal["box", "cylinder", "skylight", "solar"]


@dataclass(frozen=True)
class Dress:
    """Materials shared by the volumes of one building.

    Attributes:
        wall, cover: names of the textures of walls and roof.
        wall_tint, cover_tint: linear reflectance that multiplies the textures.
        bay, storey: width and height of a window unit.
    """

    wall: str
    wall_tint: Reflectance
    cover: str
    cover_tint: Reflectance
    bay: float
    storey: float

    def part(
        self, outline: tuple[Corner, ...], eaves: float, roof: RoofShape = "flat", rise: float = 0.0, base: float = 0.0
    ) -> Volume:
        return Volume(**vars(self), outline=outline, base=base, eaves=eaves, roof=roof, rise=rise)


@dataclass(frozen=True)
class Volume(Dress):
    """A volume of a building, with its materials.

    Attributes:
        outline: corners counter-clockwise; a pitched roof's ridge runs along the first edge of a rectangle.
        base, eaves: heights of its bottom and of the top of its walls.
        rise: height of the roof above the eaves.
    """

    outline: tuple[Corner, ...]
    base: float
    eaves: float
    roof: RoofShape
    rise: float


@dataclass(frozen=True)
class RoofItem:
    """A small object on a roof: the middle of its bottom, and its size."""

    shape: ItemShape
    x: float
    y: float
    z: float
    length: float
    width: float
    height: float
    tint: Reflectance


@dataclass(frozen=True)
class Architecture:
    """The appearance of a building.

    Attributes:
        outline: the footprint's outer ring, counter-clockwise.
    """

    kind: BuildingShape
    outline: tuple[Corner, ...]
    parts: tuple[Volume, ...]
    items: tuple[RoofItem, ...]

    @cached_property
    def size(self) -> tuple[float, float]:
        """Extent along x and y."""
        ring = np.array(self.outline)
        extent = ring.max(axis=0) - ring.min(axis=0)
        return float(extent[0]), float(extent[1])

    @cached_property
    def height(self) -> float:
        """The highest point above the ground."""
        return max(part.eaves + part.rise for part in self.parts)

    @property
    def ring(self) -> Float64Array:
        """The outline as an array (n, 2)."""
        return np.array(self.outline)


WHITE, LIGHT, GREY, DARK = (0.60, 0.60, 0.58), (0.42, 0.42, 0.40), (0.25, 0.25, 0.25), (0.10, 0.10, 0.105)
GRAVEL, SAND = (0.30, 0.27, 0.23), (0.46, 0.40, 0.31)
TERRACOTTA, BROWN, SLATE, COPPER = (0.27, 0.115, 0.075), (0.17, 0.10, 0.07), (0.095, 0.105, 0.125), (0.22, 0.40, 0.33)
BRICK, BUFF, CONCRETE, RENDER, STONE = (
    (0.27, 0.105, 0.07), (0.42, 0.31, 0.20), (0.38, 0.37, 0.34), (0.62, 0.59, 0.53), (0.48, 0.42, 0.33),
)  # fmt: skip
STEEL, BLUE, GREEN, RUST = (0.40, 0.42, 0.43), (0.16, 0.25, 0.36), (0.15, 0.24, 0.17), (0.30, 0.13, 0.07)

FLAT = (("membrane", WHITE), ("membrane", LIGHT), ("gravel", GREY), ("gravel", GRAVEL), ("bitumen", DARK),
        ("membrane", SAND), ("bitumen", GREY), ("gravel", LIGHT))  # fmt: skip
FLAT_WEIGHTS = np.array([0.17, 0.2, 0.15, 0.14, 0.11, 0.05, 0.08, 0.1])
PITCHED = (("tiles", TERRACOTTA), ("tiles", BROWN), ("tiles", SLATE), ("tiles", GREY), ("seams", COPPER))
MODERN = (("ribbon", CONCRETE), ("punched", BRICK), ("glass", GREY), ("punched", RENDER), ("punched", BUFF),
          ("ribbon", RENDER), ("punched", STONE), ("ribbon", BRICK))  # fmt: skip
CLASSIC = (("sash", BRICK), ("sash", BUFF), ("sash", RENDER), ("sash", STONE))
SHEDS = (("cladding", STEEL), ("cladding", WHITE), ("cladding", BLUE), ("cladding", GREEN), ("cladding", BUFF))


def near(rng: np.random.Generator, colour: Reflectance, spread: float = 0.12) -> Reflectance:
    """Vary a colour a little in brightness and hue."""
    value = np.array(colour) * rng.normal(1, spread) * rng.normal(1, spread / 4, 3)
    red, green, blue = np.clip(value, 0.02, 0.8)
    return round(float(red), 4), round(float(green), 4), round(float(blue), 4)


def box(x0: float, y0: float, x1: float, y1: float) -> tuple[Corner, ...]:
    """Return the corners of an upright rectangle; its first edge runs along the longer side."""
    corners = ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
    return corners if x1 - x0 >= y1 - y0 else corners[1:] + corners[:1]


def _dress(
    rng: np.random.Generator,
    walls: tuple[tuple[str, Reflectance], ...],
    covers: tuple[tuple[str, Reflectance], ...],
    weights: Float64Array | None = None,
) -> Dress:
    wall, wall_tint = walls[rng.integers(len(walls))]
    cover, cover_tint = covers[rng.choice(len(covers), p=weights)]
    return Dress(
        wall,
        near(rng, wall_tint),
        cover,
        near(rng, cover_tint, 0.18),
        round(rng.uniform(2.6, 4.2), 2),
        round(rng.uniform(3.0, 3.8), 2),
    )


def modern(rng: np.random.Generator) -> Dress:
    """Draw flat roofs and office or laboratory walls."""
    return _dress(rng, MODERN, FLAT, FLAT_WEIGHTS)


def classic(rng: np.random.Generator) -> Dress:
    """Draw pitched roofs and sash windows."""
    return _dress(rng, CLASSIC, PITCHED, np.array([0.28, 0.28, 0.27, 0.13, 0.04]))


def shed(rng: np.random.Generator) -> Dress:
    """Draw halls clad in sheet metal."""
    covers = (("seams", WHITE), ("seams", LIGHT), ("membrane", LIGHT), ("seams", GREY), ("bitumen", DARK), ("seams", BLUE),
              ("seams", RUST))  # fmt: skip
    return _dress(rng, SHEDS, covers, np.array([0.22, 0.25, 0.17, 0.15, 0.11, 0.05, 0.05]))


def plant(rng: np.random.Generator, outline: tuple[Corner, ...], z: float, amount: float = 1.0) -> list[RoofItem]:
    """Place equipment on a flat roof over an upright rectangle: plant rooms, air handlers, ducts, vents, lights, panels."""
    ring = np.array(outline)
    (x0, y0), (x1, y1) = ring.min(axis=0) + 1.6, ring.max(axis=0) - 1.6
    w, d = x1 - x0, y1 - y0
    if w < 2.5 or d < 2.5:
        return []
    items: list[RoofItem] = []
    taken: list[tuple[float, float, float, float]] = []
    for _ in range(int(rng.poisson(1.5 + w * d / 260))):  # fields of newer or older covering, and walkways
        a, b = rng.uniform(2, max(3, w * 0.6)), rng.uniform(1.2, max(2, d * 0.6))
        if rng.random() < 0.3:
            b = 1.0
        x, y = rng.uniform(x0, x1), rng.uniform(y0, y1)
        left, right, low, high = max(x - a / 2, x0), min(x + a / 2, x1), max(y - b / 2, y0), min(y + b / 2, y1)
        tint = near(rng, (WHITE, LIGHT, GREY, DARK, GRAVEL, LIGHT)[rng.integers(6)])
        items.append(RoofItem("box", float(left + right) / 2, float(low + high) / 2, z, float(right - left), float(high - low),
                          0.04 + 0.01 * len(items), tint))  # fmt: skip

    def put(shape: ItemShape, x: float, y: float, size: tuple[float, float], height: float, tint: Reflectance) -> bool:
        length, width = size
        inside = x - length / 2 >= x0 and x + length / 2 <= x1 and y - width / 2 >= y0 and y + width / 2 <= y1
        clear = all(abs(x - a) > (length + b) / 2 + 0.3 or abs(y - c) > (width + e) / 2 + 0.3 for a, c, b, e in taken)
        if inside and clear:
            taken.append((x, y, length, width))
            items.append(RoofItem(shape, x, y, z, length, width, height, tint))
        return inside and clear

    def somewhere() -> tuple[float, float]:
        return float(rng.uniform(x0, x1)), float(rng.uniform(y0, y1))

    for _ in range(1 + int(w * d > 500) + int(w * d > 1400)):
        if rng.random() < 0.8 * amount:
            put("box", *somewhere(), (min(w * 0.6, rng.uniform(4, 11)), min(d * 0.6, rng.uniform(3, 7))),
                rng.uniform(2.2, 3.8), near(rng, (LIGHT, GREY, WHITE, CONCRETE)[rng.integers(4)]))  # fmt: skip
    style = rng.random()
    if style < 0.3 and w > 8:  # a row of skylights
        pitch, across = rng.uniform(4, 7), rng.uniform(1.2, 2.4)
        y = float(rng.uniform(y0 + 1, y1 - 1))
        for x in np.arange(x0 + 2, x1 - 2, pitch):
            put("skylight", float(x), y, (across, across * rng.choice([1.0, 1.8])), 0.5, (0.35, 0.42, 0.46))
    elif style < 0.42 and w * d > 160:  # solar panels
        for y in np.arange(y0 + 1.2, y0 + d * rng.uniform(0.5, 1.0), 2.6):
            for x in np.arange(x0 + 2.5, x0 + w * 0.8, 5.2):
                put("solar", float(x), float(y), (5.0, 1.7), 0.5, (0.02, 0.03, 0.07))
    for _ in range(int(amount * rng.poisson(2 + w * d / 60))):  # air handlers, often in small rows
        x, y = somewhere()
        size = (rng.uniform(0.9, 2.8), rng.uniform(0.9, 2.0))
        tint = near(rng, (WHITE, LIGHT, STEEL, GREY)[rng.integers(4)])
        for step in range(int(rng.integers(1, 4))):
            put("box", x + step * (size[0] + 0.7), y, size, rng.uniform(0.7, 1.7), tint)
    for _ in range(int(amount * rng.poisson(1 + w * d / 220))):  # ducts
        x, y = somewhere()
        length, across = rng.uniform(5, 14), rng.uniform(0.6, 1.0)
        size = (length, across) if rng.random() < 0.5 else (across, length)
        put("box", x, y, size, 0.7, near(rng, STEEL))
    for _ in range(int(amount * rng.poisson(3 + w * d / 45))):  # vents
        x, y = somewhere()
        across = rng.uniform(0.35, 1.1)
        put("cylinder", x, y, (across, across), rng.uniform(0.4, 1.0), near(rng, LIGHT))
    return items


def chimneys(rng: np.random.Generator, x0: float, x1: float, z: float, pitch: float) -> list[RoofItem]:
    """Place chimneys along a ridge at y = 0 and height z."""
    tint = near(rng, BRICK)
    offset = float(rng.uniform(-0.8, 0.8))
    return [
        RoofItem("box", float(x), offset, z - 1.4, rng.uniform(0.7, 1.0), 1.1, 2.4, tint)
        for x in np.arange(x0 + pitch / 2, x1, pitch)
    ]
