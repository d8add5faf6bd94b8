"""Open blocks: sports, parks, schools, fields, and river banks; and the vehicles and trees along streets."""

from __future__ import annotations

import numpy as np

from tools.world.city import Draft, Patch, Street, Surface, Terrain
from tools.world.geometry import area, inset, rectangle, within
from tools.world.plot import Plot

GROVE = (0, 1, 2, 0, 1, 0, 4)


def sports(plot: Plot) -> Surface:
    """Pitches, a track, courts, and identical halls."""
    rng = plot.rng
    start, along, normal, edge, angle = plot.edge(plot.longest())
    across = plot.edge(plot.longest() + 1).length
    halls = plot.pools.shared("hall", plot.district.split, 2, rng)

    def at(share: float, depth: float) -> tuple[float, float]:
        x, y = start + along * edge * share + normal * across * depth
        return float(x), float(y)

    if edge > 150 and across > 92 and rng.random() < 0.7:
        x, y = at(0.5, 0.5)
        if plot.lay("track", x, y, 146, 84, angle, border=-2):
            plot.draft.patches.append(
                Patch("pitch", rectangle(x, y, 92, 58, angle), angle, 92, 58, float(rng.random()))
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
    plot.leftover_parking()
    plot.walks(2, "gravel")
    plot.plant(int(area(plot.polygon) / 80), (2, 0, 3, 1), (8, 17))
    return "lawn"


def park(plot: Plot) -> Surface:
    """Lawn, groves, winding paths, often a pond, sometimes a museum."""
    rng = plot.rng
    if rng.random() < 0.75:
        kind = ("round", "old tshape", "old ushape", "pavilion", "ushape", "lshape")[int(rng.integers(6))]
        plot.front(plot.pools.own(kind, rng), int(rng.integers(4)), plot.edge(0).length / 2, rng.uniform(8, 20))
    low, high = plot.polygon.min(axis=0), plot.polygon.max(axis=0)
    if rng.random() < 0.6:
        x, y = np.array(plot.middle) + rng.uniform(-0.15, 0.15, 2) * (high - low)
        for size in (0.5, 0.35, 0.2):
            length, width = ((high - low) * size * rng.uniform(0.7, 1.1, 2)).tolist()
            if plot.lay("water", float(x), float(y), length, width, float(rng.uniform(0, 3)), round_=True):
                break
    plot.walks(4, "gravel")
    plot.plant(int(area(plot.polygon) / 45), (0, 1, 2, 4, 0, 5), (8, 21), clump=16)
    plot.plant(int(area(plot.polygon) / 200), (0, 1, 2, 3, 4), (8, 20))
    return "lawn" if rng.random() < 0.6 else "meadow"


def school(plot: Plot) -> Surface:
    """A school with its playground and small pitch."""
    rng = plot.rng
    i = plot.longest()
    edge, across = plot.edge(i), plot.edge(i + 1).length
    for kind, share in ((("ushape", "tshape", "lshape")[int(rng.integers(3))], 0.3), ("slab", 0.75)):
        plot.front(plot.pools.own(kind, rng), i, edge.length * share, 6.0)
    grounds: tuple[tuple[Surface, tuple[float, float]], ...] = (
        ("playground", (30, 20)), ("pitch", (56, 36)), ("court", (30, 15.5)), ("playground", (22, 18)),
    )  # fmt: skip
    for surface, size in grounds:
        for _ in range(6):
            place = edge.at(rng.uniform(0, edge.length), rng.uniform(0, across))
            if plot.lay(surface, *place, *size, edge.angle):
                break
    plot.leftover_parking()
    plot.plant(int(area(plot.polygon) / 90), GROVE, (7, 16))
    return "lawn"


def countryside(plot: Plot) -> Surface:
    """Fields, woods, a farm here and there."""
    rng = plot.rng
    use = rng.random()
    if use < 0.3:
        plot.plant(int(area(plot.polygon) / 38), (0, 1, 4, 4, 0), (9, 19))
        return "wood"
    angle = plot.edge(plot.longest()).angle
    low, high = plot.polygon.min(axis=0), plot.polygon.max(axis=0)
    shape = inset(plot.polygon, np.full(4, 4.0))
    length, width = (high - low).tolist()
    plot.draft.patches.append(Patch("field", shape, angle, length, width, float(rng.random())))
    for i in range(4):
        start, along, normal, edge, _ = plot.edge(i)
        places = start + along * rng.uniform(0, edge, int(edge / 7))[:, None] + normal * 1.8
        plot.plant_at(places, (0, 1, 5, 5, 3), (6, 12))
    if use > 0.75:
        for _ in range(4):
            inwards = (np.array(plot.middle) - plot.polygon[0]) * rng.uniform(0.15, 0.5)
            x, y = plot.polygon[0] + inwards + rng.uniform(-12, 12, 2)
            plot.build(plot.pools.shared("barn", "", 6, rng), float(x), float(y), angle, 3)
    return "field"


def riverside(plot: Plot) -> Surface:
    """The banks: promenades and trees on both sides of the water."""
    rng = plot.rng
    line = plot.terrain.river.line
    half = plot.terrain.river.width / 2
    inside = line[within(line, plot.polygon, -9)]
    for side in (-1, 1):
        if len(inside) > 1:
            plot.path(inside + np.array([side * (half + 12), 0]), 3.4, "gravel")
            for off, spread in ((7.5, 1.0), (18, 1.5), (26, 5.0)):
                y = np.arange(inside[0, 1], inside[-1, 1], 9.0)
                x = np.interp(y, inside[:, 1], inside[:, 0]) + side * (half + off) + rng.normal(0, spread, len(y))
                places = np.stack([x, y + rng.normal(0, spread, len(y))], axis=1)[rng.random(len(y)) < 0.75]
                plot.plant_at(places[plot.terrain.bank(places) > 4], (2, 1, 0), (8, 14))
    return "lawn"


def along_street(street: Street, draft: Draft, rng: np.random.Generator, terrain: Terrain) -> None:
    """Place parked and moving cars on a street, and trees on some pavements."""
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
