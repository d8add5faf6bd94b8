"""A thread-safe record of answers and faults; a thread of its own checks the answers."""

from __future__ import annotations

import os
import queue
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from tools.soak.client_state import ClientState
from tools.soak.page_content import PageContent
from tools.soak.reference import Reference

# Kinds of acts whose times are reported: each needs at most one description and one ranking.
CHANGES = ("drag", "parts", "pick", "compare")
# The kind of fault for an error of the soak itself, after which something remained unchecked.
OWN_ERROR = "the soak's own error"


@dataclass(frozen=True)
class SoakAnswer:
    """An answer that a page showed.

    Attributes:
        kind: kind of the client's last act.
        client_name, step: the client and the number of its acts; with the seed they allow a repetition.
        text: the act in words.
        state: the state that the page must show.
        shown: what the page shows.
        seconds: time from the last change to the answer; None when nothing changed.
    """

    kind: str
    client_name: str
    step: int
    text: str
    state: ClientState
    shown: PageContent
    seconds: float | None


@dataclass(frozen=True)
class Fault:
    """A violation, with fields as in `SoakAnswer`."""

    kind: str
    client_name: str
    step: int
    text: str


@dataclass(frozen=True)
class Time:
    """The time of an answer, in phase "alone" or "together"."""

    phase: str
    client_name: str
    kind: str
    seconds: float


class Record:
    """Answers, times, and faults of all clients.

    Attributes:
        phase: "alone" or "together"; new times get it.
        times, faults: everything recorded so far.
        waiting: number of answers not checked yet.
        checked, wrong: numbers of checked answers, and of those that differ from the direct computation.
        visits: number of pages opened.
        clients: number of open pages.
    """

    def __init__(self, reference: Reference) -> None:
        self._reference, self._lock = reference, threading.Lock()
        self._answers: queue.SimpleQueue[SoakAnswer | None] = queue.SimpleQueue()
        self.phase = "alone"
        self.times: list[Time] = []
        self.faults: list[Fault] = []
        self.waiting = self.checked = self.wrong = self.visits = self.clients = 0
        self._thread = threading.Thread(target=self._check, name="soak-check", daemon=True)
        self._thread.start()

    @contextmanager
    def connected(self) -> Iterator[None]:
        """Count a page as open."""
        with self._lock:
            self.visits += 1
            self.clients += 1
        try:
            yield
        finally:
            with self._lock:
                self.clients -= 1

    def answer(self, answer: SoakAnswer) -> None:
        """Record the time, and queue the answer for its check."""
        with self._lock:
            self.waiting += 1
            if answer.seconds is not None:
                self.times.append(Time(self.phase, answer.client_name, answer.kind, answer.seconds))
        self._answers.put(answer)

    def fault(self, fault: Fault) -> None:
        """Record a fault."""
        with self._lock:
            self.faults.append(fault)

    def close(self) -> None:
        """Wait until all answers are checked."""
        self._answers.put(None)
        self._thread.join()

    def _check(self) -> None:
        with suppress(OSError, AttributeError):  # the server has priority
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)
        while (answer := self._answers.get()) is not None:
            try:
                failures = self._reference.failures(answer.state, answer.shown)
            except Exception as error:  # go on with the next answer
                text = "".join(traceback.format_exception(error))
                self.fault(Fault(OWN_ERROR, answer.client_name, answer.step, f"{answer.text}: {text}"))
                continue
            with self._lock:
                self.waiting -= 1
                self.checked += 1
                self.wrong += bool(failures)
            if failures:
                self.fault(
                    Fault("wrong answer", answer.client_name, answer.step, f"{answer.text}: {'; '.join(failures)}")
                )
