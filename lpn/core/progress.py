"""The callbacks by which long work reports its progress; each may raise an exception to stop the work."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

# Receives the number of finished items, and the total number.
CountProgress = Callable[[int, int], None]
# Receives the stage, such as "frames", the number of its finished steps, and the number of its steps.
Progress = Callable[[str, int, int], None]


def at_intervals(seconds: float, receive: CountProgress, at_once: bool = False) -> CountProgress:
    """Return what hands counts on, at most one in so many seconds; the first one after as many, or `at_once`."""
    last = -math.inf if at_once else time.monotonic()

    def report(done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= seconds:
            last = now
            receive(done, total)

    return report
