"""The table of the user's choices: one row gives the state's field, its key in the address, and its valid values."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Generic, Literal, Protocol, TypeVar
from urllib.parse import parse_qsl, quote, urlencode

from explorer.parameters import LONGEST_TEXT, UnusableError, format_number, is_line, parse_number
from explorer.workspace import Picture, Workspace
from lpn.core.files import printable
from lpn.descriptors.transforms import Change
from lpn.library.analyser import OwnPicture, QueryRequest
from lpn.tasks.task import SCORINGS, scored_key

# Maximum of characters, and of values, that are read of an address.
_MAX_SEARCH, _MAX_PARAMETERS = 4000, 100
# Maximum of a part's weight, and the digits of written weights.
MAX_WEIGHT, _WEIGHT_DIGITS = 2.0, 2


class FieldKind(Protocol):
    """The type of a field's values."""

    def read(self, value: object, state: ScreenState, workspace: Workspace) -> Any:
        """Parse a text of an address or a JSON value; UnusableError if it is invalid."""
        ...

    def write(self, value: Any, state: ScreenState, workspace: Workspace) -> str:  # noqa: ARG002
        """Format a value for an address; a text stays unchanged."""
        return str(value)


@dataclass(frozen=True)
class NumberIn(FieldKind):
    """A number from `low` to `high`."""

    low: float
    high: float

    def read(self, value: object, state: ScreenState, workspace: Workspace) -> float:  # noqa: ARG002
        if isinstance(value, bool) or not isinstance(value, (int, float, str)):
            raise UnusableError(f"expected a number from {self.low:g} to {self.high:g}.")
        text = f"{value:.10g}" if isinstance(value, float) else str(value)
        return parse_number(text, self.low, self.high)

    def write(self, value: float, state: ScreenState, workspace: Workspace) -> str:  # noqa: ARG002
        return format_number(value)


@dataclass(frozen=True)
class OneOf(FieldKind):
    """One of a few texts, which may depend on the workspace.

    Attributes:
        values: the texts, or their source.
        optional: an empty text is valid, too.
    """

    values: Sequence[str] | Literal["places", "tasks", "models", "scorings", "panels"]
    optional: bool = False

    def choices(self, state: ScreenState, workspace: Workspace) -> Sequence[str]:
        """Return the texts that a workspace offers in a state."""
        match self.values:
            case "places":
                return tuple(workspace.choices) or (workspace.key,)
            case "tasks":
                return tuple(workspace.tasks)
            case "models":
                return tuple(map(str, range(len(workspace.models))))
            case "panels":
                return [name for name, offered in PANELS.items() if offered(workspace)]
            case "scorings":
                rankings = _of_model(state, workspace).rankings
                return [name for name in SCORINGS if scored_key(state.task, name) in rankings]
        return self.values

    def read(self, value: object, state: ScreenState, workspace: Workspace) -> str:
        choices = self.choices(state, workspace)
        if not isinstance(value, str) or (value not in choices and (value or not self.optional)):
            raise UnusableError(f"expected {' or '.join(filter(None, choices))}.")
        return value


@dataclass(frozen=True)
class Line(FieldKind):
    """One line of text, with a maximum of letters."""

    longest: int = LONGEST_TEXT

    def read(self, value: object, state: ScreenState, workspace: Workspace) -> str:  # noqa: ARG002
        if not isinstance(value, str) or not is_line(value, self.longest):
            raise UnusableError(f"expected {self.longest:,} letters at most that can be printed.")
        return value


@dataclass(frozen=True)
class PictureOf(FieldKind):
    """A position among the task's queries or tiles: a number, a name, or "~" and a number where the name is ambiguous.

    Attributes:
        side: queries or tiles of the task.
        optional: None, written as an empty text, is valid, too.
    """

    side: Literal["queries", "gallery"]
    optional: bool = False

    def read(self, value: object, state: ScreenState, workspace: Workspace) -> int | None:
        pictures = self._pictures(state, workspace)
        if self.optional and value in (None, ""):
            return None
        position: object = value
        if isinstance(value, str):
            number = re.fullmatch(r"~(\d{1,9})", value)
            position = int(number[1]) if number else _first(pictures, value)
        if isinstance(position, int) and not isinstance(position, bool) and 0 <= position < len(pictures):
            return position
        raise UnusableError(f"there is no such picture; names are such as {printable(pictures[0].name)}.")

    def write(self, value: int, state: ScreenState, workspace: Workspace) -> str:
        pictures = self._pictures(state, workspace)
        name = pictures[value].name
        plain = name == printable(name) and name[:1] != "~"
        return name if plain and _first(pictures, name) == value else f"~{value}"

    def _pictures(self, state: ScreenState, workspace: Workspace) -> Sequence[Picture]:
        task = workspace.tasks[state.task]
        return task.queries if self.side == "queries" else task.gallery


