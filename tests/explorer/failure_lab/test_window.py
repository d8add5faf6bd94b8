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
from explorer.failure_lab import breakdown_page, messages, state, table
from explorer.failure_lab.map_drawing import DrawnMap, draw
from explorer.failure_lab.map_page import MapPage
from explorer.failure_lab.messages import OpenPoint, SaveNote, SelectBin, SelectRectangle, ShowMap
from explorer.failure_lab.note_form import NoteForm
from explorer.failure_lab.service import FailureLab, Findings, MapPoints
from explorer.failure_lab.state import LabState, Selection
from explorer.opening import open_model
from explorer.session_state import SessionState
from explorer.web.html import Html
from explorer.workspace import Workspace
from lpn.analysis import breakdown, notes
from lpn.core.errors import InputError, OutputError
from lpn.core.tables import Column, Table, number_column, text_column
from lpn.drawing import theme
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
def service(workspace: Workspace) -> FailureLab:
    return FailureLab(workspace)


@pytest.fixture
def findings(service: FailureLab) -> Findings:
    assert service.build(TASK, None).wait(120)
    computed = service.findings(TASK)
    assert computed is not None
    return computed


@pytest.fixture
def lab() -> LabState:
    return LabState(TASK)


def failures(findings: Findings) -> list[int]:
    return np.flatnonzero(findings.outcomes.failed).tolist()


def test_the_table_is_made_once_for_all_who_ask(service: FailureLab) -> None:
    first, second = service.build(TASK, "one"), service.build(TASK, "other")
    assert first is second
    assert first.wait(120)
    assert (first.done, first.total) == (13, 13)
    assert service.findings(TASK) is service.findings(TASK)


def test_ranks_are_those_of_the_explorer(workspace: Workspace, findings: Findings) -> None:
    np.testing.assert_array_equal(findings.outcomes.rank, workspace.rankings[TASK].ranks)
    assert findings.table.columns["part"].values[0] in workspace.part_names
    assert {"distance", "altitude", "weather", "tags"} <= set(findings.table.columns)


def test_choices_narrow_each_other(findings: Findings, lab: LabState) -> None:
    failed = failures(findings)
    assert state.selected_rows(findings, replace(lab, outcome="failed")).tolist() == failed
    both = state.add_selection(replace(lab, outcome="failed"), Selection("some", "some", np.array([*failed[:2], 12])))
    assert set(state.selected_rows(findings, both)) == {*failed[:2]} | ({12} & set(failed))
    assert state.selected_rows(findings, both, without="some").tolist() == failed
    assert 12 in state.selected_rows(findings, both, any_outcome=True)
    named = replace(lab, name_search="0009")
    assert [findings.task.queries[row].name for row in state.selected_rows(findings, named)] == ["0009"]
    assert state.selected_rows(findings, state.clear(both)).tolist() == list(range(13))


def test_another_choice_of_one_kind_takes_the_place_of_the_last(lab: LabState) -> None:
    one, other, third = (
        Selection(kind, words, np.zeros(0, int)) for kind, words in (("a", "x"), ("b", "y"), ("a", "z"))
    )
    narrowed = lab
    for pick in (one, other, third):
        narrowed = state.add_selection(replace(narrowed, page=3), pick)
        assert narrowed.page == 0
    assert narrowed.selections == (other, third)
    assert state.remove_selection(narrowed, "b").selections == (third,)


def test_sorting_twice_turns_the_order_round(findings: Findings, lab: LabState) -> None:
    by_rank = state.sort_by(lab, "rank")
    assert findings.outcomes.rank[state.sorted_rows(findings, by_rank)].tolist() == sorted(
        findings.outcomes.rank.tolist()
    )
    again = state.sort_by(by_rank, "rank")
    assert again.descending
    assert findings.outcomes.rank[state.sorted_rows(findings, again)].tolist() == sorted(findings.outcomes.rank)[::-1]
    assert not state.sort_by(again, "name").descending


