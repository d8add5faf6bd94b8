"""Figures of whole tasks with turned queries, computed by one job at a time in the background and kept for all browsers."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

from explorer.compute.background_jobs import BackgroundJob, BackgroundJobs, ReportProgress, in_turn
from lpn.core.progress import counted_among
from lpn.core.resources import yield_cores
from lpn.drawing.charts import TaskRecall
from lpn.tasks.changes import turned
from lpn.tasks.task import Task


class TurnedJobs:
    """The figures of the tasks of a workspace with turned queries. Thread-safe.

    One job runs at a time; browsers that ask for the same turns share it, and others wait. It ends early when the last one has
    left; what it has described is kept in the cache of descriptors.

    Args:
        task: returns a task by its key, with the model that describes queries in the background; each that is asked for must have
            figures, see `changes.why_not`.
    """

    def __init__(self, task: Callable[[str], Task]) -> None:
        self._task, self._jobs = task, BackgroundJobs()
        self._known: dict[tuple[str, float], TaskRecall] = {}
        self._lock, self._turn = threading.Lock(), threading.Lock()

    def known(self, task: str) -> list[TaskRecall]:
        """Return the figures of a task that are computed so far, by degrees."""
        with self._lock:
            return sorted(
                (one for (name, _), one in self._known.items() if name == task), key=lambda figures: figures.degrees
            )

    def join(self, client: object, task: str, turns: Sequence[float]) -> BackgroundJob[None]:
        """Compute the figures of turns, in degrees counter-clockwise, or join who does.

        The job's progress counts queries of all turns; it is (0, 0) while the job waits for another one.
        """
        turns = tuple(dict.fromkeys(float(degrees % 360) for degrees in turns))
        key = task, turns

        def work(report: ReportProgress) -> None:
            yield_cores()
            with in_turn(self._turn, report):
                self._compute(task, turns, report)

        return self._jobs.join(key, client, work, keep=False, again=True)

    def leave(self, client: object) -> None:
        """Remove a client from the jobs that it waits for."""
        self._jobs.leave(client)

    def _compute(self, name: str, turns: Sequence[float], report: ReportProgress) -> None:
        task = self._task(name)
        with self._lock:
            missing = [degrees for degrees in turns if (name, degrees) not in self._known]
        queries, described = len(task.queries), 0
        total = queries * sum(degrees != 0 for degrees in missing)  # upright queries are described already
        for degrees in missing:
            report(described, total)
            with counted_among(described, total):
                figures = turned(task, degrees).with_fields(weights=None).metrics
            described += queries if degrees else 0
            with self._lock:
                self._known[name, degrees] = TaskRecall(degrees, figures["recall@1"], figures["ap"])
        report(total, total)
