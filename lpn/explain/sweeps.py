"""Sweeps: score, rank, and part cosines of one query while it is turned, shifted, or zoomed.

LPN divides a picture into square rings around its middle, so that it is partly invariant to a turn and assumes a centred
target: a shift moves the target from ring to ring.

Heading: a picture whose top points h degrees clockwise from north is north-up, like a satellite tile, after a turn by h
degrees clockwise. `Change.rotate` counts counter-clockwise, so that the best angle r estimates the heading h = -r (mod 360).
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

# The swept property: degrees counter-clockwise, pixels of the network's input to the right or down, or a factor.
SweptProperty = Literal["rotation", "shift", "shift-down", "zoom"]
UNITS: dict[SweptProperty, str] = {"rotation": "°", "shift": " px", "shift-down": " px", "zoom": " x"}
# The field of `Change` that each sweep varies.
CHANGE_FIELD: dict[SweptProperty, str] = {"rotation": "rotate", "shift": "shift", "shift-down": "down", "zoom": "scale"}
MAX_POINTS = 3600


@dataclass(frozen=True, eq=False)
class Point:
    """One query under one change.

    Attributes:
        tile: gallery position of the followed tile: the nearest positive, a chosen tile, or else the top match.
        true: True when the followed tile shows the query's place; None when that is not known.
        score: weighted mean cosine of the followed tile, -1 .. 1.
        rank: of the followed tile, 1 for the nearest.
        cosines: of the parts with the followed tile, (n,).
        top: gallery position of the nearest tile.
        top_score: score of the nearest tile.
    """

    change: Change
    tile: int
    true: bool | None
    score: float
    rank: int
    cosines: Float32Array
    top: int
    top_score: float


def run_sweep(
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
    """Describe a query under each change in turn and rank the gallery; lazily, so that a sweep can be stopped.

    Args:
        picture: the query, (H, W, 3) uint8.
        gallery: descriptors, (G, n, D).
        weights: part weights that sum to one, (n,).
        changes: see `changes_over`.
        labels, label, truth: true matches, as for `retrieval.rank`.
        follow: gallery position to follow in place of the nearest positive.

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
class SweepResult:
    """The points of a sweep, which need not be complete.

    Attributes:
        over: the swept property.
        points: at least one, sorted by the swept property.
        base: the change of the query from which the sweep departs.
    """

    over: SweptProperty
    points: tuple[Point, ...]
    base: Change = UNCHANGED

    def __post_init__(self) -> None:
        if not self.points:
            raise InputError("A profile needs at least one point; take one from lpn.explain.sweeps.profile first.")
        ordered = sorted(self.points, key=lambda point: swept_value(self.over, point.change))
        object.__setattr__(self, "points", tuple(ordered))

    @property
    def best(self) -> Point:
        """The point of the followed tile's highest score; of equals the one of the least change."""
        return self._highest([point.score for point in self.points])

    @property
    def best_top_match(self) -> Point:
        """The point of any tile's highest score, which needs no ground truth; of equals the one of the least change."""
        return self._highest([point.top_score for point in self.points])

    @property
    def best_rank(self) -> Point:
        """The point of the followed tile's best rank; of equals the one of the highest score."""
        # Scores differ by at most 2, so a rank counts for more.
        return self._highest([4.0 * -point.rank + point.score for point in self.points])

    @property
    def unchanged(self) -> Point | None:
        """The point of the base change; None while it is not among the points."""
        return next((point for point in self.points if point.change == self.base), None)

    def gain(self, point: Point) -> tuple[int, float] | None:
        """Ranks and score that the followed tile gains over the base change; None while that is not among the points."""
        before = self.unchanged
        return None if before is None else (before.rank - point.rank, point.score - before.score)

    def heading(self) -> float | None:
        """Estimate the direction of the picture's top in degrees clockwise from north, 0 .. 360, without ground truth.

        None for other sweeps than rotation. The estimate supposes a north-up gallery and is as precise as the steps. On the demo,
        in steps of 15 degrees, the median error is 12 degrees for pictures from straight above, one in ten of which is taken for
        its opposite, and 33 for tilted ones, four in ten of which are; by chance it would be 90.
        """
        return -self.best_top_match.change.rotate % 360 if self.over == "rotation" else None

    def rows(self) -> list[dict[str, Any]]:
        """The values of the CSV file, a row per point."""
        return [
            {
                self.over: swept_value(self.over, point.change),
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
        """`rows` as comma-separated values in UTF-8."""
        text = io.StringIO()
        writer = csv.DictWriter(text, list(self.rows()[0]))
        writer.writeheader()
        writer.writerows(self.rows())
        return text.getvalue().encode()

    def _highest(self, scores: Sequence[float]) -> Point:
        places = sorted(range(len(scores)), key=lambda i: (-scores[i], _size(self.over, self.points[i].change)))
        return self.points[places[0]]


def swept_value(over: SweptProperty, change: Change) -> float:
    """The swept property of a change: degrees 0 .. 360, pixels, or a factor."""
    number = float(getattr(change, CHANGE_FIELD[over]))
    return number % 360 if over == "rotation" else number


def signed_value(over: SweptProperty, change: Change) -> float:
    """Return the same number with a rotation by the shorter way, above -180 to 180 degrees."""
    number = swept_value(over, change)
    return number - 360 if over == "rotation" and number > 180 else number


def changes_over(
    over: SweptProperty, step: float | None = None, reach: float | None = None, side: int = 256
) -> list[Change]:
    """The changes of a sweep: the unchanged query first, then always the change farthest from all before.

    Few points then show the shape: a rotation goes 0, 180, 90, 270, 45, ...

    Args:
        over: a rotation goes once around, shifts go to both sides, and zooms go in and out by equal factors.
        step: degrees (15), pixels of the network's input (a 32nd of its side), or the factor between zooms (1.1).
        reach: largest shift in pixels (a quarter of the side) or largest factor (2); not for a rotation.
        side: the network's input along the shift in pixels.

    Raises:
        InputError: when a number is out of range, or there would be more than 3600 points.
    """
    if over not in get_args(SweptProperty):
        raise InputError(f"The sweep is over {over!r}; expected one of {', '.join(get_args(SweptProperty))}.")
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


def apply_to_base(over: SweptProperty, base: Change, changes: Iterable[Change]) -> list[Change]:
    """Apply a sweep's changes on top of a base change: the base first, then the base with each swept value."""
    name = CHANGE_FIELD[over]
    swept = [replace(base, **{name: getattr(change, name)}) for change in changes]
    return [base, *(change for change in swept if swept_value(over, change) != swept_value(over, base))]


def _both_sides(count: int) -> list[int]:
    """0, then -count .. count without it."""
    return [0, *(i for i in range(-count, count + 1) if i)]


def _coarse_first(values: Sequence[float], circle: float | None = None) -> list[int]:
    """Positions of values, each as far as possible from all before, beginning with the first; of equals the first."""
    places = np.asarray(values, dtype=np.float64)
    order, nearest = [0], np.full(len(places), np.inf)
    while len(order) < len(places):
        apart = np.abs(places - places[order[-1]])
        nearest = np.minimum(nearest, apart if circle is None else np.minimum(apart, circle - apart))
        nearest[order[-1]] = -1
        # Steps such as 0.1 are not exact; rounding keeps the order of equals.
        order.append(int(np.argmax(np.round(nearest, 9))))
    return order


def _size(over: SweptProperty, change: Change) -> float:
    """The size of a change."""
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
