"""Updates one browser's page while the queries of its tasks are being ranked."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

from explorer.compute.ranking_job import RankingJob

_INTERVAL = 0.5  # seconds between progress reports


class RankingProgress:
    """Waits on its own thread for the rankings that a page needs, and thereby starts them.

    Args:
        on_progress: shows the progress of a ranking; never called by two threads at a time.
        on_done: called after each ranking that the page draws; it shows the page anew.
    """

    def __init__(self, on_progress: Callable[[RankingJob], None], on_done: Callable[[], None]) -> None:
        self._on_progress, self._on_done, self._lock = on_progress, on_done, threading.Lock()
        self._pending: tuple[RankingJob, ...] = ()
        self._followed: RankingJob | None = None
        self._figures: frozenset[RankingJob] = frozenset()
        self._thread: threading.Thread | None = None
        self._closed = False

    def follow(self, main: RankingJob, *others: RankingJob, figures: Sequence[RankingJob] = ()) -> None:
        """Wait for the ranking that the page shows, then for others one by one, and for no further ones.

        Args:
            figures: waited for after the others; the page shows their results alone, beside those of `main`.
        """
        all_of_them = (main, *others, *figures)
        pending = tuple(ranking for ranking in all_of_them if ranking.result is None and not ranking.error)
        with self._lock:
            if self._closed:
                return
            self._figures = frozenset(figures) - {main, *others}
            if (pending, main) == (self._pending, self._followed):
                return
            for ranking in self._pending:
                if ranking not in pending:
                    ranking.leave(self)
            self._pending, self._followed = pending, main
            if pending and self._thread is None:
                self._thread = threading.Thread(target=self._loop, name="explorer-ranking", daemon=True)
                self._thread.start()
            self._on_progress(main)  # the thread's last report may be about another ranking

    def close(self) -> None:
        """Stop waiting for good: the browser has left."""
        with self._lock:
            for ranking in self._pending:
                ranking.leave(self)
            self._pending, self._closed = (), True

    def _loop(self) -> None:
        try:
            self._wait()
        except BaseException:
            with self._lock:
                self._pending, self._thread = (), None
            raise

    def _wait(self) -> None:
        while True:
            with self._lock:
                if not self._pending:
                    self._thread = None
                    return
                ranking = self._pending[0]
                job = ranking.join(self)
            ended = job.wait(_INTERVAL) and not job.cancelled
            with self._lock:
                if self._pending[:1] != (ranking,):
                    continue
                figures_alone = ranking in self._figures
                if self._followed is not None and (self._followed is ranking or (ended and figures_alone)):
                    self._on_progress(self._followed)
                if ended:
                    self._pending = self._pending[1:]
            if ended and not figures_alone:
                self._on_done()
