"""Keeps one browser's page up to date while the queries of the task that it shows are being ranked."""

from __future__ import annotations

import threading
from collections.abc import Callable

from explorer.workspace import Task

_OFTEN = 0.5
"""Seconds between two looks at how far it is."""


class RankingProgress:
    """Waits on a thread of its own for the rankings of the tasks that are shown, which begins them.

    Args:
        tell: shows how far a task's ranking is; called by one thread at a time.
        there: shows the page anew.
    """

    def __init__(self, tell: Callable[[Task], None], there: Callable[[], None]) -> None:
        self._tell, self._there, self._lock = tell, there, threading.Lock()
        self._waiting: tuple[Task, ...] = ()
        self._shown: Task | None = None
        self._thread: threading.Thread | None = None
        self._left = False

    def follow(self, shown: Task, other: Task | None = None) -> None:
        """Wait for the task that is shown, then for another, and for no others."""
        tasks = [task for task in (shown, other) if task is not None]
        waiting = tuple(task for task in tasks if task.found is None and not task.standing.flaw)
        with self._lock:
            if waiting == self._waiting or self._left:
                return
            for task in self._waiting:
                if task not in waiting:
                    task.standing.leave(self)
            self._waiting, self._shown = waiting, shown
            if waiting and self._thread is None:
                self._thread = threading.Thread(target=self._loop, name="explorer-follower", daemon=True)
                self._thread.start()
            self._tell(shown)  # what the thread said last may have been of the task before

    def leave(self) -> None:
        """The browser is gone."""
        with self._lock:
            for task in self._waiting:
                task.standing.leave(self)
            self._waiting, self._left = (), True

    def _loop(self) -> None:
        try:
            self._wait()
        except BaseException:
            with self._lock:
                self._waiting, self._thread = (), None
            raise

    def _wait(self) -> None:
        while True:
            with self._lock:
                if not self._waiting:
                    self._thread = None
                    return
                task = self._waiting[0]
                job = task.standing.ask(self)
            ended = job.wait(_OFTEN) and not job.given_up
            with self._lock:
                if self._waiting[:1] != (task,):
                    continue
                if self._shown is task:
                    self._tell(task)
                if ended:
                    self._waiting = self._waiting[1:]
            if ended:
                self._there()
