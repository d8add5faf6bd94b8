"""Published checkpoints of every kind give what `tools.fixtures.published_network` works out from their entries alone."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import lpn
from lpn.core.errors import ModelFileError
from lpn.models.lpn import LPN
from lpn.models.options import read_options
from lpn.models.published_checkpoints import infer_backbone, infer_spec
from lpn.models.spec import ModelSpec
from tools.fixtures import published_network, seeded, small_worlds
from tools.fixtures.parity import (
    CASES,
    TOLERANCE,
    ParityCase,
    backbone,
)
from tools.fixtures.published_network import State
from tools.fixtures.seeded import relative

# A stride of 2, and panoramas; the others run with the slow tests. Those with published arrays are in test_checkpoints.py.
QUICK = CASES[7], CASES[11]


@cache
def golden_maps() -> tuple[Tensor, Tensor]:
    """The pictures of the golden cases, and their mirrors; both cases have the same backbone."""
    images = torch.from_numpy(seeded.pictures(7, 2, 256, 256))
    state = {f"model_3.model.{k}": v for k, v in backbone("resnet50").items()}
    return published_network.feature_map(state, "model_3", images), published_network.feature_map(
        state, "model_3", images.flip(3)
    )


def agree(found: np.ndarray, expected: Tensor) -> None:
    assert relative(found, expected) <= TOLERANCE


@pytest.mark.parametrize("case", ["n4", "n1_baseline"])
def test_the_reference_answers_as_the_published_implementation(case: str) -> None:
    golden, state = seeded.arrays(f"parity_{case}"), seeded.state_dict(case)
    of_image, of_mirror = (published_network.embeddings(state, "drone", features) for features in golden_maps())
    # The published arrays are (B, D, n), parts last.
    agree(golden["raw"].reshape(2, 512, -1).transpose(0, 2, 1), of_image)
    agree(
        golden["descriptor"].reshape(2, 512, -1).transpose(0, 2, 1), published_network.descriptor(of_image, of_mirror)
    )


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=[] if case in QUICK else [pytest.mark.slow]) for case in CASES if not case.golden],
    ids=str,
)
def test_a_checkpoint_gives_the_published_head_outputs(case: ParityCase, tmp_path: Path) -> None:
    model = lpn.load(case.write(tmp_path), "cpu")
    assert (model.views, model.n_parts, model.input_size) == (case.views, case.n, (case.size, case.size))
    for view in case.compared:
        agree(model.part_embeddings(case.pictures(), view), case.expected(view))


def two_branches() -> State:
    """The keys of a two-view checkpoint of a small network."""
    spec = ModelSpec("resnet18", views=("satellite", "street"), n_parts=4, layout="cvusa", shared=False, classes=3)
    return LPN(spec).state_dict()


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("views: 3", "the branches model_1, model_3"),
        ("views: 4", "views: 4"),
        ("use_vgg16: true", "the backbone resnet18"),
        ("{LPN: true, block: 6}", "4 heads"),
        ("pool: avg+max", "only average pooling"),
        ("views: two", "a whole number"),
        ("model_2: balloon", "model_2: balloon; expected street or drone"),
        ("model_2: drone", "has a branch model_3, which describes drone pictures"),
    ],
)
def test_options_of_another_model_are_refused(option: str, said: str, tmp_path: Path) -> None:
    torch.save(small_worlds.make_network().state_dict(), tmp_path / "net_last.pth")
    (tmp_path / "opts.yaml").write_text(option)
    with pytest.raises(ModelFileError, match=r"opts\.yaml") as caught:
        lpn.load(tmp_path / "net_last.pth")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def equal_branches() -> State:
    state = two_branches()
    return state | {k.replace("model_1.", "model_2."): v.clone() for k, v in state.items() if k.startswith("model_1.")}


PANORAMAS, UNIVERSITY = (("satellite", "street"), "cvusa"), (("satellite", "street", "drone"), "university")
AS_PANORAMAS, AS_ONE = "they are read as satellite and street", "they are equal, so they are read as one network"


@pytest.mark.parametrize(
    ("branches", "options", "read", "said"),
    [
        (two_branches, {"data_dir": "/data/CVUSA/train"}, PANORAMAS, ""),
        (two_branches, {"data_dir": "./data/cvact", "name": "x"}, PANORAMAS, ""),
        (two_branches, {"name": "CVUSA_n8"}, PANORAMAS, ""),
        (two_branches, {"model_2": "street"}, PANORAMAS, ""),
        (two_branches, {}, PANORAMAS, AS_PANORAMAS),
        (two_branches, {"data_dir": "/data/University-Release/train", "views": 2}, PANORAMAS, AS_PANORAMAS),
        (equal_branches, {"views": 2, "share": True}, UNIVERSITY, AS_ONE),
        (equal_branches, {"views": 2, "share": False}, PANORAMAS, AS_PANORAMAS),
        (equal_branches, {"data_dir": "University-1652/train"}, UNIVERSITY, ""),
        (equal_branches, {"data_dir": "data/CVUSA"}, PANORAMAS, ""),
        (equal_branches, {"model_2": "street"}, PANORAMAS, ""),
    ],
)
def test_the_log_says_how_two_branches_are_read_unless_the_options_do(
    branches: Any, options: dict[str, Any], read: tuple[Any, str], said: str, caplog: pytest.LogCaptureFixture
) -> None:
    state = branches()
    told = infer_spec(state, options | {"h": 256, "w": 256}, "net_last.pth")
    assert (told.views, told.layout) == read
    assert told.shared == (branches is equal_branches)
    assert [said in record.getMessage() for record in caplog.records] == ([True] if said else [])


def test_a_second_branch_is_the_drones_by_its_option_or_its_name(tmp_path: Path) -> None:
    for state, options in (
        (two_branches(), "model_2: drone"),
        ({k.replace("model_2.", "model_3."): v for k, v in two_branches().items()}, ""),
    ):
        torch.save(state, tmp_path / "net_119.pth")
        (tmp_path / "opts.yaml").write_text(f"h: 64\nw: 64\nviews: 2\n{options}\n")
        spec = lpn.load(tmp_path / "net_119.pth", "cpu").spec
        assert (spec.views, spec.layout, spec.shared) == (("satellite", "drone"), "university", False)


def test_the_log_says_that_a_size_is_assumed_where_no_option_states_it(caplog: pytest.LogCaptureFixture) -> None:
    state = small_worlds.make_network().state_dict()
    assert infer_spec(state, {"h": 128}, "net.pth").input_size == (128, 256)
    (record,) = caplog.records
    assert record.getMessage().startswith(
        "net.pth does not state the whole size of its pictures, so 128 x 256 pixels are assumed;"
    )
    caplog.clear()
    infer_spec(state, {"h": 128, "w": 128})
    assert not caplog.records


def test_finite_weights_whose_sum_is_not_open(tmp_path: Path) -> None:
    state = small_worlds.make_network().state_dict()
    state["classifier1.add_block.0.weight"][:] = 3e38
    torch.save(state, tmp_path / "net_last.pth")
    assert lpn.load(tmp_path / "net_last.pth").n_parts == 4


# Unused lines in an opts.yaml of released code, or of copies of it.
UNUSED_OPTIONS = {
    "a tuple": "gpu_ids: !!python/tuple [0, 1]",
    "a call": "out: !!python/object/apply:os.system ['touch ran']",
    "a name": "act: !!python/name:torch.nn.ReLU ''",
    "an unknown tag": "out: !Path runs",
    "an alias": "a: &1 [0]\nb: *1",
    "a huge number": "seed: " + "9" * 5000,
    "no date": "day: 2001-99-99",
    "no truth value": "flag: !!bool x",
}


@pytest.mark.parametrize("case", UNUSED_OPTIONS)
def test_an_option_that_is_not_used_may_be_anything(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = f"h: 64\n{UNUSED_OPTIONS[case]}\nw: '64'\nstride: 1\n"
    (tmp_path / "opts.yaml").write_text(text)
    options = read_options(tmp_path / "opts.yaml")
    assert (options["h"], options["w"], options["stride"]) == (64, 64, 1)
    assert not (tmp_path / "ran").exists()


# Options as text in YAML, and as they are read.
OPTIONS: dict[str, tuple[str, Any]] = {
    "h": ("'256'", 256),
    "w": ('"256"', 256),
    "LPN": ("'True'", True),
    "use_vgg16": ("false", False),
    "block": ("'4'", 4),
    "stride": ("1", 1),
    "droprate": ("75e-2", 0.75),
    "pool": ("avg", "avg"),
}
LINES = [f"{key}: {text}" for key, (text, _) in OPTIONS.items()]


@pytest.mark.parametrize(("first", "encoding"), [([], "utf-8-sig"), (["!!python/object:argparse.Namespace"], "utf-8")])
def test_options_are_numbers_and_truth_values_whatever_wrote_them(
    first: list[str], encoding: str, tmp_path: Path
) -> None:
    (tmp_path / "opts.yaml").write_text("\r\n".join([*first, *LINES]), encoding, newline="")
    assert read_options(tmp_path / "opts.yaml") == {key: value for key, (_, value) in OPTIONS.items()}


def test_a_path_in_another_encoding_does_not_hide_the_options(tmp_path: Path) -> None:
    (tmp_path / "opts.yaml").write_bytes("data_dir: D:/数据/train\nh: 384\n".encode("gbk"))
    assert read_options(tmp_path / "opts.yaml")["h"] == 384


@pytest.mark.parametrize(
    ("option", "sentence"),
    [
        ("h: '256px'", "says h: 256px; expected a whole number, so correct it."),
        ("h: [256, 256]", "says h: a list; expected a whole number, so correct it."),
        ("h: 256.5", "says h: 256.5; expected a whole number, so correct it."),
        ("block: 'False'", "says block: False; expected a whole number, so correct it."),
        ("droprate: '75%'", "says droprate: 75%; expected a number from 0 up to 1, so correct it."),
        ("use_vgg16: maybe", "says use_vgg16: maybe; expected true or false, so correct it."),
        ("LPN: 4", "says LPN: 4; expected true or false, so correct it."),
        ("share: some", "says share: some; expected true or false, so correct it."),
        ("{: :", "cannot be read; correct or remove it."),
    ],
)
def test_an_option_that_is_used_and_wrong_is_one_sentence(option: str, sentence: str, tmp_path: Path) -> None:
    (tmp_path / "opts.yaml").write_text(f"name: lpn\n{option}\n")
    with pytest.raises(ModelFileError) as caught:
        read_options(tmp_path / "opts.yaml")
    assert str(caught.value) == f"The opts.yaml beside the model {sentence}"


def test_an_lpn_on_a_se_resnet_is_not_read_without_its_gates() -> None:
    names = ("layer1.0.conv3.weight", "layer3.5.conv1.weight", "layer4.0.conv1.weight")
    state = dict.fromkeys(names, torch.zeros(1))
    assert infer_backbone(state, "net.pth") == ("resnet50", "layer4")
    with pytest.raises(ModelFileError, match=r"a SE-ResNet \(layer1\.0\.se\.fc1\.weight\), .*: timm:seresnet50`"):
        infer_backbone(state | {"layer1.0.se.fc1.weight": torch.zeros(1)}, "net.pth")
