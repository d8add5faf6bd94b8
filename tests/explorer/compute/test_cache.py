"""The cache that all browsers share computes a value once, and keeps the newest within a number and a budget of bytes."""

from __future__ import annotations

import threading

import pytest

from explorer.compute.background_jobs import WorkCancelledError
from explorer.compute.cache import SingleFlightCache
from tools.fixtures.waiting import TIMEOUT


def keys_left(cache: SingleFlightCache[int, int], keys: range) -> list[int]:
    """Return which keys are cached, without a change of the cache."""
    return [key for key in keys if key in cache._values]


def test_values_leave_when_they_take_too_many_bytes_except_for_the_newest() -> None:
    cache: SingleFlightCache[int, int] = SingleFlightCache(10, budget=100, bytes_of=lambda value: value)
    for key, size in enumerate((40, 50, 10)):
        cache.get(key, lambda size=size: size)
    assert keys_left(cache, range(3)) == [0, 1, 2]
    cache.get(3, lambda: 30)
    assert keys_left(cache, range(4)) == [1, 2, 3]
    assert cache.peek(1) == 50
    assert cache.peek(0) is None
    cache.get(4, lambda: 500)
    assert keys_left(cache, range(5)) == [4]
    cache.get(5, lambda: 100)
    assert keys_left(cache, range(6)) == [5]


def test_the_cache_computes_a_value_once_and_forgets_the_least_recently_used() -> None:
    cache: SingleFlightCache[int, object] = SingleFlightCache(2)
    making, go, made, got = threading.Event(), threading.Event(), [], []

    def make() -> object:
        made.append(1)
        making.set()
        assert go.wait(TIMEOUT)
        return object()

    threads = [threading.Thread(target=lambda: got.append(cache.get(1, make))) for _ in range(5)]
    for thread in threads:
        thread.start()
    assert making.wait(TIMEOUT)
    go.set()
    for thread in threads:
        thread.join(TIMEOUT)
    assert len(made) == 1
    assert len(got) == 5
    assert len(set(map(id, got))) == 1
    cache.get(2, object)
    assert cache.get(1, object) is got[0]
    cache.get(3, object)
    assert cache.get(1, object) is got[0]
    assert cache.get(2, lambda: "anew") == "anew"


def test_after_a_failed_computation_the_next_caller_of_the_cache_retries() -> None:
    cache: SingleFlightCache[int, str] = SingleFlightCache(2)
    making, go, got = threading.Event(), threading.Event(), []

    def fail() -> str:
        making.set()
        assert go.wait(TIMEOUT)
        raise WorkCancelledError

    def failing() -> None:
        with pytest.raises(WorkCancelledError):
            cache.get(1, fail)

    threads = [
        threading.Thread(target=failing),
        threading.Thread(target=lambda: got.append(cache.get(1, lambda: "made"))),
    ]
    threads[0].start()
    assert making.wait(TIMEOUT)
    threads[1].start()
    go.set()
    for thread in threads:
        thread.join(TIMEOUT)
    assert got == ["made"]
