"""Converts a session state to the query string of the page's address and back; no viser here."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, get_args
from urllib.parse import parse_qsl, quote, urlencode

from explorer import parameters, session_state
from explorer.compute.scorings import choices
from explorer.lab_choices import CHOICES, LabChoices, Selection
from explorer.parameters import (
    DATA,
    LONGEST_TEXT,
    Parameter,
    UnusableError,
    cells,
    format_number,
    is_line,
    parse_number,
    ranges,
)
from explorer.session_state import POSITIVE, SessionState, WhyTab, in_words, with_field
from explorer.workspace import Workspace
from lpn.core.files import printable
from lpn.descriptors.weather import WEATHERS
from lpn.library.analyser import OwnPicture

# Characters of a query string; the region of a large feature map fits.
_MAX_LENGTH = 20_000
_MOST_PARAMETERS = 200
# The value of `query` for a picture of the user's own, which an address cannot contain.
OWN = "own"
# The value of `flight` for the map that stands alone in plain words; for the window in the workbench it is 1.
ALONE = "map"
_NO_OWN = (
    "An own picture is held only by the page that opened it, until that is loaded again or the picture is forgotten. Open the "
    "file again. Here is another picture."
)
# Parameters of the query that is shown.
_OF_QUERY = ("with", "weather", "weather_strength", "angle", "shift", "down", "zoom", "region", "why")
# Characters of the queries that were chosen in the laboratory by hand.
_LONGEST_CHOICE = 3000
# Choices of such queries: each may name all queries in few characters, so that many would fill the server's memory.
_MOST_CHOICES = 20


class UrlState:
    """Writes and reads the addresses of one workspace, for all browsers."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self._first = {
            (name, side): _first_positions(entry.name for entry in entries)
            for name, task in workspace.tasks.items()
            for side, entries in (
                ("query", task.queries),
                ("gallery", task.gallery),
            )
        }
        reach = workspace.contract.input_size[1] // 2, workspace.contract.input_size[0] // 2
        words = parameters.choice("plain", {"expert": False, "plain": True}, "words")
        self._parameters = (
            Parameter("show", self._write_key, self._read_key),
            Parameter("task", lambda s: s.task, self._read_task),
            Parameter("query", self._write_query, self._read_query),
            Parameter("own", lambda s: s.upload.key or None if s.upload else None, lambda s, _: s),
            Parameter("with", self._write_tile, self._read_tile),
            Parameter("scoring", self._write_scoring, self._read_scoring),
            parameters.choice("weather", {name.replace("+", "-"): name for name in WEATHERS}),
            parameters.number("weather_strength", 0, 1),
            parameters.number("angle", -180, 180),
            parameters.number("shift", -reach[0], reach[0], whole=True),
            parameters.number("down", -reach[1], reach[1], whole=True),
            parameters.number("zoom", 1 / session_state.MAX_ZOOM, session_state.MAX_ZOOM),
            Parameter("weights", _write_weights, _read_weights),
            Parameter("off", _write_off, _read_off),
            Parameter("region", lambda s: ranges(s.region) or None, self._read_region),
            parameters.switch("map"),
            parameters.switch("city"),
            parameters.switch("cameras"),
            parameters.switch("why"),
            Parameter("reason", _write_why_tab, _read_why_tab),
            Parameter("beside", self._write_beside, self._read_beside),
            Parameter("lab", lambda s: "1" if s.lab else None, _read_lab),
            *(_in_lab(choice.parameter) for choice in CHOICES if choice.parameter is not None),
            Parameter("chosen", lambda s: _write_chosen(s.laboratory) if s.lab else None, self._read_chosen),
            Parameter("flight", _write_flight, self._read_flight),
            parameters.switch("exploded", "apart"),
            parameters.switch("rings"),
            parameters.switch("heat"),
            parameters.choice("heat_kind", {"activation": "activation", "evidence": "evidence"}, "shows"),
            Parameter("part", lambda s: None if s.heat_part is None else str(s.heat_part + 1), _read_heat_part),
            parameters.switch("heat_over", "over"),
            parameters.choice("same_scale", {"own": False, "same": True}, "scale"),
            parameters.number("opacity", 0, 1),
            parameters.choice("dark", {"light": False, "dark": True}, "theme"),
            Parameter(
                "words", lambda s: _write_words(s) or words.write(s), lambda s, text: _with_words(words.read(s, text))
            ),
            parameters.choice("first_screen", {"all": False, "first": True}, "screen"),
            Parameter("fails", lambda s: "1" if s.fails and s.first_screen else None, parameters.switch("fails").read),
        )
        self.keys = tuple(parameter.key for parameter in self._parameters)

    def write(self, state: SessionState) -> str:
        """Return the query string of a state, without "?" and without defaults."""
        pairs: list[tuple[str, str]] = [
            (parameter.key, value) for parameter in self._parameters if (value := parameter.write(state)) is not None
        ]
        return urlencode(pairs, quote_via=quote, safe="/,~")

    def read(
        self, text: str, state: SessionState, own: Callable[[str], OwnPicture | None] = lambda _: None
    ) -> tuple[SessionState, list[str]]:
        """Return the state that a query string describes, and a sentence about each value that is invalid.

        Args:
            text: untrusted; unknown keys are ignored.
            state: supplies what the query string leaves out.
            own: returns the user's own picture of a key, or None if the page does not hold it.
        """
        try:
            values = _parameters_of(text)
        except ValueError:
            return state, [f"It has more than {_MOST_PARAMETERS} parameters or {_MAX_LENGTH:,} characters."]
        problems = []
        if values.get("query") == OWN and (picture := own(values.get("own", ""))) is not None:
            state = replace(state, upload=picture)
            del values["query"]
        for parameter in self._parameters:  # in this order: the query depends on the task
            if (value := values.get(parameter.key)) is None:
                continue
            try:
                state = parameter.read(state, value)
            except UnusableError as problem:
                lost = (parameter.key, value) == ("query", OWN)
                problems.append(str(problem) if lost else f"{parameter.key}={printable(value[:60])}: {problem}")
                if lost:  # what was done to that picture suits no other one
                    values = {key: text for key, text in values.items() if key not in _OF_QUERY}
        return state, problems

    def names_nothing(self, text: str) -> bool:
        """Return True if a query string names neither a workspace, nor a screen, nor anything to show there.

        Args:
            text: untrusted.
        """
        return not self._named(text)

    def names_a_state(self, text: str) -> bool:
        """Return True if a query string names anything to show besides a workspace, a screen, a theme, and words.

        Args:
            text: untrusted.
        """
        return bool(self._named(text) - {"show", "screen"})

    def names_only_a_workspace(self, text: str) -> bool:
        """Return True if a query string names a workspace, and nothing to show in it besides a theme, words, and a screen.

        Args:
            text: untrusted.
        """
        return self._named(text) - {"screen"} == {"show"}

    def _named(self, text: str) -> set[str]:
        """Return the keys of what a query string names besides a theme and words; none if it has too many parameters."""
        try:
            return _parameters_of(text).keys() & (set(self.keys) - {"theme", "words"})
        except ValueError:
            return set()

    def workspace_key(self, text: str) -> str:
        """Return the key of the workspace that a query string names; the workspace `DATA` needs no name.

        Args:
            text: untrusted.
        """
        try:
            return _parameters_of(text).get("show") or self._unnamed
        except ValueError:
            return self._workspace.key

    def other_workspace(self, text: str) -> str | None:
        """Return the key of the other workspace that a query string names, see `Workspace.choices`; None if it names none.

        A query string without a workspace that names anything to show, such as a query, means the workspace `DATA`.

        Args:
            text: untrusted.
        """
        try:
            key = _parameters_of(text).get("show")
        except ValueError:
            return None
        if key is None and self._named(text) - {"screen"}:
            key = self._unnamed
        return key if key != self._workspace.key and key in self._workspace.choices else None

    @property
    def _unnamed(self) -> str:
        """The key of the workspace of query strings that name none."""
        return DATA if DATA in self._workspace.choices else self._workspace.key

    def _read_flight(self, state: SessionState, text: str) -> SessionState:
        if text not in ("0", "1", ALONE):
            raise UnusableError(f"expected 0, 1, or {ALONE}.")
        if text != "0" and not self._workspace.has_flight:
            raise UnusableError("this place has no flight; choose a place that has one.")
        alone = text == ALONE
        # The end of the map that stands alone leads back to the first screen.
        return replace(state, flight=text != "0", map_alone=alone, from_first_screen=alone)

    def _write_key(self, _: SessionState) -> str | None:
        return None if self._workspace.key == self._unnamed else self._workspace.key

    def _read_key(self, state: SessionState, value: str) -> SessionState:
        if value != self._workspace.key:
            raise UnusableError(f"there is nothing else to show than {', '.join(self._workspace.choices) or 'this'}.")
        return state

    def _write_beside(self, state: SessionState) -> str | None:
        return self._workspace.beside[state.beside].label if state.beside else None

    def _read_beside(self, state: SessionState, value: str) -> SessionState:
        labels = [one.label for one in self._workspace.beside]
        if value not in labels:
            raise UnusableError(f"expected {' or '.join(labels)}." if labels else "there is no model beside this one.")
        return replace(state, beside=labels.index(value))

    def _write_scoring(self, state: SessionState) -> str | None:
        return None if state.scoring == self._workspace.tasks[state.task].scoring else state.scoring

    def _read_scoring(self, state: SessionState, value: str) -> SessionState:
        ready = [one.scoring for one in choices(self._workspace.rankings, state.task) if one.ready]
        if value not in ready:
            raise UnusableError(f"it is ranked {' or '.join(ready)} here.")
        return with_field(state, "scoring", value)

    def _read_task(self, state: SessionState, value: str) -> SessionState:
        if value not in self._workspace.tasks:
            raise UnusableError(f"this data set offers {', '.join(self._workspace.tasks)}.")
        return state if value == state.task else replace(state, task=value, query=0)

    def _write_query(self, state: SessionState) -> str:
        if state.upload is not None:
            return OWN
        return self._name(state, "query", self._workspace.tasks[state.task].queries, state.query)

    def _read_query(self, state: SessionState, value: str) -> SessionState:
        task = self._workspace.tasks[state.task]
        query = self._position(state, "query", len(task.queries), value)
        if query is None and value == OWN:
            raise UnusableError(_NO_OWN)
        if query is None:
            raise UnusableError(f"there is no such query; names are such as {task.queries[0].name}.")
        return replace(state, query=query)

    def _write_tile(self, state: SessionState) -> str | None:
        if state.selected is None or state.selected == POSITIVE:
            return state.selected
        task = self._workspace.tasks[state.task]
        return self._name(state, "gallery", task.gallery, state.selected)

    def _read_tile(self, state: SessionState, value: str) -> SessionState:
        gallery = self._workspace.tasks[state.task].gallery
        tile = self._position(state, "gallery", len(gallery), value)
        if tile is not None:
            return replace(state, selected=tile)
        if value == POSITIVE:
            return replace(state, selected=POSITIVE)
        example = f"; names are such as {gallery[0].name}" if len(gallery) else ""
        raise UnusableError(f"there is no such tile{example}.")

    def _name(self, state: SessionState, side: str, entries: Sequence[Any], index: int) -> str:
        """Return a picture's name, or "~" and its position where the name is ambiguous."""
        name = str(entries[index].name)
        plain = name == printable(name) and name not in (OWN, POSITIVE) and name[:1] != "~"
        return name if plain and self._first[state.task, side][name] == index else f"~{index}"

    def _position(self, state: SessionState, side: str, count: int, value: str) -> int | None:
        if re.fullmatch(r"~\d{1,9}", value):
            return int(value[1:]) if int(value[1:]) < count else None
        return None if value in (OWN, POSITIVE) else self._first[state.task, side].get(value)

    def _read_region(self, state: SessionState, value: str) -> SessionState:
        rows, columns = self._workspace.map_sizes[self._workspace.tasks[state.task].query_view]
        return replace(state, region=cells(value, rows * columns))

    def _read_chosen(self, state: SessionState, value: str) -> SessionState:
        queries = len(self._workspace.tasks[state.task].queries)
        try:
            if len(value) > _LONGEST_CHOICE or value.count("\n") >= _MOST_CHOICES:
                raise ValueError
            lines = [line.split("\t") for line in value.split("\n")]
            chosen = [Selection(kind, label, cells(rows, queries) if rows else ()) for kind, label, rows in lines]
        except (ValueError, UnusableError) as error:
            raise UnusableError("expected queries that were chosen in the table of this data set.") from error
        if not all(is_line(text, LONGEST_TEXT) for one in chosen for text in (one.kind, one.label)):
            raise UnusableError(f"expected labels of {LONGEST_TEXT} letters at most that can be printed.")
        return replace(state, laboratory=replace(state.laboratory, selections=tuple(chosen)))


