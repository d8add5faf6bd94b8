"""The channel of the screen, JSON over one websocket: the page sends `set` and `do`; the server sends one result per answer."""

from __future__ import annotations

import asyncio
import gc
import json
import logging
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol

import viser
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from explorer.feeds import json_text
from explorer.screen.loop import ScreenMessage
from lpn.core.resources import return_memory

log = logging.getLogger(__name__)

# Characters of a message; parts of a photo are bytes, which the gateway bounds.
MAX_TEXT = 20_000
# Threads that handle the messages of all tabs.
_THREADS = 32


class TabSession(Protocol):
    """The session of one tab. Messages come from one thread at a time."""

    @property
    def client(self) -> viser.ClientHandle | None:
        """The client of viser whose page is the tab's scene; None without one."""
        ...

    def receive(self, message: object) -> None:
        """Handle a message."""
        ...

    def receive_bytes(self, part: bytes) -> None:
        """Take a part of a file."""
        ...

    def attach(self, client: viser.ClientHandle | None) -> None:
        """Draw in the scene of a viser client from now on; None once the client has left."""
        ...

    def leave(self) -> None:
        """Stop all work for this tab: it has left."""
        ...


class Tabs(Protocol):
    """The state that all tabs share."""

    def session(self, send: Callable[[ScreenMessage], None]) -> TabSession:
        """Return the session of a new tab."""
        ...


class Outbox:
    """Messages that wait for one page: the newest of each kind, so that a slow page never falls further behind.

    The kinds of a message are its keys. The key `kind` is not sent; messages that differ in it never replace each other.
    `put` may be called from any thread.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop, self._ready = loop, asyncio.Event()
        self._waiting: OrderedDict[tuple[frozenset[str], str], ScreenMessage] = OrderedDict()

    def put(self, message: ScreenMessage) -> None:
        """Queue a message, and drop each waiting message whose kinds are a subset of its kinds."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._put, message)

    def _put(self, message: ScreenMessage) -> None:
        apart = str(message.pop("kind", ""))
        kinds = frozenset(message)
        for key in [key for key in self._waiting if key[0] <= kinds and key[1] == apart]:
            del self._waiting[key]
        self._waiting[kinds, apart] = message
        self._ready.set()

    async def take(self) -> ScreenMessage:
        """Return the oldest message that waits, once there is one."""
        while not self._waiting:
            self._ready.clear()
            await self._ready.wait()
        return self._waiting.popitem(last=False)[1]


class Channel:
    """Serves the tabs of all browsers.

    Args:
        screens: their shared state.
    """

    def __init__(self, screens: Tabs) -> None:
        self._screens = screens
        self._executor = ThreadPoolExecutor(_THREADS, thread_name_prefix="explorer-screen")
        self.sessions: dict[str, TabSession] = {}

    def close(self) -> None:
        """Stop all sessions."""
        for session in list(self.sessions.values()):
            session.leave()
        self._executor.shutdown(wait=False, cancel_futures=True)

    def attach(self, tab: str, client: viser.ClientHandle) -> None:
        """Give a tab's session the client of its scene; without a session, the scene shows nothing."""
        session = self.sessions.get(tab)
        if session is not None:
            session.attach(client)

    def detach(self, tab: str, client: viser.ClientHandle) -> None:
        """Remove the client of a closed scene from its session."""
        session = self.sessions.get(tab)
        if session is not None and session.client is client:
            session.attach(None)

    async def serve(self, tab: str, connection: ServerConnection) -> None:
        """Serve one tab until its connection ends.

        Args:
            tab: identifier that the page chose; a page that connects again replaces its former session.
        """
        loop = asyncio.get_running_loop()
        outbox = Outbox(loop)
        session = self._screens.session(outbox.put)
        before, self.sessions[tab] = self.sessions.get(tab), session
        if before is not None:
            await asyncio.to_thread(before.leave)
        log.info("A page has connected; %d are open", len(self.sessions))
        writing = asyncio.create_task(_write(outbox, connection))
        try:
            async for raw in connection:
                try:
                    if isinstance(raw, bytes):
                        await loop.run_in_executor(self._executor, session.receive_bytes, raw)
                    elif len(raw) <= MAX_TEXT:
                        await loop.run_in_executor(self._executor, session.receive, json.loads(raw))
                except (json.JSONDecodeError, RecursionError):
                    log.debug("A message of a page is no JSON: %d characters", len(raw))
                except Exception:
                    log.exception("A message of a page was not handled")
        except ConnectionClosed:
            pass
        finally:
            writing.cancel()
            if self.sessions.get(tab) is session:
                del self.sessions[tab]
            log.info("A page has left; %d are open", len(self.sessions))
            await asyncio.to_thread(_end, session)


def _end(session: TabSession) -> None:
    """End a session, and free its memory now; the garbage collector might keep its pictures for minutes."""
    session.leave()
    gc.collect()
    return_memory()


async def _write(outbox: Outbox, connection: ServerConnection) -> None:
    while True:
        message = await outbox.take()
        try:
            text = json_text(message)
        except (TypeError, ValueError):  # later messages are still handled
            log.exception("A message to a page is no JSON: %s", ", ".join(message))
            continue
        try:
            await connection.send(text)
        except ConnectionClosed:
            return
