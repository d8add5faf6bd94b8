"""Networks of timm by their name, DenseUAV's other backbones and heads, SDPL's and SUES-200's baselines.

What a network gives is taken from timm's own forward pass; the heads are computed here from the entries.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

import lpn
from lpn.core.errors import InputError, ModelFileError
from lpn.models import timm_networks
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.methods import denseuav, sues
from lpn.models.adapters.model import PublishedModel
from lpn.models.adapters.named import matching
from lpn.models.backbones import Bottleneck, ResNet
from lpn.models.base import normalise
from lpn.models.contract_metadata import from_metadata, to_metadata
from lpn.models.trace import Trace
from tools.fixtures import published_models, published_network, seeded
from tools.fixtures.published_models import State, relative_by_part, small_denseuav
from tools.fixtures.published_network import head_shapes

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


def opened(state: State, folder: Path, options: str) -> PublishedModel:
    torch.save(state, folder / "net_119.pth")
    (folder / "opts.yaml").write_text(options)
    return cast(PublishedModel, lpn.load(folder / "net_119.pth", "cpu"))


def prefixed(prefix: str, state: State) -> State:
    return {f"{prefix}{key}": value for key, value in state.items()}


def check(model: PublishedModel, pictures: np.ndarray, raw: Tensor, view: Any = "drone") -> None:
    """Compare raw parts, (B, n, D), and check that the account of one picture adds up."""
    assert relative_by_part(model.part_embeddings(pictures, view), raw.numpy()) < TOLERANCE
    outputs = model.run(model.with_mirror(pictures[0]), view)
    if not model.contract.has_cells:
        assert (outputs.features, model.map_size(view)) == (None, (1, 1))
        return
    assert Trace.from_pass(model, outputs, view).errors().max() < 1e-5
    assert outputs.features is not None
    assert outputs.features.shape[-2:] == model.map_size(view)


def head(state: State, name: str, values: Tensor) -> Tensor:
    """A head's Linear and BatchNorm, of (B, C)."""
    return published_network.head({key: value.double() for key, value in state.items()}, f"head.head.{name}", values)


