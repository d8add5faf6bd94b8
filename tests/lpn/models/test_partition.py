from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import example, given
from hypothesis import strategies as st
from torch import Tensor

from lpn.core.errors import InputError
from lpn.models.partition import Partition, PartShape
from tools.fixtures import published_network

SIZES = st.tuples(st.integers(1, 40), st.integers(1, 40))
PARTS = st.integers(1, 10)
KINDS: st.SearchStrategy[PartShape] = st.sampled_from(["rings", "rows", "columns"])


def pooled(partition: Partition, features: Tensor) -> Tensor:
    weights = torch.from_numpy(partition.weights(*features.shape[2:]))
    return torch.einsum("nhw,bchw->bnc", weights, features)


@given(SIZES, PARTS, st.booleans())
@example((16, 16), 4, False)
def test_rings_partition_every_map(size: tuple[int, int], n: int, outside_in: bool) -> None:
    partition = Partition("rings", n, outside_in=outside_in)
    labels = partition.labels(*size)
    assert labels.shape == partition.grid(*size)
    assert set(np.unique(labels)) == set(range(n))
    for weighting in ("published", "area"):
        weights = Partition("rings", n, weighting, outside_in=outside_in).weights(*size)
        assert weights.shape == (n, *size)
        if labels.shape == size:
            assert ((weights > 0).sum(0) == 1).all()
            assert (weights.argmax(0) == labels).all()


@given(SIZES, KINDS, PARTS)
def test_area_weights_are_means(size: tuple[int, int], kind: PartShape, n: int) -> None:
    weights = Partition(kind, n, "area").weights(*size)
    np.testing.assert_allclose(weights.sum((1, 2)), 1, rtol=1e-5)


@given(st.integers(2, 16).map(lambda half: 2 * half), PARTS, st.booleans())
@example(8, 8, True)
@example(16, 4, True)
def test_published_weights_equal_the_released_pooling(size: int, n: int, align_corners: bool) -> None:
    features = torch.randn(2, 5, size, size, generator=torch.Generator().manual_seed(n))
    released = torch.stack(published_network.rings(features, n, align_corners), 1)
    partition = Partition("rings", n, align_corners=align_corners)
    torch.testing.assert_close(pooled(partition, features), released)
    torch.testing.assert_close(pooled(replace(partition, outside_in=True), features), released.flip(1))


@given(SIZES, PARTS)
def test_strips_are_adaptive_average_pooling(size: tuple[int, int], n: int) -> None:
    features = torch.randn(2, 5, *size, generator=torch.Generator().manual_seed(n))
    rows = F.adaptive_avg_pool2d(features, (n, 1))[..., 0].transpose(1, 2)
    torch.testing.assert_close(pooled(Partition("rows", n), features), rows)
    columns = F.adaptive_avg_pool2d(features, (1, n))[:, :, 0].transpose(1, 2)
    torch.testing.assert_close(pooled(Partition("columns", n), features), columns)


@given(SIZES, KINDS, PARTS)
def test_boxes_enclose_the_labels(size: tuple[int, int], kind: PartShape, n: int) -> None:
    partition = Partition(kind, n)
    labels = partition.labels(*size)
    for part, (left, top, right, bottom) in enumerate(partition.boxes(*size)):
        rows, columns = np.nonzero(labels == part)
        half_row, half_column = 0.51 / labels.shape[0], 0.51 / labels.shape[1]
        assert top == pytest.approx(rows.min() / labels.shape[0], abs=half_row)
        assert bottom == pytest.approx((rows.max() + 1) / labels.shape[0], abs=half_row)
        assert left == pytest.approx(columns.min() / labels.shape[1], abs=half_column)
        assert right == pytest.approx((columns.max() + 1) / labels.shape[1], abs=half_column)


def test_wrong_partitions_are_refused_in_words() -> None:
    for arguments in (("hexagons", 4), ("rings", 0), ("whole", 2), ("rings", 4, "median")):
        with pytest.raises(InputError, match=r"expected|cannot"):
            Partition(*arguments)
    with pytest.raises(InputError, match="0 x 4"):
        Partition().weights(0, 4)
