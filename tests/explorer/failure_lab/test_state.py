from __future__ import annotations

from dataclasses import replace

import numpy as np

from explorer.failure_lab import messages, state, table
from explorer.failure_lab.messages import ChooseAllRows, ChooseRows, SelectBin, ShowChosenRows
from explorer.failure_lab.service import Findings
from explorer.failure_lab.state import LabState
from explorer.lab_choices import LabChoices, Selection
from explorer.workspace import Workspace
from lpn.analysis import breakdown
from lpn.core.tables import Column, number_column, text_column
from tests.explorer.failure_lab.conftest import TASK, WEATHERS


def failures(findings: Findings) -> list[int]:
    return np.flatnonzero(findings.outcomes.failed).tolist()


def test_selections_narrow_each_other(findings: Findings, lab: LabState) -> None:
    failed = failures(findings)
    assert state.selected_rows(findings, replace(lab, outcome="failed")).tolist() == failed
    both = state.add_selection(
        replace(lab, outcome="failed"), Selection.of("some", "some", np.array([*failed[:2], 12]))
    )
    assert set(state.selected_rows(findings, both)) == {*failed[:2]} | ({12} & set(failed))
    assert state.selected_rows(findings, both, without="some").tolist() == failed
    assert 12 in state.selected_rows(findings, both, any_outcome=True)
    named = replace(lab, name_search="0009")
    assert [findings.task.queries[row].name for row in state.selected_rows(findings, named)] == ["0009"]
    assert state.selected_rows(findings, state.clear(both)).tolist() == list(range(13))


def test_a_selection_replaces_the_one_of_its_kind(lab: LabState) -> None:
    one, other, third = (
        Selection.of(kind, label, np.zeros(0, int)) for kind, label in (("a", "x"), ("b", "y"), ("a", "z"))
    )
    narrowed = lab
    for selection in (one, other, third):
        narrowed = state.add_selection(narrowed, selection)
    assert narrowed.selections == (other, third)
    assert state.remove_selection(narrowed, "b").selections == (third,)


def test_rows_are_chosen_between_two_queries_in_the_tables_order(findings: Findings, lab: LabState) -> None:
    order = state.sorted_rows(findings, lab)

    def chosen(lab: LabState) -> list[int]:
        return state.chosen_rows(lab, order).tolist()

    assert state.chosen_or_all(lab, order).tolist() == order.tolist()
    added = messages.apply(ChooseRows(int(order[4]), int(order[2]), "add"), lab, findings)
    assert chosen(added) == order[2:5].tolist()
    toggled = messages.apply(ChooseRows(int(order[3]), int(order[3]), "toggle"), added, findings)
    assert chosen(toggled) == order[[2, 4]].tolist()
    assert table.runs(np.isin(order, list(toggled.rows))) == [(2, 2), (4, 4)]
    assert chosen(messages.apply(ChooseRows(int(order[0]), int(order[2]), "drop"), toggled, findings)) == [order[4]]
    assert messages.apply(ChooseRows(int(order[0]), 99, "add"), lab, findings) == lab
    assert len(chosen(messages.apply(ChooseAllRows(), lab, findings))) == len(order)
    shown = messages.apply(ShowChosenRows(), toggled, findings)
    assert state.sorted_rows(findings, shown).tolist() == order[[2, 4]].tolist()
    assert not shown.rows
    assert state.clear(toggled).rows == frozenset()
    hidden = replace(toggled, name_search="nothing has this name")
    assert len(state.chosen_rows(hidden, state.sorted_rows(findings, hidden))) == 0


def test_sorting_twice_turns_the_order_round(findings: Findings, lab: LabState) -> None:
    by_rank = state.sort_by(lab, "rank")
    assert findings.outcomes.rank[state.sorted_rows(findings, by_rank)].tolist() == sorted(
        findings.outcomes.rank.tolist()
    )
    again = state.sort_by(by_rank, "rank")
    assert again.descending
    assert findings.outcomes.rank[state.sorted_rows(findings, again)].tolist() == sorted(findings.outcomes.rank)[::-1]
    assert not state.sort_by(again, "name").descending


