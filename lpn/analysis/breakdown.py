"""Failures of a task: confused places, deciding parts, and failure rates by metadata."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lpn.core.arrays import BoolArray, Float64Array, Int64Array
from lpn.core.tables import Column
from lpn.tasks.query_outcomes import Outcomes

# The two-sided 95 % quantile of the normal distribution.
_NORMAL_95 = 1.959963984540054
# Maximum of bins of a column of numbers.
_BINS = 5
# Columns of degrees around the full circle, and the number of their bins: north, east, south, and west.
_CIRCULAR, _SECTORS = ("heading",), 4


@dataclass(frozen=True, eq=False)
class Confusion:
    """Queries of one place that were answered with a tile of another place.

    Attributes:
        place, answered: labels of the two places.
        queries: the confused queries, (C,).
        tile: gallery position of the first query's answer.
    """

    place: int
    answered: int
    queries: Int64Array
    tile: int


@dataclass(frozen=True, eq=False)
class Hub:
    """A tile that is the answer to queries of other places.

    Attributes:
        tile: its gallery position.
        queries: the queries that it answers wrongly, (C,).
        places: the number of their places.
    """

    tile: int
    queries: Int64Array
    places: int


@dataclass(frozen=True)
class Rate:
    """The failure rate of the queries in one bin.

    Attributes:
        name: the bin in words.
        low, high: smallest and largest value in the bin; NaN for texts. In the bin around north, `low` is above `high`.
        queries, failures: numbers of queries and of failures in the bin.
        known: False for the bin of unknown values.
    """

    name: str
    low: float
    high: float
    queries: int
    failures: int
    known: bool = True

    @property
    def share(self) -> float:
        """Failures among the queries, 0 .. 1."""
        return self.failures / self.queries

    def holds(self, column: Column) -> BoolArray:
        """Return a mask of the values of the bin's column that are in the bin, (N,)."""
        if not self.known:
            return ~column.known
        if column.kind == "text":
            return np.asarray(column.values == self.name, bool)
        above, below = column.values >= self.low, column.values <= self.high
        return np.asarray(above & below if self.low <= self.high else above | below, bool)

    @property
    def interval(self) -> tuple[float, float]:
        """See `wilson`."""
        return wilson(self.failures, self.queries)


def confusions(
    outcomes: Outcomes, query_labels: Int64Array, labels: Int64Array, rows: Int64Array | None = None
) -> list[Confusion]:
    """Return the confused pairs of places, the most frequent first, and equally frequent ones by their labels.

    Args:
        query_labels, labels: the place of each query and tile, (Q,) and (G,).
        rows: the counted queries, all by default. Queries without an answer are left out.
    """
    rows = _wrongly_answered(outcomes, rows)
    pairs = np.stack([query_labels[rows], labels[outcomes.answer[rows]]], axis=1)
    kinds, which, counts = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    groups = np.split(rows[np.argsort(which.ravel(), kind="stable")], np.cumsum(counts)[:-1])
    result = [
        Confusion(place, answered, group, int(outcomes.answer[group[0]]))
        for (place, answered), group in zip(kinds.tolist(), groups, strict=False)
    ]
    return sorted(result, key=lambda confusion: -len(confusion.queries))


def hubs(outcomes: Outcomes, query_labels: Int64Array, rows: Int64Array | None = None) -> list[Hub]:
    """Return the tiles that answer queries of at least two other places, in descending number of places.

    Args:
        query_labels: the place of each query, (Q,).
        rows: the counted queries, all by default.
    """
    rows = _wrongly_answered(outcomes, rows)
    answers = outcomes.answer[rows]
    of_tiles = [(tile, rows[answers == tile]) for tile in np.unique(answers).tolist()]
    all_hubs = [Hub(tile, queries, len(np.unique(query_labels[queries]))) for tile, queries in of_tiles]
    return sorted((hub for hub in all_hubs if hub.places > 1), key=lambda hub: (-hub.places, -len(hub.queries)))


def blame(outcomes: Outcomes, rows: Int64Array | None = None) -> Int64Array:
    """Return the number of failures that each part decided, (n,); failures without a margin are not counted."""
    failed = outcomes.failed if rows is None else outcomes.failed & np.isin(np.arange(len(outcomes)), rows)
    decided = outcomes.deciding_part[failed]
    return np.bincount(decided[decided >= 0], minlength=outcomes.parts.shape[1]).astype(np.int64)


