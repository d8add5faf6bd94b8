from __future__ import annotations

import math
import os
import re
import signal
import threading
import time

import pytest

from explorer.compute.background_jobs import (
    BackgroundJob,
    BackgroundJobs,
    ReportProgress,
    WorkCancelledError,
    in_process,
)
from explorer.failure_lab import table
from lpn.analysis import notes
from lpn.core.errors import InputError, LPNError


def test_work_ends_when_the_last_one_leaves_and_begins_anew() -> None:
    jobs, ended, begun = BackgroundJobs(), threading.Event(), []

    def work(progress: ReportProgress) -> int:
        begun.append(1)
        try:
            while len(begun) == 1:
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
    assert not ended.wait(0.1)
    assert (job.done, job.total) == (3, 10)
    jobs.leave(other)
    assert ended.wait(5)
    again = jobs.join("k", one, work)
    assert again is not job
    assert again.wait(5)
    assert again.value == 5
    jobs.leave(one)
    assert jobs.join("k", one, work) is again


def test_a_failure_is_one_sentence_and_is_tried_again_when_asked() -> None:
    jobs = BackgroundJobs()

    def work(_: ReportProgress) -> int:
        raise InputError("The file is damaged.")

    job = jobs.join("k", 1, work)
    assert job.wait(5)
    assert job.error == "The file is damaged."
    assert jobs.join("k", 1, work) is job
    html = table.waiting(job, "The <map>", False, "pca")
    assert "The &lt;map&gt; is not there: The file is damaged." in html
    assert "lab-go" in html
    jobs.forget_failed("k")
    assert jobs.join("k", 1, lambda _: 3) is not job


def test_progress_is_a_share_with_a_way_to_cancel() -> None:
    release = threading.Event()

    def work(progress: ReportProgress) -> None:
        progress(1000, 4000)
        release.wait(10)

    job = BackgroundJob(work, "me")
    while not job.total:
        time.sleep(0.005)
    html = table.waiting(job, "Ranking", False, "table")
    assert "25 % (1,000 of 4,000 queries)" in html
    assert "lab-stop" in html
    assert "lab-go" in table.waiting(None, "Ranking", True, "table")
    job.total = 0
    assert re.search(r"Ranking: \d+ s so far", table.waiting(job, "Ranking", False, "table"))
    release.set()


def test_another_process_gives_its_result_its_error_or_is_ended() -> None:
    assert in_process(lambda *_: None, math.factorial, 5) == 120
    # A terminal's Ctrl-C reaches it too, and is not its to heed.
    assert signal.SIGINT in in_process(lambda *_: None, signal.pthread_sigmask, signal.SIG_BLOCK, [])
    with pytest.raises(InputError, match="no/word"):
        in_process(lambda *_: None, notes.parse_tags, "no/word")
    with pytest.raises(LPNError, match="memory"):
        in_process(lambda *_: None, os._exit, 3)

    def give_up(*_: int) -> None:
        raise WorkCancelledError

    started = time.monotonic()
    with pytest.raises(WorkCancelledError):
        in_process(give_up, time.sleep, 600)
    assert time.monotonic() - started < 300
