"""The cache that all browsers share keeps the newest values, within a number and a budget of bytes."""

from __future__ import annotations

from explorer.compute.cache import SingleFlightCache


def keys_left(cache: SingleFlightCache[int, int], keys: range) -> list[int]:
    """Return which keys are cached, without a change of the cache."""
    return [key for key in keys if key in cache._values]


def test_values_leave_when_they_take_too_many_bytes_except_for_the_newest() -> None:
    cache: SingleFlightCache[int, int] = SingleFlightCache(10, budget=100, bytes_of=lambda value: value)
    for key, size in enumerate((40, 50, 10)):
        cache.get(key, lambda size=size: size)  # type: ignore[misc]
    assert keys_left(cache, range(3)) == [0, 1, 2]
    cache.get(3, lambda: 30)
    assert keys_left(cache, range(4)) == [1, 2, 3]
    assert cache.peek(1) == 50
    assert cache.peek(0) is None
    cache.get(4, lambda: 500)
    assert keys_left(cache, range(5)) == [4]
    cache.get(5, lambda: 100)
    assert keys_left(cache, range(6)) == [5]
