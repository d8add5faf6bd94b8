"""Checkpoints are recognised by the names of their entries."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

import lpn
from lpn.core.errors import InputError, ModelFileError
from lpn.models import timm_networks
from lpn.models.adapters.build import build
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.recognise import KINDS, Kind, Recognised, recognise, unwrapped, unwrapped_as
from lpn.models.adapters.vit_names import vit_prefix
from lpn.models.base import Model
from tools.fixtures import published_models, seeded, small_worlds
from tools.fixtures.published_models import State, small_denseuav, small_fsra, small_mccg, small_vector, small_vit

GOLDENS = {
    "fsra_vits_b3": "fsra",
    "mccg_tiny": "mccg",
    "sdpl_resnet50_512": "sdpl",
    "sample4geo_base_384": "sample4geo",
    "sample4geo_tiny_256": "sample4geo",
    "dac_base_384": "dac",
    "game4loc_vitb_384": "game4loc",
    "denseuav_vits_224": "denseuav",
    "mfrgn_small": "mfrgn",
}


@pytest.mark.parametrize(("name", "kind"), GOLDENS.items())
def test_published_names_are_recognised(name: str, kind: str) -> None:
    assert recognise(published_models.shapes_of(name), "net_119.pth") == kind


def test_formats_that_share_names_are_told_apart() -> None:
    found = {
        "camp": small_vector("camp"),
        "dac": small_vector("dac"),
        "mean": small_vector("mean"),
        "mccg": small_mccg(2),
        "fsra": small_fsra(1),
        "denseuav": small_denseuav(3),
        "lpn": small_worlds.make_network().state_dict(),
        "game4loc": {key.replace("model.", "model2."): 0 for key in published_models.shapes_of("game4loc_vitb_384")},
    }
    assert {kind: recognise(state, "net.pth") for kind, state in found.items()} == {kind: kind for kind in found}


def _names(*beginnings: str, heads: str = "", layers: str = "01") -> list[str]:
    """Names of networks, each by its first entries, and of heads with a linear layer, or with a BatchNorm behind it."""
    return [*beginnings, *(f"{head}.add_block.{layer}.weight" for head in heads.split() for layer in layers)]


# The entries that tell each method from others. Names decide, so that tensors are not needed.
METHODS: dict[str, tuple[Recognised, Collection[str]]] = {
    "FSRA": ("fsra", small_fsra(2)),
    "MCCG": ("mccg", small_mccg(2)),
    "CAMP": ("camp", small_vector("camp")),
    "DAC": ("dac", small_vector("dac")),
    "MEAN": ("mean", small_vector("mean")),
    "DMNIL": ("dmnil", small_vector("dmnil")),
    "DenseUAV": ("denseuav", small_denseuav(3)),
    "QDFL": (
        "qdfl",
        _names("backbone.model.blocks.0.ls1.gamma", "components.AQEU.coarse.queries", heads="components.classifier0"),
    ),
    "MFRGN": ("mfrgn", published_models.shapes_of("mfrgn_small")),
    "SALAD": (
        "salad",
        ["backbone.model.blocks.0.ls1.gamma", "aggregator.dust_bin", "aggregator.cluster_features.0.weight"],
    ),
    "SDPL": ("sdpl", _names("model_1.model.conv1.weight", "model_1.shift_blocks.0.weight", heads="classifier0")),
    "LPN": ("lpn", _names("model_1.model.conv1.weight", "model_3.model.conv1.weight", heads="classifier0")),
    "SUES-200": ("sues200", _names("model_1.conv1.weight", "model_2.conv1.weight", heads="classifier", layers="0")),
    "Sample4Geo": ("sample4geo", ["logit_scale", "model.stem.0.weight", "model.head.norm.weight"]),
    "Game4Loc": ("game4loc", ["logit_scale", "model1.patch_embed.proj.weight", "model2.patch_embed.proj.weight"]),
    "a vision transformer": ("vit", ["dino.embeddings.patch_embeddings.projection.weight"]),
    "CLIP": ("vit", ["visual.class_embedding", "visual.conv1.weight"]),
    "DINOv2": ("vit", ["dino.patch_embed.proj.weight", "dino.blocks.0.ls1.gamma", "dino.mask_token"]),
}
# A method that is built on another has its names.
BUILT_ON = {"SDPL": ["LPN"], "DAC": ["MCCG", "DMNIL"], "CAMP": ["MCCG", "DMNIL"], "MEAN": ["DMNIL"]}


@pytest.mark.parametrize("first", METHODS)
def test_a_file_of_two_methods_is_of_neither(first: str) -> None:
    kind, names = METHODS[first]
    assert recognise(names, "net.pth") == kind
    for second, (other, others) in METHODS.items():
        both = [*names, *others]
        if first == second or second in BUILT_ON.get(first, []) or first in BUILT_ON.get(second, []):
            assert recognise(both, "net.pth") == (other if first in BUILT_ON.get(second, []) else kind)
        elif {first, second} == {"MCCG", "DMNIL"}:
            # What DAC and CAMP have in common.
            with pytest.raises(ModelFileError, match="nothing that distinguishes DAC from CAMP"):
                recognise(both, "net.pth")
        elif kind == other:
            with pytest.raises(ModelFileError, match="holds several vision transformers"):
                vit_prefix(Entries("net.pth", dict.fromkeys(both, torch.zeros(1))))
        else:
            titles = ("a vision transformer" if of == "vit" else name for of, name in ((kind, first), (other, second)))
            with pytest.raises(ModelFileError) as caught:
                recognise(both, "net.pth")
            assert all(title in str(caught.value) for title in titles)
            assert "nothing decides between them; say which with --kind" in str(caught.value)


@pytest.mark.parametrize(
    ("own", "of"),
    [
        (small_fsra(2), r"FSRA and of LPN \(classifier0\.add_block\.0\.weight\), .* with --kind \(fsra\)"),
        (small_mccg(2), r"MCCG and of LPN \(classifier0"),
        (METHODS["DINOv2"][1], r"holds a vision transformer and entries of a method \(classifier0.*--pooling mean"),
    ],
)
def test_heads_of_another_method_over_a_network_are_not_passed_over(own: Collection[str], of: str) -> None:
    with pytest.raises(ModelFileError, match=of):
        recognise([*own, *_names(heads="classifier0 classifier1")], "net.pth")


def test_two_networks_of_timm_in_a_file_are_refused(tmp_path: Path) -> None:
    vit = small_vit("model.")
    convnext = {
        f"model.{key}": value
        for key, value in timm_networks.convnext((1, 1, 1, 1), (4, 8, 12, 16))
        .to_empty(device="cpu")
        .state_dict()
        .items()
    }
    with pytest.raises(
        ModelFileError, match=r"two networks \(model\.stages\.0.* and model\.patch_embed\.proj\.weight\)"
    ):
        _opened({**vit, **convnext}, tmp_path)
    with pytest.raises(ModelFileError, match=r"the entries of Sample4Geo and of Game4Loc \(model1\."):
        _opened({**vit, **small_vit("model1."), **small_vit("model2.")}, tmp_path)


def test_a_file_that_resembles_two_methods_is_not_decided_by_order(tmp_path: Path) -> None:
    both = {**small_vector("camp"), **small_vector("dac")}
    with pytest.raises(ModelFileError, match=r"the entries of CAMP and of DAC, .* say which with --kind \(camp, dac\)"):
        recognise(both, "net.pth")
    torch.save(small_vector("mean"), tmp_path / "net.pth")
    (tmp_path / "opts.yaml").write_text("h: 64\nw: 64\n")
    model = lpn.load(tmp_path / "net.pth", "cpu")
    assert (model.contract.method, model.contract.resize, model.contract.mirror) == ("MEAN", "linear", "none")
    for kind in ("dac", "camp", "mccg", "sample4geo"):
        with pytest.raises(ModelFileError, match=f"not opened as {kind}: by its entries it is a checkpoint of MEAN"):
            lpn.load(tmp_path / "net.pth", "cpu", kind=kind)
    torch.save(both, tmp_path / "net.pth")
    assert lpn.load(tmp_path / "net.pth", "cpu", kind="dac").contract.method == "DAC"


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        (
            ["model_1.transformer.blocks.0.norm1.weight", "model_1.transformer.cls_token"],
            r"holds model_1\.transformer\.blocks\.0\..* nearest is FSRA, for which it lacks model_1\.classifier1\.add_block\.\*",
        ),
        (["model_1.model.conv1.weight"], r"nearest is LPN, for which it lacks classifier0\.add_block\.1\.\*"),
        (
            [key.replace("model_1.", "model_2.") for key in small_mccg(2)],
            r"nearest is MCCG, for which it lacks model_1\.convnext\.\*, model_1\.tri_layer\.cw\.\*, model_1\.classifier_mcb1\.",
        ),
        (
            [key.replace("model_1.", "model_2.") for key in small_worlds.make_network().state_dict()],
            r"nearest is LPN, for which it lacks model_1\.model\.\*\.",
        ),
        (["encoder.0", "encoder.1", "encoder.2", "encoder.3", "encoder.4"], "and 1 more; none of the known models"),
        ([], "it holds nothing"),
    ],
)
def test_an_unknown_checkpoint_is_told_with_its_names_and_the_nearest_model(keys: list[str], said: str) -> None:
    with pytest.raises(ModelFileError, match=said) as caught:
        recognise(keys, "net_last.pth")
    assert "\n" not in str(caught.value)


def test_a_published_checkpoint_that_is_not_read_is_refused_by_name(tmp_path: Path) -> None:
    shapes = published_models.shapes_of("mfrgn_small")
    street = {
        key.replace("transformer_", f"transformer_{view}_"): shape
        for view in ("sat", "grd")
        for key, shape in shapes.items()
    }
    with pytest.raises(ModelFileError, match=r"of MFRGN of CVUSA, CVACT, or VIGOR, which is not read: its panoramas"):
        recognise([f"module.{key}" for key in street], "net.pth")
    torch.save(seeded.entries(street), tmp_path / "net.pth")
    with pytest.raises(ModelFileError, match="not read: its panoramas and tiles differ"):
        lpn.load(tmp_path / "net.pth", "cpu", kind="mfrgn")


def test_a_kind_that_is_named_must_exist_and_fit(tmp_path: Path) -> None:
    file = tmp_path / "net_119.pth"
    torch.save(small_fsra(2), file)
    with pytest.raises(InputError, match=f"no kind of model 'vit'; expected one of {', '.join(KINDS)}"):
        lpn.load(file, "cpu", kind="vit")  # type: ignore[arg-type]
    for kind in ("mccg", "lpn"):
        with pytest.raises(
            ModelFileError, match=f"not opened as {kind}: by its entries it is a checkpoint of FSRA, so lea"
        ):
            lpn.load(file, "cpu", kind=kind)
    (tmp_path / "lpn.onnx").touch()
    with pytest.raises(InputError, match="leave --kind out"):
        lpn.load(tmp_path / "lpn.onnx", kind="fsra")


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "lpn"])
def test_a_kind_that_does_not_fit_is_refused_in_one_sentence(kind: Kind) -> None:
    for own, state in {"mccg": small_mccg(2), "denseuav": small_denseuav(3)}.items():
        # DAC, CAMP, MEAN, and DMNIL need nothing that MCCG lacks.
        if kind != own and not (own == "mccg" and kind in ("dac", "camp", "mean", "dmnil")):
            with pytest.raises(ModelFileError) as caught:
                build(kind, Entries("net.pth", state))
            assert "\n" not in str(caught.value)


def test_a_prefix_of_training_and_the_container_of_a_checkpoint_do_not_matter(tmp_path: Path) -> None:
    state, (height, width) = small_mccg(2), (64, 64)
    (tmp_path / "opts.yaml").write_text(f"h: {height}\nw: {width}\n")
    forms: dict[str, Any] = {
        "module.": {f"module.{key}": value for key, value in state.items()},
        "compiled": {f"_orig_mod.module.{key}": value for key, value in state.items()},
        "lightning": {"epoch": 3, "state_dict": {f"model.{key}": value for key, value in state.items()}},
        "trainer": {"model": state, "optimizer": {"state": {}}},
        "own": {"epoch": 3, "net": state, "optimizer": {"lr": 0.1}},
        "nested": {"model": {"state_dict": state}},
    }
    torch.save(state, tmp_path / "net.pth")
    pictures = seeded.pictures(3, 1, height, width)
    expected = lpn.load(tmp_path / "net.pth", "cpu").part_embeddings(pictures, "drone")
    files = []
    for name, content in forms.items():
        files.append(tmp_path / f"{name}.pth")
        torch.save(content, files[-1])
    for name, metadata in (("plain", None), ("hub", {"format": "pt"})):
        files.append(tmp_path / f"{name}.safetensors")
        save_file(state, files[-1], metadata)
    for file in files:
        np.testing.assert_array_equal(lpn.load(file, "cpu").part_embeddings(pictures, "drone"), expected)


def test_baselines_of_other_code_are_recognised() -> None:
    for keys, kind in (
        (["model_1.conv1.weight", "model_2.conv1.weight", "classifier.add_block.0.weight"], "sues200"),
        (["model_1.model.conv1.weight", "model_1.gem0.p", "classifier0.add_block.0.weight"], "sdpl"),
        (["logit_scale", "model.layers.0.blocks.0.attn.qkv.weight"], "sample4geo"),
        (["logit_scale", "model1.conv1.weight", "model2.conv1.weight"], "game4loc"),
    ):
        assert recognise(keys, "net.pth") == kind


@pytest.mark.parametrize(
    "entry", ["norm_pre.weight", "blocks.0.attn.q_norm.weight", "blocks.0.mlp.w12.weight", "dist_token"]
)
def test_another_form_of_a_vision_transformer_needs_the_name_of_its_network(entry: str) -> None:
    state = {**small_vit("model."), f"model.{entry}": torch.ones(1, 1, 64)}
    with pytest.raises(
        ModelFileError, match=rf"holds model\.{entry}, .* write its network's name in timm as `model: NAME`"
    ):
        build("sample4geo", Entries("net.pth", state))


def test_a_bare_network_of_timm_is_read_as_the_kind_that_is_named(tmp_path: Path) -> None:
    network = timm_networks.convnext((1, 1, 1, 1), (4, 8, 12, 16)).to_empty(device="cpu")
    for prefix in ("", "_orig_mod.", "net.module."):
        state = {f"{prefix}{key}": torch.ones_like(value) for key, value in network.state_dict().items()}
        torch.save(state, tmp_path / "bare.pth")
        assert lpn.load(tmp_path / "bare.pth", "cpu", kind="sample4geo").embedding == 16


def test_a_prefix_of_training_does_not_matter_to_a_kind_that_is_named() -> None:
    inner = {"model_1.convnext.downsample_layers.0.0.weight": torch.ones(1)}
    for prefix in ("", "_orig_mod.", "module._orig_mod.", "model."):
        state = {f"{prefix}{key}": value for key, value in inner.items()}
        assert unwrapped_as("dac", state) == inner
        with pytest.raises(ModelFileError, match="nothing that distinguishes DAC from CAMP; say which with --kind dac"):
            unwrapped(state, "net.pth")
    own = {"model.stem.0.weight": torch.ones(1), "model.head.norm.weight": torch.ones(1)}
    assert unwrapped_as("sample4geo", own) == own


def test_timm_is_imported_where_torchvision_is_missing_and_no_stand_in_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    timm_networks.import_timm()
    assert not any(type(module).__name__ == "_StandIn" for module in list(sys.modules.values()))
    for name in [name for name in sys.modules if name.partition(".")[0] == "timm"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "timm", None)
    with pytest.raises(
        InputError, match=r"comes from timm, which is not installed; pip install 'lpn-explorer\[models\]'"
    ):
        timm_networks.rotary_transformer(512, 12, (64, 64))


def _two_blocks() -> State:
    """Return a checkpoint of DenseUAV whose block stands twice."""
    state = small_denseuav(0)
    return state | {
        key.replace("blocks.0.", "blocks.1."): value.clone() for key, value in state.items() if "blocks.0." in key
    }


def _opened(state: State, folder: Path) -> Model:
    torch.save(state, folder / "net_119.pth")
    return lpn.load(folder / "net_119.pth", "cpu")


@pytest.mark.parametrize(
    ("state", "lost", "message"),
    [
        (
            small_mccg(2),
            "model_1.classifier_mcb1.add_block.0.weight",
            r"lacks model_1\.classifier_mcb1\.add_block\.0\.weight",
        ),
        (small_denseuav(2), "head.head.classifier_heat1.add_block.0.weight", r"lacks head\.head\.classifier_heat1\."),
        (_two_blocks(), "backbone.backbone.blocks.0.norm1.weight", r"lacks backbone\.backbone\.blocks\.0\.norm1"),
        (_two_blocks(), "backbone.backbone.blocks.0.attn.qkv.bias", r"has .*blocks\.1\.attn\.qkv\.bias, and others"),
    ],
)
def test_a_lost_entry_makes_no_smaller_model(state: State, lost: str, message: str, tmp_path: Path) -> None:
    _opened(state, tmp_path)
    with pytest.raises(ModelFileError, match=message):
        _opened({key: value for key, value in state.items() if key != lost}, tmp_path)


def _hollow(shapes: Mapping[str, list[int]]) -> State:
    """Entries without memory of their own, for a network at its full size."""
    return {key: torch.zeros(()).expand(shape) for key, shape in shapes.items()}


def _sues_lpn() -> State:
    """Entries of SUES-200's LPN of four rings."""
    timm: Any = timm_networks.import_timm()
    with torch.device("meta"):
        network = timm.create_model("seresnet50", pretrained=False)
    shapes = {key: list(value.shape) for key, value in network.state_dict().items()}
    heads = {f"classifier{ring}.add_block.0.weight": [512, 2048] for ring in range(4)}
    heads |= {key.replace("weight", "bias"): [512] for key in heads}
    return _hollow({f"model_{branch}.model.{key}": shape for branch in (1, 2) for key, shape in shapes.items()} | heads)