def rates(failed: BoolArray, column: Column, rows: Int64Array | None = None) -> list[Rate]:
    """Return the failure rate for each bin of a column: quantile bins of numbers, or distinct texts.

    Bins of numbers are ascending, and have about equal numbers of queries; queries of equal value are always in the same bin.
    Headings from 0 up to 360 degrees have a bin for each of the four directions, the first around north. Texts are sorted by
    descending rate. The queries of unknown value are the last bin.

    Args:
        failed: True for queries that failed, (Q,).
        column: one value for each query.
        rows: the counted queries, all by default.
    """
    rows = np.arange(len(failed)) if rows is None else rows
    known, unknown = rows[column.known[rows]], rows[~column.known[rows]]
    values = column.values[known]
    result: list[Rate] = []
    if len(known):
        distinct, which = np.unique(values, return_inverse=True)
        circular = column.kind == "number" and column.name in _CIRCULAR and len(distinct) > _BINS
        # Headings outside 0 to 360 fit into no bin around north.
        circular = circular and bool(distinct[0] >= 0 and distinct[-1] < 360)
        if circular:
            _, sectors = np.unique(_sectors(distinct), return_inverse=True)
            which = sectors[which]
        elif column.kind == "number":
            which = _quantile_bins(which)
        totals, missed = np.bincount(which), np.bincount(which, failed[known])
        if column.kind == "text":
            spans, names = [(np.nan, np.nan)] * len(totals), [str(value) for value in distinct]
        else:
            spans = [_ends(values[which == i], circular) for i in range(len(totals))]
            names = _span_names(spans, column.unit)
        for name, (low, high), total, fails in zip(names, spans, totals, missed, strict=True):
            result.append(Rate(name, low, high, int(total), int(fails)))
    if column.kind == "text":
        result.sort(key=lambda rate: (-rate.share, -rate.queries))
    if len(unknown):
        result.append(
            Rate("not known", np.nan, np.nan, len(unknown), int(np.count_nonzero(failed[unknown])), known=False)
        )
    return result


def wilson(hits: int, trials: int) -> tuple[float, float]:
    """The Wilson 95 % interval of a share, 0 .. 1, for `hits` in `trials` independent trials, at least one (Wilson 1927).

    Pictures of one place are not independent, so their true interval is wider.
    """
    square = _NORMAL_95**2
    middle = (hits + square / 2) / (trials + square)
    half = _NORMAL_95 / (trials + square) * np.sqrt(hits * (trials - hits) / trials + square / 4)
    low, high = float(middle - half), float(middle + half)
    return 0.0 if hits == 0 else low, 1.0 if hits == trials else high


def chance(hits: int, group: int, all_hits: int, total: int) -> float:
    """Return the probability that a group drawn at random from `total` has at least `hits` of all hits (hypergeometric tail)."""

    def log_ways(n: int, k: int) -> float:
        return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)

    possible = range(max(hits, all_hits + group - total), min(group, all_hits) + 1)
    whole = log_ways(total, group)
    return min(
        1.0, sum(math.exp(log_ways(all_hits, k) + log_ways(total - all_hits, group - k) - whole) for k in possible)
    )


def design_effect(failed: BoolArray, labels: Int64Array) -> float:
    """Return the number of queries that count as one independent query, 1 or more; queries of one place fail together.

    It is 1 + (m - 1) r for m queries a place, with the intraclass correlation r of a one-way analysis of variance (Kish 1965).

    Args:
        failed: True for queries that failed, (Q,).
        labels: the place of each query, (Q,).
    """
    places, which, counts = np.unique(labels, return_inverse=True, return_counts=True)
    if len(places) < 2 or len(failed) == len(places):
        return float(len(failed)) if len(places) < 2 else 1.0
    shares = np.bincount(which, failed) / counts
    between = float((counts * (shares - failed.mean()) ** 2).sum()) / (len(places) - 1)
    within = float(((failed - shares[which]) ** 2).sum()) / (len(failed) - len(places))
    size = len(failed) / len(places)
    together = (between - within) / max(between + (size - 1) * within, 1e-12)
    return 1 + (size - 1) * min(max(together, 0.0), 1.0)


def _wrongly_answered(outcomes: Outcomes, rows: Int64Array | None) -> Int64Array:
    rows = np.arange(len(outcomes)) if rows is None else rows
    return rows[outcomes.failed[rows] & (outcomes.answer[rows] >= 0)]


def _sectors(degrees: Float64Array) -> Int64Array:
    """Return the sector of each heading; sector 0 is north, from -45 up to 45 degrees."""
    return ((degrees.astype(np.float64) + 180 / _SECTORS) % 360 // (360 / _SECTORS)).astype(np.int64)


def _ends(values: Float64Array, circular: bool) -> tuple[float, float]:
    """Return the first and the last value of a bin, clockwise if it is a sector."""
    if circular and _sectors(values[:1])[0] == 0:
        # Arithmetic rounds, but an end must equal its original value.
        around = (values.astype(np.float64) + 180) % 360
        return float(values[around.argmin()]), float(values[around.argmax()])
    return float(values.min()), float(values.max())


def _quantile_bins(which: Int64Array) -> Int64Array:
    """Return the bin of each value from its index among the distinct values; equal values share the bin of their middle rank."""
    counts = np.bincount(which)
    if len(counts) <= _BINS:
        return which
    middles: Float64Array = (np.cumsum(counts) - counts / 2) / len(which)
    _, compact = np.unique((middles * _BINS).astype(np.int64), return_inverse=True)
    return compact[which].astype(np.int64)


def _span_names(spans: list[tuple[float, float]], unit: str) -> list[str]:
    """Return spans of numbers as texts, with six digits, or more to distinguish all ends."""
    ends = sorted({end for span in spans for end in span})
    digits = next((n for n in range(6, 17) if len({f"{end:.{n}g}" for end in ends}) == len(ends)), 17)
    # Show many digits as whole numbers rather than with an exponent.
    if digits > 6:
        digits = min(max(digits, *(len(f"{abs(end):.0f}") for end in ends)), 17)
    unit = f" {unit}" if unit not in ("", "°") else unit
    texts = {end: f"{end:.{digits}g}" for end in ends}
    return [f"{texts[low]}{'' if low == high else f' to {texts[high]}'}{unit}" for low, high in spans]
