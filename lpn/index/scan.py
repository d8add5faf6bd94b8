"""Bounds on the scores of tiles by one float32 product, so that few vectors are scored in float64.

A vector g is copied as g' = scale * (integers from -127 to 127), or in float16, with the norm r_i of the error of each part. For
a rescaled query v, Cauchy-Schwarz for each part gives

    |v . g - v . g'|  <=  sum_i |v_i| r_i

A product of m numbers in float32, summed in any order after v is rounded, has an error of at most M u / (1 - M u) |v| |g'| with
M = m + 2 and u = 2^-24. Float32 vectors have no copy: r_i = 0, and only rounding remains.
"""

from __future__ import annotations

import numpy as np

from lpn.core.arrays import AnyArray, Float32Array, Float64Array
from lpn.descriptors.store import Precision
from lpn.index.base import LONGEST, DescriptorKind

_STEPS = 127
_UNIT = 2.0**-24
# Exceeds the rounding of a score in float64, for a query whose numbers are at most 1.
_ROUNDING = 1e-12


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


def score_bounds(
    kind: DescriptorKind,
    wanted: Float64Array,
    rows: AnyArray,
    scales: Float32Array | None,
    errors: Float32Array | None,
) -> tuple[Float64Array, Float64Array]:
    """Bound the score of each row.

    Args:
        wanted: a rescaled query whose numbers are at most 1, (n D,).
        rows: vectors or their copies, (N, n D) float32, float16, or int8.
        scales, errors: of the copies, see `small_copy`; None for vectors.

    Returns:
        A lower and an upper bound of each score, (N,) each.
    """
    scores = (rows.astype(np.float32, copy=False) @ wanted.astype(np.float32)).astype(np.float64)
    share = (kind.numbers + 2) * _UNIT
    slack = 1.001 * share / (1 - share) * float(np.linalg.norm(wanted)) * LONGEST
    if scales is None or errors is None:
        slack += _ROUNDING
        return scores - slack, scores + slack
    # A copy can be longer than its vector, by half a step in every number.
    slack = slack * (1 + kind.embedding**0.5 / (2 * _STEPS)) + _ROUNDING
    scores *= scales
    lengths = np.linalg.norm(wanted.reshape(kind.n_parts, -1), axis=1) * (1 + 1e-5)
    missed = errors @ lengths.astype(np.float32) + slack
    return scores - missed, scores + missed
