"""The planner: from a seed to districts, river, streets, blocks, buildings, and targets."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import product

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.errors import InputError
from tools.world.city import (
    Block,
    Building,
    Character,
    City,
    District,
    Draft,
    ParkingBays,
    River,
    RoadBridge,
    Split,
    Street,
    Target,
    Terrain,
    Trees,
)  # fmt: skip
from tools.world.districts import develop
from tools.world.geometry import Waves, inset
from tools.world.grounds import along_street
from tools.world.plot import ArchitecturePool, Plot
from tools.world.streets import ARTERIAL, RIM, SIDE, STRIP, Quad, Warp, densified, divide, margin, street

TEST_SHARE = 0.35
TWIN_SHARE = 0.5
PER_DISTRICT = 23
SPACING = 42.0  # metres between targets at least
NAMES = {
    "university": "College",
    "housing": "Garden",
    "industry": "Dock",
    "old town": "Minster",
    "centre": "Exchange",
    "sports": "Arena",
    "park": "Park",
}
_ORDER: tuple[Character, ...] = (
    "university", "housing", "old town", "industry", "university", "centre", "housing", "sports", "university", "park",
)  # fmt: skip
_BEND = 24.0  # metres that waves bend streets, about
_JITTER = 32.0  # metres that the corners of districts lie off a square grid, at most
_BLOCKS: dict[Character, tuple[float, float, float]] = {  # longest, widest, slant
    "university": (215, 150, 0.08),
    "housing": (165, 84, 0.07),
    "industry": (190, 120, 0.04),
    "old town": (110, 78, 0.15),
    "centre": (125, 90, 0.04),
    "sports": (190, 130, 0.05),
    "park": (230, 170, 0.09),
    "countryside": (240, 200, 0.1),
    "river": (1e4, 1e4, 0.0),
}


def plan_city(seed: int, buildings: int) -> City:
    """Plan a city around `buildings` targets.

    Raises:
        InputError: when the seed is negative or fewer than 2 buildings are asked for.
    """
    if seed < 0 or buildings < 2:
        raise InputError(
            f"The world has seed {seed} and {buildings} buildings; expected a seed from 0, 2 buildings or more."
        )
    for more in range(1, 6):
        city = _attempt(seed, buildings, more)
        if city is not None:
            return city
    raise InputError(f"No city with {buildings} buildings came of seed {seed}; try another seed.")


def _attempt(seed: int, wanted: int, more: int) -> City | None:
    rng = np.random.default_rng([seed, 1])
    count = max(2, round(wanted / PER_DISTRICT) + (more - 1) * max(1, round(wanted / PER_DISTRICT / 5)))
    rows = max(1, round(np.sqrt(count * 0.8)))
    west = max(1, round(count * (1 - TEST_SHARE) / rows))
    east = max(1, round(count * TEST_SHARE / rows))
    widths = [RIM] + [SIDE] * west + [STRIP] + [SIDE] * east + [RIM]
    heights = [RIM] + [SIDE] * rows + [RIM]
    xs = np.concatenate([[0], np.cumsum(widths)]) - sum(widths) / 2
    ys = np.concatenate([[0], np.cumsum(heights)]) - sum(heights) / 2
    warp = Warp(Waves.draw(rng, _BEND, 700, 2200), Waves.draw(rng, _BEND, 700, 2200))
    nodes = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1)
    inner = nodes[1:-1, 1:-1]
    inner += rng.uniform(-_JITTER, _JITTER, inner.shape)
    # The river's banks stay as far apart as they were drawn.
    drift = rng.uniform(-30, 30, len(ys))
    nodes[west + 1, :, 0], nodes[west + 2, :, 0] = xs[west + 1] + drift, xs[west + 2] + drift
    nodes[west + 2, :, 1] = nodes[west + 1, :, 1]
    terrain = _river(nodes[west + 1], nodes[west + 2], warp, rng)

    districts: list[District] = []
    streets: list[Street] = []
    blocks: list[Block] = []
    draft = Draft()
    pools = ArchitecturePool(np.random.default_rng([seed, 2]), draft.architectures)
    used: Counter[str] = Counter()
    order = list(rng.permutation(len(_ORDER) // 2)) + list(range(len(_ORDER) // 2, len(_ORDER)))
    turn = {"train": 0, "test": 0}
    for i, j in product(range(len(widths)), range(len(heights))):
        split: Split = "train" if i <= west else "test"
        rim = i in (0, len(widths) - 1) or j in (0, len(heights) - 1)
        character: Character = "river" if i == west + 1 else "countryside"
        if rim or i == west + 1:
            split = ""
        else:
            character = _ORDER[order[turn[split] % len(order)]]
            turn[split] += 1
        corners = np.stack([nodes[i, j], nodes[i + 1, j], nodes[i + 1, j + 1], nodes[i, j + 1]])
        used[character] += 1
        name = f"{NAMES[character]} {used[character]}" if split else character.capitalize()
        polygon = warp(densified(np.concatenate([corners, corners[:1]]), 40.0))[:-1]
        districts.append(District(len(districts), name, character, split, polygon))
        own = np.random.default_rng([seed, 3, i, j])
        quad = Quad(corners, (margin("arterial"),) * 4)
        for number, piece in enumerate(
            divide(quad, *_BLOCKS[character], own, warp, streets, character == "countryside")
        ):
            block_rng = np.random.default_rng([seed, 4, i, j, number])
            outline = inset(warp(piece.corners), np.array(piece.margins))
            plot = Plot(outline, districts[-1], block_rng, draft, pools, terrain)
            surface = develop(plot)
            blocks.append(Block(outline, districts[-1].number, surface))
    streets.extend(_arterials(nodes, west + 1, warp))
    bridges = _bridges(nodes, west + 1, warp)
    for line in streets:
        along_street(line, draft, np.random.default_rng([seed, 5, len(draft.stalls)]), terrain)
    targets = _choose(draft, districts, wanted, np.random.default_rng([seed, 6]))
    if targets is None:
        return None
    _forget_unused(draft)
    return City(
        seed, tuple(districts), tuple(streets), tuple(blocks), tuple(draft.architectures), tuple(draft.buildings),
        tuple(draft.patches), tuple(draft.paths), tuple(draft.hedges), tuple(bridges), terrain,
        Trees(*_columns(draft.trees)), ParkingBays(*_columns(draft.stalls)), targets,
    )  # fmt: skip


def _forget_unused(draft: Draft) -> None:
    """Drop architectures without a building, for which there was no room."""
    used = sorted({building.architecture for building in draft.buildings})
    renumbered = {old: new for new, old in enumerate(used)}
    draft.architectures[:] = [draft.architectures[i] for i in used]
    draft.buildings[:] = [replace(b, architecture=renumbered[b.architecture]) for b in draft.buildings]


def _columns(
    rows: list[tuple[float, float, int, float, float]] | list[tuple[float, float, float, int, float]],
) -> Float64Array:
    return np.array(rows, dtype=np.float64).reshape(-1, 5).T


def _river(west: Float64Array, east: Float64Array, warp: Warp, rng: np.random.Generator) -> Terrain:
    middle = warp(densified((west + east) / 2, 30.0))
    # Every y has one x; smoothed, so that the arterials' corners do not show in the water.
    y = np.arange(middle[0, 1] - 400, middle[-1, 1] + 400, 20.0)
    x = np.interp(y, middle[:, 1], middle[:, 0])
    kernel = np.hanning(21) / np.hanning(21).sum()
    x = np.convolve(np.pad(x, 10, mode="edge"), kernel, mode="valid")
    river = River(np.stack([x, y], axis=1), float(rng.uniform(70, 88)), -3.2)
    return Terrain(Waves.draw(rng, 7, 420, 1500), river)


def _arterials(nodes: Float64Array, river: int, warp: Warp) -> list[Street]:
    """Lay arterials along the grid's lines; those from west to east stop at the river, where their bridges begin."""
    columns, rows, _ = nodes.shape
    streets: list[Street] = []
    for i in range(columns):
        streets.extend(street(nodes[i, j : j + 2], "arterial", warp) for j in range(rows - 1))
    for j in range(rows):
        streets.extend(street(nodes[i : i + 2, j], "arterial", warp) for i in range(columns - 1) if i != river)
    return streets


