"""The explain window: its tabs, and its answers to messages from the page."""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from threading import Event, Thread
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from explorer import session_state
from explorer.client.services import WorkspaceServices
from explorer.compute.request_context import RequestContext
from explorer.explain_window import activation, comparison, evidence, messages, region, sweep_page
from explorer.explain_window import window as window_module
from explorer.explain_window.messages import ExplainMessage
from explorer.explain_window.sweep_request import SweepRequest
from explorer.explain_window.window import ExplainWindow
from explorer.opening import open_model
from explorer.session_state import SessionState, StateChange
from explorer.stage.viewport import Viewport
from explorer.web.messages import decode
from explorer.workspace import StateAnalyser, StateAnalysis, Workspace
from lpn import explain
from lpn.analysis.comparison import Comparison
from lpn.core.numbers import signed
from lpn.descriptors.transforms import Change
from lpn.descriptors.weather import WEATHERS, Weather
from lpn.drawing import verdicts
from lpn.drawing.words import speaking
from lpn.explain import sweeps
from lpn.explain.counterfactual import Effect
from lpn.library.analyser import OwnPicture
from tools.fixtures import small_worlds
from tools.fixtures.rankings import ranked_in
from tools.fixtures.waiting import wait_until


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory, model_file: Any) -> Workspace:
    folder = tmp_path_factory.mktemp("reasons")
    return open_model(small_worlds.make_dataset(folder / "places", train=1, test=13), model_file)


def analysed(workspace: Workspace, **changes: Any) -> StateAnalysis:
    state = SessionState("drone-to-satellite", 4, why=True)
    return StateAnalyser(workspace).analyse(replace(state, **changes), 10)


def compared(analysis: StateAnalysis) -> Comparison | None:
    return Comparison.of(analysis.ranking, analysis.chosen)


def data_of(html: str, name: str) -> list[Any]:
    """The values that the page's script reads, of both pictures."""
    return [json.loads(found) for found in re.findall(f"data-{name}='([^']*)'", html)]


def test_evidence_is_computed_for_those_who_look(workspace: Workspace) -> None:
    assert analysed(workspace, why=False).pair_evidence is None
    assert analysed(workspace, why=False, heat_kind="evidence").pair_evidence is not None
    assert analysed(workspace, why=False, heat_kind="evidence", heat=False).pair_evidence is None
    analysis = analysed(workspace)
    assert analysis.pair_evidence is not None
    assert analysis.pair_evidence.evidence.score == pytest.approx(analysis.chosen.score, abs=1e-5)


def test_the_page_holds_every_cell_and_its_mate(workspace: Workspace) -> None:
    analysis = analysed(workspace, weights=(1.0, 1.0, 0.5, 0.0))
    assert analysis.pair_evidence is not None
    found, html = analysis.pair_evidence.evidence, evidence.page(analysis, workspace)
    cells = data_of(html, "cells")
    for held, side in zip(cells, (found.query, found.tile), strict=True):
        np.testing.assert_allclose(held, side.score_map(found.weights).reshape(-1), atol=6e-6)
        assert sum(held) + side.constants @ found.weights == pytest.approx(analysis.chosen.score, abs=1e-3)
    assert [len(correspondences) for correspondences in data_of(html, "correspondences")] == [16, 16]
    of_part = evidence.page(analysed(workspace, heat_part=1), workspace)
    assert data_of(of_part, "cells") != cells
    assert signed(found.score) in html


def test_heatmaps_hold_the_channel_sum_of_each_part_s_cells(workspace: Workspace) -> None:
    analysis = analysed(workspace)
    assert analysis.query.trace is not None
    assert analysis.tile.trace is not None
    html = activation.page(analysis, workspace)
    held = [json.loads(found) for found in re.findall('data-cells="([^"]*)"', html)]
    assert len(held) == 2 * 4
    for side, described in enumerate((analysis.query, analysis.tile)):
        assert described.trace is not None
        total = described.trace.features[0].sum(axis=0).ravel()
        for part in range(4):
            cells = np.array(held[2 * part + side], float)
            inside = ~np.isnan(cells)
            weights = workspace.contract.partition(analysis.task.views[side]).weights(4, 4)
            np.testing.assert_array_equal(inside, weights[part].ravel() > 0)
            np.testing.assert_allclose(cells[inside], total[inside], rtol=1e-3)
    assert '"checkbox" checked' not in html
    same = activation.page(analysed(workspace, same_scale=True), workspace)
    assert '"checkbox" checked' in same
    scales = re.findall('aria-label="scale ([^"]*)"', same)
    assert len(scales) == 8
    assert scales[::2] == scales[1::2]
    own = re.findall('aria-label="scale ([^"]*)"', html)
    assert own[::2] != own[1::2]


