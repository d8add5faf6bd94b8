"""Tell a page, and the terminal, why no websocket opens: a proxy in between that changes, drops, or answers it.

A browser hides from a page why its websocket failed. The page therefore opens websockets of its own whose addresses name a
number, `?check=NUMBER`. The gateway notes what arrives of each, and answers the page's question at `PATH` with the reason and
the missing lines of the proxy's configuration. The answer is readable for pages of the same origin only, as is any other.
"""

from __future__ import annotations

import json
import logging
import re
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from http import HTTPStatus
from typing import Final
from urllib.parse import parse_qsl

from websockets.datastructures import Headers
from websockets.http11 import Response

from explorer.server.auth import HttpRequest, Refusal, same_origin
from explorer.server.rate_limiter import TokenBucket
from lpn.core.files import printable

log = logging.getLogger(__name__)

# The path that answers, and the subprotocol of the page's own websockets. `templates/connection.js` names both, too.
PATH: Final = "/connection"
PROTOCOL: Final = "lpn-check"
# The message that each of these websockets is sent.
GREETING: Final = "open"
# Websockets that are remembered; the oldest are forgotten.
_MAX_CHECKS = 1000
# Lines in the log: each reason once for each pair of addresses, eight at once, and then one every 20 seconds.
_LOG_RATE, _LOG_BURST, _MAX_LOGGED = 0.05, 8.0, 1000
_MAX_NAME = 100  # characters of an address in a message
_MAX_REPORTED = 4  # addresses that a page tries
_NUMBER = re.compile(r"[0-9a-f]{16}")
_STATUS = re.compile(r"[1-5][0-9]{2}")

_NGINX, _APACHE, _OTHER = "nginx", "Apache", "other proxies"
# Names by which servers of a kind call themselves in the header Server.
_SERVERS = {_NGINX: ("nginx", "openresty", "tengine", "angie"), _APACHE: ("apache",)}
_OTHERS = ("caddy", "cloudflare", "envoy", "traefik", "haproxy", "varnish", "tornado", "iis", "litespeed", "awselb")
_WEBSOCKET_LINES = {
    _NGINX: (
        "proxy_http_version 1.1;",
        "proxy_set_header Upgrade $http_upgrade;",
        'proxy_set_header Connection "upgrade";',
    ),
    _APACHE: ("ProxyPass {folder} http://{server}/ upgrade=websocket",),
    _OTHER: ("pass Upgrade, Connection, and all Sec-WebSocket headers on",),
}


@dataclass(frozen=True)
class ConnectionFault:
    """A reason for which no websocket opens; its texts have the names of `_Circumstances` in braces.

    Attributes:
        text: two or three sentences for the page.
        log: the rest of "A page at ... cannot connect: " for the terminal.
        lines: configuration that is missing, by the kind of proxy.
    """

    title: str
    text: str
    log: str
    lines: Mapping[str, Sequence[str]]


