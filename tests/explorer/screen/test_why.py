"""The page behind the verdict, and the panels that compare, sweep, and search by a region: numbers are the analysis' own."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html import unescape
from typing import Any

import numpy as np
import pytest

from explorer.parameters import UnusableError
from explorer.screen import fields
from explorer.screen.fragments import fragment
from explorer.screen.panels.compare.models import changes
from explorer.screen.panels.compare.pair import TilePair
from explorer.screen.panels.region import CellRuns, message
from explorer.screen.panels.why import words
from explorer.workspace import LazyWorkspace, Workspace, WorkspaceAnalyser
from lpn.analysis.comparison import effect_on
from lpn.core.errors import DataError
from lpn.core.numbers import shown_difference
from lpn.explain import sweeps
from lpn.library.answer import Answer
from lpn.retrieval import scoring
from tests.explorer.conftest import Tab
from tests.explorer.screen.test_result import result_of
from tools.fixtures.waiting import TIMEOUT

TASK = "drone-to-satellite"


@pytest.fixture(autouse=True, scope="module")
def _second_model_is_open(workspace: Workspace) -> None:
    """Open it before the tests: one that ends meanwhile would take the folder of its cache along."""
    assert workspace.beside[0].open().wait(TIMEOUT)
    assert workspace.beside[0].workspace is not None


def analysed(workspace: Workspace, region: tuple[int, ...] = (), **state: Any) -> Answer:
    question = replace(replace(fields.opening(workspace), **state).question(), region=region)
    return WorkspaceAnalyser(workspace).analyse(workspace.tasks[TASK], question, 6)


def panel_until(tab: Tab, pattern: str) -> str:
    """Return the HTML of the open panel once a pattern is found in it; a state that changes nothing has it sent again."""
    tab.set()
    tab.until(lambda last: re.search(pattern, _html(last)))
    return _html(tab.last)


def _html(last: dict[str, Any]) -> str:
    return str((last.get("panel") or {"message": {}})["message"].get("html", ""))


def mendable(workspace: Workspace) -> tuple[int, int]:
    """Return a query and an angle at which it is missed, and some part weights put its truth first."""
    for angle in (0, *range(-150, 181, 30)):
        for query in range(len(workspace.rankings[TASK].ranks)):
            if TilePair.of(result_of(workspace, query=query, angle=angle)).usable:
                return query, angle
    raise AssertionError("no part weights mend any of the untrained model's misses")


def test_the_page_behind_the_verdict_has_the_measured_figures(workspace: Workspace) -> None:
    ranking, result = workspace.rankings[TASK], result_of(workspace)
    page, figures = words.page(result, ranking), workspace.results(ranking)
    assert ranking.result is not None
    named = {name: value for name, value, _ in page["figures"]}
    assert f"{figures['ap']:.1f} %" in fragment("why/why", **page, word="ring")
    right = int((ranking.ranks == 0).sum())
    assert (named["found"], named["missed"]) == (str(right), str(8 - right))
    assert named["R@1"] == f"{100 * right / 8:.1f} %"
    assert named["AP"] == f"{figures['ap']:.1f} %"
    metres, shares = page["metres"]
    assert np.interp(50, shares, metres) == pytest.approx(figures["median error m"], abs=0.6)
    assert metres == sorted(metres)
    assert page["answer"]["said"][0] == f"It leads the next tile by {result.first.shown_gap:.3f}."
    known = workspace.outcomes(result.task)
    of_found = known[0].margin[known[0].hits]
    assert sum(ring["found"] for ring in page["rings"]) == pytest.approx(of_found.mean(), abs=1e-3)
    assert sum(ring["most"] for ring in page["rings"]) == right


def test_other_weights_and_a_turn_are_said_where_they_make_figures_others(workspace: Workspace) -> None:
    ranking = workspace.rankings[TASK]
    turned = words.page(result_of(workspace, angle=30.0), ranking)["answer"]["said"]
    assert any("turned" in one for one in turned)
    weighed = words.page(result_of(workspace, weights=(2.0, 1.0, 1.0, 0.0)), ranking)
    assert any("part weights" in one for one in weighed["answer"]["said"])
    assert not any("found" in one for one in weighed["answer"]["said"])
    assert any("2, 1, 1, 0" in one for one in weighed["scored"])


def test_the_pair_has_the_rows_of_the_screen_and_the_ranks_of_each_part(workspace: Workspace) -> None:
    query = int(np.argmax(workspace.rankings[TASK].ranks))
    result = result_of(workspace, query=query)
    told, rows = TilePair.of(result).message(trying=False), result.message()["rows"]
    ranking = result.analysis.ranking
    truth = result.analysis.positive
    for part, row in enumerate(told["rows"]):
        assert {name: row[name] for name in rows[part]} == rows[part]
        alone = np.count_nonzero(ranking.similarities[:, part] > ranking.similarities[truth.index, part])
        assert row["alone"] == alone + 1
        without = ranking.similarities @ np.where(np.arange(4) == part, 0, ranking.weights)
        assert row["without"] == np.count_nonzero(without > without[truth.index]) + 1
    assert f"{-shown_difference(result.first.distance2, truth.distance2):.3f} behind" in told["said"][0]


def test_weights_that_are_offered_put_the_truth_first_on_the_screen(workspace: Workspace, tab: Tab) -> None:
    query, angle = mendable(workspace)
    assert tab.open(f"?query=~{query}&angle={angle}&panel=compare")["headline"]["found"] is False
    weights = list(TilePair.of(result_of(workspace, query=query, angle=angle)).usable)
    panel_until(tab, "Use these weights")
    tab.set(compare_tried="yes")
    told = panel_until(tab, "R@1 goes from")
    task = workspace.tasks[TASK]
    effect = effect_on(task.with_fields(weights=scoring.part_weights(4)), weights)
    assert f"{len(effect.gained)} newly found" in told
    assert f"to {effect.after:.1f} %" in told
    tab.set(weights=weights)
    assert tab.result(weights=[round(weight, 2) for weight in weights])["headline"]["found"] is True


def test_the_painted_places_make_the_lead(workspace: Workspace) -> None:
    result = result_of(workspace, query=3)
    pair = TilePair.of(result)
    lead = shown_difference(pair.comparison.other.distance2, pair.comparison.followed.distance2)
    told = pair.message(trying=False)
    assert f"{abs(lead):.3f} together" in told["places"]
    assert told["photo"]["signed"] is True


def test_the_account_of_the_answer_adds_up_to_its_score(workspace: Workspace) -> None:
    result = result_of(workspace, query=3)
    account = TilePair.of(result).message(trying=False)["account"]
    terms = [[float(term.replace("−", "-")) for term in part] for part in account["parts"]]
    assert sum(part[-1] for part in terms) == pytest.approx(result.first.score, abs=3e-3)
    for part in terms:
        assert sum(part[:3]) == pytest.approx(part[3], abs=1e-9)
    assert f"{result.first.score:.3f}" in account["said"][0]


def test_a_second_model_has_its_own_answer_to_the_same_photo(workspace: Workspace, tab: Tab) -> None:
    tab.open("?query=~2&panel=compare")
    told = panel_until(tab, r"Of \d+ photos")
    other = workspace.beside[0].workspace
    columns = told.split('<div class="column">')[1:]
    for column, one in zip(columns, (workspace, other), strict=True):
        first = analysed(one, query=2).ranking.match(0)
        assert f"{first.rank}: {one.tasks[TASK].gallery[first.index].title}, distance {first.distance2:.3f}" in column
        assert f"R@1 {100 * float((one.rankings[TASK].ranks == 0).mean()):.1f} %, plain<" in column
        assert len(re.findall("data-part", column.partition("</button>")[0])) == one.contract.n_parts
    ranks, theirs = (one.rankings[TASK].ranks for one in (workspace, other))
    mine, others = int(((ranks == 0) & (theirs > 0)).sum()), int(((theirs == 0) & (ranks > 0)).sum())
    assert re.search(rf"Of 8 photos, .+ alone finds {mine}, and .+ alone {others}\.", told)


def test_a_second_model_that_does_not_open_says_why_and_is_tried_again(
    workspace: Workspace, tab: Tab, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[int] = []

    def never() -> Workspace:
        tried.append(1)
        raise DataError("The file is not there; give another.")

    monkeypatch.setattr(workspace, "beside", [LazyWorkspace("third", never)])
    tab.open("?panel=compare")
    assert "The file is not there; give another." in panel_until(tab, "Try again")
    tab.act("compare.again")
    tab.until(lambda _: len(tried) == 2)


def test_photos_whose_ranks_differ_most_are_listed() -> None:
    first, second = np.array([0, 5, 2, -1, 9]), np.array([4, 0, 2, 3, 1])
    alone, better, worse = changes(first, second, np.array([True] * 4 + [False]), 2)
    assert alone == (1, 1)
    assert better == [(1, 6, 1)], "one without a truth, and one that is not graded, do not count"
    assert worse == [(0, 1, 5)]


@pytest.mark.parametrize("over", ["zoom", "shift", "rotation"])
def test_a_sweep_begins_at_the_photo_as_it_is_and_its_shares_add_up(workspace: Workspace, tab: Tab, over: Any) -> None:
    tab.open(f"?query=~1&panel=sweep&sweep={over}")
    told = panel_until(tab, "For the unchanged photo, the truth is")
    charts = [json.loads(unescape(one)) for one in re.findall("data-chart='(.*?)'", told)]
    rank, distance, shares = ([line["values"] for line in chart["lines"]] for chart in charts)
    x = charts[0]["x"]
    assert x == sorted(x)
    assert len(x) == len(sweeps.changes_over(over, side=workspace.contract.input_size[1]))
    here = x.index({"zoom": 1}.get(over, 0))
    analysis = analysed(workspace, query=1)
    assert rank[0][here] == analysis.positive.rank
    assert charts[0]["range"] == [1, workspace.tasks[TASK].tiles], "no rank lies beyond the gallery"
    assert distance[0][here] == pytest.approx(analysis.positive.distance2, abs=1e-4)
    for number, one in enumerate(distance[0]):
        assert sum(of[number] for of in shares) == pytest.approx(one, abs=1e-3)


def test_a_sweep_follows_the_photo(tab: Tab) -> None:
    tab.open("?query=~1&panel=sweep&sweep=zoom")
    panel_until(tab, r"[3-9] of \d+ steps")
    tab.set(query=5)
    tab.result(query=5)
    panel_until(tab, r"\b1 of \d+ steps")


def test_a_region_ranks_as_the_library_does(workspace: Workspace) -> None:
    cells = tuple(range(4, 9))
    result = result_of(workspace, query=4)
    told, alone = message(result, cells), analysed(workspace, query=4, region=cells)
    assert told["cells"] == list(cells)
    for tile, match in zip(told["tiles"], alone.ranking.top(3), strict=False):
        assert (tile["index"], tile["distance"]) == (match.index, f"{match.distance2:.3f}")
        assert tile["was"] == result.analysis.ranking.find(match.index).rank
    beyond = message(result, (*cells, 4000))
    assert beyond["cells"] == list(cells), "cells that this model's map has not are left out"
    assert not message(result, ())["tiles"]


@pytest.mark.parametrize(
    ("text", "cells"), [("", ()), ("7", (7,)), ("3-6,19", (3, 4, 5, 6, 19)), ("9,1-2", (1, 2, 9)), ([5, 4, 4], (4, 5))]
)
def test_cells_are_written_as_runs(workspace: Workspace, text: object, cells: tuple[int, ...]) -> None:
    state, kind = fields.opening(workspace), CellRuns()
    assert kind.read(text, state, workspace) == cells
    assert kind.read(kind.write(cells, state, workspace), state, workspace) == cells


@pytest.mark.parametrize("value", ["x", "1-", "99999", [True], [-1], ["2"], [4096], {}, 3])
def test_other_cells_are_refused(workspace: Workspace, value: object) -> None:
    with pytest.raises(UnusableError, match="cells"):
        CellRuns().read(value, fields.opening(workspace), workspace)


def test_another_photo_has_no_region(workspace: Workspace) -> None:
    state, problems = fields.changed(fields.opening(workspace), {"region_cells": [1, 2]}, workspace)
    assert not problems
    assert state.value("region_cells") == (1, 2)
    assert fields.changed(state, {"query": 3}, workspace)[0].value("region_cells") == ()
    assert replace(state, angle=3.0).value("region_cells") == (1, 2)