def _bridges(nodes: Float64Array, river: int, warp: Warp) -> list[RoadBridge]:
    bridges = []
    for j in range(nodes.shape[1]):
        a, b = warp(nodes[river, j]), warp(nodes[river + 1, j])
        along = b - a
        middle = (a + b) / 2
        angle = float(np.arctan2(along[1], along[0]))
        bridges.append(
            RoadBridge(float(middle[0]), float(middle[1]), angle, float(np.linalg.norm(along)), ARTERIAL + 5)
        )
    return bridges


def _choose(
    draft: Draft, districts: list[District], wanted: int, rng: np.random.Generator
) -> tuple[Target, ...] | None:
    """Choose targets for both splits: half of them twins if possible, well apart, and evenly from all districts."""
    tests = max(1, round(wanted * TEST_SHARE))
    chosen: list[tuple[Building, Split]] = []
    for split, number in (("train", wanted - tests), ("test", tests)):
        picked = _pick(draft, [d.number for d in districts if d.split == split], number, rng)
        if picked is None:
            return None
        chosen.extend((building, "train" if split == "train" else "test") for building in picked)
    counts = Counter(building.architecture for building, _ in chosen)
    groups = {key: i + 1 for i, key in enumerate(sorted(key for key, n in counts.items() if n > 1))}
    chosen.sort(key=lambda pair: (pair[1] != "train", pair[0].number))
    return tuple(
        Target(i + 1, building.number, groups.get(building.architecture, 0), split)
        for i, (building, split) in enumerate(chosen)
    )


def _pick(draft: Draft, districts: list[int], number: int, rng: np.random.Generator) -> list[Building] | None:
    counts = Counter(building.architecture for building in draft.buildings if building.district in districts)
    queues: dict[tuple[int, bool], list[Building]] = {(d, twin): [] for d in districts for twin in (True, False)}
    for building in draft.buildings:
        if building.notable and building.district in districts:
            queues[building.district, counts[building.architecture] > 2].append(building)
    for queue in queues.values():
        queue[:] = [queue[i] for i in rng.permutation(len(queue))]
    picked: list[Building] = []
    places = np.zeros((0, 2))
    while len(picked) < number and any(queues.values()):
        for key in product(districts, (True, False)):
            queue = queues[key]
            twins = sum(counts[b.architecture] > 2 for b in picked)
            if key[1] and twins > TWIN_SHARE * number and any(queues[d, False] for d in districts):
                continue
            while queue and len(picked) < number:
                building = queue.pop()
                place = np.array([building.x, building.y])
                if len(places) and np.linalg.norm(places - place, axis=1).min() < SPACING:
                    continue
                picked.append(building)
                places = np.concatenate([places, place[None]])
                break
    return picked if len(picked) == number else None
