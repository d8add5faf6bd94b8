"""What one browser has chosen in the failure laboratory, and which queries follow from it. No viser here."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from explorer.failure_lab.service import Findings, MapKind
from lpn.analysis import breakdown, query_outcomes
from lpn.analysis.breakdown import Rate
from lpn.core.arrays import Int64Array
from lpn.core.errors import InputError
from lpn.core.tables import Column, Table

Tab = Literal["table", "breakdown", "maps"]
Outcome = Literal["all", "failed", "found"]
TABS: Final[tuple[Tab, ...]] = ("table", "breakdown", "maps")
OUTCOMES: Final[tuple[Outcome, ...]] = ("all", "failed", "found")
MAPS: Final[tuple[MapKind, ...]] = ("pca", "umap", "ground")
ALWAYS = ("name", "rank", "margin", "part", "answer", "distance")
"""Columns that are always shown, where they are there."""
_FIRST = ("altitude", "district", "tags")
"""Columns that are shown until others are chosen, where anything is known in them."""


@dataclass(frozen=True, eq=False)
class Pick:
    """Queries that were chosen by a click or a rectangle.

    Attributes:
        kind: of the choice; another one of the same kind takes its place.
        words: what they have in common.
        rows: ascending.
    """

    kind: str
    words: str
    rows: Int64Array

    def same(self, other: Pick) -> bool:
        """Whether another choice is this one; a value may be called as what is not known is."""
        return (self.kind, self.words) == (other.kind, other.words) and np.array_equal(self.rows, other.rows)


@dataclass(frozen=True)
class LabState:
    """One browser's choices.

    Attributes:
        task: whose queries these are.
        outcome: all queries, those that failed, or those that did not.
        where: the filter in force, see `lpn.core.tables`; typed: the text in the box; flaw: why that is no filter, else empty.
        find: text that names contain.
        picks: choices by clicks and rectangles; a query must be in all of them.
        sort, descending: the column that the table is sorted by.
        page: of the table, from 0.
        columns: shown beside those of `ALWAYS`; None for those that are shown first.
        choosing: whether the columns to choose from are shown.
        tall: whether the window covers the whole stage.
        map: which one is shown.
        fit: whether the map shows the chosen queries only, as large as they fit.
        stopped: maps that are not to be made, and "table"; the user has cancelled them.
        texts: counts how often the text boxes have been changed by something else than typing.
    """

    task: str
    tab: Tab = "table"
    outcome: Outcome = "all"
    where: str = ""
    typed: str = ""
    flaw: str = ""
    find: str = ""
    picks: tuple[Pick, ...] = ()
    sort: str = "margin"
    descending: bool = False
    page: int = 0
    columns: tuple[str, ...] | None = None
    choosing: bool = False
    tall: bool = False
    map: MapKind = "pca"
    fit: bool = False
    stopped: frozenset[str] = frozenset({"umap"})
    texts: int = 0


def of_task(lab: LabState, task: str) -> LabState:
    """The same window on another task, whose queries and columns are others."""
    if lab.task == task:
        return lab
    return LabState(task, lab.tab, lab.outcome, tall=lab.tall, stopped=lab.stopped, texts=lab.texts + 1)


def sorted_by(lab: LabState, column: str) -> LabState:
    """Sort by a column; the other way round where it is the one already."""
    return replace(lab, sort=column, descending=lab.sort == column and not lab.descending, page=0)


def filtered(lab: LabState, text: str, table: Table) -> LabState:
    """Take a filter; one that cannot be read leaves the table as it is."""
    try:
        table.filter(table.rows(), text)
    except InputError as error:
        return replace(lab, typed=text, flaw=str(error))
    return replace(lab, typed=text, where=text, flaw="", page=0)


def picked(lab: LabState, pick: Pick) -> LabState:
    """Add a choice in place of the one of its kind."""
    return replace(lab, picks=(*(p for p in lab.picks if p.kind != pick.kind), pick), page=0)


def unpicked(lab: LabState, kind: str) -> LabState:
    """Take a choice away."""
    return replace(lab, picks=tuple(pick for pick in lab.picks if pick.kind != kind), page=0)


def cleared(lab: LabState) -> LabState:
    """All queries again."""
    texts = lab.texts + 1
    return replace(lab, outcome="all", where="", typed="", flaw="", find="", picks=(), page=0, fit=False, texts=texts)


def with_column(lab: LabState, table: Table, name: str) -> LabState:
    """Show a column, or no longer."""
    shown = extra_columns(lab, table)
    chosen = [c for c in shown if c != name] if name in shown else [*shown, name]
    return replace(lab, columns=tuple(chosen))


def extra_columns(lab: LabState, table: Table) -> list[str]:
    """Names of the columns that are shown beside those of `ALWAYS`."""
    if lab.columns is not None:
        return [name for name in lab.columns if name in table.columns]
    return [name for name in _FIRST if name in table.columns and table.columns[name].known.any()]


def select(found: Findings, lab: LabState, without: str = "", whatever: bool = False) -> Int64Array:
    """The chosen queries, ascending.

    Args:
        without: a kind of choice that is left out.
        whatever: whether those that failed and those that did not both count.
    """
    table, failed = found.table, found.outcomes.failed
    rows = table.filter(table.rows(), lab.where)
    if lab.outcome != "all" and not whatever:
        rows = rows[failed[rows] == (lab.outcome == "failed")]
    for pick in lab.picks:
        if pick.kind != without:
            rows = np.intersect1d(rows, pick.rows, assume_unique=True)
    return table.search(rows, lab.find) if lab.find.strip() else rows


def order(found: Findings, lab: LabState, rows: Int64Array) -> Int64Array:
    """Chosen queries in the table's order."""
    return found.table.sort(rows, _sorted_by(found, lab), lab.descending)


