"""The panel Parts: a switch and a weight for each part."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import viser

from explorer import session_state
from explorer.panels import pages
from explorer.panels.controls import Controls
from explorer.session_state import MAX_WEIGHT, SessionState, StateChange
from explorer.workspace import Workspace


def add(gui: viser.GuiApi, workspace: Workspace, controls: Controls, change: Callable[[StateChange], None]) -> None:
    """Build the panel for one browser."""
    gui.add_html(pages.note(pages.PARTS_NOTE))
    for part, name in enumerate(workspace.part_names):
        _bind(controls, "enabled", part, gui.add_checkbox(f"Part {name}", True), lambda value, _: bool(value))
        slider = gui.add_slider(f"Weight {name}", 0.0, MAX_WEIGHT, 0.05, 1.0)
        _bind(controls, "weights", part, slider, lambda value, old: session_state.number(value, 0, MAX_WEIGHT, old))
    gui.add_button("All parts equal").on_click(lambda _: change(session_state.equal_parts))


def _bind(controls: Controls, field: str, part: int, handle: Any, check: Callable[[Any, Any], Any]) -> None:
    """Bind an input to one part's entry of a tuple in the state."""

    def apply(state: SessionState, value: Any) -> SessionState:
        entries = list(getattr(state, field))
        entries[part] = check(value, entries[part])
        return session_state.with_field(state, field, tuple(entries))

    controls.bind(f"{field} {part}", handle, apply, lambda state: getattr(state, field)[part])
