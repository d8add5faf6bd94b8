from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import example, given
from hypothesis import strategies as st
from torch import Tensor

from lpn.core.errors import InputError
from lpn.models.partition import Partition, PartShape

SIZES = st.tuples(st.integers(1, 40), st.integers(1, 40))
PARTS = st.integers(1, 10)
KINDS: st.SearchStrategy[PartShape] = st.sampled_from(["rings", "rows", "columns"])


def published_rings(features: Tensor, n: int, align_corners: bool) -> Tensor:
    """The released pooling in plain slices: box by box, the inner box zeroed, divided by the area of the box."""
    height, width = features.shape[2:]
    if height // (2 * n) < 1 and width // (2 * n) < 1:
        features = F.interpolate(features, (2 * n, 2 * n), mode="bilinear", align_corners=align_corners)
        height, width = features.shape[2:]
    middle, centre = height // 2, width // 2
    down, across = height // (2 * n), width // (2 * n)
    pooled = []
    for ring in range(1, n + 1):
        masked = features.clone()
        if ring > 1:
            inner = ring - 1
            masked[
                :, :, middle - inner * down : middle + inner * down, centre - inner * across : centre + inner * across
            ] = 0
        if ring < n:
            masked = masked[
                :, :, middle - ring * down : middle + ring * down, centre - ring * across : centre + ring * across
            ]
        pooled.append(masked.mean((2, 3)))
    return torch.stack(pooled, 1)


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
    partition = Partition("rings", n, align_corners=align_corners)
    torch.testing.assert_close(pooled(partition, features), published_rings(features, n, align_corners))
    reverse = Partition("rings", n, outside_in=True, align_corners=align_corners)
    torch.testing.assert_close(pooled(reverse, features), published_rings(features, n, align_corners).flip(1))


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


@given(st.integers(1, 8))
def test_rings_of_an_even_map_survive_turns_and_mirrors(n: int) -> None:
    weights = Partition("rings", n).weights(16, 16)
    for changed in (weights[:, ::-1, ::-1], weights[:, :, ::-1], weights.transpose(0, 2, 1)):
        np.testing.assert_array_equal(changed, weights)


def test_wrong_partitions_are_refused_in_words() -> None:
    for arguments in (("hexagons", 4), ("rings", 0), ("whole", 2), ("rings", 4, "median")):
        with pytest.raises(InputError, match=r"expected|cannot"):
            Partition(*arguments)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="0 x 4"):
        Partition().weights(0, 4)


def test_the_released_weighting_scales_each_ring_by_its_share_of_its_box() -> None:
    released, stated = (Partition("rings", 4, weighting).weights(16, 16) for weighting in ("published", "area"))
    for number in range(1, 5):
        inside = stated[number - 1] > 0
        ratio = released[number - 1][inside] / stated[number - 1][inside]
        np.testing.assert_allclose(ratio, (2 * number - 1) / number**2, rtol=1e-5)
    np.testing.assert_allclose(stated.sum(axis=(1, 2)), 1, rtol=1e-5)
