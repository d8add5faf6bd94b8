from __future__ import annotations

import math
import re
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from explorer import session_state
from explorer.failure_lab import charts, lab_state, messages, table
from explorer.failure_lab.lab_state import LabState, Pick
from explorer.failure_lab.map_drawing import Drawn, draw
from explorer.failure_lab.service import Findings, Laboratory, Points
from explorer.failure_lab.views import MapView, NoteView
from explorer.opening import open_model
from explorer.session_state import SessionState
from explorer.web.html import Html
from explorer.workspace import Workspace
from lpn.analysis import breakdown, notes
from lpn.core.errors import InputError, OutputError
from lpn.core.tables import Column, Table, number_column, text_column
from lpn.drawing import overlays
from tools.fixtures import small_worlds

TASK = "drone-to-satellite"
WEATHERS = ("<b>rain", 'say "hi"', "sun")


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory, model_file: Path) -> Workspace:
    data = small_worlds.map_dataset(
        small_worlds.make_dataset(tmp_path_factory.mktemp("lab") / "places", train=1, test=13)
    )
    lines = ["path,weather"]
    for i, file in enumerate(sorted((data / "test" / "query_drone").rglob("*.png"))):
        said = WEATHERS[i % 3].replace('"', '""')
        lines.append(f'{file.relative_to(data).as_posix()},"{said}"')
    (data / "metadata.csv").write_text("\n".join(lines))
    opened = open_model(data, model_file)
    # An untrained network finds some places of 13, and which ones is up to its weights: these tests need both kinds.
    assert 0 < (opened.rankings[TASK].ranks > 0).sum() < 13
    return opened


@pytest.fixture
def laboratory(workspace: Workspace) -> Laboratory:
    return Laboratory(workspace)


@pytest.fixture
def found(laboratory: Laboratory) -> Findings:
    assert laboratory.build(TASK, None).wait(120)
    findings = laboratory.findings(TASK)
    assert findings is not None
    return findings


@pytest.fixture
def lab() -> LabState:
    return LabState(TASK)


def failures(found: Findings) -> list[int]:
    return np.flatnonzero(found.outcomes.failed).tolist()


def test_the_table_is_made_once_for_all_who_ask(laboratory: Laboratory) -> None:
    first, second = laboratory.build(TASK, "one"), laboratory.build(TASK, "other")
    assert first is second
    assert first.wait(120)
    assert (first.done, first.total) == (13, 13)
    assert laboratory.findings(TASK) is laboratory.findings(TASK)


def test_ranks_are_those_of_the_explorer(workspace: Workspace, found: Findings) -> None:
    np.testing.assert_array_equal(found.outcomes.rank, workspace.rankings[TASK].ranks)
    assert found.table.columns["part"].values[0] in workspace.part_names
    assert {"distance", "altitude", "weather", "tags"} <= set(found.table.columns)


def test_choices_narrow_each_other(found: Findings, lab: LabState) -> None:
    failed = failures(found)
    assert lab_state.select(found, replace(lab, outcome="failed")).tolist() == failed
    both = lab_state.picked(replace(lab, outcome="failed"), Pick("some", "some", np.array([*failed[:2], 12])))
    assert set(lab_state.select(found, both)) == {*failed[:2]} | ({12} & set(failed))
    assert lab_state.select(found, both, without="some").tolist() == failed
    assert 12 in lab_state.select(found, both, whatever=True)
    named = replace(lab, find="0009")
    assert [found.task.queries[row].name for row in lab_state.select(found, named)] == ["0009"]
    assert lab_state.select(found, lab_state.cleared(both)).tolist() == list(range(13))


def test_another_choice_of_one_kind_takes_the_place_of_the_last(lab: LabState) -> None:
    one, other, third = (Pick(kind, words, np.zeros(0, int)) for kind, words in (("a", "x"), ("b", "y"), ("a", "z")))
    state = lab
    for pick in (one, other, third):
        state = lab_state.picked(replace(state, page=3), pick)
        assert state.page == 0
    assert state.picks == (other, third)
    assert lab_state.unpicked(state, "b").picks == (third,)


