"""Exact ranks of the true matches of many queries, mostly from single-precision scores.

The rank of a true match is the number of tiles ahead of it. Single-precision scores that differ by more than their rounding
errors decide the order. Closer false tiles are compared in double precision, and equal scores rank in gallery order. A query with
many close tiles, as in a collapsed network, has all scores in double precision.

An inner product of F numbers in single precision (u = 2^-24), summed in any order over chunks of L and then over the chunks,
has an error of at most (L + ceil(F / L) + 2) u |q| |g|. This includes two roundings of the numbers themselves (Higham, "Accuracy
and Stability of Numerical Algorithms", 3.1). Numbers far from 1 are multiplied by powers of two first, so no product overflows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from lpn.core.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array
from lpn.datasets import Truth

# Label of gallery pictures that are ignored.
JUNK = -1

_NONE = np.zeros(0, np.int64)
# Bytes and queries of a block of products, at most.
_BLOCK_BYTES, _BLOCK_ROWS = 160_000_000, 1024
# Tiles multiplied at a time, and numbers of a descriptor that are summed in one chunk. Partial sums stay in the processor's
# cache, and shorter chunks give a tighter bound, but cost more additions.
_COLUMNS, _CHUNK = 4096, 512
# Unit roundoff of single precision.
_UNIT = 2.0**-24
# Pairs of rows that fit into the processor's cache.
_PAIRS_AT_A_TIME = 64
# Close tiles of a query that are compared one by one, and for large galleries their share of the gallery.
_MOST_CLOSE, _MOST_CLOSE_SHARE = 256, 1 / 16
# Norms beyond 2^30 or 2^-30 are scaled.
_MOST_EXPONENT = 30


@dataclass(frozen=True, eq=False)
class Lists:
    """A list of tiles for each query, concatenated: `tiles[begin[i] : end[i]]` is the list of query i, ascending."""

    tiles: Int64Array
    begin: Int64Array
    end: Int64Array

    @classmethod
    def of(cls, lists: Sequence[Int64Array]) -> Lists:
        """Concatenate the lists of all queries."""
        end = np.cumsum([len(one) for one in lists], dtype=np.int64)
        tiles = [np.sort(one) for one in lists]
        return cls(np.concatenate([_NONE, *tiles]).astype(np.int64), np.concatenate([[0], end[:-1]]), end)

    def entries(self, rows: slice) -> tuple[Int64Array, Int64Array]:
        """Return the row, relative to the first of `rows`, and the tile of every entry of these queries' lists."""
        begin, counts = self.begin[rows], self.end[rows] - self.begin[rows]
        places = np.arange(counts.sum()) + np.repeat(begin - (np.cumsum(counts) - counts), counts)
        return np.repeat(np.arange(len(counts)), counts), self.tiles[places]


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """The true tiles and the junk of each query, and the tiles that are junk for all queries.

    `trapezoid` is the kind of each query's average precision, (Q,). `among` has the ranked tiles of each query, None for all.
    """

    true: Lists
    junk: Lists
    common_junk: Int64Array
    trapezoid: BoolArray
    among: Sequence[Int64Array | None] = ()

    def drop(self, values: AnyArray, rows: slice, value: float) -> None:
        """Set the values of these queries, (B, G), to `value` at unranked tiles."""
        values[self.junk.entries(rows)] = value
        values[:, self.common_junk] = value
        # Consecutive queries of a region share one array of tiles.
        for _, members in groupby(enumerate(self.among[rows]), key=lambda member: id(member[1])):
            (first, tiles), *others = members
            if tiles is not None:
                outside = np.ones(values.shape[1], bool)
                outside[tiles] = False
                values[first : first + 1 + len(others), outside] = value

    @classmethod
    def by_labels(cls, of_query: Int64Array, of_tile: Int64Array) -> GroundTruth:
        """Take tiles with the query's label as true; a query labelled as junk has no true tiles."""
        by_label = np.argsort(of_tile, kind="stable")
        sorted_labels = of_tile[by_label]
        begin, end = (np.searchsorted(sorted_labels, of_query, side).astype(np.int64) for side in ("left", "right"))
        end[of_query == JUNK] = begin[of_query == JUNK]
        empty = np.zeros(len(of_query), np.int64)
        common_junk, trapezoid = np.flatnonzero(of_tile == JUNK), np.ones(len(of_query), bool)
        return cls(Lists(by_label, begin, end), Lists(_NONE, empty, empty), common_junk, trapezoid)

    @classmethod
    def by_lists(cls, truth: Sequence[Truth]) -> GroundTruth:
        """Take true tiles and junk from the data set's lists."""
        trapezoid = np.array([lists.trapezoid for lists in truth], bool)
        good, junk = Lists.of([lists.good for lists in truth]), Lists.of([lists.junk for lists in truth])
        among = [lists.among for lists in truth]
        return cls(good, junk, _NONE, trapezoid, among if any(tiles is not None for tiles in among) else ())


