"""Failures of a task: confused places, deciding parts, and failure rates by metadata."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lpn.analysis.query_outcomes import Outcomes
from lpn.core.arrays import BoolArray, Float64Array, Int64Array
from lpn.core.errors import InputError
from lpn.core.tables import Column

# The two-sided 95 % quantile of the normal distribution.
_NORMAL_95 = 1.959963984540054


@dataclass(frozen=True, eq=False)
class Confusion:
    """Queries of one place that were answered with another.

    Attributes:
        place, answered: labels of the two places.
        queries: the confused queries, (C,).
        tile: gallery position of the first query's answer.
    """

    place: int
    answered: int
    queries: Int64Array
    tile: int

    @property
    def count(self) -> int:
        """The number of confused queries."""
        return len(self.queries)


@dataclass(frozen=True)
class Rate:
    """The failure rate of the queries in one bin.

    Attributes:
        name: the bin in words.
        low, high: smallest and largest value in the bin; NaN for texts.
        queries, failures: their numbers.
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

    @property
    def interval(self) -> tuple[float, float]:
        """See `wilson`."""
        return wilson(self.failures, self.queries)


def confusions(
    outcomes: Outcomes, query_labels: Int64Array, labels: Int64Array, rows: Int64Array | None = None
) -> list[Confusion]:
    """Confused pairs of places, the most frequent first; equals in order of their labels.

    Args:
        query_labels, labels: the place of each query and tile, (Q,) and (G,).
        rows: the queries to count, all by default. Queries without an answer are left out.
    """
    rows = _rows(outcomes, rows)
    rows = rows[outcomes.failed[rows] & (outcomes.answer[rows] >= 0)]
    pairs = np.stack([query_labels[rows], labels[outcomes.answer[rows]]], axis=1)
    kinds, which, counts = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    groups = np.split(rows[np.argsort(which.ravel(), kind="stable")], np.cumsum(counts)[:-1])
    found = [
        Confusion(int(place), int(answered), group, int(outcomes.answer[group[0]]))
        for (place, answered), group in zip(kinds, groups, strict=False)
    ]
    return sorted(found, key=lambda one: -one.count)


def blame(outcomes: Outcomes, rows: Int64Array | None = None) -> Int64Array:
    """The number of failures that each part decided, (n,); failures without a margin count for no part."""
    rows = _rows(outcomes, rows)
    decided = outcomes.deciding_part[rows][outcomes.failed[rows]]
    return np.bincount(decided[decided >= 0], minlength=outcomes.parts.shape[1]).astype(np.int64)


def rates(failed: BoolArray, column: Column, bins: int = 5, rows: Int64Array | None = None) -> list[Rate]:
    """Failure rate against a column: of numbers in quantile bins, of texts by value.

    Bins are ascending and as equal in number of queries as equal values, which are never parted, allow. Texts come with
    the highest rate first; queries whose value is not known come last, on their own.

    Args:
        failed: which queries failed, (Q,).
        column: of Q values.
        bins: of numbers, at most.
        rows: the queries looked at, all by default.

    Raises:
        InputError: when there are not as many values as queries, or no bins.
    """
    if len(column.values) != len(failed) or bins < 1:
        raise InputError(
            f"{column.name} has {len(column.values)} values for {len(failed)} queries and {bins} bins; expected one value for "
            "each query and at least one bin."
        )
    rows = np.arange(len(failed)) if rows is None else rows
    known, unknown = rows[column.known[rows]], rows[~column.known[rows]]
    values = column.values[known]
    found: list[Rate] = []
    if len(known):
        distinct, which = np.unique(values, return_inverse=True)
        which = which if column.kind == "text" else _quantile_bins(which, bins)
        totals, missed = np.bincount(which), np.bincount(which, failed[known])
        if column.kind == "text":
            spans, names = [(np.nan, np.nan)] * len(totals), [str(value) for value in distinct]
        else:
            spans = [(float(values[which == i].min()), float(values[which == i].max())) for i in range(len(totals))]
            names = _span_names(spans, column.unit)
        for name, (low, high), total, fails in zip(names, spans, totals, missed, strict=True):
            found.append(Rate(name, low, high, int(total), int(fails)))
    if column.kind == "text":
        found.sort(key=lambda rate: (-rate.share, -rate.queries))
    if len(unknown):
        found.append(
            Rate("not known", np.nan, np.nan, len(unknown), int(np.count_nonzero(failed[unknown])), known=False)
        )
    return found


def wilson(hits: int, of: int) -> tuple[float, float]:
    """The Wilson 95 % interval of a share, 0 .. 1, for `hits` of `of` independent trials (Wilson 1927).

    Several pictures of one place are not independent, so that the true interval is wider.

    Raises:
        InputError: when there are no trials, or more hits than trials.
    """
    if not 0 <= hits <= of or of == 0:
        raise InputError(f"There are {hits} hits of {of}; expected at least one trial, and no more hits than trials.")
    square = _NORMAL_95**2
    middle = (hits + square / 2) / (of + square)
    half = _NORMAL_95 / (of + square) * np.sqrt(hits * (of - hits) / of + square / 4)
    low, high = float(middle - half), float(middle + half)
    return 0.0 if hits == 0 else low, 1.0 if hits == of else high


def _rows(outcomes: Outcomes, rows: Int64Array | None) -> Int64Array:
    return np.arange(len(outcomes)) if rows is None else rows


def _quantile_bins(which: Int64Array, bins: int) -> Int64Array:
    """The bin of each value, from the place of its value among the distinct ones: where the middle of its equals lies."""
    counts = np.bincount(which)
    if len(counts) <= bins:
        return which
    middles: Float64Array = (np.cumsum(counts) - counts / 2) / len(which)
    _, compact = np.unique((middles * bins).astype(np.int64), return_inverse=True)
    return compact[which].astype(np.int64)


def _span_names(spans: list[tuple[float, float]], unit: str) -> list[str]:
    """Spans of numbers in words, with six digits or as many as tell all their ends apart."""
    ends = sorted({end for span in spans for end in span})
    digits = next((n for n in range(6, 17) if len({f"{end:.{n}g}" for end in ends}) == len(ends)), 17)
    if digits > 6:  # then rather whole numbers than powers of ten
        digits = min(max(digits, *(len(f"{abs(end):.0f}") for end in ends)), 17)
    unit = f" {unit}" if unit not in ("", "°") else unit
    said = {end: f"{end:.{digits}g}" for end in ends}
    return [f"{said[low]}{'' if low == high else f' to {said[high]}'}{unit}" for low, high in spans]
