"""The messages of the laboratory's html, validated by msgspec, and their effect on one browser's state.

A message arrives as a kind and a JSON value: a list of the message's fields, or the field itself if there is only one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from explorer.failure_lab import state
from explorer.failure_lab.service import Findings
from explorer.failure_lab.state import Drawer, LabState, RowChange
from explorer.session_state import MapKind, OutcomeFilter, Tab
from explorer.web import messages

QueryIndex = Annotated[int, Meta(ge=0)]
# A place on a map, in units of half its longer side from its middle.
Coordinate = Annotated[float, Meta(ge=-1e6, le=1e6)]
MAX_CORNERS = 300
Work = Literal["table", "pca", "umap", "ground"]


class LabMessage(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    """A message of the laboratory's HTML. Its effect is in `apply`, or in the window where it needs more than the state."""


class ShowTab(LabMessage):
    tab: Tab


class ShowOutcome(LabMessage):
    outcome: OutcomeFilter


class SortBy(LabMessage):
    column: str


class SearchNames(LabMessage):
    text: Annotated[str, Meta(max_length=200)]


class SetFilter(LabMessage):
    text: Annotated[str, Meta(max_length=2000)]


class ToggleColumn(LabMessage):
    column: str


class ToggleDrawer(LabMessage):
    drawer: Drawer


class RemoveSelection(LabMessage):
    kind: str


class ClearSelections(LabMessage): ...


class SelectPart(LabMessage):
    part: QueryIndex


class SelectPair(LabMessage):
    place: int
    answered: int


class ChooseRows(LabMessage):
    """Choose all rows of the table from one query's to another's, or toggle or drop them."""

    first: QueryIndex
    last: QueryIndex
    how: RowChange


class ChooseAllRows(LabMessage): ...


class ChooseNoRows(LabMessage): ...


class ShowChosenRows(LabMessage): ...


class SelectBin(LabMessage):
    column: str
    index: QueryIndex
    name: str


class ShowMap(LabMessage):
    map: MapKind


class ColourBy(LabMessage):
    """Colour the map by a column; by the outcome for an empty name."""

    column: str


class SelectLasso(LabMessage):
    map: MapKind
    corners: Annotated[list[tuple[Coordinate, Coordinate]], Meta(min_length=3, max_length=MAX_CORNERS)]


class OpenPoint(LabMessage):
    map: MapKind
    row: QueryIndex


class ShowTip(LabMessage):
    map: MapKind
    row: QueryIndex


class ToggleFullHeight(LabMessage): ...


class CancelWork(LabMessage):
    work: Work


class ResumeWork(LabMessage):
    work: Work


class OpenQuery(LabMessage):
    row: QueryIndex


class SaveNote(LabMessage):
    """Save tags and note of a query.

    Attributes:
        before: tags and note as they were when the user began to type; None replaces whatever is there.
    """

    task: str
    row: QueryIndex
    tags: str
    note: str
    before: tuple[str, str] | None = None


class TagChosen(LabMessage):
    """Add tags to the chosen rows, or to all that are shown if none is chosen."""

    tags: Annotated[str, Meta(max_length=1000)]


ViewName = Annotated[str, Meta(max_length=200)]


class OpenView(LabMessage):
    name: ViewName


class SaveView(LabMessage):
    name: ViewName


class RemoveView(LabMessage):
    name: ViewName


class SaveCsv(LabMessage): ...


class SaveReport(LabMessage): ...


class OpenSecond(LabMessage): ...


class CloseLab(LabMessage): ...


MESSAGES: dict[str, type[LabMessage]] = {
    "lab-tab": ShowTab,
    "lab-outcome": ShowOutcome,
    "lab-sort": SortBy,
    "lab-find": SearchNames,
    "lab-where": SetFilter,
    "lab-column": ToggleColumn,
    "lab-drawer": ToggleDrawer,
    "lab-tag": TagChosen,
    "lab-view": OpenView,
    "lab-view-save": SaveView,
    "lab-view-remove": RemoveView,
    "lab-unpick": RemoveSelection,
    "lab-clear": ClearSelections,
    "lab-part": SelectPart,
    "lab-pair": SelectPair,
    "lab-rows": ChooseRows,
    "lab-rows-all": ChooseAllRows,
    "lab-rows-none": ChooseNoRows,
    "lab-rows-only": ShowChosenRows,
    "lab-bin": SelectBin,
    "lab-map": ShowMap,
    "lab-colour": ColourBy,
    "lab-lasso": SelectLasso,
    "lab-point": OpenPoint,
    "lab-tip": ShowTip,
    "lab-tall": ToggleFullHeight,
    "lab-stop": CancelWork,
    "lab-go": ResumeWork,
    "lab-open": OpenQuery,
    "lab-note": SaveNote,
    "lab-csv": SaveCsv,
    "lab-report": SaveReport,
    "lab-second": OpenSecond,
    "lab-close": CloseLab,
}

# A click on a line of a chart.
OF_CHARTS = SelectPart, SelectPair, SelectBin


def decode(kind: str, value: Any) -> LabMessage | None:
    """Return the message that a JSON value holds, None if it holds none of this kind."""
    return messages.decode(MESSAGES, kind, value)


def apply(message: LabMessage, lab: LabState, findings: Findings | None) -> LabState:
    """Return the state after a message; one that means nothing in this state changes nothing.

    Args:
        findings: None before the table is there; most messages need it.
    """
    match message:
        case ToggleFullHeight():
            return replace(lab, full_height=not lab.full_height)
        case CancelWork(work):
            return replace(lab, paused=lab.paused | {work})
        case ResumeWork(work):
            return replace(lab, paused=lab.paused - {work})
    return lab if findings is None else _apply_to_table(message, lab, findings)


def _apply_to_table(message: LabMessage, lab: LabState, findings: Findings) -> LabState:
    selection = None
    match message:
        case ShowTab(tab):
            return state.show_tab(findings, lab, tab)
        case ShowOutcome(outcome):
            return replace(lab, outcome=outcome)
        case SortBy(column) if column in findings.table.columns:
            return state.sort_by(lab, column)
        case SearchNames(text):
            return replace(lab, name_search=text)
        case SetFilter(text):
            return state.set_filter(lab, text, findings.table)
        case ToggleColumn(column) if column in findings.table.columns:
            return state.toggle_column(lab, findings.table, column)
        case ToggleDrawer(drawer):
            return replace(lab, drawer="" if lab.drawer == drawer else drawer)
        case RemoveSelection(kind):
            return state.remove_selection(lab, kind)
        case ClearSelections():
            return state.clear(lab)
        case ShowMap(kind) if kind != "ground" or findings.task.geometry is not None:
            return replace(lab, map=kind, map_chosen=True, paused=lab.paused - {kind})
        case ColourBy(column) if not column or column in findings.table.columns:
            return replace(lab, colour=column)
        case ChooseRows(first, last, how):
            return state.choose_rows(findings, lab, first, last, how)
        case ChooseAllRows():
            return replace(lab, rows=frozenset(state.selected_rows(findings, lab).tolist()))
        case ChooseNoRows():
            return replace(lab, rows=frozenset())
        case ShowChosenRows():
            return state.show_chosen_rows(findings, lab)
        case SelectPart(part) if part < len(findings.part_names):
            selection = state.select_part(findings, part)
        case SelectPair(place, answered):
            selection = state.select_pair(findings, lab, place, answered)
        case SelectBin(column, index, name):
            selection = state.select_bin(findings, lab, column, index, name)
    return lab if selection is None else state.toggle_selection(lab, selection)
