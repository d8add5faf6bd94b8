"""What happens to one query when it is turned, shifted, or zoomed: score, rank, and part cosines over the change.

LPN cuts square rings around the middle of a picture, so it withstands a turn in part, and assumes that the target is
centred: a shift moves it from ring to ring.

Heading. A picture whose top points h degrees clockwise from north is north-up, like a satellite tile, after a turn by h
degrees clockwise. `Change.rotate` counts counter-clockwise, so the best angle r estimates the heading h = -r (mod 360).
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from lpn import retrieval
from lpn.core.arrays import Float32Array, Int64Array, UInt8Array
from lpn.core.errors import InputError
from lpn.core.views import View
from lpn.datasets import Truth
from lpn.descriptors.transforms import MAX_SCALE, UNCHANGED, Change
from lpn.models.base import Model
from lpn.retrieval import scoring

Over = Literal["rotation", "shift", "shift-down", "zoom"]
"""What is changed: degrees counter-clockwise, pixels of the network's input to the right or down, or a factor."""
UNITS: dict[Over, str] = {"rotation": "°", "shift": " px", "shift-down": " px", "zoom": " x"}
FIELD: dict[Over, str] = {"rotation": "rotate", "shift": "shift", "shift-down": "down", "zoom": "scale"}
"""The number of a `Change` that each sweep changes."""
MAX_POINTS = 3600


@dataclass(frozen=True, eq=False)
class Point:
    """One query under one change.

    Attributes:
        change: what was done to it.
        tile: gallery position of what is followed: the nearest true match, a chosen tile, or where neither is known the top
            match.
        true: whether that tile shows the query's place; None when that is not known.
        score: of that tile, the weighted mean cosine, -1 .. 1.
        rank: of that tile, 1 for the nearest.
        cosines: of each part with that tile, (n,).
        top: gallery position of the nearest tile.
        top_score: its score.
    """

    change: Change
    tile: int
    true: bool | None
    score: float
    rank: int
    cosines: Float32Array
    top: int
    top_score: float


def profile(
    model: Model,
    picture: UInt8Array,
    view: View,
    gallery: Float32Array,
    weights: Float32Array,
    changes: Iterable[Change],
    labels: Int64Array | None = None,
    label: int | None = None,
    truth: Truth | None = None,
    follow: int | None = None,
) -> Iterator[Point]:
    """Describe a query under each change in turn and rank the gallery; to stop, take no further point.

    Args:
        picture: the query, (H, W, 3) uint8.
        gallery: descriptors, (G, n, D).
        weights: part weights that sum to one, (n,).
        changes: in the order in which they are computed, see `changes_over`.
        labels, label, truth: what is a true match, as for `retrieval.rank`.
        follow: gallery position to follow in place of the nearest true match.

    Raises:
        InputError: when the model has no such view, `follow` is not ranked, no tile is, or a change leaves nothing.
    """
    model.check_view(view)
    for change in changes:
        described = retrieval.describe_picture(model, picture, view, change)
        cosines = scoring.part_cosines(described.descriptor, gallery)
        ranking = retrieval.rank(cosines, weights, labels, label, truth)
        if not len(ranking.order):
            raise InputError("There is no tile to rank; a sweep needs a gallery with at least one that is not junk.")
        if follow is not None and not ranking.holds(follow):
            raise InputError(f"Gallery picture {follow} is not in the ranking; choose one that is.")
        top = ranking.match(0)
        tile = (ranking.positive() or top) if follow is None else ranking.find(follow)
        yield Point(change, tile.index, tile.true, tile.score, tile.rank, tile.cosines, top.index, top.score)


@dataclass(frozen=True, eq=False)
class Profile:
    """The points of a sweep, complete or so far, in the order of the change.

    Attributes:
        over: what is changed.
        points: at least one, sorted by it.
        base: what is done to the query as it is, which the sweep goes away from.
    """

    over: Over
    points: tuple[Point, ...]
    base: Change = UNCHANGED

    def __post_init__(self) -> None:
        if not self.points:
            raise InputError("A profile needs at least one point; take one from lpn.explain.sweeps.profile first.")
        ordered = sorted(self.points, key=lambda point: value(self.over, point.change))
        object.__setattr__(self, "points", tuple(ordered))

    @property
    def best(self) -> Point:
        """Where what is followed has its highest score, the least change of equals: what the truth would choose."""
        return self._highest([point.score for point in self.points])

    @property
    def best_blind(self) -> Point:
        """Where any tile has the highest score, the least change of equals: what can be chosen without knowing the truth."""
        return self._highest([point.top_score for point in self.points])

    @property
    def best_rank(self) -> Point:
        """Where what is followed has its best rank; of equals, where its score is highest."""
        # Scores differ by at most 2, so a rank counts for more.
        return self._highest([4.0 * -point.rank + point.score for point in self.points])

    @property
    def unchanged(self) -> Point | None:
        """The query as it is; None where it is not among the points (yet)."""
        return next((point for point in self.points if point.change == self.base), None)

    def gain(self, point: Point) -> tuple[int, float] | None:
        """What a change gains what is followed: ranks that it rises, and score; None before the query as it is is known."""
        before = self.unchanged
        return None if before is None else (before.rank - point.rank, point.score - before.score)

    def heading(self) -> float | None:
        """Estimate of the direction of the picture's top in degrees clockwise from north, 0 .. 360, without knowing the
        truth; None for other sweeps than rotation. It supposes a north-up gallery and is of the precision of the steps.

        A guess: on the demo, in steps of 15 degrees, the median error is 12 degrees for pictures from straight above, of which
        one in ten is taken for its opposite, and 33 for tilted ones, of which four in ten are; by chance it would be 90.
        """
        return -self.best_blind.change.rotate % 360 if self.over == "rotation" else None

    def rows(self) -> list[dict[str, Any]]:
        """One row of plain values for each point, with a column for each part's cosine."""
        return [
            {
                self.over: value(self.over, point.change),
                "score": point.score,
                "rank": point.rank,
                **{f"cosine {part}": float(cosine) for part, cosine in enumerate(point.cosines, 1)},
                "tile": point.tile,
                "true": point.true,
                "top": point.top,
                "top score": point.top_score,
            }
            for point in self.points
        ]

    def to_csv(self) -> bytes:
        """`rows` as a file of comma-separated values."""
        text = io.StringIO()
        writer = csv.DictWriter(text, list(self.rows()[0]))
        writer.writeheader()
        writer.writerows(self.rows())
        return text.getvalue().encode()

    def _highest(self, scores: Sequence[float]) -> Point:
        places = sorted(range(len(scores)), key=lambda i: (-scores[i], _size(self.over, self.points[i].change)))
        return self.points[places[0]]


