"""Networks of timm by their name: of Sample4Geo, Game4Loc, DenseUAV, and SUES-200's baselines.

What a network gives is taken from timm's own forward pass; the heads are computed here from the entries.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F

from lpn.core.errors import InputError, ModelFileError
from lpn.models import timm_networks
from lpn.models.adapters.methods import sues
from lpn.models.base import normalise
from lpn.models.entries import Entries
from tools.fixtures import published_models, published_network, seeded
from tools.fixtures.published_models import State, agrees, opened, relative_by_part

TOLERANCE = 2e-5
# An entry of timm's test_resnet, and its shape.
_STEM = ("layer4.0.conv1.weight", (96, 192, 3, 3))
NORM_HELD = "exact, with the LayerNorm's mean and variance held"


def network(name: str, size: tuple[int, int]) -> tuple[Any, State]:
    """Return a network of timm without a classifier, and the seeded weights that it has."""
    made = timm_networks.named_network(name, size)
    state = seeded.entries({key: list(value.shape) for key, value in made.state_dict().items()})
    made.load_state_dict(state)
    return made.eval(), state


def prefixed(prefix: str, state: State) -> State:
    return {f"{prefix}{key}": value for key, value in state.items()}


@pytest.mark.parametrize(
    ("name", "claim"),
    [
        ("test_resnet", "exact"),
        ("test_coatnet", "exact"),
        ("test_vit_relpos", NORM_HELD),
        ("test_mambaout", "one vector"),
        pytest.param("deit_tiny_distilled_patch16_224", "one vector", marks=pytest.mark.slow),
        pytest.param("eva02_tiny_patch14_224", NORM_HELD, marks=pytest.mark.slow),
    ],
)
def test_a_network_that_the_options_name_answers_as_timms(name: str, claim: str, tmp_path: Path) -> None:
    side = 56 if "patch14" in name else 64
    made, own = network(name, (side, side))
    pictures = seeded.pictures(21, 2, side, side)
    state = prefixed("model.", own) | {"logit_scale": torch.ones(())}
    model = opened(state, tmp_path, f"model: timm/{name}\nh: {side}\nw: {side}\n")
    assert (model.contract.claim, model.contract.method) == (claim, "Sample4Geo")
    assert model.contract.title == f"Sample4Geo {name}, {side} x {side}"
    assert model.contract.mean == timm_networks.normalisation(name)[0]
    with torch.inference_mode():
        agrees(model, pictures, made(torch.from_numpy(pictures))[:, None])


def test_a_map_need_not_divide_the_picture_and_the_model_takes_one_size(tmp_path: Path) -> None:
    _, own = network("test_resnet", (80, 80))
    state = prefixed("model.", own) | {"logit_scale": torch.ones(())}
    model = opened(state, tmp_path, "model: test_resnet\nh: 80\nw: 80\n")
    assert model.map_size("drone") == (3, 3)
    assert model.part_embeddings(seeded.pictures(29, 1, 80, 80), "drone").shape == (1, 1, 96)
    with pytest.raises(InputError, match="are 64 x 64; this model takes 80 x 80, so resize them"):
        model.part_embeddings(seeded.pictures(29, 1, 64, 64), "drone")


def test_a_network_without_a_name_or_of_another_name_is_told_so(tmp_path: Path) -> None:
    _, own = network("test_resnet", (64, 64))
    state = prefixed("model.", own) | {"logit_scale": torch.ones(())}
    with pytest.raises(
        ModelFileError,
        match=r"holds model\.conv1\.0\.weight, which names no network; write .* as `model: N",
    ):
        opened(state, tmp_path, "")
    with pytest.raises(
        ModelFileError,
        match=r"^As timm's test_nfnet: net_119\.pth lacks 91 of 91 entries, the first being model\.stem\.",
    ):
        opened(state, tmp_path, "model: test_nfnet\n")
    with pytest.raises(InputError, match="has no network 'test_resnets'; the nearest are test_resnet"):
        opened(state, tmp_path, "model: test_resnets\n")


def test_branches_of_a_named_network_follow_the_role(tmp_path: Path) -> None:
    made, own = network("test_resnet", (64, 64))
    other = {key: value * 1.1 if value.ndim > 1 else value for key, value in own.items()}
    state = prefixed("model1.", own) | prefixed("model2.", other) | {"logit_scale": torch.ones(())}
    model = opened(state, tmp_path, "model: test_resnet\nh: 64\nw: 64\n")
    assert (model.contract.method, model.contract.roles) == ("Game4Loc", "role")
    pictures = torch.from_numpy(seeded.pictures(22, 1, 64, 64))
    with torch.inference_mode():
        agrees(model.for_task("satellite", "drone"), pictures.numpy(), made(pictures)[:, None], "satellite")
        made.load_state_dict(other)
        agrees(model.for_task("drone", "satellite"), pictures.numpy(), made(pictures)[:, None], "satellite")


@pytest.mark.parametrize("pool", ["avg", "global"])
def test_denseuav_on_a_network_that_the_options_name(pool: str, tmp_path: Path) -> None:
    name = "test_resnet" if pool == "avg" else "test_vit"
    made, own = network(name, (160, 160))
    heads = seeded.entries(published_network.head_shapes("head.head.classifier", made.num_features))
    state = prefixed("backbone.backbone.", own) | heads
    option = f"model: {name}\nhead: SingleBranch\nhead_pool: {pool}\nh: 160\nw: 160\n"
    model, pictures = opened(state, tmp_path, option), seeded.pictures(23, 1, 160, 160)
    assert model.contract.claim == ("exact" if pool == "avg" else "one vector")
    with torch.inference_mode():
        features = made.forward_features(torch.from_numpy(pictures)).double()
    pooled = features.mean((2, 3)) if pool == "avg" else features[:, 0]
    doubled = {key: value.double() for key, value in heads.items()}
    agrees(model, pictures, published_network.head(doubled, "head.head.classifier", pooled)[:, None])


@pytest.mark.slow
def test_denseuav_takes_one_class_token(tmp_path: Path) -> None:
    name = "deit_tiny_distilled_patch16_224"
    _, own = network(name, (224, 224))
    heads = seeded.entries(published_network.head_shapes("head.head.classifier", 192))
    with pytest.raises(ModelFileError, match="has 2 tokens before the cells on timm's deit_tiny"):
        opened(prefixed("backbone.backbone.", own) | heads, tmp_path, f"model: {name}\n")


@pytest.mark.parametrize("shared", [True, False])
def test_a_baseline_of_sues_adds_the_raw_mirror_to_the_scaled_picture(
    shared: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sues, "NETWORKS", {"test_resnet": _STEM})
    made, own = network("test_resnet", (64, 96))
    other = own if shared else {key: value * 1.1 if value.ndim > 1 else value for key, value in own.items()}
    shapes = {"classifier.add_block.0.weight": [512, 96], "classifier.add_block.0.bias": [512]}
    heads = seeded.entries(
        shapes | {"classifier.classifier.0.weight": [120, 512], "classifier.classifier.0.bias": [120]}
    )
    model = opened(prefixed("model_1.", own) | prefixed("model_2.", other) | heads, tmp_path, "h: 64\nw: 96\n")
    assert model.contract.claim == "exact, with the length of the picture's own pass held"
    assert model.contract.groups == ((("satellite", "drone"),) if shared else (("satellite",), ("drone",)))
    made.load_state_dict(other)
    pictures = seeded.pictures(28, 1, 64, 96)
    with torch.inference_mode():
        first, second = (
            published_models.linear(heads, "classifier.add_block.0", made(torch.from_numpy(p)))
            for p in (pictures, pictures[..., ::-1].copy())
        )
    total = F.normalize(first) + second
    agrees(model, pictures, total[:, None])
    expected = normalise(total[:, None].numpy())
    assert relative_by_part(model.descriptors(pictures, "drone"), expected) < TOLERANCE


def test_a_baseline_of_sues_that_is_not_read_says_so(tmp_path: Path) -> None:
    state = {f"model_{branch}.model.conv1.weight": torch.ones(2) for branch in (1, 2)}
    with pytest.raises(ModelFileError, match=r"unsupported model of SUES-200.* \(found model_1\.model\.conv1\.weight"):
        opened(state | {"classifier0.add_block.0.weight": torch.ones(2, 2)}, tmp_path, "")


@pytest.mark.slow
def test_each_baseline_of_sues_is_told_by_one_entry() -> None:
    timm = timm_networks.import_timm()
    for name in sues.NETWORKS:
        with torch.device("meta"):
            state = timm.create_model(name, pretrained=False).state_dict()
        assert sues.network_in(Entries("net.pth", state)) == name
