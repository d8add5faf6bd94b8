"""Checkpoints are recognised by the names of their entries."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

import lpn
from lpn.core.errors import InputError, ModelFileError
from lpn.models.adapters import timm_networks
from lpn.models.adapters.build import build
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.recognise import KINDS, Kind, recognise
from tools.fixtures import published_models, small_worlds
from tools.fixtures.published_models import small_denseuav, small_fsra, small_mccg, small_vector

GOLDENS = {
    "fsra_vits_b3": "fsra",
    "mccg_tiny": "mccg",
    "sdpl_resnet50_512": "sdpl",
    "sample4geo_base_384": "sample4geo",
    "sample4geo_tiny_256": "sample4geo",
    "dac_base_384": "dac",
    "game4loc_vitb_384": "game4loc",
    "denseuav_vits_224": "denseuav",
}


@pytest.mark.parametrize(("name", "kind"), GOLDENS.items())
def test_published_names_are_recognised(name: str, kind: str) -> None:
    assert recognise(published_models.shapes_of(name), "net_119.pth") == kind


def test_formats_that_share_names_are_told_apart() -> None:
    found = {
        "camp": small_vector("camp"),
        "dac": small_vector("dac"),
        "mccg": small_mccg(2),
        "fsra": small_fsra(1),
        "denseuav": small_denseuav(3),
        "lpn": small_worlds.make_network().state_dict(),
        "game4loc": {key.replace("model.", "model2."): 0 for key in published_models.shapes_of("game4loc_vitb_384")},
    }
    assert {kind: recognise(state, "net.pth") for kind, state in found.items()} == {kind: kind for kind in found}


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        (
            ["model_1.transformer.blocks.0.norm1.weight", "model_1.transformer.cls_token"],
            r"holds model_1\.transformer\.blocks\.0\..* nearest is FSRA, for which it lacks model_1\.classifier1\.add_block\.\*",
        ),
        (["model_1.model.conv1.weight"], r"nearest is LPN, for which it lacks classifier0\.add_block\.\*"),
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


def test_a_kind_that_is_named_must_exist_and_fit(tmp_path: Path) -> None:
    file = tmp_path / "net_119.pth"
    torch.save(small_fsra(2), file)
    with pytest.raises(InputError, match=f"no kind of model 'vit'; expected one of {', '.join(KINDS)}"):
        lpn.load(file, "cpu", kind="vit")  # type: ignore[arg-type]
    with pytest.raises(ModelFileError, match="has 0 heads classifier_mcb"):
        lpn.load(file, "cpu", kind="mccg")
    with pytest.raises(InputError, match="another kind"):
        lpn.load(file, "cpu", compiled=True)
    (tmp_path / "lpn.onnx").touch()
    with pytest.raises(InputError, match="leave --kind out"):
        lpn.load(tmp_path / "lpn.onnx", kind="fsra")


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "lpn"])
def test_a_kind_that_does_not_fit_is_refused_in_one_sentence(kind: Kind) -> None:
    for own, state in {"mccg": small_mccg(2), "denseuav": small_denseuav(3)}.items():
        # DAC and CAMP need nothing that MCCG lacks.
        if kind != own and not (own == "mccg" and kind in ("dac", "camp")):
            with pytest.raises(ModelFileError) as caught:
                build(kind, Entries("net.pth", state))
            assert "\n" not in str(caught.value)


def test_a_bare_network_of_timm_is_read_as_the_kind_that_is_named(tmp_path: Path) -> None:
    network = timm_networks.convnext((1, 1, 1, 1), (4, 8, 12, 16)).to_empty(device="cpu")
    torch.save({key: torch.ones_like(value) for key, value in network.state_dict().items()}, tmp_path / "bare.pth")
    assert lpn.load(tmp_path / "bare.pth", "cpu", kind="sample4geo").embedding == 16


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
