"""Report on the terminal why a page cannot connect: a proxy changes its websocket, or the server's name is unknown."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

from explorer.server.auth import HttpRequest, same_origin
from explorer.server.rate_limiter import TokenBucket
from lpn.core.files import printable

log = logging.getLogger(__name__)

# Limits of the log: eight lines in a row, then a line every 20 seconds; and the number of remembered sentences.
_LOG_RATE, _LOG_BURST, _MAX_LOGGED = 0.05, 8.0, 1000
_MAX_NAME = 100  # characters of an address in a message


@dataclass
class ConnectionCheck:
    """Logs each fault once. Not thread-safe."""

    _logged: set[str] = field(default_factory=set, init=False)
    _lines: TokenBucket = field(default_factory=lambda: TokenBucket(_LOG_RATE, _LOG_BURST), init=False)

    def note(self, request: HttpRequest) -> None:
        """Log the fault of a browser's websocket request, with or without its header Upgrade."""
        origin, protocol = request.only("origin"), request.headers.get("sec-websocket-protocol", [])
        if not origin:  # a browser sends one, a port scanner does not
            return
        saw = []
        if origin == "null":
            saw.append("from a frame that hides its address")
        elif not same_origin(origin, host := request.only("host")):
            saw.append(f"for {printable(host)[:_MAX_NAME]}, which is another web site")
        if not request.upgrade:
            saw.append("without the header Upgrade")
        if not protocol:
            saw.append("without the header Sec-WebSocket-Protocol")
        if saw:
            self.log_once(
                f"A page at {printable(origin)[:_MAX_NAME]} cannot connect: its websocket arrived {', and '.join(saw)}. If the "
                "page is yours, its proxy must pass Host as the browser sent it, and websockets. See docs/serving.md."
            )

    def note_name(self, request: HttpRequest) -> None:
        """Log that a page was requested by an unknown name of the server."""
        name = printable(request.only("host"))[:_MAX_NAME] or "no name"
        if "text/html" in request.only("accept"):  # a browser, not a port scanner
            self.log_once(
                f"A page was asked for by the name {name} and refused: if its address has that name, start the server with "
                "--allow-host; else its proxy must pass Host as the browser sent it (nginx: proxy_set_header Host $http_host;)."
            )

    def log_once(self, sentence: str) -> None:
        """Log a sentence, unless it was logged before, or too many sentences were logged lately."""
        if sentence in self._logged or self._lines.level() < 1:
            return
        self._lines.take()
        if len(self._logged) >= _MAX_LOGGED:
            self._logged.clear()
        self._logged.add(sentence)
        log.warning("%s", sentence)


def is_websocket(request: HttpRequest) -> bool:
    """Return whether a request is a websocket, or was one before a proxy dropped its header Upgrade."""
    return request.upgrade or bool(request.only("sec-websocket-key"))
