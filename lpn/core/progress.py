"""The progress of long work: what computes reports it, and a listener, such as the command line, shows it.

    report_progress("Describing drone pictures", 3, 14)    # by the work; without a listener nothing happens
    with listening(draw):                                   # by a command, or by a job of the app
        work()

A listener hears the work of its own thread. It may raise an exception to stop the work.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

T = TypeVar("T")

# Receives the number of finished items, and the total number.
CountProgress = Callable[[int, int], None]
# Receives the stage, such as "Describing frames", the number of its finished items, and the number of its items.
Listener = Callable[[str, int, int], None]

_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


def report_progress(stage: str, done: int, total: int) -> None:
    """Tell the listener of this thread, if there is one, how far a stage is."""
    if (listener := _listener.get()) is not None:
        listener(stage, done, total)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Let a listener hear the work of this thread while the context is open; one before it hears nothing meanwhile."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


@contextmanager
def counted_among(before: int, total: int) -> Iterator[None]:
    """Let the items of one of several lists count among all: after those of the lists `before`, out of `total`."""
    outer = _listener.get()
    if outer is None:
        yield
    else:
        with listening(lambda stage, done, _: outer(stage, before + done, total)):
            yield


def tracked(stage: str, items: Iterable[T], total: int) -> Iterator[T]:
    """Yield items, and report each that is done."""
    for done, item in enumerate(items, 1):
        yield item
        report_progress(stage, done, total)


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
