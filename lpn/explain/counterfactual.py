"""The true match against a wrong one: which parts decide between them, and what would put the truth first.

All of it follows from the part cosines of one query, since under weights w_i that sum to one

    score(a) - score(b) = sum_i w_i (cos_i(a) - cos_i(b)),    distance^2(b) - distance^2(a) = 2 (score(a) - score(b)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import Float32Array, Float64Array, FloatingArray, Int64Array
from lpn.core.errors import InputError
from lpn.datasets import Truth
from lpn.explain.least_distance import shortest
from lpn.retrieval import Ranking, metrics, scoring

LEAD = 1e-5
"""Score by which `smallest_change` puts a tile before all others: more than single precision blurs, less than anyone can see."""


@dataclass(frozen=True, eq=False)
class Margin:
    """What each part says for one tile against another.

    Attributes:
        true, wrong: gallery positions of the two; the names are those of the usual case, any two tiles will do.
        parts: w_i (cos_i(true) - cos_i(wrong)), (n,) float64; above 0 where the part speaks for `true`.
    """

    true: int
    wrong: int
    parts: Float64Array

    @property
    def score(self) -> float:
        """score(true) - score(wrong), the sum of `parts`; above 0 when `true` is the nearer one."""
        return float(self.parts.sum())

    @property
    def distance2(self) -> Float64Array:
        """Each part's share of distance^2(wrong) - distance^2(true), (n,): twice `parts`, with the same sign."""
        return 2.0 * self.parts


def margin(ranking: Ranking, true: int, wrong: int) -> Margin:
    """The margin of gallery picture `true` over gallery picture `wrong`, part by part.

    Raises:
        InputError: when there is no such gallery picture.
    """
    for index in (true, wrong):
        if not 0 <= index < len(ranking.cosines):
            raise InputError(
                f"There is no gallery picture {index}; the gallery has positions 0 to {len(ranking.cosines) - 1}."
            )
    difference = ranking.cosines[true].astype(np.float64) - ranking.cosines[wrong]
    return Margin(true, wrong, ranking.weights.astype(np.float64) * difference)


@dataclass(frozen=True)
class Standing:
    """Where the truth stands under some part weights.

    Attributes:
        rank: of the nearest true match, 1 for the nearest of all.
        lead: its score less that of the nearest other tile that is not true; below 0 where that one is nearer, infinite
            where there is none.
    """

    rank: int
    lead: float


@dataclass(frozen=True)
class Without:
    """Where the truth stands with the weights as they are, without each part, and by each part alone.

    Attributes:
        now: under the ranking's weights.
        without: with one part left out and the other weights scaled to a sum of one, for each part; None where no other
            part has a weight, or sees anything of the query (see `Ranking.lengths`).
        alone: by one part alone, for each part; None for one that sees nothing of the query.
    """

    now: Standing
    without: tuple[Standing | None, ...]
    alone: tuple[Standing | None, ...]

    @property
    def cure(self) -> int | None:
        """The part (from 0) without which the truth would be first, by the largest lead; None where it is first already, or
        leaving out one part is not enough."""
        return None if self.now.rank == 1 else _best(self.without)

    @property
    def best_alone(self) -> int | None:
        """The part (from 0) that alone puts the truth first, by the largest lead; None where none does."""
        return _best(self.alone)


def without(ranking: Ranking, tile: int | None = None) -> Without | None:
    """Where the truth would stand without each part, and by each part alone.

    Args:
        tile: gallery position to follow in place of the truth; every other tile is then its rival.

    Returns:
        None when there is no true match in the ranking, or it is not known.

    Raises:
        InputError: when `tile` is not ranked.
    """
    wanted, rivals = _sides(ranking, tile)
    if not len(wanted):
        return None
    n = len(ranking.weights)
    sees = np.ones(n, bool) if ranking.lengths is None else ranking.lengths > 0

    def by(values: FloatingArray) -> Standing | None:
        # Parts that see nothing have the same score for every tile: a rank by them would be the gallery's order.
        known = bool((values[sees] > 0).any())
        return _standing(ranking, scoring.part_weights(n, values), wanted, rivals) if known else None

    left_out = [by(np.where(np.arange(n) == part, 0.0, ranking.weights)) for part in range(n)]
    now = _standing(ranking, ranking.weights, wanted, rivals)
    return Without(now, tuple(left_out), tuple(by(row) for row in np.eye(n)))


@dataclass(frozen=True, eq=False)
class Reweighting:
    """Part weights that put a tile first.

    Attributes:
        weights: 0 or more, summing to one, (n,) float32.
        change: what they add to the ranking's weights, (n,) float32, summing to zero.
        distance: Euclidean length of the change, 0 when the tile is first already.
        tile: gallery position of the tile that is first under them.
    """

    weights: Float32Array
    change: Float32Array
    distance: float
    tile: int