def ring_means(features: Tensor, n: int, published: bool) -> list[Tensor]:
    """The mean of each of n square rings of (B, C, h, w), or its sum divided by the area of its box."""
    height, width = features.shape[2:]
    found, inner, inner_area = [], torch.zeros(features.shape[:2], dtype=features.dtype), 0
    for ring in range(1, n + 1):
        down, across = ring * (height // (2 * n)), ring * (width // (2 * n))
        rows = slice(height // 2 - down, height // 2 + down) if ring < n else slice(None)
        columns = slice(width // 2 - across, width // 2 + across) if ring < n else slice(None)
        box = features[:, :, rows, columns]
        area = box.shape[2] * box.shape[3]
        total = box.sum((2, 3))
        found.append((total - inner) / (area if published else area - inner_area))
        inner, inner_area = total, area
    return found


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
    model = opened(
        prefixed("model.", own) | {"logit_scale": torch.ones(())},
        tmp_path,
        f"model: timm/{name}\nh: {side}\nw: {side}\n",
    )
    assert (model.contract.claim, model.contract.method) == (claim, "Sample4Geo")
    assert model.contract.title == f"Sample4Geo {name}, {side} x {side}"
    assert model.contract.mean == timm_networks.normalisation(name)[0]
    with torch.inference_mode():
        check(model, pictures, made(torch.from_numpy(pictures))[:, None])


def test_a_network_whose_map_does_not_divide_the_picture_takes_that_size_alone(tmp_path: Path) -> None:
    _, own = network("test_resnet", (80, 80))
    state = prefixed("model.", own) | {"logit_scale": torch.ones(())}
    model = opened(state, tmp_path, "model: test_resnet\nh: 80\nw: 80\n")
    assert model.map_size("drone") == (3, 3)
    assert model.part_embeddings(seeded.pictures(29, 1, 80, 80), "drone").shape == (1, 1, 96)
    with pytest.raises(InputError, match="trained with 80 x 80 and takes pictures of that size alone"):
        model.part_embeddings(seeded.pictures(29, 1, 64, 64), "drone")


def test_a_network_without_a_name_or_of_another_name_is_told_so(tmp_path: Path) -> None:
    _, own = network("test_resnet", (64, 64))
    state = prefixed("model.", own) | {"logit_scale": torch.ones(())}
    with pytest.raises(
        ModelFileError, match=r"holds model\.conv1\.0\.weight, .* write its network's name in timm as `model: N"
    ):
        opened(state, tmp_path, "")
    with pytest.raises(ModelFileError, match=r"^As timm's test_nfnet: net_119\.pth lacks model\.stem\."):
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
        check(model.for_task("satellite", "drone"), pictures.numpy(), made(pictures)[:, None], "satellite")
        made.load_state_dict(other)
        check(model.for_task("drone", "satellite"), pictures.numpy(), made(pictures)[:, None], "satellite")


@pytest.mark.parametrize("regions", [0, 1, 2])
def test_denseuav_on_a_convolutional_network(regions: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(denseuav, "_BACKBONES", {"test_resnet": _STEM})
    made, own = network("test_resnet", (96, 64))
    names = ["classifier1", *(f"classifier_heat{i + 1}" for i in range(regions))] if regions else ["classifier"]
    heads = seeded.entries({k: v for name in names for k, v in head_shapes(f"head.head.{name}", 96).items()})
    option = f"head: FSRA_CNN\nblock: {regions}" if regions else "head: SingleBranchCNN\nhead_pool: avg\nblock: 1"
    model = opened(prefixed("backbone.backbone.", own) | heads, tmp_path, f"{option}\nh: 96\nw: 64\n")
    assert model.contract.claim == ("exact, with the regions of each picture held" if regions > 1 else "exact")
    pictures = seeded.pictures(23, 2, 96, 64)
    with torch.inference_mode():
        features = made.forward_features(torch.from_numpy(pictures)).double()
    parts = [head(heads, names[0], features.mean((2, 3)))]
    if regions > 1:
        # Without a class token all cells are in a region; `region_means` leaves the first token out.
        tokens = F.pad(features.flatten(2).transpose(1, 2), (0, 0, 1, 0))
        means = [
            torch.stack(found) for found in zip(*(published_models.region_means(t, 2) for t in tokens), strict=True)
        ]
        parts += [head(heads, f"classifier_heat{i + 1}", mean) for i, mean in enumerate(means)]
    check(model, pictures, torch.stack(parts, 1))


@pytest.mark.parametrize("whole", [True, False])
def test_denseuav_with_the_rings_of_lpn(whole: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = [f"classifier_lpn_{ring + 1}" for ring in range(3)]
    if whole:
        state = {key: value for key, value in small_denseuav(0, 112).items() if key.startswith("backbone.")}
        tokens = published_models.vit_tokens(
            published_models.under(state, "backbone.backbone."), seeded.pictures(24, 1, 112, 112), 1, 64**-0.5
        )
        first, features = tokens[:, 0], tokens[:, 1:].transpose(1, 2).reshape(1, 64, 7, 7)
        names = ["global_classifier", *names]
    else:
        monkeypatch.setattr(denseuav, "_BACKBONES", {"test_resnet": _STEM})
        made, own = network("test_resnet", (208, 208))
        state = prefixed("backbone.backbone.", own)
        with torch.inference_mode():
            features = made.forward_features(torch.from_numpy(seeded.pictures(24, 1, 208, 208))).double()
        first = torch.zeros(1, 96)
    heads = seeded.entries(
        {k: v for name in names for k, v in head_shapes(f"head.head.{name}", features.shape[1]).items()}
    )
    side = 112 if whole else 208
    option = f"head: {'LPN' if whole else 'LPN_CNN'}\nblock: 3\nh: {side}\nw: {side}\n"
    model = opened(state | heads, tmp_path, option)
    assert features.shape[2:] == (7, 7)
    values = [*([first.double()] if whole else []), *ring_means(features, 3, published=True)]
    raw = torch.stack([head(heads, name, value) for name, value in zip(names, values, strict=True)], 1)
    check(model, seeded.pictures(24, 1, side, side), raw)
    assert model.contract.names("drone")[-1] == ("4 outer" if whole else "3 outer")
    if whole:
        cut = {key: value for key, value in heads.items() if ".global_classifier." not in key}
        with pytest.raises(ModelFileError, match=r"lacks head\.head\.global_classifier\.add_block\.0\.weight, which"):
            opened(state | cut, tmp_path, option)
    with pytest.raises(
        ModelFileError, match=r"head LPN, but the opts\.yaml beside it says head: FSRA; correct or remove it"
    ):
        opened(state | heads, tmp_path, option.replace("LPN_CNN", "FSRA").replace("LPN", "FSRA"))


@pytest.mark.slow
@pytest.mark.parametrize("pool", ["avg", "global", "regions"])
def test_denseuav_on_a_distilled_network_pools_the_second_token_with_the_cells(
    pool: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "deit_tiny_distilled_patch16_224"
    monkeypatch.setattr(denseuav, "_BACKBONES", {name: ("dist_token", (1, 1, 192))})
    made, own = network(name, (64, 64))
    names = ["classifier1", "classifier_heat1", "classifier_heat2"] if pool == "regions" else ["classifier"]
    heads = seeded.entries({k: v for name in names for k, v in head_shapes(f"head.head.{name}", 192).items()})
    option = "head: FSRA\nblock: 2\n" if pool == "regions" else f"head: SingleBranch\nhead_pool: {pool}\n"
    model = opened(prefixed("backbone.backbone.", own) | heads, tmp_path, f"{option}h: 64\nw: 64\n")
    pictures = seeded.pictures(26, 1, 64, 64)
    with torch.inference_mode():
        tokens = made.forward_features(torch.from_numpy(pictures)).double()
    values = [tokens[:, 1:].mean(1) if pool == "avg" else tokens[:, 0]]
    if pool == "regions":
        values += [mean[None] for mean in published_models.region_means(tokens[0], 2)]
    check(model, pictures, torch.stack([head(heads, n, v) for n, v in zip(names, values, strict=True)], 1))


@pytest.mark.parametrize("rings", [0, 2])
def test_the_baselines_of_sdpl_have_rings_of_their_own_area_or_the_whole_map(
    rings: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    depths = [1, 1, 1, 1]
    made = ResNet(Bottleneck, depths, "layer4", last_stride=1 if rings else 2).eval()
    monkeypatch.setattr("lpn.models.adapters.methods.sdpl.DEPTHS", depths)
    own = seeded.entries({key: list(value.shape) for key, value in made.state_dict().items()})
    made.load_state_dict(own)
    names = [f"classifier{ring}" for ring in range(rings)] or ["classifier"]
    state = seeded.entries({k: v for name in names for k, v in head_shapes(name, 2048).items()})
    state |= prefixed("model_1.model.", own) | prefixed("model_2.model.", own)
    if rings:
        state |= {f"model_1.gem{ring}.p": torch.ones(2048) for ring in range(rings)}
    option = (
        f"h: 96\nw: 96\nstride: 1\ndense_LPN: false\nLPN: {str(rings > 0).lower()}\nblock: {rings or 4}\nviews: 2\n"
    )
    model, pictures = opened(state, tmp_path, option), seeded.pictures(27, 1, 96, 96)
    assert (model.contract.method, model.contract.claim, model.n_parts) == ("SDPL", "exact", rings or 1)
    shapes = {
        "images": (1, 3, 96, 96),
        "parts": (1, rings or 1, 512),
        "features": (1, 2048, 6, 6),
        "cells": (1, rings or 1, 6, 6),
        "head_weight": (rings or 1, 512, 2048),
    }
    assert from_metadata(to_metadata(model.contract), "sdpl.onnx", shapes) == model.contract
    with torch.inference_mode():
        features = made(torch.from_numpy(pictures)).double()
    doubled = {f"head.head.{key}": value for key, value in state.items()}
    raw = [head(doubled, n, v) for n, v in zip(names, ring_means(features, rings or 1, False), strict=True)]
    check(model, pictures, torch.stack(raw, 1))


@pytest.mark.parametrize("shared", [True, False])
def test_a_baseline_of_sues_adds_the_raw_mirror_to_the_scaled_picture(
    shared: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sues, "_NETWORKS", {"test_resnet": _STEM})
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
    check(model, pictures, total[:, None])
    expected = normalise(total[:, None].numpy())
    assert relative_by_part(model.descriptors(pictures, "drone"), expected) < TOLERANCE


def test_a_baseline_of_sues_that_is_not_read_says_so(tmp_path: Path) -> None:
    state = {f"model_{branch}.model.conv1.weight": torch.ones(2) for branch in (1, 2)}
    with pytest.raises(
        ModelFileError, match=r"baseline of SUES-200 that is not read .* found model_1\.model\.conv1\.weight"
    ):
        opened(state | {"classifier0.add_block.0.weight": torch.ones(2, 2)}, tmp_path, "")


@pytest.mark.slow
@pytest.mark.parametrize("table", [denseuav._BACKBONES, sues._NETWORKS], ids=["denseuav", "sues"])
def test_each_backbone_is_told_by_one_entry(table: dict[str, tuple[str, tuple[int, ...]]]) -> None:
    timm = timm_networks.import_timm()
    for name in table:
        with torch.device("meta"):
            state = timm.create_model(name, pretrained=False).state_dict()
        assert matching(table, Entries("net.pth", state)) == name
