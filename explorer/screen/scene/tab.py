"""The scene of one tab: drawn from the newest result behind it, once its frame is there."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import viser

from explorer.compute.worker import Worker
from explorer.screen.fields import ScreenState
from explorer.screen.loop import ScreenMessage
from explorer.screen.result import ScreenResult
from explorer.screen.scene.scene import Scene


class TabScene:
    """Draws on a thread of its own, and answers what the pointer is over.

    Attributes:
        client: viser's, of the tab's frame; None without one.
        drawn: the scene of the frame; None until something is drawn in it.

    Args:
        send: hands a message to the page.
    """

    def __init__(self, send: Callable[[ScreenMessage], None]) -> None:
        self._send = send
        self.client: viser.ClientHandle | None = None
        self.drawn: Scene | None = None
        self._shown: tuple[ScreenResult, ScreenState] | None = None
        self._worker = Worker(self._draw, lambda _: None)

    def attach(self, client: viser.ClientHandle | None) -> None:
        """Draw in a frame of viser's page from now on; None once it has gone."""
        self.client = client
        self._worker.wake()

    def show(self, result: ScreenResult, state: ScreenState) -> None:
        """Draw a result in a state's view and theme."""
        self._shown = result, state
        self._worker.wake()

    def fit(self, _: Mapping[str, Any]) -> None:
        """Fit the view to the frame's new size."""
        self._worker.wake()

    def hover(self, arguments: Mapping[str, Any]) -> None:
        """Show one `part` alone, or all."""
        part = arguments.get("part")
        if self.drawn is not None:
            self.drawn.hover(part if isinstance(part, int) and part >= 0 else None)

    def pick(self, arguments: Mapping[str, Any]) -> None:
        """Say what is at a place of the scene, `x` and `y` in shares of its sides."""
        place = [arguments.get(name) for name in ("x", "y")]
        if self.drawn is not None and all(isinstance(one, (int, float)) and 0 <= one <= 1 for one in place):
            found = self.drawn.pick(*map(float, place))  # type: ignore[arg-type]
            self._send({"picked": found or {}})

    def stop(self) -> None:
        """End after what is being drawn."""
        self._worker.stop()

    def _draw(self) -> None:
        client = self.client
        if client is None or self._shown is None:
            self.drawn = None if client is None else self.drawn
            return
        result, state = self._shown
        if self.drawn is None or self.drawn.client is not client:
            self.drawn = Scene(client)
        self.drawn.show(replace(result, state=replace(result.state, view=state.view, theme=state.theme)))
        self._send({"scene": "ready"})
