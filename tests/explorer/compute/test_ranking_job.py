from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from explorer.compute import ranking_job
from explorer.compute.ranking_progress import RankingProgress
from explorer.explain_window import model_comparison
from explorer.failure_lab.service import Laboratory
from explorer.opening import open_model
from explorer.panels import pages
from explorer.workspace import Task, Workspace
from lpn.core.errors import LPNError
from lpn.retrieval import ranking_cache
from tools.fixtures import small_worlds

TASK = "drone-to-satellite"


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A data set that takes too long to be ranked before the first page is served."""
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(ranking_job, "QUICK", 0)
    monkeypatch.setattr(ranking_cache, "STEP", 2)
    return small_worlds.map_dataset(small_worlds.make_dataset(tmp_path / "places", train=1, test=9))


@pytest.fixture
def workspace(data: Path, model_file: Path) -> Workspace:
    return open_model(data, model_file)


def at_once(data: Path, model_file: Path, monkeypatch: pytest.MonkeyPatch) -> Task:
    monkeypatch.setattr(ranking_job, "QUICK", 10**12)
    return open_model(data, model_file).tasks[TASK]


def until(true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_long_rankings_are_made_when_somebody_waits_and_are_the_same(
    data: Path, workspace: Workspace, model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = workspace.tasks[TASK]
    assert task.found is None
    job = task.standing.ask("me")
    assert job is task.standing.ask("you")
    assert job.wait(20)
    assert job.flaw is None
    quick = at_once(data, model_file, monkeypatch)
    assert task.results == quick.results
    assert "median error m" in task.results
    np.testing.assert_array_equal(task.ranks, quick.ranks)


def test_the_next_start_has_them_at_once_unless_a_picture_changed(
    data: Path, workspace: Workspace, model_file: Path
) -> None:
    assert workspace.tasks[TASK].standing.ask("me").wait(20)
    again = open_model(data, model_file).tasks
    assert again[TASK].results == workspace.tasks[TASK].results
    assert again["satellite-to-drone"].found is None
    file = workspace.tasks[TASK].queries[3].path
    small_worlds.write(file, small_worlds.place(99))
    assert open_model(data, model_file).tasks[TASK].found is None


def test_pages_say_how_far_it_is_and_mark_nothing_that_is_not_known(workspace: Workspace) -> None:
    task = workspace.tasks[TASK]
    buttons = [f"b{i}" for i in range(4)]
    assert "Results: ranking 0 of 9 queries" in pages.header(workspace, task)
    before = pages.picker(workspace, task, [0, 1], 0, 0, 1, buttons)
    assert not any(sign in before for sign in ("✓", "✗"))
    assert "when both have ranked" in model_comparison._changes(task, task, ("a", "b"), workspace)
    assert task.standing.ask("me").wait(20)
    assert "R@1" in pages.header(workspace, task)
    assert any(sign in pages.picker(workspace, task, [0, 1], 0, 0, 1, buttons) for sign in ("✓", "✗"))
    assert "alone finds" in model_comparison._changes(task, task, ("a", "b"), workspace)


def test_a_ranking_that_nobody_waits_for_stands_still_and_goes_on(workspace: Workspace) -> None:
    task = workspace.tasks[TASK]
    with task.standing._turn:  # so that it cannot begin
        given_up = task.standing.ask("me")
        task.standing.leave("me")
        going = task.standing.ask("you")
    assert given_up.wait(20)
    assert given_up.given_up
    assert task.standing.flaw == ""
    assert going.wait(20)
    assert task.found is not None


def test_the_laboratory_waits_for_the_same_ranking(workspace: Workspace) -> None:
    laboratory, task = Laboratory(workspace), workspace.tasks[TASK]
    job = laboratory.build(TASK, "me")
    assert job.wait(20)
    assert job.flaw is None
    found = laboratory.findings(TASK)
    assert found is not None
    np.testing.assert_array_equal(found.outcomes.rank, task.ranks)


def test_a_page_is_told_of_progress_and_of_the_end(workspace: Workspace) -> None:
    one, other = workspace.tasks.values()
    told, ends = [], threading.Semaphore(0)
    follower = RankingProgress(lambda task: told.append(task.name), ends.release)
    follower.follow(one, other)
    for _ in range(2):
        assert ends.acquire(timeout=20)
    assert one.found is not None
    assert other.found is not None
    assert set(told) == {one.name}
    follower.follow(other)
    until(lambda: follower._thread is None)


def test_a_page_that_is_gone_waits_no_longer(workspace: Workspace) -> None:
    task = workspace.tasks[TASK]
    ended: list[int] = []
    follower = RankingProgress(lambda _: None, lambda: ended.append(1))
    with task.standing._turn:
        follower.follow(task)
        until(lambda: task.standing._job is not None)
        job = task.standing.ask("me")
        task.standing.leave("me")
        follower.leave()
    assert job.wait(20)
    assert job.given_up
    assert not ended
    until(lambda: follower._thread is None)
    follower.follow(task)  # an answer that was under way when it left
    assert follower._thread is None
    assert task.standing._job is job


def test_a_ranking_that_fails_is_said_and_not_begun_again_and_again(workspace: Workspace) -> None:
    task = workspace.tasks[TASK]
    spoilt = np.array(task.descriptors)
    spoilt[0, 0, 0] = np.nan
    broken = ranking_job.RankingJob(ranking_cache.Sides(task.asked, spoilt, task.query_labels, task.labels), None)
    with pytest.raises(LPNError, match="not finite"):
        broken.wait("me", lambda *_: None)
    assert "not finite" in broken.flaw


def test_a_ranking_that_failed_once_can_be_asked_for_again(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = workspace.tasks[TASK]
    with monkeypatch.context() as patched:
        patched.setattr(ranking_cache, "keep", lambda *_: 1 / 0)
        with pytest.raises(LPNError, match="ZeroDivisionError"):
            task.standing.wait("me", lambda *_: None)
    assert task.standing.wait("me", lambda *_: None) is task.standing.found


def test_a_page_whose_telling_fails_can_follow_again(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    task, told = workspace.tasks[TASK], []

    def tell(shown: Task) -> None:
        told.append(shown)
        if threading.current_thread().name == "explorer-follower" and len(told) < 3:
            raise RuntimeError("the page is not there yet")

    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    ended = threading.Event()
    follower = RankingProgress(tell, ended.set)
    follower.follow(task)
    until(lambda: follower._thread is None)
    follower.follow(task)
    assert task.found is not None or ended.wait(20)
