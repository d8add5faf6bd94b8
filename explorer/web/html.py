"""Html in the page that is sent only when it changed."""

from __future__ import annotations

import threading

import viser


class Html:
    """An html element that is sent again only when its text changed. Several threads may show something in it."""

    def __init__(self, gui: viser.GuiApi, content: str = "") -> None:
        self._handle = gui.add_html(_sendable(content))
        self._content, self._lock = content, threading.Lock()

    def show(self, content: str) -> None:
        """Put html into the element."""
        with self._lock:  # or an older text might be sent last, and be taken for the newer one from then on
            if content != self._content:
                self._content = content
                self._handle.content = _sendable(content)


def _sendable(content: str) -> str:
    """Text without what UTF-8 has no bytes for, which would end the connection: half characters of names that are not UTF-8."""
    return content.encode("utf-8", "replace").decode()
