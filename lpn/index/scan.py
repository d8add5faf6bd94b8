"""An upper bound on every tile's score from a small copy of its vector, so that few vectors need be read in full.

A vector g is kept as g' = scale * (integers -127 .. 127), or in float16, and for each of its parts the norm r_i of what that
leaves out. A rescaled query v is used as v' where the product needs it smaller too. By Cauchy-Schwarz, part by part,

    v . g = v' . g' + (v - v') . g' + v . (g - g')  <=  v' . g' + sum_i |v_i - v'_i| |g'_i| + sum_i |v_i| r_i

and a sum of m products in float32, in any order, is off by at most m u / (1 - m u) |v'| |g'| with u = 2^-24. Float32 vectors have
no copy, r_i = 0, and the last term alone. A tile whose bound is below the k-th best score is not among the k best.

In int8 the query is a pair of integer vectors, the second being what the first left out, 254 times finer; both meet a row
while it is in the processor's cache, so that the second costs little and the query's error next to nothing.

The products of float16 and int8 rows are numkong's where it is installed (the extra `search`), which reads them as they are;
otherwise NumPy's, of rows turned into float32 block by block.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Literal

import numpy as np

from lpn.core.arrays import AnyArray, Float32Array, Float64Array
from lpn.core.resources import usable_cores
from lpn.index.base import LONGEST, Kind

Precision = Literal["float32", "float16", "int8"]
PRECISIONS: tuple[Precision, ...] = ("float32", "float16", "int8")

_STEPS = 127
_FINER = 2 * _STEPS
_UNIT = 2.0**-24
_ROUNDING = 1e-12
_INTEGERS = 1 << 16
"""Numbers of a vector up to which sums of 8-bit products, shifted to be unsigned as some processors want it, fit 32 bits."""
_BLOCK = 1 << 22
"""Numbers in a block of rows for numkong: 4096 rows of 4 parts of 512 halve the calls, and 8 MB a thread is soon read."""
_NUMPY_BLOCK = 1 << 20


def small_copy(vectors: Float32Array, kind: Kind, precision: Precision) -> tuple[AnyArray, Float32Array, Float32Array]:
    """What a scan reads in place of vectors (B, n D).

    Returns:
        The copy (B, n D) in float16 or int8, the scale of each row (B,) float32, and the norm of what it leaves out of each
        part, (B, n) float32, rounded up.
    """
    if precision == "float16":
        scales = np.ones(len(vectors), np.float32)
        copy: AnyArray = vectors.astype(np.float16)
    else:
        scales = np.abs(vectors).max(axis=1, initial=0.0) / np.float32(_STEPS)
        copy = np.round(vectors / np.maximum(scales, np.float32(1e-30))[:, None]).clip(-_STEPS, _STEPS).astype(np.int8)
    left = vectors - copy * scales.astype(np.float64)[:, None]
    norms = np.linalg.norm(left.reshape(len(vectors), kind.n_parts, kind.embedding), axis=2)
    return copy, scales, np.nextafter(norms.astype(np.float32), np.float32(np.inf)) * np.float32(1 + 1e-6)


class Scan:
    """Upper bounds on scores, by a few threads.

    Args:
        threads: that share the rows; by default as many as the process may use, at most 8. NumPy's own products choose theirs.
    """

    def __init__(self, kind: Kind, precision: Precision, threads: int | None = None) -> None:
        self._kind, self._precision = kind, precision
        self._threads = threads or min(8, usable_cores())
        self._pool: ThreadPoolExecutor | None = None

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    def bounds(
        self, wanted: Float64Array, rows: AnyArray, scales: Float32Array | None, errors: Float32Array | None
    ) -> Float64Array:
        """At least the score of each row under a rescaled query (n D,): (N,) float64.

        Args:
            rows: (N, n D) in the precision of the scan.
            scales, errors: as `small_copy` gives them; None in float32.
        """
        longest = LONGEST * self._kind.n_parts**-0.5
        if scales is None or errors is None:
            used = wanted.astype(np.float32)
            upper: Float64Array = (rows @ used).astype(np.float64)
            return upper + self._missed(wanted - used, longest) + self._rounding(wanted, longest) + _ROUNDING
        # What a row's small copy can be longer than the row: half a step in every number.
        longest *= 1 + self._kind.embedding**0.5 / (2 * _STEPS)
        kernel = _numkong()
        if kernel is not None and self._precision == "int8" and self._kind.numbers <= _INTEGERS:
            scale = max(float(np.abs(wanted).max()), 1e-300) / _STEPS
            first = np.round(wanted / scale)
            second = np.round((wanted / scale - first) * _FINER)
            products = self._products(kernel, np.stack([first, second]).astype(np.int8), rows)
            upper = (products[0] + products[1] / _FINER) * (scale * scales.astype(np.float64))
            missed = self._missed(wanted - scale * (first + second / _FINER), longest)
        elif kernel is not None and self._precision == "float16":
            half = wanted.astype(np.float16)
            upper = self._products(kernel, half[None], rows)[0]
            missed = self._missed(wanted - half, longest) + self._rounding(wanted, longest)
        else:
            used = wanted.astype(np.float32)
            upper = np.empty(len(rows))
            for block in _blocks(len(rows), max(1, _NUMPY_BLOCK // self._kind.numbers)):
                upper[block] = rows[block].astype(np.float32) @ used
            upper *= scales
            missed = self._missed(wanted - used, longest) + self._rounding(wanted, longest)
        parts = np.linalg.norm(wanted.reshape(self._kind.n_parts, -1), axis=1)
        upper += errors @ (parts * (1 + 1e-5)).astype(np.float32)
        upper += missed + _ROUNDING
        return upper

    def _missed(self, difference: Float64Array, longest: float) -> float:
        """The most that a tile's score can differ for what the query was rounded by."""
        return float(np.linalg.norm(difference.reshape(self._kind.n_parts, -1), axis=1).sum()) * longest

    def _rounding(self, wanted: Float64Array, longest: float) -> float:
        share = self._kind.numbers * _UNIT
        norm = 1.001 * float(np.linalg.norm(wanted)) * longest * self._kind.n_parts**0.5
        return float(share / (1 - share) * norm)

    def _products(self, kernel: ModuleType, queries: AnyArray, rows: AnyArray) -> Float64Array:
        """Inner products of queries (Q, n D) with rows (N, n D): (Q, N)."""
        found = np.empty((len(queries), len(rows)))
        size = min(max(1, _BLOCK // self._kind.numbers), max(1, -(-len(rows) // self._threads)))

        def product(block: slice) -> None:
            found[:, block] = np.asarray(kernel.cdist(queries, rows[block], metric="dot"))

        self._share(product, list(_blocks(len(rows), size)))
        return found

    def _share(self, task: Callable[[slice], None], blocks: list[slice]) -> None:
        if len(blocks) < 2 or self._threads == 1:
            for block in blocks:
                task(block)
            return
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self._threads, thread_name_prefix="scan")
        list(self._pool.map(task, blocks))


def _blocks(rows: int, size: int) -> Iterator[slice]:
    return (slice(start, min(start + size, rows)) for start in range(0, rows, size))


@cache
def _numkong() -> ModuleType | None:
    """The library, where it is installed and adds up on this processor as the bounds above assume; else None."""
    try:
        kernel = import_module("numkong")
    except ImportError:
        return None
    # All of one sign, so that a sum kept in half precision or in 16 bits would be far off.
    large = np.full((3, 4096), _STEPS, np.int8)
    halves = np.linspace(0.5, 1, 3 * 4096).reshape(3, 4096).astype(np.float16)
    for rows in (large, halves):
        exact = rows[:2].astype(np.float64) @ rows.T.astype(np.float64)
        found = np.asarray(kernel.cdist(rows[:2], rows, metric="dot"))
        if not (abs(found - exact) <= (0 if rows is large else 4096 * _UNIT) * exact).all():
            return None
    return kernel
