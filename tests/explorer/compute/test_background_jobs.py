"""Background jobs: sharing, cancellation, failure, and work in another process."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable

import pytest

from explorer.compute.background_jobs import BackgroundJobs, ReportProgress, WorkCancelledError, run_in_process
from lpn.core.errors import InputError, LPNError
from lpn.tasks import notes
from tools.fixtures.waiting import TIMEOUT, wait_until


def test_a_job_is_cancelled_when_its_last_client_leaves_and_can_start_again() -> None:
    jobs, ended, starts = BackgroundJobs(), threading.Event(), []

    def work(progress: ReportProgress) -> int:
        starts.append(1)
        try:
            while len(starts) == 1:
                progress(3, 10)
                time.sleep(0.005)
        except WorkCancelledError:
            ended.set()
            raise
        return 5

    one, other = object(), object()
    job = jobs.join("k", one, work)
    assert jobs.join("k", other, work) is job
    jobs.leave(one)
    wait_until(lambda: (job.done, job.total) == (3, 10))
    assert not job.cancelled
    assert not ended.is_set()
    jobs.leave(other)
    assert ended.wait(TIMEOUT)
    again = jobs.join("k", one, work)
    assert again is not job
    assert again.wait(TIMEOUT)
    assert again.value == 5
    jobs.leave(one)
    assert jobs.join("k", one, work) is again


def test_a_cancelled_job_stays_cancelled_when_others_leave() -> None:
    jobs, left = BackgroundJobs(), threading.Event()

    def work(progress: ReportProgress) -> int:
        assert left.wait(TIMEOUT)
        progress(1, 2)
        return 5

    one, other = object(), object()
    job = jobs.join("k", one, work)
    jobs.leave(one)
    left.set()
    assert job.wait(TIMEOUT)
    jobs.leave(other)  # a browser leaves everything that it could have waited for
    assert job.cancelled
    again = jobs.join("k", other, work)
    assert again.wait(TIMEOUT)
    assert (again.value, again.error) == (5, None)


def test_a_failed_job_has_one_sentence_and_starts_again() -> None:
    jobs = BackgroundJobs()

    def work(_: ReportProgress) -> int:
        raise InputError("The file is damaged.")

    job = jobs.join("k", 1, work)
    assert job.wait(TIMEOUT)
    assert job.error == "The file is damaged."
    again = jobs.join("k", 1, lambda _: 3)
    assert again.wait(TIMEOUT)
    assert again.value == 3


def test_another_process_returns_its_result_or_error_or_is_killed() -> None:
    assert run_in_process(lambda *_: None, math.factorial, 5) == 120
    # A terminal also sends Ctrl-C to the worker process, which must ignore it.
    assert signal.SIGINT in run_in_process(lambda *_: None, signal.pthread_sigmask, signal.SIG_BLOCK, [])
    with pytest.raises(InputError, match="no/word"):
        run_in_process(lambda *_: None, notes.parse_tags, "no/word")
    with pytest.raises(LPNError, match=r"ValueError: the server's log has the details\."):
        run_in_process(lambda *_: None, math.sqrt, -1)
    with pytest.raises(LPNError, match="memory"):
        run_in_process(lambda *_: None, signal.raise_signal, signal.SIGKILL)

    def cancel(*_: int) -> None:
        raise WorkCancelledError

    started = time.monotonic()
    with pytest.raises(WorkCancelledError):
        run_in_process(cancel, time.sleep, 10 * TIMEOUT)
    assert time.monotonic() - started < 5 * TIMEOUT


def test_a_cancelled_job_that_ends_late_leaves_alone_the_one_that_took_its_place() -> None:
    jobs, stop, client, other = BackgroundJobs(), [threading.Event(), threading.Event()], object(), object()

    def work(number: int) -> Callable[[ReportProgress], int]:
        def run(report: ReportProgress) -> int:
            while not stop[number].wait(0.005):
                pass
            report(0, 0)
            return number

        return run

    first = jobs.join("a", client, work(0), keep=False)
    jobs.leave(client)
    second = jobs.join("a", client, work(1), keep=False)
    assert second is not first
    stop[0].set()
    assert first.wait(TIMEOUT)
    assert jobs.join("a", other, work(1), keep=False) is second
    stop[1].set()
    assert second.wait(TIMEOUT)
    second.leave(client)
    assert jobs.join("a", other, work(1), keep=False) is second
    assert second.value == 1
    jobs.leave(other)
    assert not jobs._jobs