def test_a_wrong_filter_is_said_and_leaves_the_table(findings: Findings, lab: LabState) -> None:
    right = state.set_filter(lab, "altitude > 100 and weather = sun", findings.table)
    assert len(state.selected_rows(findings, right)) == 4
    wrong = state.set_filter(right, "weather > 3 <script>", findings.table)
    assert (wrong.filter, wrong.filter_typed) == (right.filter, "weather > 3 <script>")
    assert "weather" in wrong.filter_error
    html = table.summary(findings, wrong, state.selected_rows(findings, wrong), (0, 9))
    assert "4 of 13 queries" in html
    assert 'role="alert"' in html
    assert "<script>" not in html + table.search_boxes(findings, wrong)
    assert state.set_filter(wrong, "", findings.table).filter_error == ""


def test_a_chart_is_not_narrowed_by_the_choice_made_in_it(findings: Findings, lab: LabState) -> None:
    weather = findings.table.columns["weather"]
    all_rates = state.failure_rates(findings, lab, weather)
    assert {rate.name for rate in all_rates} == set(WEATHERS)
    for said in WEATHERS:
        index = [rate.name for rate in all_rates].index(said)
        pick = state.select_bin(findings, lab, "weather", index, said)
        assert pick is not None
        assert pick.rows.tolist() == np.flatnonzero(weather.values == said).tolist()
        chosen = state.add_selection(replace(lab, outcome="failed"), pick)
        assert state.failure_rates(findings, chosen, weather) == all_rates
        altitude = state.failure_rates(findings, chosen, findings.table.columns["heading"])
        assert sum(rate.queries for rate in altitude) in (len(pick.rows), 13)
    assert state.select_bin(findings, lab, "weather", 0, "hail") is None
    assert state.select_bin(findings, lab, "weather", 3, "sun") is None
    assert state.select_bin(findings, lab, "weather", -1, all_rates[-1].name) is None
    assert state.select_bin(findings, lab, "latitude", 0, "46") is None


def test_a_bin_of_numbers_holds_the_queries_it_counts(findings: Findings, lab: LabState) -> None:
    for index, rate in enumerate(state.failure_rates(findings, lab, findings.table.columns["heading"])):
        pick = state.select_bin(findings, lab, "heading", index, rate.name)
        assert pick is not None
        assert len(pick.rows) == rate.queries
        assert int(findings.outcomes.failed[pick.rows].sum()) == rate.failures


def known_of(findings: Findings, column: Column) -> Findings:
    return replace(findings, table=findings.table.with_columns([column]))


def test_bins_of_large_numbers_are_told_apart(findings: Findings, lab: LabState) -> None:
    seconds = 1_700_000_000 + 150.0 * np.arange(13)
    timed = known_of(findings, number_column("time", seconds, "s"))
    bins = state.failure_rates(timed, lab, timed.table.columns["time"])
    assert len({rate.name for rate in bins}) == len(bins) == 5
    assert bins[0].name.startswith("1700000000 to 17000003")
    for index, rate in enumerate(bins):
        chosen = messages.apply(SelectBin("time", index, rate.name), lab, timed)
        assert seconds[chosen.selections[0].rows].min() == rate.low
        assert len(chosen.selections[0].rows) == rate.queries


def test_a_value_called_not_known_is_not_what_is_not_known(findings: Findings, lab: LabState) -> None:
    values = ["not known"] * 4 + [""] * 5 + ["sun"] * 4
    told = known_of(findings, text_column("sky", values))
    bins = state.failure_rates(told, lab, told.table.columns["sky"])
    picked = [state.select_bin(told, lab, "sky", index, rate.name) for index, rate in enumerate(bins)]
    rows = {tuple(pick.rows.tolist()) for pick in picked if pick is not None}
    assert rows == {(0, 1, 2, 3), (4, 5, 6, 7, 8), (9, 10, 11, 12)}


def test_a_chart_says_which_queries_it_counts(workspace: Workspace, findings: Findings, lab: LabState) -> None:
    some = Selection("some", "some", np.array([failures(findings)[0], np.flatnonzero(~findings.outcomes.failed)[0]]))
    assert "Failures by weather, of all 13 queries" in breakdown_page.page(findings, lab, workspace)
    assert "Failures by weather, of 2 queries" in breakdown_page.page(
        findings, state.add_selection(lab, some), workspace
    )
    # Among failures alone every rate would be 100 %.
    assert "Failures by weather, of all 13 queries" in breakdown_page.page(
        findings, replace(lab, filter="rank > 1"), workspace
    )