def test_heatmaps_of_a_wrong_tile_have_those_of_the_true_one_below_and_lie_over_the_pictures_on_request(
    workspace: Workspace,
) -> None:
    late = int(np.argmax(workspace.rankings["drone-to-satellite"].ranks))
    analysis = analysed(workspace, query=late)
    assert analysis.positive is not None
    html = activation.page(analysis, workspace, workspace.tile(analysis.task, analysis.positive.index))
    assert re.findall('data-side="([^"]*)"', html)[:3] == ["query", "tile", "true tile"]
    with speaking(workspace.vocabulary(True)):
        plain = activation.page(analysis, workspace, workspace.tile(analysis.task, analysis.positive.index))
    assert re.findall('data-side="([^"]*)"', plain)[:3] == ["picture", "answer", "right picture"]
    assert "Same scale for picture and answer" in plain
    assert html.count("data:image/png") == 2 * html.count("data-cells") == 24, "a heatmap and its colours"
    over = activation.page(analysed(workspace, query=late, heat_over=True), workspace)
    assert over.count("data:image/jpeg") == 2 + over.count("data-cells") == 10


def test_a_comparison_is_between_the_positive_and_the_chosen_tile(workspace: Workspace) -> None:
    ranks = workspace.rankings["drone-to-satellite"].ranks
    late = int(np.argmax(ranks))
    assert ranks[late] > 0
    pair = compared(analysed(workspace, query=late))
    assert pair is not None
    assert (pair.followed.true, pair.other.rank) == (True, 1)
    # A chosen positive is compared with the hardest negative.
    pair = compared(analysed(workspace, query=late, selected="truth"))
    assert pair is not None
    assert (pair.followed.true, pair.other.rank) == (True, 1)
    # An uploaded picture has no known positive, so the chosen tile is followed.
    own = analysed(workspace, upload=OwnPicture("own", small_worlds.place(50)), selected=3)
    pair = compared(own)
    assert pair is not None
    assert pair.followed.index == 3
    assert pair.without is not None


def test_the_comparison_shows_the_margin_and_the_smallest_change(workspace: Workspace) -> None:
    ranks = workspace.rankings["drone-to-satellite"].ranks
    for query in np.flatnonzero(ranks > 0):
        analysis = analysed(workspace, query=int(query))
        pair = compared(analysis)
        assert pair is not None
        html = comparison.page(analysis, workspace, pair, None, False)
        behind = round(pair.other.distance2, 3) - round(pair.followed.distance2, 3)  # as both stand in the page
        assert f"{-behind:.3f} (d²) behind" in html
        assert html.count('class="chart step"') == 5
        assert "gold places of the query speak for the true tile" in " ".join(re.sub("<[^>]*>", "", html).split())
        assert html.count("<img") == 4, "the query is painted by the lead"
        assert "All places together make the sum of" in " ".join(re.sub("<[^>]*>", "", html).split())
        if pair.change is None:
            assert "No part weights at all" in html
            continue
        assert "The smallest change" in html
        effect = Effect(50.0, 40.0, np.array([1]), np.array([2, 3]), 13)
        assert "it harms" in comparison.page(analysis, workspace, pair, effect, False)
    first = analysed(workspace, query=int(np.flatnonzero(ranks == 0)[0]))
    assert "first already" in comparison.page(first, workspace, compared(first), None, False)


