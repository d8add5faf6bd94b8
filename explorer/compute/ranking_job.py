"""The ranking of all queries of a task, shared by all browsers: a quick one at once, a long one in the background."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from explorer.compute.background_jobs import BackgroundJob, BackgroundJobs, ReportProgress
from lpn.core.arrays import BoolArray, Float64Array, Int64Array
from lpn.core.errors import LPNError
from lpn.retrieval import metrics
from lpn.retrieval.metrics import Retrieval
from lpn.tasks.measure import error_shares
from lpn.tasks.task import Task

# A ranking of up to this many multiplications (half a second on two cores) is computed before the app starts.
QUICK_COST = 20_000_000_000


@dataclass(frozen=True, eq=False)
class TaskRanking:
    """The ranks of all queries of a task.

    Attributes:
        ranking: ranks and best matches by query.
        errors: metres from each query to its answer, (Q,), NaN where the place is unknown; None without a geometry.
        known: the queries of a known place, (Q,), or None for all.
    """

    ranking: Retrieval
    errors: Float64Array | None
    known: BoolArray | None

    def measured(self, counted: BoolArray | None) -> dict[str, float]:
        """Return recall and AP in percent, see `lpn.retrieval.metrics.evaluate`, and the values of `error_shares`.

        Args:
            counted: the queries that count, (Q,), or None for all. Queries of unknown error count in recall and AP alone.
        """
        figures = self.ranking.metrics(counted)
        if self.errors is None:
            return figures
        errors = self.errors if counted is None else self.errors[counted]
        placed = ~np.isnan(errors)
        return figures | error_shares(errors[placed]) if placed.any() else figures

    @cached_property
    def results(self) -> dict[str, float]:
        """Return the figures of all queries of a known place, see `measured`."""
        return self.measured(self.known)


class RankingJob:
    """Ranks the gallery for each query of a task. Thread-safe.

    A long ranking runs in the background, and only while a client waits for it.

    Attributes:
        task: the ranked task.
        result: None until all queries are ranked.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        self.result: TaskRanking | None = None
        self._jobs, self._rank_lock = BackgroundJobs(), threading.Lock()
        self._job: BackgroundJob[TaskRanking] | None = None

    def start(self) -> None:
        """Rank at once if that is quick.

        Raises:
            InputError: when the task cannot be ranked.
        """
        if self.task.query_descriptors.size * self.task.tiles <= QUICK_COST:
            self.result = self._rank()

    @property
    def ranks(self) -> Int64Array:
        """0-based rank of each query's first true match, -1 without one, (Q,); only when the task is ranked."""
        assert self.result is not None
        return self.result.ranking.first

    @property
    def failed(self) -> BoolArray:
        """The queries that Recall@1 counts as missed, (Q,), see `Outcomes.failed`; only when the task is ranked."""
        known = self.task.known
        return np.asarray((self.ranks != 0) & (True if known is None else known))

    @property
    def results(self) -> dict[str, float]:
        """See `TaskRanking.results`; only when the task is ranked."""
        assert self.result is not None
        return self.result.results

    @property
    def n_ranked(self) -> int:
        """Number of ranked queries."""
        return 0 if self._job is None else self._job.done

    @property
    def error(self) -> str:
        """One sentence if the ranking failed, else empty."""
        job = self._job
        return "" if job is None or job.cancelled else job.error or ""

    def join(self, client: object) -> BackgroundJob[TaskRanking]:
        """Start the ranking for a client, or join it; it stops when all clients have left."""
        self._job = job = self._jobs.join("ranking", client, self._rank)
        return job

    def leave(self, client: object) -> None:
        """Remove a client."""
        self._jobs.leave(client)

    def wait(self, client: object, report: ReportProgress) -> TaskRanking:
        """Wait for the result.

        Args:
            report: called with the numbers of ranked and of all queries; an exception that it raises ends the wait.

        Raises:
            LPNError: when the ranking failed; the next call tries again.
        """
        try:
            while self.result is None:
                job = self.join(client)
                if not job.wait(0.2):
                    report(job.done, job.total)
                elif job.error is not None and not job.cancelled:
                    raise LPNError(job.error)
        finally:
            self.leave(client)
        return self.result

    def _rank(self, report: ReportProgress = lambda *_: None) -> TaskRanking:
        task, (queries, gallery) = self.task, self.task.compared
        with self._rank_lock:  # a cancelled job may still be computing its last block
            report(0, len(queries))
            ranking = metrics.retrieve(
                queries, task.query_labels, gallery, task.gallery_labels, task.truth, progress=report
            )
        errors = None if task.geometry is None else task.geometry.answer_errors_m(ranking.best)
        self.result = TaskRanking(ranking, errors, task.known)
        return self.result