_NO_OTHER_SITE = "Another web site may not use this server"
_NOT_PASSED = "The websocket of this page does not arrive"
FAULTS: Final[Mapping[str, ConnectionFault]] = {
    "host": ConnectionFault(
        _NO_OTHER_SITE,
        "This page is at {page}, but the proxy asks LPN Explorer for {host}, so the page counts as another site's. The proxy "
        "must pass Host as the browser sent it, with its port.",
        "its requests come for {host}, and another web site may not use this server; if the page is yours, its proxy must pass "
        "Host as the browser sent it",
        {
            _NGINX: ("proxy_set_header Host $http_host;",),
            _APACHE: ("ProxyPreserveHost On",),
            _OTHER: ("pass Host on unchanged",),
        },
    ),
    "frame": ConnectionFault(
        _NO_OTHER_SITE,
        "This page is in a frame that hides its address, so it counts as another site's. Open it in a tab of its own.",
        "it is in a frame that hides its address, and another web site may not use this server; open it in a tab of its own",
        {},
    ),
    "upgrade": ConnectionFault(
        "The proxy does not pass websockets on",
        "The websocket of this page arrived as a plain request, without the header Upgrade. The proxy must pass it.",
        "its websocket arrived without the header Upgrade, which the proxy must pass",
        _WEBSOCKET_LINES,
    ),
    "protocol": ConnectionFault(
        "The proxy drops a header of the websocket",
        "The websocket of this page arrived without the header Sec-WebSocket-Protocol. The proxy must pass it.",
        "its websocket arrived without the header Sec-WebSocket-Protocol, which the proxy must pass",
        {_OTHER: ("pass all Sec-WebSocket headers on",)},
    ),
    "refused": ConnectionFault(
        "The websocket of this page is refused",
        "It arrived without the cookie that lets this page in. Open the link that the server printed once more; if that does not "
        "help, let the proxy pass Cookie.",
        "its websocket arrived without the cookie of a signed-in browser, which the proxy must pass",
        {},
    ),
    "held": ConnectionFault(
        "The proxy holds the websocket back",
        "The websocket of this page arrived and was accepted, but what LPN Explorer sends through it does not come back. The "
        "proxy must pass websockets both ways, without collecting what they send.",
        "its websocket was accepted, but the proxy does not bring back what is sent through it",
        {**_WEBSOCKET_LINES, _NGINX: (*_WEBSOCKET_LINES[_NGINX], "proxy_buffering off;")},
    ),
    "redirect": ConnectionFault(
        _NOT_PASSED,
        "The proxy answers {address} with a redirect, and a websocket follows none. The folder needs its slash in the proxy's "
        "configuration, or the redirect an exception for websockets.",
        "its websocket did not arrive, as the proxy answers {address} with a redirect, and a websocket follows none",
        {
            _NGINX: ("location {folder} { proxy_pass http://{server}/; ... }", *_WEBSOCKET_LINES[_NGINX]),
            _APACHE: _WEBSOCKET_LINES[_APACHE],
            _OTHER: ("send {folder} to LPN Explorer, its websockets too",),
        },
    ),
    "status": ConnectionFault(
        _NOT_PASSED,
        "The proxy itself answers {address}, with {status}. It must send all below {folder} to LPN Explorer, the websocket too.",
        "its websocket did not arrive, as the proxy itself answers {address}, with {status}",
        _WEBSOCKET_LINES,
    ),
    "closed": ConnectionFault(
        _NOT_PASSED,
        "Pages come through, but something between this browser and LPN Explorer refuses the websocket at {page}{address}: a "
        "proxy, a firewall, or a tunnel. It must pass websockets on.",
        "its websocket at {address} did not arrive; a proxy, a firewall, or a tunnel refuses it",
        _WEBSOCKET_LINES,
    ),
    "silent": ConnectionFault(
        _NOT_PASSED,
        "Pages come through, but something between this browser and LPN Explorer leaves the websocket at {page}{address} without "
        "an answer: a proxy, a firewall, or a tunnel. It must pass websockets on.",
        "its websocket at {address} did not arrive; a proxy, a firewall, or a tunnel leaves it without an answer",
        _WEBSOCKET_LINES,
    ),
}


@dataclass(frozen=True)
class _Circumstances:
    """The values in a fault's text and lines, all of them from outside."""

    page: str = ""
    host: str = ""
    server: str = ""
    address: str = ""
    folder: str = "/"
    status: str = ""

    def fill(self, text: str) -> str:
        values = asdict(self)
        return _FIELD.sub(lambda name: printable(values[name[1]])[:_MAX_NAME], text)


_FIELD = re.compile("{(" + "|".join(one.name for one in fields(_Circumstances)) + ")}")
# The origin of a page, as browsers write it.
_ORIGIN = re.compile(r"https?://[^\s/]{1,300}|null")


@dataclass(frozen=True)
class _Arrival:
    """The request of one of the page's own websockets, as it arrived."""

    host: str
    upgrade: bool
    protocol: bool
    refused: bool


