"""The ranks of a second model in the laboratory: its columns, filters, and the wait for them."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from explorer.feeds import Feeds
from explorer.compute import ranking_job
from explorer.failure_lab import map_data, messages, state, table
from explorer.failure_lab.map_page import MapPage
from explorer.failure_lab.service import FailureLab, Findings, SecondProgress
from explorer.failure_lab.state import LabState
from explorer.failure_lab.window import FailureLabWindow
from explorer.opening import open_model
from explorer.session_state import SessionState
from explorer.stage.viewport import Viewport
from explorer.workspace import LazyWorkspace, StateAnalyser, StateAnalysis, Workspace
from lpn.core.arrays import Int64Array
from lpn.datasets import open_dataset
from lpn.tasks import ranking_cache
from lpn.tasks.opening import describe_task
from tests.explorer.explain_window.test_window import WindowGui
from tests.explorer.failure_lab.conftest import TASK
from tools.fixtures.small_contracts import GateModel, RegionModel
from tools.fixtures.waiting import wait_until


@pytest.fixture(scope="module")
def two(workspace: Workspace) -> Workspace:
    """A model whose parts are regions of each picture (A), beside one whose parts are gates (B)."""
    opened = open_model(workspace.root, RegionModel())
    opened.beside = [LazyWorkspace("gates", lambda: open_model(workspace.root, GateModel()))]
    assert opened.beside[0].open().wait(120)
    return opened


@pytest.fixture(scope="module")
def ranks(two: Workspace) -> tuple[Int64Array, Int64Array]:
    """The ranks of both models from 0, each from its outcomes rather than from a ranking job."""
    assert two.beside[0].workspace is not None
    models = two.model, two.beside[0].workspace.model
    dataset = open_dataset(two.root)
    first, second = (describe_task(m.model, "", dataset, TASK).outcomes.rank for m in models if m is not None)
    # The untrained networks happen to differ; the tests need that.
    assert ((first == 0) & (second > 0)).any()
    assert ((first > 0) & (second == 0)).any()
    return first, second


def built(workspace: Workspace) -> Findings:
    service = FailureLab(workspace)
    assert service.build(TASK, None).wait(120)
    findings = service.findings(TASK)
    assert findings is not None
    return findings


def chosen(findings: Findings, lab: LabState) -> list[int]:
    return state.selected_rows(findings, lab).tolist()


def test_the_table_has_the_ranks_of_both_models(
    two: Workspace, ranks: tuple[Int64Array, Int64Array], lab: LabState
) -> None:
    findings = built(two)
    first, second = ranks
    for name, expected in (("rank A", first), ("rank B", second)):
        np.testing.assert_array_equal(findings.table.columns[name].values, expected + 1)
        rows = state.sorted_rows(findings, state.sort_by(lab, name))
        assert expected[rows].tolist() == sorted(expected.tolist())
    lines = list(csv.DictReader(io.StringIO(findings.table.to_csv(findings.table.rows()).decode())))
    assert [(line["rank A"], line["rank B"]) for line in lines] == [
        (str(a + 1), str(b + 1)) for a, b in zip(first, second, strict=True)
    ]
    assert not {"rank A", "rank B"} & {column.name for column in state.charted_columns(findings)}


def test_a_filter_takes_both_ranks_and_one_click_shows_what_one_model_finds(
    two: Workspace, ranks: tuple[Int64Array, Int64Array], lab: LabState
) -> None:
    findings = built(two)
    first, second = ranks
    only_a, only_b = np.flatnonzero((first == 0) & (second > 0)), np.flatnonzero((first > 0) & (second == 0))
    for typed, expected in (
        ("rank A > 1 and rank B = 1", only_b),
        ("RANK B > 1 and rank a = 1", only_a),
        ("rank B <= 3 and margin < 0", np.flatnonzero((second < 3) & (findings.outcomes.margin < 0))),
    ):
        filtered = messages.apply(messages.SetFilter(typed), lab, findings)
        assert filtered.filter_error == ""
        assert chosen(findings, filtered) == expected.tolist()
    wrong = state.set_filter(lab, "rank C = 1", findings.table)
    assert "There is no column 'rank C'" in wrong.filter_error
    assert "rank A, rank B" in wrong.filter_error
    clicked = {only: messages.apply(messages.ShowOutcome(only), lab, findings) for only in ("only A", "only B")}
    assert chosen(findings, clicked["only A"]) == only_a.tolist()
    assert chosen(findings, clicked["only B"]) == only_b.tolist()
    a, b = findings.second.names if findings.second is not None else ("", "")
    assert state.describe(findings, clicked["only B"]) == f"found by B ({b}) and not by A ({a}), sorted by margin"


def test_the_page_names_the_models_and_shows_both_ranks_in_place_of_one(
    two: Workspace, ranks: tuple[Int64Array, Int64Array], lab: LabState
) -> None:
    findings = built(two)
    assert two.beside[0].workspace is not None
    names = two.model_name, two.beside[0].workspace.model_name
    bar = table.bar(findings, lab, 3)
    for letter, name, count in zip(
        "AB", names, ((ranks[0] == 0) & (ranks[1] > 0), (ranks[1] == 0) & (ranks[0] > 0)), strict=True
    ):
        assert f"only {letter} ({name}) {count.sum()}" in " ".join(bar.split())
    assert f"A: {names[0]}, B: {names[1]}" in table.summary(findings, lab, findings.table.rows())
    html = table.table(findings, lab, 13, 1, 300)
    heads = [head.strip() for head in re.findall(r'click to sort"><span[^>]*>([^<▲▼]*)', html)]
    assert heads[:4] == ["name", "rank A", "rank B", "margin"]
    assert "rank" not in heads
    assert f"Rank of the nearest true tile by {names[1]}" in html
    assert "rank A &gt; 1 and rank B = 1" in table.search_boxes(findings, lab)
    # A column that is always shown is no choice, and is shown once where it was a choice before.
    assert "rank B" not in table.column_choice(findings, lab)
    again = replace(lab, columns=("rank B", "weather"))
    assert table.table(findings, again, 13, 1, 300).count(">rank B") == 1


def test_one_model_alone_has_neither_column_nor_choice(workspace: Workspace, findings: Findings, lab: LabState) -> None:
    assert not {"rank A", "rank B"} & set(findings.table.columns)
    assert "only" not in table.bar(findings, lab, 3)
    # A choice that a task does not offer, after a change of the task, shows all its queries.
    assert chosen(findings, replace(lab, outcome="only B")) == list(range(13))
    assert state.describe(findings, replace(lab, outcome="only B")) == "all, sorted by margin"
    assert FailureLab(workspace).join_second(TASK, None) == SecondProgress()


def test_ranks_are_those_of_the_model_that_is_compared(workspace: Workspace) -> None:
    opened = open_model(workspace.root, RegionModel())
    others = GateModel(), GateModel(seed=7)
    opened.beside = [
        LazyWorkspace(name, lambda model=model: open_model(workspace.root, model))  # type: ignore[misc]
        for name, model in zip(("one", "two"), others, strict=True)
    ]
    assert all(one.open().wait(120) for one in opened.beside)
    service, dataset = FailureLab(opened), open_dataset(workspace.root)
    assert service.build(TASK, None).wait(120)
    for beside, model in [*enumerate(others), (0, others[0])]:
        findings = service.findings(TASK, beside)
        assert findings is not None
        ranks = describe_task(model, "", dataset, TASK).outcomes.rank
        np.testing.assert_array_equal(findings.table.columns["rank B"].values, ranks + 1)
        assert service.findings(TASK, beside) is findings
    # There is no third one.
    alone = service.findings(TASK, 2)
    assert alone is not None
    assert alone.second is None


def window_of(waiting: Workspace) -> tuple[FailureLabWindow, WindowGui, StateAnalysis]:
    """Open the laboratory on a workspace, and ask for the second model's ranks."""
    gui, client = WindowGui(), SimpleNamespace()
    client.gui = gui
    window = FailureLabWindow(
        client,  # type: ignore[arg-type]
        waiting,
        FailureLab(waiting),
        Feeds(waiting),
        lambda _: None,
        Viewport(),
        SimpleNamespace(),  # type: ignore[arg-type]
    )
    analysis = StateAnalyser(waiting).analyse(SessionState(TASK, 4, lab=True), 10)
    window.show(analysis)
    wait_until(lambda: "Compare the ranks with the other" in gui.shown("lpn-lab-second"))
    window.receive(messages.OpenSecond())
    return window, gui, analysis


