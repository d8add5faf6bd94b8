"""Keeps one browser's page up to date while the queries of the task that it shows are being ranked."""

from __future__ import annotations

import threading
from collections.abc import Callable

from explorer.compute.ranking_job import RankingJob

_OFTEN = 0.5
"""Seconds between two looks at how far it is."""


class RankingProgress:
    """Waits on a thread of its own for the rankings of the tasks that are shown, which begins them.

    Args:
        tell: shows how far a ranking is; called by one thread at a time.
        there: shows the page anew.
    """

    def __init__(self, tell: Callable[[RankingJob], None], there: Callable[[], None]) -> None:
        self._tell, self._there, self._lock = tell, there, threading.Lock()
        self._waiting: tuple[RankingJob, ...] = ()
        self._shown: RankingJob | None = None
        self._thread: threading.Thread | None = None
        self._left = False

    def follow(self, shown: RankingJob, other: RankingJob | None = None) -> None:
        """Wait for the ranking that is shown, then for another, and for no others."""
        rankings = [ranking for ranking in (shown, other) if ranking is not None]
        waiting = tuple(ranking for ranking in rankings if ranking.found is None and not ranking.flaw)
        with self._lock:
            if waiting == self._waiting or self._left:
                return
            for ranking in self._waiting:
                if ranking not in waiting:
                    ranking.leave(self)
            self._waiting, self._shown = waiting, shown
            if waiting and self._thread is None:
                self._thread = threading.Thread(target=self._loop, name="explorer-follower", daemon=True)
                self._thread.start()
            self._tell(shown)  # what the thread said last may have been of the ranking before

    def leave(self) -> None:
        """The browser is gone."""
        with self._lock:
            for ranking in self._waiting:
                ranking.leave(self)
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
                ranking = self._waiting[0]
                job = ranking.ask(self)
            ended = job.wait(_OFTEN) and not job.given_up
            with self._lock:
                if self._waiting[:1] != (ranking,):
                    continue
                if self._shown is ranking:
                    self._tell(ranking)
                if ended:
                    self._waiting = self._waiting[1:]
            if ended:
                self._there()
