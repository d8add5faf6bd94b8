"""First screen, laboratory, and report count the same photos of a flight as right, as wrong, and as not graded."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from explorer import judge, reports, session_state
from explorer.compute.request_context import RequestContext
from explorer.explain_window.model_comparison import ModelComparison
from explorer.failure_lab import state, table
from explorer.failure_lab.service import FailureLab, Findings
from explorer.failure_lab.state import LabState
from explorer.flight_window.service import FlightService
from explorer.opening import OFFERED_OVERLAP, open_offered_flight
from explorer.panels import answer_text, first_screen, pages, wrong_answer
from explorer.panels.navigation import Navigation
from explorer.session_state import SessionState
from explorer.workspace import LazyWorkspace, StateAnalyser, Workspace
from lpn.cli.main import main
from lpn.core.demo import DEMO_ANSWERS, DEMO_FLIGHT, DEMO_MODEL, DEMO_PLACE
from lpn.drawing.words import speaking
from lpn.locate.belief import FlightVerdicts
from lpn.locate.located import LocatedFlight
from lpn.locate.source import FlightSource

TASK = "drone-to-satellite"
PATIENCE = 120.0
# The photos of the shipped flight whose details judge them and are contradicted, and the wrong answers besides.
DOUBTFUL, WRONG = {7, 9, 11, 20}, {0, 3, 16, 28}
PHOTOS = 30


def opened(basemap: Path, flight: Path) -> Workspace:
    place = open_offered_flight(basemap, flight, DEMO_MODEL, shipped=basemap.with_name(DEMO_ANSWERS))
    assert place.registration is not None
    assert place.registration.wait(PATIENCE)
    return place


@pytest.fixture(scope="module")
def workspace() -> Iterator[Workspace]:
    place = opened(*DEMO_PLACE)
    yield place
    assert place.basemap is not None
    place.basemap.close()


@pytest.fixture(scope="module")
def findings(workspace: Workspace) -> Findings:
    lab = FailureLab(workspace)
    assert lab.build(TASK, lab).wait(PATIENCE)
    found = lab.findings(TASK)
    assert found is not None
    return found


def text(html: str) -> str:
    return unescape(" ".join(re.sub(r"<[^>]*>", " ", html.partition("</style>")[2] or html).split()))


def test_the_first_screen_counts_photos_whose_judge_is_in_doubt_neither_as_right_nor_as_wrong(
    workspace: Workspace,
) -> None:
    ranking = workspace.rankings[TASK]
    assert set(np.flatnonzero(~workspace.graded(ranking)).tolist()) == DOUBTFUL
    right, graded = workspace.counts(ranking)
    assert (graded - right, graded) == (len(WRONG), PHOTOS - len(DOUBTFUL))
    start = SessionState(TASK, workspace.contract.n_parts, query=workspace.first_query, first_screen=True, plain=True)
    rows = wrong_answer.rows(workspace, start)
    assert rows is not None
    assert set(rows.tolist()) == WRONG
    with speaking(workspace.vocabulary(True)):
        page = first_screen.page(StateAnalyser(workspace).analyse(start, 10), workspace)
        assert "The next of 4" in page
        assert "of 26 graded photos, 22 were right by their look alone" in text(page)
        fails = session_state.show_fails(start, int(rows[0]), PHOTOS)
        page = first_screen.page(StateAnalyser(workspace).analyse(fails, 10), workspace)
        assert "the first answer is wrong for 4 of 26 graded pictures (15 %)." in text(page)
        assert "84.6 % of 26 graded pictures right" in text(pages.header(workspace, workspace.tasks[TASK]))
    result = ranking.result
    assert result is not None
    assert result.errors is not None
    counted = np.delete(result.errors, sorted(DOUBTFUL))
    within, of_all = 100 * np.mean(counted <= 50), 100 * np.mean(result.errors <= 50)
    assert f"{within:.1f}" != f"{of_all:.1f}"
    expert = text(pages.header(workspace, workspace.tasks[TASK]))
    assert f"within 50 m {within:.1f} %" in expert
    assert "84.6 % drone → map , 30 queries (26 graded), " in expert
    navigation, seen = Navigation(workspace, lambda *_: None), [start]
    for _ in range(5):
        after = navigation.next_failure(seen[-1])
        assert after is not None
        seen.append(after)
    assert {one.query for one in seen[1:]} == WRONG
    assert {one.query for _ in range(40) if (one := navigation.failure(start)) is not None} <= WRONG


def test_the_errors_of_placed_photos_stand_behind_their_count() -> None:
    rendered = opened(*DEMO_FLIGHT)
    start = SessionState(TASK, rendered.contract.n_parts, query=rendered.first_query, first_screen=True)
    page = text(first_screen.page(StateAnalyser(rendered).analyse(start, 10), rendered))
    assert re.search(
        r"; their details placed 28 of 40, at most \d+\.\d m from their true places(, \d+ of them in doubt)?; "
        r"\d+( more)? could not be checked away from the middle\.",
        page,
    )
    assert rendered.basemap is not None
    rendered.basemap.close()


def test_the_laboratory_counts_as_the_first_screen_does(workspace: Workspace, findings: Findings) -> None:
    rows = np.arange(PHOTOS)
    np.testing.assert_array_equal(findings.graded.known, workspace.graded(workspace.rankings[TASK]))
    said = text(table.summary(findings, LabState(task=TASK), rows))
    assert "30 of 30 queries, 4 failed (15.4 %) of retrieval, 4 not graded" in said
    assert set(state.selected_rows(findings, LabState(task=TASK, outcome="failed")).tolist()) == WRONG
    unknown = findings.outcomes.known.copy()
    unknown[1] = False
    blind = replace(findings, outcomes=replace(findings.outcomes, known=unknown))
    assert "4 failed (16.0 %) of retrieval, 5 not graded" in text(table.summary(blind, LabState(task=TASK), rows))


def test_two_models_are_compared_over_the_graded_photos(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    other = copy.copy(workspace)  # as the flight is opened for a second model: its photos are not laid over the map
    assert other.flight is not None
    other.flight = replace(other.flight, frames=[replace(one, stages={}) for one in other.flight.frames])
    other.rankings = {TASK: copy.copy(workspace.rankings[TASK])}
    own = workspace.rankings[TASK].result
    assert own is not None
    first = own.ranking.first.copy()
    first[[7, 9, 1]] = 1 - np.minimum(first[[7, 9, 1]], 1)  # two in doubt, and one that is right
    assert first[1] == 1
    other.rankings[TASK].result = replace(own, ranking=replace(own.ranking, first=first))
    monkeypatch.setattr(workspace, "beside", [LazyWorkspace("two", lambda: other)])
    assert workspace.beside[0].open().wait(PATIENCE)
    comparison = ModelComparison(workspace, RequestContext(workspace.inference))
    analysis = StateAnalyser(workspace).analyse(SessionState(TASK, workspace.contract.n_parts, why=True), 10)
    said = text(comparison.page(analysis))
    assert "Of 26 graded queries, lpn.onnx alone finds 1 and lpn.onnx alone 0." in said
    assert (said.count("R@1 84.6 %"), said.count("R@1 80.8 %")) == (1, 1)
    comparison.leave()


def test_reports_count_as_the_first_screen_does(
    workspace: Workspace, findings: Findings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_app = reports.of_selection(workspace, findings.task, list(range(PHOTOS)), "all")[1].decode()
    locate = FlightSource.locate
    shipped: dict[str, Any] = {"overlap": OFFERED_OVERLAP, "shipped": DEMO_PLACE[0].with_name(DEMO_ANSWERS)}

    def as_in_app(source: FlightSource, _: float | None, *args: Any) -> Any:
        names, weights = args
        return locate(source, names=names, weights=weights, **shipped)

    monkeypatch.setattr(FlightSource, "locate", as_in_app)
    command = ["report", str(DEMO_PLACE[1]), "--map", str(DEMO_PLACE[0])]
    command += ["--model", str(DEMO_MODEL), "--out", str(tmp_path / "r.html")]
    assert main([*command, "--where", "seconds >= 0", "--matches", "1"]) == 0
    by_command = (tmp_path / "r.html").read_text()
    for page in (in_app, by_command):
        said = text(page)
        assert "That is right for 22 of the 26 photos whose place is known for certain." in said
        assert "30 queries (26 of known place, for certain, which are graded)" in said
        assert said.count("It is not graded, as no tile is right for certain") == len(DOUBTFUL)
        assert "84.6 % R@1" in said
    assert main([*command, "--matches", "1"]) == 0
    said = text((tmp_path / "r.html").read_text())
    assert "the worst of 4 failures, lowest margin first" in said
    assert main([*command, "--matches", "1", "--no-register"]) == 0
    said = text((tmp_path / "r.html").read_text())
    assert "the worst of 5 failures, lowest margin first" in said, "without registration no judge is in doubt"


@pytest.mark.parametrize(("query", "sure"), [(7, True), (1, False)])
def test_the_answer_that_a_report_shows_does_not_change_what_counts(
    workspace: Workspace, query: int, sure: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(judge, "is_sure", lambda *_: sure)  # as of an answer to a changed photo
    start = SessionState(TASK, workspace.contract.n_parts, query=query)
    said = text(reports.of_analysis(workspace, StateAnalyser(workspace).analyse(start, 10))[1].decode())
    assert "30 queries (26 of known place, for certain, which are graded)" in said
    assert "84.6 % R@1" in said
    assert ("It is not graded, as no tile is right for certain" in said) == (not sure)


def test_a_flight_is_judged_once_for_each_state_of_its_registration(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged: list[LocatedFlight] = []
    monkeypatch.setattr(FlightVerdicts, "of", lambda flight, of=FlightVerdicts.of: judged.append(flight) or of(flight))
    assert workspace.flight is not None
    monkeypatch.setattr(workspace, "flight", replace(workspace.flight))
    ranking = workspace.rankings[TASK]
    for _ in range(3):
        assert "(1 here)" in answer_text.doubts(workspace)
        assert int(workspace.graded(ranking).sum()) == PHOTOS - len(DOUBTFUL)
    view = FlightService(workspace).view()
    assert view.beliefs is FlightService(workspace).view().beliefs
    assert judged == [workspace.flight]
    frames = [
        replace(one, stages={name: answer for name, answer in one.stages.items() if name != "registration"})
        for one in workspace.flight.frames
    ]
    monkeypatch.setattr(workspace, "flight", replace(workspace.flight, frames=frames))
    assert answer_text.doubts(workspace) == ""
    assert workspace.graded(ranking).all(), "without registration no judge is in doubt"
    assert len(judged) == 2
