"""HTML elements of viser that send their content only when it changed."""

from __future__ import annotations

import threading

import viser

from explorer.server.viser_compat import is_removed


class Html:
    """A thread-safe HTML element; it sends its content again only when that changed."""

    def __init__(self, gui: viser.GuiApi, content: str = "") -> None:
        self._handle = gui.add_html(_encodable(content))
        self._content, self._lock = content, threading.Lock()

    def show(self, content: str) -> None:
        """Replace the content."""
        with self._lock:  # otherwise an older text could be sent last while `_content` holds the newer one
            # A worker of a session that was replaced may still be at work.
            if content != self._content and not is_removed(self._handle):
                self._content = content
                self._handle.content = _encodable(content)


def _encodable(content: str) -> str:
    """Replace lone surrogates, as in file names that are not UTF-8; viser would close the connection on them."""
    return content.encode("utf-8", "replace").decode()
