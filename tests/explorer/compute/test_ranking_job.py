"""Rankings in the background: start, progress, cancellation, and cache."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from explorer.compute import ranking_job
from explorer.opening import open_model
from explorer.screen.fields import opening
from explorer.screen.rail import Rail
from explorer.workspace import Workspace
from lpn.core.errors import LPNError
from tools.fixtures import small_worlds
from tools.fixtures.waiting import TIMEOUT

TASK = "drone-to-satellite"


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A data set that counts as too large to be ranked before the first page is served."""
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(ranking_job, "QUICK_COST", 0)
    return small_worlds.map_dataset(small_worlds.make_dataset(tmp_path / "places", train=1, test=9))


@pytest.fixture
def workspace(data: Path, model_file: Path) -> Workspace:
    return open_model(data, model_file)


def test_a_ranking_in_the_background_equals_one_at_the_start(
    data: Path, workspace: Workspace, model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ranking = workspace.rankings[TASK]
    assert ranking.result is None
    job = ranking.join("me")
    assert job is ranking.join("you")
    assert job.wait(TIMEOUT)
    assert job.error is None
    monkeypatch.setattr(ranking_job, "QUICK_COST", 10**12)
    quick = open_model(data, model_file).rankings[TASK]
    assert ranking.results == quick.results
    assert "median error m" in ranking.results
    np.testing.assert_array_equal(ranking.ranks, quick.ranks)


def test_nothing_is_marked_before_the_ranking_is_done(workspace: Workspace) -> None:
    ranking, feeds = workspace.rankings[TASK], workspace.feeds
    state = opening(workspace)
    assert Rail().message(replace(state, filter="missed"), workspace, ranking, feeds)["total"] == 0
    assert not workspace.graded(ranking).any()
    assert ranking.join("me").wait(TIMEOUT)
    assert Rail().message(state, workspace, ranking, feeds)["missed"] == int(ranking.failed.sum())
    assert workspace.graded(ranking).all()


def test_a_ranking_without_clients_stops_and_starts_again(workspace: Workspace) -> None:
    ranking = workspace.rankings[TASK]
    with ranking._rank_lock:  # keeps it from starting
        cancelled = ranking.join("me")
        ranking.leave("me")
        going = ranking.join("you")
    assert cancelled.wait(TIMEOUT)
    assert cancelled.cancelled
    assert ranking.error == ""
    assert going.wait(TIMEOUT)
    assert ranking.result is not None


def test_a_failed_ranking_can_start_again(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    ranking = workspace.rankings[TASK]
    with monkeypatch.context() as patched:
        patched.setattr(ranking_job, "TaskRanking", lambda *_: 1 / 0)
        with pytest.raises(LPNError, match="ZeroDivisionError"):
            ranking.wait("me", lambda *_: None)
    assert ranking.wait("me", lambda *_: None) is ranking.result
