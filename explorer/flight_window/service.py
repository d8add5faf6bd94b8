"""The view of a workspace's flight, derived once for all browsers, and a person's corrections of its frames."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from explorer.compute.cache import SingleFlightCache
from explorer.compute.watchers import Watchers
from explorer.workspace import Workspace
from lpn.core import images
from lpn.core.arrays import Float64Array
from lpn.core.demo import own_file, own_file_place
from lpn.core.errors import DataError, InputError, LPNError, PictureError
from lpn.locate import corrections
from lpn.locate.agreement import MapAgreement, map_agreement
from lpn.locate.belief import Belief, Disagreement, FlightVerdicts, best_track
from lpn.locate.corrections import Correction
from lpn.locate.coverage import Outline, outline
from lpn.locate.located import LocatedFlight
from lpn.locate.summary import placed_errors
from lpn.locate.surveyed import SurveyedErrors
from lpn.locate.tags import enter_corrections
from lpn.locate.tracks import track_bytes

# Longer side in pixels of a photo that is compared with the map.
_COMPARED = 960
# Comparisons of corrected photos in the cache.
_COMPARISONS = 100


@dataclass(frozen=True, eq=False)
class FlightView:
    """The parts of a flight that all flight windows show.

    Attributes:
        outlines: the ground that each frame shows; None where it is unknown.
        contradictions: frames whose answers lie too far apart.
        beliefs: the verdict on each frame.
        corrections: a person's corrections by the frame's name.
        corrections_error: why they cannot be used, in one sentence; empty if they can.
    """

    flight: LocatedFlight
    outlines: list[Outline | None]
    contradictions: Sequence[Disagreement]
    beliefs: Sequence[Belief]
    corrections: dict[str, Correction]
    corrections_error: str = ""

    @classmethod
    def of(
        cls, flight: LocatedFlight, kept: dict[str, Correction], error: str, verdicts: FlightVerdicts | None = None
    ) -> FlightView:
        """Derive the view of a flight with its corrections, or with the reason why they cannot be used.

        Args:
            verdicts: of the flight; by default they are looked for.
        """
        verdicts = verdicts or FlightVerdicts.of(flight)
        outlines = [outline(located) for located in flight.frames]
        return cls(flight, outlines, verdicts.contradictions, verdicts.beliefs, kept, error)

    @cached_property
    def errors(self) -> SurveyedErrors | None:
        """The errors of the placed photos against their GPS tags; None if no placed photo has one."""
        return placed_errors(self.flight, self.beliefs)

    def corrected(self, frame: int) -> tuple[float, float] | None:
        """Return where a person says that the middle of a frame's picture lies, in metres of the map's frame."""
        correction = self.corrections.get(self.flight.frames[frame].frame.name)
        if correction is None:
            return None
        x, y = self.flight.basemap.frame.xy(*correction.middle[:, None])[0].tolist()
        return x, y

    def homography(self, frame: int) -> Float64Array | None:
        """Return the matrix that lays a photo over the map: that of a correction, else of an accepted registration."""
        located = self.flight.frames[frame]
        if (correction := self.corrections.get(located.frame.name)) is not None:
            return correction.homography(self.flight.basemap.frame, located.frame.width, located.frame.height)
        answer = located.stages.get("registration")
        if answer is None or not answer.accepted or answer.homography is None:
            return None
        return np.array(answer.homography).reshape(3, 3)


class FlightService:
    """The view of a workspace's flight; thread-safe.

    Attributes:
        watchers: are told of each correction.
    """

    def __init__(self, workspace: Workspace) -> None:
        self._workspace, self._lock = workspace, threading.RLock()
        self.watchers = Watchers()
        self._view: FlightView | None = None
        self._agreements: SingleFlightCache[tuple[int, Correction], MapAgreement | None] = SingleFlightCache(
            _COMPARISONS
        )

    @property
    def corrections_file(self) -> Path:
        """The file of corrections. OutputError if it is the demo's, and the user has no writable folder for it."""
        return own_file(self._workspace.root, corrections.NAME)

    @property
    def corrections_place(self) -> str:
        """Where the corrections are, in words and without the server's folders."""
        return own_file_place(self._workspace.root, corrections.NAME, "flight")

    def view(self) -> FlightView:
        """Return the view of the frames located so far. It is the same object until the flight or a correction changes."""
        flight = self._workspace.flight
        assert flight is not None
        with self._lock:
            if self._view is None or self._view.flight is not flight:
                self._view = FlightView.of(flight, *self._read(), self._workspace.verdicts_of(flight))
            return self._view

    def correct(self, frame: int, corners: Float64Array | None) -> None:
        """Keep a frame's correction on disk, for all browsers; None removes it.

        Only what another program has written meanwhile is refused: of two browsers of this server, the later one wins.

        Args:
            corners: of the picture in metres of the map's frame, (4, 2).

        Raises:
            LPNError: when the corners are not those of a picture, another program has corrected the frame meanwhile, or the
                file cannot be written; then nothing has changed.
        """
        with self._lock:  # otherwise an older state of the file could be assigned last
            view = self.view()
            name, basemap = view.flight.frames[frame].frame.name, view.flight.basemap
            correction = None if corners is None else Correction.of(corners, basemap.frame)
            try:
                kept = corrections.set_correction(self.corrections_file, name, correction, view.corrections)
            except InputError:
                self._view = None  # the next one has what the other program wrote
                self.watchers.tell()
                raise
            self._view = replace(view, corrections=kept, corrections_error="")
        self.watchers.tell()

    def agreement(self, frame: int) -> MapAgreement | None:
        """Return how well places of a frame's photo agree with the map where it is laid.

        It is None where the photo is not laid, or could not be compared. A photo that a person has laid is compared at once.
        """
        view = self.view()
        located = view.flight.frames[frame]
        correction, answer = view.corrections.get(located.frame.name), located.stages.get("registration")
        if correction is None:
            return None if answer is None else answer.agreement
        return self._agreements.get((frame, correction), lambda: self._compare(view, frame))

    def _compare(self, view: FlightView, frame: int) -> MapAgreement | None:
        located, matrix = view.flight.frames[frame].frame, view.homography(frame)
        assert matrix is not None
        # Without a photo or a part of the map that cannot be read, it can still be laid.
        with suppress(DataError, PictureError):
            photo = located.undistorted(images.shrink(images.load_picture(located.file), _COMPARED))
            return map_agreement(view.flight.basemap, photo, matrix, (located.width, located.height))
        return None

    def positions(self, suffix: str) -> bytes:
        """Return one position a photo, that of its correction or of the stage that counts, as a track's file with a suffix."""
        view = self.view()
        frames = [replace(located, by_hand=None) for located in view.flight.frames]
        enter_corrections(view.flight.basemap, frames, view.corrections)
        return track_bytes(suffix, view.flight.flight.name, best_track(replace(view.flight, frames=frames)))

    def _read(self) -> tuple[dict[str, Correction], str]:
        try:
            return corrections.read_corrections(self.corrections_file), ""
        except LPNError as error:  # the window is useful without them
            return {}, str(error)
