"""Counterfactuals of one ranking: the margin by part, ranks without a part, and the smallest change of part weights.

They are computed from the query's part cosines, less the terms of CSLS if it is used, without the network. The margin of a
positive p over a negative g is d^2(g) - d^2(p) = 2 (score(p) - score(g)), see `lpn.retrieval.scoring`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from lpn.core.arrays import Float32Array, Float64Array, FloatingArray, Int64Array
from lpn.retrieval import Ranking, scoring

# Smallest lead in score over every negative in `smallest_change`. Rounding errors of float32 are smaller.
MIN_SCORE_LEAD = 1e-5
# Tolerance and steps of `shortest`.
_TOLERANCE, _STEPS = 1e-12, 1000


@dataclass(frozen=True)
class RanksWithoutParts:
    """The rank of the nearest positive without each part, and by each part alone.

    Attributes:
        now: the rank under the ranking's weights, 1 for the nearest of all tiles.
        without: the rank without each part, the other weights scaled to a sum of one; None if all other parts have weight 0
            or are empty in the query (see `Ranking.lengths`).
        alone: the rank by each part alone; None if the part is empty in the query.
    """

    now: int
    without: tuple[int | None, ...]
    alone: tuple[int | None, ...]


def ranks_without_parts(ranking: Ranking, tile: int | None = None) -> RanksWithoutParts | None:
    """Rank the nearest positive without each part, and by each part alone.

    Args:
        tile: gallery position of the only positive, in place of the true matches.

    Returns:
        None if the ranking has no true match, or the true matches are unknown.
    """
    positives, negatives = _split(ranking, tile)
    if not len(positives):
        return None
    n = len(ranking.weights)
    nonempty = np.ones(n, bool) if ranking.lengths is None else ranking.lengths > 0

    def rank_by(values: FloatingArray) -> int | None:
        # Empty parts give every tile one score, so a rank by them is meaningless.
        if not (values[nonempty] > 0).any():
            return None
        return _positive_rank(ranking, scoring.part_weights(n, values), positives, negatives)

    without_each = [rank_by(np.where(np.arange(n) == part, 0.0, ranking.weights)) for part in range(n)]
    now = _positive_rank(ranking, ranking.weights, positives, negatives)
    return RanksWithoutParts(now, tuple(without_each), tuple(rank_by(row) for row in np.eye(n)))


def smallest_change(ranking: Ranking, tile: int | None = None) -> Float32Array | None:
    """Find the smallest change of the ranking's weights that puts a positive first.

    For each positive p this is a convex program: minimise |w - w_now|^2 subject to w_i >= 0, sum_i w_i = 1, and
    sum_i w_i (cos_i(p) - cos_i(g)) >= MIN_SCORE_LEAD for every negative g. `shortest` solves it exactly.
    The result is the smallest solution over all positives, or no change if a positive is first already.

    Args:
        tile: gallery position of the only positive, in place of the true matches.

    Returns:
        The part weights, 0 or more, with sum one, (n,). None if no weights put a positive first by `MIN_SCORE_LEAD`, or no
        positive is known.
    """
    positives, negatives = _split(ranking, tile)
    if not len(positives):
        return None
    if _positive_rank(ranking, ranking.weights, positives, negatives) == 1:
        return ranking.weights
    n, now = len(ranking.weights), ranking.weights.astype(np.float64)
    now /= now.sum()
    # The columns are an orthonormal basis of the changes that sum to zero. Coordinates keep the norm of a change.
    basis = np.linalg.svd(np.ones((1, n)))[2][1:].T
    cosines = ranking.similarities.astype(np.float64)
    best, reach = None, float(np.linalg.norm(np.eye(n) - now, axis=1).max())
    for index in positives:
        ahead = cosines[index] - cosines[negatives]
        rows = np.concatenate([ahead @ basis, basis])
        step = shortest(rows, np.concatenate([MIN_SCORE_LEAD - ahead @ now, -now]), reach + 1e-9)
        if step is None or (best is not None and np.linalg.norm(step) >= reach):
            continue
        solution = now + basis @ step
        weights = scoring.part_weights(n, np.where(solution < 1e-9, 0.0, solution))
        if _positive_rank(ranking, weights, positives, negatives) == 1:
            reach = float(np.linalg.norm(step))
            best = weights
    return best


@dataclass(frozen=True, eq=False)
class Effect:
    """The effect of other part weights on all queries of a task.

    Attributes:
        before, after: Recall@1 in percent.
        gained: positions of queries that only the new weights find, (K,).
        lost: positions of queries that only the old weights find, (L,).
        queries: the number of queries with a known truth.
    """

    before: float
    after: float
    gained: Int64Array
    lost: Int64Array
    queries: int

    @property
    def helps(self) -> bool:
        """True if more queries are gained than lost."""
        return len(self.gained) > len(self.lost)


def _split(ranking: Ranking, tile: int | None) -> tuple[Int64Array, Int64Array]:
    """Return the ranked positives and negatives, each in gallery order."""
    ranked = np.sort(ranking.order)
    if tile is not None:
        return ranked[ranked == tile], ranked[ranked != tile]
    if ranking.relevant is None:
        return ranked[:0], ranked
    true = ranking.relevant[ranked]
    return ranked[true], ranked[~true]


def _positive_rank(ranking: Ranking, weights: Float32Array, positives: Int64Array, negatives: Int64Array) -> int:
    """Return the nearest positive's rank, from 1, as in `retrieval.rank`: by float32 scores, ties in gallery order."""
    scores = ranking.similarities @ weights
    index = positives[int(np.argmax(scores[positives]))]
    score, others = scores[index], scores[negatives]
    ties_before = np.count_nonzero(others[: np.searchsorted(negatives, index)] == score)
    return int(1 + np.count_nonzero(others > score) + ties_before)