def test_sorting_twice_turns_the_order_round(found: Findings, lab: LabState) -> None:
    rows = found.table.rows()
    by_rank = lab_state.sorted_by(lab, "rank")
    assert found.outcomes.rank[lab_state.order(found, by_rank, rows)].tolist() == sorted(found.outcomes.rank.tolist())
    again = lab_state.sorted_by(by_rank, "rank")
    assert again.descending
    assert found.outcomes.rank[lab_state.order(found, again, rows)].tolist() == sorted(found.outcomes.rank)[::-1]
    assert not lab_state.sorted_by(again, "name").descending


def test_a_wrong_filter_is_said_and_leaves_the_table(found: Findings, lab: LabState) -> None:
    right = lab_state.filtered(lab, "altitude > 100 and weather = sun", found.table)
    assert len(lab_state.select(found, right)) == 4
    wrong = lab_state.filtered(right, "weather > 3 <script>", found.table)
    assert (wrong.where, wrong.typed) == (right.where, "weather > 3 <script>")
    assert "weather" in wrong.flaw
    html = table.said(found, wrong, lab_state.select(found, wrong), (0, 9))
    assert "4 of 13 queries" in html
    assert "role='alert'" in html
    assert "<script>" not in html + table.boxes(found, wrong)
    assert lab_state.filtered(wrong, "", found.table).flaw == ""


def test_a_chart_is_not_narrowed_by_the_choice_made_in_it(found: Findings, lab: LabState) -> None:
    weather = found.table.columns["weather"]
    all_rates = lab_state.rates(found, lab, weather)
    assert {rate.name for rate in all_rates} == set(WEATHERS)
    for said in WEATHERS:
        index = [rate.name for rate in all_rates].index(said)
        pick = lab_state.pick_bin(found, lab, "weather", index, said)
        assert pick is not None
        assert pick.rows.tolist() == np.flatnonzero(weather.values == said).tolist()
        chosen = lab_state.picked(replace(lab, outcome="failed"), pick)
        assert lab_state.rates(found, chosen, weather) == all_rates
        altitude = lab_state.rates(found, chosen, found.table.columns["heading"])
        assert sum(rate.queries for rate in altitude) in (len(pick.rows), 13)
    assert lab_state.pick_bin(found, lab, "weather", 0, "hail") is None
    assert lab_state.pick_bin(found, lab, "weather", 3, "sun") is None
    assert lab_state.pick_bin(found, lab, "weather", -1, all_rates[-1].name) is None
    assert lab_state.pick_bin(found, lab, "latitude", 0, "46") is None


def test_a_bin_of_numbers_holds_the_queries_it_counts(found: Findings, lab: LabState) -> None:
    for index, rate in enumerate(lab_state.rates(found, lab, found.table.columns["heading"])):
        pick = lab_state.pick_bin(found, lab, "heading", index, rate.name)
        assert pick is not None
        assert len(pick.rows) == rate.queries
        assert int(found.outcomes.failed[pick.rows].sum()) == rate.failures


def known_of(found: Findings, column: Column) -> Findings:
    return replace(found, table=found.table.with_columns([column]))


def test_bins_of_large_numbers_are_told_apart(found: Findings, lab: LabState) -> None:
    seconds = 1_700_000_000 + 150.0 * np.arange(13)
    timed = known_of(found, number_column("time", seconds, "s"))
    bins = lab_state.rates(timed, lab, timed.table.columns["time"])
    assert len({rate.name for rate in bins}) == len(bins) == 5
    assert bins[0].name.startswith("1700000000 to 17000003")
    for index, rate in enumerate(bins):
        chosen = messages.of_bin(lab, timed, ["time", index, rate.name])
        assert chosen is not None
        assert seconds[chosen.picks[0].rows].min() == rate.low
        assert len(chosen.picks[0].rows) == rate.queries


