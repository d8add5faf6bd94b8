"""Call the page's script from Python, and receive the messages that the page sends back; none of them is trusted."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import viser

from explorer.server.message_filter import MAX_TEXT
from explorer.server.viser_compat import uuid_of
from explorer.web.html import Html
from explorer.web.render import call, render, run

log = logging.getLogger(__name__)

_SCRIPT = ";".join(
    (Path(__file__).parent / "js" / name).read_text("utf-8")
    for name in (
        "page.js",
        "viewport.js",
        "tour.js",
        "tiles.js",
        "pens.js",
        "homography.js",
        "timeline.js",
        "flight.js",
        "url_state.js",
    )
)


class PageBridge:
    """Installs the script in one page, and hands the page's messages to their handlers.

    Args:
        handlers: a function for each kind of message; its argument may be any JSON value.
        properties: initial properties of the script's object `lpn`.
        styles: a style element for the head of the page, so that it applies whichever panels are folded.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        handlers: dict[str, Callable[[Any], None]],
        properties: Mapping[str, object],
        styles: str,
    ) -> None:
        self._handlers = handlers
        self._text = gui.add_text("page", "")
        self._text.on_update(lambda _: self.receive(self._text.value))
        uuid = uuid_of(self._text)
        initial = json.dumps({**properties, "bridge": uuid})
        script = f"{_SCRIPT};Object.assign(lpn,{initial});{call('head', styles)};lpn.greet()"
        gui.add_html(render("hide_bridge", uuid=uuid) + run(script))
        self._address, self._call = Html(gui), Html(gui)
        self._calls = 0

    def set_address(self, query: str, keys: Sequence[str]) -> None:
        """Replace the values of `keys` in the page's address by a query string without "?"."""
        self._address.show(run(call("address", query, keys)))

    def call(self, function: str, *arguments: object) -> None:
        """Call a function of the page's script. The page may run only the last of several quick calls."""
        self._calls += 1
        self._call.show(run(f"{call(function, *arguments)};/*{self._calls}*/"))

    def receive(self, message: Any) -> None:
        """Hand a message to its handler; drop anything else."""
        if not isinstance(message, str) or len(message) > MAX_TEXT:
            return
        try:
            content: Any = json.loads(message)
            handler = self._handlers[content["kind"]]
            value = content.get("value")
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            log.debug("Dropped a message of %d characters", len(message))
            return
        handler(value)
