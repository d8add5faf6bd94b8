"""Html in the page that is sent only when it changed."""

from __future__ import annotations

import viser


class Html:
    """An html element that is sent again only when its text changed."""

    def __init__(self, gui: viser.GuiApi, content: str = "") -> None:
        self._handle = gui.add_html(_sendable(content))
        self._content = content

    def show(self, content: str) -> None:
        """Put html into the element."""
        if content != self._content:
            self._content = content
            self._handle.content = _sendable(content)


def _sendable(content: str) -> str:
    """Text without what UTF-8 has no bytes for, which would end the connection: half characters of names that are not UTF-8."""
    return content.encode("utf-8", "replace").decode()