def _parameters_of(text: str) -> dict[str, str]:
    """Return the parameters of a query string; ValueError if there are too many, or it is too long."""
    if len(text) > _MAX_LENGTH:
        raise ValueError
    return dict(parse_qsl(text.removeprefix("?"), True, max_num_fields=_MOST_PARAMETERS))


def _write_flight(state: SessionState) -> str | None:
    return (ALONE if state.map_alone else "1") if state.flight else None


def _write_words(state: SessionState) -> str | None:
    """Return the first screen's words, which are no default of the browser's where a link brought them."""
    return ("plain" if state.plain else "expert") if state.first_screen else None


def _with_words(state: SessionState) -> SessionState:
    """Return a state whose first screen speaks the same words."""
    return in_words(state, state.plain, state.plain)


def _first_positions(names: Iterable[str]) -> dict[str, int]:
    first: dict[str, int] = {}
    for index, name in enumerate(names):
        first.setdefault(name, index)
    return first


def _write_weights(state: SessionState) -> str | None:
    return None if set(state.weights) == {1.0} else ",".join(map(format_number, state.weights))


def _read_weights(state: SessionState, text: str) -> SessionState:
    pieces = text.split(",")
    if len(pieces) != state.n_parts:
        raise UnusableError(f"expected {state.n_parts} weights, one for each part.")
    return replace(state, weights=tuple(parse_number(piece, 0, session_state.MAX_WEIGHT) for piece in pieces))


