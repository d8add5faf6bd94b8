"""The progress of long work: the work reports it, and a listener, such as the command line, shows it.

    report_progress("Describing drone pictures", 3, 14)    # by the work; without a listener nothing happens
    with listening(draw):                                   # by a command, or by a job of the app
        work()

A listener receives the reports of its own thread. It may raise an exception to stop the work.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import ParamSpec, TypeVar

T = TypeVar("T")
P = ParamSpec("P")

# Receives the number of finished items, and the total number.
CountProgress = Callable[[int, int], None]
# Receives the stage, such as "Describing frames", the number of its finished items, and the number of its items.
Listener = Callable[[str, int, int], None]

_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


def report_progress(stage: str, done: int, total: int) -> None:
    """Report the progress of a stage to the listener of this thread, if there is one."""
    if (listener := _listener.get()) is not None:
        listener(stage, done, total)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Send this thread's reports to a listener while the context is open; an outer listener receives nothing meanwhile."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


@contextmanager
def ended() -> Iterator[None]:
    """Report the body's last stage as complete at its end, because a list that is read from a store reports no progress."""
    outer, last = _listener.get(), list[tuple[str, int, int]]()
    if outer is None:
        yield
        return

    def hear(stage: str, done: int, total: int) -> None:
        last[:] = [(stage, done, total)]
        outer(stage, done, total)

    with listening(hear):
        yield
    for stage, done, total in last:
        if done < total:
            outer(stage, total, total)


@contextmanager
def counted_among(before: int, total: int) -> Iterator[None]:
    """Report one list's progress as progress of several lists: `before` items are already done, out of `total`."""
    outer = _listener.get()
    if outer is None:
        yield
    else:
        with listening(lambda stage, done, _: outer(stage, before + done, total)):
            yield


def tracked(stage: str, items: Iterable[T], total: int) -> Iterator[T]:
    """Yield items, and report each finished one."""
    for done, item in enumerate(items, 1):
        yield item
        report_progress(stage, done, total)


def at_intervals(seconds: float, receive: Callable[P, None], at_once: bool = False) -> Callable[P, None]:
    """Return a function that passes on reports at most once in `seconds`; with `at_once`, the first one without delay."""
    last = -math.inf if at_once else time.monotonic()

    def report(*args: P.args, **kwargs: P.kwargs) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= seconds:
            last = now
            receive(*args, **kwargs)

    return report
