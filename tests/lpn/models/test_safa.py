"""SAFA and SAFA + LPN: spatial-aware layers, overlapping strips, polar tiles, and everything that runs such a model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import lpn
from lpn.core.errors import InputError
from lpn.core.images import polar
from lpn.models.backbones import VGG16, map_size
from lpn.models.base import normalise
from lpn.models.checkpoints import TorchModel, save
from lpn.models.export import export
from lpn.models.lpn import LPN
from lpn.models.partition import Partition
from lpn.models.safa import SpatialAware
from lpn.models.spec import ModelSpec
from tools.fixtures import released_safa, seeded, small_worlds

SPEC = ModelSpec(
    "resnet18",
    "layer3",
    views=("satellite", "drone"),
    shared=False,
    n_parts=4,
    pooling="safa",
    maps=3,
    embedding=3 * 256,
    input_size=(32, 160),
    polar=True,
)
"""A map of 2 x 10 cells: four strips of four columns, each two further on."""
SHARED = replace(SPEC, shared=True)


def network(spec: ModelSpec = SPEC) -> LPN:
    torch.manual_seed(0)
    return LPN(spec).eval()


@pytest.fixture(scope="module")
def model_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A saved SAFA + LPN whose views share their weights; `model.onnx` lies beside it."""
    folder = tmp_path_factory.mktemp("safa")
    save(network(SHARED), folder / "model.safetensors")
    export(folder / "model.safetensors", folder / "model.onnx")
    return folder / "model.safetensors"


@pytest.mark.parametrize("kind", ["safa", "safa-lpn"])
def test_the_released_graph_gives_the_same_numbers(kind: released_safa.Kind) -> None:
    model = TorchModel(released_safa.network(kind))
    assert model.map_size("street") == (4, 20)
    assert max(released_safa.differences(kind, model).values()) <= 1e-4


def test_poolings_of_vgg_keep_the_last_row_and_column_in_safa_only() -> None:
    with torch.device("meta"):
        for name in ("vgg16", "vgg16_bn"):
            sizes = {"safa": (4, 20), "average": (3, 19)}
            for pooling, size in sizes.items():
                spec = replace(
                    SPEC, backbone=name, last_layer="layer4", pooling=pooling, embedding=3 * 512, input_size=(112, 616)
                )
                assert map_size(LPN(spec).branch("drone").model, (112, 616)) == size
                assert map_size(LPN(spec).branch("drone").model, (256, 256)) == (8, 8)
    # Padding takes part in no maximum, even below zero.
    below = -1 - torch.rand(1, 2, 5, 7)
    pooled = VGG16(batch_norm=False, ceil_mode=True).features[4](below)
    expected = [[below[..., i : i + 2, j : j + 2].amax((2, 3)) for j in range(0, 7, 2)] for i in range(0, 5, 2)]
    torch.testing.assert_close(pooled, torch.stack([torch.stack(row, -1) for row in expected], -2))


def test_layers_have_the_published_shapes_and_start() -> None:
    torch.manual_seed(0)
    layers = SpatialAware(80, 8)
    assert [tuple(one.shape) for one in layers.parameters()] == [(8, 80, 40), (8, 1, 40), (8, 40, 80), (8, 1, 80)]
    for weight in (layers.weight1.detach(), layers.weight2.detach()):
        # A normal of 0.005 cut at two standard deviations has 0.88 of its deviation left.
        assert float(weight.abs().max()) <= 0.01
        assert float(weight.mean()) == pytest.approx(0, abs=2e-4)
        assert float(weight.std()) == pytest.approx(0.88 * 0.005, rel=0.03)
    for bias in (layers.bias1, layers.bias2):
        assert bool((bias == 0.1).all())


