"""A live flight in the flight panel: its frames so far, its tabs, and the server of its page."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from explorer.compute.watchers import Watchers
from explorer.compute.worker import Worker
from explorer.feeds import Feeds
from explorer.flight import page
from explorer.flight.part import FIELDS
from explorer.flight.pictures import FlightPicturesFeed
from explorer.flight.service import FlightSnapshot
from explorer.screen import route
from explorer.screen.channel import Channel
from explorer.screen.fields import ScreenState, changed
from explorer.screen.loop import ScreenMessage
from explorer.server.auth import Authenticator
from explorer.server.gateway import Screen
from explorer.server.page_server import close_server, open_server
from explorer.server.picture_route import PictureRoute
from lpn.core import images
from lpn.core.texts import counted
from lpn.flight.files import Flight
from lpn.flight.live.run import LiveFix
from lpn.flight.locate.located import LocatedFlight, LocatedFrame
from lpn.flight.maps import Map

log = logging.getLogger(__name__)

# Above this many frames, the older half is forgotten, because each change sends all frames to the page.
MOST = 400
# Longer side and JPEG quality of stored photos, and the number of stored notes.
_PHOTO, _QUALITY, _SENTENCES = 1280, 82, 20
# The fields that a tab of a live flight may set, beside the photo.
_FIELDS = {"theme", *(row.name for row in FIELDS if row.name != "flight_paint")}


class LiveSight(NamedTuple):
    """The flight so far.

    Attributes:
        seen: the located frames; None before the first.
        addresses: folders of their pictures, see `FlightPicturesFeed`.
        status: a sentence on the last answer's age and the dropped frames; before the first answer, the reason to wait.
    """

    seen: FlightSnapshot | None
    addresses: Mapping[str, Any]
    status: str


class LiveRecord:
    """Collects the fixes and notes of a live run; thread-safe. It stores photos as small files in a temporary folder.

    Args:
        name: the flight's name.
        basemap: the map below the flight.

    Attributes:
        feeds: serves the pictures.
        watchers: called after each frame and each note.
    """

    def __init__(self, name: str, basemap: Map) -> None:
        self._name, self._basemap = name, basemap
        self._folder = TemporaryDirectory(prefix="lpn-live-")
        self._lock = threading.Lock()
        self._frames: list[LocatedFrame] = []
        self._count = 0
        self._sentences: list[str] = []
        self.feeds, self.watchers = Feeds(), Watchers()
        self._status = "No frame has come yet"
        self._pictures = FlightPicturesFeed(self.feeds, self._flight)
        # Reset to None by each change.
        self._sight: LiveSight | None = None

    def send(self, fix: LiveFix) -> None:
        """Add a frame."""
        file = Path(self._folder.name) / f"{self._count}.jpg"
        if fix.pixels is not None:
            file.write_bytes(images.jpeg(images.shrink(fix.pixels, _PHOTO), _QUALITY))
        self._count += 1
        frame = replace(fix.located.frame, file=file)
        located = replace(fix.located, frame=frame, stages=dict(fix.located.stages))
        with self._lock:
            self._frames.append(located)
            if len(self._frames) > MOST:
                for old in self._frames[: MOST // 2]:
                    old.frame.file.unlink(missing_ok=True)
                del self._frames[: MOST // 2]
                # Frames have new numbers now, and a browser caches pictures by their addresses.
                self._pictures = FlightPicturesFeed(self.feeds, self._flight)
        dropped = f", {counted(fix.dropped, 'frame')} dropped" if fix.dropped else ""
        self._change(f"Answered in {fix.age:.2f} s{dropped}")

    def count_windows(self, done: int, total: int) -> None:
        """Take the number of described windows of the map, before the first frame is located."""
        self._change(f"{done:,} of {total:,} windows of the map are described")

    def note(self, sentence: str) -> None:
        """Add a note, one sentence; the last twenty are stored."""
        with self._lock:
            self._sentences = [*self._sentences, sentence][-_SENTENCES:]
        self._change(self._status)

    def session(self, send: Callable[[ScreenMessage], None]) -> LiveSession:
        """Return the session of a new tab, see `Channel`."""
        return LiveSession(self, send)

    def forget(self) -> None:
        """Remove the photos."""
        self._folder.cleanup()

    @property
    def sight(self) -> LiveSight:
        """The flight so far; computed when a tab asks, not for each frame."""
        with self._lock:
            if self._sight is None:
                flight = self._flight()
                seen = FlightSnapshot(flight) if flight.frames else None
                self._sight = LiveSight(seen, self._pictures.addresses, self._status)
            return self._sight

    def _change(self, status: str) -> None:
        with self._lock:
            self._status, self._sight = status, None
        self.watchers.tell()

    def _flight(self) -> LocatedFlight:
        frames = list(self._frames)
        flight = Flight(self._name, tuple(located.frame for located in frames))
        return LocatedFlight(flight, self._basemap, frames, None, list(self._sentences), None)


class LiveSession:
    """One tab: the flight panel alone, which follows the newest frame until the user chooses another."""

    def __init__(self, record: LiveRecord, send: Callable[[ScreenMessage], None]) -> None:
        self._record, self._send = record, send
        self._state = ScreenState(place="live", panel="flight", of_panels={"flight_over": "swipe"})
        # The file of the photo that the user chose; None follows the newest.
        self._chosen: str | None = None
        self._seen: FlightSnapshot | None = None
        self.client: Any = None
        self._worker = Worker(self._work, lambda error: log.error("The live page was not drawn: %s", error))

    def receive(self, message: object) -> None:
        """Open the page, choose a photo, or set a field; anything else changes nothing."""
        match message:
            case {"do": "open"}:
                panel = {"name": "flight", "title": "Live flight", "key": "", "place": "full", "script": True}
                nothing: dict[str, Any] = {"tasks": [], "scorings": [], "names": [], "commands": []}
                told = {"data": "live", "parts": 1, "word": "part", "tiles": 0, "photo": "photo", "turns": False}
                told |= {"places": {}, "models": ["LPN"], "place": "Map", "live": True, "panels": [panel]}
                self._send({"page": nothing | told})
                self._record.watchers.watch(self._worker.wake)
            case {"do": "step", "args": {"by": int(by)}}:
                self._choose(self._state.query + by)
            case {"set": {"query": int(frame)}}:
                self._choose(frame)
            case {"set": dict(values)}:
                given = {name: value for name, value in values.items() if name in _FIELDS}
                # These fields depend on no workspace.
                self._state, problems = changed(self._state, given, None)  # type: ignore[arg-type]
                for problem in problems:
                    self._send({"error": problem})
            case _:
                return
        self._worker.wake()

    def receive_bytes(self, part: bytes) -> None:
        """Ignore a file that the tab sends."""

    def attach(self, client: Any) -> None:
        """Do nothing: this page has no scene."""

    def leave(self) -> None:
        """Stop the work for a tab that left."""
        self._record.watchers.unwatch(self._worker.wake)
        self._worker.stop()

    def _choose(self, frame: int) -> None:
        frames = [] if self._seen is None else self._seen.flight.frames
        newest = not 0 <= frame < len(frames) - 1
        self._chosen = None if newest else frames[frame].frame.file.name

    def _work(self) -> None:
        sight = self._record.sight
        if (seen := sight.seen) is not None:
            names = [located.frame.file.name for located in seen.flight.frames]
            frame = names.index(self._chosen) if self._chosen in names else len(names) - 1
            self._state = replace(self._state, query=frame)
        self._send({"state": self._state.values() | {"address": "", "photo": ""}})
        if seen is not None:
            if seen is not self._seen:
                self._seen = seen
                self._tell("flight", page.data(seen, sight.addresses) | {"parts": [], "kept": "", "live": True})
            self._tell("photo", page.chosen(seen, frame, sight.addresses))
            spot = self._state.value("flight_spot")
            self._tell("spot", page.spot(seen, (spot[0], spot[1])) if spot else None)
        self._tell("progress", sight.status)

    def _tell(self, kind: str, value: object) -> None:
        self._send({"panel": {"name": "flight", "message": {kind: value}}, "kind": kind})


class LiveApp:
    """A running server of the page of a live flight.

    Args:
        record: the flight's record.
        authenticator: the access rules.

    Raises:
        InputError: when the address or port cannot be listened on.
        MissingPackageError: when viser's page cannot be protected.
    """

    def __init__(self, record: LiveRecord, host: str, port: int, authenticator: Authenticator) -> None:
        self._authenticator = authenticator
        self._pictures = PictureRoute(record.feeds.find)
        self._channel = Channel(record)
        screen = Screen(route.respond, route.scene_of, self._channel.serve)
        self.server, _ = open_server(host, port, authenticator, self._pictures, screen=screen)

    @property
    def link(self) -> str:
        """The address that the user opens."""
        return self._authenticator.link(self.server.get_port())

    def close(self) -> None:
        """Stop the server."""
        self._channel.close()
        self._pictures.close()
        close_server(self.server)