def test_a_report_says_all_that_chose_and_ordered_its_queries(findings: Findings, lab: LabState) -> None:
    assert state.describe(findings, lab) == "all, sorted by margin"
    pair = Selection("pair", "0449 taken for 0450", np.array([1, 2]))
    part = Selection("part", "part ring 1 costs most", np.array([1]))
    busy = state.add_selection(
        state.add_selection(replace(lab, outcome="failed", filter="rank > 1 ", name_search=" 0002 "), pair), part
    )
    assert state.describe(findings, replace(busy, sort_column="rank", descending=True)) == (
        "failed and rank > 1 and name ~ 0002 and 0449 taken for 0450 and part ring 1 costs most, sorted by rank, descending"
    )
    assert state.describe(findings, replace(lab, sort_column="gone")) == "all, sorted by margin"


def test_pairs_and_parts_choose_the_failures_they_count(
    workspace: Workspace, findings: Findings, lab: LabState
) -> None:
    task = findings.task
    for one in breakdown.confusions(findings.outcomes, task.query_labels, task.gallery_labels):
        pick = state.select_pair(findings, lab, one.place, one.answered)
        assert pick is not None
        assert pick.rows.tolist() == one.queries.tolist()
        assert pick.label == f"{one.place:04d} taken for {one.answered:04d}"
    assert state.select_pair(findings, lab, 1, 999) is None
    blamed = [state.select_part(findings, part) for part in range(len(workspace.part_names))]
    assert [len(pick.rows) for pick in blamed] == breakdown.blame(findings.outcomes).tolist()
    assert sorted(row for pick in blamed for row in pick.rows) == failures(findings)


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
def test_what_is_no_message_changes_nothing(findings: Findings, lab: LabState, kind: str, value: Any) -> None:
    message = messages.decode(kind, value)
    assert message is None or messages.apply(message, lab, findings) is lab


def test_a_second_click_takes_a_choice_away(findings: Findings, lab: LabState) -> None:
    index = [rate.name for rate in state.failure_rates(findings, lab, findings.table.columns["weather"])].index("sun")
    message = SelectBin("weather", index, "sun")
    once = messages.apply(message, lab, findings)
    assert [pick.label for pick in once.selections] == ["weather sun"]
    assert messages.apply(message, once, findings).selections == ()


@pytest.mark.parametrize("value", [[0.5], [0, "1"], [-0.1, 0], [0, math.nan], [True, 0], None, [0, 1, 0]])
def test_points_of_a_map_are_fractions(value: Any) -> None:
    assert messages.decode("lab-point", ["pca", value]) is None
    assert messages.decode("lab-point", ["pca", [0, 0.25]]) == OpenPoint("pca", (0.0, 0.25))


def plane(count: int = 9, fit: bool = False, chosen: list[int] | None = None) -> tuple[DrawnMap, np.ndarray]:
    """Queries on a diagonal, every third of them failed."""
    places = np.column_stack([np.arange(count), np.arange(count)]).astype(float)
    failed = np.arange(count) % 3 == 0
    mask = np.isin(np.arange(count), range(count) if chosen is None else chosen)
    points = MapPoints(places, places + 0.25)
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
        shown, other = (theme.FALSE_COLOUR, theme.TRUE_COLOUR)[:: 1 if bad else -1]
        count = int((patch == shown).all(axis=1).sum())
        assert count > 20
        assert not (patch == other).all(axis=1).any()
        beside = drawn.picture[line, column + 5]
        assert tuple(beside) != theme.FALSE_COLOUR  # a cross has nothing there, a dot has
        assert (tuple(beside) == theme.TRUE_COLOUR) == (not bad)
    assert drawn.near(0.02, 0.02).tolist() == []


