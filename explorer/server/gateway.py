"""The gateway: authenticates requests and filters messages before viser sees them.

viser 1.1.1 passes its page, its websocket handler, and its limits to `websockets.asyncio.server.serve` and has no hook for
checks. `Gateway.protect` substitutes a `serve` that adds them. If viser does not call that `serve`, its server
is stopped.
"""

from __future__ import annotations

import asyncio
import functools
import logging
import mimetypes
from collections.abc import Awaitable, Callable, Generator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any, Final

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.frames import CTRL_OPCODES, Frame
from websockets.http11 import Request as WebsocketRequest
from websockets.http11 import Response
from websockets.protocol import CONNECTING, Event
from websockets.streams import StreamReader
from websockets.typing import Subprotocol

from explorer.server import viser_compat
from explorer.server.auth import Authenticator, HttpRequest, Redirect, Refusal
from explorer.server.auth_pages import redirect_page, refusal_page
from explorer.server.connection_check import ConnectionCheck, is_websocket
from explorer.server.message_filter import BURST, FIELDS, MAX_MESSAGE, RATE, RejectedMessageError, filtered
from explorer.server.picture_route import PREFIX, PictureRoute
from explorer.server.rate_limiter import RateLimiter, TokenBucket
from lpn.core.errors import MissingPackageError

log = logging.getLogger(__name__)

Handler = Callable[[ServerConnection], Awaitable[None]]
PageServer = Callable[[ServerConnection, WebsocketRequest], Response | None]

# Bounds on connections without an answer yet, from one address and in total; each times out after 10 s.
MAX_PENDING, MAX_ALL_PENDING = 64, 256
# Maximum of characters of an address, which contains a page's state, and of bytes of a request. The limit of websockets is 8,192
# bytes a line. Longer lines, such as the cookies of a proxy with a login, would close the connection without an answer.
MAX_ADDRESS, MAX_REQUEST_HEAD = 20_000, 1 << 16
# Limits on control frames and small message fragments: tokens per second, and the size of the token bucket.
# A browser sends hardly any.
SMALL_FRAME_RATE, SMALL_FRAME_BURST = 20.0, 400.0
SMALL_FRAME = 1024  # bytes
# Seconds that a browser may take to read one message: a city of 3 MB at 25 kB/s.
READ_TIMEOUT = 120.0

# Beginnings of connections that are no requests, each with the terminal's message.
_FOREIGN = {
    b"\x16\x03": "Something speaks TLS to this port, as for https://; it answers http:// only, so let a proxy add the TLS.",
    b"PROXY ": "A proxy sends the PROXY protocol, which is not read here; switch it off (HAProxy: no send-proxy).",
    b"\r\n\r\n\0\r\nQUIT\n": "A proxy sends the PROXY protocol, which is not read here; switch it off (HAProxy: no send-proxy).",
    b"PRI * HTTP/2.0": "A proxy speaks HTTP/2 to this port; set it to HTTP/1.1.",
}

_WEB_LOG = logging.getLogger(f"{__name__}.web")
_WEB_LOG.setLevel(logging.WARNING)  # at debug level, websockets logs requests, and thus tokens
# websockets logs a traceback for each malformed request.
_WEB_LOG.addFilter(lambda record: record.getMessage() != "opening handshake failed")
# websockets raises AssertionError when a page aborts its request, as pages do while the user scrolls.
_WEB_LOG.addFilter(lambda record: record.exc_info is None or not isinstance(record.exc_info[1], AssertionError))
_TOO_MANY = "Too many wrong tokens came from your address. Wait some seconds."
_BLOCKED = Refusal(429, "Too many wrong tokens", _TOO_MANY, ask_token=True)
_SERVER_START = "the way it starts its server"
_LONG = Refusal(
    414,
    "The address is too long",
    f"An address has up to {MAX_ADDRESS:,} characters. Leave out the part after the question mark.",
)
_MALFORMED = Refusal(400, "Malformed request", "The request is not for an address of this server.")
_CHANGED = "The proxy does not pass websockets on"
_NO_UPGRADE = Refusal(
    426,
    _CHANGED,
    "The websocket of this page arrived as a plain request, without the header Upgrade. The proxy must pass it.",
)
_NO_PROTOCOL = Refusal(
    400,
    _CHANGED,
    "The websocket of this page arrived without the header Sec-WebSocket-Protocol. The proxy must pass it.",
)


# Script sources that viser's page needs.
_VISER_SCRIPTS = "'self' 'unsafe-inline' 'unsafe-eval' blob:"
# The subprotocol of the screen's channel, whose messages are JSON.
CHANNEL: Final = "lpn-json"
# The tab whose scene a websocket serves; set in the tasks that viser runs for this websocket.
SCENE_TAB: ContextVar[str] = ContextVar("scene_tab")


