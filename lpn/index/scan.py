"""Upper bounds on the scores of all tiles, from compact copies of their vectors, so that few vectors are read in full.

A vector g is copied as g' = scale * (integers from -127 to 127), or in float16, with the norm r_i of the error of each part. A
rescaled query v is rounded to v' if the product needs it. By Cauchy-Schwarz for each part,

    v . g = v' . g' + (v - v') . g' + v . (g - g')  <=  v' . g' + sum_i |v_i - v'_i| |g'_i| + sum_i |v_i| r_i

A sum of m products in float32, in any order, has an error of at most m u / (1 - m u) |v'| |g'| with u = 2^-24. Float32 vectors
have no copy: r_i = 0, and only rounding remains. A tile whose bound is below the k-th best score is not among the k best.

numkong multiplies float16 and int8 rows directly where it is installed (the extra `search`), by a query that is rounded likewise:
as many numbers as a row has are multiplied once, which takes as long as all else together. Where a finer bound is asked for, and
otherwise, NumPy multiplies rows that are converted to float32 block by block by the query in float32.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from importlib import import_module
from types import ModuleType

import numpy as np

from lpn.core.arrays import AnyArray, Float32Array, Float64Array
from lpn.core.resources import usable_cores
from lpn.descriptors.store import Precision
from lpn.index.base import LONGEST, DescriptorKind

PRECISIONS: tuple[Precision, ...] = ("float32", "float16", "int8")

_STEPS = 127
_UNIT = 2.0**-24
_ROUNDING = 1e-12
# Queries whose numbers reach 2 to this power are scaled down by a power of two, which changes no digit.
_EXPONENT = 10
# Maximum length of a vector for which sums of 8-bit products, shifted to unsigned as on some processors, fit 32 bits.
_INTEGERS = 1 << 16
# Numbers in a block of rows for numkong: 4096 rows of 4 parts of 512.
_BLOCK = 1 << 22
_NUMPY_BLOCK = 1 << 20
# Takes the bounds of a block of rows, see `Scan.run`.
TakeBounds = Callable[[slice, Float64Array, Float64Array], None]


def small_copy(
    vectors: Float32Array, kind: DescriptorKind, precision: Precision
) -> tuple[AnyArray, Float32Array, Float32Array]:
    """Make compact copies of vectors (B, n D).

    Returns:
        The copies (B, n D) in float16 or int8, the scale of each row (B,) float32, and the norm of the error of each part, (B, n)
        float32, rounded up.
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
    """Upper bounds on scores, computed by a few threads.

    Args:
        threads: number of threads, by default one for each usable core, 8 at most; without numkong, NumPy chooses.
    """

    def __init__(self, kind: DescriptorKind, precision: Precision, threads: int | None = None) -> None:
        self._kind, self._precision = kind, precision
        self._threads = threads or min(8, usable_cores())
        self._pool: ThreadPoolExecutor | None = None

    def close(self) -> None:
        """Stop the threads."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    def bounds(
        self,
        wanted: Float64Array,
        rows: AnyArray,
        scales: Float32Array | None,
        errors: Float32Array | None,
        finely: bool = False,
    ) -> Float64Array:
        """Return an upper bound on the score of each row, (N,) float64; see `run`."""
        upper = np.empty(len(rows))

        def take(block: slice, bounds: Float64Array, _: Float64Array) -> None:
            upper[block] = bounds

        self.run(wanted, rows, scales, errors, take, finely)
        return upper

    def run(
        self,
        wanted: Float64Array,
        rows: AnyArray,
        scales: Float32Array | None,
        errors: Float32Array | None,
        take: TakeBounds,
        finely: bool = False,
    ) -> None:
        """Compute bounds on the score of each row under a rescaled query (n D,), block by block.

        Args:
            rows: (N, n D) in the precision of the scan.
            scales, errors: from `small_copy`; None in float32.
            take: called with the rows of each block, an upper bound on the score of each, (B,) float64, and half the width of the
                interval below that bound in which the score lies, (B,); by several threads at once.
            finely: do not round the query to the precision of the rows; for a few rows, as it takes longer.
        """
        longest = LONGEST * self._kind.n_parts**-0.5
        exponent = int(np.frexp(np.abs(wanted).max())[1])
        if exponent > _EXPONENT:  # numbers of the rows' precision end at 65,504, or at 3e38

            def rescaled(block: slice, upper: Float64Array, slack: Float64Array) -> None:
                take(block, np.ldexp(upper, exponent), np.ldexp(slack, exponent))

            self.run(np.ldexp(wanted, -exponent), rows, scales, errors, rescaled, finely)
            return
        used = wanted.astype(np.float32)
        if scales is None or errors is None:
            missed = self._missed(wanted - used, longest) + self._rounding(wanted, longest) + _ROUNDING
            take(slice(0, len(rows)), (rows @ used).astype(np.float64) + missed, np.broadcast_to(missed, len(rows)))
            return
        # A copy can be longer than its row, by half a step in every number.
        longest *= 1 + self._kind.embedding**0.5 / (2 * _STEPS)
        kernel = None if finely else _numkong()
        missed = self._missed(wanted - used, longest) + self._rounding(wanted, longest)
        rounded: AnyArray | None = None
        scale = 1.0
        if kernel is not None and self._precision == "int8" and self._kind.numbers <= _INTEGERS:
            scale = max(float(np.abs(wanted).max()), 1e-300) / _STEPS
            rounded = np.round(wanted / scale).astype(np.int8)
            missed = self._missed(wanted - scale * rounded, longest)
        elif kernel is not None and self._precision == "float16":
            rounded = wanted.astype(np.float16)
            missed = self._missed(wanted - rounded, longest) + self._rounding(wanted, longest)
        parts = np.linalg.norm(wanted.reshape(self._kind.n_parts, -1), axis=1)
        lengths = (parts * (1 + 1e-5)).astype(np.float32)

        def fill(block: slice) -> None:
            # All of a block is computed while it is in the processor's cache.
            if kernel is None or rounded is None:
                upper = (rows[block].astype(np.float32) @ used).astype(np.float64)
            else:
                upper = np.asarray(kernel.cdist(rounded[None], rows[block], metric="dot"), np.float64)[0] * scale
            upper *= scales[block]
            slack = (errors[block] @ lengths).astype(np.float64)
            slack += missed + _ROUNDING
            upper += slack
            take(block, upper, slack)

        if rounded is None:  # NumPy's product has threads of its own
            for block in _blocks(len(rows), max(1, _NUMPY_BLOCK // self._kind.numbers)):
                fill(block)
        else:
            size = min(max(1, _BLOCK // self._kind.numbers), max(1, -(-len(rows) // self._threads)))
            self._share(fill, list(_blocks(len(rows), size)))

    def _missed(self, difference: Float64Array, longest: float) -> float:
        """Bound the change of a score by the rounding of the query."""
        return float(np.linalg.norm(difference.reshape(self._kind.n_parts, -1), axis=1).sum()) * longest

    def _rounding(self, wanted: Float64Array, longest: float) -> float:
        share = self._kind.numbers * _UNIT
        norm = 1.001 * float(np.linalg.norm(wanted)) * longest * self._kind.n_parts**0.5
        return float(share / (1 - share) * norm)

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
    """Import numkong if it is installed and accumulates on this processor as exactly as the bounds assume; else None."""
    try:
        kernel = import_module("numkong")
    except ImportError:
        return None
    # Numbers of one sign expose accumulation in half precision or 16 bits.
    large = np.full((3, 4096), _STEPS, np.int8)
    halves = np.linspace(0.5, 1, 3 * 4096).reshape(3, 4096).astype(np.float16)
    for rows in (large, halves):
        exact = rows[:1].astype(np.float64) @ rows.T.astype(np.float64)
        products = np.asarray(kernel.cdist(rows[:1], rows, metric="dot"))
        if not (abs(products - exact) <= (0 if rows is large else 4096 * _UNIT) * exact).all():
            return None
    return kernel