def test_fitting_shows_the_chosen_queries_only_and_clicks_mean_them_first() -> None:
    drawn, _ = plane(fit=True, chosen=[3, 4])
    assert drawn.inside((0, 0), (1, 1)).tolist() == [3, 4]
    places = np.zeros((4, 2))
    chosen = np.array([False, True, False, True])
    same = draw(MapPoints(places, places), chosen, chosen, np.zeros(4, np.int64), (400, 300), False)
    assert same.near(0.5, 0.5).tolist() == [1, 3]


def test_a_place_of_several_queries_shows_the_share_that_failed() -> None:
    places = np.zeros((4, 2))
    ground = np.full((10, 10, 3), 200, np.uint8), (-100.0, -100.0, 100.0, 100.0)
    failed = np.array([True, False, False, False])
    points = MapPoints(places, places, ground=ground)
    drawn = draw(points, failed, np.ones(4, bool), np.full(4, -1), (400, 300), False)
    patch = drawn.picture[280:321, 380:421].reshape(-1, 3)
    blue, yellow = (int((patch == colour).all(axis=1).sum()) for colour in (theme.FALSE_COLOUR, theme.TRUE_COLOUR))
    assert blue / (blue + yellow) == pytest.approx(0.25, abs=0.06)
    assert tuple(drawn.picture[500, 400]) == (100, 100, 100)  # the ground, dimmed


def test_a_map_is_kept_until_something_on_it_changes(service: FailureLab, findings: Findings, lab: LabState) -> None:
    view, rows = MapPage(service, "me"), findings.table.rows()
    for kind in ("pca", "ground"):
        shown = replace(lab, map=kind)
        for _ in range(50):
            html, ready = view.page(findings, shown, 0, rows, (760, 400))
            if ready:
                break
        assert f'data-map="{kind}"' in html
        drawn = view.drawn
        assert drawn is not None
        assert view.page(findings, shown, 0, rows, (760, 400))[0] == html
        assert view.drawn is drawn
        view.page(findings, shown, 1, rows, (760, 400))
        assert view.drawn is not drawn
        assert view.queries_at(findings, replace(lab, map="umap"), OpenPoint(kind, (0.5, 0.5))) is None
        chosen = view.select_rectangle(shown, SelectRectangle(kind, (0, 0), (1, 1)))
        assert chosen.selections[0].rows.tolist() == list(range(13))
        assert view.select_rectangle(shown, SelectRectangle("umap", (0, 0), (1, 1))) is shown
        for wrong in ([kind, [0, 0]], [kind, [0, 0], [2, 1]], None):
            assert messages.decode("lab-rect", wrong) is None
    without_places = replace(findings, task=replace(findings.task, geometry=None))
    assert messages.apply(ShowMap("ground"), lab, without_places) is lab


def test_names_and_metadata_never_become_html(workspace: Workspace, findings: Findings, lab: LabState) -> None:
    chosen = replace(lab, columns=("weather",))
    html = table.table(findings, chosen, workspace, findings.table.rows(), 3)
    html += breakdown_page.page(findings, chosen, workspace) + table.column_choice(findings, chosen)
    assert "<b>rain" not in html
    assert "&lt;b&gt;rain" in html
    assert html.count('class="chosen" data-row="3"') == 1
    # The click on a bin says its name as it is.
    assert re.search(r'\["weather", \d, "say \\"hi\\""\]', unescape(html))
    said = table.note(findings, 0, notes.Note(("a",), "</textarea><script>"), 1)
    assert "<script>" not in said


def test_a_page_has_as_many_rows_as_are_shown_and_an_empty_one_says_what_to_do(
    workspace: Workspace, findings: Findings, lab: LabState
) -> None:
    assert table.table(findings, lab, workspace, findings.table.rows()[:5], None).count("<tr data-row") == 5
    assert "lab-clear" in table.table(findings, lab, workspace, findings.table.rows()[:0], None)


