"""The calibrated and CSLS scorings of a workspace, which are prepared once for all browsers."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock

from explorer.compute.background_jobs import BackgroundJob, BackgroundJobs, ReportProgress


class Scorings:
    """Prepares the further scorings of a workspace.

    Args:
        why_not: the reason why there can be none, in one sentence; otherwise empty.
        prepare: ranks all tasks under the further scorings, and puts them into the workspace.
    """

    def __init__(self, why_not: str = "", prepare: Callable[[ReportProgress], None] | None = None) -> None:
        self.why_not, self._prepare = why_not, prepare
        self._jobs, self._lock = BackgroundJobs(), Lock()

    @property
    def prepares(self) -> bool:
        """True if they can still be prepared."""
        return self._prepare is not None

    def prepare(self, client: object) -> BackgroundJob[None] | None:
        """Start or join the preparation, which may describe all pictures; None if there is nothing to prepare.

        Args:
            client: waits for the job; the last client that leaves cancels it.
        """
        with self._lock:
            if self._prepare is None:
                return None
            return self._jobs.join("prepare", client, self._work)

    def _work(self, report: ReportProgress) -> None:
        assert self._prepare is not None
        self._prepare(report)
        self._prepare = None
