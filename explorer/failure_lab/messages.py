"""The messages of the laboratory's html, and their effect on one browser's state."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from explorer.failure_lab import state
from explorer.failure_lab.service import Findings
from explorer.failure_lab.state import Drawer, LabState, RowChange
from explorer.lab_choices import MapKind, OutcomeFilter, Tab
from explorer.web.messages import Message

QueryIndex = Annotated[int, Meta(ge=0)]
# A place on a map, in units of half its longer side from its middle.
Coordinate = Annotated[float, Meta(ge=-1e6, le=1e6)]
MAX_CORNERS = 300
Work = Literal["table", "pca", "umap", "ground"]


class LabMessage(Message):
    """A message of the laboratory's HTML. Its effect is in `apply`, or in the window where it needs more than the state."""


class ShowTab(LabMessage, tag="lab-tab"):
    tab: Tab


class Choose(LabMessage):
    """A message whose fields replace those of `LabChoices` of the same names."""


class ShowOutcome(Choose, tag="lab-outcome"):
    outcome: OutcomeFilter


class SortBy(LabMessage, tag="lab-sort"):
    column: str


class SearchNames(Choose, tag="lab-find"):
    name_search: Annotated[str, Meta(max_length=200)]


class SetFilter(LabMessage, tag="lab-where"):
    text: Annotated[str, Meta(max_length=2000)]


class ToggleColumn(LabMessage, tag="lab-column"):
    column: str


class ToggleDrawer(LabMessage, tag="lab-drawer"):
    drawer: Drawer


class RemoveSelection(LabMessage, tag="lab-unpick"):
    kind: str


class ClearSelections(LabMessage, tag="lab-clear"): ...


class SelectPart(LabMessage, tag="lab-part"):
    part: QueryIndex


class SelectPair(LabMessage, tag="lab-pair"):
    place: int
    answered: int


class SelectHub(LabMessage, tag="lab-hub"):
    tile: QueryIndex


class SelectAlike(LabMessage, tag="lab-alike"):
    """Select the queries of two tiles' places."""

    first: QueryIndex
    second: QueryIndex


class ChooseRows(LabMessage, tag="lab-rows"):
    """Choose all rows of the table from one query's to another's, or toggle or drop them."""

    first: QueryIndex
    last: QueryIndex
    how: RowChange


class ChooseAllRows(LabMessage, tag="lab-rows-all"): ...


class ChooseNoRows(LabMessage, tag="lab-rows-none"): ...


class ShowChosenRows(LabMessage, tag="lab-rows-only"): ...


class SelectBin(LabMessage, tag="lab-bin"):
    column: str
    index: QueryIndex
    name: str


class ShowMap(LabMessage, tag="lab-map"):
    map: MapKind


class ColourBy(LabMessage, tag="lab-colour"):
    """Colour the map by a column; by the outcome for an empty name."""

    column: str


class ShowBothMaps(Choose, tag="lab-both"):
    both_maps: bool


class SelectLasso(LabMessage, tag="lab-lasso"):
    """Select the queries within a lasso.

    Attributes:
        second: the lasso is on the map of the second model.
    """

    map: MapKind
    corners: Annotated[list[tuple[Coordinate, Coordinate]], Meta(min_length=3, max_length=MAX_CORNERS)]
    second: bool = False


class OpenPoint(LabMessage, tag="lab-point"):
    map: MapKind
    row: QueryIndex


class ShowTip(LabMessage, tag="lab-tip"):
    map: MapKind
    row: QueryIndex


class SetFullHeight(LabMessage, tag="lab-tall"):
    full_height: bool


class CancelWork(LabMessage, tag="lab-stop"):
    work: Work


class ResumeWork(LabMessage, tag="lab-go"):
    work: Work


class OpenQuery(LabMessage, tag="lab-open"):
    row: QueryIndex


class SaveNote(LabMessage, tag="lab-note"):
    """Save tags and note of a query.

    Attributes:
        before: tags and note as they were when the user began to type; None replaces whatever is there.
    """

    task: str
    row: QueryIndex
    tags: str
    note: str
    before: tuple[str, str] | None = None


class TagChosen(LabMessage, tag="lab-tag"):
    """Add tags to the chosen rows, or to all that are shown if none is chosen."""

    tags: Annotated[str, Meta(max_length=1000)]


ViewName = Annotated[str, Meta(max_length=200)]


class OpenView(LabMessage, tag="lab-view"):
    name: ViewName


class SaveView(LabMessage, tag="lab-view-save"):
    name: ViewName


class RemoveView(LabMessage, tag="lab-view-remove"):
    name: ViewName


class SaveCsv(LabMessage, tag="lab-csv"): ...


class SaveReport(LabMessage, tag="lab-report"): ...


class ScoreSecond(LabMessage, tag="lab-second-scoring"):
    """Rank by the second model as by the workspace's own: calibrate it, too."""


class OpenSecond(LabMessage, tag="lab-second"): ...


class CloseLab(LabMessage, tag="lab-close"): ...


# A click on a line of a chart.
OF_CHARTS = SelectPart, SelectPair, SelectHub, SelectAlike, SelectBin


def apply(message: LabMessage, lab: LabState, findings: Findings | None) -> LabState:
    """Return the state after a message; one that means nothing in this state changes nothing.

    Args:
        findings: None before the table is there; most messages need it.
    """
    match message:
        case SetFullHeight(full_height):
            return replace(lab, full_height=full_height)
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
        case Choose():
            return replace(lab, **msgspec.structs.asdict(message))
        case SortBy(column) if column in findings.table.columns:
            return state.sort_by(lab, column)
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
        case SelectHub(tile):
            selection = state.select_hub(findings, lab, tile)
        case SelectAlike(first, second) if max(first, second) < len(findings.task.gallery):
            selection = state.select_alike(findings, (first, second))
        case SelectBin(column, index, name):
            selection = state.select_bin(findings, lab, column, index, name)
    return lab if selection is None else state.toggle_selection(lab, selection)
