"""HTML elements of viser that send their content only when it changed, without control characters of names.

A lone surrogate, as in a file name that is not UTF-8, would make viser close the connection.
"""

from __future__ import annotations

import threading

import viser

from explorer.server.viser_compat import is_removed
from lpn.core.files import TYPED, printable


class Html:
    """A thread-safe HTML element; it sends its content again only when that changed."""

    def __init__(self, gui: viser.GuiApi, content: str = "") -> None:
        self._handle = gui.add_html(printable(content, TYPED))
        self._content, self._lock = content, threading.Lock()

    def show(self, content: str) -> None:
        """Replace the content."""
        with self._lock:  # otherwise an older text could be sent last while `_content` holds the newer one
            # A worker of a session that was replaced may still be at work.
            if content != self._content and not is_removed(self._handle):
                self._content = content
                self._handle.content = printable(content, TYPED)
