"""Registration of visitors' own pictures on a workspace's map: one at a time, and in the background."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Sequence

from explorer.compute.background_jobs import BackgroundJob, BackgroundJobs, ReportProgress, in_turn
from lpn.analysis.analyser import OwnPicture
from lpn.core.resources import yield_cores
from lpn.locate.ground import MapFeatures
from lpn.locate.matchers import open_matchers
from lpn.locate.own_photo import OwnPhoto, register_own_photo
from lpn.maps import Map, Window

# Seconds between looks at the progress of a registration.
_INTERVAL = 0.5


class OwnPhotoJobs:
    """Registers own pictures on a map; thread-safe.

    A picture's job is known by its pixels and by what its file tells. It is computed once for all clients, and forgotten
    with its answer when the last of them has left it.
    """

    def __init__(self, basemap: Map) -> None:
        self.basemap = basemap
        self._features: list[MapFeatures] = []
        self._turn = threading.Lock()
        self._jobs = BackgroundJobs()

    def join(self, picture: OwnPicture, windows: Sequence[Window], client: object) -> BackgroundJob[OwnPhoto]:
        """Return the job that registers a picture; its answer is there at once if a client still holds it.

        Args:
            windows: the most similar ones, see `register_own_photo`.
            client: leaves the job when it needs it no longer; the last one to leave cancels it.
        """
        return self._jobs.join(
            _key(picture), client, lambda report: self._register(picture, windows, report), keep=False
        )

    def leave(self, client: object) -> None:
        """Remove a client from all its jobs."""
        self._jobs.leave(client)

    def _register(self, picture: OwnPicture, windows: Sequence[Window], report: ReportProgress) -> OwnPhoto:
        yield_cores()  # it takes seconds, and answers must not wait for it
        with in_turn(self._turn, report):
            if not self._features:
                self._features = [MapFeatures(self.basemap, matcher) for matcher in open_matchers()]
            error = self.basemap.default_error
            return register_own_photo(
                self.basemap, self._features, picture.picture, picture.frame, windows, error, report
            )


class OwnPhotoProgress:
    """Follows the registration of the own picture that one browser shows, and holds the answers of those before.

    Args:
        jobs: of the workspace; None where it has no map.
        on_change: called when it has gone on or ended, by a thread of its own.
    """

    def __init__(self, jobs: OwnPhotoJobs | None, on_change: Callable[[], None]) -> None:
        self._jobs, self._on_change, self._lock = jobs, on_change, threading.Lock()
        self._picture: OwnPicture | None = None
        self._job: BackgroundJob[OwnPhoto] | None = None
        self._closed = False

    def follow(self, picture: OwnPicture | None, windows: Sequence[Window] = ()) -> BackgroundJob[OwnPhoto] | None:
        """Return the job of a picture, which begins; an unfinished one of another picture is left.

        None without a picture or a map.
        """
        with self._lock:
            if picture is not self._picture and not self._closed:
                if self._job is not None and self._job.value is None:
                    self._job.leave(self)
                self._picture, self._job = picture, None
                if picture is not None and self._jobs is not None:
                    self._job = job = self._jobs.join(picture, windows, self)
                    threading.Thread(target=self._wait, args=(job,), name="explorer-own-photo", daemon=True).start()
            return self._job

    def close(self) -> None:
        """Leave all jobs for good: the browser has disconnected."""
        with self._lock:
            self._closed = True
            if self._jobs is not None:
                self._jobs.leave(self)
            self._picture = self._job = None

    def _wait(self, job: BackgroundJob[OwnPhoto]) -> None:
        done = -1
        while self._job is job:
            ended = job.wait(_INTERVAL)
            if self._job is job and (ended or job.done != done):
                done = job.done
                self._on_change()
            if ended:
                return


def _key(picture: OwnPicture) -> str:
    digest = hashlib.sha256(picture.picture.tobytes())
    digest.update(repr((picture.picture.shape, picture.frame)).encode("utf-8", "replace"))
    return digest.hexdigest()