def _write_off(state: SessionState) -> str | None:
    return ",".join(str(part + 1) for part, on in enumerate(state.enabled) if not on) or None


def _read_off(state: SessionState, text: str) -> SessionState:
    parts = {round(parse_number(piece, 1, state.n_parts)) for piece in text.split(",")}
    return replace(state, enabled=tuple(part + 1 not in parts for part in range(state.n_parts)))


def _write_why_tab(state: SessionState) -> str | None:
    return state.why_tab if state.why and state.why_tab not in ("best", SessionState.why_tab) else None


def _read_why_tab(state: SessionState, text: str) -> SessionState:
    tabs = [tab for tab in get_args(WhyTab) if tab != "best"]
    if text not in tabs:
        raise UnusableError(f"expected {' or '.join(tabs)}.")
    return with_field(state, "why_tab", text)


def _read_heat_part(state: SessionState, text: str) -> SessionState:
    return replace(state, heat_part=round(parse_number(text, 1, state.n_parts)) - 1)


def _write_chosen(lab: LabChoices) -> str | None:
    """Write the queries that were chosen by hand, a line for each choice; None if they are too many for an address."""
    lines = [(one.kind, one.label, ranges(one.rows)) for one in lab.selections]
    if not lines or not all(is_line(text, LONGEST_TEXT) for kind, label, _ in lines for text in (kind, label)):
        return None
    text = "\n".join(map("\t".join, lines))
    return text if len(text) <= _LONGEST_CHOICE and len(lines) <= _MOST_CHOICES else None


def _in_lab(parameter: Parameter) -> Parameter:
    """Return a parameter of the laboratory as one of the page, which an address has while the laboratory is open."""

    def write(state: SessionState) -> str | None:
        return parameter.write(state.laboratory) if state.lab else None

    def read(state: SessionState, text: str) -> SessionState:
        return replace(state, laboratory=parameter.read(state.laboratory, text))

    return Parameter(parameter.key, write, read)


def _read_lab(state: SessionState, text: str) -> SessionState:
    """Open the laboratory as it is at first; the parameters that follow say what else it shows."""
    if text not in ("0", "1"):
        raise UnusableError("expected 0 or 1.")
    return replace(state, lab=text == "1", laboratory=LabChoices() if text == "1" else state.laboratory)
