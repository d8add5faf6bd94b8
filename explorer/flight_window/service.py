"""The view of a workspace's flight, derived once for all browsers, and a person's corrections of its frames."""

from __future__ import annotations

import threading
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from explorer.compute.background_jobs import BackgroundJob, ReportProgress, in_turn
from explorer.compute.watchers import Watchers
from explorer.workspace import Workspace
from lpn.core import images
from lpn.core.arrays import Float64Array
from lpn.core.demo import own_file, own_file_place
from lpn.core.errors import DataError, LPNError, PictureError
from lpn.core.resources import yield_cores
from lpn.locate import corrections
from lpn.locate.agreement import MapAgreement, map_agreement
from lpn.locate.belief import Belief, Disagreement, beliefs, best_track, disagreements
from lpn.locate.corrections import Correction
from lpn.locate.coverage import Outline, outline
from lpn.locate.located import LocatedFlight
from lpn.locate.tags import enter_corrections
from lpn.locate.tracks import track_bytes

# Longer side in pixels of a photo that is compared with the map.
_COMPARED = 960
# Photos of a flight that are compared with the map for its accuracy, at most.
_MOST_COMPARED = 40


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
    contradictions: list[Disagreement]
    beliefs: list[Belief]
    corrections: dict[str, Correction]
    corrections_error: str = ""

    @classmethod
    def of(cls, flight: LocatedFlight, kept: dict[str, Correction], error: str) -> FlightView:
        """Derive the view of a flight with its corrections, or with the reason why they cannot be used."""
        pairs = disagreements(flight.frames)
        verdicts = beliefs(flight.frames, pairs)
        return cls(flight, [outline(located) for located in flight.frames], pairs, verdicts, kept, error)

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
        watchers: are told of each correction, and of each photo that is compared with the map.
    """

    def __init__(self, workspace: Workspace) -> None:
        self._workspace, self._lock = workspace, threading.RLock()
        self.watchers = Watchers()
        self._view: FlightView | None = None
        # By the frame and the matrix that lays its photo over the map.
        self._agreements: dict[tuple[int, bytes], MapAgreement | None] = {}
        # The frames on which clients stand, by the client's id.
        self._stands: dict[int, int | None] = {}
        self._comparison: BackgroundJob[None] | None = None
        # A job may begin while a cancelled one compares its last photo.
        self._turn = threading.Lock()

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
                self._view = FlightView.of(flight, *self._read())
            return self._view

    def correct(self, frame: int, corners: Float64Array | None) -> None:
        """Keep a frame's correction on disk, for all browsers; None removes it.

        Args:
            corners: of the picture in metres of the map's frame, (4, 2).

        Raises:
            LPNError: when the corners are not those of a picture, or the file cannot be written; then nothing has changed.
        """
        with self._lock:  # otherwise an older state of the file could be assigned last
            view = self.view()
            name, basemap = view.flight.frames[frame].frame.name, view.flight.basemap
            correction = None if corners is None else Correction.of(corners, basemap.frame)
            kept = corrections.set_correction(self.corrections_file, name, correction)
            self._view = replace(view, corrections=kept, corrections_error="")
        self.watchers.tell()

    def agreement(self, frame: int) -> MapAgreement | None:
        """Return how well places of a frame's photo agree with the map where it is laid.

        It is None until `compare` has measured it, and where the photo is not laid or not readable.
        """
        matrix = self.view().homography(frame)
        return None if matrix is None else self._agreements.get((frame, matrix.tobytes()))

    def agreements(self) -> list[MapAgreement]:
        """Return how photos of the flight, laid ones at even steps, agree with the map; none before all of them are compared."""
        frames = self._compared_frames()
        if any(map(self._is_missing, frames)):
            return []
        return [agreement for agreement in map(self.agreement, frames) if agreement is not None]

    def compare(self, client: object, frame: int | None) -> BackgroundJob[None] | None:
        """Compare photos with the map in the background: those on which browsers stand, then those of `agreements`.

        One job does so for all browsers, and `watchers` are told of each photo. It ends early when all clients have left; then
        the photo in progress is still compared.

        Args:
            frame: the client stands on it; None for no frame.

        Returns:
            The job; None if nothing is left to compare.
        """
        with self._lock:
            self._stands[id(client)] = frame
            if self._next_compared() is None:
                return None
            if self._comparison is None or not self._comparison.join(client):
                self._comparison = BackgroundJob(self._compare, client)
            return self._comparison

    def leave(self, client: object) -> None:
        """Compare no photo for a client any more."""
        with self._lock:
            self._stands.pop(id(client), None)
            if self._comparison is not None:
                self._comparison.leave(client)

    def _compare(self, report: ReportProgress) -> None:
        yield_cores()
        with in_turn(self._turn, report):
            while True:
                with self._lock:
                    if (frame := self._next_compared()) is None:
                        self._comparison = None  # under the lock, so that no client joins a job that ends
                        return
                report(0, 0)
                self._compare_photo(frame)
                self.watchers.tell()

    def _compare_photo(self, frame: int) -> None:
        view = self.view()
        located, matrix = view.flight.frames[frame].frame, view.homography(frame)
        if matrix is None:  # its correction was removed meanwhile
            return
        agreement = None
        # Without a photo that cannot be read, the others can still be compared.
        with suppress(DataError, PictureError):
            photo = located.undistorted(images.shrink(images.load_picture(located.file), _COMPARED))
            agreement = map_agreement(view.flight.basemap, photo, matrix, (located.width, located.height))
        self._agreements[frame, matrix.tobytes()] = agreement

    def _next_compared(self) -> int | None:
        stands = (frame for frame in self._stands.values() if frame is not None)
        return next(filter(self._is_missing, chain(stands, self._compared_frames())), None)

    def _is_missing(self, frame: int) -> bool:
        matrix = self.view().homography(frame)
        return matrix is not None and (frame, matrix.tobytes()) not in self._agreements

    def _compared_frames(self) -> list[int]:
        view = self.view()
        laid = [i for i in range(len(view.flight.frames)) if view.homography(i) is not None]
        return laid[:: -(-len(laid) // _MOST_COMPARED) or 1]

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
