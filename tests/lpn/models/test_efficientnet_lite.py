"""EfficientNet-Lite: the published network's numbers, sizes of its map, its files, and what an LPN on it can do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import onnx
import pytest
import torch
from torch import Tensor

import lpn
from lpn import explain
from lpn.core import images
from lpn.core.errors import InputError, ModelFileError
from lpn.datasets import open_dataset
from lpn.models.backbones import CHANNELS, LastLayer, build_backbone
from lpn.models.checkpoints import backbone_in, load_backbone, save
from lpn.models.efficientnet_lite import STAGES, EfficientNetLite
from lpn.models.export import export
from lpn.models.network import LPN, map_size
from lpn.models.quantize import quantize
from lpn.models.spec import ModelSpec
from lpn.retrieval import describe_picture, scoring
from tests.lpn.models.test_quantize import convolutions
from tools.fixtures import seeded

LITE0 = "efficientnet_lite0"
SPEC = ModelSpec(LITE0, "layer3", views=("satellite", "drone"), embedding=8, classes=3, input_size=(64, 64))

# Values of the map of efficientnet-lite-pytorch 0.1.0 for two pictures of 75 x 75 pixels, at every seventh of its length, and its
# mean and mean square, in double precision with the weights of `seeded.entries`: of the whole network, and up to its fifth stage.
# 75 pixels give maps of 38, 19, 10, 5, and 3 cells, so convolutions with a stride meet odd and even sizes.
GOLDEN: dict[str, tuple[tuple[list[float], float, float], ...]] = {
    "efficientnet_lite0": (
        ([0.0, 0.0, 2.616968, 0.844391, 0.0, 0.0], 1.287159, 5.078725),
        ([-2.334555, 3.942756, 2.877568, -0.686084, 1.149515, 4.163778], -0.053593, 15.92757),
    ),
    "efficientnet_lite1": (
        ([0.0, 0.0, 0.958131, 6.0, 0.0, 0.0], 1.313565, 5.022991),
        ([-3.374944, -1.91221, -1.628863, 3.685857, -1.560369, 0.585096], 0.020509, 19.251441),
    ),
    "efficientnet_lite2": (
        ([1.022747, 0.0, 0.556059, 2.298045, 3.450527, 5.440545], 1.339391, 5.288295),
        ([-2.297216, -0.744239, 0.526548, 5.937099, -6.218294, 5.28093], -0.360011, 20.83522),
    ),
}  # fmt: skip


def entries(network: EfficientNetLite) -> dict[str, Tensor]:
    return seeded.entries({key: list(value.shape) for key, value in network.state_dict().items()})


@pytest.mark.parametrize("name", STAGES)
@torch.inference_mode()
def test_maps_are_those_of_the_published_network(name: str) -> None:
    pictures = torch.from_numpy(seeded.pictures(int(name[-1]), 2, 75, 75)).double()
    for whole, (values, mean, square) in zip((True, False), GOLDEN[name], strict=True):
        network = EfficientNetLite(name, whole, last_stride=2).eval().double()
        network.load_state_dict(entries(network))
        found = network((pictures - network.offset) / network.scale)
        assert found.shape[1] == network.channels == CHANNELS[name, "layer4" if whole else "layer3"]
        flat = found.flatten()
        assert flat[:: len(flat) // 7][:6].tolist() == pytest.approx(values, abs=2e-6)
        assert float(found.mean()) == pytest.approx(mean, abs=2e-6)
        assert float(found.square().mean()) == pytest.approx(square, abs=2e-6)


def test_pictures_reach_the_stem_as_its_weights_were_trained() -> None:
    network = EfficientNetLite("efficientnet_lite0", whole=False)
    grey = np.array([[[0, 0, 0], [127, 127, 127], [255, 255, 255]]], np.uint8)
    seen = torch.from_numpy(images.normalise(grey)) * network.scale + network.offset
    torch.testing.assert_close(seen[:, 0], torch.tensor([[-127 / 128, 0.0, 1.0]]).expand(3, 3), atol=1e-6, rtol=0)


def test_maps_have_a_sixteenth_of_the_size_unless_the_last_stride_is_2() -> None:
    with torch.device("meta"):
        for layer, stride, cells in (("layer3", 2, (7, 11)), ("layer4", 1, (7, 11)), ("layer4", 2, (4, 6))):
            assert map_size(build_backbone(LITE0, cast(LastLayer, layer), stride), (100, 170)) == cells


@pytest.mark.parametrize("name", STAGES)
def test_weights_are_told_apart_and_fill_the_whole_backbone(name: str, tmp_path: Path) -> None:
    network = EfficientNetLite(name)
    weights = entries(network) | {"_fc.weight": torch.zeros(1000, 1280), "_fc.bias": torch.zeros(1000)}
    torch.save(weights, tmp_path / "weights.pth")
    assert backbone_in(tmp_path / "weights.pth") == name
    for layer in ("layer3", "layer4") if name == LITE0 else ("layer3",):
        made = LPN(replace(SPEC, backbone=name, last_layer=layer))
        filled, total, missing = load_backbone(made, tmp_path / "weights.pth")
        assert (filled, missing) == (total, [])
        assert all(torch.equal(value, weights[key]) for key, value in made.branch("drone").model.state_dict().items())
    other = next(one for one in STAGES if one != name)
    with pytest.raises(
        ModelFileError, match=rf"weights\.pth holds {name}; the network has {other}\. Give weights of {other}"
    ):
        load_backbone(LPN(replace(SPEC, backbone=other)), tmp_path / "weights.pth")
    torch.save({key: value for key, value in weights.items() if not key.startswith("_blocks.0.")}, tmp_path / "cut.pth")
    assert load_backbone(LPN(replace(SPEC, backbone=name)), tmp_path / "cut.pth")[2] == ["_blocks.0"]


def test_a_saved_model_opens_as_it_was_and_says_its_layer(tmp_path: Path) -> None:
    torch.manual_seed(0)
    save(LPN(SPEC), tmp_path / "lite.safetensors")
    model = lpn.load(tmp_path / "lite.safetensors")
    assert model.describe() == "LPN efficientnet_lite0/layer3, n = 4, 64 x 64"
    assert backbone_in(tmp_path / "lite.safetensors") == "efficientnet_lite0"
    assert model.map_size("drone") == (4, 4)
    with pytest.raises(InputError, match=r"backbone_dropout is 0\.2 with efficientnet_lite0"):
        replace(SPEC, backbone_dropout=0.2)


@pytest.mark.slow
def test_exported_and_in_8_bits_the_numbers_stay_and_evidence_adds_up(data: Path, tmp_path: Path) -> None:
    made = LPN(replace(SPEC, n_parts=2))
    backbone = made.branch("satellite").model
    assert isinstance(backbone, EfficientNetLite)
    backbone.load_state_dict(entries(backbone))
    save(made, tmp_path / "lite.safetensors")
    export(tmp_path / "lite.safetensors", tmp_path / "lite.onnx")
    # The padding of strides is part of the convolutions.
    operations = {node.op_type for node in onnx.load_model(tmp_path / "lite.onnx").graph.node}
    assert "Clip" in operations
    assert not {"Pad", "BatchNormalization"} & operations
    _, agreement = quantize(tmp_path / "lite.onnx", open_dataset(data), tmp_path / "small.onnx", 16)
    # 0.95 with each Clip in float32, as a convolution's output is then cut to 8 bits before it.
    assert min(agreement.cosines.values()) > 0.99
    assert len(set(convolutions(tmp_path / "small.onnx"))) == 1
    entry = open_dataset(data).queries("drone")[0]
    shown = (
        ("lite.safetensors", "drone"),
        ("lite.onnx", "drone"),
        ("small.onnx", "drone"),
        ("small.onnx", "satellite"),
    )
    picture = images.load_picture(entry.path)
    described = [describe_picture(lpn.load(tmp_path / name), picture, view) for name, view in shown]  # type: ignore[arg-type]
    np.testing.assert_allclose(described[0].descriptor, described[1].descriptor, atol=1e-5)
    for one, other in (described[:2], described[2:]):
        assert one.trace is not None
        assert other.trace is not None
        score = float((one.descriptor * other.descriptor).sum())
        evidence = explain.evidence(one.trace, other.trace, scoring.part_weights(2))
        assert sum(float(values.sum()) for values in evidence.part_sums) == pytest.approx(score, abs=1e-5)