def test_a_filter_on_the_ranks_of_one_model_is_refused_until_those_of_the_next_are_known(
    waiting: Workspace, held: tuple[Event, Event]
) -> None:
    held[1].set()
    waiting.beside = [*waiting.beside, LazyWorkspace("the next", lambda: open_model(waiting.root, GateModel(seed=7)))]
    window, gui, analysis = window_of(waiting)
    wait_until(lambda: "rank B" in gui.shown("lpn-lab-table"))
    window.receive(messages.SetFilter("rank B > 1"))
    wait_until(lambda: window._lab.filter == "rank B > 1")
    window.show(replace(analysis, state=replace(analysis.state, beside=1)))
    wait_until(lambda: "There is no column" in gui.shown("lpn-lab-count"))
    wait_until(lambda: "Compare the ranks with the next" in gui.shown("lpn-lab-second"))
    order = window.order(replace(analysis.state, beside=1))
    assert order is not None
    assert len(order) == 13
    window.leave()


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Event, Event]]:
    """Rankings of new workspaces wait in the background until the second event is set; the first says that one has begun."""
    begun, go = Event(), Event()
    finish = ranking_cache.ResumableRanking.finish

    def wait(self: Any, report: Any) -> Any:
        report(5, 13)
        begun.set()
        assert go.wait(120)
        report(6, 13)
        return finish(self, report)

    monkeypatch.setattr(ranking_job, "QUICK_COST", -1)
    monkeypatch.setattr(ranking_cache, "load", lambda _: None)
    monkeypatch.setattr(ranking_cache.ResumableRanking, "finish", wait)
    yield begun, go
    go.set()


