"""The planned city as plain data: metres in a plane with x east and y north; angles in radians from east."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lpn.core.arrays import Float64Array
from tools.world.architecture import Architecture
from tools.world.geometry import Waves, turned

Split = Literal["train", "test", ""]
Character = Literal["university", "housing", "industry", "old town", "centre", "sports", "park", "countryside", "river"]
StreetKind = Literal["arterial", "local", "lane"]
Surface = Literal[
    "lawn", "meadow", "paved", "asphalt", "gravel", "garden", "concrete", "field", "wood", "dirt", "water",
    "parking", "pitch", "track", "court", "pool", "plaza", "playground",
]  # fmt: skip
# West, south, east, and north border in metres of the plan.
Window = tuple[float, float, float, float]
SPECIES = ("oak", "maple", "lime", "poplar", "fir", "bush")
VEHICLES = ("car", "van", "truck", "bus")


@dataclass(frozen=True)
class District:
    """A district of one character, bounded by arterial streets.

    Attributes:
        polygon: its boundary (n, 2).
        split: the split of all targets in it, train or test; empty if there are none.
    """

    number: int
    name: str
    character: Character
    split: Split
    polygon: Float64Array


@dataclass(frozen=True)
class Street:
    """A street along a line (n, 2) with a carriageway `width` wide and pavements of `pavement` on both sides."""

    line: Float64Array
    width: float
    kind: StreetKind
    pavement: float


@dataclass(frozen=True)
class Block:
    """Ground between streets: a convex polygon and its default surface."""

    polygon: Float64Array
    district: int
    surface: Surface


@dataclass(frozen=True)
class Building:
    """A building: the place of its architecture.

    Attributes:
        number: its index in `City.buildings`.
        architecture: index into `City.architectures`.
        notable: large enough to be a target.
    """

    number: int
    architecture: int
    x: float
    y: float
    angle: float
    district: int
    notable: bool


@dataclass(frozen=True)
class Patch:
    """Ground of one use, a convex polygon; `angle` is the direction of markings and furrows, `shade` varies its colour."""

    surface: Surface
    polygon: Float64Array
    angle: float
    length: float
    width: float
    shade: float


@dataclass(frozen=True)
class Path:
    """A footpath or driveway along a line (n, 2)."""

    line: Float64Array
    width: float
    surface: Surface


@dataclass(frozen=True)
class RoadBridge:
    """The deck of a street over the river."""

    x: float
    y: float
    angle: float
    length: float
    width: float


@dataclass(frozen=True)
class River:
    """A river along a line (n, 2), `width` wide, with its surface at height `level`."""

    line: Float64Array
    width: float
    level: float


@dataclass(frozen=True)
class Target:
    """A building that is photographed.

    Attributes:
        number: the place's id, from 1.
        building: index into `City.buildings`.
        twins: number of its group of twins, 0 if its architecture is unique.
        split: `train` or `test`, as its district's.
    """

    number: int
    building: int
    twins: int
    split: Split


@dataclass(frozen=True)
class Terrain:
    """Height of the ground in metres: gentle waves, level at the river, with the river's bed cut into it."""

    waves: Waves
    river: River

    def bank(self, points: Float64Array) -> Float64Array:
        """Distance (...,) from the river's edge, negative on the water."""
        flat = points.reshape(-1, 2)
        # The river runs from south to north, so its middle is a function of y.
        line = self.river.line
        middle = np.interp(flat[:, 1], line[:, 1], line[:, 0])
        slope = np.gradient(line[:, 0], line[:, 1])
        lean = np.interp(flat[:, 1], line[:, 1], slope)
        distance: Float64Array = (np.abs(flat[:, 0] - middle) / np.sqrt(1 + lean**2)).reshape(points.shape[:-1])
        return distance - self.river.width / 2

    def __call__(self, points: Float64Array) -> Float64Array:
        bank = self.bank(points)
        rising = np.clip((bank - 30) / 220, 0, 1)
        land = self.waves(points) * rising**2 * (3 - 2 * rising)
        cut = np.clip((bank + 1.0) / 3.5, 0, 1)
        return np.asarray(self.river.level + (land - self.river.level) * cut)


@dataclass(frozen=True)
class Trees:
    """Trees as arrays (n,): x, y, index into SPECIES, height in metres, and a number in [0, 1) that varies their appearance."""

    x: Float64Array
    y: Float64Array
    species: Float64Array
    height: Float64Array
    look: Float64Array


@dataclass(frozen=True)
class ParkingBays:
    """Parking bays as arrays (n,): x, y, angle, index into VEHICLES, and the probability of a vehicle."""

    x: Float64Array
    y: Float64Array
    angle: Float64Array
    vehicle: Float64Array
    chance: Float64Array


@dataclass(frozen=True)
class City:
    """The whole plan."""

    seed: int
    districts: tuple[District, ...]
    streets: tuple[Street, ...]
    blocks: tuple[Block, ...]
    architectures: tuple[Architecture, ...]
    buildings: tuple[Building, ...]
    patches: tuple[Patch, ...]
    paths: tuple[Path, ...]
    hedges: tuple[Float64Array, ...]
    bridges: tuple[RoadBridge, ...]
    terrain: Terrain
    trees: Trees
    stalls: ParkingBays
    targets: tuple[Target, ...]

    def footprint(self, building: Building) -> Float64Array:
        """The building's outline on the ground (n, 2)."""
        ring = self.architectures[building.architecture].ring
        return np.asarray(turned(ring, building.angle) + np.array([building.x, building.y]))

    def height(self, x: float, y: float) -> float:
        return float(self.terrain(np.array([x, y])))


def middles(things: Sequence[Building | RoadBridge]) -> tuple[Float64Array, Float64Array]:
    """Return x and y, (n,) each, of buildings or bridges."""
    return np.array([thing.x for thing in things]), np.array([thing.y for thing in things])


def within_window(window: Window, x: Float64Array, y: Float64Array, reach: float = 0.0) -> NDArray[np.int_]:
    """Return the numbers of the points inside a window, or at most `reach` metres outside."""
    west, south, east, north = window
    inside = (x > west - reach) & (x < east + reach) & (y > south - reach) & (y < north + reach)
    return np.flatnonzero(inside)


def grid(terrain: Terrain, x: Float64Array, y: Float64Array) -> tuple[Float64Array, NDArray[np.int_]]:
    """Return a grid on the ground over columns x and rows y: vertices (n, 3), and the corners of quadrilaterals (q, 4)."""
    places = np.stack(np.meshgrid(x, y), axis=-1)
    vertices = np.concatenate([places, terrain(places)[..., None]], axis=-1).reshape(-1, 3)
    index = np.arange(len(x) * len(y)).reshape(len(y), len(x))
    quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1)
    return vertices, quads.reshape(-1, 4)


@dataclass
class Draft:
    """The state of the plan while blocks are filled."""

    architectures: list[Architecture] = field(default_factory=list)
    buildings: list[Building] = field(default_factory=list)
    patches: list[Patch] = field(default_factory=list)
    paths: list[Path] = field(default_factory=list)
    hedges: list[Float64Array] = field(default_factory=list)
    trees: list[tuple[float, float, int, float, float]] = field(default_factory=list)
    stalls: list[tuple[float, float, float, int, float]] = field(default_factory=list)
