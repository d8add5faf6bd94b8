"""Vision transformers whose tokens are pooled by name: what they return, their account, their export, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

import lpn
from lpn.core.arrays import AnyArray
from lpn.core.errors import InputError, ModelFileError
from lpn.models import timm_networks
from lpn.models.export import export
from lpn.models.partition import Partition
from lpn.models.token_pooling import TokenPooling
from lpn.models.trace import Trace
from tools.fixtures import seeded
from tools.fixtures.published_models import relative_by_part
from tools.fixtures.small_vits import PATCH, SIDE, SMALL_VITS, WIDTH

# Tokens of the cells (2, 18, 32) and class tokens, or pooled vectors, (2, 32), of SMALL_VITS for pictures of 24 x 12 pixels. A
# forward pass of plain torch in double precision made them from the weights by each library's equations and defaults: positions
# resampled as it does, its activation, its epsilon. It used nothing of `lpn`; commit 05d1c693 has its code (`SmallVit.answers`).
ANSWERS = seeded.arrays("published/vits")
TOLERANCE = 2e-5
POOLINGS = ("mean", "gem", "gem:2", "cls", "cls+mean", "rings:2")


def pooled(pooling: str, cells: AnyArray, first: AnyArray | None, grid: tuple[int, int]) -> AnyArray:
    """The parts of tokens (B, N, C) and a class token (B, C)."""
    parts: AnyArray = cells.mean(1, keepdims=True)
    if pooling.startswith("gem"):
        power = float(pooling.partition(":")[2] or 3)
        parts = (np.maximum(cells, 1e-6) ** power).mean(1, keepdims=True) ** (1 / power)
    elif pooling.startswith("rings"):
        parts = np.einsum("nx,bxc->bnc", Partition("rings", 2).weights(*grid).reshape(2, -1), cells)
    elif pooling.startswith("cls"):
        assert first is not None
        parts = first[:, None] if pooling == "cls" else np.concatenate([first[:, None], parts], 2)
    return parts


def account_error(model: lpn.Model, picture: AnyArray) -> float:
    return float(Trace.from_pass(model, model.run(picture[None], "drone"), "drone").errors().max())


@pytest.mark.parametrize("name", SMALL_VITS)
def test_each_librarys_network_gives_its_tokens_at_another_size_than_its_trainings(name: str, tmp_path: Path) -> None:
    vit, grid = SMALL_VITS[name], (6, 3)
    file = vit.write(tmp_path, (grid[0] * PATCH, grid[1] * PATCH))
    pictures = seeded.pictures(40, 2, grid[0] * PATCH, grid[1] * PATCH)
    cells, first = ANSWERS[f"{name}.cells"], ANSWERS.get(f"{name}.first")
    for pooling in POOLINGS:
        model = lpn.load(file, "cpu", pooling=pooling)
        expected = pooled(pooling, cells, first, grid)
        assert model.contract.method.startswith(name.partition(" of ")[0].replace(" with gates", ""))
        assert relative_by_part(model.part_embeddings(pictures, "drone"), expected) < TOLERANCE
        if pooling == "cls":
            assert (model.contract.claim, model.map_size("drone")) == ("one vector", (1, 1))
        else:
            assert model.map_size("drone") == grid
            assert account_error(model, pictures[0]) < 1e-5


def test_levels_parts_and_names_are_those_of_the_pooling(tmp_path: Path) -> None:
    file = SMALL_VITS["DINOv2 of torch.hub"].write(tmp_path, (PATCH * SIDE, PATCH * SIDE))
    contracts = {pooling: lpn.load(file, "cpu", pooling=pooling).contract for pooling in (*POOLINGS, "rings:1")}
    assert {pooling: contract.claim for pooling, contract in contracts.items()} == {
        "mean": "exact",
        "rings:1": "exact",
        "rings:2": "exact",
        "gem": "exact, with the power means of GeM (Euler's split of its power) held",
        "gem:2": "exact, with the power means of GeM (Euler's split of its power) held",
        "cls": "one vector",
        "cls+mean": "exact, with the class token held",
    }
    assert contracts["rings:2"].names("drone") == ["1 centre", "2 outer"]
    assert contracts["rings:2"].partition("street") == Partition("rings", 2)
    assert contracts["cls+mean"].embedding == 2 * WIDTH
    assert contracts["gem:2"].title == "DINOv2 ViT/4, gem:2, 16 x 16"
    # Without a name, the mean.
    assert lpn.load(file, "cpu").contract == contracts["mean"]


def test_files_of_transformers_tell_size_and_normalisation(tmp_path: Path) -> None:
    file = SMALL_VITS["SigLIP of transformers"].write(tmp_path, (8, 8))
    (tmp_path / "opts.yaml").unlink()
    assert lpn.load(file, "cpu", pooling="mean").contract.std == (0.5, 0.5, 0.5)
    stated = {"image_mean": [0.1, 0.2, 0.3], "image_std": [1, 1, 1], "size": {"height": 20, "width": 12}}
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(stated))
    contract = lpn.load(file, "cpu", pooling="mean").contract
    assert (contract.mean, contract.std, contract.input_size) == ((0.1, 0.2, 0.3), (1, 1, 1), (20, 12))
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(ModelFileError, match=r"config\.json beside the model cannot be read; correct or remove it"):
        lpn.load(file, "cpu", pooling="mean")


@pytest.mark.parametrize(
    ("name", "side", "claim"),
    [
        ("test_vit.r160_in1k", 96, "exact"),
        ("test_vit_relpos", 64, "exact, with the LayerNorm's mean and variance held"),
        ("test_convnext", 64, "exact, with the LayerNorm's mean and variance held"),
        ("test_resnet", 64, "exact"),
    ],
)
def test_a_network_of_timm_answers_as_timms(name: str, side: int, claim: str, tmp_path: Path) -> None:
    network = timm_networks.named_network(timm_networks.base_name(name), (side, side))
    state = seeded.entries({key: list(value.shape) for key, value in network.state_dict().items()})
    network.load_state_dict(state)
    torch.save(state, tmp_path / "weights.pth")
    (tmp_path / "opts.yaml").write_text(f"h: {side}\nw: {side}\n")
    pictures = seeded.pictures(41, 2, side, side)
    with torch.inference_mode():
        values = network.eval().forward_features(torch.from_numpy(pictures))  # type: ignore[operator]
        own = network(torch.from_numpy(pictures))
    prefix = getattr(network, "num_prefix_tokens", 0)
    cells = (values[:, prefix:] if values.ndim == 3 else values.flatten(2).transpose(1, 2)).numpy()
    grid = (round(cells.shape[1] ** 0.5),) * 2
    for pooling in ("mean", "rings:2"):
        model = lpn.load(f"timm:{name}:{tmp_path}/weights.pth", "cpu", pooling=pooling)
        expected = pooled(pooling, cells, None, grid)
        if pooling == "mean" and "held" in claim:
            expected = own.numpy()[:, None]
        assert model.contract.claim == (claim if pooling == "mean" else "exact")
        assert relative_by_part(model.part_embeddings(pictures, "drone"), expected) < TOLERANCE
        assert account_error(model, pictures[0]) < 1e-5


@pytest.mark.parametrize("pooling", ["gem", "cls+mean"])
def test_an_export_gives_the_same_parts_and_account(pooling: str, tmp_path: Path) -> None:
    file = SMALL_VITS["DINOv2 with registers of torch.hub"].write(tmp_path, (24, 12))
    model = lpn.load(file, "cpu", pooling=pooling)
    export(file, tmp_path / "small.onnx", pooling=pooling)
    exported = lpn.load(tmp_path / "small.onnx")
    # A graph of a fixed batch cannot be quantized.
    assert onnx.load(tmp_path / "small.onnx").graph.input[0].type.tensor_type.shape.dim[0].dim_param == "batch"
    pictures = seeded.pictures(42, 3, 24, 12)
    own = model.part_embeddings(pictures, "street")
    assert relative_by_part(exported.part_embeddings(pictures, "street"), own) < TOLERANCE
    assert (exported.contract.claim, exported.contract.names("drone")) == (
        model.contract.claim,
        model.contract.names("drone"),
    )
    assert account_error(exported, pictures[0]) < 1e-5


@pytest.mark.parametrize("text", ["", "max", "rings", "rings:0", "rings:65", "gem:0.1", "cls+gem", "rings:2 "])
def test_a_pooling_that_is_none_is_told_so(text: str) -> None:
    with pytest.raises(InputError, match="expected"):
        TokenPooling.parse(text)
    for right in ("mean", "gem", "gem:2.5", "cls", "cls+mean", "rings:4"):
        assert str(TokenPooling.parse(right)) == right


def test_nothing_is_downloaded_and_the_form_is_named() -> None:
    with pytest.raises(
        ModelFileError, match=r"nothing is downloaded; .* as timm:vit_small_patch14_dinov2\.lvd142m:FILE"
    ):
        lpn.load("timm:vit_small_patch14_dinov2.lvd142m", pooling="mean")
    with pytest.raises(ModelFileError, match=r"no file absent\.pth .* expected timm:NAME:FILE"):
        lpn.load("timm:vit_small_patch14_dinov2.lvd142m:absent.pth", pooling="mean")


def test_what_does_not_fit_is_one_sentence(tmp_path: Path) -> None:
    vit = SMALL_VITS["DINOv2 of torch.hub"]
    file = vit.write(tmp_path, (16, 16))
    (tmp_path / "opts.yaml").write_text("h: 16\nw: 16\n")
    with pytest.raises(ModelFileError, match=r"how many heads its attention of the width 32 has; put its config\.json"):
        lpn.load(file, pooling="mean")
    vit.write(tmp_path, (18, 16))
    with pytest.raises(ModelFileError, match=r"patches of 4 pixels, and pictures of 18 x 16; .* multiples of 4"):
        lpn.load(file, pooling="mean")
    vit.write(tmp_path, (16, 16))
    with pytest.raises(InputError, match=r"--kind fsra has its own parts"):
        lpn.load(file, kind="fsra", pooling="mean")
    with pytest.raises(InputError, match="has no network 'vit_unknown'"):
        lpn.load(f"timm:vit_unknown:{file}", pooling="mean")
    with pytest.raises(ModelFileError, match=r"^As timm's test_vit for "):
        lpn.load(f"timm:test_vit:{file}", pooling="mean")
    network = timm_networks.named_network("test_resnet", (64, 64))
    torch.save(network.state_dict(), tmp_path / "resnet.pth")
    with pytest.raises(InputError, match="test_resnet has no class token for the pooling cls"):
        lpn.load(f"timm:test_resnet:{tmp_path}/resnet.pth", pooling="cls")
    with pytest.raises(ModelFileError, match="no patches of a vision transformer; expected the names of timm"):
        lpn.load(tmp_path / "resnet.pth", pooling="mean")
    lpn_state = {"model_1.model.conv1.weight": torch.zeros(1), "classifier.add_block.1.weight": torch.zeros(1)}
    torch.save(lpn_state, tmp_path / "lpn.pth")
    with pytest.raises(InputError, match=r"lpn\.pth is a checkpoint of LPN, which has its own parts; leave --pooling"):
        lpn.load(tmp_path / "lpn.pth", pooling="rings:4")


def test_the_activation_that_a_clip_does_not_tell_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = SMALL_VITS["CLIP of transformers"].write(tmp_path, (4 * PATCH, 4 * PATCH))
    config = json.loads((tmp_path / "config.json").read_text())
    pictures, found = seeded.pictures(9, 1, 4 * PATCH, 4 * PATCH), {}
    for stated in (None, "quick_gelu", "gelu"):
        (tmp_path / "config.json").write_text(json.dumps(config | ({"hidden_act": stated} if stated else {})))
        caplog.clear()
        found[stated] = lpn.load(file, "cpu", pooling="mean").part_embeddings(pictures, "drone")
        assert (f"quick_gelu is taken by its width of {WIDTH}" in caplog.text) == (stated is None)
    np.testing.assert_array_equal(found[None], found["quick_gelu"])
    assert np.abs(found["gelu"] - found["quick_gelu"]).max() > 1e-4
