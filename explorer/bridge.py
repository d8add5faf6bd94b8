"""Messages from html in the page: where a mouse was pressed, which cells are painted. None of them is trusted."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

import viser

log = logging.getLogger(__name__)

LONGEST = 60_000
"""Characters of a message: a region of a large feature map fits."""
_SCRIPT = (Path(__file__).parent / "page.js").read_text(encoding="utf-8")
_PIXEL = "data:image/gif;base64,R0lGODlhAQABAIAAAAAAAP///yH5BAEAAAAALAAAAAABAAEAAAIBRAA7"


class Bridge:
    """Puts the page's own script into it and hands its messages on.

    Args:
        handlers: for each kind of message, what is called with its value, which may be anything that JSON can say.
    """

    def __init__(self, gui: viser.GuiApi, handlers: dict[str, Callable[[Any], None]]) -> None:
        self._handlers = handlers
        self._text = gui.add_text("page", "")
        self._text.on_update(lambda _: self.receive(self._text.value))
        uuid = str(self._text._impl.uuid)
        hide = f'div:has(>div>p>label[for="{uuid}"]){{display:none!important}}'
        # An image's onload is the one way in: scripts in html that is put into a page do not run.
        run = escape(f"{_SCRIPT};window.lpn.bridge={json.dumps(uuid)}")
        gui.add_html(f"<style>{hide}</style><img src='{_PIXEL}' style='display:none' alt='' onload=\"{run}\">")

    def receive(self, message: Any) -> None:
        """Hand a message to its handler; what is no message is dropped."""
        if not isinstance(message, str) or len(message) > LONGEST:
            return
        try:
            found: Any = json.loads(message)
            handler = self._handlers[found["kind"]]
            value = found.get("value")
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            log.debug("Dropped a message of %d characters", len(message))
            return
        handler(value)


def send(kind: str, value: object = None) -> str:
    """The attribute that sends a message when its element is clicked."""
    return f'onclick="{escape(f"lpn.send({json.dumps(kind)},{json.dumps(value)})")}"'
