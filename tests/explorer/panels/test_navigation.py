"""Tests of the steps from one query or task to another."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from explorer.browse.query_list import entries
from explorer.compute.ranking_job import RankingJob
from explorer.opening import open_model
from explorer.panels.navigation import Navigation
from explorer.session_state import SessionState
from lpn.datasets import Truth
from lpn.library.analyser import OwnPicture


def test_a_task_goes_on_where_it_was_left_and_closes_ones_own_picture(data: Path, model_file: Path) -> None:
    workspace, notices = open_model(data, model_file), []
    for name, task in workspace.tasks.items():  # two queries show each place
        workspace.tasks[name] = replace(task, query_labels=task.query_labels // 2)
    drone = workspace.tasks["drone-to-satellite"].query_labels
    navigation = Navigation(workspace, lambda title, _: notices.append(title))
    there, back = (navigation.choose_task(name) for name in ("satellite-to-drone", "drone-to-satellite"))
    same = np.flatnonzero(drone == drone[6])
    before = SessionState("drone-to-satellite", 4, query=int(same[-1]))
    assert same[0] < before.query
    satellite = there(before)
    assert satellite is not None
    again = back(satellite)
    assert again is not None
    assert (again.task, again.query) == ("drone-to-satellite", before.query)
    assert notices == []
    own = there(SessionState("drone-to-satellite", 4, upload=OwnPicture("mine", np.zeros((2, 2, 3), np.uint8))))
    assert own is not None
    assert own.upload is None
    assert notices == ["Your picture is closed"]


def test_a_query_without_a_true_tile_is_a_failure_in_every_count(data: Path, model_file: Path) -> None:
    workspace, notices = open_model(data, model_file), []
    name, task = next(iter(workspace.tasks.items()))
    workspace.tasks[name] = task = replace(task, query_labels=task.query_labels + 10_000)
    workspace.rankings[name] = ranking = RankingJob(task)
    ranking.start()
    state = SessionState(name, 4)
    chosen = Navigation(workspace, lambda title, _: notices.append(title)).failure(state)
    assert chosen is not None
    assert chosen.query != state.query
    assert notices == []
    assert ranking.results["recall@1"] == task.metrics["recall@1"] == 0
    assert ranking.failed.all()
    np.testing.assert_array_equal(ranking.failed, task.outcomes.failed)
    assert [right for _, _, right in entries(ranking, [0, 1], workspace.graded(ranking))] == [0, 0]


def test_a_query_whose_place_is_not_known_is_no_failure(data: Path, model_file: Path) -> None:
    workspace, notices = open_model(data, model_file), []
    name, task = next(iter(workspace.tasks.items()))
    none = np.zeros(0, np.int64)
    workspace.tasks[name] = task = replace(task, truth=[Truth(none, none, known=False)] * len(task.queries))
    workspace.rankings[name] = ranking = RankingJob(task)
    ranking.start()
    assert not ranking.failed.any()
    assert Navigation(workspace, lambda title, _: notices.append(title)).failure(SessionState(name, 4)) is None
    assert notices == ["Nothing is known"]
