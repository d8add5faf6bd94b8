"""Checkpoints of other sizes, blocks, and branches give what double-precision references computed from their entries alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lpn.core.errors import ModelFileError
from lpn.models import timm_networks
from lpn.models.adapters.methods import sdpl
from lpn.models.adapters.methods.sdpl import planes
from lpn.models.adapters.published import PublishedModel
from lpn.models.entries import Entries
from tools.fixtures import published_models, seeded
from tools.fixtures.published_models import (
    State,
    agrees,
    distinct,
    opened,
    relative_by_part,
    small_denseuav,
    small_fsra,
    small_mccg,
    small_vector,
)
from tools.fixtures.seeded import relative

# The first 64 numbers of each part, raw and of the descriptor. References in double precision computed them from the entries of
# the checkpoints below, by the equations of each method and without `lpn` and timm; commit 05d1c693 has their code
# (tools/fixtures/published_models.py). test_goldens.py compares all numbers of larger networks with those of released code.
REFERENCES = seeded.arrays("published/formats")
FSRA, DENSEUAV, RESNET = small_fsra(2), small_denseuav(), small_mccg(2, resnet=True)


def check(model: PublishedModel, pictures: np.ndarray, of: str, view: Any = "drone") -> None:
    """Compare raw parts and descriptors with REFERENCES."""
    agrees(model, pictures, REFERENCES[f"{of}.raw"], view)
    expected = REFERENCES[f"{of}.descriptor"]
    assert relative_by_part(model.descriptors(pictures, view)[..., : expected.shape[2]], expected) < 2e-5


GATES = "exact, with the gates and the LayerNorm's mean and variance held"
NORM = "exact, with the LayerNorm's mean and variance held"
REGIONS = "exact, with the regions of each picture held"


@pytest.mark.parametrize(
    ("state", "options", "pictures", "reference", "claim"),
    [
        pytest.param(small_fsra(1), "views: 2\nblock: 1\n", 3, "fsra-1", "one vector", marks=pytest.mark.slow),
        (FSRA, "views: 2\nblock: 2\nh: 256\nw: 256\n", 3, "fsra-2", REGIONS),
        (small_mccg(1), "block: 1\nh: 64\nw: 64\n", 5, "mccg-1", GATES),
        (small_mccg(2), "block: 2\nh: 96\nw: 64\n", 5, "mccg-2", GATES),
        (RESNET, "resnet: true\nblock: 2\nh: 96\nw: 64\n", 5, "mccg-resnet", "exact, with the gates held"),
        (RESNET | {"model_1.proj.mlp.0.weight": torch.zeros(2, 2)}, "h: 96\nw: 64\n", 5, "dac-resnet", "exact"),
        (small_vector("camp"), "h: 64\nw: 96\n", 8, "camp", NORM),
        (small_vector("dac"), "h: 64\nw: 96\n", 8, "dac", NORM),
        (small_vector("dmnil"), "h: 64\nw: 96\n", 8, "dmnil", NORM),
        (DENSEUAV, "head: SingleBranch\nhead_pool: avg\nh: 64\nw: 64\n", 9, "denseuav-avg", "exact"),
        (DENSEUAV, "head_pool: global\n", 9, "denseuav-global", "one vector"),
    ],
    ids=lambda value: value if isinstance(value, str) and "\n" not in value and " " not in value else "",
)
def test_each_form_agrees_with_its_reference(
    state: State, options: str, pictures: int, reference: str, claim: str, tmp_path: Path
) -> None:
    model = opened(state, tmp_path, options)
    assert (model.contract.method.lower(), model.contract.claim) == (reference.partition("-")[0], claim)
    assert model.n_parts == REFERENCES[f"{reference}.raw"].shape[1]
    check(model, seeded.pictures(pictures, 1, *model.input_size), reference)


def test_mccg_takes_pictures_of_other_sizes(tmp_path: Path) -> None:
    model, expected = opened(small_mccg(2), tmp_path, "h: 128\nw: 64\n"), REFERENCES["mccg-2.larger"]
    found = model.part_embeddings(seeded.pictures(6, 1, 128, 64), "drone")
    assert relative_by_part(found[..., : expected.shape[2]], expected) < 2e-5


def test_fsra_of_three_views_whose_street_has_weights_of_its_own(tmp_path: Path) -> None:
    state, pictures = distinct(small_fsra(2, 2), "model_2."), seeded.pictures(4, 1, 256, 256)
    model = opened(state, tmp_path, "views: 3\nshare: false\n")
    assert model.views == ("satellite", "street", "drone")
    assert model.contract.groups == (("satellite", "drone"), ("street",))
    for view, branch in (("satellite", "model_1"), ("drone", "model_1"), ("street", "model_2")):
        agrees(model, pictures, REFERENCES[f"fsra-three-views.{branch}"], view)
    assert opened(small_fsra(2, 2), tmp_path).contract.groups == (("satellite", "street", "drone"),)


def test_the_head_that_fsra_of_one_block_does_not_use_may_be_missing(tmp_path: Path) -> None:
    state, pictures = small_fsra(1), seeded.pictures(3, 1, 256, 256)
    bare = {key: value for key, value in state.items() if "classifier_heat" not in key}
    expected = opened(state, tmp_path, "block: 1").part_embeddings(pictures, "drone")
    np.testing.assert_array_equal(opened(bare, tmp_path, "block: 1").part_embeddings(pictures, "drone"), expected)
    with pytest.raises(ModelFileError, match=r"has 0 heads of parts, .* block: 3"):
        opened(bare, tmp_path, "block: 3")


def test_mccg_of_three_views_is_described_by_the_network_that_the_released_test_loads_last(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    state, pictures = small_mccg(2, 2), seeded.pictures(5, 1, 64, 64)
    model = opened(state, tmp_path, "views: 3\nh: 64\nw: 64\n")
    assert not caplog.records
    assert model.views == ("satellite", "street", "drone")
    state = distinct(state, "model_2.")
    model = opened(state, tmp_path, "views: 3\nh: 64\nw: 64\n")
    assert "model_2 describes all views" in caplog.text
    for view in model.views:
        agrees(model, pictures, REFERENCES["mccg-three-views.model_2"], view)


@pytest.mark.parametrize("form", [{"use_grn": True, "ls_init_value": None}, {"conv_mlp": True}])
def test_forms_of_a_convnext_are_read_off_its_entries(form: dict[str, Any], tmp_path: Path) -> None:
    timm_networks.import_timm()
    from timm.models.convnext import ConvNeXt

    network = ConvNeXt(depths=(1, 1, 1, 1), dims=(4, 8, 12, 16), num_classes=0, **form).eval()
    state = seeded.entries({key: list(value.shape) for key, value in network.state_dict().items()})
    network.load_state_dict(state)
    # Branches of their own make it a model of Game4Loc.
    branches = {f"model{number}.{key}": value for number in (1, 2) for key, value in state.items()}
    model = opened({"logit_scale": torch.ones(()), **branches}, tmp_path, "h: 64\nw: 64\n")
    assert (model.contract.method, model.contract.roles) == ("Game4Loc", "view")
    assert model.describe().startswith("Game4Loc ConvNeXt V2" if "use_grn" in form else "Game4Loc ConvNeXt,")
    pictures = seeded.pictures(10, 1, 64, 64)
    with torch.inference_mode():
        agrees(model, pictures, network(torch.from_numpy(pictures))[:, None])


def test_the_names_of_training_may_be_missing_if_the_kind_is_named(tmp_path: Path) -> None:
    state = {key: value for key, value in small_vector("dac").items() if key.startswith("model_1.convnext.")}
    with pytest.raises(ModelFileError, match="not a checkpoint of a known model"):
        opened(state, tmp_path)
    assert opened(state, tmp_path, kind="camp").contract.method == "CAMP"


@pytest.mark.parametrize("side", [16, 24, 32])
def test_the_parts_of_sdpl_keep_the_lasting_zero(side: int) -> None:
    rng = np.random.default_rng(side)
    features, weights = np.maximum(rng.standard_normal((3, side, side)), 0), np.array([0.5, 0.2, 0.3])
    flat = np.append(features.reshape(3, -1), np.zeros((3, 1)), axis=1)
    found = np.zeros((10, 3))
    for weight, parts in zip(weights, planes(side), strict=True):
        for number, plane in enumerate(parts):
            values = np.maximum(sum(flat[:, cells] for cells in plane), 1e-6)
            found[number] += weight * np.cbrt((values**3).mean(1))
    assert relative(found, REFERENCES[f"sdpl-{side}"]) < 1e-12


def test_the_branches_of_sdpl_follow_the_role() -> None:
    """Return entries of zeros, which take no memory; the branches differ in one number."""
    blank = torch.zeros(())
    state = {key: blank.expand(shape) for key, shape in published_models.shapes_of("sdpl_resnet50_512").items()}
    entries = Entries("net_350.pth", state, {"h": 256, "w": 256})
    assert sdpl.build(entries).contract.roles == "view"
    state["model_2.model.bn1.bias"] = torch.ones(64)
    model = PublishedModel(sdpl.build(entries), "0")
    assert (model.contract.roles, model.map_size("drone")) == ("role", (16, 16))
    for query, gallery in (("drone", "satellite"), ("satellite", "drone")):
        bound = model.for_task(query, gallery)
        for view, value in ((query, 0.0), (gallery, 1.0)):
            assert bound.network(view).get_submodule("trunk.bn1").bias[0] == value
    for height, width in ((320, 320), (512, 256), (128, 128)):
        with pytest.raises(
            ModelFileError,
            match=f"{height} x {width} pixels; SDPL takes squares with a side that is a multiple of 128 pixels, 256 or more",
        ):
            sdpl.build(Entries("net_350.pth", state, {"h": height, "w": width}))


def narrow_denseuav() -> State:
    """A vision transformer of 40 numbers a token, which are no whole heads."""
    state = small_denseuav()
    cut = {key: value[..., :40] if value.ndim and value.shape[-1] == 64 else value for key, value in state.items()}
    return cut | {"backbone.backbone.patch_embed.proj.weight": torch.zeros(40, 3, 16, 16)}


@pytest.mark.parametrize(
    ("state", "changed", "options", "said"),
    [
        (FSRA, {"model_1.classifier1.add_block.0.weight": (512, 8)}, "", r"has shape \(512, 8\); expected \(512, 16\)"),
        (FSRA, {"model_1.transformer.pos_embed": (1, 50, 16)}, "", "positions for 49 patches of 16"),
        (FSRA, {}, "block: 3", "block: 3; correct or remove it"),
        (small_mccg(1), {}, "views: 3\nh: 64\nw: 64", "has 2 views, .* says views: 3; correct or remove"),
        (small_mccg(1, 2), {}, "views: 2\nh: 64\nw: 64", "has 3 views, .* says views: 2; correct or remove"),
        (small_mccg(1), {}, "h: 100\nw: 64", "multiples of 32"),
        (narrow_denseuav(), {}, "", "1 blocks of the width 40; expected .* heads of 64 numbers"),
        (DENSEUAV, {"head.head.netvlad.centroids": (4, 64)}, "", r"unsupported head \(found head\.head\.netvlad\.centroids\)"),
        (DENSEUAV, {"backbone.backbone.dist_token": (1, 1, 64)}, "backbone: DeitT-224", r"unknown backbone \(found backbone"),
        (DENSEUAV, {}, "head_pool: median", "head_pool: median; expected one of avg, global"),
    ],
)  # fmt: skip
def test_wrong_shapes_and_options_are_told_in_one_sentence(
    state: State, changed: dict[str, tuple[int, ...]], options: str, said: str, tmp_path: Path
) -> None:
    state = state | {name: torch.ones(shape) for name, shape in changed.items()}
    with pytest.raises(ModelFileError, match=said) as caught:
        opened(state, tmp_path, options)
    assert "\n" not in str(caught.value)
