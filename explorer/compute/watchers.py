"""Functions that are called after each change of a shared state."""

from __future__ import annotations

import threading
from collections.abc import Callable


class Watchers:
    """A thread-safe list of these functions."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._calls: list[Callable[[], None]] = []

    def watch(self, on_change: Callable[[], None]) -> None:
        """Call a function after each change; it must return at once."""
        with self._lock:
            self._calls.append(on_change)

    def unwatch(self, on_change: Callable[[], None]) -> None:
        """Stop calling a function."""
        with self._lock:
            if on_change in self._calls:
                self._calls.remove(on_change)

    def tell(self) -> None:
        """Call all functions."""
        with self._lock:
            calls = list(self._calls)
        for on_change in calls:
            on_change()