def test_a_profile_is_drawn_from_its_first_point(workspace: Workspace) -> None:
    assert workspace.model is not None
    analysis = analysed(workspace)
    task = analysis.task
    changes = sweeps.changes_over("rotation", 45)
    ranked = ranked_in(
        task.gallery_descriptors, analysis.ranking.weights, task.gallery_labels, int(task.query_labels[0])
    )
    steps = sweeps.sweep_points(workspace.model, analysis.source, "drone", changes, ranked)
    points = [next(steps)]
    one = sweep_page.page(analysis, "rotation", sweeps.SweepResult("rotation", tuple(points)), 8, workspace.part_names)
    assert 'data-done="1" data-of="8"' in one
    assert "Cancel" in one
    assert "The conclusions follow when all 8 steps are there" in one
    assert "clockwise from north" not in one
    points += list(steps)
    whole = sweep_page.page(
        analysis, "rotation", sweeps.SweepResult("rotation", tuple(points)), 8, workspace.part_names
    )
    assert "Cancel" not in whole
    assert "conclusions follow" not in whole
    assert re.search(r"Best for the true tile: .*, d² [\d.]+ \(score [\d.]+\)", whole)
    assert "Positive turns are counter-clockwise" in whole
    assert whole.count('class="point"') == 2 * (8 + 1)
    assert "clockwise from north" in whole
    assert "Choose what to change" in sweep_page.page(analysis, None, None, 0, workspace.part_names)


def test_a_region_ranks_by_what_its_cells_add(workspace: Workspace) -> None:
    analyser = StateAnalyser(workspace)
    state = SessionState("drone-to-satellite", 4, why=True)
    whole = analyser.analyse(state, 10)
    part = analyser.analyse(replace(state, region=(5, 6, 9)), 10)
    assert part.query is whole.query
    assert whole.query.trace is not None
    cells = np.zeros((4, 4), bool)
    cells.reshape(-1)[[5, 6, 9]] = True
    added = [
        explain.side_evidence(whole.query.trace, tile).cells.mean(axis=0)[cells].sum()
        for tile in whole.task.gallery_descriptors
    ]
    assert [match.index for match in part.matches] == np.argsort(-np.array(added), kind="stable")[:10].tolist()
    for match in part.matches:
        assert match.contributions.sum() == pytest.approx(match.distance2, abs=1e-5)
        assert match.contributions.min() >= -1e-6
    assert "3 of 16 cells" in region.page(part, workspace)
    assert "whole query" in evidence.page(part, workspace)
    np.testing.assert_array_equal(analyser.analyse(state, 10).ranking.scores, whole.ranking.scores)


def test_shift_and_zoom_are_of_the_described_query(workspace: Workspace) -> None:
    moved = analysed(workspace, shift=8, down=-4, zoom=1.5)
    expected = Change(0, 8, 1.5, -4)
    assert moved.state.change == expected
    assert not np.allclose(moved.query.descriptor, analysed(workspace).query.descriptor, atol=1e-3)
    assert session_state.upright(moved.state).change == Change()


@pytest.mark.parametrize("value", [None, "a", 3, [1, "b"], [-1], [True], [0.5], {"a": 1}])
def test_a_region_from_the_page_is_a_list_of_cells(value: Any) -> None:
    assert decode(ExplainMessage, "region", value) is None


def test_a_region_is_within_the_feature_map(workspace: Workspace) -> None:
    changes: list[StateChange] = []
    window = make_window(workspace, WindowGui(), [], change=changes.append)
    analysis = analysed(workspace)
    window.show(analysis)
    rows, columns = workspace.map_sizes[analysis.task.query_view]
    for wrong in ([rows * columns], [0] * (rows * columns + 1)):
        window.receive(messages.SearchRegion(wrong))
    assert changes == []
    for cells, expected in (([3, 1, 3], (1, 3)), ([], ())):
        window.receive(messages.SearchRegion(cells))
        searched = changes.pop()(analysis.state)
        assert searched is not None
        assert searched.region == expected
    window.leave()


@pytest.mark.parametrize(
    "value", [None, [1, 2], ["a", None, {}, []], [1e999, 0, 0, 1], [0, math.nan, 0, 1], [1e7, 0, 0, 1]]
)
def test_a_point_of_a_profile_is_four_finite_numbers(value: Any) -> None:
    assert decode(ExplainMessage, "take", value) is None


@given(*[st.floats(-1e6, 1e6)] * 4)
def test_a_point_of_a_profile_stays_within_bounds(angle: float, right: float, down: float, zoom: float) -> None:
    state = session_state.apply_point(SessionState("drone-to-satellite", 4), angle, right, down, zoom, (64, 128))
    assert -180 <= state.angle <= 180
    assert abs(state.shift) <= 64
    assert abs(state.down) <= 32
    assert 0.25 <= state.zoom <= 4


