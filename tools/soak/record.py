"""What was answered and what went wrong, from many clients at once; each answer is checked on a thread of its own."""

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

# The acts whose times count: one query described at most, and one ranking.
CHANGES = ("drag", "parts", "pick", "compare")
# A kind of fault: something that was to be checked was not.
OWN_ERROR = "the soak's own error"


@dataclass(frozen=True)
class SoakAnswer:
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
    client_name: str
    step: int
    text: str
    state: ClientState
    shown: PageContent
    seconds: float | None


@dataclass(frozen=True)
class Fault:
    """What must not be; fields as in `Answer`."""

    kind: str
    client_name: str
    step: int
    text: str


@dataclass(frozen=True)
class Time:
    """How long an answer took; `phase` is "alone" or "together"."""

    phase: str
    client_name: str
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
        self._answers: queue.SimpleQueue[SoakAnswer | None] = queue.SimpleQueue()
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

    def answer(self, answer: SoakAnswer) -> None:
        """Keep the time, and have the answer checked."""
        with self._lock:
            self.waiting += 1
            if answer.seconds is not None:
                self.times.append(Time(self.phase, answer.client_name, answer.kind, answer.seconds))
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
                failures = self._reference.failures(answer.state, answer.shown)
            except Exception as error:  # those after it are to be checked all the same
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
