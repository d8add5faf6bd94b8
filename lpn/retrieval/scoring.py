"""Scores of parts: weights, cosines, and each part's exact share of the squared distance.

With parts q_i, g_i of norm 1/sqrt(n) and part weights w_i with sum one, cos_i = n q_i . g_i and

    score = sum_i w_i cos_i,        distance^2 = 2 - 2 score = sum_i 2 w_i (1 - cos_i).
"""

from __future__ import annotations

from typing import cast

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError


def part_weights(n: int, values: npt.ArrayLike | None = None) -> Float32Array:
    """Return part weights with sum one, (n,) float32; equal weights by default.

    Raises:
        InputError: when there are not n values, one is negative or not finite, or all are zero.
    """
    weights = np.ones(n) if values is None else np.asarray(values, dtype=np.float64)
    if weights.shape != (n,) or not np.isfinite(weights).all() or (weights < 0).any() or weights.sum() <= 0:
        raise InputError(f"The part weights are {weights.tolist()}; expected {n} numbers of 0 or more, not all 0.")
    return cast(Float32Array, (weights / weights.sum()).astype(np.float32))


def part_cosines(query: Float32Array, gallery: Float32Array) -> Float32Array:
    """Return the cosine of each part of a query (n, D) with the parts of each gallery descriptor (G, n, D): (G, n) float32."""
    n = query.shape[0]
    # One batched product per part: NumPy's einsum would fall back to a slow loop here.
    return cast(Float32Array, n * np.matmul(gallery.transpose(1, 0, 2), query[:, :, None])[..., 0].T)


def contributions(
    cosines: Float32Array,
    weights: Float32Array,
    lengths: Float32Array | None = None,
    terms: Float32Array | None = None,
) -> Float32Array:
    """Return each part's exact share 2 w_i (1 - cos_i) of the squared distance, (..., n); they add up to it.

    Args:
        lengths: n |q_i|^2 of each part of a region's query, see `Trace.region`, (n,); 1 by default. The share is then
            w_i (1 + n |q_i|^2 - 2 n q_i . g_i), and `cosines` has n q_i . g_i.
        terms: the terms that CSLS subtracts from the cosines, (..., n); they add 2 w_i terms_i to the share.
    """
    query_lengths = np.float32(1) if lengths is None else lengths
    similarities = cosines if terms is None else cosines - terms
    return cast(Float32Array, weights * (1.0 + query_lengths - 2.0 * similarities))


def activation(total: Float32Array) -> Float32Array:
    """Scale the channel sum of a map (h, w) to 0 .. 1 (Figure 7); it depends on one picture, not on a pair."""
    low, high = float(total.min()), float(total.max())
    return cast(Float32Array, ((total - low) / max(high - low, 1e-12)).astype(np.float32))