def value(over: Over, change: Change) -> float:
    """The number that a sweep changes: degrees 0 .. 360, pixels, or a factor."""
    number = float(getattr(change, FIELD[over]))
    return number % 360 if over == "rotation" else number


def signed_value(over: Over, change: Change) -> float:
    """Return the same number with a rotation by the shorter way, above -180 to 180 degrees."""
    number = value(over, change)
    return number - 360 if over == "rotation" and number > 180 else number


def changes_over(over: Over, step: float | None = None, reach: float | None = None, side: int = 256) -> list[Change]:
    """The changes of a sweep, the query as it is first and then always the one farthest from all before.

    So few points show the shape: a rotation goes 0, 180, 90, 270, 45, ...

    Args:
        over: rotation goes once around; shifts go to both sides, zooms by equal factors in and out.
        step: degrees (15), pixels of the network's input (a 32nd of its side), or the factor between zooms (1.1).
        reach: how far to go: pixels (a quarter of the side) or the largest factor (2); not for rotation.
        side: the network's input along the shift in pixels.

    Raises:
        InputError: when a number is out of range, or there would be more than 3600 points.
    """
    if over not in get_args(Over):
        raise InputError(f"The sweep is over {over!r}; expected one of {', '.join(get_args(Over))}.")
    if over == "rotation":
        step = _checked("step", 15.0 if step is None else step, 0, 360, "degrees")
        if reach is not None:
            raise InputError("A rotation goes once around; leave its reach out.")
        _check_count(360 / step)
        angles = [step * i for i in range(math.ceil(360 / step - 1e-9))]
        return [Change(rotate=angles[i]) for i in _coarse_first(angles, 360.0)]
    if over == "zoom":
        step = _checked("step", 1.1 if step is None else step, 1, MAX_SCALE, "a factor")
        reach = _checked("reach", 2.0 if reach is None else reach, 1, MAX_SCALE, "a factor")
        _check_count(2 * math.log(reach) / math.log(step))
        powers = _both_sides(math.floor(math.log(reach) / math.log(step) + 1e-9))
        return [Change(scale=step ** powers[i]) for i in _coarse_first(powers)]
    step = _checked("step", max(1, side // 32) if step is None else step, 0, side, "whole pixels")
    reach = _checked("reach", side // 4 if reach is None else reach, 0, side, "whole pixels")
    if step != int(step):
        raise InputError(f"The step is {step:g}; expected whole pixels.")
    _check_count(2 * reach / step)
    pixels = [int(step) * i for i in _both_sides(math.floor(reach / step))]
    order = _coarse_first(pixels)
    return [Change(shift=pixels[i]) if over == "shift" else Change(down=pixels[i]) for i in order]


def around(over: Over, base: Change, changes: Iterable[Change]) -> list[Change]:
    """A sweep's changes of a query to which something is done already: that first, then each with its one value in place of
    the base's."""
    name = FIELD[over]
    swept = [replace(base, **{name: getattr(change, name)}) for change in changes]
    return [base, *(change for change in swept if value(over, change) != value(over, base))]


def _both_sides(count: int) -> list[int]:
    """0, then -count .. count without it."""
    return [0, *(i for i in range(-count, count + 1) if i)]


def _coarse_first(values: Sequence[float], circle: float | None = None) -> list[int]:
    """Positions of values such that each is as far as can be from all before, beginning with the first; of equals the
    first."""
    places = np.asarray(values, dtype=np.float64)
    order, nearest = [0], np.full(len(places), np.inf)
    while len(order) < len(places):
        apart = np.abs(places - places[order[-1]])
        nearest = np.minimum(nearest, apart if circle is None else np.minimum(apart, circle - apart))
        nearest[order[-1]] = -1
        # Steps such as 0.1 are not exact; without the rounding, equals would come in an odd order.
        order.append(int(np.argmax(np.round(nearest, 9))))
    return order


def _size(over: Over, change: Change) -> float:
    """How large a change is."""
    number = value(over, change)
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
