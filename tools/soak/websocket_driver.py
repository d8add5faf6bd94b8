"""Drive a page over a websocket: move controls as viser's page does, and read what it would show."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Protocol

from websockets.exceptions import WebSocketException

from tools.fixtures.websocket_client import CHUNK, WebSocketClient
from tools.soak import page_content
from tools.soak.client_state import ClientState, PictureNames, UploadedPicture, shows_state, unexpected_links
from tools.soak.page_content import PageContent

# Longest time to any answer in seconds, with all clients at work.
BOUND = 60.0
# Changes a second that viser's page sends while a slider is dragged.
RATE = 20.0


class StoppedError(Exception):
    """Raised in every client when the soak ends."""


class FaultError(Exception):
    """Raised when the server violates an expectation.

    Args:
        kind: such as "no answer".
        text: expected and actual behaviour.
    """

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(f"{kind}: {text}")
        self.kind, self.text = kind, text


@dataclass(frozen=True)
class SettledPage:
    """A page that shows the expected state.

    Attributes:
        shown: the page's content.
        seconds: time from the last change to the answer.
    """

    shown: PageContent
    seconds: float


class PageDriver(Protocol):
    """Operates a page as a person does; every method may raise FaultError and StoppedError."""

    def enter(self, link: str) -> None:
        """Open the page by a link's query."""

    def drag(self, label: str, values: list[float]) -> float:
        """Move a slider through values, and return the last one."""

    def switch(self, label: str, on: bool) -> None:
        """Set a checkbox."""

    def press(self, label: str) -> None:
        """Press a button."""

    def choose(self, label: str, option: str) -> None:
        """Choose an option."""

    def take(self, task: str) -> None:
        """Choose a task."""

    def send(self, own_picture: UploadedPicture) -> None:
        """Upload a picture."""

    def settle(self, state: ClientState, path: Iterable[ClientState] = ()) -> SettledPage:
        """Wait until the page shows a state.

        Args:
            path: states set on the way, which the page may have shown.
        """

    def leave(self, how: str) -> None:
        """Leave by "close", or by "vanish", without a farewell."""