@dataclass(frozen=True, eq=False)
class Ranked:
    """The rankings of some queries; -1 stands for a rank or tile that does not exist.

    Attributes:
        first: 0-based rank of each query's first true match, (B,).
        true: its nearest true tile, on ties the first in gallery order, (B,).
        false: its nearest tile that is neither true nor junk, with ties as for `true`, (B,).
        precision: its average precision, 0 .. 1, (B,).
        gap: d² of its second nearest tile minus d² of its nearest one, junk excluded, in single precision, (B,); NaN
            without two tiles.
    """

    first: Int64Array
    true: Int64Array
    false: Int64Array
    precision: Float64Array
    gap: Float64Array


class Scores:
    """Inner products of queries (Q, F) with tiles (G, F) of any floating type, without a copy in double precision.

    Args:
        norms: upper bounds on the norms of the queries (Q,) and of the tiles (G,).
        factors: multiplied into each query first, (F,).

    Attributes:
        exponents: `blocks` yields the products divided by 2 to these powers, (Q,).
    """

    def __init__(
        self,
        queries: AnyArray,
        tiles: AnyArray,
        norms: tuple[Float64Array, Float64Array],
        factors: Float64Array | None = None,
    ) -> None:
        self._queries, self._tiles, self._factors = queries, tiles, factors
        length = queries.shape[1]
        reach = norms[0] * (1.0 if factors is None else float(np.abs(factors).max(initial=0.0)))
        longest = float(norms[1].max(initial=0.0))
        powers, of_tiles = np.frexp(reach)[1], int(np.frexp(longest)[1])
        if max(np.abs(powers).max(initial=0), abs(of_tiles)) <= _MOST_EXPONENT:
            powers, of_tiles = np.zeros_like(powers), 0
        self._powers, self.exponents = powers, powers + of_tiles
        # Numbers of half precision would underflow.
        wide = np.promote_types(tiles.dtype, np.float32)
        self._single = (np.ldexp(tiles.astype(wide), -of_tiles) if of_tiles else tiles).astype(np.float32, copy=False)
        terms = min(length, _CHUNK) + -(-length // _CHUNK) + 2
        reach, longest = np.ldexp(reach, -powers), float(np.ldexp(longest, -of_tiles))
        # The second term is the extra error of subnormal numbers, which have fewer than 24 digits.
        self._errors = 1.02 * terms * _UNIT * reach * longest + length * 2.0**-120 * (1 + reach) * (1 + longest)

    def blocks(self) -> Iterator[tuple[slice, Float32Array, Float64Array]]:
        """Yield each block's rows, their products with all tiles (B, G), which may be overwritten, and their error bounds."""
        block = max(1, min(_BLOCK_ROWS, _BLOCK_BYTES // (4 * max(len(self._tiles), 1))))
        for start in range(0, len(self._queries), block):
            rows = slice(start, min(start + block, len(self._queries)))
            queries, powers = self._asked(rows), self._powers[rows]
            scaled = np.ldexp(queries, -powers[:, None]) if powers.any() else queries
            yield rows, self._products(scaled.astype(np.float32, copy=False)), self._errors[rows]

    def exact(self, queries: int | Int64Array, tiles: Int64Array) -> Float64Array:
        """Return the products of pairs, or of one query with tiles, in double precision, equal for equal tiles, (P,)."""
        products = np.empty(len(tiles))
        for start in range(0, len(tiles), _PAIRS_AT_A_TIME):
            some = slice(start, start + _PAIRS_AT_A_TIME)
            # Rows need one order of summation: a matrix product may change it from row to row, and einsum splits long rows by
            # their position in its buffer.
            asked = self._asked(slice(queries, queries + 1) if isinstance(queries, int) else queries[some])
            products[some] = (asked.astype(np.float64, copy=False) * self._tiles[tiles[some]]).sum(axis=1)
        return products

    def _asked(self, rows: slice | Int64Array) -> AnyArray:
        queries = self._queries[rows]
        return queries if self._factors is None else queries.astype(np.float64) * self._factors

    def _products(self, queries: Float32Array) -> Float32Array:
        products = np.empty((len(queries), len(self._single)), np.float32)
        chunk_sums = np.empty((len(queries), min(_COLUMNS, len(self._single))), np.float32)
        for begin in range(0, len(self._single), _COLUMNS):
            tiles = self._single[begin : begin + _COLUMNS]
            sums = products[:, begin : begin + _COLUMNS]
            np.matmul(queries[:, :_CHUNK], tiles[:, :_CHUNK].T, out=sums)
            for first in range(_CHUNK, queries.shape[1], _CHUNK):
                chunk = slice(first, first + _CHUNK)
                sums += np.matmul(queries[:, chunk], tiles[:, chunk].T, out=chunk_sums[:, : len(tiles)])
        return products


def rank(scores: Scores, ground_truth: GroundTruth, rows: slice, block: Float32Array, errors: Float64Array) -> Ranked:
    """Rank the gallery for the queries of a block of `Scores.blocks`; `block` is overwritten."""
    row, tile = ground_truth.true.entries(rows)
    score, gap, lines = block[row, tile].astype(np.float64), 2 * errors, np.arange(len(block))
    ground_truth.drop(block, rows, -np.inf)
    lead = np.ldexp(_gaps(block), scores.exponents[rows])
    block[row, tile] = -np.inf  # from here on, the block has only the false tiles
    false = np.argmax(block, axis=1)
    top = block[lines, false].astype(np.float64)
    floor = _rounded(top - gap, -np.inf)
    near = np.where(top > -np.inf, _count_true(block >= floor[:, None]), 0)
    most = max(_MOST_CLOSE, int(_MOST_CLOSE_SHARE * block.shape[1]))
    crowded = near > most
    for i in np.flatnonzero((near > 1) & ~crowded).tolist():
        close = np.flatnonzero(block[i] >= floor[i])
        false[i] = close[np.argmax(scores.exact(rows.start + i, close))]
    first, true, precision = np.full(len(block), -1), np.full(len(block), -1), np.zeros(len(block))
    counts, trapezoid = np.bincount(row, minlength=len(block)), ground_truth.trapezoid[rows]
    begins = np.cumsum(counts) - counts

    # Queries with one true tile, all at once.
    one = begins[counts == 1]
    alone, own_tile = row[one], tile[one]
    low, high = _rounded(score[one] - gap[alone], -np.inf), _rounded(score[one] + gap[alone], np.inf)
    above, between = np.zeros(len(one), np.int64), np.zeros(len(one), np.int64)
    contested = np.flatnonzero(top[alone] >= low)
    some = block[alone[contested]]
    above[contested] = _count_true(some > high[contested, None])
    between[contested] = _count_true(some >= low[contested, None]) - above[contested]
    crowded[alone[between > most]] = True
    unsure = np.flatnonzero((between > 0) & ~crowded[alone])
    some, queries = block[alone[unsure]], rows.start + alone[unsure]
    line, close = np.nonzero((some >= low[unsure, None]) & (some <= high[unsure, None]))
    exact, tiles = scores.exact(queries, own_tile[unsure]), own_tile[unsure]
    before = _before(exact[line], tiles[line], scores.exact(queries[line], close), close)
    above[unsure] += np.bincount(line[before], minlength=len(unsure))
    first[alone], true[alone] = above, own_tile
    whole = 1 / (first[alone] + 1)
    precision[alone] = np.where(trapezoid[alone], (whole + (first[alone] == 0)) / 2, whole)

    # Queries with several true tiles, and those with many close tiles, one by one.
    for i in np.flatnonzero(crowded | (counts > 1)).tolist():
        own, query, values = slice(begins[i], begins[i] + counts[i]), rows.start + i, block[i]
        found = None if crowded[i] else _ranks_of(scores, query, tile[own], score[own], values, gap[i], most)
        if found is None:
            exact = scores.exact(query, np.arange(len(values)))
            values = np.where(values > -np.inf, exact, -np.inf)
            false[i] = np.argmax(values)
            values[tile[own]] = exact[tile[own]]
            order = np.argsort(-values, kind="stable")
            ranks = np.flatnonzero(np.isin(order, tile[own]))
            found = ranks, int(order[ranks[0]]) if len(ranks) else -1
        ranks, true[i] = found
        if len(ranks):
            first[i], precision[i] = ranks[0], average_precision(ranks, bool(trapezoid[i]))
    return Ranked(first, true, np.where(top > -np.inf, false, -1), precision, lead)


def _ranks_of(
    scores: Scores, query: int, tiles: Int64Array, score: Float64Array, line: Float32Array, gap: float, most: int
) -> tuple[Int64Array, int] | None:
    """Return the ascending ranks of a query's true tiles, and the nearest of them; None if more than `most` are close."""
    # `score` has the scores of the true tiles, (T,), and `line` those of the false tiles, (G,), -inf for others. Scores that
    # differ by more than `gap` are in their true order.
    # NumPy 1 compares a number with an array in single precision, so the limits are rounded outwards.
    low, high = _rounded(score - gap, -np.inf), _rounded(score + gap, np.inf)
    near = (line >= low.min()).nonzero()[0]
    order = near[line[near].argsort()]
    ordered = line[order]
    start, stop = ordered.searchsorted(low, "left"), ordered.searchsorted(high, "right")
    above, counts = len(ordered) - stop, stop - start
    if counts.sum() > most:
        return None
    unsure, nearest = counts.nonzero()[0], (score >= score.max() - gap).nonzero()[0]
    exact = np.zeros(len(tiles))
    recomputed = np.union1d(unsure, nearest) if len(nearest) > 1 else unsure
    if len(recomputed):
        exact[recomputed] = scores.exact(query, tiles[recomputed])
        owner = np.arange(len(tiles)).repeat(counts)
        close = order[np.arange(len(owner)) + (start - counts.cumsum() + counts).repeat(counts)]
        others, place = np.unique(close, return_inverse=True)
        before = _before(exact[owner], tiles[owner], scores.exact(query, others)[place], close)
        above += np.bincount(owner[before], minlength=len(above))
    above.sort()
    return above + np.arange(len(above)), int(tiles[nearest[exact[nearest].argmax()]])


def average_precision(ranks: Int64Array, trapezoid: bool = True) -> float:
    """Return the average precision from the ascending 0-based ranks of all true matches, at least one.

    It is the area below the precision-recall points by the trapezoid rule, or else the mean precision at the true matches.
    """
    hits = np.arange(len(ranks))
    after = (hits + 1) / (ranks + 1)
    if not trapezoid:
        return float(after.mean())
    before = np.where(ranks == 0, 1.0, hits / np.maximum(ranks, 1))
    return float(((after + before) / 2).mean())


def _gaps(block: Float32Array) -> Float64Array:
    """Return twice the difference of the two highest scores of each row, NaN without two of them; `block` is unchanged."""
    rows, highest = np.arange(len(block)), np.argmax(block, axis=1)
    first = block[rows, highest]
    block[rows, highest] = -np.inf
    second = block.max(axis=1)
    block[rows, highest] = first
    with np.errstate(invalid="ignore"):
        gaps = 2.0 * (first.astype(np.float64) - second)
    return np.where(np.isfinite(gaps), gaps, np.nan)


def _before(score: Float64Array, tile: Int64Array, others: Float64Array, tiles: Int64Array) -> BoolArray:
    """Return the mask of `tiles` that rank before `tile`; equal scores rank in gallery order."""
    return np.asarray((others > score) | ((others == score) & (tiles < tile)))


def _count_true(mask: BoolArray) -> Int64Array:
    """Count True in each row; many times faster than `count_nonzero` along an axis."""
    total: AnyArray = mask.view(np.uint8).sum(axis=1, dtype=np.uint16 if mask.shape[1] < 2**16 else np.uint32)
    return total.astype(np.int64)


def _rounded(values: Float64Array, towards: float) -> Float32Array:
    return np.nextafter(values.astype(np.float32), np.float32(towards))