@pytest.fixture
def waiting(workspace: Workspace) -> Iterator[Workspace]:
    """The laboratory's workspace of an LPN, ranked, which offers a second model on request."""
    workspace.beside = [LazyWorkspace("the other", lambda: open_model(workspace.root, GateModel()))]
    yield workspace
    workspace.beside = []


def test_ranks_that_are_computed_in_the_background_join_the_table(
    waiting: Workspace, findings: Findings, service: FailureLab, held: tuple[Event, Event]
) -> None:
    begun, go = held
    assert service.join_second(TASK, "one") == SecondProgress(offered="the other")
    service.open_second()
    assert waiting.beside[0].open().wait(120)
    assert service.join_second(TASK, "one").pending
    assert begun.wait(120)
    assert service.join_second(TASK, "one") == SecondProgress("rank B: ranking 5 of 13 queries", True, "", 5, 13)
    assert findings.second is None
    assert service.findings(TASK) is findings  # the page has its table meanwhile
    go.set()
    wait_until(lambda: service.join_second(TASK, "one") == SecondProgress())
    newest = service.findings(TASK)
    assert newest is not None
    assert {"rank A", "rank B"} < set(newest.table.columns)
    assert service.findings(TASK) is newest
    note = newest.table.paths[0]
    service.set_note(note, "seen", "")
    try:
        noted = service.findings(TASK)
        assert noted is not None
        assert "rank B" in noted.table.columns
    finally:
        service.notes.unlink()


