"""A worker thread for the newest request of a browser."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from lpn.core.errors import LPNError

log = logging.getLogger(__name__)


class Worker:
    """Runs `work` on its own thread after each `wake`; several wakes during a run lead to one more run.

    Args:
        work: function that reads the newest state; it returns the seconds until its next run, or None to wait for `wake`.
        on_error: called with an exception of `work`; the worker continues.
    """

    def __init__(
        self, work: Callable[[], float | None], on_error: Callable[[Exception], None] = lambda _: None
    ) -> None:
        self._work, self._on_error = work, on_error
        self._requested, self._lock = threading.Event(), threading.Lock()
        self._stopped = False
        self._thread: threading.Thread | None = None

    def wake(self) -> None:
        """Request a run; the first call starts the thread."""
        self._requested.set()
        with self._lock:
            if self._thread is None and not self._stopped:
                thread = threading.Thread(target=self._loop, name="explorer-worker", daemon=True)
                thread.start()
                # `start` may fail for lack of threads. Then `_thread` stays None, and the next `wake` tries again.
                self._thread = thread

    def stop(self) -> None:
        """End the thread after the current run."""
        with self._lock:
            self._stopped = True
        self._requested.set()

    def _loop(self) -> None:
        delay: float | None = None
        while True:
            self._requested.wait(delay)
            self._requested.clear()
            if self._stopped:
                return
            delay = None
            try:
                delay = self._work()
            except Exception as error:
                if self._stopped:
                    return
                if isinstance(error, LPNError):  # the message is enough, without a traceback
                    log.warning("A browser's request failed: %s", error)
                else:
                    log.exception("A browser's request failed")
                self._on_error(error)
