"""What became of all queries of a task: known at once where that is quick, else ranked once for all browsers, meanwhile."""

from __future__ import annotations

import os
import sys
import threading
from dataclasses import dataclass

from explorer.compute.background_jobs import BackgroundJob, BackgroundJobs, ReportProgress
from lpn.analysis import ranking_cache
from lpn.analysis.ranking_cache import ResumableRanking
from lpn.analysis.task import Task
from lpn.core.arrays import Int64Array
from lpn.core.errors import LPNError
from lpn.retrieval.evaluate import error_shares
from lpn.retrieval.metrics import Retrieval

QUICK = 20_000_000_000
"""Multiplications that are done before the first page is served: half a second of two cores."""


@dataclass(frozen=True, eq=False)
class TaskRanking:
    """What became of all queries of a task.

    Attributes:
        ranking: of the gallery for each.
        results: recall and AP in percent, see `lpn.retrieval.metrics.evaluate`; with positions, `median error m` and more.
    """

    ranking: Retrieval
    results: dict[str, float]


class RankingJob:
    """The ranking of a task's queries; thread-safe."""

    def __init__(self, task: Task) -> None:
        self.task = task
        self._ranking, self._jobs, self._turn = ResumableRanking(task), BackgroundJobs(), threading.Lock()
        self._job: BackgroundJob[TaskRanking] | None = None
        self.found: TaskRanking | None = None
        """None until all are ranked."""

    def begin(self) -> None:
        """Rank at once where that is quick, and take what is kept of another time; InputError when that cannot be done."""
        if ranking_cache.cost(self.task) <= QUICK:
            self.found = self._told(self._ranking.finish(lambda *_: None))
        elif (cached := ranking_cache.load(self.task)) is not None:
            self.found = self._told(cached)

    @property
    def ranks(self) -> Int64Array:
        """0-based rank of each query's first true match, -1 without one, (Q,); only when the task is ranked."""
        assert self.found is not None
        return self.found.ranking.first

    @property
    def results(self) -> dict[str, float]:
        """See `TaskRanking`; only when the task is ranked."""
        assert self.found is not None
        return self.found.results

    @property
    def done(self) -> int:
        """How many queries are ranked."""
        job = self._job
        return 0 if job is None else job.done

    @property
    def flaw(self) -> str:
        """Why they cannot be ranked; empty where they can."""
        job = self._job
        return "" if job is None or job.given_up else job.flaw or ""

    def ask(self, who: object) -> BackgroundJob[TaskRanking]:
        """Wait for the ranking, begun or gone on with; a ranking that nobody waits for stands still."""
        self._job = job = self._jobs.ask("ranking", who, self._rank)
        return job

    def leave(self, who: object) -> None:
        """Wait for it no longer."""
        self._jobs.leave(who)

    def wait(self, who: object, progress: ReportProgress) -> TaskRanking:
        """What became of the queries, waited for.

        Args:
            progress: told how many are ranked, and of how many; what it raises ends the waiting.

        Raises:
            LPNError: when they cannot be ranked; who waits next begins anew.
        """
        try:
            while self.found is None:
                job = self.ask(who)
                if not job.wait(0.2):
                    progress(job.done, job.total)
                elif job.flaw is not None and not job.given_up:
                    self._jobs.forget("ranking")
                    raise LPNError(job.flaw)
        finally:
            self.leave(who)
        return self.found

    def _rank(self, progress: ReportProgress) -> TaskRanking:
        if sys.platform == "linux":  # there, a thread has a niceness of its own: what a browser asks for goes first
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 5)
        with self._turn:  # one that was given up may still be at its last block
            ranking = self._ranking.finish(progress)
        ranking_cache.save(self.task, ranking)
        self.found = self._told(ranking)
        return self.found

    def _told(self, ranking: Retrieval) -> TaskRanking:
        near: dict[str, float] = {}
        if self.task.geometry is not None:
            near = error_shares(self.task.geometry.answer_errors_m(ranking.best))
        return TaskRanking(ranking, ranking.figures() | near)
