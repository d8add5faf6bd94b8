from __future__ import annotations

import os
import platform
import subprocess
import sys
import threading

import pytest

from lpn.core.resources import one_thread_a_library, yield_cores

HELD = """
import numpy as np
from lpn.core.resources import limit_malloc_arenas, return_memory

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096 // 1_000_000

assert limit_malloc_arenas()
for _ in range(3):
    np.ones(500_000)
arrays = [np.ones(250_000) for _ in range(100)]
before = resident()
del arrays[::2]
return_memory()
print(before - resident())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library keeps memory in other ways")
def test_freed_arrays_leave_the_process_though_others_live_on() -> None:
    done = subprocess.run([sys.executable, "-c", HELD], check=True, stdout=subprocess.PIPE, text=True)
    assert int(done.stdout) > 90


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux has a niceness for each thread")
def test_a_thread_that_yields_and_those_it_starts_are_nicer_than_others() -> None:
    before, found = os.getpriority(os.PRIO_PROCESS, 0), []

    def measure() -> None:
        found.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))

    def work() -> None:
        yield_cores()
        measure()
        child = threading.Thread(target=measure)
        child.start()
        child.join()

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [min(before + 10, 19)] * 2
    assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == before


def test_libraries_compute_by_one_thread_each_within_and_as_before_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    control = pytest.importorskip("threadpoolctl")

    def threads() -> list[int]:
        return [library["num_threads"] for library in control.threadpool_info() if library["user_api"] == "blas"]

    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    with control.threadpool_limits(2):
        with one_thread_a_library() as limited:
            assert limited
            assert set(threads()) == {2}  # the user's choice
        monkeypatch.delenv("OMP_NUM_THREADS")
        with one_thread_a_library() as limited:
            assert limited
            assert set(threads()) == {1}
            assert os.environ["OMP_NUM_THREADS"] == "1"
        assert set(threads()) == {2}
        assert "OMP_NUM_THREADS" not in os.environ
