"""The laboratory: the selections of its choices, the counts of its charts and map, and its notes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from explorer.app import App
from explorer.parameters import UnusableError
from explorer.screen import fields
from explorer.screen.fields import ScreenState
from explorer.screen.fragments import fragment
from explorer.screen.panels.lab import charts, points, table
from explorer.screen.panels.lab.selection import PICKED, WHERE, LabSelection, decode, encode
from explorer.screen.panels.lab.service import LabFindings, lab_of
from explorer.workspace import Workspace
from lpn.analysis import breakdown, embedding_map
from lpn.core.errors import InputError
from lpn.tasks.notes import Note
from tests.explorer.conftest import Tab, get, mapped_workspace

TASK = "drone-to-satellite"
WEATHERS = ("<b>rain", 'say "hi"', "sun and sea")


@pytest.fixture(scope="module")
def workspace(
    tmp_path_factory: pytest.TempPathFactory, model_file: Path, one_part_model_file: Path
) -> Iterator[Workspace]:
    """Thirteen places with metadata, of which the untrained network finds some."""
    columns = {"weather": WEATHERS, "wind": [str(100 + 10 * i) for i in range(6)]}
    with mapped_workspace(tmp_path_factory.mktemp("lab"), model_file, one_part_model_file, 13, columns) as opened:
        assert 0 < (opened.rankings[TASK].ranks > 0).sum() < 13
        yield opened


@pytest.fixture(scope="module")
def findings(workspace: Workspace) -> LabFindings:
    lab = lab_of(workspace)
    job = lab.build(TASK, workspace)
    assert job.wait(120)
    assert job.error is None
    return lab.findings(TASK)


@pytest.fixture(scope="module")
def app(workspace: Workspace) -> Iterator[App]:
    served = App(workspace, "127.0.0.1", 0)
    yield served
    served.close()


def state_of(workspace: Workspace, **values: object) -> ScreenState:
    state, problems = fields.changed(fields.opening(workspace), values, workspace)
    assert not problems
    return state


def told(tab: Tab, kind: str, /, **values: object) -> dict[str, Any]:
    """Return the newest message of a kind of the panel, once it has these values."""

    def holds(last: dict[str, Any]) -> bool:
        message = last.get("panel", {}).get("message", {}).get(kind)
        return message is not None and all(message[name] == value for name, value in values.items())

    found: dict[str, Any] = tab.until(holds)["panel"]["message"][kind]
    return found


def test_picked_queries_are_a_text_of_their_task(findings: LabFindings, workspace: Workspace) -> None:
    task, other = findings.task, workspace.tasks["satellite-to-drone"]
    for rows in ([], [0], [2, 3, 12], list(range(13))):
        assert decode(encode(np.array(rows, np.int64), task), task).tolist() == rows
    assert decode("", task).tolist() == list(range(13))
    code = encode(np.array([1]), task)
    for broken in (code[:-4], "zzzz", "é", code[:4] + "!", encode(np.array([1]), other)):
        with pytest.raises(UnusableError):
            decode(broken, task)
    state = state_of(workspace, lab_picked=code)
    again, problems = fields.from_values(fields.parsed(fields.to_address(state, workspace)), workspace)
    assert again[PICKED] == code
    assert not problems
    # Another task drops nothing of the address, but shows all its queries.
    elsewhere = LabSelection.of(replace(findings, task=other), replace(state), "")
    assert len(elsewhere.picked) == len(findings.table)


def test_outcome_filter_and_picked_queries_select_together(findings: LabFindings, workspace: Workspace) -> None:
    failed = np.flatnonzero(findings.graded.failed)
    picked = encode(failed[:2], findings.task)
    state = state_of(workspace, lab_show="missed", lab_picked=picked, lab_sort="-rank")
    assert LabSelection.of(findings, state, "").rows().tolist() == failed[:2].tolist()
    everything = LabSelection.of(findings, state_of(workspace, lab_sort="-rank"), "")
    ranks = findings.outcomes.rank[everything.ordered()]
    assert (np.diff(ranks) <= 0).all()
    near = LabSelection.of(findings, state_of(workspace, lab_show="near"), "").rows()
    assert near.tolist() == [row for row in failed if findings.outcomes.rank[row] < 5]


def test_a_filter_that_cannot_be_read_keeps_the_last_one_and_says_why(
    findings: LabFindings, workspace: Workspace
) -> None:
    wrong = state_of(workspace, lab_where="rank >")
    selection = LabSelection.of(findings, wrong, "wind > 120")
    with pytest.raises(InputError) as error:
        findings.table.filter(findings.table.rows(), "rank >")
    assert selection.error == str(error.value)
    assert (findings.table.columns["wind"].values[selection.rows()] > 120).all()
    assert LabSelection.of(findings, wrong, "no such > 1").where == ""


def test_each_line_of_a_chart_selects_its_queries_and_a_second_click_returns(
    findings: LabFindings, workspace: Workspace
) -> None:
    state = state_of(workspace, lab_where="wind > 90")
    selection = LabSelection.of(findings, state, "")
    message = charts.message(selection, selection.rows())
    titles = [card["title"] for card in message["cards"]]
    assert {"Missed by weather", "Missed by wind"} < set(titles)
    for number, card in enumerate(message["cards"]):
        for place, line in enumerate(card["lines"]):
            assert not line["chosen"]
            clicked = fields.changed(state, line["click"], workspace)[0]
            chosen = LabSelection.of(findings, clicked, "")
            assert not chosen.error
            rows = chosen.rows()
            again = charts.message(chosen, rows)["cards"]
            same = next(one for one in again if one["title"].partition(",")[0] == card["title"].partition(",")[0])
            back = next(one for one in same["lines"] if one["text"] == line["text"])
            assert back["chosen"], (number, place)
            returned = fields.changed(clicked, back["click"], workspace)[0]
            assert (returned[WHERE], returned[PICKED]) == (state[WHERE], state[PICKED])
            if "low" in line:
                known = rows[findings.graded.known[rows]]
                share = float(findings.graded.failed[known].mean())
                assert line["share"] == pytest.approx(share)
                assert (line["low"], line["high"]) == breakdown.wilson(round(share * len(known)), len(known))
            elif "count" in line:
                assert line["count"] == len(rows)
                assert findings.graded.failed[rows].all()


def test_bars_of_margins_and_recall_count_the_selected_queries(findings: LabFindings, workspace: Workspace) -> None:
    selection = LabSelection.of(findings, state_of(workspace), "")
    message = charts.message(selection, selection.rows())
    graded = findings.graded
    assert "Photos by margin" in fragment("lab/charts", **message, tiles="")
    assert sum(message["margins"]["found"]) == graded.hits.sum()
    assert sum(message["margins"]["missed"]) == graded.failed.sum()
    recall = message["recall"]
    for k, percent in zip(recall["k"], recall["percent"][0], strict=True):
        assert percent == pytest.approx(100 * ((graded.rank >= 0) & (graded.rank < k)).mean())


def test_a_query_whose_judge_is_in_doubt_counts_nowhere(findings: LabFindings, workspace: Workspace) -> None:
    failed = np.flatnonzero(findings.graded.failed)
    doubtful = np.isin(np.arange(13), failed[:1])
    doubted = replace(findings, doubtful=doubtful)
    selection = LabSelection.of(doubted, state_of(workspace), "")
    head = table.message(selection, selection.rows())
    assert head["counts"]["missed"] == len(failed) - 1
    assert head["graded"] == 12
    [(_, cells)] = table.entries(doubted, [doubted.table.columns["rank"]], failed[:1], "tiles/")
    assert "✗" not in cells[0]
    assert "✗" in table.entries(findings, [findings.table.columns["rank"]], failed[:1], "tiles/")[0][1][0]
    assert points.colours(doubted, "").codes[failed[0]] == points.UNKNOWN


def test_the_map_has_all_places_and_a_lasso_picks_those_inside(workspace: Workspace, findings: LabFindings) -> None:
    job = lab_of(workspace).points("ground", TASK, workspace)
    assert job.wait(120)
    found = job.value
    origin, unit = points.scale(found)
    plane = np.frombuffer(points.plane(found), "<f4").reshape(-1, 2)
    known = np.concatenate([findings.task.geometry.query_ground, findings.task.geometry.ground])
    np.testing.assert_allclose(plane * unit + origin, known, atol=1e-2)
    x, y = found.queries[4]
    inside = embedding_map.inside(
        found.queries, np.array([[x - 1, y - 1], [x + 1, y - 1], [x + 1, y + 1], [x - 1, y + 1]])
    )
    assert 4 in inside.tolist()
    assert all(np.abs(found.queries[row] - found.queries[4]).max() <= 1 for row in inside)
    coloured = points.colours(findings, "weather")
    assert sum(points.legend(coloured, findings.table.rows())["counts"]) == 13
    marked = np.frombuffer(points.marks(findings, coloured, np.array([3])), np.uint8).reshape(-1, 2)
    assert np.flatnonzero(marked[:, 0] & 1).tolist() == [3]
    assert np.flatnonzero(marked[:, 0] & 2).tolist() == np.flatnonzero(findings.graded.failed).tolist()


def test_a_lasso_and_marked_rows_are_picked(tab: Tab) -> None:
    tab.open("?panel=lab&lab=map&points=pca")
    told(tab, "map", kind="pca")
    tab.act("lab.lasso", corners=[[-2, -2], [2, -2], [2, 2], [-2, 2]])
    told(tab, "table", picked=0, total=13)
    tab.act("lab.lasso", corners=[[1e9, 0], [1e9, 1], [2e9, 1]])
    tab.act("lab.lasso", corners=[["x", 0], [1, 1], [2, 2]])
    tab.act("lab.pick", rows=[0, 2])
    head = told(tab, "table", picked=2)
    assert head["total"] == 2
    tab.act("lab.pick", rows=[])
    assert told(tab, "table", picked=0)["total"] == 13


def test_a_second_model_adds_its_ranks(tab: Tab, findings: LabFindings, workspace: Workspace) -> None:
    tab.open("?panel=lab&ranks-of=1")
    told(tab, "query")
    tab.until(lambda last: last["panel"]["message"].get("table", {}).get("models"))
    head = tab.last["panel"]["message"]["table"]
    assert [one["name"] for one in head["columns"]][1:3] == ["rank A", "rank B"]
    other = workspace.beside[0].workspace
    assert head["models"] == [workspace.model_name, other.model_name]
    ranked = other.ranked_as(findings.task)
    known = findings.graded.known
    assert head["counts"]["only A"] == int((findings.graded.hits & known & (ranked.ranks != 0)).sum())
    assert head["counts"]["only B"] == int((known & ~findings.graded.hits & (ranked.ranks == 0)).sum())
    tab.set(lab_where="rank A > 1 and rank B = 1")
    assert told(tab, "table", where="rank A > 1 and rank B = 1")["total"] == head["counts"]["only B"]


def test_notes_are_kept_beside_the_data_and_a_change_of_others_is_told(
    tab: Tab, workspace: Workspace, app: App
) -> None:
    lab = lab_of(workspace)
    tab.open("?panel=lab&query=~0")
    shown = told(tab, "query", query=0)
    note = {"task": shown["task"], "query": 0}
    before = {"tags": "", "text": ""}
    tab.act("lab.note", **note, tags="night blur", text="dark", before=before)
    told(tab, "saved", good=True)
    assert "night blur,dark" in (workspace.root / "notes.csv").read_text()
    told(tab, "query", note={"tags": "night blur", "text": "dark", "place": lab.notes_place})
    found = lab.findings(TASK)
    lab.set_note(found.table.paths[0], "day", "bright", Note(("night", "blur"), "dark"))
    tab.act("lab.note", **note, tags="mine", text="", before={"tags": "night blur", "text": "dark"})
    refused = told(tab, "saved", good=False)
    assert refused["stored"] == {"tags": "day", "text": "bright"}
    tab.act("lab.note", **note, tags="mine", text="", before=refused["stored"])
    told(tab, "saved", good=True)
    tab.set(lab_where="wind > 130")
    count = told(tab, "table", where="wind > 130")["total"]
    tab.act("lab.tag", tags="high")
    told(tab, "saved", good=True, query=-1)
    tab.set(lab_where="tags ~ high")
    assert told(tab, "table", where="tags ~ high")["total"] == count
    tab.act("lab.tag", tags="!")
    told(tab, "saved", good=False, query=-1)
    tab.act("lab.csv")
    file = tab.until(lambda last: "download" in last)["download"]
    assert file["name"].endswith(f"-{count}-queries.csv")
    assert len(get(app, "/" + file["address"])[2].decode().strip().splitlines()) == count + 1
