"""One worker per browser. The newest request wins: requests that come while it works become one."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from lpn.core.errors import LPNError

log = logging.getLogger(__name__)


class DelayedCall:
    """Calls `tell`, once, when it is not told within some seconds that what was waited for is there."""

    def __init__(self, seconds: float, tell: Callable[[], None]) -> None:
        self._tell, self._lock, self._there = tell, threading.Lock(), False
        self._timer = threading.Timer(seconds, self._late)
        self._timer.daemon = True
        self._timer.start()

    def there(self) -> None:
        """It is there: `tell` has been called by now, or never will be."""
        self._timer.cancel()
        with self._lock:
            self._there = True

    def _late(self) -> None:
        with self._lock:
            if not self._there:
                self._tell()


class Worker:
    """Runs `work` on a thread of its own after each `wake`, once for any number of wakes meanwhile.

    The thread is there from the first `wake` on.

    Args:
        work: reads the newest state itself; returns None, or the seconds after which it is run again unless it is woken before.
        failed: is told of an exception, and the worker goes on.
    """

    def __init__(self, work: Callable[[], float | None], failed: Callable[[Exception], None]) -> None:
        self._work, self._failed = work, failed
        self._requested, self._lock = threading.Event(), threading.Lock()
        self._stopped = False
        self._thread: threading.Thread | None = None

    def wake(self) -> None:
        """Ask for one more run with the newest state."""
        self._requested.set()
        with self._lock:
            if self._thread is None and not self._stopped:
                thread = threading.Thread(target=self._loop, name="explorer-worker", daemon=True)
                thread.start()
                self._thread = thread  # not before: where there can be no more threads, the next `wake` tries again

    def stop(self) -> None:
        """End the thread after the run in progress."""
        with self._lock:
            self._stopped = True
        self._requested.set()

    def _loop(self) -> None:
        again: float | None = None
        while True:
            self._requested.wait(again)
            self._requested.clear()
            if self._stopped:
                return
            again = None
            try:
                again = self._work()
            except Exception as error:
                if self._stopped:
                    return
                if isinstance(error, LPNError):  # of which one sentence says all
                    log.warning("A browser's request failed: %s", error)
                else:
                    log.exception("A browser's request failed")
                self._failed(error)
