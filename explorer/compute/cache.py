"""A cache that all browsers share."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class SingleFlightCache(Generic[K, V]):
    """A thread-safe LRU cache of at most `size` values that computes each value once (single flight).

    `functools.lru_cache` would compute a value in every thread that misses it.

    Args:
        budget: the most bytes that all values together take, by `bytes_of`; the newest value is kept even if it takes more.
        bytes_of: the bytes of a value.
    """

    def __init__(self, size: int, budget: int = 0, bytes_of: Callable[[V], int] = lambda _: 0) -> None:
        self._size, self._lock = size, threading.Lock()
        self._budget, self._bytes_of, self._bytes = budget, bytes_of, 0
        self._values: OrderedDict[K, V] = OrderedDict()
        self._in_flight: dict[K, threading.Event] = {}

    def peek(self, key: K) -> V | None:
        """Return the value of a key if it is cached, else None; this does not count as a use."""
        with self._lock:
            return self._values.get(key)

    def get(self, key: K, compute: Callable[[], V]) -> V:
        """Return the value of a key. An error of `compute` is raised in the calling thread only; the next caller retries."""
        while True:
            with self._lock:
                if key in self._values:
                    self._values.move_to_end(key)
                    return self._values[key]
                finished = self._in_flight.get(key)
                if finished is None:
                    finished = self._in_flight[key] = threading.Event()
                    break
            finished.wait()
        try:
            value = compute()
            with self._lock:
                self._values[key] = value
                self._bytes += self._bytes_of(value)
                while len(self._values) > self._size or (len(self._values) > 1 and self._bytes > self._budget):
                    self._bytes -= self._bytes_of(self._values.popitem(last=False)[1])
            return value
        finally:
            with self._lock:
                del self._in_flight[key]
            finished.set()
