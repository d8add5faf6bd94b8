"""Figures of whole tasks under part weights, computed one at a time in the background and kept for all browsers."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence

from explorer.compute.background_jobs import BackgroundJob, BackgroundJobs, ReportProgress, in_turn
from lpn.analysis.part_weights import WeightedTask, WeightEffect, part_combinations, weights_of
from lpn.core.resources import yield_cores
from lpn.retrieval import scoring
from lpn.tasks.task import Task

# Number of weightings whose figures are kept.
_KEPT = 1024
# Number of tasks whose part products are kept: each may take hundreds of megabytes.
_MEASURED = 2

_Key = tuple[str, bytes]


class WeightFigures:
    """The figures of the tasks of a workspace under part weights. Thread-safe.

    A job ends early when the last browser that waits for it has left.

    Args:
        task: returns a task by its key; each that is asked for must have figures, see `part_weights.why_not`.
    """

    def __init__(self, task: Callable[[str], Task]) -> None:
        self._task, self._jobs = task, BackgroundJobs()
        self._measured: dict[str, WeightedTask] = {}
        self._known: OrderedDict[_Key, WeightEffect] = OrderedDict()
        # One computation takes all cores, and `WeightedTask` is not thread-safe.
        self._lock, self._turn = threading.Lock(), threading.Lock()

    def known(self, task: str, weights: Sequence[float]) -> WeightEffect | None:
        """Return the figures under part weights, (n,); None until they are computed."""
        with self._lock:
            return self._known.get(self._key(task, weights))

    def join(self, client: object, task: str, weights: Sequence[float]) -> BackgroundJob[WeightEffect]:
        """Start to compute the figures under part weights, or join who does; the client should leave the job before."""
        key = self._key(task, weights)

        def work(report: ReportProgress) -> WeightEffect:
            yield_cores()
            return self._compute(task, weights, report)

        return self._jobs.join(key, client, work, keep=False, again=True)

    def join_all(self, client: object, tasks: Sequence[str]) -> BackgroundJob[None]:
        """Compute the figures of all combinations of parts of some tasks, see `part_weights.part_combinations`.

        The job's progress counts combinations; what is computed already is kept when it is cancelled.
        """
        key = ("all", *tasks)

        def work(report: ReportProgress) -> None:
            yield_cores()
            n = self._task(tasks[0]).contract.n_parts
            combined = [(task, weights_of(parts, n)) for parts in part_combinations(n) for task in tasks]
            for done, (task, weights) in enumerate(combined):
                report(done, len(combined))
                self._compute(task, weights, lambda *_, done=done: report(done, len(combined)))
            report(len(combined), len(combined))

        return self._jobs.join(key, client, work, keep=False, again=True)

    def leave(self, client: object) -> None:
        """Remove a client from the jobs that it waits for."""
        self._jobs.leave(client)

    def _compute(self, task: str, weights: Sequence[float], report: ReportProgress) -> WeightEffect:
        key = self._key(task, weights)
        with in_turn(self._turn, report):
            effect = self.known(task, weights)
            if effect is None:
                if task not in self._measured:
                    for before in list(self._measured)[: 1 - _MEASURED]:
                        del self._measured[before]
                    self._measured[task] = WeightedTask(self._task(task))
                effect = self._measured[task].effect(weights, report)
                with self._lock:
                    self._known[key] = effect
                    if len(self._known) > _KEPT:
                        self._known.popitem(last=False)
            return effect

    def _key(self, task: str, weights: Sequence[float]) -> _Key:
        """Return a key that is the same for equal proportions."""
        return task, scoring.part_weights(len(weights), weights).tobytes()
