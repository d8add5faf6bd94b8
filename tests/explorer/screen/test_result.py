"""The result holds the analysis' own numbers, whatever is shown."""

from __future__ import annotations

from base64 import b64decode
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from explorer.screen import fields, result
from explorer.screen.fields import ScreenState
from explorer.screen.result import STRIP, ScreenResult, measured_scale
from explorer.workspace import Workspace, WorkspaceAnalyser
from lpn import explain
from lpn.core import images
from lpn.core.numbers import rounded_to_sum
from lpn.retrieval import scoring


def result_of(workspace: Workspace, **values: Any) -> ScreenResult:
    state: ScreenState = replace(fields.opening(workspace), **values)
    analysis = WorkspaceAnalyser(workspace).analyse(workspace.tasks[state.task], state.question(), STRIP)
    return ScreenResult(
        workspace, workspace.feeds, state, state.question(), analysis, measured_scale(analysis.task), "photo.jpg"
    )


@pytest.mark.parametrize("query", range(8))
@pytest.mark.parametrize("angle", [0.0, 33.0])
def test_each_number_is_the_analysis_own_and_they_add_up(workspace: Workspace, query: int, angle: float) -> None:
    made = result_of(workspace, query=query, angle=angle)
    message, analysis = made.message(), made.analysis
    answer, verdict = message["tiles"][message["answer"]], analysis.verdict
    assert answer["distance"] == f"{analysis.ranking.match(0).distance2:.3f}"
    assert answer["shares"] == rounded_to_sum(verdict.answer.contributions.tolist(), total=verdict.answer.distance2)
    for tile in message["tiles"].values():
        assert sum(tile["shares"]) == pytest.approx(float(tile["distance"]), abs=1e-9)
    assert message["rival"] == verdict.rival.index
    gains = [float(row["gain"]) * (-1 if row["minus"] else 1) for row in message["rows"]]
    assert sum(gains) == pytest.approx(verdict.lead, abs=1e-9)
    assert gains == verdict.figures
    told = [None if abs(gain) < 0.005 else (gain > 0) == verdict.sign for gain in gains]
    assert [row["prefers"] for row in message["rows"]] == told
    assert message["headline"]["reason"].startswith(verdict.headline)
    assert message["rank"] == analysis.positive.rank if analysis.positive else message["rank"] is None
    assert message["headline"]["found"] == (message["rank"] == 1)
    assert [message["tiles"][index]["rank"] for index in message["strip"][:3]] == ["1", "2", "3"]


def test_a_missed_query_shows_its_truth_last(workspace: Workspace) -> None:
    ranks = workspace.rankings["drone-to-satellite"].ranks
    missed = int(np.argmax(ranks))
    assert ranks[missed] >= 1, "the untrained model misses some"
    message = result_of(workspace, query=missed).message()
    assert message["rival_word"] == "truth"
    assert message["truth"] == message["rival"]
    assert message["truth"] in message["strip"]
    assert f"truth is {ranks[missed] + 1}" in message["headline"]["title"]
    assert "heat" in message["tiles"][message["truth"]]
    strip = result_of(workspace, query=missed, compare=message["truth"]).message()["strip"]
    assert len(set(strip)) == len(strip), "a pinned truth stands there once"


def test_a_chosen_tile_is_compared_and_changes_neither_headline_nor_answer(workspace: Workspace) -> None:
    plain = result_of(workspace).message()
    chosen = plain["strip"][3]
    pinned = result_of(workspace, compare=chosen).message()
    assert (pinned["pinned"], pinned["rival"], pinned["rival_word"]) == (True, chosen, "pinned")
    assert (pinned["headline"], pinned["answer"]) == (plain["headline"], plain["answer"])
    assert pinned["tiles"][chosen]["heat"]
    again = result_of(workspace, compare=plain["answer"]).message()
    assert again["rows"] == plain["rows"], "the answer beside itself tells nothing"


def test_the_strongest_cell_of_each_part_lies_in_it(workspace: Workspace) -> None:
    made = result_of(workspace, query=2)
    photo = made.message()["photo"]
    rows, columns = photo["parts"]["rows"], photo["parts"]["columns"]
    labels = np.frombuffer(b64decode(photo["parts"]["labels"]), np.uint8).reshape(rows, columns)
    heat = np.frombuffer(b64decode(photo["heat"]), np.uint8).reshape(rows, columns)
    assert (heat.min(), heat.max()) == (0, 255), "one scale from the least to the greatest cell"
    for part, (column, row) in enumerate(photo["strongest"]):
        assert labels[row, column] == part
        assert heat[row, column] == heat[labels == part].max()


