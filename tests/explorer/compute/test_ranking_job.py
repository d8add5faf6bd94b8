from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from explorer.compute import ranking_job
from explorer.compute.ranking_job import RankingJob
from explorer.compute.ranking_progress import RankingProgress
from explorer.explain_window import model_comparison
from explorer.failure_lab.service import FailureLab
from explorer.opening import open_model
from explorer.panels import pages
from explorer.workspace import Workspace
from lpn.analysis import ranking_cache
from lpn.core.errors import LPNError
from tools.fixtures import small_worlds

TASK = "drone-to-satellite"


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A data set that takes too long to be ranked before the first page is served."""
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(ranking_job, "QUICK_COST", 0)
    monkeypatch.setattr(ranking_cache, "STEP", 2)
    return small_worlds.map_dataset(small_worlds.make_dataset(tmp_path / "places", train=1, test=9))


@pytest.fixture
def workspace(data: Path, model_file: Path) -> Workspace:
    return open_model(data, model_file)


def at_once(data: Path, model_file: Path, monkeypatch: pytest.MonkeyPatch) -> RankingJob:
    monkeypatch.setattr(ranking_job, "QUICK_COST", 10**12)
    return open_model(data, model_file).rankings[TASK]


def until(true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 120
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_long_rankings_are_made_when_somebody_waits_and_are_the_same(
    data: Path, workspace: Workspace, model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ranking = workspace.rankings[TASK]
    assert ranking.result is None
    job = ranking.join("me")
    assert job is ranking.join("you")
    assert job.wait(120)
    assert job.error is None
    quick = at_once(data, model_file, monkeypatch)
    assert ranking.results == quick.results
    assert "median error m" in ranking.results
    np.testing.assert_array_equal(ranking.ranks, quick.ranks)


def test_the_next_start_has_them_at_once_unless_a_picture_changed(
    data: Path, workspace: Workspace, model_file: Path
) -> None:
    assert workspace.rankings[TASK].join("me").wait(120)
    again = open_model(data, model_file).rankings
    assert again[TASK].results == workspace.rankings[TASK].results
    assert again["satellite-to-drone"].result is None
    file = workspace.tasks[TASK].queries[3].path
    small_worlds.write(file, small_worlds.place(99))
    assert open_model(data, model_file).rankings[TASK].result is None


def test_pages_say_how_far_it_is_and_mark_nothing_that_is_not_known(workspace: Workspace) -> None:
    ranking = workspace.rankings[TASK]
    buttons = [f"b{i}" for i in range(4)]
    assert "Results: ranking 0 of 9 queries" in pages.header(workspace, ranking.task)
    before = pages.picker(workspace, ranking.task, [0, 1], 0, 0, 1, buttons)
    assert not any(sign in before for sign in ("✓", "✗"))
    assert model_comparison.changes(ranking, ranking) is None
    assert ranking.join("me").wait(120)
    assert "R@1" in pages.header(workspace, ranking.task)
    assert any(sign in pages.picker(workspace, ranking.task, [0, 1], 0, 0, 1, buttons) for sign in ("✓", "✗"))
    assert model_comparison.changes(ranking, ranking) is not None


def test_a_ranking_that_nobody_waits_for_stands_still_and_goes_on(workspace: Workspace) -> None:
    ranking = workspace.rankings[TASK]
    with ranking._turn:  # so that it cannot begin
        given_up = ranking.join("me")
        ranking.leave("me")
        going = ranking.join("you")
    assert given_up.wait(120)
    assert given_up.cancelled
    assert ranking.error == ""
    assert going.wait(120)
    assert ranking.result is not None


def test_the_laboratory_waits_for_the_same_ranking(workspace: Workspace) -> None:
    laboratory, ranking = FailureLab(workspace), workspace.rankings[TASK]
    job = laboratory.build(TASK, "me")
    assert job.wait(120)
    assert job.error is None
    found = laboratory.findings(TASK)
    assert found is not None
    np.testing.assert_array_equal(found.outcomes.rank, ranking.ranks)


def test_a_page_is_told_of_progress_and_of_the_end(workspace: Workspace) -> None:
    one, other = workspace.rankings.values()
    told, ends = [], threading.Semaphore(0)
    progress = RankingProgress(lambda ranking: told.append(ranking.task.name), ends.release)
    progress.follow(one, other)
    for _ in range(2):
        assert ends.acquire(timeout=120)
    assert one.result is not None
    assert other.result is not None
    assert set(told) == {one.task.name}
    progress.follow(other)
    until(lambda: progress._thread is None)


def test_a_page_that_is_gone_waits_no_longer(workspace: Workspace) -> None:
    ranking = workspace.rankings[TASK]
    ended: list[int] = []
    progress = RankingProgress(lambda _: None, lambda: ended.append(1))
    with ranking._turn:
        progress.follow(ranking)
        until(lambda: ranking._job is not None)
        job = ranking.join("me")
        ranking.leave("me")
        progress.close()
    assert job.wait(120)
    assert job.cancelled
    assert not ended
    until(lambda: progress._thread is None)
    progress.follow(ranking)  # an answer that was under way when it left
    assert progress._thread is None
    assert ranking._job is job


def test_a_ranking_that_fails_is_said_and_not_begun_again_and_again(workspace: Workspace) -> None:
    ranking = workspace.rankings[TASK]
    damaged = np.array(ranking.task.gallery_descriptors)
    damaged[0, 0, 0] = np.nan
    broken = ranking_job.RankingJob(replace(ranking.task, gallery_descriptors=damaged, geometry=None))
    with pytest.raises(LPNError, match="not finite"):
        broken.wait("me", lambda *_: None)
    assert "not finite" in broken.error


def test_a_ranking_that_failed_once_can_be_asked_for_again(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    ranking = workspace.rankings[TASK]
    with monkeypatch.context() as patched:
        patched.setattr(ranking_cache, "save", lambda *_: 1 / 0)
        with pytest.raises(LPNError, match="ZeroDivisionError"):
            ranking.wait("me", lambda *_: None)
    assert ranking.wait("me", lambda *_: None) is ranking.result


def test_a_page_whose_telling_fails_can_follow_again(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    ranking, told = workspace.rankings[TASK], []

    def tell(shown: RankingJob) -> None:
        told.append(shown)
        if threading.current_thread().name == "explorer-ranking" and len(told) < 3:
            raise RuntimeError("the page is not there yet")

    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    ended = threading.Event()
    progress = RankingProgress(tell, ended.set)
    progress.follow(ranking)
    until(lambda: progress._thread is None)
    progress.follow(ranking)
    assert ranking.result is not None or ended.wait(120)
