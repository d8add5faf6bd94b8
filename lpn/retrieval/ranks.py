"""Exact ranks of the true matches of a block of queries, mostly from single-precision scores.

The rank of a true match is the number of tiles ahead of it. If the single-precision scores of a true and a false tile differ
by more than their rounding errors, they decide the order. The few closer false tiles are compared in double precision, and
equal scores rank in gallery order. If there are many closer tiles, as in a gallery of equal tiles, the query's whole row is
computed in double precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from lpn.core.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array
from lpn.datasets import Truth
from lpn.retrieval.inner_products import Scores

# Label of gallery pictures that are ignored.
JUNK = -1

_NONE = np.zeros(0, np.int64)
# Maximum number of tiles that are compared with a query one by one in double precision, and for large galleries their
# maximum share of the gallery.
_MAX_CLOSE = 256
_MAX_CLOSE_SHARE = 1 / 16


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
        before = np.cumsum(counts) - counts
        return np.repeat(np.arange(len(counts)), counts), self.tiles[
            np.arange(counts.sum()) + np.repeat(begin - before, counts)
        ]


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """The true tiles and the junk of each query, and the tiles that are junk for all queries.

    `trapezoid` tells for each query which average precision it has, see `average_precision`, (Q,). `among` has for each query the
    only tiles that are ranked, None for all; it is empty where all queries rank all.
    """

    true: Lists
    junk: Lists
    common_junk: Int64Array
    trapezoid: BoolArray
    among: Sequence[Int64Array | None] = ()

    def drop(self, values: AnyArray, rows: slice, value: float) -> None:
        """Set the values of these queries, (B, G), to `value` at the tiles that are not ranked."""
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
        """Tiles with the query's label are true; a query labelled as junk has no true tiles."""
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
        gap: d² of its second nearest tile minus that of its nearest one, both true or false but not junk, in single precision,
            (B,); NaN where there are not two.
    """

    first: Int64Array
    true: Int64Array
    false: Int64Array
    precision: Float64Array
    gap: Float64Array


def rank(scores: Scores, ground_truth: GroundTruth, rows: slice, block: Float32Array, errors: Float64Array) -> Ranked:
    """Rank the gallery for the queries of a block of `Scores.blocks`; `block` is overwritten."""
    # Rows with an infinite error bound are not used.
    with np.errstate(over="ignore", invalid="ignore"):
        return _Block(scores, ground_truth, rows, block, errors).ranked()


class _Block:
    """Ranks one block of queries: `_block` has the scores of false tiles, and -inf for all other tiles."""

    def __init__(
        self, scores: Scores, ground_truth: GroundTruth, rows: slice, block: Float32Array, errors: Float64Array
    ) -> None:
        self._scores, self._start, self._block = scores, rows.start, block
        self._gap = 2 * errors
        self._ground_truth, self._rows = ground_truth, rows
        self._row, self._tile = ground_truth.true.entries(rows)
        self._true = block[self._row, self._tile]
        ground_truth.drop(block, rows, -np.inf)
        self._lead = _gaps(block)
        block[self._row, self._tile] = -np.inf
        size = block.shape
        self._max_close = max(_MAX_CLOSE, int(_MAX_CLOSE_SHARE * size[1]))
        self._trapezoid = ground_truth.trapezoid[rows]
        self._needs_double = ~np.isfinite(errors)
        self._first, self._nearest, self._false = (np.full(size[0], -1, np.int64) for _ in range(3))
        self._precision = np.zeros(size[0])

    def ranked(self) -> Ranked:
        if self._block.shape[1]:
            counts = np.bincount(self._row, minlength=len(self._block))
            begins = np.cumsum(counts) - counts
            self._find_false()
            self._rank_single(begins[counts == 1])
            for row in np.flatnonzero((counts > 1) & ~self._needs_double).tolist():
                self._rank_several(row, slice(begins[row], begins[row] + counts[row]))
            self._rank_in_double()
        return Ranked(self._first, self._nearest, self._false, self._precision, self._lead)

    def _find_false(self) -> None:
        """Find the nearest false tile of each query."""
        best = np.argmax(self._block, axis=1)
        self._top = self._block[np.arange(len(self._block)), best].astype(np.float64)
        self._false = np.where(self._top > -np.inf, best, -1)
        floor = _round_down(self._top - self._gap)
        near = _count_true(self._block >= floor[:, None])
        for row in np.flatnonzero((near > 1) & (self._false >= 0) & ~self._needs_double).tolist():
            if near[row] > self._max_close:
                self._needs_double[row] = True
                continue
            close = np.flatnonzero(self._block[row] >= floor[row])
            self._false[row] = close[np.argmax(self._exact(row, close))]

    def _rank_single(self, entries: Int64Array) -> None:
        """Rank queries with one true match, given the positions of their entries."""
        rows, tiles, score = self._row[entries], self._tile[entries], self._true[entries].astype(np.float64)
        above, between = np.zeros(len(rows), np.int64), np.zeros(len(rows), np.int64)
        low, high = _round_down(score - self._gap[rows]), _round_up(score + self._gap[rows])
        contested = np.flatnonzero(self._top[rows] >= low)
        some = self._block[rows[contested]]
        above[contested] = _count_true(some > high[contested, None])
        between[contested] = _count_true(some >= low[contested, None]) - above[contested]
        self._needs_double[rows[between > self._max_close]] = True
        unsure = np.flatnonzero((between > 0) & ~self._needs_double[rows])
        queries, error = self._start + rows[unsure], self._gap[rows[unsure]] / 2
        exact = self._scores.pairs(queries, tiles[unsure])
        low, high = (edge[:, None] for edge in (_round_down(exact - error), _round_up(exact + error)))
        some = self._block[rows[unsure]]
        line, close = np.nonzero((some >= low) & (some <= high))
        before = _ranks_before(exact[line], tiles[unsure][line], self._scores.pairs(queries[line], close), close)
        above[unsure] = _count_true(some > high) + np.bincount(line[before], minlength=len(unsure))
        self._first[rows], self._nearest[rows] = above, tiles
        precision = 1 / (above + 1)
        self._precision[rows] = np.where(self._trapezoid[rows], (precision + (above == 0)) / 2, precision)

    def _rank_several(self, row: int, entries: slice) -> None:
        """Rank a query with several true matches."""
        tiles, score, gap = self._tile[entries], self._true[entries].astype(np.float64), self._gap[row]
        low, high = _round_down(score - gap), _round_up(score + gap)
        line = self._block[row]
        near = (line >= low.min()).nonzero()[0]
        order = near[line[near].argsort()]
        ordered = line[order]
        start, stop = ordered.searchsorted(low, "left"), ordered.searchsorted(high, "right")
        above, unsure = len(ordered) - stop, (stop > start).nonzero()[0]
        nearest = (score >= score.max() - gap).nonzero()[0]
        exact = np.zeros(len(tiles))
        recomputed = np.union1d(unsure, nearest) if len(nearest) > 1 else unsure
        if len(recomputed):
            exact[recomputed] = self._exact(row, tiles[recomputed])
            # Now only the false tile's score has a rounding error.
            start = ordered.searchsorted(_round_down(exact[unsure] - gap / 2), "left")
            stop = ordered.searchsorted(_round_up(exact[unsure] + gap / 2), "right")
            counts = stop - start
            if counts.sum() > self._max_close:
                self._needs_double[row] = True
                return
            owner = unsure.repeat(counts)
            close = order[np.arange(len(owner)) + (start - counts.cumsum() + counts).repeat(counts)]
            before = _ranks_before(exact[owner], tiles[owner], self._exact(row, close), close)
            above[unsure] = len(ordered) - stop
            above += np.bincount(owner[before], minlength=len(above))
        above.sort()
        self._set_ranks(row, above + np.arange(len(above)))
        self._nearest[row] = tiles[nearest[exact[nearest].argmax()]]

    def _rank_in_double(self) -> None:
        """Rank the queries whose scores are too close together, or too large, for single precision."""
        rows = np.flatnonzero(self._needs_double)
        for query, line in self._scores.double(rows + self._start):
            row = query - self._start
            own = slice(*np.searchsorted(self._row, [row, row + 1]))
            tiles = self._tile[own]
            self._ground_truth.drop(line[None], slice(query, query + 1), -np.inf)
            true = line[tiles].copy()
            line[tiles] = -np.inf
            false = int(np.argmax(line))
            self._false[row] = false if line[false] > -np.inf else -1
            if len(tiles):
                order = np.argsort(line)
                ordered = line[order]
                start, stop = np.searchsorted(ordered, true, "left"), np.searchsorted(ordered, true, "right")
                before = [np.count_nonzero(order[a:b] < tile) for a, b, tile in zip(start, stop, tiles, strict=True)]
                self._set_ranks(row, np.sort(len(ordered) - stop + before) + np.arange(len(tiles)))
                self._nearest[row] = tiles[np.argmax(true)]

    def _set_ranks(self, row: int, ranks: Int64Array) -> None:
        self._first[row], self._precision[row] = ranks[0], average_precision(ranks, bool(self._trapezoid[row]))

    def _exact(self, row: int, tiles: Int64Array) -> Float64Array:
        return self._scores.exact(self._start + row, tiles)


def average_precision(ranks: Int64Array, trapezoid: bool = True) -> float:
    """Average precision from the ascending 0-based ranks of all true matches, at least one.

    It is the area below the precision-recall points by the trapezoid rule, or else the mean precision at the true matches.
    """
    hits = np.arange(len(ranks))
    after = (hits + 1) / (ranks + 1)
    if not trapezoid:
        return float(after.mean())
    before = np.where(ranks == 0, 1.0, hits / np.maximum(ranks, 1))
    return float(((after + before) / 2).mean())


def _gaps(block: Float32Array) -> Float64Array:
    """Return twice the difference of the two highest scores of each row, NaN without two of them; `block` is left as it is."""
    if block.shape[1] < 2:
        return np.full(len(block), np.nan)
    rows, highest = np.arange(len(block)), np.argmax(block, axis=1)
    first = block[rows, highest]
    block[rows, highest] = -np.inf
    second = block.max(axis=1)
    block[rows, highest] = first
    gaps = 2.0 * (first.astype(np.float64) - second)
    return np.where(np.isfinite(gaps), gaps, np.nan)


def _ranks_before(
    score: float | Float64Array, tile: int | Int64Array, others: Float64Array, tiles: Int64Array
) -> BoolArray:
    """True for the `tiles` that rank before `tile`; equal scores rank in gallery order."""
    return np.asarray((others > score) | ((others == score) & (tiles < tile)))


def _count_true(mask: BoolArray) -> Int64Array:
    """Count True in each row; many times faster than `count_nonzero` along an axis."""
    total: AnyArray = mask.view(np.uint8).sum(axis=1, dtype=np.uint16 if mask.shape[1] < 2**16 else np.uint32)
    return total.astype(np.int64)


def _round_down(values: Float64Array) -> Float32Array:
    """Round down to single precision."""
    return np.nextafter(values.astype(np.float32), np.float32(-np.inf))


def _round_up(values: Float64Array) -> Float32Array:
    return np.nextafter(values.astype(np.float32), np.float32(np.inf))
