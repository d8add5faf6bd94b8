"""The adapter of each checkpoint, its refusals, and the entries that it names as not read."""

from __future__ import annotations

import sys
from collections.abc import Collection
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import torch

import lpn
from lpn.core.errors import InputError, ModelFileError
from lpn.models import timm_networks
from lpn.models.adapters import registry
from lpn.models.adapters.methods import sdpl
from tools.fixtures import published_models, small_worlds
from tools.fixtures.published_models import State, opened, small_denseuav, small_fsra, small_mccg, small_vector

timm_networks.import_timm()
from timm.models import convnext  # noqa: E402

HEAD = ("0.weight", "1.weight", "1.running_mean")


def chosen(names: Collection[str], options: Collection[str] = (), kind: str | None = None) -> str:
    return registry.choose(kind, dict.fromkeys(names, torch.zeros(1)), options, "net.pth")[0].kind


def heads(*names: str, layers: Collection[str] = HEAD) -> list[str]:
    return [f"{name}.add_block.{layer}" for name in names for layer in layers]


@pytest.mark.parametrize(
    ("names", "kind"),
    [
        (published_models.shapes_of("fsra_vits_b3"), "fsra"),
        (published_models.shapes_of("mccg_tiny"), "mccg"),
        (published_models.shapes_of("sdpl_resnet50_512"), "sdpl"),
        (published_models.shapes_of("sample4geo_base_384"), "sample4geo"),
        (published_models.shapes_of("sample4geo_tiny_256"), "sample4geo"),
        (published_models.shapes_of("dac_base_384"), "dac"),
        (published_models.shapes_of("game4loc_vitb_384"), "game4loc"),
        (published_models.shapes_of("denseuav_vits_224"), "denseuav"),
        (small_vector("camp"), "camp"),
        (small_vector("mean"), "mean"),
        (small_vector("dmnil"), "dmnil"),
        (small_worlds.make_network().state_dict(), "lpn"),
        (["backbone.model.blocks.0.norm1.bias", "aggregator.dust_bin", "aggregator.cluster_features.0.bias"], "salad"),
        (
            ["backbone.blocks.0.norm1.bias", "aggregator.agg.dust_bin", "aggregator.agg.cluster_features.0.bias"],
            "salad",
        ),
        (["model_1.conv1.weight", "model_2.conv1.weight", *heads("classifier", layers=["0.weight"])], "sues200"),
        (["model_1.model.conv1.weight", "model_2.model.conv1.weight", *heads("classifier0")], "lpn"),
        (["logit_scale", "model.layers.0.blocks.0.attn.qkv.weight"], "sample4geo"),
        (["logit_scale", "model1.conv1.weight", "model2.conv1.weight"], "game4loc"),
    ],
)
def test_each_method_is_told_by_its_entries(names: Collection[str], kind: str) -> None:
    assert chosen(names) == kind
    # Prefixes that training puts before all names do not matter.
    assert chosen([f"_orig_mod.module.{name}" for name in names]) == kind


def test_two_that_fit_alike_are_asked_for(tmp_path: Path) -> None:
    both = {**small_vector("camp"), **small_vector("dac")}
    with pytest.raises(ModelFileError, match=r"the entries of dac and of camp, and nothing decides .* with --kind"):
        opened(both, tmp_path)
    assert lpn.load(tmp_path / "net_119.pth", "cpu", kind="dac").contract.method == "DAC"


def test_what_fits_none_and_a_kind_that_is_none_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelFileError, match=r"holds encoder\.0, .* and 1 more\. Name its method with --kind \(lpn, "):
        chosen([f"encoder.{number}" for number in range(5)])
    with pytest.raises(ModelFileError, match="it holds nothing"):
        chosen([])
    with pytest.raises(InputError, match="no kind of model 'vit'; expected one of lpn, "):
        chosen(small_fsra(2), kind="vit")
    opened(small_fsra(2), tmp_path)
    with pytest.raises(ModelFileError, match=r"lacks model_1\."):
        lpn.load(tmp_path / "net_119.pth", "cpu", kind="camp")
    (tmp_path / "lpn.onnx").touch()
    with pytest.raises(InputError, match="leave --kind out"):
        lpn.load(tmp_path / "lpn.onnx", kind="fsra")