def test_what_an_address_keeps_brings_back_the_same_queries(findings: Findings, lab: LabState) -> None:
    lasso = Selection.of("in pca", "lasso on the PCA", np.array([0, 2, 3, 5, 8, 12]))
    shown = state.add_selection(replace(lab, tab="maps", outcome="failed", colour="weather", map="umap"), lasso)
    shown = state.sort_by(state.sort_by(state.set_filter(shown, "altitude > 100", findings.table), "name"), "name")
    shown = state.toggle_column(shown, findings.table, "weather")
    again = state.with_choices(findings, LabState(task=TASK, name_search="gone"), state.choices(shown))
    assert state.choices(again) == state.choices(shown)
    assert len(state.sorted_rows(findings, shown))
    assert state.sorted_rows(findings, again).tolist() == state.sorted_rows(findings, shown).tolist()
    assert state.describe(findings, again) == state.describe(findings, shown)
    assert not again.paused, "who opens the link wants to see the map"


def test_what_an_address_restores_keeps_the_chosen_rows(findings: Findings, lab: LabState) -> None:
    lab = replace(lab, rows=frozenset({1, 3}))
    assert state.with_choices(findings, lab, state.choices(lab)).rows == {1, 3}
    assert not state.from_view(findings, lab, state.to_view(findings, lab, "a view")).rows


def test_a_filter_takes_the_words_that_stand_above_the_columns(findings: Findings, lab: LabState) -> None:
    for plain, expert in (("lead < 0", "margin < 0"), ("place in the list > 1", "rank > 1"), ("ring = 2", "part = 2")):
        shown, same = (state.with_choices(findings, lab, LabChoices(filter=text)) for text in (plain, expert))
        assert not shown.filter_error
        assert state.sorted_rows(findings, shown).tolist() == state.sorted_rows(findings, same).tolist()


def test_an_address_with_a_wrong_filter_shows_all_queries_and_says_so(findings: Findings, lab: LabState) -> None:
    shown = state.with_choices(findings, lab, LabChoices(filter="colour > 3", sort_column="gone", colour="gone"))
    assert "There is no column 'colour'" in shown.filter_error
    assert len(state.sorted_rows(findings, shown)) == 13
    assert state.choices(shown).filter == ""


def test_a_wrong_filter_is_reported_and_changes_nothing(findings: Findings, lab: LabState) -> None:
    right = state.set_filter(lab, "altitude > 100 and weather = sun", findings.table)
    assert len(state.selected_rows(findings, right)) == 4
    wrong = state.set_filter(right, "weather > 3 <script>", findings.table)
    assert (wrong.filter, wrong.filter_typed) == (right.filter, "weather > 3 <script>")
    assert "weather" in wrong.filter_error
    html = table.summary(findings, wrong, state.selected_rows(findings, wrong))
    assert "4 of 13 queries" in html
    assert 'role="alert"' in html
    assert "<script>" not in html + table.search_boxes(findings, wrong)
    assert state.set_filter(wrong, "", findings.table).filter_error == ""


def test_a_chart_is_not_narrowed_by_a_selection_made_in_it(findings: Findings, lab: LabState) -> None:
    weather = findings.table.columns["weather"]
    all_rates = state.failure_rates(findings, lab, weather)
    assert {rate.name for rate in all_rates} == set(WEATHERS)
    counts = []
    for weather_name in WEATHERS:
        index = [rate.name for rate in all_rates].index(weather_name)
        selection = state.select_bin(findings, lab, "weather", index, weather_name)
        assert selection is not None
        assert list(selection.rows) == np.flatnonzero(weather.values == weather_name).tolist()
        chosen = state.add_selection(replace(lab, outcome="failed"), selection)
        assert state.failure_rates(findings, chosen, weather) == all_rates
        failures = int(findings.outcomes.failed[list(selection.rows)].sum())
        expected = len(selection.rows) if 0 < failures < len(selection.rows) else 13  # else every rate would be 0 or 1
        heading = state.failure_rates(findings, chosen, findings.table.columns["heading"])
        assert sum(rate.queries for rate in heading) == expected
        counts.append(expected)
    assert min(counts) < 13, "no selection narrowed the other chart"
    assert state.select_bin(findings, lab, "weather", 0, "hail") is None
    assert state.select_bin(findings, lab, "weather", 3, "sun") is None
    assert state.select_bin(findings, lab, "weather", -1, all_rates[-1].name) is None
    assert state.select_bin(findings, lab, "latitude", 0, "46") is None


