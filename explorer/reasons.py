"""The window of reasons: evidence, true against wrong, profiles, and search by a region, in tabs of one movable panel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import viser

from explorer import why
from explorer.exhibit import Answer, Exhibit
from explorer.html import Html
from explorer.session import State

Change = Callable[[State], State | None]
_WIDTH, _HEIGHT, _EDGE = 1000, 900, 6


class Reasons:
    """One browser's window; it shows answers while the state says that it is open."""

    def __init__(self, client: viser.ClientHandle, exhibit: Exhibit, change: Callable[[Change], None]) -> None:
        self._client, self._exhibit, self._change = client, exhibit, change
        self._panel = client.gui.add_panel(visible=False)
        self._open = False
        with self._panel.add_tab("Why", viser.Icon.ZOOM_QUESTION):
            client.gui.add_html(why.STYLE)
            self._why = Html(client.gui)
            self._close()

    def _close(self) -> None:
        self._client.gui.add_button("Close").on_click(lambda _: self._change(lambda state: replace(state, why=False)))

    def handlers(self) -> dict[str, Callable[[Any], None]]:
        """What the window's html may ask for."""
        return {"part": self._part}

    def show(self, answer: Answer) -> None:
        """Open or close the window, and fill it."""
        opened = answer.state.why
        if opened:
            self._why.show(why.page(answer, self._exhibit))
        if opened != self._open:
            self._open = opened
            if opened:
                self._place()
            self._panel.visible = opened

    def _place(self) -> None:
        """Over the stage, as large as it has room for."""
        camera = self._client.camera
        width = min(max(camera.image_width - 2 * _EDGE, 320), _WIDTH)
        height = min(max(camera.image_height - 2 * _EDGE, 320), _HEIGHT)
        self._panel.float(x=_EDGE, y=_EDGE, width=width, height=height)
        self._panel.expand()

    def _part(self, value: Any) -> None:
        known = value is None or (isinstance(value, int) and 0 <= value < self._exhibit.spec.n_parts)
        if known and not isinstance(value, bool):
            self._change(lambda state: replace(state, heat_part=value))