def test_a_point_of_a_profile_is_shown() -> None:
    start = SessionState("drone-to-satellite", 4, angle=10.0)
    assert session_state.apply_point(start, 270, 5, -6, 2.0, (64, 128)).change == Change(-90, 5, 2.0, -6)


def test_a_point_of_a_sweep_over_weather_keeps_the_strength() -> None:
    start = SessionState("drone-to-satellite", 4, weather_strength=0.5)
    taken = decode(ExplainMessage, "take", [0, 0, 0, 1, "fog+rain"])
    assert isinstance(taken, messages.TakePoint)
    change = session_state.apply_point(start, 0, 0, 0, 1, (64, 64), taken.weather).change
    assert change == Change(weather=Weather("fog+rain", 0.5))
    assert decode(ExplainMessage, "take", [0, 0, 0, 1, "hail"]) is None


def test_a_sweep_over_weather_says_which_part_loses_most(workspace: Workspace) -> None:
    analysis = analysed(workspace)
    assert workspace.model is not None
    progress = list(SweepRequest("weather", analysis).run(workspace, workspace.model))[-1]
    profile = progress.profile(analysis)
    assert profile is not None
    assert [point.change.weather.name for point in profile.points] == list(WEATHERS)
    page = sweep_page.page(analysis, "weather", profile, 10, workspace.part_names)
    worst = min(profile.points, key=lambda point: point.score)
    lost = int(np.argmin(worst.cosines - profile.points[0].cosines))
    assert f"suffers most {worst.change.weather.describe()}" in page
    assert f"Part {workspace.part_names[lost]} loses most there" in page
    assert all(f">{name}</text>" in page for name in WEATHERS)


def test_a_profile_without_a_point_says_whether_it_is_still_being_computed(workspace: Workspace) -> None:
    analysis = analysed(workspace)
    assert "computing" in sweep_page.page(analysis, "zoom", None, 8, workspace.part_names)
    stopped = sweep_page.page(analysis, "zoom", None, 8, workspace.part_names, stopped=True)
    assert "computing" not in stopped
    assert "Stopped before the first step" in stopped


def test_a_sweep_ends_when_cancelled_and_belongs_to_one_query(workspace: Workspace) -> None:
    assert workspace.model is not None
    turned = analysed(workspace, angle=37.0, shift=4)
    request = SweepRequest("rotation", turned)
    steps = request.run(workspace, workspace.model)
    assert next(steps).points == ()
    progress = next(steps)
    first = progress.points[0]
    assert (first.change.rotate, first.change.shift, progress.total) == (37.0, 4, 25)
    profile = progress.profile(turned)
    assert profile is not None
    assert profile.unchanged is first
    request.cancelled.set()
    (last,) = steps
    assert last.stopped
    page = sweep_page.page(turned, "rotation", profile, last.total, workspace.part_names, last.stopped)
    assert "stopped at" in page
    assert "1 of 25" in page
    assert request.applies_to(analysed(workspace, angle=-75.0, shift=4))
    for other in ({"shift": 5, "angle": 37.0}, {"query": 1}, {"shift": 4, "weights": (1.0, 1.0, 1.0, 0.0)}):
        assert not request.applies_to(analysed(workspace, **other))
    # A known positive is followed, whatever tile is compared; otherwise the compared tile is followed.
    assert request.applies_to(analysed(workspace, shift=4, selected=3))
    upload = OwnPicture("own", small_worlds.place(50))
    request = SweepRequest("zoom", analysed(workspace, upload=upload, selected=3))
    assert not request.applies_to(analysed(workspace, upload=upload, selected=4))


class WindowGui:
    """The part of viser's gui that the explain window needs; `html` has the newest content of each element."""

    def __init__(self) -> None:
        self.html: list[SimpleNamespace] = []
        self.expanded = 0

    def add_panel(self, **_: Any) -> Any:
        return SimpleNamespace(
            add_tab=lambda label, _: MagicMock(_label=label), float=lambda **_: None, expand=self.expand, visible=False
        )

    def expand(self) -> None:
        self.expanded += 1

    def add_html(self, content: str) -> Any:
        self.html.append(SimpleNamespace(content=content))
        return self.html[-1]

    def shown(self, identifier: str) -> str:
        return next((html.content for html in self.html if f'id="{identifier}"' in html.content), "")


