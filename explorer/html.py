"""Html in the page that is sent only when it changed."""

from __future__ import annotations

import viser


class Html:
    """An html element that is sent again only when its text changed."""

    def __init__(self, gui: viser.GuiApi, content: str = "") -> None:
        self._handle = gui.add_html(content)
        self._content = content

    def show(self, content: str) -> None:
        """Put html into the element."""
        if content != self._content:
            self._content = content
            self._handle.content = content
