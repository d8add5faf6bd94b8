"""Stands in front of viser's page and websocket: nothing of a request or message reaches viser before it was looked at.

viser 1.1.1 hands its page, its websocket's handler, and its limits to `websockets.asyncio.server.serve`, and offers no place
for a check of its own. While it does so, `Gateway.before` gives it another `serve`, which puts the checks in front; viser's own
code is not changed, and where it does otherwise than expected nobody is let in.
"""

from __future__ import annotations

import asyncio
import functools
import inspect
import itertools
import logging
import threading
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import viser
import viser._messages as viser_messages
import viser.infra._infra as viser_infra
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed
from websockets.frames import CTRL_OPCODES, Frame
from websockets.http11 import Request as WebsocketRequest
from websockets.http11 import Response
from websockets.protocol import CONNECTING, Event

from explorer.server.auth import Authenticator, HttpRequest, Redirect, Refusal
from explorer.server.auth_pages import led_on, refused
from explorer.server.message_filter import MESSAGE_BYTES, MessageFilter, RejectedMessageError, TokenBucket, strange
from explorer.server.rate_limiter import RateLimiter
from lpn.core.errors import MissingPackageError

log = logging.getLogger(__name__)

Page = Callable[[ServerConnection, WebsocketRequest], Any]

HALF_OPEN, ALL_HALF_OPEN = 64, 256
"""Connections whose request is not answered yet, of one address and of all; each has 10 s for it."""
IDLE_RATE, IDLE_BURST = 20.0, 400.0
"""Frames that bring next to nothing (pings, small pieces of a message), a second and at once. A browser sends hardly any."""
SMALL = 1024
"""Bytes of a piece of a message below which it is such a frame."""

_MAKING = threading.Lock()
_WEB = logging.getLogger(f"{__name__}.web")
_WEB.setLevel(logging.WARNING)  # it would write requests, and so tokens, at debug
_WEB.addFilter(
    lambda record: record.getMessage() != "opening handshake failed"
)  # with a traceback, for whatever somebody sends
_BUSY = Refusal(
    429, "Too many wrong tokens", "Too many wrong tokens came from your address. Wait some seconds.", ask=True
)
_UNREADABLE = Refusal(400, "This cannot be answered", "What was asked for is no address of this server.")
_BROKEN = Refusal(503, "The server is not ready", "Its parts do not fit together; its log says more.")


class Gateway:
    """The guard of one server.

    Args:
        entry: the rules.

    Raises:
        MissingPackageError: when viser is not one that the guard knows.
    """

    def __init__(self, entry: Authenticator) -> None:
        self.entry = entry
        self._turnstile = RateLimiter()
        self._served = False
        if found := strange(viser_messages):
            raise _unknown(", ".join(found))
        if not hasattr(viser_infra, "websockets"):
            raise _unknown("the way it starts its server")

    def before(self, make: Callable[[], viser.ViserServer]) -> viser.ViserServer:
        """The server that `make` makes, with this guard before it.

        Raises:
            MissingPackageError: when viser did not take the guard; the server is stopped.
        """
        infra: Any = viser_infra
        with _MAKING:
            plain = infra.websockets
            serving = _Instead(plain.asyncio.server, serve=self._serve)
            infra.websockets = _Instead(plain, asyncio=_Instead(plain.asyncio, server=serving))
            try:
                server = make()
            finally:
                infra.websockets = plain
        if not self._served:
            server.stop()
            raise _unknown("the way it starts its server")
        return server

    def _serve(self, handler: Callable[[ServerConnection], Awaitable[None]], *where: Any, **settings: Any) -> Any:
        """What viser calls in place of websockets' own. It must not raise: viser would wait for ever."""
        self._served = True
        page = settings.pop("process_request", None)
        settings |= {"max_size": MESSAGE_BYTES, "create_connection": _Connection, "server_header": None, "logger": _WEB}
        return websockets.asyncio.server.serve(
            functools.partial(_attended, handler, itertools.count()),
            *where,
            process_request=functools.partial(self._answer, page),
            **settings,
        )

    async def _answer(
        self, page: Page | None, connection: ServerConnection, asked: WebsocketRequest
    ) -> Response | None:
        """The answer to a request; None to go on to the websocket."""
        try:
            return await self._judged(page, connection, asked)
        except Exception as error:  # a path that the file system does not take, a header that is there twice
            log.info("Refused a request: %s", _said(error))
            return refused(_UNREADABLE)

    async def _judged(
        self, page: Page | None, connection: ServerConnection, asked: WebsocketRequest
    ) -> Response | None:
        if page is None:
            return refused(_BROKEN)
        port = int(connection.local_address[1])
        request = _read(connection, asked)
        if self.entry.guessed_at(request) and self._turnstile.full(request.address):
            return refused(_BUSY)
        found = self.entry.check(request, port)
        if isinstance(found, Redirect):
            return led_on(found, self.entry.cookie(request, port))
        if found is not None:
            log.debug("Refused %s, %d: %s", request.address, found.status, found.title)
            return refused(await self._slowed(found, request.address))
        answer = page(connection, asked)
        answer = await answer if inspect.isawaitable(answer) else answer
        if request.upgrade:
            return None if answer is None else refused(_BROKEN)
        return refused(_BROKEN) if answer is None else _hardened(answer, request.one("host"))

    async def _slowed(self, refusal: Refusal, address: str) -> Refusal:
        if not refusal.guessed:
            return refusal
        seconds = self._turnstile.enter(address)
        log.warning("A wrong token came from %s", address)
        try:
            await asyncio.sleep(seconds)
        finally:
            self._turnstile.leave(address)
        return refusal


