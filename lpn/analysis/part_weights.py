"""Recall@1 and AP of a whole task under other part weights (Table V), and the paired difference from equal weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from lpn.analysis.statistics import RESAMPLES, Estimate, intervals
from lpn.core.arrays import Float64Array, Int64Array
from lpn.core.csv_cells import csv_bytes
from lpn.core.errors import InputError
from lpn.retrieval import metrics
from lpn.retrieval.part_ranks import BUDGET, PartRanks
from lpn.tasks.query_outcomes import weight_factors
from lpn.tasks.task import Task

# Up to so many parts, every combination of them is tried.
_MOST_PARTS = 4
_SEED = 0


@dataclass(frozen=True)
class WeightEffect:
    """A whole task under part weights beside the same task under equal weights.

    Attributes:
        recall, ap: Recall@1 and AP under these weights, in percent.
        equal_recall, equal_ap: those under equal weights.
        gained, lost: numbers of queries that only these weights find, and that only equal weights find.
        recall_difference, ap_difference: these weights minus equal ones, in percentage points, with an interval from a bootstrap
            over places, see `statistics.intervals`.
        queries: number of queries whose truth is known.
    """

    recall: float
    ap: float
    equal_recall: float
    equal_ap: float
    gained: int
    lost: int
    recall_difference: Estimate
    ap_difference: Estimate
    queries: int


def why_not(task: Task) -> str:
    """Say why a task has no figures under other part weights, as a sentence; empty if it has."""
    if task.contract.n_parts == 1:
        return "The model has one part, so there are no weights to compare."
    return task.no_truth


class WeightedTask:
    """One task under any part weights; not thread-safe.

    The first call compares all queries with the gallery, part by part; each further one takes a fraction of a second, unless the
    parts disagree about most tiles (see `PartRanks`).

    Args:
        budget: see `PartRanks.of`.

    Raises:
        InputError: when there are no figures, see `why_not`.
    """

    def __init__(self, task: Task, budget: int = BUDGET) -> None:
        if reason := why_not(task):
            raise InputError(reason)
        self._task, self._budget = task, budget
        self._parts: PartRanks | None = None
        self._compared = False
        self._equal: tuple[Int64Array, Float64Array] | None = None

    def effect(self, weights: npt.ArrayLike, progress: Callable[[int, int], None] | None = None) -> WeightEffect:
        """Measure the task under part weights, (n,), 0 or more and not all 0.

        Args:
            progress: called with the numbers of compared and of all queries; an exception stops the work.

        Raises:
            InputError: when the weights are not those of the parts.
        """
        equal = self._equal = self._equal or self._ranked(np.ones(self._task.contract.n_parts), progress)
        first, precision = self._ranked(weights, progress)
        known = self._task.known
        rows = np.arange(len(first)) if known is None else np.flatnonzero(known)
        hits, before = (ranks[rows] == 0 for ranks in (first, equal[0]))
        difference = np.stack([hits.astype(np.float64) - before, precision[rows] - equal[1][rows]])
        labels = self._task.query_labels[rows]
        recall_difference, ap_difference = intervals(difference, labels, _SEED, RESAMPLES)
        return WeightEffect(
            100 * float(hits.mean()),
            100 * float(precision[rows].mean()),
            100 * float(before.mean()),
            100 * float(equal[1][rows].mean()),
            int((hits & ~before).sum()),
            int((before & ~hits).sum()),
            recall_difference,
            ap_difference,
            len(rows),
        )

    def _ranked(
        self, weights: npt.ArrayLike, progress: Callable[[int, int], None] | None
    ) -> tuple[Int64Array, Float64Array]:
        """Return rank and average precision of each query, see `PartRanks.under`."""
        task = self._task
        query, gallery = task.compared
        labelled = query, gallery, task.query_labels, task.gallery_labels, task.truth
        if not self._compared:
            self._parts = PartRanks.of(*labelled, progress, self._budget)
            self._compared = True
        factors = weight_factors(query, weights)
        assert factors is not None
        if self._parts is not None:
            return self._parts.under(factors[:: query.shape[2]] / query.shape[1])
        ranking = metrics.retrieve(
            query, task.query_labels, gallery, task.gallery_labels, task.truth, factors, progress
        )
        return ranking.first, ranking.precision


def part_combinations(n: int) -> list[tuple[int, ...]]:
    """Return the combinations of parts, from 1: all of up to four parts; of more, each alone, and growing from the centre."""
    if n <= _MOST_PARTS:
        return [some for count in range(1, n + 1) for some in combinations(range(1, n + 1), count)]
    return [(part,) for part in range(1, n + 1)] + [tuple(range(1, last + 1)) for last in range(2, n + 1)]


def weights_of(parts: Sequence[int], n: int) -> tuple[float, ...]:
    """Return the weights that count some parts, from 1, equally, (n,)."""
    return tuple(float(part in parts) for part in range(1, n + 1))


def combinations_csv(rows: Mapping[tuple[int, ...], Mapping[str, WeightEffect]]) -> bytes:
    """Return the table of combinations as comma-separated values in UTF-8.

    Args:
        rows: for each combination, the figures of each task by its name; the same tasks in each row.
    """
    tasks = list(next(iter(rows.values()), {}))
    header = ["parts", *(f"{figure} {task}" for task in tasks for figure in ("recall@1", "ap"))]
    table = [
        [" ".join(map(str, parts)), *(value for task in tasks for value in (effects[task].recall, effects[task].ap))]
        for parts, effects in rows.items()
    ]
    return csv_bytes([header, *table])
