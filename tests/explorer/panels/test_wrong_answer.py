"""Tests of the page of wrong answers, and of the steps to it and back."""

from __future__ import annotations

import re
from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np
import pytest

from explorer import session_state
from explorer.opening import open_model
from explorer.panels import first_screen, wrong_answer
from explorer.panels.navigation import Navigation
from explorer.session_state import SessionState
from explorer.url_state import UrlState
from explorer.workspace import StateAnalyser, Workspace
from lpn.core.tables import number_column
from lpn.datasets.geo import Position
from lpn.drawing.words import speaking
from lpn.library.analyser import OwnPicture
from lpn.tasks.gallery_geometry import GalleryGeometry

TASK = "drone-to-satellite"


@pytest.fixture(scope="module")
def workspace(data: Path, model_file: Path) -> Workspace:
    workspace = open_model(data, model_file)
    workspace.rankings[TASK].wait(workspace, lambda *_: None)
    return workspace


def text(html: str) -> str:
    return unescape(" ".join(re.sub(r"<[^>]*>", " ", html).split()))


def page(workspace: Workspace, state: SessionState) -> str:
    with speaking(workspace.vocabulary(True)):
        return first_screen.page(StateAnalyser(workspace).analyse(state, 10), workspace)


def test_each_wrong_answer_has_its_pictures_and_a_reason(workspace: Workspace) -> None:
    start = SessionState(TASK, 4, first_screen=True, plain=True)
    rows = wrong_answer.rows(workspace, start)
    assert rows is not None
    assert len(rows) > 1
    last = session_state.show_fails(start, int(rows[-1]), len(workspace.tasks[TASK].queries))
    html = page(workspace, last)
    assert html.count("data:image/jpeg") == 3
    said = text(html)
    graded = len(workspace.tasks[TASK].queries)
    assert f"The first answer is wrong for {len(rows)} of {graded} pictures" in said
    assert f"{len(rows)} of {len(rows)}, the worst first" in said
    assert "chose another place; the right one came " in said
    assert f"{StateAnalyser(workspace).analyse(last, 10).verdict.headline}." in said
    # A right answer is none of them, and neither is a reason.
    right = int(np.flatnonzero(~workspace.rankings[TASK].failed)[0])
    assert "Where it fails" not in page(workspace, replace(last, query=right)).split("</h1>")[0]
    assert "local pattern network), cuts each picture" in text(page(workspace, replace(last, why=True))).lower()


def test_kinds_that_fail_more_often_are_named(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    known = workspace.outcomes(workspace.tasks[TASK])
    assert known is not None
    outcomes, table = known
    low = np.where(outcomes.failed, 50.0, 200.0)
    state = SessionState(
        TASK, 4, query=int(np.flatnonzero(outcomes.failed)[0]), first_screen=True, plain=True, fails=True
    )
    for heights, said in (
        (low, "Pictures whose height of the drone is 50 m: 2 of 2 are wrong, against 0 of 12 others."),
        (
            np.where(np.arange(len(low)) % 2, 50.0, 200.0),
            "With so few, no kind of picture fails more often than by chance.",
        ),
    ):
        columns = table.with_columns([number_column("altitude", heights.tolist(), "m")])
        monkeypatch.setattr(workspace, "outcomes", lambda _, columns=columns: (outcomes, columns))
        shown = text(page(workspace, state))
        assert said in shown
        assert 'class="reason"' not in page(workspace, state), "a reason takes focus and sight"
        assert ("It is of a kind that fails more often: pictures whose height" in shown) == (heights is low)


def test_the_answer_s_direction_is_that_of_the_positions(workspace: Workspace) -> None:
    state = SessionState(TASK, 4, first_screen=True, plain=True)
    rows = wrong_answer.rows(workspace, state)
    assert rows is not None
    analysis = StateAnalyser(workspace).analyse(replace(state, query=int(rows[0])), 10)
    task = analysis.task
    tiles = [Position(46.0, 8.0)] * len(task.gallery)
    tiles[analysis.matches[0].index] = Position(46.0, 8.01)
    geometry = GalleryGeometry.of([Position(46.0, 8.0)] * len(task.queries), tiles)
    placed = replace(analysis, task=replace(task, geometry=geometry), errors_m=geometry.errors_m(int(rows[0])))
    assert "chose one that lies 772 m to the east;" in wrong_answer._sentence(placed, "the right one")


def test_the_steps_go_around_and_lead_back_to_what_was_shown(workspace: Workspace) -> None:
    navigation = Navigation(workspace, lambda *_: None)
    start = SessionState(TASK, 4, query=1, first_screen=True, plain=True)
    rows = wrong_answer.rows(workspace, start)
    assert rows is not None
    queries = len(workspace.tasks[TASK].queries)
    state = first = session_state.show_fails(start, int(rows[0]), queries)
    seen = []
    for _ in rows:
        seen.append(state.query)
        state = navigation.next(state)
    assert (seen, state) == (rows.tolist(), first)
    assert navigation.previous(first).query == rows[-1]
    assert session_state.to_first_screen(navigation.next(first)) == start
    own = replace(start, upload=OwnPicture("mine", np.zeros((2, 2, 3), np.uint8)))
    shown = session_state.show_fails(own, int(rows[0]), queries)
    assert shown.upload is None
    assert session_state.to_first_screen(shown) == own
    # The laboratory leads back to them, any other choice of a picture ends them, and a link opens them.
    leave = session_state.leave_first_screen
    lab = leave(first, replace(first, lab=True))
    assert leave(lab, replace(lab, lab=False)) == first
    assert not navigation.next(lab).first_screen  # what lies over the laboratory stays away
    assert not session_state.choose_query(first, 0, queries).fails
    assert not leave(first, replace(first, upload=own.upload)).fails
    links = UrlState(workspace)
    again, problems = links.read(links.write(first), replace(start, query=0))
    assert (again, problems) == (replace(first, came_from=None), [])
