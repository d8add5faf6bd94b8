"""The gateway: authenticates requests and filters messages before viser sees them.

viser 1.1.1 passes its page, its websocket handler, and its limits to `websockets.asyncio.server.serve` and has no hook for
checks. `Gateway.protect` substitutes a `serve` that adds them. If viser does not call that `serve`, its server
is stopped.
"""

from __future__ import annotations

import asyncio
import functools
import itertools
import logging
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed
from websockets.frames import CTRL_OPCODES, Frame
from websockets.http11 import Request as WebsocketRequest
from websockets.http11 import Response
from websockets.protocol import CONNECTING, Event

from explorer.server import viser_compat
from explorer.server.auth import Authenticator, HttpRequest, Redirect, Refusal
from explorer.server.auth_pages import redirect_page, refusal_page
from explorer.server.message_filter import FIELDS, MAX_MESSAGE, MessageFilter, RejectedMessageError
from explorer.server.picture_route import PictureRoute
from explorer.server.rate_limiter import RateLimiter, TokenBucket
from lpn.core.errors import MissingPackageError

log = logging.getLogger(__name__)

Handler = Callable[[ServerConnection], Awaitable[None]]
PageServer = Callable[[ServerConnection, WebsocketRequest], Response | None]

# Bounds on connections without an answer yet, from one address and in total; each times out after 10 s.
MAX_PENDING, MAX_ALL_PENDING = 64, 256
# Limits on control frames and small message fragments: tokens per second, and the size of the token bucket.
# A browser sends hardly any.
SMALL_FRAME_RATE, SMALL_FRAME_BURST = 20.0, 400.0
SMALL_FRAME = 1024  # bytes

_WEB_LOG = logging.getLogger(f"{__name__}.web")
_WEB_LOG.setLevel(logging.WARNING)  # at debug level, websockets logs requests, and thus tokens
# websockets logs a traceback for each malformed request.
_WEB_LOG.addFilter(lambda record: record.getMessage() != "opening handshake failed")
_TOO_MANY = "Too many wrong tokens came from your address. Wait some seconds."
_BLOCKED = Refusal(429, "Too many wrong tokens", _TOO_MANY, ask_token=True)
_SERVER_START = "the way it starts its server"
_MALFORMED = Refusal(400, "Malformed request", "The request is not for an address of this server.")


class Gateway:
    """Protects one viser server.

    Args:
        authenticator: decides which requests are let in.
        pictures: answers requests for pictures; None refuses them like any other unknown address.

    Raises:
        MissingPackageError: when viser's private API is not that of the supported version.
    """

    def __init__(self, authenticator: Authenticator, pictures: PictureRoute | None = None) -> None:
        self.authenticator, self._pictures = authenticator, pictures
        self._rate_limiter = RateLimiter()
        self._server: viser.ViserServer | None = None
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
        self._server = server
        return server

    def _serve(self, handler: Handler, *where: Any, **settings: Any) -> Any:
        """Replace `websockets.asyncio.server.serve`. It must not raise: viser would wait for ever."""
        self._protecting = True
        page = settings.pop("process_request", None)  # viser always passes one; without it every request fails
        return websockets.asyncio.server.serve(
            functools.partial(_handle, handler, itertools.count()),
            *where,
            process_request=functools.partial(self._respond, page),
            **settings
            | {
                "max_size": MAX_MESSAGE,
                "create_connection": functools.partial(_Connection, self._is_upload_button),
                "server_header": None,
                "logger": _WEB_LOG,
            },
        )

    def _is_upload_button(self, uuid: str) -> bool:
        return self._server is not None and viser_compat.is_upload_button(self._server, uuid)

    def _respond(
        self, page: PageServer, connection: ServerConnection, request: WebsocketRequest
    ) -> Response | Awaitable[Response] | None:
        """Return the response to a request, at once or later, or None if it may open a websocket."""
        try:
            return self._authenticate_and_respond(page, connection, request)
        except Exception as error:  # for example a path that the file system rejects, or a repeated header
            log.info("Refused a request: %s", _summary(error))
            return refusal_page(_MALFORMED)

    def _authenticate_and_respond(
        self, page: PageServer, connection: ServerConnection, raw: WebsocketRequest
    ) -> Response | Awaitable[Response] | None:
        port = int(connection.local_address[1])
        request = _http_request(connection, raw)
        if self.authenticator.has_token(request) and self._rate_limiter.blocked(request.address):
            return refusal_page(_BLOCKED)
        verdict = self.authenticator.check(request, port)
        if isinstance(verdict, Redirect):
            return redirect_page(verdict, self.authenticator.cookie(request, port))
        if verdict is not None:
            log.debug("Refused %s, %d: %s", request.address, verdict.status, verdict.title)
            if verdict.wrong_token:
                log.warning("A wrong token came from %s", request.address)
                self._rate_limiter.wrong_token(request.address)
            return refusal_page(verdict)
        if self._pictures is not None and self._pictures.serves(raw.path) and not request.upgrade:
            return self._picture(self._pictures, raw.path, request)
        response = page(connection, raw)
        return None if response is None else _add_security_headers(response, request.only("host"))

    async def _picture(self, pictures: PictureRoute, path: str, request: HttpRequest) -> Response:
        return _add_security_headers(await pictures.respond(path, request.address), request.only("host"))


