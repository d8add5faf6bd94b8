"""Exact ranks of all queries under any part weights, from one pass over the part cosines.

With weights w_i of 0 or more, a false tile g can only rank before a true tile p of query q if in some part cos_i(q, g) is at
least cos_i(q, p). One pass keeps the part products of these tiles alone, often a few in a hundred; then other weights cost a
weighted sum of what is kept. Scores that differ by no more than their rounding errors are compared in double precision, so that
ranks are those of `lpn.retrieval.metrics.retrieve`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import Float32Array, Float64Array, Int64Array
from lpn.datasets import Truth
from lpn.retrieval.inner_products import Scores, norms
from lpn.retrieval.metrics import checked_ground_truth, checked_sides
from lpn.retrieval.ranks import GroundTruth, average_precision

# Bytes of kept products beyond which they are not kept.
BUDGET = 400_000_000
_BLOCK_BYTES = 64_000_000
_UNIT = 2.0**-24


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pairs of query and tile, by query: `begin[q] : begin[q + 1]` are those of query q.

    Attributes:
        tiles: (C,).
        products: of each part, (n, C).
        begin: (Q + 1,).
    """

    tiles: Int64Array
    products: Float32Array
    begin: Int64Array

    def scores(self, factors: Float64Array) -> Float64Array:
        """Return the weighted sum of the products, (C,)."""
        total = np.zeros(len(self.tiles))
        for factor, products in zip(factors, self.products, strict=True):
            if factor:
                total += factor * products
        return total

    @property
    def queries(self) -> Int64Array:
        """The query of each pair, (C,)."""
        return np.repeat(np.arange(len(self.begin) - 1), np.diff(self.begin))


