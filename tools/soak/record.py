"""What was answered and what went wrong, from many clients at once; each answer is checked on a thread of its own."""

from __future__ import annotations

import os
import queue
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from tools.soak.asked import Asked
from tools.soak.reading import Shown
from tools.soak.reference import Reference

CHANGES = ("drag", "parts", "pick", "compare")
"""The acts whose times count: one query described at most, and one ranking."""
OWN_ERROR = "the soak's own error"
"""A kind of fault: something that was to be checked was not."""


@dataclass(frozen=True)
class Answer:
    """An answer that a page showed.

    Attributes:
        kind: of the act before it.
        who, step: the client, and how many acts it had begun; with the seed they say what to repeat.
        said: the act in words.
        asked: for what.
        shown: by the page.
        seconds: from the last change to the answer; None where nothing was changed.
    """

    kind: str
    who: str
    step: int
    said: str
    asked: Asked
    shown: Shown
    seconds: float | None


@dataclass(frozen=True)
class Fault:
    """What must not be; fields as in `Answer`."""

    kind: str
    who: str
    step: int
    said: str


@dataclass(frozen=True)
class Time:
    """How long an answer took; `phase` is "alone" or "together"."""

    phase: str
    who: str
    kind: str
    seconds: float


class Record:
    """Filled by all clients.

    Attributes:
        phase: of the answers that come now.
        times, faults: so far.
        waiting: answers that are still to be checked.
        checked, wrong: answers compared with the direct computation, and those that differ.
        visits: pages opened.
        clients: pages that are open now.
    """

    def __init__(self, reference: Reference) -> None:
        self._reference, self._lock = reference, threading.Lock()
        self._answers: queue.SimpleQueue[Answer | None] = queue.SimpleQueue()
        self.phase = "alone"
        self.times: list[Time] = []
        self.faults: list[Fault] = []
        self.waiting = self.checked = self.wrong = self.visits = self.clients = 0
        self._thread = threading.Thread(target=self._check, name="soak-check", daemon=True)
        self._thread.start()

    @contextmanager
    def connected(self) -> Iterator[None]:
        """For as long as a page is open."""
        with self._lock:
            self.visits += 1
            self.clients += 1
        try:
            yield
        finally:
            with self._lock:
                self.clients -= 1

    def answer(self, answer: Answer) -> None:
        """Keep the time, and have the answer checked."""
        with self._lock:
            self.waiting += 1
            if answer.seconds is not None:
                self.times.append(Time(self.phase, answer.who, answer.kind, answer.seconds))
        self._answers.put(answer)

    def fault(self, fault: Fault) -> None:
        """Keep what went wrong."""
        with self._lock:
            self.faults.append(fault)

    def close(self) -> None:
        """Wait until all answers are checked."""
        self._answers.put(None)
        self._thread.join()

    def _check(self) -> None:
        with suppress(OSError, AttributeError):  # the server goes first
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)
        while (answer := self._answers.get()) is not None:
            try:
                flaws = self._reference.flaws(answer.asked, answer.shown)
            except Exception as error:  # those after it are to be checked all the same
                said = "".join(traceback.format_exception(error))
                self.fault(Fault(OWN_ERROR, answer.who, answer.step, f"{answer.said}: {said}"))
                continue
            with self._lock:
                self.waiting -= 1
                self.checked += 1
                self.wrong += bool(flaws)
            if flaws:
                self.fault(Fault("wrong answer", answer.who, answer.step, f"{answer.said}: {'; '.join(flaws)}"))
