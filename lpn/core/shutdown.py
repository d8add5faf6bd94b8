"""Stopping on Ctrl-C and SIGTERM: finish the files being written, print one sentence, and exit.

The first signal raises KeyboardInterrupt in the main thread; a file that this thread is writing is completed first.
A second signal exits at once. Files on the disk are complete at any moment (see `lpn.core.files.write_atomic`).
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

# Seconds to wait for file writes in progress.
WRITE_SECONDS = 10.0
SIGNALS = (signal.SIGINT, signal.SIGTERM)
# Global, as signal handlers are per process: the thread of each file write, and signals that wait for a write of the main thread.
_WRITING: list[threading.Thread] = []
_DELAYED: list[int] = []


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay a stop until the block ends, so that files that belong together are all written.

    Raises:
        KeyboardInterrupt: at the end of the block in the main thread, if the process was asked to stop.
    """
    thread = threading.current_thread()
    _WRITING.append(thread)
    try:
        yield
    finally:
        _WRITING.remove(thread)
        if _DELAYED and thread is threading.main_thread() and thread not in _WRITING:
            _DELAYED.clear()
            raise KeyboardInterrupt


def writes_finished(seconds: float) -> bool:
    """Wait until no file is being written; return False if `seconds` were not enough."""
    until = time.monotonic() + seconds
    while _WRITING and time.monotonic() < until:
        time.sleep(0.01)
    return not _WRITING


class StopSignals:
    """The signals that stop a command.

    Args:
        report: reports the stop by a signal, and returns the exit status.

    Attributes:
        signal: the first signal received; 0 before.
    """

    def __init__(self, report: Callable[[int], int]) -> None:
        self.signal = 0
        self._report = report

    def end(self) -> int:
        """Report the stop, and return the exit status."""
        status = self._report(self.signal or signal.SIGINT)
        with suppress(AttributeError, OSError, ValueError):  # there may be no stream, or a closed one
            sys.stdout.flush()
        return status

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Handle signals inside the context; has no effect outside of the main thread."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, self._handle) for number in SIGNALS}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _handle(self, number: int, _: FrameType | None) -> None:
        if self.signal:
            exit_now(128 + self.signal)
        self.signal = number
        if threading.main_thread() not in _WRITING:
            raise KeyboardInterrupt
        _DELAYED.append(number)


def exit_now(status: int) -> None:
    """Exit the process and its child processes at once, whatever its threads are doing."""
    for child in multiprocessing.active_children():
        child.kill()
    for stream in filter(None, (sys.__stdout__, sys.__stderr__)):
        with suppress(OSError, ValueError):  # the terminal may be closed
            if stream.isatty():  # show the cursor, which a progress bar hides
                os.write(stream.fileno(), b"\x1b[?25h")
    os._exit(status)
