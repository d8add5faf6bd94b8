"""One browser's choices in the failure laboratory, and the queries that they select; no viser here."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from explorer import lab_choices
from explorer.failure_lab.service import Findings
from explorer.lab_choices import LabChoices, OutcomeFilter, Selection, Tab
from lpn.analysis import breakdown
from lpn.analysis.breakdown import Rate
from lpn.analysis.named_views import ChosenQueries, NamedView
from lpn.core.arrays import BoolArray, Int64Array
from lpn.core.errors import InputError
from lpn.core.tables import Column, Table
from lpn.locate.task import REASON
from lpn.tasks import query_outcomes
from lpn.tasks.query_outcomes import RANK_A, RANK_B

# The part of the page that is open below the summary.
Drawer = Literal["", "columns", "tag", "views"]
RowChange = Literal["add", "drop", "toggle"]
_FIXED_COLUMNS = ("name", "rank", "margin", "part", "answer", "distance")
# Columns shown until the user chooses others. A column without any value is left out.
_DEFAULT_COLUMNS = ("altitude", "district", "verdict", "tags")


@dataclass(frozen=True)
class LabState(LabChoices):
    """One browser's choices, and what no address keeps.

    Attributes:
        task: the name of the task.
        filter_typed: the text in the filter's box.
        filter_error: why `filter_typed` is invalid; empty if it is valid.
        rows: queries whose rows are chosen in the table; those that are not shown do not count.
        drawer: what is open below the summary.
        map_chosen: a person or an address chose the map; until then that of the ground comes first where there is one.
        paused: computations that start only on request: kinds of maps, or "table".
        text_revision: number of times that the app, not the user, has changed the text boxes.
    """

    task: str = field(kw_only=True)
    filter_typed: str = ""
    filter_error: str = ""
    rows: frozenset[int] = frozenset()
    drawer: Drawer = ""
    map_chosen: bool = False
    paused: frozenset[str] = frozenset({"umap"})
    text_revision: int = 0


def for_task(lab: LabState, task: str) -> LabState:
    """Return the state for another task, with the choices that suit every task."""
    if lab.task == task:
        return lab
    kept = lab_choices.values_of(lab_choices.for_any_task(lab))
    return LabState(task=task, paused=lab.paused, text_revision=lab.text_revision + 1, **kept)


def choices(lab: LabState) -> LabChoices:
    """Return what an address keeps of the state."""
    return LabChoices(**lab_choices.values_of(lab))


def with_choices(findings: Findings, lab: LabState, wanted: LabChoices) -> LabState:
    """Return the state that shows what an address says; an invalid filter is left out, and told."""
    values = lab_choices.values_of(wanted)
    values["selections"] = tuple(one for one in wanted.selections if not one.rows or one.rows[-1] < len(findings.table))
    del values["filter"]
    in_sight = wanted.tab == "maps"
    lab = replace(
        clear(lab),
        rows=lab.rows,
        map_chosen=lab.map_chosen or in_sight,
        paused=lab.paused - {wanted.map} if in_sight else lab.paused,
        **values,
    )
    return set_filter(lab, wanted.filter, findings.table)


def show_tab(findings: Findings, lab: LabState, tab: Tab) -> LabState:
    """Show a tab; see `LabState.map_chosen`."""
    if tab == "maps" and not lab.map_chosen and findings.task.geometry is not None:
        lab = replace(lab, map="ground", map_chosen=True)
    return replace(lab, tab=tab)


def sort_by(lab: LabState, column: str) -> LabState:
    """Sort by a column, or reverse the order if the table is sorted by it already."""
    return replace(lab, sort_column=column, descending=lab.sort_column == column and not lab.descending)


def set_filter(lab: LabState, text: str, table: Table) -> LabState:
    """Apply a filter; an invalid filter does not change the selected queries."""
    try:
        table.filter(table.rows(), text)
    except InputError as error:
        return replace(lab, filter_typed=text, filter_error=str(error))
    return replace(lab, filter_typed=text, filter=text, filter_error="")


def toggle_selection(lab: LabState, selection: Selection) -> LabState:
    """Remove a selection if the state has it, otherwise add it."""
    if selection in lab.selections:
        return remove_selection(lab, selection.kind)
    return add_selection(lab, selection)


def add_selection(lab: LabState, selection: Selection) -> LabState:
    """Add a selection; it replaces an earlier one of the same kind."""
    others = remove_selection(lab, selection.kind).selections
    return replace(lab, selections=(*others, selection))


def remove_selection(lab: LabState, kind: str) -> LabState:
    """Remove the selection of a kind."""
    return replace(lab, selections=tuple(one for one in lab.selections if one.kind != kind))


def choose_rows(findings: Findings, lab: LabState, first: int, last: int, how: RowChange) -> LabState:
    """Choose, drop, or toggle the rows from one query's to another's; a query that is not shown changes nothing."""
    order = sorted_rows(findings, lab)
    ends = np.flatnonzero((order == first) | (order == last))
    if len(ends) != len({first, last}):
        return lab
    between = frozenset(order[ends[0] : ends[-1] + 1].tolist())
    changed = {"add": lab.rows | between, "drop": lab.rows - between, "toggle": lab.rows ^ between}
    return replace(lab, rows=changed[how])


def chosen_rows(lab: LabState, listed: Int64Array) -> Int64Array:
    """Return the shown queries whose rows are chosen, in the order of the shown ones."""
    return listed[np.isin(listed, list(lab.rows))]


def chosen_or_all(lab: LabState, listed: Int64Array) -> Int64Array:
    """Return the queries that an action is about: those of the chosen rows, or all shown ones if none is chosen."""
    chosen = chosen_rows(lab, listed)
    return chosen if len(chosen) else listed


def show_chosen_rows(findings: Findings, lab: LabState) -> LabState:
    """Turn the chosen rows into a selection, which leaves no other query."""
    rows = chosen_rows(lab, selected_rows(findings, lab))
    if not len(rows):
        return lab
    return replace(add_selection(lab, Selection.of("rows", count_rows(len(rows)), rows)), rows=frozenset())


def count_rows(number: int) -> str:
    """Say how many rows are chosen."""
    return "1 chosen row" if number == 1 else f"{number:,} chosen rows"


def clear(lab: LabState) -> LabState:
    """Select all queries again, and choose no row."""
    return replace(
        lab_choices.show_all(lab),
        filter_typed="",
        filter_error="",
        rows=frozenset(),
        text_revision=lab.text_revision + 1,
    )


def to_view(findings: Findings, lab: LabState, name: str) -> NamedView:
    """Return what is selected, and how it is shown, under a name."""
    paths = findings.table.paths
    chosen = tuple(ChosenQueries(one.kind, one.label, tuple(paths[row] for row in one.rows)) for one in lab.selections)
    kept = lab_choices.to_view(replace(lab, sort_column=_sort_column(findings, lab)))
    return NamedView(name.strip(), lab.task, chosen=chosen, **kept)


def from_view(findings: Findings, lab: LabState, view: NamedView) -> LabState:
    """Return the state that shows a view; queries that are no longer there are left out, and counted in its label."""
    row_of = {path: row for row, path in enumerate(findings.table.paths)}
    selections = []
    for one in view.chosen:
        rows = {row_of[path] for path in one.paths if path in row_of}
        missing = len(set(one.paths)) - len(rows)
        label = f"{one.label} ({missing} no longer there)" if missing else one.label
        selections.append(Selection.of(one.kind, label, rows))
    made = replace(lab_choices.from_view(choices(clear(lab)), view), selections=tuple(selections))
    return replace(with_choices(findings, lab, made), rows=frozenset())


def fixed_columns(table: Table) -> list[str]:
    """Return the columns that the table always shows: with a second model, `rank A` and `rank B` stand for `rank`."""
    ranks = [RANK_A, RANK_B] if RANK_B in table.columns else ["rank"]
    names = [_FIXED_COLUMNS[0], *ranks, *_FIXED_COLUMNS[2:]]
    return [name for name in names if name in table.columns]


def toggle_column(lab: LabState, table: Table, name: str) -> LabState:
    """Show a column, or hide it."""
    extra = extra_columns(lab, table)
    return replace(lab, columns=tuple(c for c in extra if c != name) if name in extra else (*extra, name))


def extra_columns(lab: LabState, table: Table) -> list[str]:
    """Return the names of the columns shown beside `fixed_columns`."""
    if lab.columns is not None:
        return [name for name in lab.columns if name in table.columns]
    return [name for name in _DEFAULT_COLUMNS if name in table.columns and table.columns[name].known.any()]


def outcome_masks(findings: Findings) -> dict[OutcomeFilter, BoolArray]:
    """Return which queries each choice of an outcome shows, (Q,) each; those about two models only where there are two."""
    outcomes, second = findings.graded, findings.second
    masks: dict[OutcomeFilter, BoolArray] = {
        "all": np.ones(len(outcomes), bool),
        "failed": outcomes.failed,
        "found": outcomes.hits,
    }
    if second is not None:
        of_second = outcomes.known & second.hits
        masks |= {"only A": outcomes.hits & ~of_second, "only B": of_second & ~outcomes.hits}
    return masks


def selected_rows(findings: Findings, lab: LabState, without: str = "", any_outcome: bool = False) -> Int64Array:
    """Return the selected queries, ascending.

    Args:
        without: a kind of selection to ignore.
        any_outcome: ignore the choice of an outcome.
    """
    table = findings.table
    rows = table.filter(table.rows(), lab.filter)
    if (mask := outcome_masks(findings).get(lab.outcome)) is not None and not any_outcome:
        rows = rows[mask[rows]]
    for selection in lab.selections:
        if selection.kind != without:
            rows = np.intersect1d(rows, np.array(selection.rows, np.int64), assume_unique=True)
    return table.search(rows, lab.name_search) if lab.name_search.strip() else rows


def sorted_rows(findings: Findings, lab: LabState) -> Int64Array:
    """Return the selected queries in the table's order."""
    return findings.table.sort(selected_rows(findings, lab), _sort_column(findings, lab), lab.descending)