def _first(pictures: Sequence[Picture], name: str) -> int | None:
    return next((position for position, picture in enumerate(pictures) if picture.name == name), None)


@dataclass(frozen=True)
class Weights(FieldKind):
    """The weight of each part, 0 to `MAX_WEIGHT`, not all 0; an empty value for equal ones."""

    def read(self, value: object, state: ScreenState, workspace: Workspace) -> tuple[float, ...]:
        n = _of_model(state, workspace).contract.n_parts
        given = value.split(",") if isinstance(value, str) else value
        if given in ([], [""], None):
            return ()
        if not isinstance(given, list) or len(given) != n:
            raise UnusableError(f"expected {n} numbers from 0 to {MAX_WEIGHT:g}, not all 0.")
        number = NumberIn(0.0, MAX_WEIGHT)
        weights = tuple(round(number.read(one, state, workspace), _WEIGHT_DIGITS) for one in given)
        if not any(weights):
            raise UnusableError(f"expected {n} numbers from 0 to {MAX_WEIGHT:g}, not all 0.")
        return () if len(set(weights)) == 1 else weights

    def write(self, value: tuple[float, ...], state: ScreenState, workspace: Workspace) -> str:  # noqa: ARG002
        return ",".join(map(format_number, value))


T = TypeVar("T")


@dataclass(frozen=True)
class PanelField(Generic[T]):
    """A row of the table that a panel adds: `state[FIELD]` is its value.

    Attributes:
        name: name in messages, which begins with the panel's name, such as `lab_sort`.
        kind: the type of its values.
        default: the value of a page without an address; it is valid in every workspace.
        key: its key in the address; empty for a field that no address has.
        of_query: reset by another query.
    """

    name: str
    kind: FieldKind
    default: T
    key: str = ""
    of_query: bool = False


def _row(kind: FieldKind, default: Any, key: str = "", of_query: bool = False) -> Any:
    return field(default=default, metadata={"row": (kind, key, of_query)})


@dataclass(frozen=True)
class ScreenState:
    """A user's choices on one screen; each field is a row of the table.

    Attributes:
        place: key of the workspace.
        task: name of its task.
        model: "0" for the workspace's model, else the number of another model.
        scoring: how the gallery is ranked.
        query: position among the task's queries.
        own: the key of the user's own photo in place of the query; empty for none.
        angle: degrees counter-clockwise by which the photo is turned.
        compare: gallery position of the compared tile; None for the headline's tile.
        weights: the part weights; empty for equal ones.
        heat: the values of the cells: activation, evidence, or the loss of score by occlusion.
        filter: queries that the rail lists.
        find: a text that the listed queries' names contain.
        view: the scene's view.
        theme: of the page.
        panel: the open panel; empty for none.
        of_panels: values of the panels' fields by their names; a field that is missing has its default.
    """

    place: str = _row(OneOf("places"), "", "show")
    task: str = _row(OneOf("tasks"), "", "task")
    model: str = _row(OneOf("models"), "0", "model")
    scoring: str = _row(OneOf("scorings"), "plain", "scoring")
    query: int = _row(PictureOf("queries"), 0, "query")
    own: str = _row(Line(), "")
    angle: float = _row(NumberIn(-180.0, 180.0), 0.0, "angle", of_query=True)
    compare: int | None = _row(PictureOf("gallery", optional=True), None, "with", of_query=True)
    weights: tuple[float, ...] = _row(Weights(), (), "weights")
    heat: str = _row(OneOf(("activation", "evidence", "occlusion")), "activation", "shows")
    filter: str = _row(OneOf(("all", "missed")), "all", "only")
    find: str = _row(Line(), "", "find")
    view: str = _row(OneOf(("city", "apart")), "city", "view")
    theme: str = _row(OneOf(("dark", "light")), "dark", "theme")
    panel: str = _row(OneOf("panels", optional=True), "", "panel")
    of_panels: Mapping[str, Any] = field(default_factory=dict)

    def __getitem__(self, row: PanelField[T]) -> T:
        value: T = self.of_panels.get(row.name, row.default)
        return value

    def question(self, own: OwnPicture | None = None) -> QueryRequest:
        """Return the question for the task: about the user's own photo if there is one, else about the query."""
        return QueryRequest(own or self.query, Change(self.angle), self.weights or None, compare=self.compare)

    def value(self, name: str) -> Any:
        """Return the value of a field by its name."""
        row = FIELDS[name]
        return self.of_panels.get(name, row.default) if name in _OF_PANELS else getattr(self, name)

    def with_value(self, name: str, value: Any) -> ScreenState:
        """Return the state with another value of a field, which is not checked."""
        if name in _OF_PANELS:
            others = {key: one for key, one in self.of_panels.items() if key != name}
            return replace(self, of_panels=others if value == FIELDS[name].default else {**others, name: value})
        changes: dict[str, Any] = {name: value}
        return replace(self, **changes)

    def values(self) -> dict[str, Any]:
        """Return the values of all fields by their names."""
        return {name: self.value(name) for name in FIELDS}


