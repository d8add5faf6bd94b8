"""The tab "Two models": both models' pictures, their shares in the centre, and the choice among several models."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from explorer.compute.request_context import RequestContext
from explorer.explain_window import messages
from explorer.explain_window.model_comparison import ModelComparison
from explorer.opening import open_model
from explorer.session_state import SessionState
from explorer.url_state import UrlState
from explorer.web.messages import decode
from explorer.workspace import LazyWorkspace, StateAnalyser, StateAnalysis, Workspace
from lpn.core.errors import InputError
from lpn.core.progress import report_progress
from lpn.drawing import charts
from lpn.drawing.charts import ModelPoint
from lpn.drawing.words import speaking
from lpn.explain.centre import centre_share
from lpn.sources import ModelOptions
from tests.explorer.explain_window.test_window import WindowGui, make_window, wait_until
from tools.fixtures import small_worlds
from tools.fixtures.small_contracts import PartsModel, RegionModel

TASK = "drone-to-satellite"


@pytest.fixture(scope="module")
def workspace(
    data: Path, model_file: Path, one_part_model_file: Path, tmp_path_factory: pytest.TempPathFactory
) -> Workspace:
    """A model of four parts beside which stand one of one part, and one of two parts and other pixels."""
    two = small_worlds.make_model(tmp_path_factory.mktemp("two"), n_parts=2, size=96)
    return open_model(data, model_file, beside=[ModelOptions(model=one_part_model_file), ModelOptions(model=two)])


@pytest.fixture
def comparison(workspace: Workspace) -> Iterator[ModelComparison]:
    made = ModelComparison(workspace, RequestContext(workspace.inference))
    yield made
    made.leave()


def analysed(workspace: Workspace, **changes: Any) -> StateAnalysis:
    state = SessionState(TASK, 4, why=True, why_tab="models")
    return StateAnalyser(workspace).analyse(replace(state, **changes), 10)


def settled(comparison: ModelComparison, state: SessionState) -> None:
    """Wait until all models are open and ranked."""
    wait_until(lambda: comparison.advance(state) is None)


def maps_of(page: str) -> list[str]:
    return re.findall('data-side="[^"]*".*?src="([^"]*)"', page, re.DOTALL)


def test_both_models_show_query_and_tile_with_their_shares_in_the_centre(
    workspace: Workspace, comparison: ModelComparison
) -> None:
    analysis = analysed(workspace, selected=3, beside=1)
    settled(comparison, analysis.state)
    page = comparison.page(analysis)
    assert len(set(maps_of(page))) == 4
    shares = [float(share) for share in re.findall(r"([\d.]+) %</b> in the box", page)]
    other = workspace.beside[1].workspace
    assert other is not None
    expected = []
    for one in (workspace, other):
        task = one.tasks[TASK]
        described = StateAnalyser(one).analyse(SessionState(TASK, one.contract.n_parts, selected=3), 1)
        assert described.chosen.index == 3  # the same tile
        assert task.gallery[3].path == analysis.task.gallery[3].path
        for side in (described.query, described.tile):
            assert side.trace is not None
            expected.append(100 * centre_share(side.trace.activation))
    np.testing.assert_allclose(shares, expected, atol=0.051)
    assert page.count(f'tile <span class="dim">{analysis.task.gallery[3].name}') == 2


def test_plain_words_name_pictures_and_scoring_as_the_page_does(
    workspace: Workspace, comparison: ModelComparison
) -> None:
    analysis = analysed(workspace)
    settled(comparison, analysis.state)
    # The page ranks by CSLS, and the second model does not.
    analysis = replace(analysis, task=replace(analysis.task, neighbours=5))
    expert = comparison.page(analysis)
    with speaking(workspace.vocabulary(True)):
        plain = comparison.page(analysis)
    assert re.findall("<figcaption>(query|tile|picture|answer) <span", expert) == ["query", "tile"] * 2
    assert re.findall("<figcaption>(query|tile|picture|answer) <span", plain) == ["picture", "answer"] * 2
    assert "Models are compared as plain here" in expert
    assert "Pictures are compared as they are here, because they are not adjusted for all models." in plain
    assert not re.search("channel sum|activation of|calibrated|R@1", plain)


def test_one_switch_shows_evidence_and_one_gives_all_pictures_one_scale(
    workspace: Workspace, comparison: ModelComparison
) -> None:
    settled(comparison, analysed(workspace).state)
    scales = {}
    for kind in ("activation", "evidence"):
        for same in (False, True):
            page = comparison.page(analysed(workspace, beside=1, heat_kind=kind, same_scale=same))
            assert re.search(f'class="chosen"[^>]*maps[^>]*{kind}', page)
            scales[kind, same] = re.findall('aria-label="scale ([^"]*)"', page)
            assert len(set(maps_of(page))) == 4
            assert ('"checkbox" checked' in page) == same
    assert len(set(scales["activation", False])) == 4
    assert len(set(scales["evidence", False])) == 2  # a cell for the pair has one meaning on both sides
    assert len(set(scales["activation", True])) == len(set(scales["evidence", True])) == 1


def test_several_models_are_drawn_over_what_they_differ_in_and_a_click_chooses_one(
    workspace: Workspace, comparison: ModelComparison
) -> None:
    analysis = analysed(workspace)
    settled(comparison, analysis.state)
    page = comparison.page(analysis)
    assert re.findall('aria-label="R@1 of the whole task, % by ([^"]*)"', page) == [
        "number of parts n",
        "input size in pixels",
    ]
    recalls = [
        one.rankings[TASK].results["recall@1"]
        for one in (workspace, *(lazy.workspace for lazy in workspace.beside))
        if one is not None
    ]
    for (n, recall), role in zip(zip((4, 1, 2), recalls, strict=True), ("own", "compared", "other"), strict=True):
        assert re.search(f'class="model {role}"[^>]*: {n}, {recall:.1f} %"', page)
    # The workspace's own model is A already.
    assert 'class="model own" role="img"' in page
    assert "n = 1" in page
    chosen = comparison.page(analysed(workspace, beside=1))
    assert "n = 2" in chosen
    assert re.search('class="model compared"[^>]*beside[^>]*1', chosen)
    assert len(set(maps_of(chosen))) == 4


def test_models_open_one_at_a_time_and_the_chosen_one_first(data: Path, model_file: Path) -> None:
    opened = open_model(data, model_file)
    started: list[str] = []

    def failing(name: str) -> LazyWorkspace:
        def opens() -> Workspace:
            report_progress("Describing", 3, 7)
            started.append(name)
            raise InputError(f"{name} is broken.")

        return LazyWorkspace(name, opens)

    opened.beside = [failing("one"), failing("two")]
    comparison = ModelComparison(opened, RequestContext(opened.inference))
    analysis = analysed(opened, beside=1)
    page = comparison.page(analysis)
    assert len(maps_of(page)) == 2  # the model's own pictures wait for nothing
    assert "Opening two: its file and the data set are read." in comparison.live(analysis.state)
    wait_until(lambda: comparison.advance(analysis.state) is None)
    assert started == ["two", "one"]
    page = comparison.page(analysis)
    assert "two is broken." in page
    assert "Try again" in page
    assert "not opened" in page
    comparison.open(analysis.state)
    wait_until(lambda: started == ["two", "one", "two"])
    comparison.leave()


def test_a_model_without_cells_and_one_of_other_views_say_so_in_a_sentence(data: Path) -> None:
    opened = open_model(data, RegionModel())
    opened.beside = [LazyWorkspace("parts", lambda: open_model(data, PartsModel(RegionModel())))]
    comparison = ModelComparison(opened, RequestContext(opened.inference))
    analysis = analysed(opened)
    settled(comparison, analysis.state)
    page = comparison.page(analysis)
    assert len(maps_of(page)) == 2
    other = opened.beside[0].workspace
    assert other is not None
    assert other.without_cells in page.replace("&#39;", "'")
    assert "B" not in {text[:1] for text in re.findall("([AB]) (?:query|tile)", comparison.live(analysis.state))}
    del other.rankings[TASK], other.tasks[TASK]
    assert f"does not know the views of {TASK}; choose another task." in comparison.page(analysis)
    comparison.leave()


def test_messages_choose_model_and_maps(workspace: Workspace) -> None:
    gui, errors, states = WindowGui(), [], [SessionState(TASK, 4, why=True)]
    window = make_window(workspace, gui, errors, change=lambda change: states.append(change(states[-1]) or states[-1]))
    for kind, value in (("beside", 1), ("beside", 2), ("maps", "evidence")):
        message = decode(messages.ExplainMessage, kind, value)
        assert message is not None
        window.receive(message)
    assert (states[-1].beside, states[-1].heat_kind) == (1, "evidence")
    assert decode(messages.ExplainMessage, "beside", -1) is None
    assert decode(messages.ExplainMessage, "maps", "nothing") is None
    labels = [label for label, _ in window.commands() if label.startswith("Compare with")]
    assert labels == [f"Compare with {one.label}" for one in workspace.beside]
    window.leave()
    assert errors == []


def test_an_address_names_the_model_that_is_compared(workspace: Workspace) -> None:
    url, state = UrlState(workspace), SessionState(TASK, 4, why=True, why_tab="models", beside=1)
    text = url.write(state)
    assert "beside=" in text
    assert url.read(text, SessionState(TASK, 4)) == (state, [])
    assert "beside" not in url.write(replace(state, beside=0))
    _, problems = url.read("beside=nothing", state)
    assert problems == [f"beside=nothing: expected {' or '.join(one.label for one in workspace.beside)}."]


def test_a_chart_of_models_has_even_steps_and_a_line_where_each_has_one_model() -> None:
    points = [ModelPoint(i, f"m{i}", n, str(n), 10.0 * i, "other") for i, n in enumerate((1, 8, 2))]
    drawn = charts.model_chart(points, "R@1", "n", lambda point: f'data-key="{point.key}"')  # type: ignore[arg-type,return-value]
    spots = [(float(x), float(y)) for x, y in re.findall('cx="([^"]*)" cy="([^"]*)" r="6"', drawn)]
    assert [x for x, _ in spots] == sorted(x for x, _ in spots)
    assert spots[1][0] - spots[0][0] == pytest.approx(spots[2][0] - spots[1][0], abs=0.11)
    heights = dict(zip((0, 2, 1), (y for _, y in spots), strict=True))
    assert heights[0] > heights[1] > heights[2]  # a higher percentage is drawn higher
    assert "<polyline" in drawn
    apart = charts.model_chart(points, "R@1", "n", lambda _: "", joined=False)  # type: ignore[arg-type,return-value]
    assert "<polyline" not in apart
    twice = charts.model_chart([*points, replace(points[0], percent=50.0)], "R@1", "n", lambda _: "")  # type: ignore[arg-type,return-value]
    assert "<polyline" not in twice