def test_a_value_called_not_known_is_not_what_is_not_known(found: Findings, lab: LabState) -> None:
    values = ["not known"] * 4 + [""] * 5 + ["sun"] * 4
    told = known_of(found, text_column("sky", values))
    bins = lab_state.rates(told, lab, told.table.columns["sky"])
    picked = [lab_state.pick_bin(told, lab, "sky", index, rate.name) for index, rate in enumerate(bins)]
    rows = {tuple(pick.rows.tolist()) for pick in picked if pick is not None}
    assert rows == {(0, 1, 2, 3), (4, 5, 6, 7, 8), (9, 10, 11, 12)}


def test_a_chart_says_which_queries_it_counts(workspace: Workspace, found: Findings, lab: LabState) -> None:
    some = Pick("some", "some", np.array([failures(found)[0], np.flatnonzero(~found.outcomes.failed)[0]]))
    assert "Failures by weather, of all 13 queries" in charts.page(found, lab, workspace)
    assert "Failures by weather, of 2 queries" in charts.page(found, lab_state.picked(lab, some), workspace)
    # Among failures alone every rate would be 100 %.
    assert "Failures by weather, of all 13 queries" in charts.page(found, replace(lab, where="rank > 1"), workspace)


def test_a_report_says_all_that_chose_and_ordered_its_queries(found: Findings, lab: LabState) -> None:
    assert lab_state.words(found, lab) == "all, sorted by margin"
    pair = Pick("pair", "0449 taken for 0450", np.array([1, 2]))
    part = Pick("part", "part ring 1 costs most", np.array([1]))
    busy = lab_state.picked(
        lab_state.picked(replace(lab, outcome="failed", where="rank > 1 ", find=" 0002 "), pair), part
    )
    assert lab_state.words(found, replace(busy, sort="rank", descending=True)) == (
        "failed and rank > 1 and name ~ 0002 and 0449 taken for 0450 and part ring 1 costs most, sorted by rank, descending"
    )
    assert lab_state.words(found, replace(lab, sort="gone")) == "all, sorted by margin"


def test_pairs_and_parts_choose_the_failures_they_count(workspace: Workspace, found: Findings, lab: LabState) -> None:
    task = found.task
    for one in breakdown.confusions(found.outcomes, task.query_labels, task.gallery_labels):
        pick = lab_state.pick_pair(found, lab, one.place, one.answered)
        assert pick is not None
        assert pick.rows.tolist() == one.queries.tolist()
        assert pick.words == f"{one.place:04d} taken for {one.answered:04d}"
    assert lab_state.pick_pair(found, lab, 1, 999) is None
    blamed = [lab_state.pick_part(found, part, name) for part, name in enumerate(workspace.part_names)]
    assert [len(pick.rows) for pick in blamed] == breakdown.blame(found.outcomes).tolist()
    assert sorted(row for pick in blamed for row in pick.rows) == failures(found)


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("lab-tab", "other"),
        ("lab-tab", ["table"]),
        ("lab-outcome", None),
        ("lab-sort", "password"),
        ("lab-sort", {"a": 1}),
        ("lab-find", 7),
        ("lab-where", None),
        ("lab-column", []),
        ("lab-unpick", 3),
        ("lab-pair", [1, "2"]),
        ("lab-pair", [True, 2]),
        ("lab-pair", 3),
        ("lab-bin", ["weather", 0, None]),
        ("lab-bin", ["weather", True, "sun"]),
        ("lab-bin", ["weather", "sun"]),
        ("lab-bin", ["margin", 0, "1"]),
        ("lab-map", "moon"),
    ],
)
def test_what_is_no_message_changes_nothing(found: Findings, lab: LabState, kind: str, value: Any) -> None:
    assert messages.WITH_TABLE[kind](lab, found, value) is None


