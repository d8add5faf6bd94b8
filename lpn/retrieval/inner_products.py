"""Inner products of many queries with a gallery, in single precision with an error bound, or in double precision.

An inner product of F numbers in single precision (u = 2^-24), summed in any order over chunks of L and then over the chunks,
has an error of at most

    (L + ceil(F / L) + 2) u |q| |g|

which includes two roundings of the numbers themselves to single precision (Higham, "Accuracy and Stability of Numerical
Algorithms", 3.1). Two products that differ by more than twice this bound are in the order of the true products.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from functools import cached_property

import numpy as np

from lpn.core.arrays import AnyArray, Float32Array, Float64Array, Int64Array

_BLOCK_BYTES = 160_000_000
# Maximum number of queries in a block.
_BLOCK_ROWS = 1024
# Tiles multiplied at a time, so that partial sums stay in the processor's cache.
_COLUMNS = 4096
# Numbers of a descriptor that are summed in one chunk: shorter chunks give a tighter bound and cost more additions.
_CHUNK = 512
# Unit roundoff of single precision.
_UNIT = 2.0**-24
_PAIRS_AT_A_TIME = 1024


class Scores:
    """Inner products of queries (Q, F) with tiles (G, F) of any floating type, without a copy in double precision.

    Args:
        norms: upper bounds on the norms of the queries (Q,) and of the tiles (G,), see `norms`.
        factors: multiplied into each query first, (F,).
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
            # The extra error of subnormal numbers, which have fewer than 24 digits.
            self._errors += length * 2.0**-120 * (1 + reach) * (1 + longest)
            self._errors[~(reach * longest < 1e37)] = np.inf

    def blocks(self) -> Iterator[tuple[slice, Float32Array, Float64Array]]:
        """Yield blocks of queries of at most 160 MB.

        Yields:
            The rows of the block, their products with all tiles (B, G), which the caller may overwrite, and the error bound of
            each row, (B,), infinite on overflow.
        """
        block = max(1, min(_BLOCK_ROWS, _BLOCK_BYTES // (4 * max(len(self._tiles), 1))))
        for start in range(0, len(self._queries), block):
            rows = slice(start, min(start + block, len(self._queries)))
            with np.errstate(over="ignore", invalid="ignore"):
                products = self._products(_to_single(self._scaled(rows)))
            yield rows, products, self._errors[rows]

    def exact(self, query: int, tiles: Int64Array) -> Float64Array:
        """Return the products of one query with some tiles in double precision, equal for equal tiles, (P,)."""
        return self.pairs(np.full(len(tiles), query), tiles)

    def pairs(self, queries: Int64Array, tiles: Int64Array) -> Float64Array:
        """Return the products of pairs in double precision, (P,)."""
        products = np.empty(len(queries))
        for start in range(0, len(queries), _PAIRS_AT_A_TIME):
            some = slice(start, start + _PAIRS_AT_A_TIME)
            # Rows must be summed in the same order: a matrix product may change it from row to row, and einsum splits long
            # rows by their position in its buffer.
            scaled = self._scaled(queries[some]).astype(np.float64, copy=False)
            products[some] = (scaled * self._tiles[tiles[some]]).sum(axis=1)
        return products

    def double(self, queries: Int64Array) -> Iterator[tuple[int, Float64Array]]:
        """Yield each query and its products with all tiles in double precision, equal for equal tiles, (G,)."""
        group = max(1, _BLOCK_BYTES // (8 * max(len(self._tiles), 1)))
        for start in range(0, len(queries), group):
            some = queries[start : start + group]
            scaled = self._scaled(some).astype(np.float64, copy=False)
            products = np.empty((len(some), len(self._tiles)))
            for begin in range(0, len(self._tiles), _COLUMNS):
                columns = slice(begin, begin + _COLUMNS)
                products[:, columns] = scaled @ self._tiles[columns].astype(np.float64).T
            yield from zip(some.tolist(), products[:, self._first_equal], strict=True)

    @cached_property
    def _first_equal(self) -> Int64Array:
        """The first tile that equals each tile, since a matrix product may differ between equal columns."""
        # Equal tiles have equal sums, and other tiles rarely do.
        sums = self._tiles.sum(axis=1)
        first_equal = np.arange(len(sums))
        _, kind, counts = np.unique(sums, return_inverse=True, return_counts=True)
        first: dict[bytes, int] = {}
        for tile in np.flatnonzero(counts[kind] > 1).tolist():
            key = hashlib.blake2b(self._tiles[tile].tobytes(), digest_size=16).digest()
            first_equal[tile] = first.setdefault(key, tile)
        return first_equal

    def _scaled(self, rows: slice | Int64Array) -> AnyArray:
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


def norms(rows: AnyArray) -> Float64Array:
    """Return upper bounds on the norms of rows (N, F), at most 0.1 % too large; not finite for rows that are not, (N,)."""
    bounds = np.empty(len(rows))
    length = rows.shape[1]
    for start in range(0, len(rows), _PAIRS_AT_A_TIME):
        some = _to_single(rows[start : start + _PAIRS_AT_A_TIME])
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.einsum("nf,nf->n", some, some).astype(np.float64)
            # Recompute sums of squares near the limits of single precision.
            extreme = np.flatnonzero(~((squares > 1e-20) & (squares < 1e30)))
            if len(extreme) or length > 10_000:
                which = extreme if length <= 10_000 else np.arange(len(some))
                wide = rows[start : start + _PAIRS_AT_A_TIME][which].astype(np.float64)
                squares[which] = np.einsum("nf,nf->n", wide, wide)
            bounds[start : start + _PAIRS_AT_A_TIME] = 1.001 * np.sqrt(squares)
    return bounds


def _to_single(values: AnyArray) -> Float32Array:
    with np.errstate(over="ignore"):
        return values.astype(np.float32, copy=False)
