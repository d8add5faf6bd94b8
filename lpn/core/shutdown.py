"""Stopping on Ctrl-C and SIGTERM: finish the files being written, print one sentence, and exit within two seconds.

The first signal raises KeyboardInterrupt in the main thread. If that thread is writing a file, the exception comes when
the file is complete. The process exits at once after a second signal, or if the command has not ended two seconds after
the first. Files on the disk are complete at any moment (see `lpn.core.files.write_atomic`).
"""

from __future__ import annotations

import multiprocessing
import os
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

# Seconds after the first signal within which a command should end by itself.
GRACE = 2.0
# Further seconds to wait for file writes in progress.
WRITE_SECONDS = 10.0
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class _Writes:
    """The file writes in progress in any thread of this process.

    Attributes:
        depth: nesting depth of writes in the main thread.
        stop_pending: True if a signal arrived during a write of the main thread.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._count = 0
        self.depth = 0
        self.stop_pending = False

    def begin(self) -> None:
        with self._changed:
            self._count += 1

    def end(self) -> None:
        with self._changed:
            self._count -= 1
            self._changed.notify_all()

    def wait(self, seconds: float) -> bool:
        with self._changed:
            return self._changed.wait_for(lambda: not self._count, seconds)


# Global, as signal handlers are per process.
_WRITES = _Writes()


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay a stop until the block ends, so that files that belong together are all written.

    Raises:
        KeyboardInterrupt: at the end of the block in the main thread, if the process was asked to stop.
    """
    main = threading.current_thread() is threading.main_thread()
    if main:
        _WRITES.depth += 1
    _WRITES.begin()
    try:
        yield
    finally:
        _WRITES.end()
        if main:
            _WRITES.depth -= 1
            if not _WRITES.depth and _WRITES.stop_pending:
                _WRITES.stop_pending = False
                raise KeyboardInterrupt


def writes_finished(seconds: float) -> bool:
    """Wait until no file is being written; return False if `seconds` were not enough."""
    return _WRITES.wait(seconds)


class StopSignals:
    """The signals that stop a command.

    Args:
        report: prints that the command was stopped by a signal, and returns the exit status.

    Attributes:
        signal: the first signal received; 0 before.
    """

    def __init__(self, report: Callable[[int], int]) -> None:
        self.signal = 0
        self._report, self._reported = report, threading.Lock()
        self._raised = False
        self._wakeup, self._watched = socket.socketpair()
        self._wakeup.setblocking(False)
        self._over = threading.Event()

    def end(self) -> int:
        """Report the stop and return the exit status; if several threads call this, only the first one reports."""
        if not self._reported.acquire(blocking=False):
            threading.Event().wait(GRACE)  # the other thread is about to exit the process
        return self._report(self.signal or signal.SIGINT)

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Handle signals inside the context; has no effect outside of the main thread."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, self._handle) for number in SIGNALS}
        # Python runs its handlers only between bytecodes; the wake-up socket is written at once.
        old_wakeup = signal.set_wakeup_fd(self._wakeup.fileno(), warn_on_full_buffer=False)
        watcher = threading.Thread(target=self._watch, name="lpn-stopping", daemon=True)
        watcher.start()
        try:
            yield
        finally:
            signal.set_wakeup_fd(old_wakeup)
            for number, handler in before.items():
                signal.signal(number, handler)
            self._over.set()
            self._wakeup.send(b"\0")
            watcher.join()
            self._wakeup.close()
            self._watched.close()

    def _handle(self, number: int, _: FrameType | None) -> None:
        self.signal = self.signal or number
        if self._raised:
            return
        self._raised = True
        if _WRITES.depth:
            _WRITES.stop_pending = True
        else:
            raise KeyboardInterrupt

    def _watch(self) -> None:
        first = self._next(None)
        if first is None:
            return
        self.signal = self.signal or first
        second = self._next(GRACE)
        until = time.monotonic() + WRITE_SECONDS
        while second is None and not self._over.is_set() and time.monotonic() < until and not writes_finished(0):
            second = self._next(0.05)
        if not self._over.is_set():
            exit_now(128 + self.signal, self.end if second is None else None)

    def _next(self, seconds: float | None) -> int | None:
        """Return the next stop signal; None if none arrives in time or the command ends."""
        until = None if seconds is None else time.monotonic() + seconds
        while True:
            left = None if until is None else max(until - time.monotonic(), 0)
            if not select.select([self._watched], [], [], left)[0]:
                return None
            number = self._watched.recv(1)[0]
            if self._over.is_set():
                return None
            if number in SIGNALS:
                return number


def exit_now(status: int, report: Callable[[], int] | None = None) -> None:
    """Exit the process and its child processes at once, whatever its threads are doing.

    Args:
        report: called first, for half a second at most; its result replaces `status`.
    """
    statuses = [status]

    def tidy() -> None:
        with suppress(Exception):  # the terminal may be closed
            for child in multiprocessing.active_children():
                child.kill()
            if report is not None:
                statuses.append(report())
            # Neither `plain_streams` nor a running bar wraps these.
            for stream in filter(None, (sys.__stdout__, sys.__stderr__)):
                if stream.isatty():  # show the cursor, which a progress bar hides
                    stream.write("\x1b[?25h")
                stream.flush()

    # `tidy` may wait for a lock that another thread holds, so give it a thread and a time limit.
    thread = threading.Thread(target=tidy, daemon=True)
    thread.start()
    thread.join(0.5)
    os._exit(statuses[-1])