# The rows by their names. The task comes before the query, whose names depend on it; panels add more rows.
FIELDS: dict[str, PanelField[Any]] = {
    row.name: PanelField(row.name, row.metadata["row"][0], row.default, *row.metadata["row"][1:])
    for row in fields(ScreenState)
    if row.metadata
}
_OF_PANELS: set[str] = set()
# For each panel that opens: whether a workspace has it.
PANELS: dict[str, Callable[[Workspace], bool]] = {}
# Fields whose change needs no new answer, beside those of panels.
_OF_PAGE = ("filter", "find", "view", "theme", "panel", "of_panels")


def add_panel(name: str, rows: Sequence[PanelField[Any]], offered: Callable[[Workspace], bool] | None) -> None:
    """Add a panel's name and rows to the table; `offered` tests whether a workspace has it; None for a panel that never opens."""
    if offered is not None:
        PANELS[name] = offered
    for row in rows:
        assert row.name.startswith(f"{name}_"), row.name
        assert row.key == "" or row.key not in {other.key for other in FIELDS.values()}, row.key
        FIELDS[row.name] = row
        _OF_PANELS.add(row.name)


def same_page(one: ScreenState, other: ScreenState) -> bool:
    """Return whether two states have the same place, task, and model."""
    return (one.place, one.task, one.model) == (other.place, other.task, other.model)


def _of_model(state: ScreenState, workspace: Workspace) -> Workspace:
    """Return the workspace of the state's model, or the place's workspace until the model is open."""
    return workspace.models[int(state.model)].workspace or workspace


def _upright(state: ScreenState) -> ScreenState:
    """Return the state with the fields of a query reset."""
    for name, row in FIELDS.items():
        if row.of_query:
            state = state.with_value(name, row.default)
    return state


def opening(workspace: Workspace) -> ScreenState:
    """Return the state of a page without an address: the workspace's first task and query."""
    task = next(iter(workspace.tasks))
    scoring = workspace.default_scoring(task)
    return ScreenState(place=workspace.key, task=task, scoring=scoring, query=workspace.first_query)


def changed(state: ScreenState, values: Mapping[str, object], workspace: Workspace) -> tuple[ScreenState, list[str]]:
    """Return the state with some fields set, and a sentence for each value that cannot be used.

    Another task, query, or own photo resets angle and compared tile; another model resets the weights.
    """
    problems = []
    for name, row in FIELDS.items():
        if name not in values:
            continue
        try:
            value = row.kind.read(values[name], state, workspace)
        except UnusableError as error:
            problems.append(f"{row.key or name}: {error}")
            continue
        if name in ("task", "query", "own") and (value != getattr(state, name) or (state.own and name != "own")):
            state = replace(_upright(state), own="")
        if name == "task" and value != state.task:
            state = replace(state, query=0, scoring=workspace.default_scoring(value))
        if name == "model" and value != state.model:
            state = replace(state, weights=())
        state = state.with_value(name, value)
    unknown = [printable(name)[:40] for name in values if name not in FIELDS]
    return state, problems + [f"{name}: there is no such choice." for name in unknown]


def to_address(state: ScreenState, workspace: Workspace) -> str:
    """Return the query string of a state, without "?": the fields that differ from the workspace's first state."""
    plain = replace(opening(workspace), query=-1)
    pairs = [
        (row.key, row.kind.write(value, state, workspace))
        for name, row in FIELDS.items()
        if row.key and (value := state.value(name)) != plain.value(name) and not (name == "query" and state.own)
    ]
    return urlencode(pairs, quote_via=quote, safe="/,~")


def from_values(given: Mapping[str, str], workspace: Workspace) -> tuple[ScreenState, list[str]]:
    """Return the state of an address's values by their keys, and a sentence for each invalid one; see `parsed`."""
    values = {name: given[row.key] for name, row in FIELDS.items() if row.key in given}
    return changed(opening(workspace), values, workspace)


def parsed(search: str) -> dict[str, str]:
    """Return the values of a query string by their keys; none if it is malformed."""
    try:
        return dict(parse_qsl(search.lstrip("?")[:_MAX_SEARCH], keep_blank_values=True, max_num_fields=_MAX_PARAMETERS))
    except ValueError:
        return {}


def needs_answer(before: ScreenState, state: ScreenState) -> bool:
    """Return whether two states have different answers."""
    unchanged: dict[str, Any] = {name: getattr(state, name) for name in _OF_PAGE}
    return replace(before, **unchanged) != state