def test_a_second_click_takes_a_choice_away(found: Findings, lab: LabState) -> None:
    index = [rate.name for rate in lab_state.rates(found, lab, found.table.columns["weather"])].index("sun")
    once = messages.of_bin(lab, found, ["weather", index, "sun"])
    assert once is not None
    assert [pick.words for pick in once.picks] == ["weather sun"]
    twice = messages.of_bin(once, found, ["weather", index, "sun"])
    assert twice is not None
    assert twice.picks == ()


@pytest.mark.parametrize("value", [[0.5], [0, "1"], [-0.1, 0], [0, math.nan], [True, 0], None, [0, 1, 0]])
def test_points_of_a_map_are_fractions(value: Any) -> None:
    assert messages.point(value) is None
    assert messages.point([0, 0.25]) == (0.0, 0.25)


def plane(count: int = 9, fit: bool = False, chosen: list[int] | None = None) -> tuple[Drawn, np.ndarray]:
    """Queries on a diagonal, every third of them failed."""
    places = np.column_stack([np.arange(count), np.arange(count)]).astype(float)
    failed = np.arange(count) % 3 == 0
    mask = np.isin(np.arange(count), range(count) if chosen is None else chosen)
    points = Points(places, places + 0.25)
    return draw(points, failed, mask, np.zeros(count, np.int64), (400, 300), fit), failed


def test_a_rectangle_holds_what_is_drawn_in_it() -> None:
    drawn, _ = plane()
    assert drawn.picture.shape == (600, 800, 3)
    # In the plane y is upwards: the upper right half of the picture holds the larger numbers.
    assert drawn.inside((0.5, 0.5), (1, 0)).tolist() == [5, 6, 7, 8]
    assert drawn.inside((1, 0), (0.5, 0.5)).tolist() == [5, 6, 7, 8]
    assert drawn.inside((0, 0), (0.3, 0.3)).tolist() == []
    assert drawn.inside((0, 0), (1, 1)).tolist() == list(range(9))


def test_found_and_failed_are_drawn_where_they_are_in_other_shapes() -> None:
    drawn, failed = plane()
    west, south, east, north = drawn.bounds
    for row, bad in enumerate(failed):
        x, y = (row - west) / (east - west), (north - row) / (north - south)
        assert drawn.near(x, y).tolist() == [row]
        column, line = round(x * 800), round(y * 600)
        patch = drawn.picture[line - 12 : line + 13, column - 12 : column + 13].reshape(-1, 3)
        shown, other = (overlays.FALSE_COLOUR, overlays.TRUE_COLOUR)[:: 1 if bad else -1]
        count = int((patch == shown).all(axis=1).sum())
        assert count > 20
        assert not (patch == other).all(axis=1).any()
        beside = drawn.picture[line, column + 5]
        assert tuple(beside) != overlays.FALSE_COLOUR  # a cross has nothing there, a dot has
        assert (tuple(beside) == overlays.TRUE_COLOUR) == (not bad)
    assert drawn.near(0.02, 0.02).tolist() == []


def test_fitting_shows_the_chosen_queries_only_and_clicks_mean_them_first() -> None:
    drawn, _ = plane(fit=True, chosen=[3, 4])
    assert drawn.inside((0, 0), (1, 1)).tolist() == [3, 4]
    places = np.zeros((4, 2))
    chosen = np.array([False, True, False, True])
    same = draw(Points(places, places), chosen, chosen, np.zeros(4, np.int64), (400, 300), False)
    assert same.near(0.5, 0.5).tolist() == [1, 3]


