"""Whole tasks under part weights and with turned queries: shared, superseded, cancelled, one at a time."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest

from explorer.client.services import WorkspaceServices
from explorer.compute import turned_jobs, weight_figures
from explorer.compute.turned_jobs import TurnedJobs
from explorer.compute.weight_figures import WeightFigures
from explorer.opening import open_model
from explorer.workspace import Workspace
from lpn.analysis.part_weights import WeightedTask
from lpn.core.progress import report_progress
from lpn.drawing.charts import TaskRecall
from lpn.tasks.changes import turned
from lpn.tasks.task import Task
from tools.fixtures import small_worlds
from tools.fixtures.waiting import TIMEOUT

TASK, REVERSE = "drone-to-satellite", "satellite-to-drone"


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory, model_file: Path) -> Workspace:
    folder = tmp_path_factory.mktemp("whole")
    return open_model(small_worlds.make_dataset(folder / "places", train=1, test=13), model_file)


def test_figures_are_computed_once_for_equal_proportions(workspace: Workspace) -> None:
    figures, client = WeightFigures(workspace.tasks.__getitem__), object()
    assert figures.known(TASK, (1, 0, 1, 1)) is None
    job = figures.join(client, TASK, (1, 0, 1, 1))
    assert job.wait(TIMEOUT)
    assert job.value == WeightedTask(workspace.tasks[TASK]).effect((1, 0, 1, 1))
    assert figures.known(TASK, (2, 0, 2, 2)) is job.value


def test_all_combinations_of_both_directions_are_counted_and_kept(workspace: Workspace) -> None:
    figures = WeightFigures(workspace.tasks.__getitem__)
    job = figures.join_all(object(), (TASK, REVERSE))
    assert job.wait(TIMEOUT)
    assert (job.done, job.total, job.error) == (30, 30, None)
    assert figures.known(REVERSE, (0, 0, 1, 1)) is not None


def test_combinations_that_the_cache_has_lost_are_computed_again(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(weight_figures, "_KEPT", 15)
    figures, client = WeightFigures(workspace.tasks.__getitem__), object()
    assert figures.join_all(client, (TASK,)).wait(TIMEOUT)
    assert figures.join(client, TASK, (1, 2, 3, 4)).wait(TIMEOUT)
    assert figures.known(TASK, (1, 0, 0, 0)) is None
    again = figures.join_all(client, (TASK,))
    assert again.wait(TIMEOUT)
    assert again.done == 15
    assert figures.known(TASK, (1, 0, 0, 0)) is not None


def test_weights_that_moved_on_are_not_computed_to_the_end(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, go_on = threading.Event(), threading.Event()

    class Slow(WeightedTask):
        def effect(self, weights: Any, progress: Any = None) -> Any:
            begun.set()
            assert go_on.wait(TIMEOUT)
            progress(1, 2)
            return super().effect(weights, progress)

    monkeypatch.setattr(weight_figures, "WeightedTask", Slow)
    figures, client, other = WeightFigures(workspace.tasks.__getitem__), object(), object()
    first = figures.join(client, TASK, (1, 1, 0, 0))
    assert begun.wait(TIMEOUT)
    figures.leave(client)
    second = figures.join(client, TASK, (0, 1, 0, 0))
    shared = figures.join(other, TASK, (0, 1, 0, 0))
    assert shared is second
    go_on.set()
    assert first.wait(TIMEOUT)
    assert second.wait(TIMEOUT)
    assert first.cancelled
    assert figures.known(TASK, (1, 1, 0, 0)) is None
    assert figures.known(TASK, (0, 1, 0, 0)) is second.value is not None


def turned_of(workspace: Workspace) -> TurnedJobs:
    return WorkspaceServices.of(workspace).turned


def test_turned_queries_pass_through_the_queue_and_are_kept(workspace: Workspace) -> None:
    jobs = turned_of(workspace)
    job = jobs.join(object(), TASK, (0, 90, -90))
    assert job.wait(TIMEOUT)
    assert job.error is None
    assert (job.done, job.total) == (26, 26)
    assert [one.degrees for one in jobs.known(TASK)] == [0, 90, 270]
    expected = turned(workspace.tasks[TASK], 90).metrics
    assert jobs.known(TASK)[1] == TaskRecall(90, expected["recall@1"], expected["ap"])
    again = jobs.join(object(), TASK, (90,))
    assert again.wait(TIMEOUT)
    assert again.total == 0


def test_one_job_turns_queries_at_a_time_and_equal_ones_are_shared(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    started, go_on, running = threading.Event(), threading.Event(), []

    def slow(task: Task, degrees: float) -> Task:
        running.append(degrees)
        started.set()
        while not go_on.wait(0.01):
            report_progress("Describing", 0, 13)
        return task

    monkeypatch.setattr(turned_jobs, "turned", slow)
    jobs, first, second, third = turned_of(workspace), object(), object(), object()
    job = jobs.join(first, TASK, (30,))
    assert started.wait(TIMEOUT)
    assert jobs.join(second, TASK, (390,)) is job
    waiting = jobs.join(third, TASK, (60,))
    assert not waiting.wait(0.3)
    assert running == [30]
    jobs.leave(first)
    assert not job.cancelled  # the second browser waits still
    jobs.leave(third)
    assert waiting.wait(TIMEOUT)
    assert waiting.error == "The computation was cancelled."
    jobs.leave(second)
    assert job.wait(TIMEOUT)
    assert job.cancelled
    assert running == [30]
    go_on.set()
    last = jobs.join(third, TASK, (60,))
    assert last.wait(TIMEOUT)
    assert [one.degrees for one in jobs.known(TASK)] == [60]