def smallest_change(ranking: Ranking, tile: int | None = None) -> Reweighting | None:
    """The part weights nearest to the ranking's that put the truth first.

    For each true tile t the convex program: minimise |w - w_now|^2 subject to w_i >= 0, sum_i w_i = 1, and
    sum_i w_i (cos_i(t) - cos_i(g)) >= LEAD for every tile g that is ranked and not true. It is solved exactly (see
    `lpn.explain.least_distance`), and the nearest of the true tiles' solutions is taken. A tile that is first already needs no change,
    whatever its lead.

    Args:
        tile: gallery position to put first in place of the truth; every other tile is then its rival.

    Returns:
        None when no weighting gives a true tile that lead: some combination of the constraints then says that weights which
        do lie farther away than any weights are. Also None when there is no true match, or it is not known.

    Raises:
        InputError: when `tile` is not ranked.
    """
    wanted, rivals = _sides(ranking, tile)
    if not len(wanted):
        return None
    if _standing(ranking, ranking.weights, wanted, rivals).rank == 1:
        first = int(ranking.order[np.isin(ranking.order, wanted)][0])
        return Reweighting(ranking.weights, np.zeros_like(ranking.weights), 0.0, first)
    n, now = len(ranking.weights), ranking.weights.astype(np.float64)
    now /= now.sum()
    # An orthonormal basis of the changes that sum to zero, in which a change keeps its length.
    basis = np.linalg.svd(np.ones((1, n)))[2][1:].T
    cosines = ranking.cosines.astype(np.float64)
    best, reach = None, float(np.linalg.norm(np.eye(n) - now, axis=1).max())
    for index in wanted:
        ahead = cosines[index] - cosines[rivals]
        rows = np.concatenate([ahead @ basis, basis])
        step = shortest(rows, np.concatenate([LEAD - ahead @ now, -now]), reach + 1e-9)
        if step is None or (best is not None and np.linalg.norm(step) >= reach):
            continue
        found = now + basis @ step
        weights = scoring.part_weights(n, np.where(found < 1e-9, 0.0, found))
        if _standing(ranking, weights, wanted, rivals).rank == 1:
            reach = float(np.linalg.norm(step))
            best = Reweighting(weights, weights - ranking.weights, reach, int(index))
    return best


@dataclass(frozen=True, eq=False)
class Effect:
    """What other part weights do to all queries of a task.

    Attributes:
        before, after: Recall@1 in percent.
        gained: queries, by position, whose nearest tile is a true match only with the new weights, (K,) int64.
        lost: those whose nearest tile is one only with the old weights, (L,) int64.
        queries: number of all.
    """

    before: float
    after: float
    gained: Int64Array
    lost: Int64Array
    queries: int

    @property
    def helps(self) -> bool:
        """Whether more queries are gained than lost."""
        return len(self.gained) > len(self.lost)


def effect(
    query: Float32Array,
    gallery: Float32Array,
    before: npt.ArrayLike | None,
    after: npt.ArrayLike,
    query_labels: npt.ArrayLike | None = None,
    gallery_labels: npt.ArrayLike | None = None,
    truth: Sequence[Truth] | None = None,
    first: Int64Array | None = None,
) -> Effect:
    """Whether other part weights help or harm over all queries of a task.

    The weights go into the queries, `w_i n q_i`, so that each side is one inner-product retrieval, in blocks and in double
    precision; see `lpn.retrieval.metrics.retrieve`, also for memory and for what is raised.

    Args:
        query, gallery: descriptors, (Q, n, D) and (G, n, D).
        before, after: part weights, see `scoring.part_weights`; None for equal ones.
        query_labels, gallery_labels, truth: what is a true match, as for `lpn.retrieval.metrics.retrieve`.
        first: the 0-based rank of each query's first true match with the old weights, (Q,), -1 without any, where it is
            known already; it is then not computed again.
    """
    if first is None:
        first = metrics.retrieve(folded(query, before), query_labels, gallery, gallery_labels, truth).first
    then = metrics.retrieve(folded(query, after), query_labels, gallery, gallery_labels, truth).first
    if first.shape != then.shape:
        raise InputError(f"There are {len(first)} known ranks for {len(then)} queries; expected one for each.")
    old, new = first == 0, then == 0
    shares = [100.0 * float(hits.mean()) for hits in (old, new)]
    return Effect(shares[0], shares[1], np.flatnonzero(new & ~old), np.flatnonzero(old & ~new), len(then))


def folded(query: Float32Array, weights: npt.ArrayLike | None) -> Float32Array:
    """Queries (..., n, D) whose inner product with a descriptor is the score under part weights: each part times w_i n."""
    n = query.shape[-2]
    return cast(Float32Array, query * (n * scoring.part_weights(n, weights))[:, None])


def _sides(ranking: Ranking, tile: int | None) -> tuple[Int64Array, Int64Array]:
    """Ranked tiles of which one shall be first, and ranked tiles that must come after it, both in gallery order."""
    ranked = np.sort(ranking.order)
    if tile is not None:
        if not ranking.holds(tile):
            raise InputError(f"Gallery picture {tile} is not in the ranking; choose one that is.")
        return ranked[ranked == tile], ranked[ranked != tile]
    if ranking.relevant is None:
        return ranked[:0], ranked
    true = ranking.relevant[ranked]
    return ranked[true], ranked[~true]


def _standing(ranking: Ranking, weights: Float32Array, wanted: Int64Array, rivals: Int64Array) -> Standing:
    """As `retrieval.rank` would have it: in single precision, equal scores in gallery order."""
    scores = ranking.cosines @ weights
    index = wanted[int(np.argmax(scores[wanted]))]
    score, others = scores[index], scores[rivals]
    rank = 1 + np.count_nonzero(others > score) + np.count_nonzero(others[: np.searchsorted(rivals, index)] == score)
    return Standing(int(rank), float(score) - float(others.max()) if len(others) else np.inf)


def _best(standings: Sequence[Standing | None]) -> int | None:
    leads = {part: found.lead for part, found in enumerate(standings) if found is not None and found.rank == 1}
    return max(leads, key=leads.__getitem__, default=None)
