"""Tests of the turn at which two feature maps fit."""

from __future__ import annotations

import numpy as np
import pytest

from lpn.core.arrays import Float32Array
from lpn.explain.relative_turn import relative_turn
from lpn.models.trace import Trace


def trace_of(features: Float32Array) -> Trace:
    """The trace of one pass with a map (C, h, w); nothing but the map matters here."""
    nothing = np.zeros((1, 1), np.float32)
    return Trace(
        nothing, features[None], np.ones((1, 1, *features.shape[1:]), np.float32), None, None, np.zeros((1, 1))
    )


@pytest.mark.parametrize("quarters", range(4))
def test_a_map_that_was_turned_is_turned_back(quarters: int) -> None:
    query = np.random.default_rng(3).random((8, 12, 12), np.float32)
    tile = np.rot90(query, -quarters, axes=(1, 2))  # clockwise
    assert relative_turn(trace_of(query), trace_of(np.ascontiguousarray(tile))) == 90 * quarters


def test_maps_that_cannot_be_laid_over_each_other_have_no_turn() -> None:
    maps = np.random.default_rng(3).random((8, 12, 12), np.float32)
    square = trace_of(maps)
    assert relative_turn(square, trace_of(maps[:, :10, :10])) is None
    assert relative_turn(trace_of(maps[:, :6]), trace_of(maps[:, :6])) is None
    assert relative_turn(square, trace_of(np.ones_like(maps))) is None