class WebSocketDriver:
    """One client over a websocket, for one visit after the other.

    Args:
        url: the server's address.
        names: names of the pictures.
        stop: set when the soak ends.
    """

    def __init__(self, url: str, names: PictureNames, stop: threading.Event) -> None:
        self._url, self._names, self._stop = url, names, stop
        self._talker: WebSocketClient | None = None
        self._changed = time.monotonic()
        self._before: list[ClientState] = []

    @property
    def talker(self) -> WebSocketClient:
        """The connection."""
        assert self._talker is not None
        return self._talker

    def enter(self, link: str) -> None:
        """Connect, send a camera, and greet as the page does."""
        began = time.monotonic()
        try:
            self._talker = WebSocketClient(self._url, origin=self._url, open_timeout=BOUND)
        except (OSError, WebSocketException) as error:
            raise FaultError("no connection", f"{type(error).__name__}: {error}") from error
        self.talker.camera()
        self._await(lambda: self.talker.find("page") is not None, "the page's controls", "none came")
        hello = {"search": f"?{link}", "small": False}
        self.tell("hello", hello)

        def greet() -> None:
            if self.talker.find("page") is not None:  # while another place is opened, the page has no controls
                self.tell("hello", hello)

        # Repeat the greeting, as the page does: the app may not be listening yet.
        self._await(lambda: self.talker.link is not None, "a first answer", "none came", greet)
        self._changed, self._before = began, []

    def drag(self, label: str, values: list[float]) -> float:
        """Send values at the page's rate."""
        for value in values:
            self.set(label, value)
            if self._stop.wait(1 / RATE):
                raise StoppedError
        return values[-1]

    def switch(self, label: str, on: bool) -> None:
        """Set a checkbox."""
        self.set(label, on)

    def press(self, label: str) -> None:
        """Press a button."""
        self.set(label, True)

    def choose(self, label: str, option: str) -> None:
        """Choose an option."""
        self.set(label, option)

    def take(self, task: str) -> None:
        """Choose a task."""
        self.tell("task", task)

    def set(self, label: str, value: Any, prop: str = "value") -> None:
        """Set a control, or another attribute of it."""
        self._sending(lambda: self.talker.set(label, value, prop))

    def tell(self, kind: str, value: Any) -> None:
        """Send a message of the page's own script."""
        self._sending(lambda: self.talker.tell(kind, value))

    def send(self, own_picture: UploadedPicture) -> None:
        """Upload a picture."""
        self._sending(lambda: self.talker.upload(own_picture.name, own_picture.content, transfer=own_picture.name))

    def begin_upload(self, name: str) -> None:
        """Send the first of three parts of a file."""
        self._sending(lambda: self.talker.begin_upload(name, CHUNK, 3))

    def raw(self, data: bytes | str) -> None:
        """Send a frame."""
        self._sending(lambda: self.talker.raw(data))

    def settle(self, state: ClientState, path: Iterable[ClientState] = ()) -> SettledPage:
        """Wait for the answer, and check that the page showed nothing foreign before it."""
        talker, caught = self.talker, list[tuple[dict[str, str], float, list[str], list[str]]]()

        def there() -> bool:  # called under the client's lock
            found = shows_state(
                self._names, state, talker.link, page_content.status(talker.elements.get("lpn-status", ""))
            )
            if found:
                caught.append((dict(talker.elements), talker.heard, list(talker.statuses), list(talker.links)))
                talker.statuses.clear()
                talker.links.clear()
            return found

        self._await(there, f"{self._names.address(state)} with {self._names.label(state)},", None)
        elements, heard, statuses, links = caught[0]
        refused = [f"{title}: {text}" for title, text in talker.notices if title == "No answer"]
        talker.notices.clear()
        if refused:
            raise FaultError("refused", " ".join(refused))
        self._foreign([state, *path, *self._before], statuses, links)
        self._before = [state]
        found = page_content.shown(*(elements.get(part, "") for part in ("lpn-status", "lpn-matches", "lpn-parts")))
        return SettledPage(found, max(heard - self._changed, 0.0))

    def leave(self, how: str) -> None:
        """Leave, with a farewell or without."""
        if self._talker is not None:
            self._talker.close() if how == "close" else self._talker.abort()
            self._talker = None

    def gone(self, seconds: float) -> bool:
        """Return True when the server ends the connection in time."""
        return self.talker.gone(seconds)

    def _foreign(self, path: list[ClientState], statuses: list[str], links: list[str]) -> None:
        """Raise FaultError when the page showed a state that this client never set."""
        own_picture = {(str(one.query), self._names.label(one), f"{one.angle:g}") for one in path}
        lines = [text for text in map(page_content.status, statuses) if text.get("seq", "0") != "0"]
        shown = {(text["query"], text["name"], text["angle"]) for text in lines}
        if odd := shown - own_picture:
            raise FaultError("foreign state", f"the page showed {sorted(odd)}; asked for were {sorted(own_picture)}")
        if text := unexpected_links(self._names, path, links):
            raise FaultError("foreign state", f"the page's address said {', '.join(text)}, which was not asked for")

    def _await(
        self, holds: Callable[[], bool], what: str, found: str | None, again: Callable[[], None] = lambda: None
    ) -> None:
        """Wait, even after the soak's end, so that a missing answer is noticed in a short soak too."""
        deadline = time.monotonic() + BOUND
        while not self.talker.until(holds, 0.5):
            if self.talker.closed.is_set():
                if self._stop.is_set():
                    raise StoppedError
                raise FaultError("disconnected", f"the server ended the connection while {what} was awaited")
            if time.monotonic() > deadline:
                status = page_content.status(self.talker.elements.get("lpn-status", ""))
                shown = found or f"the page shows {self.talker.link} with {status}"
                raise FaultError("no answer", f"expected {what} within {BOUND:g} s; {shown}")
            again()

    def _sending(self, act: Callable[[], None]) -> None:
        try:
            act()
        except (OSError, ConnectionError) as error:
            raise FaultError("disconnected", f"{type(error).__name__}: {error}") from error
        except Exception as error:
            if self.talker.closed.wait(1):
                raise FaultError("disconnected", f"{type(error).__name__}: {error}") from error
            raise
        self._changed = time.monotonic()
