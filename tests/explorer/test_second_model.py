"""The second model: offered for the demo, opened once on request, and shown in the tab "Two models"."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

import explorer.app
import explorer.cli
from explorer.cli import Explore
from explorer.explain_window.window import ExplainWindow
from explorer.opening import open_model
from explorer.session_state import SessionState
from explorer.workspace import StateAnalyser, Workspace
from lpn.analysis.task import Task
from lpn.core.errors import InputError
from tests.explorer.explain_window.test_window import WindowGui, make_window, wait_until
from tools.fixtures.published_models import small_vector

PATIENCE = 120.0


@pytest.fixture
def workspace(data: Path, model_file: Path, one_part_model_file: Path, tmp_path: Path) -> Workspace:
    """A workspace that offers the model of one part."""
    shutil.copy(one_part_model_file, tmp_path / "baseline.onnx")
    return open_model(data, model_file, baseline=tmp_path / "baseline.onnx")


def test_an_offered_model_is_opened_once_and_on_request(workspace: Workspace) -> None:
    second = workspace.second
    assert second is not None
    assert (second.label, second.workspace, second.opening, second.error) == ("the baseline (n = 1)", None, False, "")
    job = second.open()
    assert second.open() is job
    assert job.wait(PATIENCE)
    assert second.workspace is not None
    assert second.workspace.contract.n_parts == 1
    assert list(second.workspace.tasks) == list(workspace.tasks)
    assert second.open().value is second.workspace


def test_a_damaged_model_is_reported_and_may_be_tried_again(
    workspace: Workspace, one_part_model_file: Path, tmp_path: Path
) -> None:
    second = workspace.second
    assert second is not None
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


def test_a_model_given_at_the_start_is_open(data: Path, model_file: Path, one_part_model_file: Path) -> None:
    second = open_model(data, model_file, second_model=one_part_model_file).second
    assert second is not None
    wait_until(lambda: second.workspace is not None)
    assert second.workspace is not None
    assert second.workspace.contract.n_parts == 1
    assert second.label == "model.onnx"
    assert open_model(data, model_file).second is None


def test_the_tab_offers_the_model_opens_it_and_compares(workspace: Workspace) -> None:
    gui, tabs, errors = WindowGui(), [], []
    window: ExplainWindow = make_window(workspace, gui, errors, tabs.append)
    analysis = StateAnalyser(workspace).analyse(SessionState("drone-to-satellite", 4, why=True), 10)
    window.show(analysis)
    wait_until(lambda: "Compare with the baseline (n = 1)" in gui.shown("lpn-second-model"))
    expanded = gui.expanded
    window.compare_models()
    assert tabs == ["Two models"]
    assert gui.expanded == expanded + 1
    wait_until(lambda: "Baseline" in gui.shown("lpn-model-comparison"))
    page = gui.shown("lpn-model-comparison")
    assert all(said in page for said in ("n = 4", "n = 1", "baseline.onnx"))
    window.leave()
    assert errors == []


def test_another_task_begins_at_the_same_place(workspace: Workspace) -> None:
    tasks: dict[str, Task] = workspace.tasks
    label = int(tasks["drone-to-satellite"].query_labels[5])
    state = SessionState("drone-to-satellite", 4, query=5)
    query = workspace.same_place(state, "satellite-to-drone")
    assert int(tasks["satellite-to-drone"].query_labels[query]) == label


@pytest.mark.parametrize("there", [True, False])
def test_the_demo_offers_its_baseline_where_the_file_is_there(
    there: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    baseline, given = tmp_path / "baseline.onnx", []
    if there:
        baseline.touch()
    monkeypatch.setattr(explorer.cli, "DEMO", tmp_path)
    monkeypatch.setattr(explorer.cli, "DEMO_BASELINE", baseline)

    def run(*arguments: Any) -> None:
        given.append(arguments)

    monkeypatch.setattr(explorer.app, "run", run)
    Explore().run()
    Explore(model=tmp_path / "other.onnx").run()
    Explore(data=tmp_path, model=tmp_path / "other.onnx").run()
    assert [arguments[6] for arguments in given] == [baseline if there else None, None, None]


def test_a_model_whose_kind_is_named_is_opened_before_the_app(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []
    monkeypatch.setattr(explorer.app, "run", lambda *arguments: given.append(arguments[1]))
    state = {key: value for key, value in small_vector("camp").items() if key.startswith("model_1.convnext.")}
    torch.save(state, tmp_path / "weights.pth")
    Explore(data=tmp_path, model=tmp_path / "weights.pth", kind="camp").run()
    assert [model.contract.method for model in given] == ["CAMP"]
    with pytest.raises(InputError, match="give --kind with --model"):
        Explore(data=tmp_path, kind="camp").run()