def test_a_bin_of_numbers_holds_the_queries_it_counts(findings: Findings, lab: LabState) -> None:
    for index, rate in enumerate(state.failure_rates(findings, lab, findings.table.columns["heading"])):
        selection = state.select_bin(findings, lab, "heading", index, rate.name)
        assert selection is not None
        assert len(selection.rows) == rate.queries
        assert int(findings.outcomes.failed[list(selection.rows)].sum()) == rate.failures


def with_column(findings: Findings, column: Column) -> Findings:
    return replace(findings, table=findings.table.with_columns([column]))


def test_bins_of_large_numbers_are_named_apart(findings: Findings, lab: LabState) -> None:
    seconds = 1_700_000_000 + 150.0 * np.arange(13)
    timed = with_column(findings, number_column("time", seconds, "s"))
    bins = state.failure_rates(timed, lab, timed.table.columns["time"])
    assert len({rate.name for rate in bins}) == len(bins) == 5
    assert bins[0].name.startswith("1700000000 to 17000003")
    for index, rate in enumerate(bins):
        chosen = messages.apply(SelectBin("time", index, rate.name), lab, timed)
        assert seconds[list(chosen.selections[0].rows)].min() == rate.low
        assert len(chosen.selections[0].rows) == rate.queries


def test_a_value_named_not_known_differs_from_a_missing_value(findings: Findings, lab: LabState) -> None:
    values = ["not known"] * 4 + [""] * 5 + ["sun"] * 4
    named = with_column(findings, text_column("sky", values))
    bins = state.failure_rates(named, lab, named.table.columns["sky"])
    selections = [state.select_bin(named, lab, "sky", index, rate.name) for index, rate in enumerate(bins)]
    rows = {selection.rows for selection in selections if selection is not None}
    assert rows == {(0, 1, 2, 3), (4, 5, 6, 7, 8), (9, 10, 11, 12)}


def test_a_description_names_every_condition_and_the_order(findings: Findings, lab: LabState) -> None:
    assert state.describe(findings, lab) == "all, sorted by margin"
    pair = Selection.of("pair", "0449 taken for 0450", np.array([1, 2]))
    part = Selection.of("part", "part ring 1 lowers the margin most", np.array([1]))
    busy = state.add_selection(
        state.add_selection(replace(lab, outcome="failed", filter="rank > 1 ", name_search=" 0002 "), pair), part
    )
    assert state.describe(findings, replace(busy, sort_column="rank", descending=True)) == (
        "failed and rank > 1 and name ~ 0002 and 0449 taken for 0450 and part ring 1 lowers the margin most, "
        "sorted by rank, descending"
    )
    assert state.describe(findings, replace(lab, sort_column="gone")) == "all, sorted by margin"


def test_pairs_and_parts_select_the_failures_they_count(
    workspace: Workspace, findings: Findings, lab: LabState
) -> None:
    task = findings.task
    for one in breakdown.confusions(findings.outcomes, task.query_labels, task.gallery_labels):
        selection = state.select_pair(findings, lab, one.place, one.answered)
        assert selection is not None
        assert list(selection.rows) == one.queries.tolist()
        assert selection.label == f"{one.place:04d} taken for {one.answered:04d}"
    assert state.select_pair(findings, lab, 1, 999) is None
    blamed = [state.select_part(findings, part) for part in range(len(workspace.part_names))]
    assert [len(selection.rows) for selection in blamed] == breakdown.blame(findings.outcomes).tolist()
    assert sorted(row for selection in blamed for row in selection.rows) == failures(findings)


def test_another_task_begins_with_all_its_queries(lab: LabState) -> None:
    busy = replace(
        lab,
        filter="rank > 1",
        selections=(Selection.of("a", "x", np.zeros(0, int)),),
        tab="maps",
        full_height=True,
    )
    other = state.for_task(busy, "satellite-to-drone")
    assert (other.filter, other.selections) == ("", ())
    assert (other.tab, other.full_height) == ("maps", True)
    assert state.for_task(busy, TASK) is busy
