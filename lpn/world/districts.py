"""What a block is used for, by the character of its district, and how buildings, paths, and trees fill it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from lpn.world.architecture import MAKERS, Architecture
from lpn.world.city import (
    SPECIES, VEHICLES, Building, Character, District, Draft, Patch, Path, Street, Surface, Terrain,
)  # fmt: skip
from lpn.world.geometry import Points, area, ellipse, inset, overlap, rectangle, segment_distance, turned, within

_NOTABLE = 260.0  # square metres a target covers at least


class Pools:
    """Architectures that several buildings share, by kind and split, so that twins never cross from train to test."""

    def __init__(self, rng: np.random.Generator, architectures: list[Architecture]) -> None:
        self._rng = rng
        self._architectures = architectures
        self._shared: dict[tuple[str, str], list[int]] = {}

    def own(self, kind: str, rng: np.random.Generator) -> int:
        """A new architecture that one building has for itself."""
        self._architectures.append(MAKERS[kind](rng))
        return len(self._architectures) - 1

    def shared(self, kind: str, split: str, variants: int, rng: np.random.Generator) -> int:
        """One of the architectures of this kind that buildings of the split have in common."""
        pool = self._shared.setdefault((kind, split), [])
        if not pool:
            pool.extend(self.own(kind, self._rng) for _ in range(variants))
        return pool[int(rng.integers(len(pool)))]

    def __getitem__(self, index: int) -> Architecture:
        return self._architectures[index]


@dataclass
class Plot:
    """A block while it is being filled; a convex polygon whose corners run counter-clockwise."""

    polygon: Points
    district: District
    rng: np.random.Generator
    draft: Draft
    pools: Pools
    terrain: Terrain
    bodies: list[Points] = field(default_factory=list)
    hard: list[Points] = field(default_factory=list)
    paths: list[Path] = field(default_factory=list)
    pads: list[Points] = field(default_factory=list)
    trees: list[tuple[float, float]] = field(default_factory=list)

    def edge(self, i: int) -> tuple[Points, Points, Points, float]:
        """Start, direction, inward normal, and length of an edge."""
        start, end = self.polygon[i % 4], self.polygon[(i + 1) % 4]
        length = float(np.linalg.norm(end - start))
        along = (end - start) / length
        return start, along, np.array([-along[1], along[0]]), length

    def longest(self) -> int:
        """The longer of the two pairs of edges: 0 or 1."""
        lengths = [self.edge(i)[3] for i in range(4)]
        return int(lengths[0] + lengths[2] < lengths[1] + lengths[3])

    @property
    def middle(self) -> Points:
        """Mean of the corners."""
        middle: Points = self.polygon.mean(axis=0)
        return middle

    def free(self, shape: Points, gap: float = 1.0, border: float = 0.5) -> bool:
        """Whether a shape lies in the block and clear of buildings and hard ground."""
        return bool(within(shape, self.polygon, border).all()) and not any(
            overlap(shape, other, gap) for other in (*self.bodies, *self.hard)
        )

    def build(self, index: int, x: float, y: float, angle: float, gap: float = 3.0, border: float = 0.5) -> bool:
        """Put a building if there is room for it."""
        look = self.pools[index]
        body = rectangle(x, y, *look.size, angle)
        if not self.free(body, gap, border):
            return False
        self.bodies.append(body)
        notable = abs(area(look.ring)) >= _NOTABLE and look.kind not in ("tank", "container", "townhouse", "shed")
        self.draft.buildings.append(
            Building(len(self.draft.buildings), index, x, y, angle, self.district.number, notable)
        )
        if notable:
            self._surround(x, y, *look.size, angle)
        return True

    def _surround(self, x: float, y: float, length: float, depth: float, angle: float) -> None:
        """The way to the door, and perhaps a yard with cars beside the building."""
        rng = self.rng
        door = float(rng.uniform(-0.3, 0.3)) * length
        way = turned(np.array([[door, -depth / 2 + 2], [door + rng.uniform(-3, 3), -depth / 2 - 14]]), angle) + (x, y)
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
        """Put a building at `at` metres along edge i, facing its street."""
        start, along, normal, _ = self.edge(i)
        x, y = start + along * at + normal * (setback + self.pools[index].size[1] / 2)
        return self.build(index, float(x), float(y), float(np.arctan2(along[1], along[0])), gap, border)

    def lay(self, surface: Surface, x: float, y: float, length: float, width: float, angle: float,
            solid: bool = True, round_: bool = False, border: float = 0.3) -> bool:  # fmt: skip
        """Cover ground if there is room for it; nothing is built or planted on solid ground."""
        shape = ellipse(x, y, length, width, angle) if round_ else rectangle(x, y, length, width, angle)
        if solid and not self.free(shape, 0.6, border):
            return False
        if solid:
            self.hard.append(shape)
        self.draft.patches.append(Patch(surface, shape, angle, length, width, float(self.rng.random())))
        return True

    def path(self, points: Points, width: float, surface: Surface = "gravel") -> None:
        """A path along a line; buildings stand on it where they are in its way."""
        made = Path(points, width, surface)
        self.paths.append(made)
        self.draft.paths.append(made)

    def hedge(self, start: Points, end: Points) -> None:
        """A hedge or fence."""
        self.draft.hedges.append(np.stack([start, end]))

    def plant(self, count: int, species: tuple[int, ...], height: tuple[float, float], clump: float = 0.0) -> None:
        """Trees at random, clear of buildings, hard ground, and paths; `clump` gathers them in groves of that radius."""
        low, high = self.polygon.min(axis=0), self.polygon.max(axis=0)
        places = self.rng.uniform(low, high, (count, 2))
        if clump:
            groves = self.rng.uniform(low, high, (max(1, count // 14), 2))
            places = groves[self.rng.integers(len(groves), size=count)] + self.rng.normal(0, clump, (count, 2))
        self.plant_at(places, species, height)

    def plant_at(self, places: Points, species: tuple[int, ...], height: tuple[float, float], gap: float = 2.4) -> None:
        """Trees at given places where there is room for them."""
        keep = within(places, self.polygon, 0.8)
        for body in self.bodies:
            keep &= ~within(places, body, -gap)
        for shape in (*self.hard, *self.pads):
            keep &= ~within(places, shape, -0.8)
        for path in self.paths:
            for a, b in zip(path.line[:-1], path.line[1:], strict=True):
                keep &= segment_distance(places, a, b) > path.width / 2 + 0.7
        for x, y in places[keep]:
            if all((x - a) ** 2 + (y - b) ** 2 > 6 for a, b in self.trees[-60:]):
                self.trees.append((x, y))
                kind = species[int(self.rng.integers(len(species)))]
                size = float(self.rng.uniform(*height)) * (0.22 if SPECIES[kind] == "bush" else 1)
                self.draft.trees.append((float(x), float(y), kind, size, float(self.rng.random())))

    def stalls(self, x: float, y: float, length: float, width: float, angle: float, chance: float, truck: bool = False) -> None:
        """Rows of parked cars on a rectangle: bays of 2.5 by 5 m at right angles to its length, aisles of 6 m."""
        for row in parking_rows(width):
            for along in np.arange(-length / 2 + 1.4, length / 2 - 1.2, 2.5):
                a, b = turned(np.array([[along, row]]), angle)[0] + (x, y)
                kind = VEHICLES.index("truck") if truck else int(self.rng.random() < 0.12)
                flip = np.pi * self.rng.integers(2)
                turn = angle + np.pi / 2 + flip + self.rng.normal(0, 0.03)
                self.draft.stalls.append((float(a), float(b), float(turn), kind, chance))


def parking_rows(width: float) -> list[float]:
    """Where the rows of bays lie across a car park: pairs of rows with aisles between."""
    rows, y = [], -width / 2 + 2.6
    while y < width / 2 - 2.0:
        rows.append(y)
        y += 11.0 if len(rows) % 2 else 5.2
    return rows


_GROVE = (0, 1, 2, 0, 1, 0, 4)
_PADS: tuple[Surface, ...] = ("concrete", "asphalt", "paved", "asphalt", "lawn", "gravel")


def car_park(plot: Plot, x: float, y: float, length: float, width: float, angle: float) -> bool:
    """A marked car park, if there is room, with trees in some of its rows."""
    if not plot.lay("parking", x, y, length, width, angle):
        return False
    plot.stalls(x, y, length, width, angle, float(plot.rng.uniform(0.3, 0.9)))
    return True


def _fill(plot: Plot, kinds: tuple[str, ...], shared: tuple[str, ...], setback: float, gap: float, tries: int = 3) -> None:
    """Buildings along all edges, one after the other; kinds in `shared` have twins."""
    rng = plot.rng
    for i in rng.permutation(4):
        length = plot.edge(i)[3]
        at = float(rng.uniform(1, 5))
        while at < length - 12:
            for _ in range(tries):
                kind = kinds[int(rng.integers(len(kinds)))]
                if kind in shared:
                    index = plot.pools.shared(kind, plot.district.split, 2, rng)
                else:
                    index = plot.pools.own(kind, rng)
                half = plot.pools[index].size[0] / 2
                if at + half < length and plot.front(index, i, at + half, setback + rng.uniform(0, 3), gap):
                    at += 2 * half + gap + float(rng.uniform(0, 6))
                    break
            else:
                at += 9


def _inside(plot: Plot, kinds: tuple[str, ...], shared: tuple[str, ...], tries: int, gap: float) -> None:
    """Buildings in the middle of a block, parallel to one of its edges."""
    rng = plot.rng
    low, high = plot.polygon.min(axis=0), plot.polygon.max(axis=0)
    for _ in range(tries):
        kind = kinds[int(rng.integers(len(kinds)))]
        twin = kind in shared
        index = plot.pools.shared(kind, plot.district.split, 2, rng) if twin else plot.pools.own(kind, rng)
        for _ in range(5):
            x, y = rng.uniform(low, high)
            along = plot.edge(int(rng.integers(4)))[1]
            if plot.build(index, float(x), float(y), float(np.arctan2(along[1], along[0])), gap, 3.0):
                break


def _walks(plot: Plot, count: int, surface: Surface) -> None:
    """Slightly bent paths across a block."""
    rng = plot.rng
    for _ in range(count):
        a, b = (plot.polygon[i] + (plot.polygon[(i + 1) % 4] - plot.polygon[i]) * rng.uniform(0.1, 0.9)
                for i in rng.permutation(4)[:2])  # fmt: skip
        steps = np.linspace(0, 1, 14)[:, None]
        side = np.array([a[1] - b[1], b[0] - a[0]]) * rng.uniform(-0.12, 0.12)
        plot.path(a + (b - a) * steps + side * np.sin(np.pi * steps), float(rng.uniform(1.6, 3)), surface)


def terraces(plot: Plot) -> Surface:
    """Rows of identical terraces back to back, with a garden for each house."""
    rng = plot.rng
    index = plot.pools.shared("terrace", plot.district.split, 5, rng)
    look = plot.pools[index]
    length, depth = look.size
    first = plot.longest()
    for i in (first, first + 2, first + 1, first + 3):
        start, along, normal, edge = plot.edge(i)
        room = int((edge - 4) // (length + 3))
        slack = (edge - room * length) / (room + 1)
        angle = float(np.arctan2(along[1], along[0]))
        for n in range(room):
            at = slack + n * (length + slack) + length / 2
            if not plot.front(index, i, at, 4.0, 1.0):
                continue
            unit = length / max(1, round(length / 5.8))
            out = 4.0 + depth
            for m in range(round(length / unit)):
                x, y = start + along * (at - length / 2 + (m + 0.5) * unit) + normal * (out + 6)
                kind: Surface = ("garden", "garden", "lawn", "paved", "dirt", "garden")[int(rng.integers(6))]  # type: ignore[assignment]
                plot.lay(kind, float(x), float(y), unit, 12, angle, solid=False)
                fence = start + along * (at - length / 2 + m * unit) + normal * out
                if rng.random() < 0.8 and within(np.stack([fence, fence + normal * 12]), plot.polygon).all():
                    plot.hedge(fence, fence + normal * 12)
                if rng.random() < 0.4:
                    shed = plot.pools.shared("shed", "", 8, rng)
                    x, y = start + along * (at - length / 2 + (m + 0.4) * unit) + normal * (out + 10)
                    plot.build(shed, float(x), float(y), angle, 0.4)
    plot.plant(int(area(plot.polygon) / 70), (1, 2, 5, 5, 4, 5), (5, 12))
    return "garden"


def detached(plot: Plot) -> Surface:
    """Houses in gardens, with driveways, garages, and many trees."""
    rng = plot.rng
    for i in range(4):
        start, along, normal, edge = plot.edge(i)
        at = float(rng.uniform(8, 14))
        angle = float(np.arctan2(along[1], along[0]))
        while at < edge - 8:
            index = plot.pools.shared("house", "", 26, rng)
            setback = float(rng.uniform(5, 8))
            if plot.front(index, i, at, setback, 3.0):
                side = at + plot.pools[index].size[0] / 2 + 2.2
                x, y = start + along * side + normal * (setback + 1.0)
                drive: Surface = ("asphalt", "concrete", "gravel")[int(rng.integers(3))]  # type: ignore[assignment]
                if plot.lay(drive, float(x), float(y), 3.0, 2 * setback, angle, border=-1):
                    plot.draft.stalls.append((float(x), float(y), angle + np.pi / 2, 0, 0.5))
                    if rng.random() < 0.6:
                        x, y = start + along * side + normal * (2 * setback + 4)
                        plot.build(plot.pools.shared("shed", "", 8, rng), float(x), float(y), angle, 0.3)
                if rng.random() < 0.7:
                    fence = start + along * (at - plot.pools[index].size[0] / 2 - 3)
                    plot.hedge(fence + normal, fence + normal * 24)
                if rng.random() < 0.12:
                    x, y = start + along * at + normal * (setback + 17)
                    plot.lay("pool", float(x), float(y), rng.uniform(6, 9), rng.uniform(3, 4.5), angle, round_=rng.random() < 0.4)
                if rng.random() < 0.5:
                    x, y = start + along * at + normal * (setback + 12)
                    plot.lay("paved", float(x), float(y), rng.uniform(4, 8), rng.uniform(3, 5), angle, solid=False)
            at += float(rng.uniform(17, 23))
    plot.plant(int(area(plot.polygon) / 42), (0, 1, 2, 4, 5, 5, 1), (6, 17))
    return "garden"


def dormitories(plot: Plot) -> Surface:
    """Identical slabs in parallel rows on a lawn, with a car park at the end."""
    rng = plot.rng
    index = plot.pools.shared("dormitory", plot.district.split, 5, rng)
    length, depth = plot.pools[index].size
    start, along, normal, edge = plot.edge(plot.longest())
    _, _, _, across = plot.edge(plot.longest() + 1)
    angle = float(np.arctan2(along[1], along[0]))
    crossways = rng.random() < 0.5
    step, reach = (depth + rng.uniform(15, 22), length) if crossways else (length + rng.uniform(9, 16), depth)
    lanes = max(1, int((across - 6) // (reach + 14)))
    parked = edge * rng.uniform(0, 0.3)
    if parked > 18:
        x, y = start + along * (edge - parked / 2 - 3) + normal * (across / 2)
        car_park(plot, float(x), float(y), across - 16, parked - 8, angle + np.pi / 2)
    for lane in range(lanes):
        y0 = (lane + 0.5) * across / lanes
        for at in np.arange(step / 2 + 2, edge - 4, step):
            x, y = start + along * at + normal * y0
            if plot.build(index, float(x), float(y), angle + (np.pi / 2 if crossways else 0), 4.0, 2.0):
                foot = np.array([x, y]) + normal * (reach / 2 + 3.5)
                plot.path(np.stack([foot - along * step / 2, foot + along * step / 2]), 1.8, "concrete")
    spine = start + normal * (across / lanes)
    plot.path(np.stack([spine + along * 4, spine + along * (edge - 4)]), 2.4, "concrete")
    _walks(plot, 2, "concrete")
    plot.plant(int(area(plot.polygon) / 75), _GROVE, (8, 19))
    return "lawn"


def quadrangle(plot: Plot) -> Surface:
    """Colleges around a lawn with crossing paths."""
    old = plot.rng.random() < 0.45
    kinds = ("old courtyard", "old ushape", "old lshape", "old tshape") if old else (
        "courtyard", "lshape", "ushape", "slab", "tshape", "round")  # fmt: skip
    _fill(plot, (*kinds, "dormitory"), ("dormitory",), float(plot.rng.uniform(3, 9)), 6.0)
    if plot.rng.random() < 0.6:
        _inside(plot, kinds, (), 3, 9.0)
    _walks(plot, 3, "gravel" if old else "concrete")
    corners = inset(plot.polygon, np.full(4, 8.0))
    for a, b in ((0, 2), (1, 3)):
        plot.path(np.stack([corners[a], corners[b]]), 2.6, "gravel" if old else "concrete")
    for i in range(4):
        plot.path(np.stack([corners[i], corners[(i + 1) % 4]]), 2.2, "gravel" if old else "concrete")
    x, y = plot.middle
    plot.lay("plaza", float(x), float(y), 18, 18, 0.0, round_=True)
    plot.plant(int(area(plot.polygon) / 85), _GROVE, (9, 20), clump=18 if plot.rng.random() < 0.4 else 0.0)
    return "lawn"


def laboratories(plot: Plot) -> Surface:
    """Large flat-roofed buildings close together, with yards and car parks."""
    kinds = ("slab", "lshape", "tshape", "courtyard", "ushape", "hall", "slab")
    _fill(plot, kinds, (), float(plot.rng.uniform(2, 7)), 5.0)
    _inside(plot, kinds, (), 4, 6.0)
    _leftover_parking(plot)
    _walks(plot, 2, "concrete")
    x, y = plot.middle
    corners = inset(plot.polygon, np.full(4, 3.0))
    for corner in corners:
        plot.path(np.stack([corner, np.array([x, y])]), 3.0, "concrete")
    plot.plant(int(area(plot.polygon) / 110), _GROVE, (7, 17))
    return "lawn" if plot.rng.random() < 0.6 else "paved"


def _leftover_parking(plot: Plot) -> None:
    start, along, normal, edge = plot.edge(plot.longest())
    across = plot.edge(plot.longest() + 1)[3]
    angle = float(np.arctan2(along[1], along[0]))
    for size in ((46, 32), (34, 32), (40, 16), (24, 16), (16, 16)):
        for _ in range(6):
            x, y = start + along * plot.rng.uniform(0, edge) + normal * plot.rng.uniform(0, across)
            car_park(plot, float(x), float(y), *size, angle)


def offices(plot: Plot) -> Surface:
    """Towers and blocks on paved ground."""
    kinds = ("tower", "slab", "lshape", "courtyard", "ushape", "tower", "tshape")
    _fill(plot, kinds, (), 1.0, 4.0)
    _inside(plot, ("slab", "lshape"), (), 3, 5.0)
    _leftover_parking(plot)
    x, y = plot.middle
    plot.lay("plaza", float(x), float(y), 20, 14, 0.0)
    plot.plant(int(area(plot.polygon) / 150), (2, 1, 0), (6, 13))
    return "paved"


def industry(plot: Plot) -> Surface:
    """Halls in yards, identical ones in rows, with lorries, containers, and tanks."""
    rng = plot.rng
    alike = rng.random() < 0.55
    kinds = ("hall",) if alike else ("hall", "hall", "shop", "slab")
    _fill(plot, kinds, ("hall",) if alike else (), 8.0, 9.0)
    start, along, normal, edge = plot.edge(plot.longest())
    across = plot.edge(plot.longest() + 1)[3]
    angle = float(np.arctan2(along[1], along[0]))
    for _ in range(3):
        x, y = start + along * rng.uniform(0, edge) + normal * rng.uniform(0, across)
        car_park(plot, float(x), float(y), rng.uniform(20, 40), 16, angle)
    for _ in range(4):  # container yards
        x, y = start + along * rng.uniform(0, edge) + normal * rng.uniform(0, across)
        if plot.lay("gravel" if rng.random() < 0.5 else "dirt", float(x), float(y), 28, 18, angle):
            plot.hard.pop()
            for row in range(5):
                for step in range(2):
                    if rng.random() < 0.6:
                        a, b = turned(np.array([[step * 13 - 6.5, row * 3.2 - 6.5]]), angle)[0] + (x, y)
                        plot.build(plot.pools.shared("container", "", 10, rng), float(a), float(b), angle, 0.2)
    for _ in range(int(rng.integers(0, 5))):
        x, y = start + along * rng.uniform(0, edge) + normal * rng.uniform(0, across)
        plot.build(plot.pools.shared("tank", "", 5, rng), float(x), float(y), angle, 2)
    for _ in range(8):
        x, y = start + along * rng.uniform(5, edge - 5) + normal * rng.uniform(4, across - 4)
        if plot.free(rectangle(float(x), float(y), 9, 4, angle)):
            plot.draft.stalls.append((float(x), float(y), angle + float(rng.integers(4)) * np.pi / 2, 2, 0.5))
    plot.plant(int(area(plot.polygon) / 190), (2, 3, 5, 1, 0), (6, 14), clump=9)
    return "asphalt" if rng.random() < 0.65 else "concrete"


def retail(plot: Plot) -> Surface:
    """A store in its car park."""
    index = plot.pools.own("shop", plot.rng)
    i = int(plot.rng.integers(4))
    plot.front(index, i, plot.edge(i)[3] * plot.rng.uniform(0.4, 0.6), 6.0)
    start, along, normal, edge = plot.edge(i)
    angle = float(np.arctan2(along[1], along[0]))
    back = plot.edge(i + 1)[3]
    for length, width in ((edge * 0.8, 64), (edge * 0.7, 48), (edge * 0.6, 32), (edge * 0.4, 16)):
        x, y = start + along * edge / 2 + normal * (back - width / 2 - 6)
        if car_park(plot, float(x), float(y), length, width, angle):
            break
    _leftover_parking(plot)
    plot.plant(int(area(plot.polygon) / 300), (2, 1, 5), (5, 9))
    return "asphalt"


def old_town(plot: Plot) -> Surface:
    """Houses wall to wall along the streets, yards and back houses within."""
    rng = plot.rng
    if rng.random() < 0.42:  # one large old building among them
        kind = ("old courtyard", "old ushape", "old lshape", "church", "old tshape")[int(rng.integers(5))]
        index = plot.pools.own(kind, rng)
        i = int(rng.integers(4))
        plot.front(index, i, plot.edge(i)[3] / 2, 0.6, 0.2)
    for i in range(4):
        length = plot.edge(i)[3]
        at = 0.6
        while at < length - 7:
            index = plot.pools.shared("townhouse", "", 30, rng)
            half = plot.pools[index].size[0] / 2
            if at + half < length and plot.front(index, i, at + half, 0.4, 0.02, 0.2):
                at += 2 * half + 0.05
            else:
                at += 2.5
    for _ in range(14):
        x, y = rng.uniform(plot.polygon.min(axis=0), plot.polygon.max(axis=0))
        kind = "townhouse" if rng.random() < 0.4 else "shed"
        index = plot.pools.shared(kind, "", 30, rng)
        along = plot.edge(int(rng.integers(4)))[1]
        plot.build(index, float(x), float(y), float(np.arctan2(along[1], along[0])), 1.5)
    plot.plant(int(area(plot.polygon) / 80), (1, 2, 5, 5), (5, 12))
    return "paved" if rng.random() < 0.6 else "garden"


def civic(plot: Plot) -> Surface:
    """Public buildings around a square."""
    _fill(plot, ("old courtyard", "old ushape", "church", "old tshape", "old lshape", "courtyard"), (), 3.0, 5.0)
    x, y = plot.middle
    for size in (40, 28, 18):
        if plot.lay("plaza", float(x), float(y), size, size * 0.8, float(plot.rng.uniform(0, 3))):
            break
    plot.plant(int(area(plot.polygon) / 120), (2, 1, 0), (7, 15))
    return "paved"


def sports(plot: Plot) -> Surface:
    """Pitches, a track, courts, and identical halls."""
    rng = plot.rng
    start, along, normal, edge = plot.edge(plot.longest())
    across = plot.edge(plot.longest() + 1)[3]
    angle = float(np.arctan2(along[1], along[0]))
    halls = plot.pools.shared("hall", plot.district.split, 2, rng)

    def at(share: float, depth: float) -> tuple[float, float]:
        x, y = start + along * edge * share + normal * across * depth
        return float(x), float(y)

    if edge > 150 and across > 92 and rng.random() < 0.7:
        if plot.lay("track", *at(0.5, 0.5), 146, 84, angle, border=-2):
            plot.draft.patches.append(
                Patch("pitch", rectangle(*at(0.5, 0.5), 92, 58, angle), angle, 92, 58, float(rng.random()))
            )
        plot.front(plot.pools.own("stand", rng), plot.longest(), edge / 2, 1.0, 0.2)
    else:
        first = plot.longest()
        plot.front(halls, first + 1, across / 2, 4.0, 4.0)
        plot.front(halls, first + 3, across / 2, 4.0, 4.0)
        for length, width in ((96, 60), (70, 46), (50, 34)):
            plot.lay("pitch", *at(0.5, 0.5), length, width, angle)
        for share in np.arange(0.1, 0.95, 0.09):
            for depth in (0.15, 0.85):
                plot.lay("court", *at(float(share), depth), 30, 15.5, angle + np.pi / 2)
                plot.lay("court", *at(float(share), depth), 30, 15.5, angle)
    plot.build(plot.pools.shared("pavilion", plot.district.split, 3, rng), *at(0.1, 0.5), angle)
    _leftover_parking(plot)
    _walks(plot, 2, "gravel")
    plot.plant(int(area(plot.polygon) / 80), (2, 0, 3, 1), (8, 17))
    return "lawn"


def park(plot: Plot) -> Surface:
    """Lawn, groves, winding paths, often a pond, sometimes a museum."""
    rng = plot.rng
    if rng.random() < 0.75:
        kind = ("round", "old tshape", "old ushape", "pavilion", "ushape", "lshape")[int(rng.integers(6))]
        plot.front(plot.pools.own(kind, rng), int(rng.integers(4)), plot.edge(0)[3] / 2, rng.uniform(8, 20))
    low, high = plot.polygon.min(axis=0), plot.polygon.max(axis=0)
    if rng.random() < 0.6:
        x, y = plot.middle + rng.uniform(-0.15, 0.15, 2) * (high - low)
        for size in (0.5, 0.35, 0.2):
            extent = (high - low) * size * rng.uniform(0.7, 1.1, 2)
            if plot.lay("water", float(x), float(y), *extent.tolist(), float(rng.uniform(0, 3)), round_=True):
                break
    _walks(plot, 4, "gravel")
    plot.plant(int(area(plot.polygon) / 45), (0, 1, 2, 4, 0, 5), (8, 21), clump=16)
    plot.plant(int(area(plot.polygon) / 200), (0, 1, 2, 3, 4), (8, 20))
    return "lawn" if rng.random() < 0.6 else "meadow"


def school(plot: Plot) -> Surface:
    """A school with its playground and small pitch."""
    rng = plot.rng
    i = plot.longest()
    start, along, normal, edge = plot.edge(i)
    across = plot.edge(i + 1)[3]
    angle = float(np.arctan2(along[1], along[0]))
    for kind, share in ((("ushape", "tshape", "lshape")[int(rng.integers(3))], 0.3), ("slab", 0.75)):
        plot.front(plot.pools.own(kind, rng), i, edge * share, 6.0)
    for surface, size in (("playground", (30, 20)), ("pitch", (56, 36)), ("court", (30, 15.5)), ("playground", (22, 18))):
        for _ in range(6):
            x, y = start + along * rng.uniform(0, edge) + normal * rng.uniform(0, across)
            if plot.lay(surface, float(x), float(y), *size, angle):  # type: ignore[arg-type]
                break
    _leftover_parking(plot)
    plot.plant(int(area(plot.polygon) / 90), _GROVE, (7, 16))
    return "lawn"


def countryside(plot: Plot) -> Surface:
    """Fields, woods, a farm here and there."""
    rng = plot.rng
    use = rng.random()
    if use < 0.3:
        plot.plant(int(area(plot.polygon) / 38), (0, 1, 4, 4, 0), (9, 19))
        return "wood"
    angle = float(np.arctan2(*plot.edge(plot.longest())[1][::-1]))
    low, high = plot.polygon.min(axis=0), plot.polygon.max(axis=0)
    shape = inset(plot.polygon, np.full(4, 4.0))
    plot.draft.patches.append(Patch("field", shape, angle, *(high - low).tolist(), float(rng.random())))
    for i in range(4):
        start, along, normal, edge = plot.edge(i)
        places = start + along * rng.uniform(0, edge, int(edge / 7))[:, None] + normal * 1.8
        plot.plant_at(places, (0, 1, 5, 5, 3), (6, 12))
    if use > 0.75:
        for _ in range(4):
            x, y = plot.polygon[0] + (plot.middle - plot.polygon[0]) * rng.uniform(0.15, 0.5) + rng.uniform(-12, 12, 2)
            plot.build(plot.pools.shared("barn", "", 6, rng), float(x), float(y), angle, 3)
    return "field"


def riverside(plot: Plot) -> Surface:
    """The banks: promenades and trees on both sides of the water."""
    rng = plot.rng
    line = plot.terrain.river.line
    half = plot.terrain.river.width / 2
    inside = line[within(line, plot.polygon)]
    for side in (-1, 1):
        if len(inside) > 1:
            plot.path(inside + (side * (half + 12), 0), 3.4, "gravel")
            for off, spread in ((7.5, 1.0), (18, 1.5), (26, 5.0)):
                y = np.arange(inside[0, 1], inside[-1, 1], 9.0)
                x = np.interp(y, inside[:, 1], inside[:, 0]) + side * (half + off) + rng.normal(0, spread, len(y))
                places = np.stack([x, y + rng.normal(0, spread, len(y))], axis=1)[rng.random(len(y)) < 0.75]
                plot.plant_at(places[plot.terrain.bank(places) > 4], (2, 1, 0), (8, 14))
    return "lawn"


Use = Callable[[Plot], Surface]
_USES: dict[Character, tuple[tuple[Use, float], ...]] = {
    "university": ((quadrangle, 0.38), (laboratories, 0.27), (dormitories, 0.22), (sports, 0.06), (park, 0.07)),
    "housing": ((terraces, 0.5), (detached, 0.24), (dormitories, 0.13), (school, 0.07), (park, 0.06)),
    "industry": ((industry, 0.68), (retail, 0.16), (laboratories, 0.1), (park, 0.06)),
    "old town": ((old_town, 0.6), (civic, 0.24), (terraces, 0.1), (park, 0.06)),
    "centre": ((offices, 0.52), (civic, 0.16), (laboratories, 0.16), (retail, 0.1), (park, 0.06)),
    "sports": ((sports, 0.45), (dormitories, 0.27), (detached, 0.14), (school, 0.14)),
    "park": ((park, 0.36), (quadrangle, 0.24), (terraces, 0.16), (dormitories, 0.16), (detached, 0.08)),
    "countryside": ((countryside, 0.62), (detached, 0.2), (park, 0.18)),
    "river": ((riverside, 1.0),),
}


def develop(plot: Plot) -> Surface:
    """Fill a block by the character of its district; returns what covers the rest of it."""
    options = _USES[plot.district.character]
    chosen = plot.rng.choice(len(options), p=[weight for _, weight in options])
    surface = options[chosen][0](plot)
    plot.shrubs()
    return surface


def along_street(street: Street, draft: Draft, rng: np.random.Generator, terrain: Terrain) -> None:
    """Parked and moving cars on a street, and trees on the pavements of some."""
    steps = np.diff(street.line, axis=0)
    lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(steps, axis=1))])
    total = float(lengths[-1])
    trees = street.pavement > 1 and rng.random() < (0.75 if street.kind == "arterial" else 0.45)
    species = int(rng.integers(0, 4))
    size = float(rng.uniform(6, 14))

    def at(along: float, aside: float) -> tuple[float, float, float]:
        x, y = (float(np.interp(along, lengths, street.line[:, k])) for k in (0, 1))
        dx, dy = steps[min(int(np.searchsorted(lengths, along, side="right")) - 1, len(steps) - 1)]
        angle = float(np.arctan2(dy, dx))
        return x - np.sin(angle) * aside, y + np.cos(angle) * aside, angle

    parked = 0.0 if street.kind == "arterial" or street.pavement < 1 else float(rng.choice([0.0, 0.35, 0.7]))
    for side in (-1, 1):
        if parked:
            for along in np.arange(12, total - 12, 6.2):
                x, y, angle = at(float(along), side * (street.width / 2 - 1.05))
                draft.stalls.append((x, y, angle + (np.pi if side > 0 else 0), int(rng.random() < 0.1), parked))
        lanes = (1.9, 5.3) if street.kind == "arterial" else (1.5,)
        for lane in lanes:
            for along in np.arange(rng.uniform(3, 20), total, 17.0):
                x, y, angle = at(float(along + rng.uniform(-7, 7)), side * lane)
                kind = int(rng.choice(4, p=[0.82, 0.1, 0.05, 0.03]))
                chance = 0.28 if street.kind == "arterial" else 0.07
                draft.stalls.append((x, y, angle + (np.pi if side > 0 else 0), kind, chance))
        if trees:
            for along in np.arange(10, total - 10, rng.uniform(9, 15)):
                x, y, _ = at(float(along), side * (street.width / 2 + street.pavement * 0.6))
                if rng.random() < 0.85 and terrain.bank(np.array([x, y])) > 5:
                    draft.trees.append((x, y, species, size * float(rng.uniform(0.8, 1.2)), float(rng.random())))
