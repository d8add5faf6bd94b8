"""What the command palette offers beyond the panels' own keys, so that everything can be reached from it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, cast

import viser

from explorer import session_state
from explorer.panels.panels import Panels
from explorer.session_state import SessionState, StateChange
from explorer.web.bridge import PageBridge
from explorer.workspace import Workspace

_SHIFT = 8
_ZOOM = 1.1


def add(
    gui: viser.GuiApi,
    workspace: Workspace,
    panels: Panels,
    change: Callable[[StateChange], None],
    bridge: PageBridge,
    further: Sequence[tuple[str, Callable[[], None]]],
) -> None:
    """Register them for one browser; `further` are those of the windows."""
    live = workspace.model is not None
    orders: list[tuple[str, str | None, Callable[[], None]]] = [
        ("Copy link to what is shown", "I", lambda: bridge.call("copy")),
        ("Show the tour", None, lambda: bridge.call("tour")),
        ("Find a picture by name", None, lambda: bridge.call("focus", panels.finder)),
    ]
    if live:
        orders.append(("Use my own picture", "U", lambda: bridge.call("upload")))
    orders += [(label, None, order) for label, order in further]
    for label, key, order in orders:
        gui.add_command(label, hotkey=cast(Any, key)).on_trigger(_calls(order))
    changes: list[tuple[str, str | None, StateChange]] = [("Light or dark", "O", session_state.flip_dark)]
    if len(workspace.tasks) > 1:
        changes += [(f"Task: {name}", None, _task(name)) for name in workspace.tasks]
    changes += [(f"Part {name} on or off", None, _flip_part(part)) for part, name in enumerate(workspace.part_names)]
    changes.append(("All parts equal", None, lambda state: replace(state, weights=(), enabled=())))
    if live:
        changes += [(f"Heatmap of part {name}", None, _heat_of(part)) for part, name in enumerate(workspace.part_names)]
        changes += [
            ("Heatmap of all parts", None, _heat_of(None)),
            ("Zoom in", None, _zoom(_ZOOM)),
            ("Zoom out", None, _zoom(1 / _ZOOM)),
            (f"Shift right by {_SHIFT} pixels", None, _shift(workspace, _SHIFT, 0)),
            (f"Shift left by {_SHIFT} pixels", None, _shift(workspace, -_SHIFT, 0)),
            (f"Shift down by {_SHIFT} pixels", None, _shift(workspace, 0, _SHIFT)),
            (f"Shift up by {_SHIFT} pixels", None, _shift(workspace, 0, -_SHIFT)),
        ]
    for label, key, changed in changes:
        gui.add_command(label, hotkey=cast(Any, key)).on_trigger(_changes(change, changed))


def _calls(order: Callable[[], None]) -> Callable[[Any], None]:
    return lambda _: order()


def _changes(change: Callable[[StateChange], None], changed: StateChange) -> Callable[[Any], None]:
    return lambda _: change(changed)


def _task(name: str) -> StateChange:
    return lambda state: session_state.take_task(state, name)


def _flip_part(part: int) -> StateChange:
    def flipped(state: SessionState) -> SessionState:
        enabled = tuple(on != (i == part) for i, on in enumerate(state.enabled))
        return replace(state, enabled=enabled)

    return flipped


def _heat_of(part: int | None) -> StateChange:
    return lambda state: replace(state, heat=True, heat_part=part)


def _zoom(factor: float) -> StateChange:
    low, high = 1 / session_state.MAX_ZOOM, session_state.MAX_ZOOM
    return lambda state: replace(state, zoom=min(max(round(state.zoom * factor, 2), low), high))


def _shift(workspace: Workspace, right: int, down: int) -> StateChange:
    reach = workspace.spec.input_size[1] // 2, workspace.spec.input_size[0] // 2

    def shifted(state: SessionState) -> SessionState:
        across = min(max(state.shift + right, -reach[0]), reach[0])
        return replace(state, shift=across, down=min(max(state.down + down, -reach[1]), reach[1]))

    return shifted