def describe(findings: Findings, lab: LabState) -> str:
    """Say what selects and orders the queries, such as "failed and rank > 5, sorted by margin"."""
    name = lab.name_search.strip()
    conditions = [
        _outcome_in_words(findings, lab.outcome),
        lab.filter.strip(),
        f"name ~ {name}" if name else "",
        *(selection.label for selection in lab.selections),
    ]
    descending = ", descending" if lab.descending else ""
    selected = " and ".join(filter(None, conditions)) or "all"
    return f"{selected}, sorted by {_sort_column(findings, lab)}{descending}"


def _outcome_in_words(findings: Findings, outcome: OutcomeFilter) -> str:
    if outcome == "all" or outcome not in outcome_masks(findings):
        return ""
    if findings.second is None or outcome in ("failed", "found"):
        return outcome
    first, second = (f"{letter} ({name})" for letter, name in zip("AB", findings.second.names, strict=True))
    finds, misses = (first, second) if outcome == "only A" else (second, first)
    return f"found by {finds} and not by {misses}"


def _sort_column(findings: Findings, lab: LabState) -> str:
    return lab.sort_column if lab.sort_column in findings.table.columns else "margin"


def charted_columns(findings: Findings) -> list[Column]:
    """Return the columns against which failure rates are shown."""
    columns = query_outcomes.picture_columns(findings.table)
    return [column for column in columns if column.name not in ("latitude", "longitude", REASON)]