class _Connection(ServerConnection):
    """A browser's connection, from which viser receives only filtered messages."""

    def __init__(self, is_upload_button: Callable[[str], bool], *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self.filter = MessageFilter(is_upload_button)
        self._small_frames = TokenBucket(SMALL_FRAME_RATE, SMALL_FRAME_BURST)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Abort the connection if too many are pending; otherwise the process could run out of file descriptors."""
        super().connection_made(transport)
        pending = [_address(one) for one in self.server.handlers if one.state is CONNECTING]
        if len(pending) > MAX_ALL_PENDING or pending.count(_address(self)) > MAX_PENDING:
            self.transport.abort()

    def process_event(self, event: Event) -> None:
        """Abort a connection that floods the server with control frames or small fragments: `recv` delays only whole messages."""
        if _is_small(event) and self._small_frames.take() > 0:
            self.transport.abort()
        else:
            super().process_event(event)

    async def recv(self, decode: bool | None = None) -> Any:
        """Return the next message that passes the filter, as bytes."""
        while True:
            raw = await super().recv(decode)
            if seconds := self.filter.delay():
                await asyncio.sleep(seconds)
            if (message := self.filter.read(raw)) is not None:
                return message


async def _handle(handler: Handler, numbers: Iterator[int], connection: ServerConnection) -> None:
    """Run viser's handler; an error closes this connection only and is logged in one line."""
    asyncio.get_running_loop().set_exception_handler(_log_failed_task)
    number = next(numbers)  # viser counts browsers in the same way
    if isinstance(connection, _Connection):
        connection.filter.number = number
    try:
        await handler(connection)
    except RejectedMessageError as error:
        log.info("Browser %d sent %s; closed its connection", number, error)
        await connection.close(1007, "not a message")
    except ConnectionClosed:
        pass
    except Exception as error:
        log.info("Browser %d: closed its connection: %s", number, _summary(error))
        await connection.close(1011)


def _is_small(event: Event) -> bool:
    return isinstance(event, Frame) and (
        event.opcode in CTRL_OPCODES or (not event.fin and len(event.data) < SMALL_FRAME)
    )


def _log_failed_task(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log the error of a failed task in one line: viser's task for a message fails when a control rejects the value."""
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
    # viser opens a websocket for exactly this value, and answers every other request with its page.
    upgrade = headers.get("upgrade") == ["websocket"]
    return HttpRequest(request.path, headers, upgrade, _address(connection))


def _address(connection: ServerConnection) -> str:
    remote = connection.remote_address
    return str(remote[0]) if isinstance(remote, tuple) else ""


def _add_security_headers(response: Response, host: str) -> Response:
    """Add security headers to a response.

    The page may load resources only from its own server. Other sites may not embed the page.
    """
    own = f"'self' ws://{host} wss://{host}"  # some browsers do not apply 'self' to websockets
    response.headers["Content-Security-Policy"] = (
        "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; style-src 'self' 'unsafe-inline'; "
        f"img-src 'self' data: blob:; font-src 'self' data:; connect-src {own} data: blob:; worker-src 'self' blob: data:; "
        "object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'self'"
    )
    response.headers["X-Content-Type-Options"] = "nosniff"
    response.headers["Referrer-Policy"] = "no-referrer"
    return response


def _unsupported(what: str) -> MissingPackageError:
    return MissingPackageError(
        f"viser {viser.__version__} differs from 1.1.1 in {what}, so its page cannot be protected; install viser==1.1.1."
    )
