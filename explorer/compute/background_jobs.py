"""Long work that several browsers wait for: done once, off the event loop, and ended when nobody waits any longer."""

from __future__ import annotations

import logging
import multiprocessing
import signal
import threading
import time
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any, Generic, TypeVar

from lpn.core.errors import LPNError

log = logging.getLogger(__name__)

T = TypeVar("T")
ReportProgress = Callable[[int, int], None]
"""Told how much is done, and of how much; (0, 0) where that cannot be said. Raises `WorkCancelledError` when nobody waits."""


class WorkCancelledError(Exception):
    """Nobody waits for the work any longer."""


class BackgroundJob(Generic[T]):
    """Work on a thread of its own.

    Attributes:
        done, total: as the work last said.
        value: the result, None before it is there.
        flaw: one sentence why there is none, or None.
    """

    def __init__(self, work: Callable[[ReportProgress], T], who: object) -> None:
        self._work, self._waiting, self._lock = work, {id(who)}, threading.Lock()
        self._finished, self._given_up = threading.Event(), False
        self.done, self.total = 0, 0
        self._began = time.monotonic()
        self.value: T | None = None
        self.flaw: str | None = None
        threading.Thread(target=self._run, name="explorer-job", daemon=True).start()

    @property
    def given_up(self) -> bool:
        """Whether everybody left before it ended."""
        return self._given_up

    @property
    def seconds(self) -> float:
        """Since it was begun."""
        return time.monotonic() - self._began

    def wait(self, seconds: float) -> bool:
        """Whether the work has ended, in success or not, within some seconds."""
        return self._finished.wait(seconds)

    def join(self, who: object) -> bool:
        """Wait for it too; False when it has been given up."""
        with self._lock:
            if not self._given_up:
                self._waiting.add(id(who))
            return not self._given_up

    def leave(self, who: object) -> None:
        """Wait for it no longer."""
        with self._lock:
            self._waiting.discard(id(who))
            self._given_up = not self._waiting and not self._finished.is_set()

    def _progress(self, done: int, total: int) -> None:
        self.done, self.total = done, total
        if self._given_up:
            raise WorkCancelledError

    def _run(self) -> None:
        try:
            self.value = self._work(self._progress)
        except WorkCancelledError:
            self.flaw = "It was cancelled."
        except LPNError as error:
            self.flaw = str(error)
        except Exception as error:
            log.exception("A job failed")
            self.flaw = f"{type(error).__name__}: the details are in the server's log."
        self._finished.set()


class BackgroundJobs:
    """One job for each kind of work. One that was given up is begun anew when it is asked for again; one that failed, once it
    is forgotten."""

    def __init__(self) -> None:
        self._jobs: dict[Hashable, BackgroundJob[Any]] = {}
        self._lock = threading.Lock()

    def ask(self, key: Hashable, who: object, work: Callable[[ReportProgress], T]) -> BackgroundJob[T]:
        """The job of a key, joined or begun."""
        with self._lock:
            job = self._jobs.get(key)
            if job is None or not job.join(who):
                job = self._jobs[key] = BackgroundJob(work, who)
            return job

    def forget(self, key: Hashable) -> None:
        """Let the next one who asks begin anew, where the job failed."""
        with self._lock:
            job = self._jobs.get(key)
            if job is not None and job.flaw is not None:
                del self._jobs[key]

    def leave(self, who: object, key: Hashable | None = None) -> None:
        """Wait no longer for one job, or for any."""
        with self._lock:
            for name, job in self._jobs.items():
                if key is None or name == key:
                    job.leave(who)


def in_process(progress: ReportProgress, function: Callable[..., T], *arguments: object) -> T:
    """Call a function in a process of its own, which is ended when `progress` raises: some work cannot be stopped otherwise.

    Args:
        function: of a module, so that the other process can import it; arguments and result are pickled.

    Raises:
        LPNError: what the function raised, or that the process ended without a word.
    """
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_call, args=(there, function, arguments), daemon=True)
    try:
        with _without_interrupts():
            process.start()
        there.close()
        while not here.poll(0.2):
            progress(0, 0)
        error, value = here.recv()
        process.join(5)  # it may have things to put away
    except EOFError as ended:
        raise LPNError("The process that computed it was ended, which is often for want of memory.") from ended
    finally:
        process.kill()
        process.join()
        here.close()
    if error is not None:
        raise error
    result: T = value
    return result


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Processes started here know no Ctrl-C, which a terminal sends to them too: who started them ends them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _call(connection: Connection, function: Callable[..., Any], arguments: tuple[object, ...]) -> None:
    try:
        answer: tuple[LPNError | None, Any] = (None, function(*arguments))
    except LPNError as error:
        answer = (error, None)
    connection.send(answer)
