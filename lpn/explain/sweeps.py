"""Sweeps: score, rank, and part cosines of one query over a range of turns, shifts, or zooms, or over the ten weathers.

LPN divides a picture into square rings around its centre. A turn changes the rings little, but a shift moves the target
from ring to ring.

A rotation sweep also estimates the heading: the direction h, in degrees clockwise from north, of the top of the query.
Turning the query clockwise by h makes it north-up, like the tiles. `Change.rotate` counts counter-clockwise, so the best
angle r estimates h = -r (mod 360).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar, get_args

import numpy as np

from lpn import retrieval
from lpn.core.arrays import Float32Array, UInt8Array
from lpn.core.csv_cells import csv_bytes
from lpn.core.errors import InputError
from lpn.core.views import View
from lpn.descriptors.transforms import MAX_SCALE, UNCHANGED, Change
from lpn.descriptors.weather import WEATHERS, Weather
from lpn.models.base import Model
from lpn.retrieval import Match, Ranking

# The property that a sweep varies. Rotation is in degrees counter-clockwise. A shift to the right or down is in pixels of the
# network's input. Zoom is a factor. A weather's number is its place among `WEATHERS`.
SweptProperty = Literal["rotation", "shift", "shift-down", "zoom", "weather"]
UNITS: dict[SweptProperty, str] = {"rotation": "°", "shift": " px", "shift-down": " px", "zoom": " x", "weather": ""}
# The field of `Change` that each sweep varies.
CHANGE_FIELD: dict[SweptProperty, str] = {
    **{"rotation": "rotate", "shift": "shift", "shift-down": "down", "zoom": "scale"},
    "weather": "weather",
}
MAX_POINTS = 3600
T = TypeVar("T", int, float)


@dataclass(frozen=True, eq=False)
class SweepPoint:
    """One query under one change.

    Attributes:
        followed: the nearest positive, a chosen tile, or else the top match.
        top: the nearest tile.
    """

    change: Change
    followed: Match
    top: Match


def sweep_points(
    model: Model,
    picture: UInt8Array,
    view: View,
    changes: Iterable[Change],
    rank: Callable[[Float32Array], Ranking],
    follow: int | None = None,
) -> Iterator[SweepPoint]:
    """Yield a point for each change: describe the changed query and rank the gallery.

    Args:
        picture: the query, (H, W, 3) uint8.
        changes: see `changes_over`.
        rank: ranks the gallery for a descriptor, (n, D).
        follow: gallery position of the tile to follow in place of the nearest positive.

    Raises:
        InputError: if the model lacks the view, all tiles are junk, the tile `follow` is not in the ranking, or a
            change leaves an empty picture.
    """
    model.check_view(view)
    for change in changes:
        ranking = rank(retrieval.describe_picture(model, picture, view, change).descriptor)
        if not len(ranking.order):
            raise InputError("There is no tile to rank; a sweep needs at least one that is not junk.")
        if follow is not None and not ranking.holds(follow):
            raise InputError(f"Gallery picture {follow} is not in the ranking; choose one that is.")
        top = ranking.match(0)
        yield SweepPoint(change, (ranking.positive() or top) if follow is None else ranking.find(follow), top)


@dataclass(frozen=True, eq=False)
class SweepResult:
    """The points of a sweep that may still be running.

    Attributes:
        over: the swept property.
        points: at least one, sorted by the swept property.
        base: the change that the query had before the sweep.
    """

    over: SweptProperty
    points: tuple[SweepPoint, ...]
    base: Change = UNCHANGED

    def __post_init__(self) -> None:
        ordered = sorted(self.points, key=lambda point: swept_value(self.over, point.change))
        object.__setattr__(self, "points", tuple(ordered))

    @property
    def best(self) -> SweepPoint:
        """The point where the followed tile has its highest score; the smallest change wins ties."""
        return self._highest([point.followed.score for point in self.points])

    @property
    def best_top_match(self) -> SweepPoint:
        """The point where the top match has its highest score; needs no ground truth. The smallest change wins ties."""
        return self._highest([point.top.score for point in self.points])

    @property
    def best_rank(self) -> SweepPoint:
        """The point where the followed tile ranks best; the highest score wins ties."""
        # Scores differ by at most 2, so the rank dominates.
        return self._highest([4.0 * -point.followed.rank + point.followed.score for point in self.points])

    @property
    def unchanged(self) -> SweepPoint | None:
        """The point of the base change; None until it is computed."""
        return next((point for point in self.points if point.change == self.base), None)

    def gain(self, point: SweepPoint) -> tuple[int, float] | None:
        """Return how many ranks and how much score the followed tile gains over the base change.

        None until the base change is computed.
        """
        if self.unchanged is None:
            return None
        before, after = self.unchanged.followed, point.followed
        return before.rank - after.rank, after.score - before.score

    def heading(self) -> float | None:
        """Estimate the heading of the query, 0 .. 360 degrees clockwise from north.

        None unless the sweep is a rotation. The estimate needs a north-up gallery and no ground truth. On the demo, in steps
        of 15 degrees, the median error is 12 degrees for pictures from straight above and 33 for tilted ones (chance: 90). One
        in ten estimates is opposite for pictures from straight above, and four in ten for tilted ones.
        """
        return -self.best_top_match.change.rotate % 360 if self.over == "rotation" else None

    def to_csv(self) -> bytes:
        """Return a row for each point as comma-separated values in UTF-8."""
        parts = (f"cosine {part}" for part in range(1, len(self.points[0].followed.cosines) + 1))
        rows: list[list[Any]] = [[self.over, "score", "rank", *parts, "tile", "true", "top", "top score"]]
        for point in self.points:
            value = point.change.weather.name if self.over == "weather" else swept_value(self.over, point.change)
            tile, top = point.followed, point.top
            cosines = tile.cosines.tolist()
            rows.append([value, tile.score, tile.rank, *cosines, tile.index, tile.true, top.index, top.score])
        return csv_bytes(rows)

    def _highest(self, scores: Sequence[float]) -> SweepPoint:
        places = sorted(range(len(scores)), key=lambda i: (-scores[i], _magnitude(self.over, self.points[i].change)))
        return self.points[places[0]]


def swept_value(over: SweptProperty, change: Change) -> float:
    """Return the swept property of a change: degrees 0 .. 360, pixels, a factor, or a weather's place among `WEATHERS`."""
    if over == "weather":
        return float(WEATHERS.index(change.weather.name))
    number = float(getattr(change, CHANGE_FIELD[over]))
    return number % 360 if over == "rotation" else number