def test_the_last_browser_that_leaves_cancels_the_ranking(
    waiting: Workspace, service: FailureLab, held: tuple[Event, Event]
) -> None:
    begun, go = held
    service.open_second()
    assert waiting.beside[0].open().wait(120)
    assert waiting.beside[0].workspace is not None
    ranking = waiting.beside[0].workspace.rankings[TASK]
    service.join_second(TASK, "one")
    assert begun.wait(120)
    service.leave_second("one")
    go.set()
    job = ranking._job
    assert job is not None
    assert job.wait(120)
    assert job.cancelled
    assert ranking.result is None


def test_a_second_model_that_cannot_be_opened_says_why(
    workspace: Workspace, service: FailureLab, monkeypatch: pytest.MonkeyPatch
) -> None:
    second = LazyWorkspace("the other", lambda: open_model(workspace.root, Path("other.onnx")))
    monkeypatch.setattr(workspace, "beside", [second])
    service.open_second()
    assert second.open().wait(120)
    progress = service.join_second(TASK, None)
    assert not progress.pending
    assert "the other is not open" in progress.text
    assert "other.onnx" in progress.text
    assert "Try again" in table.second_progress(progress)


def test_the_window_shows_the_wait_and_then_the_ranks(waiting: Workspace, held: tuple[Event, Event]) -> None:
    begun, go = held
    window, gui, _ = window_of(waiting)
    assert begun.wait(120)
    wait_until(lambda: "rank B: ranking 5 of 13 queries" in gui.shown("lpn-lab-second"))
    assert 'value="5" max="13"' in gui.shown("lpn-lab-second")
    assert "rank B" not in gui.shown("lpn-lab-table")
    go.set()
    wait_until(lambda: "rank B" in gui.shown("lpn-lab-table"))
    wait_until(lambda: not gui.shown("lpn-lab-second"))
    assert f"B: {GateModel().contract.method}" in gui.shown("lpn-lab-models")
    window.leave()


def test_the_maps_of_both_models_stand_side_by_side_and_share_what_is_selected(two: Workspace, lab: LabState) -> None:
    service = FailureLab(two)
    assert service.build(TASK, None).wait(120)
    findings = service.findings(TASK)
    assert findings is not None
    lab = messages.apply(messages.ShowBothMaps(True), lab, findings)
    view = MapPage(service, Feeds(two), "me")
    drawn = view.page(findings, lab, 0, findings.table.rows(), (760, 500), offered=True)
    for _ in range(50):
        if drawn.final:
            break
        drawn = view.page(findings, lab, 0, findings.table.rows(), (760, 500), offered=True)
    assert findings.second is not None
    assert [drawn.maps.count(name) for name in findings.second.names] == [1, 1]
    assert drawn.maps.count("<canvas") == 6
    first, second = view._points, view._second
    assert first is not None
    assert second is not None
    assert first.tiles.shape == second.tiles.shape
    assert not np.allclose(first.queries, second.queries)
    # A lasso on the second map selects by that map, and replaces the one on the first.
    left = [(-2.0, -2.0), (0.0, -2.0), (0.0, 2.0), (-2.0, 2.0)]
    for number, points in enumerate((first, second)):
        lab = view.select_lasso(lab, messages.SelectLasso("pca", left, number > 0))
        places = np.frombuffer(map_data.plane(points), "<f4").reshape(-1, 2)[: len(points.queries)]
        assert chosen(findings, lab) == np.flatnonzero(places[:, 0] < 0).tolist()
    assert len(lab.selections) == 1


def test_models_under_two_scorings_are_not_compared_without_a_word(two: Workspace, lab: LabState) -> None:
    findings = built(two)
    assert findings.second is not None
    rows = findings.table.rows()
    assert "lpn-lab-scorings" not in table.summary(findings, lab, rows)
    apart = replace(findings, second=replace(findings.second, scorings=("csls", "plain")))
    said = table.summary(apart, lab, rows)
    assert "A is ranked by CSLS, and B plain: their ranks do not differ by the models alone." in said
    assert "lpn.send(&#34;scoring&#34;,&#34;plain&#34;)" in said
