"""Weights stored in fewer bits than they are computed with."""

from __future__ import annotations

from typing import Literal

import numpy as np

from lpn.core.arrays import Float32Array, Int8Array

WeightType = Literal["float32", "float16", "int8"]


def to_eight_bits(kernels: Float32Array) -> tuple[Int8Array, Float32Array]:
    """Round kernels to 8 bits, each output channel by the largest of its own values.

    Args:
        kernels: (O, I, h, w).

    Returns:
        Integers from -127 to 127 (O, I, h, w), and scales (O, 1, 1, 1); their product is the kernels to within half a scale.
    """
    scale = np.maximum(np.abs(kernels).max(axis=(1, 2, 3), keepdims=True), 1e-30) / np.float32(127)
    return np.round(kernels / scale).astype(np.int8), scale.astype(np.float32)
