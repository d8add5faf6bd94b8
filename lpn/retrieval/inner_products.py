"""Inner products of many queries with a gallery: single precision with a bound on its error, double where that decides.

A product of F numbers in single precision (u = 2^-24), summed in any order over chunks of L and then over the chunks, is
off by at most

    (L + ceil(F / L) + 2) u |q| |g|

two roundings of which are those of the numbers themselves, where they were not single (Higham, "Accuracy and Stability
of Numerical Algorithms", 3.1). Two products that lie further apart than twice that are in the order of the true ones.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from functools import cached_property

import numpy as np

from lpn.core.arrays import AnyArray, Float32Array, Float64Array, Int64Array

_BLOCK_BYTES = 160_000_000
_ROWS = 1024
# Tiles multiplied at a time, so that partial sums stay in the processor's cache.
_COLUMNS = 4096
# Numbers of a descriptor that are summed in one chunk: shorter chunks give a tighter bound and cost more additions.
_CHUNK = 512
_UNIT = 2.0**-24
_PAIRS = 1024


class Scores:
    """Inner products of queries (Q, F) with tiles (G, F), any floats, none of them held in double precision.

    Args:
        norms: bounds for the queries (Q,) and for the tiles (G,), see `norms`.
        factors: multiply each number of a query first, (F,).
    """

    def __init__(
        self,
        queries: AnyArray,
        tiles: AnyArray,
        norms: tuple[Float64Array, Float64Array],
        factors: Float64Array | None = None,
    ) -> None:
        self._queries, self._tiles, self._factors = queries, tiles, factors
        self._single = _to_single(tiles)
        length = queries.shape[1]
        terms = min(length, _CHUNK) + -(-length // _CHUNK) + 2
        reach = norms[0] * (1.0 if factors is None else float(np.abs(factors).max(initial=0.0)))
        longest = float(norms[1].max(initial=0.0))
        with np.errstate(over="ignore", invalid="ignore"):
            self._errors = 1.02 * terms * _UNIT * reach * longest
            # The loss of subnormal numbers, which have fewer than 24 digits.
            self._errors += length * 2.0**-120 * (1 + reach) * (1 + longest)
            self._errors[~(reach * longest < 1e37)] = np.inf

    def blocks(self) -> Iterator[tuple[slice, Float32Array, Float64Array]]:
        """Yield the queries in blocks of at most 160 MB: the rows, their products (B, G), which the caller may change, and the
        error bound of each row, (B,), infinite on overflow."""
        block = max(1, min(_ROWS, _BLOCK_BYTES // (4 * max(len(self._tiles), 1))))
        for start in range(0, len(self._queries), block):
            rows = slice(start, min(start + block, len(self._queries)))
            with np.errstate(over="ignore", invalid="ignore"):
                found = self._products(_to_single(self._asked(rows)))
            yield rows, found, self._errors[rows]

    def exact(self, query: int, tiles: Int64Array) -> Float64Array:
        """Products of one query with some tiles in double precision, equal for equal tiles, (P,)."""
        return self.pairs(np.full(len(tiles), query), tiles)

    def pairs(self, queries: Int64Array, tiles: Int64Array) -> Float64Array:
        """Products of pairs in double precision, (P,)."""
        found = np.empty(len(queries))
        for start in range(0, len(queries), _PAIRS):
            some = slice(start, start + _PAIRS)
            # Not as a matrix product, which may sum one row in another order than the next.
            asked = self._asked(queries[some]).astype(np.float64, copy=False)
            # And not by einsum, which cuts long rows by where they lie in its buffer.
            found[some] = (asked * self._tiles[tiles[some]]).sum(axis=1)
        return found

    def double(self, queries: Int64Array) -> Iterator[tuple[int, Float64Array]]:
        """Some queries, and the products of each with all tiles in double precision, equal for equal tiles, (G,)."""
        group = max(1, _BLOCK_BYTES // (8 * max(len(self._tiles), 1)))
        for start in range(0, len(queries), group):
            some = queries[start : start + group]
            asked = self._asked(some).astype(np.float64, copy=False)
            found = np.empty((len(some), len(self._tiles)))
            for begin in range(0, len(self._tiles), _COLUMNS):
                columns = slice(begin, begin + _COLUMNS)
                found[:, columns] = asked @ self._tiles[columns].astype(np.float64).T
            yield from zip(some.tolist(), found[:, self._twins], strict=True)

    @cached_property
    def _twins(self) -> Int64Array:
        """For each tile the first that is equal: a matrix product may sum the columns at its edge in another order."""
        sums = self._tiles.sum(axis=1)  # equal for equal tiles, and rarely for others
        found = np.arange(len(sums))
        _, kind, counts = np.unique(sums, return_inverse=True, return_counts=True)
        first: dict[bytes, int] = {}
        for tile in np.flatnonzero(counts[kind] > 1).tolist():
            key = hashlib.blake2b(self._tiles[tile].tobytes(), digest_size=16).digest()
            found[tile] = first.setdefault(key, tile)
        return found

    def _asked(self, rows: slice | Int64Array) -> AnyArray:
        asked = self._queries[rows]
        return asked if self._factors is None else asked.astype(np.float64) * self._factors

    def _products(self, asked: Float32Array) -> Float32Array:
        found = np.empty((len(asked), len(self._single)), np.float32)
        apart = np.empty((len(asked), min(_COLUMNS, len(self._single))), np.float32)
        for begin in range(0, len(self._single), _COLUMNS):
            tiles = self._single[begin : begin + _COLUMNS]
            sums = found[:, begin : begin + _COLUMNS]
            np.matmul(asked[:, :_CHUNK], tiles[:, :_CHUNK].T, out=sums)
            for first in range(_CHUNK, asked.shape[1], _CHUNK):
                chunk = slice(first, first + _CHUNK)
                sums += np.matmul(asked[:, chunk], tiles[:, chunk].T, out=apart[:, : len(tiles)])
        return found


def norms(rows: AnyArray) -> Float64Array:
    """Upper bounds on the norms of rows (N, F), a thousandth too long at most; not finite where a number is not, (N,)."""
    found = np.empty(len(rows))
    length = rows.shape[1]
    for start in range(0, len(rows), _PAIRS):
        some = _to_single(rows[start : start + _PAIRS])
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.einsum("nf,nf->n", some, some).astype(np.float64)
            odd = np.flatnonzero(~((squares > 1e-20) & (squares < 1e30)))  # single precision does not reach further
            if len(odd) or length > 10_000:
                which = odd if length <= 10_000 else np.arange(len(some))
                wide = rows[start : start + _PAIRS][which].astype(np.float64)
                squares[which] = np.einsum("nf,nf->n", wide, wide)
            found[start : start + _PAIRS] = 1.001 * np.sqrt(squares)
    return found


def _to_single(values: AnyArray) -> Float32Array:
    with np.errstate(over="ignore"):
        return values.astype(np.float32, copy=False)
