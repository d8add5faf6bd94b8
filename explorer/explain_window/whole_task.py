"""The whole task with turned queries (Table IV), as one browser follows it in the tab "Turn, shift, zoom"."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from explorer.compute.background_jobs import BackgroundJob
from explorer.compute.turned_jobs import TurnedJobs
from explorer.compute.worker import Worker
from explorer.session_state import SessionState
from lpn.drawing.charts import TaskRecall
from lpn.tasks.changes import PAPER_TURNS, why_not
from lpn.tasks.task import Task

TurnChoice = Literal["this", "paper", "circle"]
# Seconds between two looks at a computation.
_INTERVAL = 0.4


@dataclass(frozen=True, eq=False)
class WholeTaskSection:
    """The tab's section about the whole task.

    Attributes:
        reason: why it has no figures, as a sentence; empty if it has.
        recalls: the figures that are known, by degrees.
        job: the job of this browser; None without one.
        queries: number of the task's queries.
    """

    reason: str
    recalls: Sequence[TaskRecall]
    job: BackgroundJob[None] | None
    queries: int

    @property
    def running(self) -> bool:
        """True while the job computes."""
        return self.job is not None and not self.job.wait(0)


class WholeTask:
    """One browser's request for a task with turned queries.

    Args:
        draw: draws the tab anew; called by a thread of its own.
    """

    def __init__(self, jobs: TurnedJobs, draw: Callable[[], None]) -> None:
        self._jobs, self._draw = jobs, draw
        self.task = ""
        self.job: BackgroundJob[None] | None = None
        self._worker = Worker(self._follow, lambda _: None)

    def measure(self, choice: TurnChoice, state: SessionState) -> None:
        """Compute the figures of turns, in place of what was asked before."""
        turns = {
            "this": (0.0, state.angle),
            "paper": PAPER_TURNS,
            "circle": tuple(float(angle) for angle in range(0, 360, 30)),
        }
        before, self.task = self.job, state.ranking_key
        self.job = self._jobs.join(self, state.ranking_key, turns[choice])
        if before is not None and before is not self.job:
            before.leave(self)
        self._worker.wake()

    def stop(self) -> None:
        """Cancel what was asked, unless another browser waits for it."""
        self._jobs.leave(self)
        self._worker.wake()

    def leave(self) -> None:
        """Stop all: the browser has left."""
        self._worker.stop()
        self._jobs.leave(self)

    def section(self, task: Task) -> WholeTaskSection:
        """Return what the tab says about a task."""
        job = self.job if self.task == task.key else None
        return WholeTaskSection(why_not(task), self._jobs.known(task.key), job, len(task.queries))

    def _follow(self) -> float | None:
        self._draw()
        return _INTERVAL if self.job is not None and not self.job.wait(0) else None