def _two_game4locs() -> State:
    """Entries of Game4Loc's networks for queries and gallery."""
    one = published_models.shapes_of("game4loc_vitb_384")
    return _hollow({key.replace("model.", f"model{branch}."): shape for branch in (1, 2) for key, shape in one.items()})


@pytest.mark.parametrize(
    ("kind", "make", "lost"),
    [
        (
            "sdpl",
            lambda: _hollow(published_models.shapes_of("sdpl_resnet50_512")),
            [
                "model_1.shift_blocks.0.weight",
                "model_2.shift_blocks.8.bias",
                "model_2.model.layer4.2.bn3.running_var",
                "classifier9.add_block.1.weight",
            ],
        ),
        pytest.param(
            "sues200",
            _sues_lpn,
            ["classifier0.add_block.0.weight", "model_1.model.layer3.5.se.fc1.weight"],
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "game4loc",
            _two_game4locs,
            ["model2.blocks.0.attn.q_bias", "model1.fc_norm.bias"],
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_network_at_its_full_size_without_one_entry_is_no_other_one(
    kind: Kind, make: Callable[[], State], lost: list[str]
) -> None:
    state = make()
    for key in lost:
        for entry in ({}, {key: torch.zeros(3, 3, 3)}):
            changed = {name: value for name, value in state.items() if name != key} | entry
            with pytest.raises(ModelFileError, match=re.escape(key)):
                build(kind, Entries("net.pth", changed))


@pytest.mark.xfail(
    strict=True,
    raises=AssertionError,
    reason="Entries under proj., head., fc., or bn. pass as known for all methods, so that none of them is named.",
)
@pytest.mark.parametrize("entry", ["model_1.proj.0.weight", "model_1.head.fusion.weight", "model_1.bn.weight"])
def test_an_entry_that_another_method_has_is_named(
    entry: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    _opened(small_vector("camp") | {entry: torch.zeros(2, 2)}, tmp_path)
    assert f"has entries that CAMP's released code does not have, 1 in number ({entry})" in caplog.text


def test_the_buffers_of_an_older_timm_are_not_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    names = ("attn_mask", "attn.relative_position_index", "attn.relative_coords_table")
    _opened(small_vector("camp") | {f"model_1.layers.0.blocks.1.{name}": torch.zeros(2, 2) for name in names}, tmp_path)
    assert "released code does not have" not in caplog.text


def test_entries_of_a_method_that_is_built_on_a_known_one_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    state = small_vector("camp")
    _opened(state, tmp_path)
    assert not caplog.records
    _opened(state | {"model_1.pool.attention.weight": torch.zeros(2, 2)}, tmp_path)
    assert (
        "has entries that CAMP's released code does not have, 1 in number (model_1.pool.attention.weight)"
        in caplog.text
    )
    network = small_worlds.make_network().state_dict()
    caplog.clear()
    _opened(network, tmp_path)
    assert "released code does not have" not in caplog.text
    _opened(network | {"model_1.attention.weight": torch.zeros(2, 2)}, tmp_path)
    assert "LPN's released code does not have, 1 in number (model_1.attention.weight)" in caplog.text