def test_notes_reach_every_table_and_the_disk(workspace: Workspace, service: FailureLab, findings: Findings) -> None:
    path = findings.table.paths[2]
    service.set_note(path, "night, blur", "Looks like\nthe twin.")
    try:
        newest = service.findings(TASK)
        assert newest is not None
        assert newest.note(2) == notes.Note(("night", "blur"), "Looks like\nthe twin.")
        assert newest.table.filter(newest.table.rows(), "tags ~ night").tolist() == [2]
        assert notes.read_notes(workspace.root / "notes.csv")[path].tags == ("night", "blur")
        other = FailureLab(workspace)
        other.build(TASK, None).wait(120)
        again = other.findings(TASK)
        assert again is not None
        assert again.note(2) == newest.note(2)
        with pytest.raises(InputError, match="no/word"):
            service.set_note(path, "no/word", "")
        (workspace.root / "notes.csv").write_text("what,is\n")
        damaged = FailureLab(workspace)
        damaged.build(TASK, None).wait(120)
        without = damaged.findings(TASK)
        assert without is not None
        assert "expected path,tags,note" in without.notes_error
        assert "left out" in table.summary(without, LabState(TASK), without.table.rows(), (0, 5))
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
    workspace: Workspace, service: FailureLab, findings: Findings, monkeypatch: pytest.MonkeyPatch
) -> None:
    named = list(findings.table.paths)
    named[2] = "test/query_drone/0002/caf\udce9.webp"
    odd = replace(findings, table=Table(named, list(findings.table.columns.values())))
    monkeypatch.setitem(service._findings, TASK, odd)
    gui = Gui()
    Html(gui, "caf\udce9").show("<b>caf\udce9.webp</b>")  # type: ignore[arg-type]
    assert gui.elements[0].content == "<b>caf?.webp</b>"
    view = NoteForm(gui, service)  # type: ignore[arg-type]
    view.show(odd, 2)
    boxes, message = gui.elements[1:]
    assert f'data-task="{TASK}" data-row="2"' in boxes.content
    assert not view.save(SaveNote(TASK, 2, "night", "text"))
    assert "Not saved. The query&#39;s path is" in message.content
    assert "rename the file" in message.content
    for wrong in (None, [TASK, True, "", ""], [TASK, 2, "", 3], [[], 2, "", ""], [TASK, -1, "", ""], [TASK, 2, ""]):
        assert messages.decode("lab-note", wrong) is None
    assert not view.save(SaveNote(TASK, 13, "", ""))
    assert not view.save(SaveNote("moon", 2, "", ""))
    assert not (workspace.root / "notes.csv").exists()
    assert view.save(SaveNote(TASK, 3, "night", "text"))
    assert notes.read_notes(workspace.root / "notes.csv") == {named[3]: notes.Note(("night",), "text")}
    (workspace.root / "notes.csv").unlink()


def test_notes_that_cannot_be_written_are_said_and_nothing_is_changed(workspace: Workspace) -> None:
    file = workspace.root / "notes.csv"
    file.mkdir()
    try:
        service = FailureLab(workspace)
        service.build(TASK, None).wait(120)
        findings = service.findings(TASK)
        assert findings is not None
        assert "cannot be read" in findings.notes_error
        with pytest.raises(OutputError, match=r"notes\.csv cannot be written"):
            service.set_note(findings.table.paths[0], "night", "")
        assert service.findings(TASK) is findings
    finally:
        file.rmdir()


def test_next_and_previous_go_through_an_order() -> None:
    session, order = SessionState(TASK, 4, query=7), np.array([3, 7, 5])
    assert session_state.step_in_order(session, 1, order, 13).query == 5
    assert session_state.step_in_order(replace(session, query=5), 1, order, 13).query == 3
    assert session_state.step_in_order(session, -1, order, 13).query == 3
    assert [session_state.step_in_order(replace(session, query=0), by, order, 13).query for by in (1, -1)] == [3, 5]
    assert session_state.step_in_order(session, 1, order[:0], 13) is session


def test_another_task_begins_with_all_its_queries(lab: LabState) -> None:
    busy = replace(
        lab, filter="rank > 1", selections=(Selection("a", "x", np.zeros(0, int)),), page=4, tab="maps", tall=True
    )
    other = state.for_task(busy, "satellite-to-drone")
    assert (other.filter, other.selections, other.page) == ("", (), 0)
    assert (other.tab, other.tall) == ("maps", True)
    assert state.for_task(busy, TASK) is busy