@dataclass
class ConnectionCheck:
    """Remembers what arrived of the websockets that pages try, and logs each reason once. Not thread-safe."""

    _arrivals: OrderedDict[str, _Arrival] = field(default_factory=OrderedDict, init=False)
    _logged: set[tuple[str, str, str]] = field(default_factory=set, init=False)
    _lines: TokenBucket = field(default_factory=lambda: TokenBucket(_LOG_RATE, _LOG_BURST), init=False)

    def note(self, request: HttpRequest, server: str, refusal: Refusal | None) -> None:
        """Note a websocket that arrived, with or without its header Upgrade.

        A fault of viser's websocket is logged at once; one of the page's own only when the page asks, since another may be open.

        Args:
            server: address and port at which it arrived.
            refusal: why the rules of access refuse it; None if they let it in.
        """
        host, origin = request.only("host"), request.only("origin")
        arrival = _Arrival(
            host[:_MAX_NAME], request.upgrade, bool(request.headers.get("sec-websocket-protocol")), refusal is not None
        )
        if number := _check_number(request):
            self._arrivals[number] = arrival
            if len(self._arrivals) > _MAX_CHECKS:
                self._arrivals.popitem(last=False)
        elif origin:  # a browser's, not a port scanner's
            self._log(_faults(origin, host, arrival, "", ""), _Circumstances(origin, host, server))

    def note_name(self, request: HttpRequest) -> None:
        """Log that a page was asked for by a name that the server does not go by."""
        name = printable(request.only("host"))[:_MAX_NAME] or "no name"
        if "text/html" in request.only("accept"):  # a browser's, not a port scanner's
            sentence = (
                f"A page was asked for by the name {name} and refused: if its address has that name, start the server with "
                "--allow-host; else its proxy must pass Host as the browser sent it (nginx: proxy_set_header Host $http_host;)."
            )
            self._log_line(("name", "", name), sentence)

    def answer(self, request: HttpRequest, server: str) -> Response:
        """Return the faults that a page asks for, as JSON: title, texts, and the lines of each kind of proxy.

        Args:
            server: address and port at which the request arrived.
        """
        query = dict(parse_qsl(request.query))
        page, host = query.get("page", ""), request.only("host")
        numbers, answers, addresses = (
            query.get(name, "").split(" ")[:_MAX_REPORTED] for name in ("checks", "answers", "at")
        )
        arrival = next((self._arrivals[number] for number in numbers if number in self._arrivals), None)
        host = host if arrival is None else arrival.host
        at, answered = next(
            ((at, answer) for at, answer in zip(addresses, answers, strict=False) if answer != "200"),
            (addresses[0], ""),
        )
        faults = _faults(page, host, arrival, answered, query.get("saw") or "closed")
        values = _Circumstances(page, host, server, at, query.get("folder", "/"), answered)
        # Another site could have a browser ask, though not read the answer; what is no page names no origin.
        if request.only("sec-fetch-site") in ("", "same-origin") and _ORIGIN.fullmatch(page):
            self._log(faults, values)
        kinds = _kinds(query.get("proxy", ""))
        lines = {kind: [line for one in faults for line in FAULTS[one].lines.get(kind, ())] for kind in kinds}
        content = {
            "title": FAULTS[faults[0]].title,
            "texts": [values.fill(FAULTS[one].text) for one in faults],
            "lines": {kind: [values.fill(line) for line in some] for kind, some in lines.items() if some},
        }
        body = json.dumps(content).encode()
        headers = Headers(
            {"Content-Type": "application/json", "Content-Length": str(len(body)), "Cache-Control": "no-store"}
        )
        return Response(HTTPStatus.OK, HTTPStatus.OK.phrase, headers, body)

    def log_once(self, sentence: str) -> None:
        """Log a sentence, unless it or too many others were logged."""
        self._log_line((sentence, "", ""), sentence)

    def _log(self, faults: Sequence[str], values: _Circumstances) -> None:
        for one in faults:
            missing = " ".join(FAULTS[one].lines.get(_NGINX, ()))
            advice = f" (nginx: {missing})" if missing else ""
            sentence = values.fill("A page at {page} cannot connect: " + FAULTS[one].log + advice)
            self._log_line((one, values.page, values.host), f"{sentence}. See docs/serving.md.")

    def _log_line(self, key: tuple[str, str, str], sentence: str) -> None:
        if key in self._logged or self._lines.level() < 1:
            return
        self._lines.take()
        if len(self._logged) >= _MAX_LOGGED:
            self._logged.clear()
        self._logged.add(key)
        log.warning("%s", sentence)


def is_websocket(request: HttpRequest) -> bool:
    """Return whether a request is a websocket, or was one before a proxy dropped its header Upgrade."""
    return request.upgrade or bool(request.only("sec-websocket-key"))


def _check_number(request: HttpRequest) -> str:
    number = dict(parse_qsl(request.query)).get("check", "")
    return number if _NUMBER.fullmatch(number) else ""


def _faults(page: str, host: str, arrival: _Arrival | None, answered: str, saw: str) -> list[str]:
    """Return the keys of all that is wrong, the most important first.

    Args:
        page: the page's origin.
        host: the header Host of what arrived.
        arrival: what arrived of its websocket; None for nothing.
        answered: the proxy's answer to a plain request for the websocket's address.
        saw: how the websocket ended in the browser, closed, silent, or open; "" if unknown.
    """
    faults = [] if same_origin(page, host) else ["frame" if page == "null" else "host"]
    if arrival is not None and not arrival.upgrade:
        return [*faults, "upgrade"]
    if arrival is not None and not arrival.protocol:
        return [*faults, "protocol"]
    if faults or not saw:
        return faults
    if arrival is not None and arrival.refused:
        return ["refused"]
    if arrival is not None:
        return ["held"]
    if answered == "redirect" or _STATUS.fullmatch(answered):
        return ["redirect" if answered == "redirect" else "status"]
    return ["silent" if saw == "silent" else "closed"]


def _kinds(server: str) -> list[str]:
    """Return the kinds of proxies that a page is told of, by the header Server that it saw."""
    server = server.lower()
    known = [kind for kind, names in _SERVERS.items() if any(name in server for name in names)]
    return known or ([_OTHER] if any(name in server for name in _OTHERS) else [_NGINX, _APACHE, _OTHER])
