"""A flight with its verdicts and a user's corrections, derived once for all tabs."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from explorer.compute.cache import SingleFlightCache
from explorer.compute.watchers import Watchers
from explorer.flight.pictures import FlightPicturesFeed
from explorer.workspace import Workspace
from lpn.core.arrays import Float64Array
from lpn.core.demo import own_file, own_file_place
from lpn.core.errors import InputError, LPNError
from lpn.flight.locate import corrections
from lpn.flight.locate.corrections import Correction
from lpn.flight.locate.coverage import Outline, outline
from lpn.flight.locate.located import LocatedFlight
from lpn.flight.locate.tags import enter_corrections
from lpn.flight.locate.tracks import best_track, track_bytes
from lpn.flight.locate.verdict import FrameVerdict, judge


@dataclass(frozen=True, eq=False)
class FlightSnapshot:
    """The located frames of a flight at one moment.

    Attributes:
        flight: its frames have the user's corrections.
        corrections: by the frame's name.
        corrections_error: the reason why they cannot be used, in one sentence; empty if they can.
    """

    flight: LocatedFlight
    corrections: Mapping[str, Correction] = field(default_factory=dict)
    corrections_error: str = ""

    @classmethod
    def of(cls, flight: LocatedFlight, corrections: Mapping[str, Correction], error: str = "") -> FlightSnapshot:
        """Enter corrections in a copy of a flight."""
        frames = [replace(located, by_hand=None) for located in flight.frames]
        enter_corrections(flight.basemap, frames, corrections)
        return cls(replace(flight, frames=frames), corrections, error)

    @cached_property
    def verdicts(self) -> list[FrameVerdict]:
        """The verdict on each frame."""
        return [judge(located) for located in self.flight.frames]

    @cached_property
    def outlines(self) -> list[Outline | None]:
        """The ground that each frame shows; None where it is unknown."""
        return [outline(located) for located in self.flight.frames]

    @cached_property
    def measured(self) -> LocatedFlight:
        """The flight for measuring errors: its tags are corrected for their time lag."""
        return self.flight.without_lag()

    @property
    def lag(self) -> float | None:
        """Seconds by which the tags of the flight are late; None if they are not."""
        return None if self.flight.tags_without_lag is None or self.flight.audit is None else self.flight.audit.lag


class SharedFlight:
    """The flight of a workspace; thread-safe.

    Attributes:
        watchers: called after each correction.
    """

    def __init__(self, workspace: Workspace) -> None:
        self._workspace, self._lock = workspace, threading.RLock()
        self.watchers = Watchers()
        self._snapshot: FlightSnapshot | None = None
        # The snapshot's flight before corrections.
        self._flight: LocatedFlight | None = None

    @property
    def _file(self) -> Path:
        return own_file(self._workspace.root, corrections.NAME)

    @property
    def corrections_place(self) -> str:
        """The place of the corrections, in words and without the server's folders."""
        return own_file_place(self._workspace.root, corrections.NAME, "flight")

    def snapshot(self) -> FlightSnapshot:
        """Return the frames located so far. It is one object until the flight or a correction changes."""
        flight = self._workspace.flight
        assert flight is not None
        with self._lock:
            if self._snapshot is None or self._flight is not flight:
                self._flight = flight
                try:
                    self._snapshot = FlightSnapshot.of(flight, corrections.read_corrections(self._file))
                except LPNError as error:  # the panel is useful without corrections
                    self._snapshot = FlightSnapshot.of(flight, {}, str(error))
            return self._snapshot

    def correct(self, frame: int, corners: Float64Array | None) -> None:
        """Store a frame's correction on disk, for all tabs; None removes it.

        The later of two tabs of this server wins; a newer correction by another program is not overwritten.

        Args:
            corners: corners of the picture in metres of the map's frame, (4, 2).

        Raises:
            LPNError: when no camera can see these corners, another program has corrected the frame, or the file cannot be
                written; then nothing has changed.
        """
        with self._lock:  # otherwise an older state of the file could be assigned last
            seen = self.snapshot()
            name, basemap = seen.flight.frames[frame].frame.name, seen.flight.basemap
            correction = None if corners is None else Correction.of(corners, basemap.frame)
            try:
                kept = corrections.set_correction(self._file, name, correction, seen.corrections)
            except InputError:
                self._snapshot = None  # the next one includes the other program's corrections
                self.watchers.tell()
                raise
            self._snapshot = FlightSnapshot.of(seen.flight, kept)
        self.watchers.tell()

    def positions(self, suffix: str) -> bytes:
        """Return a file of the format `suffix` with one position for each photo, by its correction or the deciding stage."""
        flight = self.snapshot().flight
        return track_bytes(suffix, flight.flight.name, best_track(flight))


# The flights of workspaces, with their pictures.
_SHARED: SingleFlightCache[Workspace, tuple[SharedFlight, FlightPicturesFeed]] = SingleFlightCache(16)


def shared_flight(workspace: Workspace) -> tuple[SharedFlight, FlightPicturesFeed]:
    """Return a workspace's flight and its pictures; all tabs share them."""

    def make() -> tuple[SharedFlight, FlightPicturesFeed]:
        flight = workspace.flight
        assert flight is not None
        pictures = FlightPicturesFeed(workspace.feeds, lambda: workspace.flight or flight)
        return SharedFlight(workspace), pictures

    return _SHARED.get(workspace, make)
