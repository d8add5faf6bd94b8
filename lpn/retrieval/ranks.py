"""Ranks of the true matches of a block of queries, from single-precision scores and as few double-precision ones as decide.

The rank of a true match is the number of false tiles ahead of it plus the true ones ahead of it. Every false tile whose score
is further from the true one's than both can be off is counted as it stands; the few between are compared in double precision,
where equal scores are in gallery order. Where they are not few, such as among tiles that are all alike, the query's whole row
is computed in double precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lpn.core.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array
from lpn.datasets import Truth
from lpn.retrieval.inner_products import Scores

JUNK = -1
"""Label of gallery pictures that are ignored."""

_NONE = np.zeros(0, np.int64)
# Tiles of one query that are compared in double precision one by one; in large galleries, this share of the gallery.
_FEW = 256
_SHARE = 1 / 16


@dataclass(frozen=True, eq=False)
class Lists:
    """A list of tiles for each query, one after the other: `tiles[begin[i] : end[i]]` is the query i's, ascending."""

    tiles: Int64Array
    begin: Int64Array
    end: Int64Array

    @classmethod
    def of(cls, lists: Sequence[Int64Array]) -> Lists:
        """From a list of lists."""
        end = np.cumsum([len(one) for one in lists], dtype=np.int64)
        tiles = [np.sort(one) for one in lists]
        return cls(np.concatenate([_NONE, *tiles]).astype(np.int64), np.concatenate([[0], end[:-1]]), end)

    def cells(self, rows: slice) -> tuple[Int64Array, Int64Array]:
        """Row, counted from the first of these, and tile of every entry of some queries' lists."""
        begin, counts = self.begin[rows], self.end[rows] - self.begin[rows]
        before = np.cumsum(counts) - counts
        return np.repeat(np.arange(len(counts)), counts), self.tiles[
            np.arange(counts.sum()) + np.repeat(begin - before, counts)
        ]


@dataclass(frozen=True, eq=False)
class Marks:
    """The true tiles and the junk of each query, and the junk of all queries."""

    true: Lists
    junk: Lists
    never: Int64Array

    @classmethod
    def by_labels(cls, of_query: Int64Array, of_tile: Int64Array) -> Marks:
        """True tiles by label; a query labelled as junk has none."""
        by_label = np.argsort(of_tile, kind="stable")
        in_order = of_tile[by_label]
        begin, end = (np.searchsorted(in_order, of_query, side).astype(np.int64) for side in ("left", "right"))
        end[of_query == JUNK] = begin[of_query == JUNK]
        nothing = np.zeros(len(of_query), np.int64)
        return cls(Lists(by_label, begin, end), Lists(_NONE, nothing, nothing), np.flatnonzero(of_tile == JUNK))

    @classmethod
    def by_lists(cls, truth: Sequence[Truth]) -> Marks:
        """True tiles and junk by the data set's lists."""
        return cls(Lists.of([of.good for of in truth]), Lists.of([of.junk for of in truth]), _NONE)


@dataclass(frozen=True, eq=False)
class Ranked:
    """The rankings of some queries; -1 where there is no such rank or tile.

    Attributes:
        first: 0-based rank of each query's first true match, (B,).
        true: its nearest true tile, the first of equals, (B,).
        false: its nearest tile that is neither true nor junk, the first of equals, (B,).
        precision: its average precision, 0 .. 1, (B,).
    """

    first: Int64Array
    true: Int64Array
    false: Int64Array
    precision: Float64Array


def rank(scores: Scores, marks: Marks, rows: slice, block: Float32Array, errors: Float64Array) -> Ranked:
    """Rank the gallery for the queries of a block of `Scores.blocks`, which is written into."""
    with np.errstate(over="ignore", invalid="ignore"):  # where errors are infinite, nothing of the block is used
        return _Block(scores, marks, rows, block, errors).ranked()