def test_a_place_of_several_queries_shows_the_share_that_failed() -> None:
    places = np.zeros((4, 2))
    ground = np.full((10, 10, 3), 200, np.uint8), (-100.0, -100.0, 100.0, 100.0)
    failed = np.array([True, False, False, False])
    points = Points(places, places, ground=ground)
    drawn = draw(points, failed, np.ones(4, bool), np.full(4, -1), (400, 300), False)
    patch = drawn.picture[280:321, 380:421].reshape(-1, 3)
    blue, yellow = (
        int((patch == colour).all(axis=1).sum()) for colour in (overlays.FALSE_COLOUR, overlays.TRUE_COLOUR)
    )
    assert blue / (blue + yellow) == pytest.approx(0.25, abs=0.06)
    assert tuple(drawn.picture[500, 400]) == (100, 100, 100)  # the ground, dimmed


def test_a_map_is_kept_until_something_on_it_changes(laboratory: Laboratory, found: Findings, lab: LabState) -> None:
    view, rows = MapView(laboratory, "me"), found.table.rows()
    for kind in ("pca", "ground"):
        shown = replace(lab, map=kind)
        for _ in range(50):
            html, ready = view.page(found, shown, 0, rows, (760, 400))
            if ready:
                break
        assert f"data-map='{kind}'" in html
        drawn = view.drawn
        assert drawn is not None
        assert view.page(found, shown, 0, rows, (760, 400))[0] == html
        assert view.drawn is drawn
        view.page(found, shown, 1, rows, (760, 400))
        assert view.drawn is not drawn
        x, y = (0.5, 0.5)
        assert view.at(found, replace(lab, map="umap"), [kind, [x, y]]) is None
        chosen = messages.rectangle(shown, [kind, [0, 0], [1, 1]], view.drawn)
        assert chosen is not None
        assert chosen.picks[0].rows.tolist() == list(range(13))
        for wrong in ([kind, [0, 0]], ["umap", [0, 0], [1, 1]], [kind, [0, 0], [2, 1]], None):
            assert messages.rectangle(shown, wrong, view.drawn) is None
    assert messages.map_kind(lab, replace(found, task=replace(found.task, geometry=None)), "ground") is None


def test_names_and_metadata_never_become_html(workspace: Workspace, found: Findings, lab: LabState) -> None:
    chosen = replace(lab, columns=("weather",))
    html = table.table(found, chosen, workspace, found.table.rows(), 3)
    html += charts.page(found, chosen, workspace) + table.columns(found, chosen)
    assert "<b>rain" not in html
    assert "&lt;b&gt;rain" in html
    assert html.count("class='chosen' data-row='3'") == 1
    # The click on a bin says its name as it is.
    assert re.search(r'\["weather", \d, "say \\"hi\\""\]', unescape(html))
    said = table.note(found, 0, notes.Note(("a",), "</textarea><script>"), 1)
    assert "<script>" not in said


def test_a_page_has_as_many_rows_as_are_shown_and_an_empty_one_says_what_to_do(
    workspace: Workspace, found: Findings, lab: LabState
) -> None:
    assert table.table(found, lab, workspace, found.table.rows()[:5], None).count("<tr class") == 5
    assert "lab-clear" in table.table(found, lab, workspace, found.table.rows()[:0], None)


def test_notes_reach_every_table_and_the_disk(workspace: Workspace, laboratory: Laboratory, found: Findings) -> None:
    path = found.table.paths[2]
    laboratory.say(path, "night, blur", "Looks like\nthe twin.")
    try:
        newest = laboratory.findings(TASK)
        assert newest is not None
        assert newest.note(2) == notes.Note(("night", "blur"), "Looks like\nthe twin.")
        assert newest.table.filter(newest.table.rows(), "tags ~ night").tolist() == [2]
        assert notes.read_notes(workspace.root / "notes.csv")[path].tags == ("night", "blur")
        other = Laboratory(workspace)
        other.build(TASK, None).wait(120)
        again = other.findings(TASK)
        assert again is not None
        assert again.note(2) == newest.note(2)
        with pytest.raises(InputError, match="no/word"):
            laboratory.say(path, "no/word", "")
        (workspace.root / "notes.csv").write_text("what,is\n")
        damaged = Laboratory(workspace)
        damaged.build(TASK, None).wait(120)
        without = damaged.findings(TASK)
        assert without is not None
        assert "expected path,tags,note" in without.flaw
        assert "left out" in table.said(without, LabState(TASK), without.table.rows(), (0, 5))
    finally:
        (workspace.root / "notes.csv").unlink()


