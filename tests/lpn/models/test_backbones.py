"""Plain VGG-16: torchvision's names, the dropout of released SAFA, and how its files are recognised and loaded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

import lpn
from lpn.core.errors import InputError, ModelFileError
from lpn.models.backbones import VGG16
from lpn.models.checkpoints import backbone_in, load_backbone
from lpn.models.lpn import LPN
from lpn.models.published_checkpoints import infer_backbone
from lpn.models.spec import BACKBONES, ModelSpec

# Torchvision's numbers of the convolutions of VGG-13, 16, and 19 without batch normalisation, and of VGG-16 with it.
VGG13 = (0, 2, 5, 7, 10, 12, 15, 17, 20, 22)
VGG16_PLAIN = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
VGG19 = (0, 2, 5, 7, 10, 12, 14, 16, 19, 21, 23, 25, 28, 30, 32, 34)
VGG16_BN = (0, 3, 7, 10, 14, 17, 20, 24, 27, 30, 34, 37, 40)
SPEC = ModelSpec(
    "vgg16",
    views=("satellite", "street"),
    shared=False,
    n_parts=2,
    embedding=512,
    input_size=(32, 64),
    pooling="safa",
    maps=1,
    backbone_dropout=0.2,
)


def entries(numbers: tuple[int, ...], normalised: bool = False) -> dict[str, Tensor]:
    """The entries of a torchvision file by name; BatchNorm follows its convolution."""
    names = {f"features.{number}.{kind}" for number in numbers for kind in ("weight", "bias")}
    if normalised:
        names |= {
            f"features.{n + 1}.{kind}" for n in numbers for kind in ("weight", "bias", "running_mean", "running_var")
        }
    return dict.fromkeys(names | {"classifier.0.weight", "classifier.0.bias"}, torch.zeros(1))


def test_plain_vgg16_has_torchvision_s_names_with_and_without_dropout() -> None:
    with torch.device("meta"):
        for dropout in (0.0, 0.2):
            names = {f"features.{key}" for key in VGG16(batch_norm=False, dropout=dropout).features.state_dict()}
            assert names == {name for name in entries(VGG16_PLAIN) if name.startswith("features")}


def test_dropout_follows_the_six_last_convolutions() -> None:
    with torch.device("meta"):
        layers = VGG16(batch_norm=False, dropout=0.2).features
    dropped = [number for number, layer in enumerate(layers) if any(isinstance(m, nn.Dropout) for m in layer.modules())]
    assert dropped == [number + 1 for number in VGG16_PLAIN[-6:]]
    # The activation works in place, so its input is made anew.
    activation = layers[18].train()
    thinned = activation(torch.ones(1, 100, 100, 10))
    assert set(thinned.unique().tolist()) == {0.0, 1.25}
    assert float((thinned == 0).float().mean()) == pytest.approx(0.2, abs=0.01)
    torch.testing.assert_close(activation.eval()(torch.ones(1, 4)), torch.ones(1, 4))


def test_files_of_vgg_are_told_apart() -> None:
    assert infer_backbone(entries(VGG16_PLAIN), "file") == ("vgg16", "layer4")
    assert infer_backbone(entries(VGG16_BN, normalised=True), "file") == ("vgg16_bn", "layer4")
    for other in (VGG13, VGG19):
        with pytest.raises(ModelFileError, match="not one of resnet18, resnet50, vgg16, vgg16_bn"):
            infer_backbone(entries(other), "file")


def test_imagenet_weights_of_plain_vgg16_fill_both_branches(tmp_path: Path) -> None:
    state = {key: torch.rand_like(value) for key, value in VGG16(batch_norm=False).state_dict().items()}
    torch.save(state | {"classifier.0.weight": torch.zeros(3)}, tmp_path / "vgg16.pth")
    assert backbone_in(tmp_path / "vgg16.pth") == "vgg16"
    network = LPN(SPEC)
    assert load_backbone(network, tmp_path / "vgg16.pth") == (52, 52, [])
    for view in SPEC.views:
        filled: dict[str, Tensor] = network.branch(view).model.state_dict()
        assert all(torch.equal(filled[key], value) for key, value in state.items())


def test_weights_of_another_backbone_are_refused_even_where_some_would_fit(tmp_path: Path) -> None:
    torch.save(VGG16(batch_norm=True).state_dict(), tmp_path / "vgg16_bn.pth")
    with pytest.raises(ModelFileError, match=r"vgg16_bn\.pth holds vgg16_bn; the network has vgg16"):
        load_backbone(LPN(SPEC), tmp_path / "vgg16_bn.pth")


def test_backbones_without_dropout_are_refused_a_rate() -> None:
    with pytest.raises(InputError, match=r"backbone_dropout = 0\.2 with resnet18"):
        replace(SPEC, backbone="resnet18")
    with pytest.raises(InputError, match=r"backbone_dropout = 1\.0"):
        replace(SPEC, backbone_dropout=1.0)


@pytest.mark.parametrize("backbone", BACKBONES)
@pytest.mark.parametrize("prefix", ["", "model_1.model."])
def test_a_backbone_given_as_a_model_is_told_as_that(backbone: str, prefix: str, tmp_path: Path) -> None:
    with torch.device("meta"):
        network = LPN(ModelSpec(backbone, views=("satellite",)))
    of_branch = network.branch("satellite").model.state_dict()
    state = {prefix + key: torch.zeros(value.shape[:1]) for key, value in of_branch.items()}
    torch.save(state, tmp_path / "weights.pth")
    with pytest.raises(ModelFileError, match=r"timm:NAME:FILE, .* the weights of a backbone go to lpn train --init"):
        lpn.load(tmp_path / "weights.pth")
    assert backbone_in(tmp_path / "weights.pth") == backbone


def test_weights_that_are_missing_or_a_graph_are_refused_as_that(tmp_path: Path) -> None:
    with pytest.raises(ModelFileError, match=r"There is no model file at .*absent\.onnx"):
        backbone_in(tmp_path / "absent.onnx")
    (tmp_path / "model.onnx").touch()
    with pytest.raises(ModelFileError, match=r"model\.onnx is an exported graph; give --init the \.safetensors or"):
        backbone_in(tmp_path / "model.onnx")
