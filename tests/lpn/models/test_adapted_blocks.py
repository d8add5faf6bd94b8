from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import lpn
from lpn.core.errors import InputError
from lpn.models.adapted_blocks import check_divisible, is_adapters
from lpn.models.checkpoints import load_backbone, save
from lpn.models.export import export
from lpn.models.network import LPN
from lpn.models.spec import ModelSpec
from lpn.models.timm_networks import TimmMap
from lpn.models.trace import Trace
from lpn.training.optimizer import build_optimizer
from lpn.training.recipes import RECIPES
from tools.fixtures import seeded
from tools.fixtures.published_models import relative

VIT = ModelSpec(
    "timm:test_vit", views=("satellite", "drone"), n_parts=2, embedding=8, input_size=(64, 96), adapted_blocks=2
)
RESNET = replace(VIT, backbone="resnet18", last_layer="layer3", adapted_blocks=3)


def network(spec: ModelSpec) -> LPN:
    torch.manual_seed(3)
    return LPN(spec).eval()


def trained(spec: ModelSpec) -> LPN:
    """Return a network whose adapters have an effect."""
    made = network(spec)
    with torch.no_grad():
        for name, values in made.branch("drone").model.named_parameters():
            if is_adapters(name):
                values += 0.05 * torch.randn_like(values)
    return made


@pytest.mark.parametrize("spec", [VIT, RESNET], ids=["vit", "resnet"])
@torch.inference_mode()
def test_adapters_begin_without_effect_and_weights_of_the_backbone_fill_all_else(
    spec: ModelSpec, tmp_path: Path
) -> None:
    plain, pictures = network(replace(spec, adapted_blocks=0)), torch.from_numpy(seeded.pictures(5, 2, 64, 96))
    weights = plain.branch("drone").model.state_dict()
    torch.save({name.removeprefix("network."): value for name, value in weights.items()}, tmp_path / "net.pth")
    made = LPN(spec).eval()
    filled, total, missing = load_backbone(made, tmp_path / "net.pth")
    assert (filled, missing) == (total, [])
    assert torch.equal(made.features(pictures, "drone"), plain.features(pictures, "drone"))
    assert not torch.allclose(trained(spec).features(pictures, "drone"), made.features(pictures, "drone"), atol=1e-3)


@pytest.mark.parametrize("spec", [VIT, RESNET], ids=["vit", "resnet"])
def test_adapters_and_heads_alone_learn_and_statistics_stay(spec: ModelSpec) -> None:
    made = network(spec)
    before = {name: value.clone() for name, value in made.state_dict().items()}
    groups = build_optimizer(made, RECIPES["small"]).param_groups
    rates = {id(p): group["lr"] for group in groups for p in group["params"]}
    learns = {name for name, p in made.named_parameters() if id(p) in rates}
    assert learns == {name for name, _ in made.named_parameters() if name.startswith("classifier") or is_adapters(name)}
    assert set(rates.values()) == {RECIPES["small"].lr}
    optimizer = torch.optim.SGD([p for group in groups for p in group["params"]], 0.1)
    made.train()(torch.from_numpy(seeded.pictures(5, 2, 64, 96)), "drone")[1].square().sum().backward()
    optimizer.step()
    after = made.state_dict()
    frozen = [name for name in before if name.startswith("model_") and not is_adapters(name)]
    assert all(torch.equal(before[name], after[name]) for name in frozen)
    # An adapter begins at 0, so its second layer is the first to move.
    assert all(not torch.equal(before[name], after[name]) for name in before if name.endswith("adapter.up.weight"))


@pytest.mark.parametrize("spec", [VIT, RESNET], ids=["vit", "resnet"])
@torch.inference_mode()
def test_the_frozen_part_and_what_is_behind_it_are_the_whole(spec: ModelSpec) -> None:
    made, pictures = trained(spec), torch.from_numpy(seeded.pictures(6, 2, 64, 96))
    check_divisible(made.branch("drone").model, spec.backbone, spec.input_size, spec.adapted_blocks)
    frozen = made.branch("drone").frozen_output(pictures)
    assert relative(made(frozen, "drone", True)[0].numpy(), made(pictures, "drone")[0].numpy()) < 1e-6


@pytest.mark.parametrize("spec", [VIT, RESNET], ids=["vit", "resnet"])
def test_its_checkpoint_is_exact_and_exports(spec: ModelSpec, tmp_path: Path) -> None:
    save(trained(spec), tmp_path / "last.safetensors")
    model, pictures = lpn.load(tmp_path / "last.safetensors", "cpu"), seeded.pictures(7, 2, 64, 96)
    assert (model.contract.level, model.contract.n_parts) == ("exact", 2)
    assert Trace.from_pass(model, model.run(model.with_mirror(pictures[0]), "drone"), "drone").errors().max() < 1e-5
    (file,) = export(tmp_path / "last.safetensors", tmp_path / "model.onnx")
    exported = lpn.load(file, "cpu")
    assert exported.contract == model.contract
    assert relative(exported.descriptors(pictures, "drone"), model.descriptors(pictures, "drone")) < 2e-5
    assert not np.allclose(
        exported.descriptors(pictures, "drone"), _without_adapters(spec, tmp_path, pictures), atol=1e-3
    )


def _without_adapters(spec: ModelSpec, folder: Path, pictures: np.ndarray) -> np.ndarray:
    made = trained(spec)
    for name, module in made.named_modules():
        if name.endswith("adapter.up"):
            nn.init.zeros_(module.weight)
            nn.init.zeros_(module.bias)
    save(made, folder / "without.safetensors")
    return lpn.load(folder / "without.safetensors", "cpu").descriptors(pictures, "drone")


@pytest.mark.parametrize("name", ["cait_xxs24_224", "eva02_tiny_patch14_224"])
def test_a_transformer_whose_last_blocks_take_more_than_tokens_is_not_divided(name: str) -> None:
    size = (28, 28) if "patch14" in name else (32, 32)
    with pytest.raises(InputError, match=f"map of {name} does not follow from the tokens .*; leave --variants out"):
        check_divisible(TimmMap(name, size).eval(), name, size, 2)


def test_a_model_without_adapters_keeps_its_description() -> None:
    assert "adapted_blocks" not in replace(VIT, adapted_blocks=0).to_json()
    assert ModelSpec.from_json(VIT.to_json()) == VIT


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"backbone": "vgg16"}, "vgg16 has no blocks that take adapters"),
        ({"backbone": "timm:test_convnext"}, "test_convnext has no blocks that take adapters"),
        ({"adapted_blocks": 7}, "timm:test_vit has 6 blocks, and 7 are to be adapted"),
        ({"adapted_blocks": -1}, "adapted_blocks is -1; expected a whole number from 1"),
    ],
)
def test_a_backbone_without_such_blocks_is_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        LPN(replace(VIT, **changes))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({}, "adapted_blocks = 0, which freezes nothing"),
        ({"adapted_blocks": 1, "sampling": "pictures"}, "sampling = pictures, which has no variants"),
    ],
)
def test_variants_need_frozen_blocks_of_places(changes: dict[str, object], reason: str) -> None:
    base = RECIPES["paper"] if "sampling" in changes else RECIPES["small"]
    with pytest.raises(InputError, match=f"variants = 4 with {reason}"):
        replace(base, variants=4, **changes)