@given(st.integers(1, 8), st.integers(8, 40))
def test_windows_are_as_wide_as_the_stride_leaves(n: int, width: int) -> None:
    stride = width // n
    kernel = width - (n - 1) * stride
    partition = Partition("windows", n)
    weights = partition.weights(3, width)
    for part in range(n):
        expected = np.zeros((3, width))
        expected[:, part * stride : part * stride + kernel] = 1 / (3 * kernel)
        np.testing.assert_allclose(weights[part], expected, rtol=1e-6)
        assert partition.boxes(3, width)[part] == (part * stride / width, 0, (part * stride + kernel) / width, 1)
    assert bool((weights.sum((0, 1)) > 0).all())
    labels = partition.labels(3, width)
    assert set(np.unique(labels)) == set(range(n))
    assert all(weights[labels[row, column], row, column] > 0 for row in range(3) for column in range(width))


def test_too_narrow_a_map_is_refused_in_words() -> None:
    with pytest.raises(InputError, match="2 x 10 cells, too few for 11 strips"):
        LPN(replace(SPEC, n_parts=11))
    with pytest.raises(InputError, match="3 maps of 256 channels has 768"):
        LPN(replace(SPEC, embedding=512))


def test_tiles_are_unrolled_by_the_released_formula() -> None:
    tile = small_worlds.place(3)
    assert np.abs(polar(tile, *released_safa.SIZE) - released_safa.unroll(tile)).mean() < 0.5


def test_only_satellites_are_unrolled() -> None:
    model = TorchModel(network())
    tile = small_worlds.place(1)
    np.testing.assert_array_equal(model.to_input_size(tile, "satellite"), polar(tile, 32, 160))
    assert not np.array_equal(model.to_input_size(tile, "drone"), polar(tile, 32, 160))
    plain = TorchModel(network(replace(SPEC, polar=False)))
    np.testing.assert_array_equal(plain.to_input_size(tile, "satellite"), plain.to_input_size(tile, "drone"))


def test_a_saved_and_an_exported_model_answer_as_the_network(model_file: Path) -> None:
    images = seeded.pictures(5, 2, 32, 160)
    saved, exported = lpn.load(model_file), lpn.load(model_file.with_suffix(".onnx"))
    original = TorchModel(network(SHARED))
    for view in SPEC.views:
        parts, features = original.run(images, view)[:2]
        np.testing.assert_array_equal(saved.part_embeddings(images, view), parts)
        found, found_features = exported.run(images, view)[:2]
        assert np.abs(found - parts).max() <= 1e-4 * np.abs(parts).max()
        assert np.abs(found_features - features).max() <= 1e-4 * np.abs(features).max()
        np.testing.assert_allclose(exported.descriptors(images, view), original.descriptors(images, view), atol=1e-5)
        assert original.map_size(view) == saved.map_size(view) == exported.map_size(view) == (2, 10)
    for model in (saved, exported):
        assert model.heads("drone").weight is None


@pytest.mark.slow
def test_an_exported_vgg_keeps_the_last_row_and_column(tmp_path: Path) -> None:
    spec = replace(SHARED, backbone="vgg16", last_layer="layer4", maps=1, embedding=512, input_size=(48, 136))
    original = TorchModel(network(spec))
    save(original.network, tmp_path / "model.safetensors")
    export(tmp_path / "model.safetensors", tmp_path / "model.onnx")
    exported = lpn.load(tmp_path / "model.onnx")
    assert original.map_size("drone") == exported.map_size("drone") == (2, 5)
    images = seeded.pictures(5, 2, 48, 136)
    for view in SPEC.views:
        for ours, theirs in zip(original.run(images, view)[:3], exported.run(images, view)[:3], strict=True):
            assert np.abs(theirs - ours).max() <= 1e-4 * np.abs(ours).max()


def test_a_mirrored_picture_is_not_added(model_file: Path) -> None:
    images = seeded.pictures(6, 1, 32, 160)
    for model in (lpn.load(model_file), lpn.load(model_file.with_suffix(".onnx"))):
        alone = normalise(model.part_embeddings(images, "drone"))
        np.testing.assert_array_equal(model.descriptors(images, "drone"), alone)
        mirrored = model.descriptors(np.ascontiguousarray(images[..., ::-1]), "drone")
        assert np.abs(mirrored - alone).max() > 1e-3
