"""The mean share of activation in the centre over pictures of a test set, computed while a browser waits for it."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from random import Random

from explorer.compute.background_jobs import BackgroundJob, BackgroundJobs, ReportProgress
from lpn.core.views import View
from lpn.datasets import Picture
from lpn.descriptors.weather import CLEAR, Weather
from lpn.explain.centre import centre_shares
from lpn.models.base import Model

# The size of the random sample of a larger test set; it leaves the mean uncertain by about 0.1 %.
MOST = 2000


class CentreMean:
    """A mean that improves picture by picture. Thread-safe.

    It is computed on a thread of its own while a client waits for it, and goes on where it stopped.

    Args:
        model: computes in the background.
        pictures: of one view; they are described in random order, so that the mean of the first ones is a fair guess.
        weather: drawn on each picture.

    Attributes:
        total: number of pictures that are described.
        pictures: number of pictures of the test set.
    """

    def __init__(self, model: Model, pictures: Sequence[Picture], view: View, weather: Weather = CLEAR) -> None:
        self._model, self._view, self._weather, self.pictures = model, view, weather, len(pictures)
        self._sample = [pictures[i] for i in Random(0).sample(range(len(pictures)), min(MOST, len(pictures)))]
        self.total = len(self._sample)
        self._shares: list[float] = []
        self._jobs, self._compute_lock = BackgroundJobs(), threading.Lock()
        self._job: BackgroundJob[None] | None = None

    @property
    def done(self) -> int:
        """Number of described pictures."""
        return len(self._shares)

    @property
    def percent(self) -> float | None:
        """The mean over the described pictures in percent; None before the first."""
        shares = self._shares[:]
        return 100 * sum(shares) / len(shares) if shares else None

    @property
    def error(self) -> str:
        """One sentence if a picture could not be described, else empty."""
        job = self._job
        return "" if job is None or job.cancelled else job.error or ""

    @property
    def pending(self) -> bool:
        """Some pictures are still to be described, and can be."""
        return self.done < self.total and not self.error

    def join(self, client: object) -> None:
        """Start or resume the computation for a client; it pauses when all clients have left."""
        self._job = self._jobs.join("mean", client, self._compute)

    def leave(self, client: object) -> None:
        """Remove a client."""
        self._jobs.leave(client)

    def _compute(self, report: ReportProgress) -> None:
        with self._compute_lock:  # a cancelled job may still be describing its last batch
            for share in centre_shares(self._model, self._sample[self.done :], self._view, self._weather):
                self._shares.append(share)
                report(self.done, self.total)
