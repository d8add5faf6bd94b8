"""All queries of a task ranked by an index, one search each; resumable."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lpn.core.arrays import BoolArray, Float64Array
from lpn.retrieval import scoring
from lpn.retrieval.metrics import Retrieval

if TYPE_CHECKING:
    from lpn.index.task import IndexTask


@dataclass(frozen=True, eq=False, kw_only=True)
class IndexRetrieval(Retrieval):
    """The rankings of all queries to a depth; `precision` is not a number, as AP needs all ranks.

    Attributes:
        parts: each part's term of the margin in d², (Q, n); NaN without a true or a false tile.
        missed: queries whose first true match an approximate search may have missed, so that its rank may be any, (Q,).
    """

    parts: Float64Array
    missed: BoolArray


class IndexRanking:
    """The rankings of all queries of a task over an index; not thread-safe.

    If `progress` stops `finish` by an exception, the next call continues.
    """

    def __init__(self, task: IndexTask) -> None:
        self._task = task
        self._rows: list[tuple[int, int, int, bool, Float64Array, float]] = []

    def finish(self, progress: Callable[[int, int], None]) -> IndexRetrieval:
        """Search for the queries that have not been searched for.

        Args:
            progress: called with the numbers of ranked and of all queries; may raise an exception to stop.

        Raises:
            StoreError: if the index cannot be read.
        """
        total = len(self._task.queries)
        while len(self._rows) < total:
            progress(len(self._rows), total)
            self._rows.append(self._ranked(len(self._rows)))
        first, true, false = (np.array([row[i] for row in self._rows], np.int64) for i in range(3))
        parts = np.array([row[4] for row in self._rows], np.float64).reshape(total, self._task.contract.n_parts)
        missed = np.array([row[3] for row in self._rows], bool)
        unknown, gap = np.full(total, np.nan), np.array([row[5] for row in self._rows], np.float64)
        depth: int | None = self._task.search_depth
        if depth == self._task.tiles and not (first == depth).any():
            depth = None
        return IndexRetrieval(
            first, true, false, unknown, gap, self._task.tiles, depth=depth, parts=parts, missed=missed
        )

    def _ranked(self, query: int) -> tuple[int, int, int, bool, Float64Array, float]:
        """Return rank from 0, nearest positive, hardest negative, `missed`, the parts of the margin, and the gap of a query."""
        task = self._task
        weights = scoring.part_weights(task.contract.n_parts, task.weights)
        ranking = task.search_index(query, task.query_descriptors[query], weights, background=True)
        positive, negative = ranking.positive(), ranking.hardest_negative()
        parts = np.full(len(weights), np.nan)
        gap = ranking.match(0).gap if len(ranking.order) else None
        if positive is not None and negative is not None:
            parts = 2 * weights.astype(np.float64) * (positive.cosines.astype(np.float64) - negative.cosines)
        if positive is not None:
            first = task.search_depth if positive.beyond else positive.rank - 1
            missed = positive.missed or (positive.beyond and positive.rank <= task.search_depth)
        else:  # where true tiles cannot be listed, one may follow beyond the depth
            listed = task.contains is None or ranking.relevant is None or ranking.depth is None
            first, missed = -1 if listed else task.search_depth, not listed and task.approximate
        return (
            first,
            -1 if positive is None else positive.index,
            -1 if negative is None else negative.index,
            missed,
            parts,
            np.nan if gap is None else gap,
        )