def test_a_method_of_another_package_is_one_file_and_an_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    adapter = registry.Adapter("rings", (r"encoder\.0", r"encoder\.1"), sdpl.build)
    monkeypatch.setitem(sys.modules, "own_rings", type(sys)("own_rings"))
    monkeypatch.setattr(sys.modules["own_rings"], "ADAPTERS", (adapter,), raising=False)
    point = EntryPoint("rings", "own_rings:ADAPTERS", registry.GROUP)
    monkeypatch.setattr(registry, "entry_points", lambda group: [point] if group == registry.GROUP else [])
    registry.adapters.cache_clear()
    assert chosen(["encoder.0", "encoder.1"]) == "rings"
    registry.adapters.cache_clear()


def test_a_bare_network_of_timm_is_read_as_the_kind_that_is_named(tmp_path: Path) -> None:
    for prefix in ("", "_orig_mod.", "net.module."):
        state = {f"{prefix}{key.removeprefix('model.')}": value for key, value in CONVNEXT.items()}
        torch.save(state, tmp_path / "bare.pth")
        assert lpn.load(tmp_path / "bare.pth", "cpu", kind="sample4geo").embedding == 16


def test_timm_is_imported_where_torchvision_is_missing_and_no_stand_in_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    timm_networks.import_timm()
    assert not any(type(module).__name__ == "_StandIn" for module in list(sys.modules.values()))
    for name in [name for name in sys.modules if name.partition(".")[0] == "timm"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "timm", None)
    with pytest.raises(InputError, match=r"comes from timm, which is not installed; pip install 'lpn-.*\[models\]'"):
        timm_networks.named_network("test_vit", (64, 64))


def _two_blocks() -> State:
    """Return a checkpoint of DenseUAV whose block stands twice."""
    state = small_denseuav()
    return state | {
        key.replace("blocks.0.", "blocks.1."): value.clone() for key, value in state.items() if "blocks.0." in key
    }


@pytest.mark.parametrize(
    ("state", "lost", "message"),
    [
        (small_mccg(2), "model_1.classifier_mcb1.add_block.0.weight", r"lacks model_1\.classifier_mcb1\.add_block\.0"),
        (small_denseuav(), "head.head.classifier.add_block.1.bias", r"lacks head\.head\.classifier\.add_block\.1\.b"),
        (_two_blocks(), "backbone.backbone.blocks.0.norm1.weight", r"lacks backbone\.backbone\.blocks\.0\.norm1"),
        (_two_blocks(), "backbone.backbone.blocks.0.attn.qkv.bias", r"has .*blocks\.1\.attn\.qkv\.bias, but the model"),
    ],
)
def test_a_lost_entry_makes_no_smaller_model(state: State, lost: str, message: str, tmp_path: Path) -> None:
    opened(state, tmp_path)
    with pytest.raises(ModelFileError, match=message):
        opened({key: value for key, value in state.items() if key != lost}, tmp_path)


_NETWORK = convnext.ConvNeXt(depths=(1, 1, 1, 1), dims=(4, 8, 12, 16), num_classes=0)
CONVNEXT = {f"model.{key}": value for key, value in _NETWORK.state_dict().items()}
STATES = {
    "CAMP": small_vector("camp"),
    "DAC": small_vector("dac"),
    "MEAN": small_vector("mean"),
    "DMNIL": small_vector("dmnil"),
    "MCCG": small_mccg(2),
    "FSRA": small_fsra(2),
    "DenseUAV": small_denseuav(),
    "Sample4Geo": {**CONVNEXT, "logit_scale": torch.ones(())},
    "LPN": small_worlds.make_network().state_dict(),
}


@pytest.mark.parametrize("method", STATES)
def test_entries_that_are_not_read_are_named(method: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The released code's entries of training alone are no news, and those of a method that is built on it are."""
    opened(STATES[method], tmp_path)
    assert "released code does not have" not in caplog.text
    for entry in ("model_1.proj.0.weight", "model_1.head.fusion.weight", "model_1.bn.weight"):
        opened(STATES[method] | {entry: torch.zeros(2, 2)}, tmp_path)
        assert f"has entries that {method}'s released code does not have, 1 in number ({entry})" in caplog.text


def test_the_buffers_of_an_older_timm_are_not_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    names = ("attn_mask", "attn.relative_position_index", "attn.relative_coords_table")
    opened(STATES["Sample4Geo"] | {f"model.layers.0.blocks.1.{name}": torch.zeros(2, 2) for name in names}, tmp_path)
    assert "released code does not have" not in caplog.text
