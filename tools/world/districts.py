"""The use of blocks by the character of their district: buildings, paths, and trees that fill them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tools.world.city import Character, Surface
from tools.world.geometry import area, inset, rectangle, turned, within
from tools.world.grounds import GROVE, countryside, park, riverside, school, sports
from tools.world.plot import Plot


def _drawn(plot: Plot, kinds: tuple[str, ...], shared: tuple[str, ...]) -> int:
    """Draw an architecture; kinds in `shared` have twins."""
    kind = kinds[int(plot.rng.integers(len(kinds)))]
    if kind in shared:
        return plot.pools.shared(kind, plot.district.split, 2, plot.rng)
    return plot.pools.own(kind, plot.rng)


def _fill(plot: Plot, kinds: tuple[str, ...], shared: tuple[str, ...], setback: float, gap: float) -> None:
    """Place buildings along all edges in turn, each of the first of three kinds that fits."""
    rng = plot.rng
    for i in rng.permutation(4):
        length = plot.edge(i).length
        at = float(rng.uniform(1, 5))
        while at < length - 12:
            for _ in range(3):
                index = _drawn(plot, kinds, shared)
                half = plot.pools[index].size[0] / 2
                if at + half < length and plot.front(index, i, at + half, setback + rng.uniform(0, 3), gap):
                    at += 2 * half + gap + float(rng.uniform(0, 6))
                    break
            else:
                at += 9


def _inside(plot: Plot, kinds: tuple[str, ...], tries: int, gap: float) -> None:
    """Place buildings inside a block, parallel to one of its edges."""
    rng = plot.rng
    low, high = plot.polygon.min(axis=0), plot.polygon.max(axis=0)
    for _ in range(tries):
        index = _drawn(plot, kinds, ())
        for _ in range(5):
            x, y = rng.uniform(low, high)
            if plot.build(index, float(x), float(y), plot.edge(int(rng.integers(4))).angle, gap, 3.0):
                break


def terraces(plot: Plot) -> Surface:
    """Rows of identical terraces back to back, with a garden for each house."""
    rng = plot.rng
    index = plot.pools.shared("terrace", plot.district.split, 5, rng)
    length, depth = plot.pools[index].size
    first = plot.longest()
    for i in (first, first + 2, first + 1, first + 3):
        edge = plot.edge(i)
        room = max(0, int((edge.length - 4) // (length + 3)))
        slack = (edge.length - room * length) / (room + 1)
        for n in range(room):
            at = slack + n * (length + slack) + length / 2
            if not plot.front(index, i, at, 4.0, 1.0):
                continue
            unit = length / max(1, round(length / 5.8))
            out = 4.0 + depth
            for m in range(round(length / unit)):
                kind: Surface = ("garden", "garden", "lawn", "paved", "dirt", "garden")[int(rng.integers(6))]
                garden = edge.at(at - length / 2 + (m + 0.5) * unit, out + 6)
                plot.lay(kind, *garden, unit, 12, edge.angle, solid=False)
                fence = np.array(edge.at(at - length / 2 + m * unit, out))
                if rng.random() < 0.8 and within(np.stack([fence, fence + edge.normal * 12]), plot.polygon).all():
                    plot.hedge(fence, fence + edge.normal * 12)
                if rng.random() < 0.4:
                    shed = plot.pools.shared("shed", "", 8, rng)
                    plot.build(shed, *edge.at(at - length / 2 + (m + 0.4) * unit, out + 10), edge.angle, 0.4)
    plot.plant(int(area(plot.polygon) / 70), (1, 2, 5, 5, 4, 5), (5, 12))
    return "garden"


def detached(plot: Plot) -> Surface:
    """Houses in gardens, with driveways, garages, and many trees."""
    rng = plot.rng
    for i in range(4):
        edge = plot.edge(i)
        at = float(rng.uniform(8, 14))
        while at < edge.length - 8:
            index = plot.pools.shared("house", "", 26, rng)
            setback = float(rng.uniform(5, 8))
            if plot.front(index, i, at, setback, 3.0):
                side = at + plot.pools[index].size[0] / 2 + 2.2
                drive: Surface = ("asphalt", "concrete", "gravel")[int(rng.integers(3))]
                middle = edge.at(side, setback + 1.0)
                if plot.lay(drive, *middle, 3.0, 2 * setback, edge.angle, border=-1):
                    plot.draft.stalls.append((*middle, edge.angle + np.pi / 2, 0, 0.5))
                    if rng.random() < 0.6:
                        shed = plot.pools.shared("shed", "", 8, rng)
                        plot.build(shed, *edge.at(side, 2 * setback + 4), edge.angle, 0.3)
                if rng.random() < 0.7:
                    fence = edge.start + edge.along * (at - plot.pools[index].size[0] / 2 - 3)
                    plot.hedge(fence + edge.normal, fence + edge.normal * 24)
                if rng.random() < 0.12:
                    size = float(rng.uniform(6, 9)), float(rng.uniform(3, 4.5))
                    plot.lay("pool", *edge.at(at, setback + 17), *size, edge.angle, round_=bool(rng.random() < 0.4))
                if rng.random() < 0.5:
                    size = rng.uniform(4, 8), rng.uniform(3, 5)
                    plot.lay("paved", *edge.at(at, setback + 12), *size, edge.angle, solid=False)
            at += float(rng.uniform(17, 23))
    plot.plant(int(area(plot.polygon) / 42), (0, 1, 2, 4, 5, 5, 1), (6, 17))
    return "garden"


def dormitories(plot: Plot) -> Surface:
    """Identical slabs in parallel rows on a lawn, with a car park at the end."""
    rng = plot.rng
    index = plot.pools.shared("dormitory", plot.district.split, 5, rng)
    length, depth = plot.pools[index].size
    one = plot.edge(plot.longest())
    start, along, normal, edge, angle = one
    across = plot.edge(plot.longest() + 1).length
    crossways = rng.random() < 0.5
    step, reach = (depth + rng.uniform(15, 22), length) if crossways else (length + rng.uniform(9, 16), depth)
    lanes = max(1, int((across - 6) // (reach + 14)))
    parked = edge * rng.uniform(0, 0.3)
    if parked > 18:
        plot.car_park(*one.at(edge - parked / 2 - 3, across / 2), across - 16, parked - 8, angle + np.pi / 2)
    for lane in range(lanes):
        y0 = (lane + 0.5) * across / lanes
        for at in np.arange(step / 2 + 2, edge - 4, step):
            middle = one.at(at, y0)
            if plot.build(index, *middle, angle + (np.pi / 2 if crossways else 0), 4.0, 2.0):
                foot = np.array(middle) + normal * (reach / 2 + 3.5)
                plot.path(np.stack([foot - along * step / 2, foot + along * step / 2]), 1.8, "concrete")
    spine = start + normal * (across / lanes)
    plot.path(np.stack([spine + along * 4, spine + along * (edge - 4)]), 2.4, "concrete")
    plot.walks(2, "concrete")
    plot.plant(int(area(plot.polygon) / 75), GROVE, (8, 19))
    return "lawn"


def quadrangle(plot: Plot) -> Surface:
    """Colleges around a lawn with crossing paths."""
    old = plot.rng.random() < 0.45
    kinds = ("old courtyard", "old ushape", "old lshape", "old tshape") if old else (
        "courtyard", "lshape", "ushape", "slab", "tshape", "lshape", "courtyard", "tshape", "round")  # fmt: skip
    _fill(plot, (*kinds, "dormitory"), ("dormitory",), float(plot.rng.uniform(3, 9)), 6.0)
    if plot.rng.random() < 0.6:
        _inside(plot, kinds, 3, 9.0)
    plot.walks(3, "gravel" if old else "concrete")
    corners = inset(plot.polygon, np.full(4, 8.0))
    for a, b in ((0, 2), (1, 3)):
        plot.path(np.stack([corners[a], corners[b]]), 2.6, "gravel" if old else "concrete")
    for i in range(4):
        plot.path(np.stack([corners[i], corners[(i + 1) % 4]]), 2.2, "gravel" if old else "concrete")
    plot.lay("plaza", *plot.middle, 18, 18, 0.0, round_=True)
    plot.plant(int(area(plot.polygon) / 85), GROVE, (9, 20), clump=18 if plot.rng.random() < 0.4 else 0.0)
    return "lawn"


def laboratories(plot: Plot) -> Surface:
    """Large flat-roofed buildings close together, with yards and car parks."""
    kinds = ("slab", "lshape", "tshape", "courtyard", "ushape", "hall", "slab")
    _fill(plot, kinds, (), float(plot.rng.uniform(2, 7)), 5.0)
    _inside(plot, kinds, 4, 6.0)
    plot.leftover_parking()
    plot.walks(2, "concrete")
    for corner in inset(plot.polygon, np.full(4, 3.0)):
        plot.path(np.stack([corner, plot.middle]), 3.0, "concrete")
    plot.islands(24)
    plot.plant_beds((2, 1, 0, 5), (7, 16))
    plot.plant(int(area(plot.polygon) / 140), GROVE, (7, 17))
    return "lawn" if plot.rng.random() < 0.6 else "paved"


def offices(plot: Plot) -> Surface:
    """Towers and blocks on paved ground."""
    kinds = ("tower", "slab", "lshape", "courtyard", "ushape", "tower", "tshape")
    _fill(plot, kinds, (), 1.0, 4.0)
    _inside(plot, ("slab", "lshape"), 3, 5.0)
    plot.leftover_parking()
    plot.lay("plaza", *plot.middle, 20, 14, 0.0)
    plot.islands(26)
    plot.plant_beds((2, 1, 0, 5), (6, 14))
    plot.plant(int(area(plot.polygon) / 190), (2, 1, 0), (6, 13))
    return "paved"


def industry(plot: Plot) -> Surface:
    """Halls in yards, identical ones in rows, with lorries, containers, and tanks."""
    rng = plot.rng
    alike = rng.random() < 0.55
    kinds = ("hall",) if alike else ("hall", "hall", "shop", "slab")
    _fill(plot, kinds, ("hall",) if alike else (), 8.0, 9.0)
    edge, across = plot.edge(plot.longest()), plot.edge(plot.longest() + 1).length
    angle = edge.angle

    def somewhere() -> tuple[float, float]:
        return edge.at(rng.uniform(0, edge.length), rng.uniform(0, across))

    for _ in range(3):
        plot.car_park(*somewhere(), rng.uniform(20, 40), 16, angle)
    for _ in range(4):  # container yards
        x, y = somewhere()
        if plot.lay("gravel" if rng.random() < 0.5 else "dirt", x, y, 28, 18, angle):
            plot.hard.pop()
            for row in range(5):
                for step in range(2):
                    if rng.random() < 0.6:
                        a, b = turned(np.array([[step * 13 - 6.5, row * 3.2 - 6.5]]), angle)[0] + (x, y)
                        plot.build(plot.pools.shared("container", "", 10, rng), float(a), float(b), angle, 0.2)
    for _ in range(int(rng.integers(0, 5))):
        place = somewhere()
        plot.build(plot.pools.shared("tank", "", 5, rng), *place, angle, 2)
    for _ in range(8):
        place = edge.at(rng.uniform(5, edge.length - 5), rng.uniform(4, across - 4))
        if plot.free(rectangle(*place, 9, 4, angle)):
            plot.draft.stalls.append((*place, angle + float(rng.integers(4)) * np.pi / 2, 2, 0.5))
    plot.islands(10)
    plot.plant_beds((2, 1, 0, 5), (6, 13))
    plot.plant(int(area(plot.polygon) / 190), (2, 3, 5, 1, 0), (6, 14), clump=9)
    return "asphalt" if rng.random() < 0.65 else "concrete"


def retail(plot: Plot) -> Surface:
    """A store in its car park."""
    index = plot.pools.own("shop", plot.rng)
    i = int(plot.rng.integers(4))
    edge, back = plot.edge(i), plot.edge(i + 1).length
    plot.front(index, i, edge.length * plot.rng.uniform(0.4, 0.6), 6.0)
    for share, width in ((0.8, 64), (0.7, 48), (0.6, 32), (0.4, 16)):
        middle = edge.at(edge.length / 2, back - width / 2 - 6)
        if plot.car_park(*middle, edge.length * share, width, edge.angle):
            break
    plot.leftover_parking()
    plot.islands(14)
    plot.plant_beds((2, 1, 5), (5, 11))
    plot.plant(int(area(plot.polygon) / 300), (2, 1, 5), (5, 9))
    return "asphalt"


def old_town(plot: Plot) -> Surface:
    """Houses wall to wall along the streets, yards and back houses within."""
    rng = plot.rng
    if rng.random() < 0.42:  # one large old building among them
        kind = ("old courtyard", "old ushape", "old lshape", "church", "old tshape")[int(rng.integers(5))]
        index = plot.pools.own(kind, rng)
        i = int(rng.integers(4))
        plot.front(index, i, plot.edge(i).length / 2, 0.6, 0.2)
    for i in range(4):
        length = plot.edge(i).length
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
        plot.build(index, float(x), float(y), plot.edge(int(rng.integers(4))).angle, 1.5)
    plot.plant(int(area(plot.polygon) / 80), (1, 2, 5, 5), (5, 12))
    return "paved" if rng.random() < 0.6 else "garden"


def civic(plot: Plot) -> Surface:
    """Public buildings around a square."""
    _fill(plot, ("old courtyard", "old ushape", "church", "old tshape", "old lshape", "courtyard"), (), 3.0, 5.0)
    for size in (40, 28, 18):
        if plot.lay("plaza", *plot.middle, size, size * 0.8, float(plot.rng.uniform(0, 3))):
            break
    plot.islands(20)
    plot.plant_beds((2, 1, 0), (7, 16))
    plot.plant(int(area(plot.polygon) / 150), (2, 1, 0), (7, 15))
    return "paved"


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
    """Fill a block by the character of its district, and return the surface of the rest."""
    options = _USES[plot.district.character]
    chosen = plot.rng.choice(len(options), p=[weight for _, weight in options])
    surface = options[chosen][0](plot)
    plot.shrubs()
    return surface
