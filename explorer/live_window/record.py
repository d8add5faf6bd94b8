"""The record of a flight that goes on, for all browsers: its last frames, their photos, and sentences."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from explorer.compute.watchers import Watchers
from explorer.flight_window.pictures import FlightPictures
from explorer.flight_window.service import FlightView
from explorer.server.picture_route import EncodedPicture
from lpn.core import images
from lpn.core.arrays import UInt8Array
from lpn.flights import Flight
from lpn.live.outputs import LiveFix
from lpn.locate.located import LocatedFlight, LocatedFrame
from lpn.maps import Map

# When there are this many frames, the older half is forgotten: the page gets all frames again at each change.
MOST = 400
# Longer side and quality of the photos that are kept.
_PHOTO, _QUALITY = 1280, 82
_SENTENCES = 20
_WAITING = "No frame has come yet"


@dataclass(frozen=True, eq=False)
class LiveSight:
    """The flight so far.

    Attributes:
        view: of its frames; None before the first.
        pictures: of these frames.
        status: age of the last answer and dropped frames in words; before the first answer, what is waited for.
        described: windows of the map that are described, and all of them; (0, 0) once there is a frame.
    """

    view: FlightView | None
    pictures: FlightPictures
    status: str = ""
    described: tuple[int, int] = (0, 0)


class _Flown:
    """The flight whose pictures are served."""

    def __init__(self, flight: LocatedFlight) -> None:
        self.flight: LocatedFlight | None = flight


class LiveRecord:
    """Takes the fixes of a run and its sentences; thread-safe. Photos are kept as small files in a folder of its own.

    Args:
        name: of the flight.
        basemap: that it flies over.

    Attributes:
        watchers: are told of each frame and sentence.
    """

    def __init__(self, name: str, basemap: Map) -> None:
        self._name, self._basemap = name, basemap
        self._folder = TemporaryDirectory(prefix="lpn-live-")
        self._lock = threading.Lock()
        self._frames: list[LocatedFrame] = []
        self._count = 0
        self._sentences: list[str] = []
        self.watchers = Watchers()
        self._flown = _Flown(self._flight())
        self._pictures = FlightPictures(self._flown)
        self._status, self._described = _WAITING, (0, 0)
        # None after a change.
        self._sight: LiveSight | None = None

    def send(self, fix: LiveFix) -> None:
        """Add a frame."""
        file = Path(self._folder.name) / f"{self._count}.jpg"
        if fix.pixels is not None:
            file.write_bytes(_small(fix.pixels))
        self._count += 1
        frame = replace(fix.located.frame, file=file)
        located = replace(fix.located, frame=frame, stages=dict(fix.located.stages))
        with self._lock:
            self._frames.append(located)
            if len(self._frames) > MOST:
                for old in self._frames[: MOST // 2]:
                    old.frame.file.unlink(missing_ok=True)
                del self._frames[: MOST // 2]
                # Frames have other numbers now, and a browser keeps pictures by their addresses.
                self._flown = _Flown(self._flight())
                self._pictures = FlightPictures(self._flown)
            dropped = f", {fix.dropped} frames dropped" if fix.dropped else ""
            self._status = f"Answered in {fix.age:.2f} s{dropped}"
            self._sight = None
        self.watchers.tell()

    def count_windows(self, done: int, total: int) -> None:
        """Take the number of the map's windows that are described, before the first frame is located."""
        with self._lock:
            self._described = done, total
            self._status = f"{done:,} of {total:,} windows of the map are described"
            self._sight = None
        self.watchers.tell()

    def note(self, sentence: str) -> None:
        """Add a sentence; the last twenty are kept."""
        with self._lock:
            self._sentences = [*self._sentences, sentence][-_SENTENCES:]
            self._sight = None
        self.watchers.tell()

    def forget(self) -> None:
        """Remove the photos."""
        self._folder.cleanup()

    @property
    def sight(self) -> LiveSight:
        """The flight so far; it is derived when a browser asks, and not for each frame."""
        with self._lock:
            if self._sight is None:
                view = None
                if self._frames:
                    self._flown.flight = self._flight()
                    view = FlightView.of(self._flown.flight, {}, "")
                self._sight = LiveSight(view, self._pictures, self._status, self._described if view is None else (0, 0))
            return self._sight

    def find_picture(self, path: str) -> Callable[[], EncodedPicture] | None:
        """Return what computes the picture of a path; None if there is no such picture. The path is untrusted."""
        with self._lock:
            pictures = self._pictures
        return pictures.find(path)

    def _flight(self) -> LocatedFlight:
        frames = list(self._frames)
        flight = Flight(self._name, tuple(located.frame for located in frames))
        return LocatedFlight(flight, self._basemap, frames, None, list(self._sentences), None)


def _small(pixels: UInt8Array) -> bytes:
    return images.jpeg(images.shrink(pixels, _PHOTO), _QUALITY)