class PartRanks:
    """The part products that decide the ranks of all queries under any part weights; see `of`."""

    def __init__(
        self,
        sides: tuple[Float32Array, Float32Array],
        lengths: tuple[Float64Array, Float64Array],
        true: _Pairs,
        false: _Pairs,
        errors: Float64Array,
        ground_truth: GroundTruth,
    ) -> None:
        self._sides, self._lengths, self._true, self._false = sides, lengths, true, false
        self._errors, self._trapezoid = errors, ground_truth.trapezoid

    @classmethod
    def of(
        cls,
        query: Float32Array,
        gallery: Float32Array,
        query_labels: Int64Array | None,
        gallery_labels: Int64Array | None,
        truth: Sequence[Truth] | None = None,
        progress: Callable[[int, int], None] | None = None,
        budget: int = BUDGET,
    ) -> PartRanks | None:
        """Compare all queries with the gallery, part by part.

        Args:
            query, gallery: descriptors, (Q, n, D) and (G, n, D); for the other arguments and errors see `metrics.retrieve`.
            progress: called after each block with the numbers of compared and of all queries; an exception stops the work.
            budget: bytes of products to keep.

        Returns:
            None where more than the budget would be kept: the parts of a weak model disagree about most tiles.
        """
        (flat_query, flat_gallery), lengths = checked_sides(query, gallery)
        ground_truth = checked_ground_truth(flat_query, flat_gallery, query_labels, gallery_labels, truth)
        n = query.shape[1]
        errors = _errors(query, gallery)
        tiles = [np.ascontiguousarray(gallery[:, part], np.float32).T for part in range(n)]
        true, false, kept = _Collected(n), _Collected(n), 0
        step = max(1, min(1024, _BLOCK_BYTES // (4 * len(gallery) * n)))
        for start in range(0, len(query), step):
            rows = slice(start, min(start + step, len(query)))
            blocks = [query[rows, part].astype(np.float32, copy=False) @ tiles[part] for part in range(n)]
            row, tile = ground_truth.true.entries(rows)
            of_true = np.stack([block[row, tile] for block in blocks])
            count = rows.stop - rows.start
            true.add(row, tile, of_true, count)
            ahead = _ahead(blocks, row, of_true, 2 * errors[rows])
            ahead[row, tile] = False
            ground_truth.drop(ahead, rows, False)
            row, tile = np.divmod(np.flatnonzero(ahead), len(gallery))
            kept += len(row) * (8 + 4 * n)
            if kept > budget:
                return None
            false.add(row, tile, np.stack([block[row, tile] for block in blocks]), count)
            if progress is not None:
                progress(rows.stop, len(query))
        return cls((flat_query, flat_gallery), lengths, true.pairs(), false.pairs(), errors, ground_truth)

    def under(self, weights: Float64Array) -> tuple[Int64Array, Float64Array]:
        """Rank under part weights.

        Args:
            weights: 0 or more, summing to one, (n,).

        Returns:
            The 0-based rank of each query's first true match, -1 without one, and each query's average precision, 0 .. 1;
            (Q,) each.
        """
        n = len(weights)
        factors = n * weights
        size = self._sides[0].shape[1] // n
        exact = Scores(*self._sides, self._lengths, np.repeat(factors, size))
        of_true, of_false = self._true.scores(factors), self._false.scores(factors)
        # The weights sum to one, so the errors of the parts' products weigh at most n times that of one part.
        gap = 2 * n * self._errors
        counts = np.diff(self._true.begin)
        first, precision = np.full(len(counts), -1, np.int64), np.zeros(len(counts))
        self._rank_single(np.flatnonzero(counts == 1), exact, of_true, of_false, gap, first, precision)
        for query in np.flatnonzero(counts > 1).tolist():
            ranks = self._ranks_of(query, exact, of_true, of_false, gap[query])
            first[query], precision[query] = ranks[0], average_precision(ranks, bool(self._trapezoid[query]))
        return first, precision

    def _rank_single(
        self,
        queries: Int64Array,
        exact: Scores,
        of_true: Float64Array,
        of_false: Float64Array,
        gap: Float64Array,
        first: Int64Array,
        precision: Float64Array,
    ) -> None:
        """Rank the queries with one true match, all at once."""
        single = np.zeros(len(first), bool)
        single[queries] = True
        owner = self._false.queries
        cells = np.flatnonzero(single[owner])
        owner, scores, tiles = owner[cells], of_false[cells], self._false.tiles[cells]
        entry = np.minimum(self._true.begin[owner], max(len(of_true) - 1, 0))
        true = of_true[entry]
        unsure = np.flatnonzero(np.abs(scores - true) <= gap[owner])
        if len(unsure):
            scores[unsure] = exact.pairs(owner[unsure], tiles[unsure])
            true[unsure] = exact.pairs(owner[unsure], self._true.tiles[entry[unsure]])
        before = (scores > true) | ((scores == true) & (tiles < self._true.tiles[entry]))
        above = np.bincount(owner[before], minlength=len(first))[queries]
        first[queries] = above
        mean = 1 / (above + 1)
        precision[queries] = np.where(self._trapezoid[queries], (mean + (above == 0)) / 2, mean)

    def _ranks_of(
        self, query: int, exact: Scores, of_true: Float64Array, of_false: Float64Array, gap: float
    ) -> Int64Array:
        """Return the ascending ranks of the true matches of a query that has several."""
        some, rest = (slice(pairs.begin[query], pairs.begin[query + 1]) for pairs in (self._true, self._false))
        true, true_tiles = of_true[some].copy(), self._true.tiles[some]
        false, false_tiles = of_false[rest].copy(), self._false.tiles[rest]
        ordered = np.sort(true)
        place = ordered.searchsorted(false)
        below, above = ordered[np.maximum(place - 1, 0)], ordered[np.minimum(place, len(ordered) - 1)]
        unsure = np.flatnonzero((np.abs(false - below) <= gap) | (np.abs(above - false) <= gap))
        if len(unsure):
            false[unsure] = exact.exact(query, false_tiles[unsure])
            true = exact.exact(query, true_tiles)
        ranked = np.sort(false)
        start, stop = ranked.searchsorted(true, "left"), ranked.searchsorted(true, "right")
        before = len(ranked) - stop
        for entry in np.flatnonzero(stop > start).tolist():  # equal scores rank in gallery order
            before[entry] += np.count_nonzero((false == true[entry]) & (false_tiles < true_tiles[entry]))
        return np.sort(before) + np.arange(len(before))


class _Collected:
    """Pairs collected block by block."""

    def __init__(self, n: int) -> None:
        self._tiles: list[Int64Array] = []
        self._products: list[Float32Array] = [np.zeros((n, 0), np.float32)]
        self._counts: list[Int64Array] = []

    def add(self, row: Int64Array, tile: Int64Array, products: Float32Array, count: int) -> None:
        """Add the pairs of `count` queries, sorted by query."""
        self._tiles.append(tile)
        self._products.append(products)
        self._counts.append(np.bincount(row, minlength=count))

    def pairs(self) -> _Pairs:
        begin = np.concatenate([[0], np.cumsum(np.concatenate(self._counts))])
        return _Pairs(np.concatenate(self._tiles), np.concatenate(self._products, axis=1), begin)


def _ahead(
    blocks: Sequence[Float32Array], row: Int64Array, of_true: Float32Array, gap: Float64Array
) -> npt.NDArray[np.bool_]:
    """Return the tiles that are at least as near in some part as the farthest true tile, up to rounding, (B, G)."""
    ahead = np.zeros(blocks[0].shape, bool)
    for block, products in zip(blocks, of_true, strict=True):
        low = np.full(len(block), np.inf)
        np.minimum.at(low, row, products)
        ahead |= block >= np.nextafter((low - gap).astype(np.float32), np.float32(-np.inf))[:, None]
    ahead[np.bincount(row, minlength=len(ahead)) == 0] = False
    return ahead


def _errors(query: Float32Array, gallery: Float32Array) -> Float64Array:
    """Return a bound on the rounding error of each query's products of one part, (Q,), see `inner_products`."""
    reach, longest = np.zeros(len(query)), 0.0
    for part in range(query.shape[1]):
        reach = np.maximum(reach, norms(query[:, part]))
        longest = max(longest, float(norms(gallery[:, part]).max()))
    return np.asarray(1.02 * (query.shape[2] + 3) * _UNIT * reach * longest + 1e-30)