class Gui:
    """Takes what only UTF-8 has bytes for, as the connection to a browser does."""

    content: str

    def __init__(self) -> None:
        self.elements: list[Gui] = []

    def add_html(self, content: str) -> Gui:
        self.elements.append(Gui())
        self.elements[-1].content = content
        return self.elements[-1]

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "content":
            value.encode()
        super().__setattr__(name, value)


def test_a_name_that_is_not_utf8_is_shown_and_a_note_on_it_refused_in_words(
    workspace: Workspace, laboratory: Laboratory, found: Findings, monkeypatch: pytest.MonkeyPatch
) -> None:
    named = list(found.table.paths)
    named[2] = "test/query_drone/0002/caf\udce9.webp"
    odd = replace(found, table=Table(named, list(found.table.columns.values())))
    monkeypatch.setitem(laboratory._findings, TASK, odd)
    gui = Gui()
    Html(gui, "caf\udce9").show("<b>caf\udce9.webp</b>")  # type: ignore[arg-type]
    assert gui.elements[0].content == "<b>caf?.webp</b>"
    view = NoteView(gui, laboratory)  # type: ignore[arg-type]
    view.show(odd, 2)
    boxes, message = gui.elements[1:]
    assert f"data-task='{TASK}' data-row='2'" in boxes.content
    assert not view.say([TASK, 2, "night", "text"])
    assert "Not saved. The query&#x27;s path is" in message.content
    assert "rename the file" in message.content
    for wrong in (
        None,
        [TASK, 13, "", ""],
        [TASK, True, "", ""],
        ["moon", 2, "", ""],
        [TASK, 2, "", 3],
        [[], 2, "", ""],
    ):
        assert not view.say(wrong)
    assert not (workspace.root / "notes.csv").exists()
    assert view.say([TASK, 3, "night", "text"])
    assert notes.read_notes(workspace.root / "notes.csv") == {named[3]: notes.Note(("night",), "text")}
    (workspace.root / "notes.csv").unlink()


def test_notes_that_cannot_be_written_are_said_and_nothing_is_changed(workspace: Workspace) -> None:
    file = workspace.root / "notes.csv"
    file.mkdir()
    try:
        laboratory = Laboratory(workspace)
        laboratory.build(TASK, None).wait(120)
        found = laboratory.findings(TASK)
        assert found is not None
        assert "cannot be read" in found.flaw
        with pytest.raises(OutputError, match=r"notes\.csv cannot be written"):
            laboratory.say(found.table.paths[0], "night", "")
        assert laboratory.findings(TASK) is found
    finally:
        file.rmdir()


def test_next_and_previous_go_through_an_order() -> None:
    state, order = SessionState(TASK, 4, query=7), np.array([3, 7, 5])
    assert session_state.walk(state, 1, order, 13).query == 5
    assert session_state.walk(replace(state, query=5), 1, order, 13).query == 3
    assert session_state.walk(state, -1, order, 13).query == 3
    assert [session_state.walk(replace(state, query=0), by, order, 13).query for by in (1, -1)] == [3, 5]
    assert session_state.walk(state, 1, order[:0], 13) is state


def test_another_task_begins_with_all_its_queries(lab: LabState) -> None:
    busy = replace(lab, where="rank > 1", picks=(Pick("a", "x", np.zeros(0, int)),), page=4, tab="maps", tall=True)
    other = lab_state.of_task(busy, "satellite-to-drone")
    assert (other.where, other.picks, other.page) == ("", (), 0)
    assert (other.tab, other.tall) == ("maps", True)
    assert lab_state.of_task(busy, TASK) is busy
