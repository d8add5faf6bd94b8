"""Tests of the activation part by part: which cells it has, their values, and the ranges of its scales."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from lpn.core.arrays import Float32Array
from lpn.explain.part_activation import part_activation, value_ranges
from lpn.models.partition import Partition
from lpn.models.trace import Trace

PARTITIONS = [
    Partition("whole", 1),
    *(Partition("rings", n) for n in (2, 4, 8)),
    Partition("rings", 4, outside_in=True),
    Partition("rows", 4),
    Partition("columns", 3),
    Partition("windows", 3),
]


def trace(features: Float32Array, partition: Partition) -> Trace:
    """The trace of a picture with a map (C, h, w) that a partition cuts."""
    embedding = np.zeros((partition.n, len(features)))
    cells = partition.weights(*features.shape[1:])[None]
    return Trace(embedding.astype(np.float32), features[None], cells, None, None, embedding)


@given(st.sampled_from(PARTITIONS), st.tuples(st.integers(1, 20), st.integers(1, 20)))
def test_each_part_has_the_channel_sum_of_the_cells_that_it_pools(partition: Partition, size: tuple[int, int]) -> None:
    features = np.random.default_rng(0).normal(size=(6, *size)).astype(np.float32)
    maps = part_activation(trace(features, partition))
    assert maps.shape == (partition.n, *size)
    inside = ~np.isnan(maps)
    np.testing.assert_array_equal(inside, partition.weights(*size) > 0)
    assert inside.any(axis=(1, 2)).all()
    assert inside.any(axis=0).all()  # no cell is left out
    total = features.sum(axis=0)
    for cells in maps:
        np.testing.assert_array_equal(cells[~np.isnan(cells)], total[~np.isnan(cells)])


def test_rings_of_a_large_map_share_no_cell() -> None:
    inside = ~np.isnan(part_activation(trace(np.ones((2, 16, 16), np.float32), Partition("rings", 4))))
    assert (inside.sum(axis=0) == 1).all()
    assert inside.sum(axis=(1, 2)).tolist() == [16, 48, 80, 112]


def test_a_cell_of_zero_belongs_to_its_part() -> None:
    maps = part_activation(trace(np.zeros((2, 4, 4), np.float32), Partition("rows", 2)))
    assert (maps[0, :2] == 0).all()
    assert np.isnan(maps[0, 2:]).all()


def test_ranges_are_of_one_picture_or_of_both() -> None:
    nan = np.nan
    query = np.array([[[1.0, nan]], [[nan, 5.0]]], np.float32)
    tile = np.array([[[-2.0, nan]], [[nan, 9.0]]], np.float32)
    own = value_ranges([query, tile], shared=False)
    assert own.tolist() == [[[1, 1], [5, 5]], [[-2, -2], [9, 9]]]
    shared = value_ranges([query, tile], shared=True)
    assert shared.tolist() == [[[-2, 1], [5, 9]]] * 2  # each part has its own range still


def test_a_part_may_have_a_map_of_its_own_or_no_cell() -> None:
    features = np.random.default_rng(0).normal(size=(1, 2, 3, 4, 4)).astype(np.float32)
    cells = np.stack([np.ones((4, 4), np.float32), np.zeros((4, 4), np.float32)])[None]
    maps = part_activation(Trace(np.zeros((2, 3), np.float32), features, cells, None, None, np.zeros((2, 3))))
    np.testing.assert_array_equal(maps[0], features[0, 0].sum(axis=0))
    assert np.isnan(maps[1]).all()
    assert value_ranges([maps], shared=True)[0, 1].tolist() == [0, 0]
