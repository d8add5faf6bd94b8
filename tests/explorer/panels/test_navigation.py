"""Tests of the steps from one query or task to another."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from explorer.opening import open_model
from explorer.panels.navigation import Navigation
from explorer.session_state import SessionState
from lpn.analysis.analyser import OwnPicture


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
