"""The hotkeys and the palette, whose commands cover every action of the app."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, cast

import viser

from explorer import session_state
from explorer.panels.panels import Panels
from explorer.panels.query_panel import city_available
from explorer.server.viser_compat import uuid_of
from explorer.session_state import MAX_ZOOM, POSITIVE, SessionState, StateChange
from explorer.web.bridge import PageBridge
from explorer.workspace import Workspace
from lpn.tasks.task import Scoring

_SCORINGS: Mapping[Scoring, str] = {
    "plain": "Ranking: plain",
    "calibrated": "Ranking: calibrated",
    "csls": "Ranking: by CSLS",
}
_SHIFT_STEP = 8
_ZOOM_STEP = 1.1


def add(
    gui: viser.GuiApi,
    workspace: Workspace,
    panels: Panels,
    change: Callable[[StateChange], None],
    bridge: PageBridge,
    window_commands: Sequence[tuple[str, str | None, Callable[[], None]]],
    show_scoring: Callable[[Scoring], None],
) -> None:
    """Register all commands for one browser.

    Args:
        show_scoring: ranks by a scoring, which is prepared first where it is not ready.
    """
    for label, key, state_change in _changes(workspace, panels):
        _register(gui, label, key, _with_change(change, state_change))
    for slot in range(9):
        _register(gui, f"Compare match {slot + 1}", str(slot + 1), panels.answer.compare(slot))
    calls: list[tuple[str, str | None, Callable[[], None]]] = [
        ("Copy link to what is shown", "I", lambda: bridge.call("copy")),
        ("Find a picture by name", None, lambda: bridge.call("focus", uuid_of(panels.query.find_box))),
    ]
    if workspace.model is not None:
        calls.append(("Use my own picture", "U", lambda: bridge.call("upload")))
    if not workspace.scorings.why_not:
        calls += [(label, None, partial(show_scoring, scoring)) for scoring, label in _SCORINGS.items()]
    calls += window_commands
    for label, key, call in calls:
        _register(gui, label, key, _without_event(call))


def _changes(workspace: Workspace, panels: Panels) -> list[tuple[str, str | None, StateChange]]:
    """Return label, hotkey, and state change of each command."""
    navigation, word = panels.navigation, f"{workspace.contract.part_noun}s"
    changes: list[tuple[str, str | None, StateChange]] = [
        ("Next picture", "N", navigation.next),
        ("Previous picture", "P", navigation.previous),
        ("Random picture", "R", navigation.random),
        ("Random failure", "F", navigation.failure),
        ("Turn left 5°", "J", lambda state: session_state.turn(state, 5)),
        ("Turn right 5°", "L", lambda state: session_state.turn(state, -5)),
        ("Reset weather, rotation, shift, and zoom", "K", session_state.upright),
        ("Compare the true tile", "T", lambda state: replace(state, selected=POSITIVE)),
        ("Map on or off", "M", lambda state: _flip_map(workspace, state)),
        (
            "Close the explanation or the map" + (f", or put the {word} together" if workspace.has_parts else ""),
            "escape",
            session_state.leave_stage_view,
        ),
        ("Why: evidence for the compared pair", "Y", session_state.flip_why),
        ("All pictures in a table", "B", session_state.flip_lab),
        *(_of_flights() if workspace.has_flight else []),
        ("3-D city on the map on or off", "C", lambda state: _flip_city(workspace, state)),
        ("Light or dark theme", "O", session_state.flip_dark),
        ("Plain words or the field's terms", None, session_state.flip_words),
    ]
    if len(workspace.tasks) > 1:
        changes += [(f"Task: {name}", None, navigation.choose_task(name)) for name in workspace.tasks]
    parts = list(enumerate(workspace.part_names)) if workspace.has_parts else []
    if parts:
        changes += [
            (f"{word.capitalize()} on or off", "G", lambda state: replace(state, rings=not state.rings)),
            (f"Take the {word} apart", "X", lambda state: replace(state, exploded=not state.exploded)),
        ]
    changes += [(f"Part {name} on or off", None, partial(session_state.flip_part, part=part)) for part, name in parts]
    if parts:
        changes.append(("All parts equal", None, session_state.equal_parts))
    if not workspace.without_cells:
        changes += [
            ("Heatmap on or off", "H", lambda state: replace(state, heat=not state.heat)),
            ("Heatmap: activation or evidence", "V", session_state.flip_heat_kind),
            *((f"Heatmap of part {name}", None, _show_heat(part)) for part, name in parts),
            *([("Heatmap of all parts", None, _show_heat(None))] if parts else []),
        ]
    if workspace.model is not None:
        changes += [
            ("Zoom in", None, _zoom(_ZOOM_STEP)),
            ("Zoom out", None, _zoom(1 / _ZOOM_STEP)),
            (f"Shift right by {_SHIFT_STEP} pixels", None, _shift(workspace, _SHIFT_STEP, 0)),
            (f"Shift left by {_SHIFT_STEP} pixels", None, _shift(workspace, -_SHIFT_STEP, 0)),
            (f"Shift down by {_SHIFT_STEP} pixels", None, _shift(workspace, 0, _SHIFT_STEP)),
            (f"Shift up by {_SHIFT_STEP} pixels", None, _shift(workspace, 0, -_SHIFT_STEP)),
        ]
    return changes


def _of_flights() -> list[tuple[str, str | None, StateChange]]:
    return [
        ("Flight over its map", "W", session_state.flip_flight),
        (
            "On the map: cameras of the flight on or off",
            "D",
            lambda state: replace(state, cameras=not state.cameras) if state.map else None,
        ),
    ]


def _register(gui: viser.GuiApi, label: str, key: str | None, callback: Callable[[Any], None]) -> None:
    gui.add_command(label, hotkey=cast(Any, key)).on_trigger(callback)


def _with_change(change: Callable[[StateChange], None], state_change: StateChange) -> Callable[[Any], None]:
    return lambda _: change(state_change)


def _without_event(call: Callable[[], None]) -> Callable[[Any], None]:
    return lambda _: call()


def _flip_map(workspace: Workspace, state: SessionState) -> SessionState:
    return session_state.show_map(state, not state.map and workspace.tasks[state.task].geometry is not None)


def _flip_city(workspace: Workspace, state: SessionState) -> SessionState:
    return replace(state, city=not state.city) if city_available(workspace, state) else state


def _show_heat(part: int | None) -> StateChange:
    return lambda state: replace(state, heat=True, heat_part=part)


def _zoom(factor: float) -> StateChange:
    return lambda state: replace(state, zoom=min(max(round(state.zoom * factor, 2), 1 / MAX_ZOOM), MAX_ZOOM))


def _shift(workspace: Workspace, right: int, down: int) -> StateChange:
    max_down, max_right = (side // 2 for side in workspace.contract.input_size)

    def shift(state: SessionState) -> SessionState:
        return replace(
            state,
            shift=min(max(state.shift + right, -max_right), max_right),
            down=min(max(state.down + down, -max_down), max_down),
        )

    return shift
