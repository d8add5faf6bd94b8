"""Models beside the workspace's own: the demo's baseline, one or many of --beside, each opened once."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import explorer.app
import explorer.cli
import explorer.opening
import lpn
from explorer.cli import Explore
from explorer.opening import open_model
from explorer.workspace import Workspace
from lpn.core.errors import DataError, InputError, ModelFileError
from lpn.datasets import open_dataset
from lpn.descriptors.transforms import Change
from lpn.descriptors.weather import Weather
from lpn.models import timm_networks
from lpn.sources import ModelOptions
from lpn.tasks.changes import changed
from lpn.tasks.opening import lazy_task
from tests.conftest import Refused
from tests.explorer.conftest import TASK, answered
from tools.fixtures import small_worlds
from tools.fixtures.published_models import small_vector
from tools.fixtures.small_contracts import RegionModel
from tools.fixtures.waiting import wait_until

PATIENCE = 120.0


@pytest.fixture
def workspace(data: Path, model_file: Path, one_part_model_file: Path, tmp_path: Path) -> Workspace:
    """A workspace that offers the model of one part."""
    shutil.copy(one_part_model_file, tmp_path / "baseline.onnx")
    return open_model(data, model_file, baseline=tmp_path / "baseline.onnx")


def test_an_offered_model_is_opened_once_and_on_request(workspace: Workspace) -> None:
    (second,) = workspace.beside
    assert (second.label, second.workspace, second.asked, second.error) == ("the baseline (n = 1)", None, False, "")
    job = second.open()
    assert second.open() is job
    assert job.wait(PATIENCE)
    assert second.workspace.contract.n_parts == 1
    assert list(second.workspace.tasks) == list(workspace.tasks)
    assert second.open().value is second.workspace


def test_a_damaged_model_is_reported_and_may_be_tried_again(
    workspace: Workspace, one_part_model_file: Path, tmp_path: Path
) -> None:
    (second,) = workspace.beside
    (tmp_path / "baseline.onnx").write_bytes(b"no model")
    assert second.open().wait(PATIENCE)
    assert second.workspace is None
    assert "baseline.onnx" in second.error
    (tmp_path / "baseline.onnx").unlink()
    assert second.open().wait(PATIENCE)
    assert second.error == "There is no model file at baseline.onnx; check the path."
    shutil.copy(one_part_model_file, tmp_path / "baseline.onnx")
    assert second.open().wait(PATIENCE)
    assert second.workspace is not None
    assert second.error == ""


def test_a_model_given_at_the_start_is_open(
    data: Path, model_file: Path, one_part_model_file: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = shutil.copytree(data, tmp_path / "places")
    (data / "test" / "gallery_satellite" / "0007" / "photo.heic").write_bytes(b"")
    (second,) = open_model(data, model_file, beside=[ModelOptions(model=one_part_model_file)]).beside
    assert [record.getMessage() for record in caplog.records if record.name == "lpn.datasets.base"] == [
        "Left out of places: 1 picture, test/gallery_satellite/0007/photo.heic (is of a kind that is not read; save it as "
        "JPEG)."
    ]
    wait_until(lambda: second.workspace is not None)
    assert second.workspace.contract.n_parts == 1
    # Both files are called model.onnx.
    assert second.label == "/".join(one_part_model_file.parts[-3:])
    assert open_model(data, model_file).beside == []


@pytest.mark.parametrize("there", [True, False])
def test_the_demo_offers_its_baseline_where_the_file_is_there(
    there: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    baseline, given = tmp_path / "baseline.onnx", []
    if there:
        baseline.touch()
    monkeypatch.setattr(explorer.cli, "DEMO", tmp_path)
    monkeypatch.setattr(explorer.cli, "DEMO_BASELINE", baseline)
    monkeypatch.setattr(explorer.opening, "open_model", lambda *arguments: given.append(arguments))
    other = tmp_path / "other.onnx"
    for options in (Explore(), Explore(model=other), Explore(source=str(tmp_path), model=other)):
        options.opens_data()()
    assert [arguments[4] for arguments in given] == [baseline if there else None, None, None]


def test_the_kinds_of_both_models_may_be_named(
    data: Path, model_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Workspace] = []
    monkeypatch.setattr(explorer.app, "serve", lambda opening, *_: opened.append(opening.open_workspace()))
    state = {key: value for key, value in small_vector("camp").items() if key.startswith("model_1.convnext.")}
    weights = tmp_path / "weights.pth"
    torch.save(state, weights)
    (tmp_path / "opts.yaml").write_text("h: 32\nw: 32\n")
    Explore(source=str(data), model=weights, kind="camp", beside=(weights,), beside_kind=("dac",)).run()
    (workspace,) = opened
    assert workspace.contract.method == "CAMP"
    (second,) = workspace.beside
    assert (workspace.model_name, second.label) == ("weights.pth, camp", "weights.pth, dac")
    wait_until(lambda: second.workspace is not None)
    assert second.workspace.contract.method == "DAC"
    with pytest.raises(ModelFileError, match=r"is not a checkpoint of a known model: .* Name its method with --kind"):
        Explore(source=str(data), model=model_file, beside=(weights,)).run()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("explore DATA --model a.onnx --beside b.pth c.pth --beside-kind dac", "Found 1 kind for 2 models of --beside"),
        ("explore DATA --model a --beside b c --beside-pooling mean", "Found 1 pooling for 2 models of --beside"),
        ("explore DATA --beside-kind dac", "--beside-kind needs --beside"),
        ("failures DATA --model a.onnx --beside-kind dac", "--beside-kind needs --beside"),
        ("failures DATA --model a.onnx --beside-pooling mean", "--beside-pooling needs --beside"),
    ],
)
def test_kinds_and_poolings_are_of_each_model_beside(words: str, said: str, data: Path, refused: Refused) -> None:
    assert said in refused(*(data if word == "DATA" else word for word in words.split()))


def test_of_many_models_the_first_is_open_and_the_others_wait_for_a_browser(
    data: Path, model_file: Path, one_part_model_file: Path, tmp_path: Path
) -> None:
    two = small_worlds.make_model(tmp_path / "two", n_parts=2)
    workspace = open_model(data, model_file, beside=[ModelOptions(model=one_part_model_file), ModelOptions(model=two)])
    first, last = workspace.beside
    wait_until(lambda: first.workspace is not None)
    assert (last.workspace, last.asked, last.progress) == (None, False, (0, 0))
    assert last.open().wait(PATIENCE)
    assert last.workspace.contract.n_parts == 2
    pictures = len(workspace.tasks[TASK].queries) + len(workspace.tasks[TASK].gallery)
    assert last.progress[0] == last.progress[1] >= pictures


def test_a_model_that_is_given_twice_or_cannot_be_compared_ends_the_start(
    data: Path, model_file: Path, one_part_model_file: Path, tmp_path: Path
) -> None:
    for beside in ([model_file], [one_part_model_file, one_part_model_file]):
        with pytest.raises(InputError, match=r"model\.onnx is given twice; --model and --beside need different models"):
            open_model(data, model_file, beside=[ModelOptions(model=file) for file in beside])
    (tmp_path / "broken.onnx").write_bytes(b"no model")
    with pytest.raises(ModelFileError, match=r"broken\.onnx"):
        open_model(
            data,
            model_file,
            beside=[ModelOptions(model=one_part_model_file), ModelOptions(model=tmp_path / "broken.onnx")],
        )
    street = replace(RegionModel().contract, views=("satellite", "street"), groups=(), part_names={})
    with pytest.raises(DataError, match="knows only satellite and street pictures"):
        open_model(data, RegionModel(street))


def test_a_model_is_compared_with_itself_in_a_weather(data: Path, model_file: Path) -> None:
    workspace = open_model(data, model_file, beside_weathers=["dark"])
    (second,) = workspace.beside
    assert second.label == "model.onnx in the dark"
    assert second.open().wait(PATIENCE)
    dark = second.workspace
    assert list(dark.tasks) == [name for name in workspace.tasks if not name.startswith("satellite")]
    task = dark.tasks[TASK]
    change = Change(weather=Weather("dark"))
    analysis = answered(workspace, model="1", query=1).analysis
    assert analysis.query.descriptor == pytest.approx(task.query_descriptors[1], abs=1e-5)
    assert not np.allclose(analysis.query.descriptor, workspace.tasks[TASK].query_descriptors[1], atol=1e-2)
    result = changed(lazy_task(lpn.load(model_file), open_dataset(data), task.name), change).evaluate()
    assert [task.metrics["recall@1"], task.metrics["ap"]] == pytest.approx([result.recall["1"], result.ap])
    with pytest.raises(InputError, match="expected weathers other than normal, each once"):
        open_model(data, model_file, beside_weathers=["fog", "fog"])


def test_tokens_of_one_file_are_pooled_in_two_ways_beside_a_model(
    data: Path, model_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Workspace] = []
    monkeypatch.setattr(explorer.app, "serve", lambda opening, *_: opened.append(opening.open_workspace()))
    network = timm_networks.named_network("test_vit", (32, 32), own_size=True)
    torch.save(network.state_dict(), tmp_path / "weights.pth")
    (tmp_path / "opts.yaml").write_text("h: 32\nw: 32\n")
    weights = Path(f"timm:test_vit:{tmp_path / 'weights.pth'}")
    both = ("rings:3", "mean")
    Explore(source=str(data), model=model_file, beside=(weights, weights), beside_pooling=both).run()
    Explore(source=str(data), model=weights, pooling="gem").run()
    first, last = opened[0].beside
    assert [first.label, last.label] == ["weights.pth, rings:3", "weights.pth, mean"]
    wait_until(lambda: first.workspace is not None)
    assert (first.workspace.contract.n_parts, first.workspace.contract.level) == (3, "exact")
    assert opened[1].contract.method == "test_vit, gem"
    with pytest.raises(InputError, match="is given twice"):
        Explore(source=str(data), model=weights, pooling="mean", beside=(weights,), beside_pooling=("mean",)).run()
