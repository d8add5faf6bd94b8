"""Two-way bindings between viser's inputs and a session state."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import viser

from explorer.session_state import SessionState, StateChange, number, with_field


@dataclass(frozen=True, eq=False)
class _Binding:
    """One input.

    Attributes:
        apply: checks an untrusted value and applies it to a state.
        value_of: returns the value that shows a state; None if the input is never written.
    """

    handle: Any
    apply: Callable[[SessionState, Any], SessionState]
    value_of: Callable[[SessionState], Any] | None


class Controls:
    """The inputs of one browser that show its state.

    On any change, all inputs are read, because the page may merge two changes into one message. Every value is untrusted
    and therefore checked.

    Args:
        state: gives the initial values.
        change: updates the browser's state with a function.
    """

    def __init__(self, gui: viser.GuiApi, state: SessionState, change: Callable[[StateChange], None]) -> None:
        self._gui, self._initial, self._change = gui, state, change
        self._bindings: dict[str, _Binding] = {}
        # The state of the last `read`, None after the next `write`, and the inputs' values at that time.
        self._last_read: tuple[SessionState | None, dict[str, Any]] = None, {}
        self._writing_thread: int | None = None

    def bind(
        self,
        name: str,
        handle: Any,
        apply: Callable[[SessionState, Any], SessionState],
        value_of: Callable[[SessionState], Any] | None = None,
    ) -> None:
        """Add an input; inputs are read in the order in which they are added."""
        self._bindings[name] = _Binding(handle, apply, value_of)
        handle.on_update(self._on_update)

    def slider(
        self, label: str, field: str, low: float, high: float, step: float, *, whole: bool = False, visible: bool = True
    ) -> None:
        """Add a slider for a number of the state."""
        handle = self._gui.add_slider(label, low, high, step, getattr(self._initial, field), visible=visible)

        def apply(state: SessionState, value: Any) -> SessionState:
            checked = number(value, low, high, getattr(state, field))
            return with_field(state, field, round(checked) if whole else checked)

        self.bind(field, handle, apply, lambda state: getattr(state, field))

    def checkbox(
        self,
        label: str,
        field: str,
        *,
        visible: bool = True,
        apply: Callable[[SessionState, bool], SessionState] | None = None,
    ) -> viser.GuiCheckboxHandle:
        """Add a checkbox for a boolean of the state; `apply` changes the state, by default by setting the boolean."""
        change = apply or (lambda state, on: with_field(state, field, on))
        handle = self._gui.add_checkbox(label, getattr(self._initial, field), visible=visible)
        self.bind(
            field,
            handle,
            lambda state, value: change(state, bool(value)),
            lambda state: getattr(state, field),
        )
        return handle

    def dropdown(
        self,
        label: str,
        field: str,
        choices: Mapping[str, Any],
        *,
        visible: bool = True,
        hint: str | None = None,
    ) -> None:
        """Add a dropdown for a field of the state; `choices` maps each label to its value, and other labels are ignored."""
        labels = {value: text for text, value in choices.items()}
        initial = labels[getattr(self._initial, field)]
        handle = self._gui.add_dropdown(label, tuple(choices), initial_value=initial, visible=visible, hint=hint)

        def choose(state: SessionState, value: Any) -> SessionState:
            known = isinstance(value, str) and value in choices
            return with_field(state, field, choices[value]) if known else state

        self.bind(field, handle, choose, lambda state: labels[getattr(state, field)])

    def read(self, state: SessionState) -> SessionState:
        """Return the state with the value of every input."""
        values = {name: binding.handle.value for name, binding in self._bindings.items()}
        for name, binding in self._bindings.items():
            state = binding.apply(state, values[name])
        self._last_read = state, values
        return state

    def write(self, state: SessionState) -> None:
        """Write a state into the inputs, except those for which the page has sent a newer value since `read`."""
        (read, values), self._last_read = self._last_read, (None, {})
        if state != read:
            values = {}
        self._writing_thread = threading.get_ident()  # viser calls `_on_update` at once
        try:
            for name, binding in self._bindings.items():
                now = binding.handle.value
                wanted = now if binding.value_of is None else binding.value_of(state)
                if now != wanted and now == values.get(name, now):
                    binding.handle.value = wanted
        finally:
            self._writing_thread = None

    def _on_update(self, _: Any) -> None:
        if self._writing_thread != threading.get_ident():
            self._change(self.read)
