"""Registration of visitors' own pictures on a workspace's map: one at a time, and in the background."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from explorer.compute.background_jobs import BackgroundJob, BackgroundJobs, ReportProgress
from lpn.core.numbers import distance
from lpn.core.resources import yield_cores
from lpn.flight.files import Frame
from lpn.flight.locate.grades import off_window, window_of
from lpn.flight.locate.ground import MapFeatures
from lpn.flight.locate.matchers import open_matchers
from lpn.flight.locate.options import TOP
from lpn.flight.locate.own_photo import OwnPhoto, register_own_photo
from lpn.flight.locate.verdict import judge
from lpn.flight.maps import Map, Window
from lpn.library.analyser import OwnPicture
from lpn.tasks.task import Task

# Seconds between two checks of whether a waiting registration is still wanted.
_PATIENCE = 0.1


@dataclass(frozen=True, eq=False)
class CameraPicture(OwnPicture):
    """An own picture with the camera's data from its file; `frame` is None if there is none."""

    frame: Frame | None = None


@dataclass(frozen=True, eq=False)
class _Turn:
    """A registration's place in a map's queue; `key` is the job's key."""

    key: str


class _Turns:
    """Lets one registration compute at a time, in the order of their start; registrations of shown pictures go first."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._waiting: list[_Turn] = []
        self._holder: _Turn | None = None
        # The keys of the pictures that clients show, by the client's id.
        self._shown: dict[int, str] = {}

    def show(self, client: object, key: str | None) -> None:
        """Note the picture that a client shows, or None."""
        with self._condition:
            self._shown.pop(id(client), None)
            if key is not None:
                self._shown[id(client)] = key

    def take(self, turn: _Turn, report: Callable[[], None]) -> None:
        """Wait for a turn; an exception of `report` ends the wait."""
        with self._condition:
            self._waiting.append(turn)
            try:
                while self._holder is not None or self._next() is not turn:
                    report()
                    self._condition.wait(_PATIENCE)
                self._holder = turn
            finally:
                self._waiting.remove(turn)

    def give_back(self, turn: _Turn) -> None:
        with self._condition:
            if self._holder is turn:
                self._holder = None
                self._condition.notify_all()

    def give_way(self, turn: _Turn, report: Callable[[], None]) -> None:
        """Let registrations of shown pictures go first, unless a browser shows this one's picture."""
        with self._condition:
            shown = self._shown.values()
            if turn.key in shown or not any(other.key in shown for other in self._waiting):
                return
            self._holder = None
            self._condition.notify_all()
        self.take(turn, report)

    def _next(self) -> _Turn:
        shown = self._shown.values()
        return next((turn for turn in self._waiting if turn.key in shown), self._waiting[0])


class OwnPhotoJobs:
    """Registers own pictures on a map; thread-safe.

    The key of a job is its picture's key, or a digest of pixels and camera data. Each job runs once for all clients, and is
    forgotten with its answer when its last client has left.

    Args:
        map_error: 1-sigma error of the map's places in metres, see `lpn.flight.locate.options.LocateOptions`.
    """

    def __init__(self, basemap: Map, map_error: float | None = None) -> None:
        self.basemap, self._map_error = basemap, map_error
        self._features: list[MapFeatures] = []
        self._turns = _Turns()
        self._jobs = BackgroundJobs()

    def join(self, picture: OwnPicture, windows: Sequence[Window], client: object) -> BackgroundJob[OwnPhoto]:
        """Return the job that registers a client's picture; it has ended already if another client has its answer.

        Args:
            windows: the most similar windows, see `register_own_photo`.
            client: must leave a job that it no longer needs; the last one to leave cancels it.
        """
        key = _key(picture)
        self._turns.show(client, key)
        return self._jobs.join(
            key, client, lambda report: self._register(_Turn(key), picture, windows, report), keep=False
        )

    def show_none(self, client: object) -> None:
        """Note that a client shows no own picture; its jobs go on."""
        self._turns.show(client, None)

    def leave(self, client: object) -> None:
        """Remove a client from all its jobs."""
        self._turns.show(client, None)
        self._jobs.leave(client)

    def _register(
        self, turn: _Turn, picture: OwnPicture, windows: Sequence[Window], report: ReportProgress
    ) -> OwnPhoto:
        yield_cores()  # registration takes seconds, and answers must not wait for it

        def on_progress(done: int, total: int) -> None:
            report(done, total)
            self._turns.give_way(turn, lambda: report(done, total))

        try:
            self._turns.take(turn, lambda: report(0, 0))
            if not self._features:
                self._features = [MapFeatures(self.basemap, matcher) for matcher in open_matchers()]
            return register_own_photo(
                self.basemap, self._features, picture.picture, _frame(picture), windows, on_progress, self._map_error
            )
        finally:
            self._turns.give_back(turn)


def likely_windows(task: Task, order: Sequence[int]) -> list[Window]:
    """Return the most similar windows of a map; on a large map, a photo is searched only there.

    Args:
        order: gallery positions, the nearest first.
    """
    return [window for index in order[:TOP] if (window := window_of(task, index)) is not None]


def mark(job: BackgroundJob[OwnPhoto], task: Task, answer: int) -> tuple[bool | None, str, str]:
    """Return the photo check's verdict on the nearest tile: a sign, a few words, and a sentence of the registration.

    Args:
        answer: gallery position of the nearest tile.
    """
    found = job.value
    if found is None:
        tries = f", try {job.done} of {job.total}" if job.total else ""
        return None, "not checked" if job.error else f"checking the map{tries}", job.error or ""
    why = found.answer.sentence
    if not found.answer.accepted:
        return None, "fits no place of the map" if found.whole_map else "fits none of the nearest tiles", why
    off = off_window(found.located, window_of(task, answer))
    if off is not None and off > 0:
        return False, f"fits the map {distance(off)} away", why
    sign = judge(found.located).sign
    return sign, "fits the map here" if sign else "fits the map here, in doubt", why


def _frame(picture: OwnPicture) -> Frame | None:
    return picture.frame if isinstance(picture, CameraPicture) else None


def _key(picture: OwnPicture) -> str:
    if picture.key:  # a stored JPEG of the picture has other pixels
        return picture.key
    digest = hashlib.sha256(picture.picture.tobytes())
    digest.update(repr((picture.picture.shape, _frame(picture))).encode("utf-8", "replace"))
    return digest.hexdigest()