def test_a_tile_is_turned_by_the_quarters_that_its_cells_are(workspace: Workspace) -> None:
    made = result_of(workspace)
    straight = made._heat(made.analysis.tile, "satellite", 0, None)
    turned = made._heat(made.analysis.tile, "satellite", 1, None)
    size = straight["parts"]["rows"], straight["parts"]["columns"]
    before = np.frombuffer(b64decode(straight["heat"]), np.uint8).reshape(size)
    assert (np.frombuffer(b64decode(turned["heat"]), np.uint8).reshape(size[::-1]) == np.rot90(before)).all()
    places = made.task.geometry
    query, tile = places.queries[0], places.tiles[made.first.index]
    off = ((query.heading or 0) - (tile.heading or 0) + 180) % 360 - 180
    assert made.quarter(made.first) == round(off / 90) % 4


@pytest.mark.parametrize("weights", [(), (2.0, 0.0, 1.0, 1.0)])
def test_evidence_is_that_of_the_pair_on_one_scale(workspace: Workspace, weights: tuple[float, ...]) -> None:
    made = result_of(workspace, query=1, heat="evidence", weights=weights)
    message, ranking = made.message(), made.analysis.ranking
    greatest = 0.0
    for index, pair in made.evidence.items():
        exact = explain.evidence(
            made.analysis.query.trace, workspace.tile(made.task, index).trace, ranking.weights, ranking.csls_of(index)
        )
        assert np.allclose(pair.tile.score_map(ranking.weights), exact.tile.score_map(ranking.weights))
        maps = pair.query.score_map(ranking.weights), pair.tile.score_map(ranking.weights)
        greatest = max(greatest, *(float(np.abs(cells).max()) for cells in maps))
    assert set(made.evidence) == set(made.large)
    tile = message["tiles"][message["answer"]]
    assert tile["signed"]
    assert message["photo"]["signed"]
    cells = np.frombuffer(b64decode(tile["heat"]), np.uint8).astype(float)
    size = tile["parts"]["rows"], tile["parts"]["columns"]
    shown = np.rot90((cells.reshape(size) - 128) / 127 * greatest, -tile["quarter"])
    own = made.evidence[message["answer"]].tile.score_map(ranking.weights)
    assert np.abs(shown - images.enlarge(own, *shown.shape)).max() <= greatest / 127


def test_part_weights_widen_the_scale_of_the_bars(workspace: Workspace) -> None:
    plain = result_of(workspace).message()["scale"]
    weighed = result_of(workspace, weights=(2.0, 1.0, 1.0, 0.0)).message()["scale"]
    assert weighed["part"] == pytest.approx(2 * plain["part"])
    assert weighed["total"] == plain["total"]


def test_most_bars_of_answers_and_rivals_fit_the_measured_scale(workspace: Workspace) -> None:
    task = workspace.tasks["drone-to-satellite"]
    scale = measured_scale(task)
    weights = scoring.part_weights(4)
    shares = []
    for query in range(8):
        found = task.start_search(query, task.query_descriptors[query])(weights)
        shares += [found.match(0).contributions, (found.hardest_negative() or found.match(0)).contributions]
    assert np.percentile(np.concatenate(shares), 90) <= scale.part
    assert scale.part * 10 == pytest.approx(round(scale.part * 10))


def test_the_scale_reads_a_part_of_a_large_gallery(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    read = []
    task = workspace.tasks["drone-to-satellite"]
    search = type(task).start_search
    monkeypatch.setattr(type(task), "start_search", lambda self, *a: read.append(a[0]) or search(self, *a))
    monkeypatch.setattr(result, "_MOST_NUMBERS", 1)
    measured_scale(task)
    assert read == [0]


def test_a_model_of_one_part_has_one_row(workspace: Workspace) -> None:
    beside = workspace.beside[0]
    assert beside.open().wait(120)
    message = result_of(beside.workspace).message()
    assert len(message["rows"]) == 1
    assert message["photo"]["parts"]["boxes"] == [[0.0, 0.0, 1.0, 1.0]]