def make_window(
    workspace: Workspace,
    gui: WindowGui,
    errors: list[Exception],
    open_tab: Callable[[str], None] = lambda _: None,
    change: Callable[[StateChange], None] = lambda _: None,
) -> ExplainWindow:
    return ExplainWindow(
        SimpleNamespace(gui=gui),  # type: ignore[arg-type]
        workspace,
        change,
        errors.append,
        Viewport(),
        SimpleNamespace(),  # type: ignore[arg-type]
        RequestContext(workspace.inference),
        WorkspaceServices.of(workspace).turned,
        open_tab,
    )


@pytest.fixture
def window(workspace: Workspace) -> Iterator[tuple[ExplainWindow, WindowGui]]:
    gui, errors = WindowGui(), []
    window = make_window(workspace, gui, errors)
    yield window, gui
    window.leave()
    assert errors == []


def two_answers_with_a_change(workspace: Workspace) -> tuple[StateAnalysis, StateAnalysis]:
    """One query under two part weights; in both answers other weights would put its positive first."""
    for query in np.flatnonzero(workspace.rankings["drone-to-satellite"].ranks > 0):
        analyses = [analysed(workspace, query=int(query), weights=(1.0, 1.0, 1.0, last)) for last in (1.0, 0.95)]
        if all((pair := compared(analysis)) is not None and pair.change is not None for analysis in analyses):
            return analyses[0], analyses[1]
    raise AssertionError("no query whose positive another choice of weights puts first")


def test_a_failed_analysis_is_said_in_the_open_window_which_can_be_closed(
    workspace: Workspace, window: tuple[ExplainWindow, WindowGui]
) -> None:
    explain_window, gui = window
    explain_window.fail("nobody looks")
    assert not gui.shown("lpn-why")
    explain_window.announce()
    assert "Computing" in gui.shown("lpn-why")
    explain_window.fail("The picture of <b> is damaged.")
    assert "No answer: The picture of &lt;b&gt; is damaged." in gui.shown("lpn-why")
    explain_window.close()
    explain_window.show(analysed(workspace))  # was begun before
    assert not explain_window._panel.visible
    explain_window.announce()
    explain_window.show(analysed(workspace))
    assert explain_window._panel.visible
    assert "No answer" not in gui.shown("lpn-why")


def test_a_failure_ends_the_sweep_and_empties_every_tab(
    workspace: Workspace, window: tuple[ExplainWindow, WindowGui]
) -> None:
    explain_window, gui = window
    explain_window.announce()
    explain_window.show(analysed(workspace))
    explain_window.receive(messages.RequestSweep("rotation"))
    content = explain_window._content
    assert content is not None
    assert content.sweep is not None
    explain_window.fail("The picture is damaged.")
    assert content.sweep.request.cancelled.is_set()
    explain_window.leave()
    time.sleep(0.2)  # for a step of the sweep that was under way
    assert sum("No answer: The picture is damaged." in html.content for html in gui.html) == 5


def test_a_sweep_that_is_requested_again_is_kept_unless_it_was_stopped(
    workspace: Workspace, window: tuple[ExplainWindow, WindowGui]
) -> None:
    explain_window, _ = window

    def requested(over: sweeps.SweptProperty) -> SweepRequest:
        explain_window.receive(messages.RequestSweep(over))
        content = explain_window._content
        assert content is not None
        assert content.sweep is not None
        return content.sweep.request

    explain_window.announce()
    explain_window.show(analysed(workspace))
    turns = requested("rotation")
    assert requested("rotation") is turns
    zooms = requested("zoom")
    assert turns.cancelled.is_set()
    again = requested("rotation")
    assert again is not turns
    assert zooms.cancelled.is_set()
    explain_window.receive(messages.CancelSweep())
    assert requested("rotation") is not again
    explain_window.leave()


def test_an_analysis_of_a_closed_window_is_not_drawn_and_opens_nothing(
    workspace: Workspace, window: tuple[ExplainWindow, WindowGui]
) -> None:
    explain_window, gui = window
    explain_window.announce()
    explain_window.show(analysed(workspace, why=False))  # was begun before the window was opened
    assert explain_window._panel.visible
    assert "Computing" in gui.shown("lpn-why")
    explain_window.close()
    explain_window.show(analysed(workspace))
    assert not explain_window._panel.visible
    assert "Computing" in gui.shown("lpn-why")


