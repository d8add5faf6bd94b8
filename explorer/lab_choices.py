"""The choices in the failure laboratory: for each one its values, its parameter of an address, and its name in a saved view."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, NamedTuple, TypeVar, get_args

import numpy as np

from explorer import parameters
from explorer.parameters import Parameter, UnusableError, is_line

Tab = Literal["table", "breakdown", "maps"]
OutcomeFilter = Literal["all", "failed", "found", "only A", "only B"]
MapKind = Literal["pca", "umap", "ground"]
# Characters of the filter, and of the names of columns, that an address holds.
_LONGEST_FILTER, _LONGEST_COLUMNS = 1000, 1000


class Selection(NamedTuple):
    """Queries that were chosen by a click or a lasso.

    Attributes:
        kind: of selection, such as a lasso; a new selection replaces an earlier one of the same kind.
        label: what they have in common, in words. Labels alone are ambiguous: a column's value "not known" has the same
            label as the queries without a value.
        rows: the queries, ascending.
    """

    kind: str
    label: str
    rows: tuple[int, ...]

    @classmethod
    def of(cls, kind: str, label: str, rows: Iterable[int]) -> Selection:
        """Select queries, in any order."""
        return cls(kind, label, tuple(np.unique(np.fromiter(rows, np.int64)).tolist()))


@dataclass(frozen=True)
class LabChoices:
    """The choices that an address keeps. The names of columns are untrusted: a table may lack them.

    Attributes:
        outcome: show all queries, those that failed, those that were found, or those that one of two models finds alone.
        filter: the filter in force, see `lpn.core.tables`.
        name_search: text that the names of the queries contain.
        selections: a query must be in all of them.
        sort_column, descending: the order of the table.
        columns: shown beside the columns that are always shown; None for the default ones.
        full_height: the window covers the whole stage; None leaves that to the tab, see `covers_stage`.
        map: the map that is shown.
        colour: the column that colours the map; empty for the outcome.
        both_maps: a map of descriptors stands beside that of the second model.
    """

    tab: Tab = "table"
    outcome: OutcomeFilter = "all"
    filter: str = ""
    name_search: str = ""
    selections: tuple[Selection, ...] = ()
    sort_column: str = "margin"
    descending: bool = False
    columns: tuple[str, ...] | None = None
    full_height: bool | None = None
    map: MapKind = "pca"
    colour: str = ""
    both_maps: bool = False

    def covers_stage(self, wide: bool) -> bool:
        """Return True if the window covers the whole stage: as a person chose, else for maps on a wide stage."""
        return wide and self.tab == "maps" if self.full_height is None else self.full_height


@dataclass(frozen=True)
class LabChoice:
    """One choice.

    Attributes:
        field: of `LabChoices`.
        parameter: of an address; None for one that needs the task, see `UrlState`.
        view: its field of `NamedView`; empty where a view does not keep it as it is.
        values: those that it can have; empty for any.
        orders: it orders the queries.
        selects: it says which queries are shown.
        every_task: it suits every task.
    """

    field: str
    parameter: Parameter | None = None
    view: str = ""
    values: tuple[Any, ...] = ()
    orders: bool = False
    selects: bool = False
    every_task: bool = False


def _one_of(field: str, key: str, values: tuple[str, ...], **kept: Any) -> LabChoice:
    words = {value.removeprefix("only "): value for value in values}
    return LabChoice(field, parameters.choice(field, words, key), field, values, **kept)


def _text(field: str, key: str, view: str, longest: int = parameters.LONGEST_TEXT, **kept: Any) -> LabChoice:
    return LabChoice(field, parameters.text(field, key, longest), view, **kept)


def _write_columns(lab: LabChoices) -> str | None:
    if lab.columns is None or any("," in name for name in lab.columns):
        return None
    text = ",".join(lab.columns)
    return text if is_line(text, _LONGEST_COLUMNS) else None


def _read_columns(lab: LabChoices, text: str) -> LabChoices:
    if not is_line(text, _LONGEST_COLUMNS):
        raise UnusableError(f"expected names of columns, {_LONGEST_COLUMNS:,} letters at most.")
    return replace(lab, columns=tuple(filter(None, text.split(","))))


# In the order of an address.
CHOICES = (
    _one_of("tab", "tab", get_args(Tab), every_task=True),
    _one_of("outcome", "only", get_args(OutcomeFilter), selects=True, every_task=True),
    _text("filter", "where", "filter", _LONGEST_FILTER, selects=True),
    _text("name_search", "find", "search", selects=True),
    _text("sort_column", "sort", "sort", orders=True),
    LabChoice(
        "descending", parameters.choice("descending", {"up": False, "down": True}, "order"), "descending", orders=True
    ),
    LabChoice("columns", Parameter("columns", _write_columns, _read_columns)),
    LabChoice("full_height", parameters.switch("full_height", "tall"), every_task=True),
    _one_of("map", "on", get_args(MapKind)),
    _text("colour", "by", "colour"),
    LabChoice("both_maps", parameters.switch("both_maps", "both")),
    LabChoice("selections", selects=True),
)
_Choices = TypeVar("_Choices", bound=LabChoices)


def values_of(lab: LabChoices) -> dict[str, Any]:
    """Return each choice by its field."""
    return {field.name: getattr(lab, field.name) for field in fields(LabChoices)}


def for_any_task(lab: LabChoices) -> LabChoices:
    """Return the choices that suit every task."""
    return LabChoices(**{choice.field: getattr(lab, choice.field) for choice in CHOICES if choice.every_task})


def show_all(lab: _Choices) -> _Choices:
    """Return the choices that show all queries."""
    return replace(lab, **{choice.field: getattr(LabChoices, choice.field) for choice in CHOICES if choice.selects})


def to_view(lab: LabChoices) -> dict[str, Any]:
    """Return the choices that a saved view keeps, by the fields of `NamedView`."""
    return {choice.view: getattr(lab, choice.field) for choice in CHOICES if choice.view}


def from_view(lab: _Choices, view: object) -> _Choices:
    """Return the choices that a saved view keeps; a value that is none of the choice's changes nothing."""
    kept = {choice: getattr(view, choice.view) for choice in CHOICES if choice.view}
    valid = {choice.field: value for choice, value in kept.items() if not choice.values or value in choice.values}
    return replace(lab, **valid)
