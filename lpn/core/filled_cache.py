"""A cache for values that are requested in one order again and again."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

T = TypeVar("T")


class FilledCache(Generic[T]):
    """A cache that fills up to a limit, and then keeps its contents.

    An LRU cache that is too small for a flight's frames drops each of them before it is needed again. Threads may share it; two
    of them may compute a value at once.

    Args:
        limit: maximum of bytes of all values.
        size: returns the bytes of a value.
    """

    def __init__(self, limit: int, size: Callable[[T], int]) -> None:
        self._room, self._size = limit, size
        self._values: dict[Hashable, T] = {}

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the value of a key, computed if the cache does not hold it."""
        if key in self._values:
            return self._values[key]
        value = make()
        if (size := self._size(value)) <= self._room:
            self._room -= size
            self._values[key] = value
        return value
