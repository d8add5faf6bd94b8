"""A block while it is filled: its free ground, and ways to build, pave, and plant."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from lpn.core.arrays import Float64Array
from tools.world.architecture import Architecture
from tools.world.buildings import MAKERS
from tools.world.city import SPECIES, Building, District, Draft, Patch, Path, Surface, Terrain
from tools.world.geometry import area, ellipse, overlap, rectangle, segment_distance, turned, within

_NOTABLE = 260.0  # square metres a target covers at least
_PADS: tuple[Surface, ...] = ("concrete", "asphalt", "paved", "asphalt", "lawn", "gravel")


class Edge(NamedTuple):
    """An edge of a block: its start, direction, inward normal, length, and the angle of its direction."""

    start: Float64Array
    along: Float64Array
    normal: Float64Array
    length: float
    angle: float

    def at(self, along: float, inward: float) -> tuple[float, float]:
        """Return the point at metres along the edge and into the block."""
        x, y = self.start + self.along * along + self.normal * inward
        return float(x), float(y)


class ArchitecturePool:
    """Architectures that several buildings share, by kind and split, so that twins are never in both splits."""

    def __init__(self, rng: np.random.Generator, architectures: list[Architecture]) -> None:
        self._rng = rng
        self._architectures = architectures
        self._shared: dict[tuple[str, str], list[int]] = {}
        self._spare: dict[str, int] = {}

    def own(self, kind: str, rng: np.random.Generator) -> int:
        """Return an architecture for a single building: a new one, or one for which there was no room before."""
        if kind not in self._spare:
            self._spare[kind] = self._new(kind, rng)
        return self._spare[kind]

    def taken(self, index: int) -> None:
        """Mark an architecture as used by a building."""
        self._spare = {kind: spare for kind, spare in self._spare.items() if spare != index}

    def _new(self, kind: str, rng: np.random.Generator) -> int:
        self._architectures.append(MAKERS[kind](rng))
        return len(self._architectures) - 1

    def shared(self, kind: str, split: str, variants: int, rng: np.random.Generator) -> int:
        """Draw one of the architectures of a kind that buildings of a split share."""
        pool = self._shared.setdefault((kind, split), [])
        if not pool:
            pool.extend(self._new(kind, self._rng) for _ in range(variants))
        return pool[int(rng.integers(len(pool)))]

    def __getitem__(self, index: int) -> Architecture:
        return self._architectures[index]


@dataclass
class Plot:
    """A block while it is filled: a convex polygon with corners counter-clockwise."""

    polygon: Float64Array
    district: District
    rng: np.random.Generator
    draft: Draft
    pools: ArchitecturePool
    terrain: Terrain
    bodies: list[Float64Array] = field(default_factory=list)
    hard: list[Float64Array] = field(default_factory=list)
    paths: list[Path] = field(default_factory=list)
    pads: list[Float64Array] = field(default_factory=list)
    beds: list[Float64Array] = field(default_factory=list)
    trees: list[tuple[float, float]] = field(default_factory=list)

    def edge(self, i: int) -> Edge:
        """Return the edge from corner i, counted modulo 4."""
        start, end = self.polygon[i % 4], self.polygon[(i + 1) % 4]
        length = float(np.linalg.norm(end - start))
        along = (end - start) / length
        return Edge(start, along, np.array([-along[1], along[0]]), length, float(np.arctan2(along[1], along[0])))

    def longest(self) -> int:
        """Index of the longer of the two pairs of edges: 0 or 1."""
        lengths = [self.edge(i).length for i in range(4)]
        return int(lengths[0] + lengths[2] < lengths[1] + lengths[3])

    @property
    def middle(self) -> tuple[float, float]:
        """The mean of its corners."""
        x, y = self.polygon.mean(axis=0).tolist()
        return x, y

    def free(self, shape: Float64Array, gap: float = 1.0, border: float = 0.5) -> bool:
        """Return whether a shape is in the block and clear of buildings and hard ground."""
        return bool(within(shape, self.polygon, border).all()) and not any(
            overlap(shape, other, gap) for other in (*self.bodies, *self.hard)
        )

    def build(self, index: int, x: float, y: float, angle: float, gap: float = 3.0, border: float = 0.5) -> bool:
        """Place a building if there is room."""
        look = self.pools[index]
        body = rectangle(x, y, *look.size, angle)
        if not self.free(body, gap, border):
            return False
        self.bodies.append(body)
        self.pools.taken(index)
        notable = abs(area(look.ring)) >= _NOTABLE and look.kind not in ("tank", "container", "townhouse", "shed")
        self.draft.buildings.append(
            Building(len(self.draft.buildings), index, x, y, angle, self.district.number, notable)
        )
        if notable:
            self._surround(x, y, *look.size, angle)
        return True

    def _surround(self, x: float, y: float, length: float, depth: float, angle: float) -> None:
        """Add a path to the door, and perhaps a yard with cars beside the building."""
        rng = self.rng
        door = float(rng.uniform(-0.3, 0.3)) * length
        way = turned(np.array([[door, -depth / 2 + 2], [door + rng.uniform(-3, 3), -depth / 2 - 14]]), angle)
        way += (x, y)
        self.path(way, float(rng.uniform(1.8, 4)), "concrete" if rng.random() < 0.7 else "paved")
        for side in (1, -1):
            if rng.random() > 0.45:
                continue
            wide, long = float(rng.uniform(3, 9)), float(rng.uniform(0.3, 1.0)) * length
            off = side * (depth + wide) / 2
            along = float(rng.uniform(-0.5, 0.5)) * (length - long)
            px, py = turned(np.array([[along, off]]), angle)[0] + (x, y)
            pad = rectangle(float(px), float(py), long, wide, angle)
            if not within(pad, self.polygon, -1).all():
                continue
            surface: Surface = _PADS[int(rng.integers(len(_PADS)))]
            self.pads.append(pad)
            self.draft.patches.append(Patch(surface, pad, angle, long, wide, float(rng.random())))
            if wide > 5.2 and rng.random() < 0.6:
                for step in np.arange(-long / 2 + 1.5, long / 2 - 1.2, 2.7):
                    sx, sy = turned(np.array([[along + step, off + side * (wide / 2 - 2.6)]]), angle)[0] + (x, y)
                    self.draft.stalls.append((float(sx), float(sy), angle + np.pi / 2, int(rng.random() < 0.2), 0.5))
            elif surface != "lawn" and rng.random() < 0.5:
                sx, sy = turned(np.array([[along + rng.uniform(-0.4, 0.4) * long, off]]), angle)[0] + (x, y)
                self.draft.stalls.append((float(sx), float(sy), angle, 1, 0.6))

    def shrubs(self) -> None:
        """Bushes along the walls of large buildings."""
        for body in self.bodies:
            if area(body) < _NOTABLE or self.rng.random() < 0.35:
                continue
            for a, b in zip(body, np.roll(body, -1, axis=0), strict=True):
                if self.rng.random() < 0.5:
                    length = float(np.linalg.norm(b - a))
                    out = np.array([b[1] - a[1], a[0] - b[0]]) / length
                    along = np.arange(1, length, self.rng.uniform(1.6, 3.5))[:, None] / length
                    places = a + (b - a) * along + out * self.rng.uniform(1.1, 1.8)
                    self.plant_at(places[self.rng.random(len(places)) < 0.8], (5,), (5, 9), 0.7)

    def front(self, index: int, i: int, at: float, setback: float, gap: float = 3.0, border: float = 0.5) -> bool:
        """Place a building at `at` metres along edge i, facing its street."""
        edge = self.edge(i)
        return self.build(index, *edge.at(at, setback + self.pools[index].size[1] / 2), edge.angle, gap, border)

    def lay(self, surface: Surface, x: float, y: float, length: float, width: float, angle: float,
            solid: bool = True, round_: bool = False, border: float = 0.3) -> bool:  # fmt: skip
        """Cover ground if there is room; nothing is built or planted on solid ground."""
        shape = ellipse(x, y, length, width, angle) if round_ else rectangle(x, y, length, width, angle)
        if solid and not self.free(shape, 0.6, border):
            return False
        if solid:
            self.hard.append(shape)
        self.draft.patches.append(Patch(surface, shape, angle, length, width, float(self.rng.random())))
        return True

    def path(self, points: Float64Array, width: float, surface: Surface = "gravel") -> None:
        """Add a path along a line; buildings may cover it."""
        made = Path(points, width, surface)
        self.paths.append(made)
        self.draft.paths.append(made)

    def hedge(self, start: Float64Array, end: Float64Array) -> None:
        self.draft.hedges.append(np.stack([start, end]))

    def plant(self, count: int, species: tuple[int, ...], height: tuple[float, float], clump: float = 0.0) -> None:
        """Plant trees at random, clear of buildings, hard ground, and paths; `clump` is the radius of groves."""
        low, high = self.polygon.min(axis=0), self.polygon.max(axis=0)
        places = self.rng.uniform(low, high, (count, 2))
        if clump:
            groves = self.rng.uniform(low, high, (max(1, count // 14), 2))
            places = groves[self.rng.integers(len(groves), size=count)] + self.rng.normal(0, clump, (count, 2))
        self.plant_at(places, species, height)

    def plant_at(
        self, places: Float64Array, species: tuple[int, ...], height: tuple[float, float], gap: float = 2.4
    ) -> None:
        """Plant trees at given places if there is room."""
        keep = within(places, self.polygon, 0.8)
        for body in self.bodies:
            keep &= ~within(places, body, -gap)
        for shape in (*self.hard, *self.pads):
            keep &= ~within(places, shape, -0.8)
        for path in self.paths:
            for a, b in pairwise(path.line[:: max(1, len(path.line) // 6)]):
                keep &= segment_distance(places, a, b) > path.width / 2 + 0.9
        for x, y in places[keep]:
            if all((x - a) ** 2 + (y - b) ** 2 > 6 for a, b in self.trees[-60:]):
                self.trees.append((x, y))
                kind = species[int(self.rng.integers(len(species)))]
                size = float(self.rng.uniform(*height)) * (0.22 if SPECIES[kind] == "bush" else 1)
                self.draft.trees.append((float(x), float(y), kind, size, float(self.rng.random())))

    def stalls(self, x: float, y: float, length: float, width: float, angle: float, chance: float) -> None:
        """Add rows of parking bays to a rectangle: 2.5 by 5 m, at right angles to its length, with aisles of 6 m."""
        for row in parking_rows(width):
            for along in np.arange(-length / 2 + 1.4, length / 2 - 1.2, 2.5):
                a, b = turned(np.array([[along, row]]), angle)[0] + (x, y)
                kind = int(self.rng.random() < 0.12)
                flip = np.pi * self.rng.integers(2)
                turn = angle + np.pi / 2 + flip + self.rng.normal(0, 0.03)
                self.draft.stalls.append((float(a), float(b), float(turn), kind, chance))

    def car_park(self, x: float, y: float, length: float, width: float, angle: float) -> bool:
        """Add a marked car park with cars if there is room."""
        if not self.lay("parking", x, y, length, width, angle):
            return False
        self.stalls(x, y, length, width, angle, float(self.rng.uniform(0.3, 0.9)))
        return True

    def leftover_parking(self) -> None:
        """Add car parks wherever there is still room."""
        edge, across = self.edge(self.longest()), self.edge(self.longest() + 1).length
        for length, width in ((46, 32), (34, 32), (40, 16), (24, 16), (16, 16)):
            for _ in range(6):
                place = edge.at(self.rng.uniform(0, edge.length), self.rng.uniform(0, across))
                self.car_park(*place, length, width, edge.angle)

    def islands(self, count: int) -> None:
        """Beds of lawn in paved ground, some with a hedge around."""
        rng = self.rng
        low, high = self.polygon.min(axis=0), self.polygon.max(axis=0)
        for _ in range(count):
            x, y = rng.uniform(low, high)
            angle = self.edge(int(rng.integers(4))).angle
            length, width = float(rng.uniform(6, 26)), float(rng.uniform(3, 11))
            bed = rectangle(float(x), float(y), length, width, angle)
            if self.free(bed, 0.8, 0.5):
                self.draft.patches.append(Patch("lawn", bed, angle, length, width, float(rng.random())))
                self.bodies.append(bed)
                self.beds.append(bed)
                if rng.random() < 0.3:
                    for a, b in zip(bed[:2], bed[2:], strict=True):
                        self.hedge(a, b)

    def plant_beds(self, species: tuple[int, ...], height: tuple[float, float]) -> None:
        """Trees and bushes in the beds, which count as ground again."""
        self.bodies = [body for body in self.bodies if not any(body is bed for bed in self.beds)]
        for bed in self.beds:
            inside = bed[0] + (bed[1] - bed[0]) * self.rng.uniform(0.1, 0.9, (6, 1))
            inside = inside + (bed[3] - bed[0]) * self.rng.uniform(0.15, 0.85, (6, 1))
            self.plant_at(inside[: int(area(bed) / 22)], species, height, 1.5)

    def walks(self, count: int, surface: Surface) -> None:
        """Slightly bent paths across the block."""
        rng = self.rng
        for _ in range(count):
            a, b = (self.polygon[i] + (self.polygon[(i + 1) % 4] - self.polygon[i]) * rng.uniform(0.1, 0.9)
                    for i in rng.permutation(4)[:2])  # fmt: skip
            steps = np.linspace(0, 1, 14)[:, None]
            side = np.array([a[1] - b[1], b[0] - a[0]]) * rng.uniform(-0.12, 0.12)
            self.path(a + (b - a) * steps + side * np.sin(np.pi * steps), float(rng.uniform(1.6, 3)), surface)


def parking_rows(width: float) -> list[float]:
    """Return the offsets of rows of bays across a car park: pairs of rows with aisles between."""
    rows, y = [], -width / 2 + 2.6
    while y < width / 2 - 2.0:
        rows.append(y)
        y += 11.0 if len(rows) % 2 else 5.2
    return rows
