"""Long work that several clients may share: it runs once, on its own thread, and is cancelled when the last client leaves."""

from __future__ import annotations

import logging
import multiprocessing
import signal
import threading
import traceback
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import Connection
from typing import Any, Generic, TypeVar

from lpn.core.errors import LPNError
from lpn.core.progress import listening

log = logging.getLogger(__name__)

T = TypeVar("T")

# A function that reports the finished and the total amount of work, (0, 0) if unknown. It raises `WorkCancelledError`
# when all clients have left.
ReportProgress = Callable[[int, int], None]


class WorkCancelledError(Exception):
    """No client waits for the work any longer."""


class BackgroundJob(Generic[T]):
    """Work that starts at once on its own thread; its reports (`lpn.core.progress`) are the job's progress.

    Args:
        on_abandoned: called with the job when its last client has left.

    Attributes:
        done, total: progress as last reported.
        value: the result, None until the work succeeds.
        error: one sentence with the reason of a failure or a cancellation, else None.
        cancelled: all clients left before the work ended.
    """

    def __init__(
        self,
        work: Callable[[ReportProgress], T],
        client: object,
        on_abandoned: Callable[[BackgroundJob[T]], None] = lambda _: None,
    ) -> None:
        self._on_abandoned, self._lock = on_abandoned, threading.Lock()
        self._clients = {id(client)}  # ids, so that a finished job keeps no client alive
        self._finished = threading.Event()
        self.done, self.total = 0, 0
        self.value: T | None = None
        self.error: str | None = None
        self.cancelled = False
        threading.Thread(target=self._run, args=(work,), name="explorer-job", daemon=True).start()

    def wait(self, seconds: float) -> bool:
        """Wait for the end; return whether the work has ended, with or without success."""
        return self._finished.wait(seconds)

    def join(self, client: object) -> bool:
        """Add a client; return False if the job has been cancelled."""
        with self._lock:
            if not self.cancelled:
                self._clients.add(id(client))
            return not self.cancelled

    def leave(self, client: object) -> None:
        """Remove a client; the last one to leave cancels the work, for good."""
        with self._lock:
            self._clients.discard(id(client))
            abandoned = not self._clients
            self.cancelled = self.cancelled or (abandoned and not self._finished.is_set())
        if abandoned:
            self._on_abandoned(self)

    def _report(self, done: int, total: int) -> None:
        self.done, self.total = done, total
        if self.cancelled:
            raise WorkCancelledError

    def _run(self, work: Callable[[ReportProgress], T]) -> None:
        try:
            with listening(lambda _, done, total: self._report(done, total)):
                self.value = work(self._report)
        except WorkCancelledError:
            self.error = "The computation was cancelled."
        except LPNError as error:
            self.error = str(error)
        except Exception as error:
            log.exception("A job failed")
            self.error = f"{type(error).__name__}: the details are in the server's log."
        self._finished.set()


class BackgroundJobs:
    """At most one job for each key; thread-safe.

    Joining a cancelled or failed job starts a new one.
    """

    def __init__(self) -> None:
        self._jobs: dict[Hashable, BackgroundJob[Any]] = {}
        self._lock = threading.RLock()

    def join(
        self,
        key: Hashable,
        client: object,
        work: Callable[[ReportProgress], T],
        keep: bool = True,
    ) -> BackgroundJob[T]:
        """Return the job of a key; start it if there is none.

        Args:
            keep: False if the job is to be forgotten when its last client has left it.
        """
        with self._lock:
            job = self._jobs.get(key)
            if job is None or (job.wait(0) and job.error is not None) or not job.join(client):
                abandoned = (lambda _: None) if keep else partial(self._forget, key)
                job = self._jobs[key] = BackgroundJob(work, client, abandoned)
            return job

    def _forget(self, key: Hashable, job: BackgroundJob[Any]) -> None:
        with self._lock:
            if self._jobs.get(key) is job:  # a cancelled job must not remove its successor
                del self._jobs[key]

    def leave(self, client: object, key: Hashable | None = None) -> None:
        """Remove a client from the job of a key, or from all jobs."""
        with self._lock:
            for name, job in list(self._jobs.items()):
                if key is None or name == key:
                    job.leave(client)


def run_in_process(report: ReportProgress, function: Callable[..., T], *arguments: object) -> T:
    """Call a function in a separate process, and kill the process when `report` raises.

    Use it for functions that never report progress and could not be cancelled otherwise.

    Args:
        function: a function that the process can import; arguments and result are pickled.

    Raises:
        LPNError: raised by the function, or because the process was killed.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send_result, args=(sender, function, arguments), daemon=True)
    try:
        with _sigint_blocked():
            process.start()
        sender.close()
        while not receiver.poll(0.2):
            report(0, 0)
        error, value = receiver.recv()
        process.join(5)  # give the process time to clean up
    except EOFError as end:
        raise LPNError("The process of this computation was killed, often because memory ran out.") from end
    finally:
        process.kill()
        process.join()
        receiver.close()
    if error is not None:
        raise error
    result: T = value
    return result


@contextmanager
def _sigint_blocked() -> Iterator[None]:
    """Block SIGINT in this thread and in the processes that it starts.

    Ctrl-C in the terminal then does not end these processes; this process ends them.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _send_result(connection: Connection, function: Callable[..., Any], arguments: tuple[object, ...]) -> None:
    try:
        outcome: tuple[LPNError | None, Any] = (None, function(*arguments))
    except LPNError as error:
        outcome = (error, None)
    except Exception as error:
        traceback.print_exc()
        outcome = (LPNError(f"{type(error).__name__}: the server's log has the details."), None)
    connection.send(outcome)