def shortest(rows: Float64Array, least: Float64Array, limit: float) -> Float64Array | None:
    """Return the shortest x (d,) with rows (m, d) @ x >= least (m,); None if none has length `limit` or less.

    This is least-distance programming by Lawson and Hanson (Solving Least Squares Problems, chapter 23): the non-negative
    least squares problem min over u >= 0 of |E u - f| with E = [rows^T; least^T] and f = (0, .., 0, 1) has the residual
    r = f - E u, and x = -r[:-1] / r[-1]. The active set holds at most d + 1 rows, so thousands of rows cost little.

    Every u >= 0 proves the bound |x|^2 >= 1 / |r|^2 - 1 for all feasible x. If no x is feasible, the bound grows without limit,
    so the test of the bound also detects that no x is feasible.
    """
    columns = np.concatenate([rows.T, least[None]])
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    target = np.zeros(len(columns))
    target[-1] = 1.0
    active: list[int] = []
    shares, residual = np.zeros(0), target
    for _ in range(_STEPS):
        if (residual @ residual) * (1 + limit**2) < 1:
            return None
        violated = residual @ columns
        violated[active] = -np.inf
        entering = int(np.argmax(violated)) if len(violated) else -1
        if entering < 0 or violated[entering] <= _TOLERANCE:
            break
        active, shares = _enter(columns, target, [*active, entering], np.append(shares, 0.0))
        previous, residual = residual, target - columns[:, active] @ shares
        if residual @ residual >= previous @ previous:  # only rounding errors remain
            break
    return cast(Float64Array, -residual[:-1] / residual[-1])


def _enter(
    columns: Float64Array, target: Float64Array, active: list[int], shares: Float64Array
) -> tuple[list[int], Float64Array]:
    """Solve least squares over the active columns, dropping those whose share would not stay above zero."""
    while active:
        wanted = cast(Float64Array, np.linalg.lstsq(columns[:, active], target, rcond=None)[0])
        falling = wanted <= 0
        if not falling.any():
            return active, wanted
        # Rounding may make the entering column fall from zero; the step is then zero, and the column leaves again.
        step = float(np.min(shares[falling] / np.maximum(shares[falling] - wanted[falling], 1e-300)))
        shares = np.maximum(shares + step * (wanted - shares), 0.0)
        remaining = (shares > 0) & ~(falling & (shares <= shares[falling].min()))
        active = [index for index, remains in zip(active, remaining, strict=True) if remains]
        shares = shares[remaining]
    return active, shares