def signed_value(over: SweptProperty, change: Change) -> float:
    """Return the swept property with rotations from -180 (exclusive) to 180 degrees."""
    number = swept_value(over, change)
    return number - 360 if over == "rotation" and number > 180 else number


def swept_label(over: SweptProperty, number: float, digits: int = 3) -> str:
    """Return a value of the swept property with its unit, such as "30°", or the name of a weather."""
    return WEATHERS[round(number)] if over == "weather" else f"{number:.{digits}g}{UNITS[over]}"


def changes_over(
    over: SweptProperty, step: float | None = None, reach: float | None = None, side: int = 256
) -> list[Change]:
    """Return the changes of a sweep from coarse to fine, so that the first points already show its shape.

    The first one is the identity. Each further one is farthest from all earlier ones: a rotation goes 0, 180, 90, 270, 45, ...

    Args:
        over: a rotation covers the full circle, shifts go both ways, and zooms go in and out by equal factors. Weathers follow
            the order of `WEATHERS`.
        step: degrees (default 15), pixels (default `side` / 32), or the factor between zooms (default 1.1).
        reach: largest shift in pixels (default `side` / 4), largest factor (default 2), or the weathers' strength (default 1);
            not for a rotation.
        side: size of the network's input along the shift, in pixels.

    Raises:
        InputError: if a number is out of range, or there would be more than 3600 points.
    """
    if over not in get_args(SweptProperty):
        raise InputError(f"There is no sweep over {over!r}; expected one of {', '.join(get_args(SweptProperty))}.")
    if over == "weather":
        if step is not None:
            raise InputError("Weathers have no step; leave it out, and give their strength as the reach.")
        strength = 1.0 if reach is None else reach
        if strength == 0:
            raise InputError("The weathers' strength is 0, at which all are alike; expected above 0, up to 1.")
        return [Change(weather=Weather(name, strength)) for name in WEATHERS]
    if over == "rotation":
        step = _checked("step", 15.0 if step is None else step, 0, 360, "degrees")
        if reach is not None:
            raise InputError("A rotation always covers the full circle; leave its reach out.")
        _check_count(360 / step)
        angles = [step * i for i in range(math.ceil(360 / step - 1e-9))]
        return [Change(rotate=angle) for angle in _coarse_first(angles, 360.0)]
    if over == "zoom":
        step = _checked("step", 1.1 if step is None else step, 1, MAX_SCALE, "a factor")
        reach = _checked("reach", 2.0 if reach is None else reach, 1, MAX_SCALE, "a factor")
        _check_count(2 * math.log(reach) / math.log(step))
        count = math.floor(math.log(reach) / math.log(step) + 1e-9)
        return [Change(scale=step**power) for power in _coarse_first(_both_sides(count))]
    step = _checked("step", max(1, side // 32) if step is None else step, 0, side, "whole pixels")
    reach = _checked("reach", side // 4 if reach is None else reach, 0, side, "whole pixels")
    if step != int(step):
        raise InputError(f"The step is {step:g}; expected whole pixels.")
    _check_count(2 * reach / step)
    pixels = _coarse_first([int(step) * i for i in _both_sides(math.floor(reach / step))])
    return [Change(shift=number) if over == "shift" else Change(down=number) for number in pixels]


def apply_to_base(over: SweptProperty, base: Change, changes: Iterable[Change]) -> list[Change]:
    """Return the base change, then a copy of it for every different swept value in `changes`."""
    name = CHANGE_FIELD[over]
    swept = [replace(base, **{name: getattr(change, name)}) for change in changes]
    return [base, *(change for change in swept if swept_value(over, change) != swept_value(over, base))]


def _both_sides(count: int) -> list[int]:
    """Return 0, then the other integers from -count to count."""
    return [0, *(i for i in range(-count, count + 1) if i)]


def _coarse_first(values: Sequence[T], circle: float | None = None) -> list[T]:
    """Return values in farthest-point order, which starts at the first value; of equally far values, the earlier comes next."""
    places = np.asarray(values, dtype=np.float64)
    order, nearest = [0], np.full(len(places), np.inf)
    while len(order) < len(places):
        apart = np.abs(places - places[order[-1]])
        nearest = np.minimum(nearest, apart if circle is None else np.minimum(apart, circle - apart))
        nearest[order[-1]] = -1
        # Steps such as 0.1 are inexact; rounding keeps ties.
        order.append(int(np.argmax(np.round(nearest, 9))))
    return [values[i] for i in order]


def _magnitude(over: SweptProperty, change: Change) -> float:
    """Return the magnitude of a change; 0 for the identity."""
    number = swept_value(over, change)
    if over == "rotation":
        return min(number, 360 - number)
    return abs(math.log(number)) if over == "zoom" else abs(number)


def _checked(name: str, number: float, low: float, high: float, expected: str) -> float:
    if not low < number < high:
        raise InputError(f"The {name} is {number:g}; expected {expected} between {low:g} and {high:g}.")
    return number


def _check_count(intervals: float) -> None:
    if intervals > MAX_POINTS:
        raise InputError(f"The sweep has {intervals:.0f} points; expected at most {MAX_POINTS}, so take larger steps.")