def words(found: Findings, lab: LabState) -> str:
    """All that chooses and orders the queries, such as "failed and rank > 5 and 0449 taken for 0450, sorted by margin"."""
    outcome, name = lab.outcome if lab.outcome != "all" else "", lab.find.strip()
    parts = (outcome, lab.where.strip(), f"name ~ {name}" if name else "", *(pick.words for pick in lab.picks))
    descending = ", descending" if lab.descending else ""
    return f"{' and '.join(filter(None, parts)) or 'all'}, sorted by {_sorted_by(found, lab)}{descending}"


def rates(found: Findings, lab: LabState, column: Column) -> list[Rate]:
    """Failure rates against a column among the chosen queries, whatever became of them and whatever was chosen of it."""
    rows = select(found, lab, kind_of(column), whatever=True)
    failures_among = int(found.outcomes.failed[rows].sum())
    if not 0 < failures_among < len(rows):  # the filter says what became of them
        rows = found.table.rows()
    return breakdown.rates(found.outcomes.failed, column, rows=rows)


def kind_of(column: Column) -> str:
    """The kind of choices by a column."""
    return f"column {column.name}"


def pick_bin(found: Findings, lab: LabState, name: str, index: int, said: str) -> Pick | None:
    """The queries of one bin of a column; None where there is no such bin.

    Args:
        name: of the column.
        index: of the bin among `rates`.
        said: the bin's name where it was clicked; another one, and the bins have changed since.
    """
    column = next((column for column in described(found) if column.name == name), None)
    bins = [] if column is None else rates(found, lab, column)
    if column is None or not 0 <= index < len(bins) or bins[index].name != said:
        return None
    rate = bins[index]
    if not rate.known:
        inside = ~column.known
    elif column.kind == "number":
        inside = (column.values >= rate.low) & (column.values <= rate.high)
    else:
        inside = column.values == rate.name
    return Pick(kind_of(column), f"{column.name} {rate.name}", np.flatnonzero(inside))


def pick_pair(found: Findings, lab: LabState, place: int, answered: int) -> Pick | None:
    """The queries of one place that were answered with another; None where there are none."""
    rows = select(found, lab, "pair", whatever=True)
    of_task = found.task.query_labels, found.task.gallery_labels
    for one in breakdown.confusions(found.outcomes, *of_task, rows):
        if (one.place, one.answered) == (place, answered):
            return Pick("pair", f"{' taken for '.join(names_of(found, one))}", one.queries)
    return None


def pick_part(found: Findings, part: int, name: str) -> Pick:
    """The failures that a part costs most."""
    blamed = found.outcomes.failed & (found.outcomes.decides == part)
    return Pick("part", f"part {name} costs most", np.flatnonzero(blamed))


def _sorted_by(found: Findings, lab: LabState) -> str:
    return lab.sort if lab.sort in found.table.columns else "margin"


def names_of(found: Findings, one: breakdown.Confusion) -> tuple[str, str]:
    """What the two places of a confusion are called: by their tiles."""
    first = int(one.queries[0])
    truth, answer = (found.table.columns[name].text(first) for name in ("truth", "answer"))
    return truth or str(one.place), answer


def described(found: Findings) -> list[Column]:
    """The columns that failure rates are shown against."""
    columns = query_outcomes.described_by(found.table)
    return [column for column in columns if column.name not in ("latitude", "longitude")]