def failure_rates(findings: Findings, lab: LabState, column: Column) -> list[Rate]:
    """Return failure rates against a column among the selected queries whose truth is known.

    The outcome filter and a selection in this column are ignored. If all or none of the selected queries failed, every
    rate would be 1 or 0, so the rates of all queries are returned.
    """
    known = findings.graded.known
    rows = selected_rows(findings, lab, selection_kind(column), any_outcome=True)
    rows = rows[known[rows]]
    if not 0 < int(findings.failed[rows].sum()) < len(rows):
        rows = np.flatnonzero(known)
    return breakdown.rates(findings.failed, column, rows=rows)


def selection_kind(column: Column) -> str:
    """Return the kind of the selections made in a column's chart."""
    return f"column {column.name}"


def select_bin(findings: Findings, lab: LabState, name: str, index: int, bin_name: str) -> Selection | None:
    """Select the queries of one bin of a column's chart.

    Args:
        name: the column.
        index: the bin among `failure_rates`.
        bin_name: the name of the clicked bin. The result is None if the bins have changed since the click.
    """
    column = next((column for column in charted_columns(findings) if column.name == name), None)
    bins = [] if column is None else failure_rates(findings, lab, column)
    if column is None or not 0 <= index < len(bins) or bins[index].name != bin_name:
        return None
    rate = bins[index]
    return Selection.of(selection_kind(column), f"{column.name} {rate.name}", np.flatnonzero(rate.holds(column)))