@dataclass(frozen=True)
class Screen:
    """The served page, with viser's page in a frame.

    Attributes:
        respond: returns the page or one of its files, as gzip if the browser accepts it; None for other addresses.
        scene_of: returns the tab of a scene's path, or None.
        serve: serves the channel of a tab.
    """

    respond: Callable[[HttpRequest, bool], Response | None]
    scene_of: Callable[[str], str | None]
    serve: Callable[[str, ServerConnection], Awaitable[None]]


class Gateway:
    """Protects one viser server.

    Args:
        authenticator: decides which requests are let in.
        screen: the page.
        pictures: answers requests for pictures.
        embedders: CSP sources of the pages that may show the page in a frame, beside pages of this server.

    Raises:
        MissingPackageError: when viser's private API differs from the supported version.
    """

    def __init__(
        self,
        authenticator: Authenticator,
        screen: Screen,
        pictures: PictureRoute,
        embedders: Sequence[str] = (),
    ) -> None:
        self.authenticator, self._screen = authenticator, screen
        self._pictures, self._embedders = pictures, tuple(embedders)
        self._rate_limiter = RateLimiter()
        self._check = ConnectionCheck()
        self._protecting = False
        if changed := [kind for kind, fields in FIELDS.items() if viser_compat.message_fields(kind) != fields]:
            raise _unsupported(", ".join(changed))
        if not viser_compat.has_websocket_server_hook():
            raise _unsupported(_SERVER_START)

    def protect(self, make_server: Callable[[], viser.ViserServer]) -> viser.ViserServer:
        """Return the server made by `make_server`, behind this gateway.

        Raises:
            MissingPackageError: when viser did not use the gateway; the server is stopped.
        """
        with viser_compat.websocket_server_hook(self._serve):
            server = make_server()
        if not self._protecting:
            server.stop()
            raise _unsupported(_SERVER_START)
        return server

    def _serve(self, handler: Handler, *where: Any, **settings: Any) -> Any:
        """Replace `websockets.asyncio.server.serve`. It must not raise: viser would wait for ever."""
        self._protecting = True
        page = settings.pop("process_request", None)  # viser always passes one; without it every request fails
        select = settings.pop("select_subprotocol", None)
        return websockets.asyncio.server.serve(
            functools.partial(self._handle, handler),
            *where,
            process_request=functools.partial(self._respond, page),
            select_subprotocol=functools.partial(self._select_subprotocol, select),
            process_response=_finish,
            **settings
            | {
                "max_size": MAX_MESSAGE,
                "create_connection": functools.partial(_Connection, self._check),
                "server_header": None,
                "logger": _WEB_LOG,
            },
        )

    def _respond(
        self, page: PageServer, connection: ServerConnection, request: WebsocketRequest
    ) -> Response | Awaitable[Response] | None:
        """Return the response to a request, at once or later; None lets it open a websocket."""
        try:
            return self._authenticate_and_respond(page, connection, request)
        except Exception as error:  # for example a path that the file system rejects, or a repeated header
            log.info("Refused a request: %s", _summary(error))
            return refusal_page(_MALFORMED)

    def _authenticate_and_respond(
        self, page: PageServer, connection: ServerConnection, raw: WebsocketRequest
    ) -> Response | Awaitable[Response] | None:
        if _method(connection) == b"OPTIONS":  # a proxy asks whether the server is up, without a name or a token
            return Response(HTTPStatus.NO_CONTENT, "No Content", Headers({"Allow": "GET, HEAD, OPTIONS"}))
        if len(raw.path) > MAX_ADDRESS:
            return refusal_page(_LONG)
        port = int(connection.local_address[1])
        request = _http_request(connection, raw)
        if self.authenticator.has_token(request) and self._rate_limiter.blocked(request.address):
            return refusal_page(_BLOCKED)
        verdict = self.authenticator.check(request, port)
        if is_websocket(request):
            self._check.note(request)
        if isinstance(verdict, Redirect):
            return redirect_page(verdict, self.authenticator.cookie(request, port))
        if verdict is not None:
            log.debug("Refused %s, %d: %s", request.address, verdict.status, verdict.title)
            if verdict.status == HTTPStatus.MISDIRECTED_REQUEST:
                self._check.note_name(request)
            if verdict.wrong_token:
                log.warning("A wrong token came from %s", request.address)
                self._rate_limiter.wrong_token(request.address)
            return refusal_page(verdict)
        # viser would take "Upgrade: WebSocket", Apache's spelling, for a request of its page.
        if request.upgrade:
            # A program that checks the server sends neither header; a browser sends both.
            dropped = request.only("origin") and not request.headers.get("sec-websocket-protocol")
            return refusal_page(_NO_PROTOCOL) if dropped else None
        if is_websocket(request):
            return refusal_page(_NO_UPGRADE)
        if (start := raw.path.partition("?")[0].rfind(PREFIX)) >= 0:  # a proxy may leave a folder in front
            return self._picture(raw.path[start:], request)
        raw.headers.get("Upgrade")  # raises for a repeated header, as viser does
        own = self._screen.respond(request, "gzip" in raw.headers.get("Accept-Encoding", ""))
        if own is not None:
            return self._secured(own, request, "'self'")
        if self._screen.scene_of(raw.path.partition("?")[0]) is not None:
            of_viser = page(connection, WebsocketRequest("/", raw.headers))
            return refusal_page(_MALFORMED) if of_viser is None else self._secured(of_viser, request)
        if (folder := _folder(request)) is not None:
            return redirect_page(Redirect(folder, sign_in=False), "")
        return self._secured(Response(404, "Not Found", Headers({"Content-Length": "0"}), b""), request)

    async def _picture(self, path: str, request: HttpRequest) -> Response:
        return self._secured(await self._pictures.respond(path, request.address), request)

    def _secured(self, response: Response, request: HttpRequest, scripts: str = _VISER_SCRIPTS) -> Response:
        """Let the page load resources only from its own server, and let only the embedders show it in a frame."""
        host, frames = request.only("host"), " ".join(("'self'", *self._embedders))
        own = f"'self' ws://{host} wss://{host}"  # some browsers do not apply 'self' to websockets
        response.headers["Content-Security-Policy"] = (
            f"default-src 'self'; script-src {scripts}; style-src 'self' 'unsafe-inline'; "
            f"img-src 'self' data: blob:; font-src 'self' data:; connect-src {own} data: blob:; worker-src 'self' blob: data:; "
            f"object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors {frames}"
        )
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Referrer-Policy"] = "no-referrer"
        return response

    async def _handle(self, handler: Handler, connection: ServerConnection) -> None:
        """Run the screen's handler or, for a tab's scene, viser's. An error is logged, and closes this connection alone."""
        asyncio.get_running_loop().set_exception_handler(_log_failed_task)
        path = "" if connection.request is None else connection.request.path.partition("?")[0]
        of_channel = connection.subprotocol == CHANNEL
        tab = self._screen.scene_of(path.replace("/api/", "/scene/") if of_channel else path)
        if tab is None:
            await connection.close(1008, "no tab")
            return
        if of_channel:
            await self._screen.serve(tab, connection)
            return
        SCENE_TAB.set(tab)
        try:
            await handler(connection)
        except RejectedMessageError as error:
            log.info("A scene's page sent %s; closed its connection", error)
            await connection.close(1007, "not a message")
        except ConnectionClosed:
            pass
        except Exception as error:
            log.info("A scene's page: closed its connection: %s", _summary(error))
            await connection.close(1011)

    def _select_subprotocol(
        self,
        select: Callable[[ServerConnection, Sequence[Subprotocol]], Subprotocol | None] | None,
        connection: ServerConnection,
        offered: Sequence[Subprotocol],
    ) -> Subprotocol | None:
        if CHANNEL in offered:
            return Subprotocol(CHANNEL)
        return None if select is None else select(connection, offered)


