"""One browser's view of a flight that goes on: the flight window with the newest frame chosen and its photo laid over the map."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any

import viser
from markupsafe import escape

from explorer.compute.worker import Worker
from explorer.flight_window import messages as flight_messages
from explorer.flight_window import page
from explorer.flight_window.messages import FlightMessage
from explorer.live_window.messages import GreetLive, LivePageMessage, ResizeLive
from explorer.live_window.record import LiveRecord
from explorer.stage.viewport import EDGE, Viewport
from explorer.web import style
from explorer.web.bridge import PageBridge
from explorer.web.html import Html
from explorer.web.render import progress_bar
from lpn.drawing import theme

log = logging.getLogger(__name__)

# Height of the panel's own frame in pixels.
_FRAME_HEIGHT = 52
# Colour of refused frames on the map.
_REFUSED = theme.css(theme.COLOURS["part-3"])


class LiveWindow:
    """One browser's view; it works on a thread of its own.

    Args:
        record: of the flight, for all browsers.
    """

    def __init__(self, client: viser.ClientHandle, record: LiveRecord) -> None:
        self._record, self._lock = record, threading.RLock()
        # The frame that a person chose; None follows the newest.
        self._chosen: str | None = None
        self._size: tuple[int, int] | None = None
        self._sequence = 0
        self.viewport = Viewport()
        self._client = client
        self._panel = client.gui.add_panel(visible=True)
        with self._panel.add_tab("Live", viser.Icon.DRONE):
            self._shell = Html(client.gui)
            self._data, self._followed, self._progress, self._start = (Html(client.gui) for _ in range(4))
        self._worker = Worker(self._work, lambda error: log.error("The live page was not drawn: %s", error))
        receivers: dict[type[Any], Callable[[Any], None]] = {
            FlightMessage: self._receive_flight,
            LivePageMessage: self._receive,
        }
        properties = {"title": "Live · LPN Explorer", "keys": []}
        self._bridge = PageBridge(client.gui, receivers, properties, style.STYLE)
        self.viewport.watch(self._worker.wake)
        record.watchers.watch(self._worker.wake)
        self._worker.wake()

    def leave(self) -> None:
        """Stop working for a browser that left."""
        self._record.watchers.unwatch(self._worker.wake)
        self._worker.stop()

    def _receive(self, message: LivePageMessage) -> None:
        match message:
            case GreetLive(greeting):
                self._bridge.set_address("", [])
                dark = not greeting.get("light")
                self._client.gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False)
                self._bridge.tell_theme(dark)
                sides = greeting.get("viewport")
                if isinstance(sides, list) and len(sides) == 2 and all(isinstance(side, int | float) for side in sides):
                    self.viewport.resize(*(min(max(int(side), 1), 10_000) for side in sides))
                self._worker.wake()
            case ResizeLive(width, height):
                self.viewport.resize(width, height)

    def _receive_flight(self, message: FlightMessage) -> None:
        if isinstance(message, flight_messages.ChooseFrame):
            view = self._record.sight.view
            frames = () if view is None else view.flight.frames
            with self._lock:
                newest = message.frame >= len(frames) - 1
                self._chosen = None if newest else frames[message.frame].frame.file.name
            self._worker.wake()

    def _work(self) -> float | None:
        self._place()
        sight = self._record.sight
        view = sight.view
        self._shell.show(page.shell((), max(self._height - _FRAME_HEIGHT, 300), tall=True, live=True))
        if view is None:
            self._progress.show(
                page.calls({"waits": progress_bar(*sight.described, f"{sight.status}.", "windows of the map")})
            )
            return None
        frames = view.flight.frames
        with self._lock:
            chosen = self._chosen
        names = [located.frame.file.name for located in frames]
        frame = names.index(chosen) if chosen in names else len(frames) - 1
        address = sight.pictures.address
        data = page.data(view, address) | {"refused": _REFUSED}
        self._data.show(page.calls({"show": data, "lists": page.lists(view)}))
        last = view.beliefs[-1]
        sentence = f"{last.headline}. {page.sentence(view, running=False)}"
        self._progress.show(page.calls({"sentence": escape(sentence), "status": escape(sight.status)}))
        self._sequence += 1
        followed = {"address": address, "frame": page.chosen(view, frame, address), "answer": None, "scores": None}
        self._followed.show(page.calls({"follow": followed | {"sequence": self._sequence}}))
        self._start.show(page.calls({"live": None}))
        return None

    def _place(self) -> None:
        """Cover the whole page."""
        width, self._height = self.viewport.window()
        if (width, self._height) != self._size:
            self._panel.float(x=EDGE, y=-EDGE, width=width, height=self._height)
            self._panel.expand()
            self._size = width, self._height