class _Instead:
    """A module with some of its names replaced."""

    def __init__(self, module: Any, **names: Any) -> None:
        self.__dict__.update(names)
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)


class _Connection(ServerConnection):
    """A browser's connection, of which viser reads only messages that fit."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self._inbox = MessageFilter()
        self._idle = TokenBucket(IDLE_RATE, IDLE_BURST)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Somebody connects; it ends at once where too many wait for their answer, so that files can still be opened."""
        super().connection_made(transport)
        waiting = [_address(one) for one in self.server.handlers if one.state is CONNECTING]
        if len(waiting) > ALL_HALF_OPEN or waiting.count(_address(self)) > HALF_OPEN:
            self.transport.abort()

    def process_event(self, event: Event) -> None:
        """What came, one frame at a time. Messages wait their turn in `recv`; what makes up none never gets there."""
        if _idle(event) and self._idle.take() > 0:
            self.transport.abort()
        else:
            super().process_event(event)

    def called(self, number: int) -> None:
        """Give the browser its number, which viser counts in the same way."""
        self._inbox = MessageFilter(number=number)

    async def recv(self, decode: bool | None = None) -> Any:
        """The next message that fits, as bytes."""
        while True:
            raw = await super().recv(decode)
            if seconds := self._inbox.wait():
                await asyncio.sleep(seconds)
            if (message := self._inbox.read(raw)) is not None:
                return message


async def _attended(
    handler: Callable[[ServerConnection], Awaitable[None]], numbers: Iterator[int], connection: ServerConnection
) -> None:
    """viser's handler; what a browser breaks ends its own connection, with one line in the log."""
    asyncio.get_running_loop().set_exception_handler(_failed)
    number = next(numbers)
    if isinstance(connection, _Connection):
        connection.called(number)
    try:
        await handler(connection)
    except RejectedMessageError as error:
        log.info("Browser %d sent %s; closed its connection", number, error)
        await connection.close(1007, "no message")
    except ConnectionClosed:
        pass
    except Exception as error:
        log.info("Browser %d: closed its connection: %s", number, _said(error))
        await connection.close(1011)


def _idle(event: Event) -> bool:
    if not isinstance(event, Frame):
        return False
    return event.opcode in CTRL_OPCODES or (not event.fin and len(event.data) < SMALL)


def _failed(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """viser runs each message in a task of its own, where a value that a control cannot have fails."""
    error = context.get("exception")
    if isinstance(error, Exception):
        log.debug("A message failed: %s", _said(error))
    else:
        loop.default_exception_handler(context)


def _said(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error)[:200]!r}"


def _read(connection: ServerConnection, asked: WebsocketRequest) -> HttpRequest:
    headers: dict[str, list[str]] = {}
    for name, value in asked.headers.raw_items():
        headers.setdefault(name.lower(), []).append(value)
    upgrade = any("websocket" in value.lower() for value in headers.get("upgrade", ()))
    return HttpRequest(asked.path, headers, upgrade, _address(connection))


def _address(connection: ServerConnection) -> str:
    remote = connection.remote_address
    return str(remote[0]) if isinstance(remote, tuple) else ""


def _hardened(answer: Response, host: str) -> Response:
    """viser's page, told to load and to connect to nothing but its own server, and to be in no other site's frame."""
    own = f"'self' ws://{host} wss://{host}"  # not every browser takes 'self' for the websocket's, too
    answer.headers["Content-Security-Policy"] = (
        "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; style-src 'self' 'unsafe-inline'; "
        f"img-src 'self' data: blob:; font-src 'self' data:; connect-src {own} data: blob:; worker-src 'self' blob: data:; "
        "object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'self'"
    )
    answer.headers["X-Content-Type-Options"] = "nosniff"
    answer.headers["Referrer-Policy"] = "no-referrer"
    return answer


def _unknown(what: str) -> MissingPackageError:
    return MissingPackageError(
        f"viser {viser.__version__} differs from 1.1.1 in {what}, so its page cannot be guarded; install viser==1.1.1."
    )
