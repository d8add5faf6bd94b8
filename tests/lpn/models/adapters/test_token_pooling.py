"""Networks of timm and transformers whose tokens are pooled by name: outputs, account, and refusals."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

import lpn
from lpn.core.arrays import AnyArray
from lpn.core.errors import InputError, ModelFileError
from lpn.models import timm_networks
from lpn.models.export import export
from lpn.models.partition import Partition
from lpn.models.token_pooling import TokenPooling
from tools.fixtures import seeded
from tools.fixtures.published_models import account_error, relative_by_part

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
        parts = first[:, None] if pooling == "cls" else np.concatenate([first[:, None], parts], 2)
    return parts


def timm_file(name: str, side: int, folder: Path) -> str:
    """Write seeded weights of a network of timm, and return its model value."""
    network = timm_networks.named_network(timm_networks.base_name(name), (side, side), own_size=True)
    state = seeded.entries({key: list(value.shape) for key, value in network.state_dict().items()})
    torch.save(state, folder / "weights.pth")
    (folder / "opts.yaml").write_text(f"h: {side}\nw: {side}\n")
    return f"timm:{name}:{folder}/weights.pth"


def test_levels_parts_and_names_are_those_of_the_pooling(tmp_path: Path) -> None:
    file = timm_file("test_vit.r160_in1k", 32, tmp_path)
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
    assert contracts["cls+mean"].embedding == 2 * contracts["mean"].embedding
    assert contracts["gem:2"].title == "test_vit, gem:2, 32 x 32"
    # Without a name, the mean.
    assert lpn.load(file, "cpu").contract == contracts["mean"]


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
    file = timm_file(name, side, tmp_path)
    network = timm_networks.named_network(timm_networks.base_name(name), (side, side), own_size=True)
    network.load_state_dict(torch.load(tmp_path / "weights.pth"))
    pictures = seeded.pictures(41, 2, side, side)
    with torch.inference_mode():
        values = network.eval().forward_features(torch.from_numpy(pictures))
        own = network(torch.from_numpy(pictures))
    prefix = getattr(network, "num_prefix_tokens", 0)
    cells = (values[:, prefix:] if values.ndim == 3 else values.flatten(2).transpose(1, 2)).numpy()
    first = values[:, 0].numpy() if prefix else None
    grid = (round(cells.shape[1] ** 0.5),) * 2
    for pooling in POOLINGS if prefix else ("mean", "gem", "rings:2"):
        model = lpn.load(file, "cpu", pooling=pooling)
        expected = pooled(pooling, cells, first, grid)
        if pooling == "mean" and "held" in claim:
            expected = own.numpy()[:, None]
        if pooling in ("mean", "rings:2"):
            assert model.contract.claim == (claim if pooling == "mean" else "exact")
        assert relative_by_part(model.part_embeddings(pictures, "drone"), expected) < TOLERANCE
        if pooling != "cls":
            assert account_error(model, pictures[0]) < 1e-5


@pytest.mark.parametrize(("kind", "prefix"), [("Dinov2", 1), ("CLIPVision", 1), ("SiglipVision", 0)])
def test_a_folder_of_transformers_answers_as_transformers(kind: str, prefix: int, tmp_path: Path) -> None:
    transformers = pytest.importorskip("transformers", reason="transformers is not installed")
    sizes = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2, "image_size": 32, "patch_size": 8}
    config = getattr(transformers, f"{kind}Config")(**sizes, intermediate_size=48)
    network = getattr(transformers, f"{kind}Model")(config).eval()
    network.load_state_dict(seeded.entries({key: list(value.shape) for key, value in network.state_dict().items()}))
    network.save_pretrained(tmp_path / "network")
    stated = {"image_mean": [0.1, 0.2, 0.3], "image_std": [1, 1, 1], "size": {"height": 32, "width": 32}}
    (tmp_path / "network" / "preprocessor_config.json").write_text(json.dumps(stated))
    pictures = seeded.pictures(43, 2, 32, 32)
    with torch.inference_mode():
        values = network(pixel_values=torch.from_numpy(pictures)).last_hidden_state.numpy()
    for pooling in ("rings:2", "cls+mean") if prefix else ("rings:2",):
        model = lpn.load(tmp_path / "network", "cpu", pooling=pooling)
        expected = pooled(pooling, values[:, prefix:], values[:, 0], (4, 4))
        assert relative_by_part(model.part_embeddings(pictures, "drone"), expected) < TOLERANCE
        assert account_error(model, pictures[0]) < 1e-5
    assert (model.contract.mean, model.input_size) == ((0.1, 0.2, 0.3), (32, 32))
    (tmp_path / "network" / "config.json").write_text('{"model_type": "no such"}')
    with pytest.raises(ModelFileError, match=r"cannot open network as a vision transformer for pictures of 32 x 32"):
        lpn.load(tmp_path / "network", "cpu")


@pytest.mark.parametrize(
    ("name", "side", "pooling"), [("test_resnet", 64, "gem"), ("test_vit.r160_in1k", 32, "cls+mean")]
)
def test_an_export_gives_the_same_parts_and_account(name: str, side: int, pooling: str, tmp_path: Path) -> None:
    file = timm_file(name, side, tmp_path)
    model = lpn.load(file, "cpu", pooling=pooling)
    export(file, tmp_path / "small.onnx", pooling=pooling)
    exported = lpn.load(tmp_path / "small.onnx")
    pictures = seeded.pictures(42, 3, side, side)
    own = model.part_embeddings(pictures, "street")
    assert relative_by_part(exported.part_embeddings(pictures, "street"), own) < TOLERANCE
    assert exported.contract == model.contract
    assert account_error(exported, pictures[0]) < 1e-5


@pytest.mark.parametrize("text", ["", "max", "rings", "rings:0", "rings:65", "gem:0.1", "cls+gem", "rings:2 "])
def test_a_pooling_that_is_none_is_told_so(text: str) -> None:
    with pytest.raises(InputError, match="expected"):
        TokenPooling.parse(text)
    for right in ("mean", "gem", "gem:2.5", "cls", "cls+mean", "rings:4"):
        assert str(TokenPooling.parse(right)) == right


def test_what_does_not_fit_is_one_sentence(tmp_path: Path) -> None:
    file = timm_file("test_resnet", 64, tmp_path).rpartition(":")[2]
    for name, message in (
        ("timm:vit_small_patch14_dinov2.lvd142m", r"nothing is down.* as timm:vit_small_patch14_dinov2\.lvd142m:F"),
        ("timm:vit_small_patch14_dinov2.lvd142m:absent.pth", r"no file absent\.pth .* expected timm:NAME:FILE"),
        (f"timm:test_vit:{file}", r"^As timm's test_vit for "),
    ):
        with pytest.raises(ModelFileError, match=message):
            lpn.load(name, pooling="mean")
    for name, pooling, kind, message in (
        (f"timm:vit_unknown:{file}", "mean", None, "has no network 'vit_unknown'"),
        (f"timm:test_resnet:{file}", "cls", None, "test_resnet has no class token for the pooling cls"),
        (f"timm:test_resnet:{file}", "mean", "fsra", "leave --kind fsra out"),
        (file, "rings:4", None, r"name its network, as timm:NAME:weights\.pth, or leave --pooling out"),
    ):
        with pytest.raises(InputError, match=message):
            lpn.load(name, kind=kind, pooling=pooling)
