"""Statistics of compared models: bootstrap intervals, paired tests, and tests over seeds.

Queries of one place are not independent, so places are the units of intervals and of paired tests.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from lpn.core.arrays import Float64Array, Int64Array

RESAMPLES = 1000
# Coverage of an interval.
LEVEL = 0.95
# The number of random swaps of a paired test, and the largest number of differing places for which all swaps are counted.
SWAPS, _MAX_ENUMERATED = 100_000, 16
# Smaller standard errors, in percentage points, are rounding errors.
_ROUNDING = 1e-9
# Swaps that are drawn at once, and cells of the integral of Student's distribution.
_BLOCK, _CELLS = 100, 20_000


@dataclass(frozen=True)
class Estimate:
    """A percentage with its bootstrap interval over places.

    Attributes:
        sd: standard deviation (n - 1) over the runs of a group; None for one run.
    """

    value: float
    low: float
    high: float
    sd: float | None = None

    def __str__(self) -> str:
        spread = "" if self.sd is None else f" ± {self.sd:.2f}"
        return f"{self.value:.2f}{spread} ({self.low:.2f} to {self.high:.2f})"


def intervals(values: Float64Array, labels: Int64Array, seed: int, resamples: int) -> list[Estimate]:
    """Return the mean of each row in percent with its bootstrap interval; the draws are common to all rows.

    Args:
        values: of the queries, 0 .. 1, (M, Q).
        labels: the place of each query, (Q,); places are drawn with replacement, each with all its queries.
    """
    counts, sums = _of_places(np.ones((1, len(labels))), labels)[0], _of_places(values, labels)
    rng = np.random.default_rng(seed)
    means = np.empty((resamples, len(values)))
    for draw in range(resamples):
        times = np.bincount(rng.integers(len(counts), size=len(counts)), minlength=len(counts)).astype(np.float64)
        means[draw] = sums @ times / (counts @ times)
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    mean = values.mean(axis=1)
    return [Estimate(*(100 * float(number) for number in row)) for row in zip(mean, low, high, strict=True)]


def randomization_test(differences: Float64Array, labels: Int64Array, seed: int) -> list[float]:
    """Return the two-sided p-value of the mean of each row of paired differences (Fisher 1935; Smucker et al. 2007).

    A swap exchanges the two models on all queries of some places. p is the share of swaps with a mean at least as far from 0:
    of all swaps up to 16 differing places, else of 100,000 random swaps and the observed result.

    Args:
        differences: of the queries, (K, Q).
        labels: the place of each query, (Q,).
    """
    sums = _of_places(differences, labels)
    sums = sums[:, sums.any(axis=0)]  # a swap of equal results changes no mean
    total = sums.sum(axis=1)
    # Rounding errors must not separate swaps of equal means.
    far = np.abs(total) - 1e-9 * np.abs(sums).sum(axis=1)
    many = np.count_nonzero(sums, axis=1) > _MAX_ENUMERATED
    p = np.ones(len(sums))
    for row in np.flatnonzero(~many):
        differing = sums[row][sums[row] != 0]
        swapped = np.arange(2 ** len(differing))[:, None] >> np.arange(len(differing)) & 1
        p[row] = np.mean(np.abs((1 - 2 * swapped) @ differing) >= far[row])
    if many.any():
        rng, found = np.random.default_rng(seed), np.ones(int(many.sum()))
        for _ in range(SWAPS // _BLOCK):
            drawn = rng.integers(0, 256, (_BLOCK, -(-sums.shape[1] // 8)), np.uint8)
            swapped = np.unpackbits(drawn, axis=1, count=sums.shape[1]).astype(np.float64)
            found += (np.abs(total[many] - 2 * (swapped @ sums[many].T)) >= far[many]).sum(axis=0)
        p[many] = found / (1 + SWAPS)
    return [float(value) for value in p]


def welch_test(first: Float64Array, second: Float64Array) -> float | None:
    """Return the two-sided p-value of Welch's t-test (1947) of two groups of runs; None if neither group has a spread."""
    error, freedom = _standard_error(first, second)
    return _student_tail(abs(float(np.mean(first) - np.mean(second))) / error, freedom) if error else None


def half_interval(*groups: Float64Array | Sequence[float]) -> float:
    """Return half the width of the 95 % interval of the mean of one group of runs, or of the difference of two (Welch 1947).

    It is 0 for groups without a spread, such as single runs, which say nothing about seeds.
    """
    error, freedom = _standard_error(*groups)
    return error * _student_quantile(freedom) if error else 0.0


def _standard_error(*groups: Float64Array | Sequence[float]) -> tuple[float, float]:
    """Return the standard error of one mean or of a difference of means, and its degrees of freedom; 0 if unknown."""
    runs = [np.asarray(group, np.float64) for group in groups]
    if min(map(len, runs)) < 2:
        return 0.0, 0.0
    squares = [float(of.var(ddof=1)) / len(of) for of in runs]
    total = sum(squares)
    if total < _ROUNDING**2:
        return 0.0, 0.0
    parts = sum(square**2 / (len(of) - 1) for square, of in zip(squares, runs, strict=True))
    return math.sqrt(total), total**2 / parts


def _student_tail(t: float, freedom: float) -> float:
    """Return the probability of a Student's t at least this far from 0; SciPy is not in the base install."""
    # With t = sqrt(freedom) tan(angle), the density is proportional to cos(angle) ** (freedom - 1).
    start, middles = math.atan(t / math.sqrt(freedom)), (np.arange(_CELLS) + 0.5) / _CELLS
    tail, whole = (
        (math.pi / 2 - low) * np.mean(np.cos(low + (math.pi / 2 - low) * middles) ** (freedom - 1))
        for low in (start, 0)
    )
    return float(tail / whole)


@cache
def _student_quantile(freedom: float) -> float:
    """Return the bound of |t| with the probability `LEVEL`."""
    low, high = 0.0, 13.0  # for one degree of freedom, it is 12.7
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if _student_tail(middle, freedom) > 1 - LEVEL else (low, middle)
    return high


def holm(p: Sequence[float | None]) -> list[float | None]:
    """Return p-values adjusted for their number (Holm 1979); None stays and does not count."""
    known = sorted((value, row) for row, value in enumerate(p) if value is not None)
    adjusted, largest = list(p), 0.0
    for done, (value, row) in enumerate(known):
        largest = adjusted[row] = max(largest, min(1.0, (len(known) - done) * value))
    return adjusted


def _of_places(values: Float64Array, labels: Int64Array) -> Float64Array:
    places, of_query = np.unique(labels, return_inverse=True)
    return np.stack([np.bincount(of_query, row, minlength=len(places)) for row in values])
