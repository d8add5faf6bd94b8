"""Viewpoints of pedestrians: on streets, paths, and open ground near a building, with a view of it.

A camera keeps clear of buildings, hedges, water, tree crowns, and parking bays. Its view of the building is estimated on the
plan, by straight lines to the walls that buildings, trees, and hedges may block.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lpn.core.arrays import Float64Array
from lpn.core.errors import InputError
from lpn.world.cameras import TILE, Panorama, Pose
from lpn.world.city import SPECIES, City, Target
from lpn.world.geometry import segment_distance
from lpn.world.meshes import CROWNS, VEHICLE_SIZES
from lpn.world.streets import beside, densified
from lpn.world.surroundings import Obstacles, distances

NEAR, FAR = 15.0, 45.0  # distance of a street camera from the walls, in metres
CLOSER = 9.0  # where little of it can be seen from there, open ground this far off will do too
EYES = (1.7, 2.5)  # metres above the ground
FIELDS = (60.0, 75.0)  # degrees across
APART = 20.0  # metres between panoramas, where there is room
_SPACING = 3.0  # of the places tried along streets and paths
_TRIED = 48  # places from which the view is judged, of each building
_ENOUGH = 8  # of them from which nearly half of the walls can be seen
_Kind = NDArray[np.int_]
_LANE, _PAVEMENT, _PATH, _OPEN = range(4)


@dataclass(frozen=True)
class Viewpoints:
    """Viewpoints around one building.

    Attributes:
        places: (n, 2).
        kind: (n,) lane, pavement, path, or open ground: 0 to 3.
        away: (n,) distance from the building's walls in metres.
        seen: (n,) visible fraction of the walls that face the viewpoint, 0 to 1.
        aims: (n, 2) middle of the visible walls.
    """

    places: Float64Array
    kind: _Kind
    away: Float64Array
    seen: Float64Array
    aims: Float64Array


class GroundLevel:
    """The city at ground level.

    Args:
        city: the plan.
    """

    def __init__(self, city: City) -> None:
        self._city = city
        self._ways, self._kinds = _ways(city)
        looks = [city.architectures[b.architecture] for b in city.buildings]
        self._bodies = np.array(
            [(b.x, b.y, *np.array(k.size) / 2, b.angle, k.height) for b, k in zip(city.buildings, looks, strict=True)]
        )
        across, low = np.array([CROWNS[name] for name in SPECIES]).T
        trees, stalls = city.trees, city.stalls
        species = trees.species.astype(int)
        # The outermost leaves of a crown hang a little outside its nominal radius.
        crowns = np.maximum(1.15 * across[species] * trees.height, 0.4)
        self._trees = np.stack([trees.x, trees.y, crowns, low[species] * trees.height, trees.height], axis=1)
        kinds = stalls.vehicle.astype(int)
        sizes = np.array(VEHICLE_SIZES)[kinds] / 2
        self._vehicles = np.column_stack([stalls.x, stalls.y, sizes, stalls.angle])
        self._tall = kinds > 0
        self._water = tuple(patch.polygon for patch in city.patches if patch.surface in ("water", "pool"))
        self._hedges = np.array(city.hedges).reshape(-1, 2, 2)

    def open(self, places: Float64Array) -> NDArray[np.bool_]:
        """Return on which places (n, 2) a person can stand, on dry ground and with nothing overhead."""
        dry: NDArray[np.bool_] = self._city.terrain.bank(places) > 4
        return dry & self._things(places.min(axis=0), places.max(axis=0)).room(places)

    def around(self, target: Target, near: float = NEAR, far: float = FAR) -> Viewpoints:
        """Find viewpoints `near` to `far` metres from a target's walls, on open ground too if the others show little of it.

        Raises:
            InputError: when there are none.
        """
        corners = self._city.footprint(self._city.buildings[target.building])
        low, high = corners.min(axis=0) - far, corners.max(axis=0) + far
        things = self._things(low, high)
        close = _inside(self._ways, low, high)
        viewpoints = self._judged(target, things, self._ways[close], self._kinds[close], (near, far), _TRIED)
        if (viewpoints.seen > 0.4).sum() < _ENOUGH:
            x, y = (np.arange(a, b, 3.0) for a, b in zip(low, high, strict=True))
            grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
            kinds = np.full(len(grid), _OPEN)
            more = self._judged(target, things, grid, kinds, (min(near, CLOSER), far), 3 * _TRIED)
            viewpoints = Viewpoints(
                *(np.concatenate(pair) for pair in zip(_columns(viewpoints), _columns(more), strict=True))
            )
        if not len(viewpoints.places):
            raise InputError(f"There is nowhere to stand around place {target.number} of this world; try another seed.")
        return viewpoints

    def _things(self, low: Float64Array, high: Float64Array) -> Obstacles:
        """Return the obstacles in a box, or reaching into it."""
        numbers = _inside(self._bodies[:, :2], low - 60, high + 60)
        trees = self._trees[_inside(self._trees[:, :2], low - 15, high + 15)]
        hedges = self._hedges[_inside(self._hedges.mean(axis=1), low - 60, high + 60)]
        near = _inside(self._vehicles[:, :2], low - 10, high + 10)
        water = tuple(p for p in self._water if (p.max(axis=0) > low - 2).all() and (p.min(axis=0) < high + 2).all())
        return Obstacles(numbers, self._bodies[numbers], trees, hedges, self._vehicles[near], self._tall[near], water)

    def _judged(
        self,
        target: Target,
        things: Obstacles,
        places: Float64Array,
        kinds: _Kind,
        reach: tuple[float, float],
        most: int,
    ) -> Viewpoints:
        city, building = self._city, self._city.buildings[target.building]
        corners = city.footprint(building)
        ring = np.concatenate([corners, corners[:1]])
        away = np.min([segment_distance(places, a, b) for a, b in pairwise(ring)], axis=0)
        keep = np.flatnonzero((away > reach[0]) & (away < reach[1]) & (city.terrain.bank(places) > 4))
        keep = keep[things.room(places[keep])]
        if len(keep) > most:
            keep = keep[np.random.default_rng([city.seed, 24, target.number]).permutation(len(keep))[:most]]
        height = city.architectures[building.architecture].height
        line = densified(ring, 5.0)
        views = [_view(things, target.building, line, height, place) for place in places[keep]]
        seen, aims = np.array([view[0] for view in views]), np.array([view[1] for view in views]).reshape(-1, 2)
        return Viewpoints(places[keep], kinds[keep], away[keep], seen, aims)


def _view(
    things: Obstacles, own: int, line: Float64Array, height: float, place: Float64Array
) -> tuple[float, Float64Array]:
    """Return the visible fraction of the walls along a ring (n, 2) that face a place, and the middle (2,) of the visible ones."""
    steps, middles = np.diff(line, axis=0), (line[1:] + line[:-1]) / 2
    outward = np.stack([steps[:, 1], -steps[:, 0]], axis=1)
    facing = middles[((place - middles) * outward).sum(axis=1) > 0]
    if not len(facing):
        return 0.0, middles.mean(axis=0)
    facing = facing[:: max(1, len(facing) // 8)]
    tops = np.full(len(facing), min(0.7 * height, 14.0))
    clear = things.clear(np.broadcast_to(place, facing.shape), facing, tops, own)
    aim: Float64Array = facing[clear].mean(axis=0) if clear.any() else facing.mean(axis=0)
    return float(clear.mean()), aim


def street_poses(outdoors: GroundLevel, city: City, target: Target, count: int) -> list[Pose]:
    """Choose the cameras of a target's street pictures: the first `count` of a list that is independent of it.

    The best view comes first; the next ones also look from other sides.

    Raises:
        InputError: when there are fewer viewpoints.
    """
    if not count:
        return []
    building = city.buildings[target.building]
    rng = np.random.default_rng([city.seed, 25, target.number])
    stands = outdoors.around(target)
    if len(stands.places) < count:
        raise InputError(f"Place {target.number} has room for {len(stands.places)} street pictures; ask for no more.")
    score = 1.3 * stands.seen - 0.12 * (stands.kind == _PATH) - 0.3 * (stands.kind == _OPEN) - 0.004 * stands.away
    score += rng.uniform(0, 0.1, len(score))
    side = np.arctan2(*(stands.places - (building.x, building.y)).T)
    aside = np.full(len(score), np.pi)
    middle = np.array([building.x, building.y])
    height = city.architectures[building.architecture].height
    poses: list[Pose] = []
    for _ in range(count):
        pick = int(np.argmax(score + 0.3 * np.minimum(aside / np.radians(80), 1)))
        score[pick] = -np.inf
        aside = np.minimum(aside, np.abs((side - side[pick] + np.pi) % (2 * np.pi) - np.pi))
        x, y = stands.places[pick].tolist()
        z = city.height(x, y) + rng.uniform(*EYES)
        dx, dy = 0.6 * stands.aims[pick] + 0.4 * middle - (x, y)
        up = city.height(building.x, building.y) + 0.5 * height - z
        tilt = np.degrees(np.arctan2(up, np.hypot(dx, dy))) + rng.uniform(-2, 2)
        heading = (np.degrees(np.arctan2(dx, dy)) + rng.uniform(-4, 4)) % 360
        poses.append(Pose(x, y, z, float(heading), float(np.clip(tilt, 0, 20)), float(rng.uniform(*FIELDS))))
    return poses


def panoramas(
    outdoors: GroundLevel, city: City, count: int, covered: Callable[[Target, Float64Array], NDArray[np.bool_]]
) -> dict[int, list[Panorama]]:
    """Choose the cameras of `count` panoramas near each target, by its number; the first ones are independent of `count`.

    They stand on carriageways, else on paths, a few metres to some 60 m from the building and apart from each other. No tile
    around a camera crosses the middle of the river.

    Args:
        covered: returns for which places (n, 2) the satellite image of a target's sector contains a tile around them.

    Raises:
        InputError: when there are fewer viewpoints.
    """
    river = city.terrain.river
    choice = {target.number: outdoors.around(target, 6.0, 60.0) for target in city.targets} if count else {}
    taken = np.zeros((0, 2))
    by_target: dict[int, list[Panorama]] = {target.number: [] for target in city.targets}
    for number in range(count):
        for target in city.targets:
            stands = choice[target.number]
            rng = np.random.default_rng([city.seed, 26, target.number, number])
            own_side = city.terrain.bank(stands.places) > TILE / 2 - river.width / 2 + 1
            score = (
                0.5 * stands.seen - 0.012 * stands.away - 0.25 * (stands.kind == _PATH) - 0.5 * (stands.kind == _OPEN)
            )
            score -= 0.2 * (stands.kind == _PAVEMENT) + 2.0 * ~covered(target, stands.places)
            if len(taken):
                score -= np.clip(APART - distances(stands.places, taken).min(axis=1), 0, None) * (4 / APART)
            score[~own_side] = -np.inf
            pick = int(np.argmax(score))
            x, y = stands.places[pick].tolist()
            if not own_side[pick] or (len(taken) and distances(stands.places[pick][None], taken).min() < 1):
                raise InputError(f"Place {target.number} has room for {number} panoramas; ask for no more.")
            taken = np.concatenate([taken, stands.places[pick][None]])
            by_target[target.number].append(Panorama(x, y, city.height(x, y) + float(rng.uniform(2.1, 2.5))))
    return by_target


def _ways(city: City) -> tuple[Float64Array, _Kind]:
    """Return places (n, 2) along streets and paths, and the kind (n,) of each."""
    pieces: list[tuple[Float64Array, int]] = []
    for street in city.streets:
        line = densified(street.line, _SPACING)
        lane = 1.9 if street.kind == "arterial" else 1.5
        pieces.extend((beside(line, offset), _LANE) for offset in (-lane, 0.0, lane))
        if street.pavement > 1:
            aside = street.width / 2 + street.pavement / 2
            pieces.extend((beside(line, side * aside), _PAVEMENT) for side in (-1, 1))
    pieces.extend((densified(path.line, _SPACING), _PATH) for path in city.paths)
    return np.concatenate([p for p, _ in pieces]), np.concatenate([np.full(len(p), kind) for p, kind in pieces])


def _inside(points: Float64Array, low: Float64Array, high: Float64Array) -> NDArray[np.int_]:
    return np.flatnonzero(((points > low) & (points < high)).all(axis=1))


def _columns(stands: Viewpoints) -> tuple[Float64Array, _Kind, Float64Array, Float64Array, Float64Array]:
    return stands.places, stands.kind, stands.away, stands.seen, stands.aims