class _RequestReader(StreamReader):
    """Reads the lines of a request, which may exceed websockets' limits because of a page's state or many cookies.

    websockets reads GET and HTTP/1.1 only. A proxy may use HTTP/1.0, as nginx does by default, and programs that watch a server
    use HEAD or OPTIONS. All are read as GET and HTTP/1.1.

    Attributes:
        method: the method that the client sent.
    """

    method = b"GET"
    _remaining = MAX_REQUEST_HEAD

    def read_line(self, m: int) -> Generator[None, None, bytearray]:  # noqa: ARG002
        """Read a line, whatever `m` is; all lines together have `MAX_REQUEST_HEAD` bytes at most. Errors as in the base class."""
        first = self._remaining == MAX_REQUEST_HEAD
        line = yield from super().read_line(self._remaining)
        self._remaining -= len(line)
        if not first:
            return line
        if line.startswith((b"HEAD ", b"OPTIONS ")):
            self.method, _, rest = bytes(line).partition(b" ")
            line = bytearray(b"GET " + rest)
        if line.endswith(b" HTTP/1.0\r\n"):
            line[-3:-2] = b"1"
        return line


class _Connection(ServerConnection):
    """A browser's connection, from which viser receives only filtered messages."""

    def __init__(self, check: ConnectionCheck, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self._check, self._begun = check, False
        # The base class has started a parser on its own reader, so a new parser is started here.
        self.reader = self.protocol.reader = _RequestReader()
        self.protocol.parser = self.protocol.parse()
        next(self.protocol.parser)
        self._messages = TokenBucket(RATE, BURST)
        self._small_frames = TokenBucket(SMALL_FRAME_RATE, SMALL_FRAME_BURST)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Abort the oldest connection without a request if too many are pending, so that file descriptors suffice.

        So a client with half-open connections keeps nobody else out.
        """
        super().connection_made(transport)
        pending = [one for one in self.server.handlers if one.state is CONNECTING and not one.transport.is_closing()]
        own = [one for one in pending if _address(one) == _address(self)]
        excess = own if len(own) > MAX_PENDING else pending if len(pending) > MAX_ALL_PENDING else []
        if excess:
            next(one for one in excess if one.request is None).transport.abort()

    def data_received(self, data: bytes) -> None:
        """Log a connection that does not begin with a request; a proxy would report only its end."""
        if not self._begun:
            self._begun = True
            for start, sentence in _FOREIGN.items():
                if data.startswith(start):
                    self._check.log_once(sentence)
        super().data_received(data)

    def process_event(self, event: Event) -> None:
        """Abort a connection that floods the server with control frames or small fragments; `recv` delays whole messages only."""
        if _is_small(event) and self._small_frames.take() > 0:
            self.transport.abort()
        else:
            super().process_event(event)

    async def drain(self) -> None:
        """Wait for the browser to read; on a timeout websockets aborts the connection. Without one, the wait may never end."""
        async with asyncio.timeout(READ_TIMEOUT):
            await super().drain()

    async def recv(self, decode: bool | None = None) -> Any:
        """Return the next message of the screen's channel, or as bytes the next message of viser that passes the filter."""
        while True:
            raw = await super().recv(decode)
            if seconds := self._messages.take():
                await asyncio.sleep(seconds)
            if self.subprotocol == CHANNEL:  # the screen reads its own messages
                return raw
            if (message := filtered(raw)) is not None:
                return message


def _is_small(event: Event) -> bool:
    return isinstance(event, Frame) and (
        event.opcode in CTRL_OPCODES or (not event.fin and len(event.data) < SMALL_FRAME)
    )


def _log_failed_task(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log a failed task's error in one line: viser's task for a message fails when a control rejects the value."""
    error = context.get("exception")
    if isinstance(error, Exception):
        log.debug("A message failed: %s", _summary(error))
    else:
        loop.default_exception_handler(context)


def _summary(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error)[:200]!r}"


def _http_request(connection: ServerConnection, request: WebsocketRequest) -> HttpRequest:
    headers: dict[str, list[str]] = {}
    for name, value in request.headers.raw_items():
        headers.setdefault(name.lower(), []).append(value)
    upgrade = [value.strip().lower() for value in headers.get("upgrade", ())] == ["websocket"]
    return HttpRequest(request.path, headers, upgrade, _address(connection))


def _address(connection: ServerConnection) -> str:
    remote = connection.remote_address
    return str(remote[0]) if isinstance(remote, tuple) else ""


def _folder(request: HttpRequest) -> str | None:
    """Return the relative folder of a page that was requested without its last slash; None for other files."""
    place, mark, query = request.path.partition("?")
    name = place.rpartition("/")[2]
    page = "text/html" in request.only("accept") and request.only("sec-fetch-mode") in ("", "navigate")
    is_file = mimetypes.guess_type(name)[0] is not None
    return f"./{name}/{mark}{query}" if page and name and not is_file else None


def _method(connection: ServerConnection) -> bytes:
    return connection.reader.method if isinstance(connection, _Connection) else b"GET"


def _finish(connection: ServerConnection, _: WebsocketRequest, response: Response) -> None:
    """Close the connection after a page, and leave its body out for HEAD."""
    if response.status_code == HTTPStatus.SWITCHING_PROTOCOLS:
        return
    if "Connection" not in response.headers:
        response.headers["Connection"] = "close"
    if _method(connection) == b"HEAD":
        response.body = b""


def _unsupported(what: str) -> MissingPackageError:
    return MissingPackageError(
        f"viser {viser.__version__} differs from 1.1.1 in {what}, so its page cannot be protected; install viser==1.1.1."
    )
