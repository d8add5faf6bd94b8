"""The scene of one tab, drawn after each result as soon as its frame exists."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import viser

from explorer.compute.worker import Worker
from explorer.screen.fields import ScreenState
from explorer.screen.loop import ScreenMessage
from explorer.screen.panel import SceneLines
from explorer.screen.result import ScreenResult
from explorer.screen.scene.scene import Scene

# Change of a frame's aspect after which its scene is drawn again.
_OTHER_SHAPE = 0.02


class TabScene:
    """Draws the scene on a worker thread, and finds the object under the pointer.

    Attributes:
        client: viser's client of the tab's frame; None without a frame.
        drawn: the scene of the frame; None until something is drawn.

    Args:
        send: hands a message to the page.
        lines: returns the panels' lines for the scene of a result.
    """

    def __init__(
        self,
        send: Callable[[ScreenMessage], None],
        lines: Callable[[ScreenResult], Sequence[SceneLines]] = lambda _: (),
    ) -> None:
        self._send, self._lines = send, lines
        self.client: viser.ClientHandle | None = None
        self.drawn: Scene | None = None
        self._shown: tuple[ScreenResult, ScreenState] | None = None
        self._aspect = 1.0
        self._part: int | None = None
        self._worker = Worker(self._draw)

    def attach(self, client: viser.ClientHandle | None) -> None:
        """Draw in the scene of a viser client from now on; None once the client has left."""
        self.client = client
        self._worker.wake()

    def take(self, result: ScreenResult, state: ScreenState) -> None:
        """Store a result, and the state with its view and theme, for `draw`."""
        self._shown = result, state

    def draw(self) -> None:
        """Draw the last taken result."""
        self._worker.wake()

    def hover(self, arguments: Mapping[str, Any]) -> None:
        """Show one `part` alone, or all."""
        part = arguments.get("part")
        self._part = part if isinstance(part, int) and part >= 0 else None
        if self.drawn is not None:
            self.drawn.hover(self._part)

    def pick(self, arguments: Mapping[str, Any]) -> None:
        """Send the object at `x` and `y`, which are shares of the scene's sides; `why` is "hover" or "click"."""
        why = "click" if arguments.get("why") == "click" else "hover"
        place = [arguments.get(name) for name in ("x", "y")]
        if self.drawn is not None and all(isinstance(one, (int, float)) and 0 <= one <= 1 for one in place):
            found = self.drawn.pick(*map(float, place))  # type: ignore[arg-type]
            self._send({"picked": {**(found or {}), "why": why}, "kind": why})

    def stop(self) -> None:
        """End after the current drawing."""
        self._worker.stop()

    def _fit(self, camera: viser.CameraHandle) -> None:
        """Draw again for a frame of another shape, which viser's page reports with its camera."""
        if abs(camera.aspect - self._aspect) > _OTHER_SHAPE:
            self._worker.wake()

    def _draw(self) -> None:
        client = self.client
        if client is None or self._shown is None:
            self.drawn = None if client is None else self.drawn
            return
        result, state = self._shown
        if self.drawn is None or self.drawn.client is not client:
            self.drawn = Scene(client)
            client.camera.on_update(self._fit)
        self._aspect = client.camera.aspect
        self.drawn.show(
            replace(result, state=replace(result.state, view=state.view, theme=state.theme)), self._lines(result)
        )
        self.drawn.hover(self._part)
        self._send({"scene": result.state.place})