def select_pair(findings: Findings, lab: LabState, place: int, answered: int) -> Selection | None:
    """Select the queries of `place` that were answered with `answered`.

    The result is None if there is no such query.
    """
    for confusion in confusions(findings, lab):
        if (confusion.place, confusion.answered) == (place, answered):
            return Selection.of("pair", " taken for ".join(place_names(findings, confusion)), confusion.queries)
    return None


def select_hub(findings: Findings, lab: LabState, tile: int) -> Selection | None:
    """Select the queries that a tile answers wrongly; None if there are none."""
    hub = next((hub for hub in hubs(findings, lab) if hub.tile == tile), None)
    return None if hub is None else Selection.of("hub", hub_label(findings, tile), hub.queries)


def hub_label(findings: Findings, tile: int) -> str:
    """Return what a selection of a hub's queries is called."""
    return f"wrongly answered with {findings.task.gallery[tile].name}"


def hubs(findings: Findings, lab: LabState) -> list[breakdown.Hub]:
    """Return the hubs of the selected queries."""
    rows = selected_rows(findings, lab, "hub", any_outcome=True)
    return breakdown.hubs(findings.graded, findings.task.query_labels, rows)


def select_alike(findings: Findings, tiles: tuple[int, int]) -> Selection:
    """Select the queries of the places that two tiles show."""
    task = findings.task
    rows = np.flatnonzero(np.isin(task.query_labels, task.gallery_labels[list(tiles)]))
    return Selection.of("alike", alike_label(findings, tiles), rows)


def alike_label(findings: Findings, tiles: tuple[int, int]) -> str:
    """Return what a selection of the queries of two tiles is called."""
    return " and ".join(findings.task.gallery[tile].name for tile in tiles)


def select_part(findings: Findings, part: int) -> Selection:
    """Select the failures in which this part lowers the margin most."""
    blamed = findings.failed & (findings.outcomes.deciding_part == part)
    return Selection.of("part", f"part {findings.part_names[part]} lowers the margin most", np.flatnonzero(blamed))


def confusions(findings: Findings, lab: LabState) -> list[breakdown.Confusion]:
    """Return the confusions among the selected queries, the most frequent first."""
    rows = selected_rows(findings, lab, "pair", any_outcome=True)
    task = findings.task
    return breakdown.confusions(findings.graded, task.query_labels, task.gallery_labels, rows)


def place_names(findings: Findings, confusion: breakdown.Confusion) -> tuple[str, str]:
    """Return the names of a confusion's true tile and of its answer."""
    first = int(confusion.queries[0])
    positive, answer = (findings.table.columns[name].text(first) for name in ("truth", "answer"))
    return positive or str(confusion.place), answer
