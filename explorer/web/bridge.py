"""Messages from html in the page: where a mouse was pressed, which cells are painted. None of them is trusted."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import viser

from explorer.web.html import Html

log = logging.getLogger(__name__)

LONGEST = 60_000
"""Characters of a message: a region of a large feature map fits."""
_SCRIPT = ";".join(
    (Path(__file__).parent / "js" / name).read_text("utf-8")
    for name in ("page.js", "viewport.js", "tour.js", "url_state.js")
)
_PIXEL = "data:image/gif;base64,R0lGODlhAQABAIAAAAAAAP///yH5BAEAAAAALAAAAAABAAEAAAIBRAA7"


PRESSED = 'role="button" tabindex="0"'
"""What makes an element that is clicked one that a keyboard reaches, too; `viewport.js` has Enter and Space click it."""


class Bridge:
    """Puts the page's own script into it and hands its messages on.

    Args:
        handlers: for each kind of message, what is called with its value, which may be anything that JSON can say.
        told: what the script knows from the start, as properties of `lpn`.
        styles: html of styles that must hold in every panel, whichever are folded.
    """

    def __init__(
        self, gui: viser.GuiApi, handlers: dict[str, Callable[[Any], None]], told: Mapping[str, object], styles: str
    ) -> None:
        self._handlers = handlers
        self._text = gui.add_text("page", "")
        self._text.on_update(lambda _: self.receive(self._text.value))
        uuid = str(self._text._impl.uuid)
        hide = f'div:has(>div>p>label[for="{uuid}"]){{display:none!important}}'
        known = json.dumps({**told, "bridge": uuid})
        run = f"{_SCRIPT};Object.assign(lpn,{known});{_call('head', styles)};lpn.greet()"
        gui.add_html(f"<style>{hide}</style>{_running(run)}")
        self._address, self._order = Html(gui), Html(gui)
        self._orders = 0

    def address(self, query: str, keys: Sequence[str]) -> None:
        """Put a query (without "?") into the page's address, in place of what it had of these keys."""
        self._address.show(_running(_call("address", query, keys)))

    def order(self, function: str, *arguments: object) -> None:
        """Call a function of the page's script, once; the last of several that come at once may be the only one."""
        self._orders += 1
        self._order.show(_running(f"{_call(function, *arguments)};/*{self._orders}*/"))

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


def _call(function: str, *arguments: object) -> str:
    return f"lpn.{function}({','.join(json.dumps(argument) for argument in arguments)})"


def _running(script: str) -> str:
    """Html that runs a script: an image's onload is the one way in, for scripts in html put into a page do not run.

    As a function's body it sees the page's names, not those of image and document (`URL` is one) first.
    """
    body = escape(f"Function({json.dumps(script)})()")
    return f"<img src='{_PIXEL}' style='display:none' alt='' onload=\"{body}\">"


def send(kind: str, value: object = None) -> str:
    """The attribute that sends a message when its element is clicked."""
    return f'{PRESSED} onclick="{escape(f"lpn.send({json.dumps(kind)},{json.dumps(value)})")}"'
