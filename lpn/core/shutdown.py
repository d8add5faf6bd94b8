"""Ending on Ctrl-C and SIGTERM: what is being written is finished, one sentence is said, and it takes two seconds at most.

The first signal raises KeyboardInterrupt in the main thread, though not while it writes a file: then, when the file is whole.
What still computes two seconds later is not waited for, nor is anything after a second signal: whatever is on the disk
is whole at any moment, see `lpn.core.files.write_atomic`.
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

GRACE = 2.0
"""Seconds that a command has to end by itself."""
WRITING = 10.0
"""Seconds that files being written have beyond that."""
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class _Writes:
    """Files that are being written by this process, in any thread."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._count = 0
        self.depth = 0
        """How many of them, one within the other, by the main thread, which alone changes it."""
        self.stop_after = False
        """Whether a signal came meanwhile."""

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


_WRITES = _Writes()


@contextmanager
def uninterrupted() -> Iterator[None]:
    """What is done here is done to its end, also when the process is asked to stop meanwhile: files that belong together.

    Raises:
        KeyboardInterrupt: at its end in the main thread, when the process was asked to stop.
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
            if not _WRITES.depth and _WRITES.stop_after:
                _WRITES.stop_after = False
                raise KeyboardInterrupt


def writes_finished(seconds: float) -> bool:
    """Whether no file is being written, now or within some seconds."""
    return _WRITES.wait(seconds)


class StopSignals:
    """What becomes of a command that is asked to stop.

    Args:
        say: says that it was stopped, and how to go on; returns the exit status.

    Attributes:
        signal: that asked for it, 0 before any did.
    """

    def __init__(self, say: Callable[[int], int]) -> None:
        self.signal = 0
        self._say, self._said = say, threading.Lock()
        self._raised = False
        self._here, self._there = socket.socketpair()
        self._here.setblocking(False)
        self._over = threading.Event()

    def end(self) -> int:
        """Say that it was stopped, once, and return the exit status."""
        if not self._said.acquire(blocking=False):
            threading.Event().wait(GRACE)  # the other thread is about to end the process
        return self._say(self.signal or signal.SIGINT)

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Heed signals, in the main thread; elsewhere nothing is done."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, self._heard) for number in SIGNALS}
        # Python runs its handlers between two lines of Python, not while a library computes; this is told at once.
        woken = signal.set_wakeup_fd(self._here.fileno(), warn_on_full_buffer=False)
        watcher = threading.Thread(target=self._watch, name="lpn-stopping", daemon=True)
        watcher.start()
        try:
            yield
        finally:
            signal.set_wakeup_fd(woken)
            for number, handler in before.items():
                signal.signal(number, handler)
            self._over.set()
            self._here.send(b"\0")
            watcher.join()
            self._here.close()
            self._there.close()

    def _heard(self, number: int, _: FrameType | None) -> None:
        self.signal = self.signal or number
        if self._raised:
            return
        self._raised = True
        if _WRITES.depth:
            _WRITES.stop_after = True
        else:
            raise KeyboardInterrupt

    def _watch(self) -> None:
        first = self._next(None)
        if first is None:
            return
        self.signal = self.signal or first
        again = self._next(GRACE)
        until = time.monotonic() + WRITING
        while again is None and not self._over.is_set() and time.monotonic() < until and not writes_finished(0):
            again = self._next(0.05)
        if not self._over.is_set():
            exit_now(128 + self.signal, self.end if again is None else None)

    def _next(self, seconds: float | None) -> int | None:
        """The next signal that asks to stop; None when none comes in time, or the command is over."""
        until = None if seconds is None else time.monotonic() + seconds
        while True:
            left = None if until is None else max(until - time.monotonic(), 0)
            if not select.select([self._there], [], [], left)[0]:
                return None
            number = self._there.recv(1)[0]
            if self._over.is_set():
                return None
            if number in SIGNALS:
                return number


def exit_now(status: int, say: Callable[[], int] | None = None) -> None:
    """End the process at once, with the processes that it started, whatever its threads are doing.

    Args:
        say: what is done first, if it can be done at once; returns another exit status.
    """
    statuses = [status]

    def tidy() -> None:
        for child in multiprocessing.active_children():
            child.kill()
        if say is not None:
            statuses.append(say())
        for stream in (sys.stdout, sys.stderr):
            if stream.isatty():
                stream.write("\x1b[?25h")  # a progress bar hides the cursor
            stream.flush()

    # A thread that is stuck may hold what this needs.
    thread = threading.Thread(target=_quietly, args=(tidy,), daemon=True)
    thread.start()
    thread.join(0.5)
    os._exit(statuses[-1])


def _quietly(work: Callable[[], None]) -> None:
    with suppress(Exception):  # a closed terminal
        work()