def test_an_effect_of_the_previous_pair_is_never_shown_under_the_next(
    workspace: Workspace, window: tuple[ExplainWindow, WindowGui], monkeypatch: pytest.MonkeyPatch
) -> None:
    explain_window, gui = window
    old, new = two_answers_with_a_change(workspace)
    drawing, go_on, render = Event(), Event(), comparison.page

    def slow_page(
        analysis: StateAnalysis, workspace: Workspace, pair: Comparison | None, effect: Any, busy: bool
    ) -> str:
        html = render(analysis, workspace, pair, effect, busy)
        if effect is not None:
            drawing.set()
            assert go_on.wait(120)
        return html

    monkeypatch.setattr(comparison, "page", slow_page)
    explain_window.announce()
    explain_window.show(old)
    explain_window.receive(messages.RequestEffect())
    assert drawing.wait(120)  # the worker is about to show the old pair's effect when the pair changes
    change = Thread(target=explain_window.show, args=(new,))
    change.start()
    change.join(0.3)
    go_on.set()
    change.join(30)
    explain_window.leave()
    wait_until(lambda: gui.shown("lpn-counterfactual") == render(new, workspace, compared(new), None, False))
    time.sleep(0.2)
    assert gui.shown("lpn-counterfactual") == render(new, workspace, compared(new), None, False)


def test_an_effect_is_computed_from_one_pair_and_stored_for_that_pair_only(
    workspace: Workspace, window: tuple[ExplainWindow, WindowGui], monkeypatch: pytest.MonkeyPatch
) -> None:
    explain_window, gui = window
    old, new = two_answers_with_a_change(workspace)
    # The pair changes while the effect of the old pair is being computed.
    computed = []

    def effect(*arguments: Any) -> Effect:
        explain_window.show(new)
        computed.append(arguments[0].weights)
        return Effect(50.0, 40.0, np.array([1]), np.array([2, 3]), 13)

    monkeypatch.setattr(window_module, "effect_on", effect)
    explain_window.announce()
    explain_window.show(old)
    explain_window.receive(messages.RequestEffect())
    wait_until(lambda: bool(computed))
    assert computed[0] is old.ranking.weights
    explain_window.leave()
    time.sleep(0.2)
    assert "it harms" not in gui.shown("lpn-counterfactual")
    assert "Does it help" in gui.shown("lpn-counterfactual")


def test_weights_that_change_nothing_neither_help_nor_harm() -> None:
    same = Effect(70.0, 70.0, np.array([1]), np.array([2]), 13)
    assert "it neither helps nor harms: 1 gained, 1 lost" in verdicts.describe_effect(same)


def test_a_window_fits_the_room_that_the_page_tells() -> None:
    room = Viewport()
    room.resize(700, 500)
    assert room.window() == (688, 488)
    assert room.window((600, 900), 0.5) == (588, 320)
    told: list[int] = []
    room.watch(lambda: told.append(room.width))
    room.resize(700, 500)
    room.resize(640, 500)
    assert told == [640]


def test_the_window_opens_at_the_tab_that_answers_and_follows_the_page(workspace: Workspace) -> None:
    ranks = workspace.rankings["drone-to-satellite"].ranks
    opened: list[str] = []
    changes: list[StateChange] = []
    window = make_window(workspace, WindowGui(), [], opened.append, changes.append)
    for query, tab in ((int(np.argmax(ranks)), "comparison"), (int(np.argmin(ranks)), "evidence")):
        analysis = analysed(workspace, query=query, why_tab="best")
        window.announce()
        window.show_tab("best")  # waits for the answer
        assert opened == []
        window.show(analysis)
        shown = changes.pop()(analysis.state)
        assert shown is not None
        assert shown.why_tab == tab
        window.show_tab(shown.why_tab)
        assert opened.pop() == {"comparison": "True or wrong", "evidence": "Why"}[tab]
        window.show_tab(shown.why_tab)  # the page shows it by now
        assert opened == []
        assert changes == []
        window.close()
    window.announce()
    window.receive(messages.FollowTab("Parts"))  # of another window
    assert changes == []
    window.receive(messages.FollowTab("Heatmaps"))
    followed = changes.pop()(analysis.state)
    assert followed is not None
    assert followed.why_tab == "heatmaps"
    window.show_tab("heatmaps")
    assert opened == []
    window.leave()