class _Block:
    """A block while it is settled: `_block` holds the false tiles' scores, -inf for the others."""

    def __init__(self, scores: Scores, marks: Marks, rows: slice, block: Float32Array, errors: Float64Array) -> None:
        self._scores, self._start, self._block = scores, rows.start, block
        self._gap = 2 * errors
        self._marks, self._rows = marks, rows
        self._row, self._tile = marks.true.cells(rows)
        self._true = block[self._row, self._tile]
        for at in (marks.junk.cells(rows), (self._row, self._tile), (slice(None), marks.never)):
            block[at] = -np.inf
        size = block.shape
        self._few = max(_FEW, int(_SHARE * size[1]))
        self._wide = ~np.isfinite(errors)
        self._first, self._nearest, self._false = (np.full(size[0], -1, np.int64) for _ in range(3))
        self._precision = np.zeros(size[0])

    def ranked(self) -> Ranked:
        if self._block.shape[1]:
            counts = np.bincount(self._row, minlength=len(self._block))
            begins = np.cumsum(counts) - counts
            self._find_false()
            self._single(begins[counts == 1])
            for row in np.flatnonzero((counts > 1) & ~self._wide).tolist():
                self._several(row, slice(begins[row], begins[row] + counts[row]))
            self._settle_wide()
        return Ranked(self._first, self._nearest, self._false, self._precision)

    def _find_false(self) -> None:
        """The nearest false tile of each query."""
        lines = np.arange(len(self._block))
        found = np.argmax(self._block, axis=1)
        self._top = self._block[lines, found].astype(np.float64)
        self._false = np.where(self._top > -np.inf, found, -1)
        floor = _below(self._top - self._gap)
        near = _count(self._block >= floor[:, None])
        for row in np.flatnonzero((near > 1) & (self._false >= 0) & ~self._wide).tolist():
            if near[row] > self._few:
                self._wide[row] = True
                continue
            close = np.flatnonzero(self._block[row] >= floor[row])
            self._false[row] = close[np.argmax(self._exact(row, close))]

    def _single(self, entries: Int64Array) -> None:
        """Queries with one true match, at their entries."""
        rows, tiles, score = self._row[entries], self._tile[entries], self._true[entries].astype(np.float64)
        above, between = np.zeros(len(rows), np.int64), np.zeros(len(rows), np.int64)
        low, high = _below(score - self._gap[rows]), _over(score + self._gap[rows])
        contested = np.flatnonzero(self._top[rows] >= low)
        some = self._block[rows[contested]]
        above[contested] = _count(some > high[contested, None])
        between[contested] = _count(some >= low[contested, None]) - above[contested]
        self._wide[rows[between > self._few]] = True
        unsure = np.flatnonzero((between > 0) & ~self._wide[rows])
        asked, error = self._start + rows[unsure], self._gap[rows[unsure]] / 2
        exact = self._scores.pairs(asked, tiles[unsure])
        low, high = (edge[:, None] for edge in (_below(exact - error), _over(exact + error)))
        some = self._block[rows[unsure]]
        line, close = np.nonzero((some >= low) & (some <= high))
        before = _ahead(exact[line], tiles[unsure][line], self._scores.pairs(asked[line], close), close)
        above[unsure] = _count(some > high) + np.bincount(line[before], minlength=len(unsure))
        self._first[rows], self._nearest[rows] = above, tiles
        self._precision[rows] = (1 / (above + 1) + (above == 0)) / 2

    def _several(self, row: int, entries: slice) -> None:
        """A query with several true matches."""
        tiles, score, gap = self._tile[entries], self._true[entries].astype(np.float64), self._gap[row]
        low, high = _below(score - gap), _over(score + gap)
        line = self._block[row]
        near = (line >= low.min()).nonzero()[0]
        order = near[line[near].argsort()]
        held = line[order]
        start, stop = held.searchsorted(low, "left"), held.searchsorted(high, "right")
        above, unsure = len(held) - stop, (stop > start).nonzero()[0]
        rivals = (score >= score.max() - gap).nonzero()[0]
        exact = np.zeros(len(tiles))
        asked = np.union1d(unsure, rivals) if len(rivals) > 1 else unsure
        if len(asked):
            exact[asked] = self._exact(row, tiles[asked])
            # Now only one of the two scores can be off.
            start = held.searchsorted(_below(exact[unsure] - gap / 2), "left")
            stop = held.searchsorted(_over(exact[unsure] + gap / 2), "right")
            counts = stop - start
            if counts.sum() > self._few:
                self._wide[row] = True
                return
            owner = unsure.repeat(counts)
            close = order[np.arange(len(owner)) + (start - counts.cumsum() + counts).repeat(counts)]
            before = _ahead(exact[owner], tiles[owner], self._exact(row, close), close)
            above[unsure] = len(held) - stop
            above += np.bincount(owner[before], minlength=len(above))
        above.sort()
        self._take(row, above + np.arange(len(above)))
        self._nearest[row] = tiles[rivals[exact[rivals].argmax()]]

    def _settle_wide(self) -> None:
        """Queries whose scores are too close together, or too large, for single precision."""
        rows = np.flatnonzero(self._wide)
        for query, line in self._scores.double(rows + self._start):
            row = query - self._start
            own = slice(*np.searchsorted(self._row, [row, row + 1]))
            junk = self._marks.junk.cells(slice(query, query + 1))[1]
            tiles = self._tile[own]
            line[junk] = line[self._marks.never] = -np.inf
            true = line[tiles].copy()
            line[tiles] = -np.inf
            false = int(np.argmax(line))
            self._false[row] = false if line[false] > -np.inf else -1
            if len(tiles):
                order = np.argsort(line)
                held = line[order]
                start, stop = np.searchsorted(held, true, "left"), np.searchsorted(held, true, "right")
                before = [np.count_nonzero(order[a:b] < tile) for a, b, tile in zip(start, stop, tiles, strict=True)]
                self._take(row, np.sort(len(held) - stop + before) + np.arange(len(tiles)))
                self._nearest[row] = tiles[np.argmax(true)]

    def _take(self, row: int, ranks: Int64Array) -> None:
        self._first[row], self._precision[row] = ranks[0], average_precision(ranks)

    def _exact(self, row: int, tiles: Int64Array) -> Float64Array:
        return self._scores.exact(self._start + row, tiles)


def average_precision(ranks: Int64Array) -> float:
    """Average precision from the 0-based ranks of all true matches, ascending, at least one: the trapezoid rule."""
    hits = np.arange(len(ranks))
    after = (hits + 1) / (ranks + 1)
    before = np.where(ranks == 0, 1.0, hits / np.maximum(ranks, 1))
    return float(((after + before) / 2).mean())


def _ahead(score: float | Float64Array, tile: int | Int64Array, others: Float64Array, tiles: Int64Array) -> BoolArray:
    """True for the tiles that rank before one tile; equal scores rank in gallery order."""
    return np.asarray((others > score) | ((others == score) & (tiles < tile)))


def _count(mask: BoolArray) -> Int64Array:
    """Trues in each row; many times quicker than `count_nonzero` along an axis."""
    total: AnyArray = mask.view(np.uint8).sum(axis=1, dtype=np.uint16 if mask.shape[1] < 2**16 else np.uint32)
    return total.astype(np.int64)


def _below(values: Float64Array) -> Float32Array:
    """Round down to single precision."""
    return np.nextafter(values.astype(np.float32), np.float32(-np.inf))


def _over(values: Float64Array) -> Float32Array:
    return np.nextafter(values.astype(np.float32), np.float32(np.inf))
