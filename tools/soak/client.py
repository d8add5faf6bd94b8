"""A simulated user with seeded visits and acts, whose answers are all compared with the direct computation."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from random import Random

from tools.soak.record import Fault, Record
from tools.soak.reference import ClientState, PageContent, Reference

# Longest time to any answer in seconds, with all clients at work.
BOUND = 60.0


class StoppedError(Exception):
    """Raised in every client when the soak ends."""


class FaultError(Exception):
    """Raised with a kind, such as "no answer", and a text, when the server violates an expectation."""


class SoakClient(ABC):
    """One client, which visits the page again and again until the soak ends.

    Args:
        name: such as "client 3"; with the seed it decides every act. "client 0" stays on one page.
        url: the server's address.
        stop: set when the soak ends.
    """

    def __init__(
        self, name: str, seed: int, url: str, reference: Reference, record: Record, stop: threading.Event
    ) -> None:
        self._name, self._url, self._reference, self._record, self._stop = name, url, reference, record, stop
        self._rng, self._visit, self._step, self._did = Random(f"{seed} {name}"), 0, 0, ""
        self._state = ClientState(next(iter(reference.tasks)), 0)
        self._changed = 0.0

    @abstractmethod
    def _open(self, link: str) -> None:
        """Open the page by a link's query."""

    @abstractmethod
    def _acts(self) -> dict[Callable[[], None], float]:
        """The acts of a user, and the frequency of each."""

    @abstractmethod
    def _leave(self) -> None:
        """Leave the page; without effect where none is open."""

    @abstractmethod
    def _look(self) -> PageContent:
        """What the page shows."""

    @abstractmethod
    def _shows(self, state: ClientState) -> bool:
        """Return True once the page shows the result of a state."""

    @abstractmethod
    def _wait(self, holds: Callable[[], bool]) -> bool:
        """Wait a while for `holds()`, and return its value."""

    @abstractmethod
    def _check(self, states: Sequence[ClientState]) -> None:
        """Raise FaultError for an error, or content of none of the states."""

    def run(self) -> None:
        """Visit again and again; a fault ends the visit, not the client."""
        while not self._stop.is_set():
            self._visit += 1
            try:
                self._enter()
                acts = self._acts()
                for _ in range(10**9 if self._name == "client 0" else self._rng.randint(5, 18)):
                    self._rng.choices([*acts], [*acts.values()])[0]()
                    self._rest(self._rng.uniform(0, 1))
            except StoppedError:
                pass
            except FaultError as fault:
                self._fault(*fault.args)
            finally:
                self._leave()
            self._stop.wait(self._rng.choice([0.0, 0.0, 1.0, 3.0]))

    def _enter(self) -> None:
        rng, task = self._rng, self._rng.choice(list(self._reference.tasks))
        state = ClientState(task, rng.randrange(len(self._reference.tasks[task].queries)))
        if rng.random() < 0.3:
            state = replace(state, angle=float(rng.randint(-180, 180)))
        if rng.random() < 0.2:
            state = replace(state, weights=self._weights())
        link = self._reference.address(state)
        self._begin(f"opened ?{link}")
        self._send(lambda: self._open(link))
        # A page that has to wait for its address may show another query before.
        self._settle("open", state, None)

    def _weights(self) -> tuple[float, ...]:
        weights = [round(0.05 * self._rng.randint(0, 40), 2) for _ in range(self._reference.parts)]
        weights[0] = 1.0 if weights[0] != 1.0 and len(weights) > 1 else 0.5
        return tuple(weights) if len(set(weights)) > 1 else ()

    def _act(self, kind: str, send: Callable[[], object], state: ClientState) -> None:
        """Perform an act of a kind that leads to a state, and await its answer."""
        self._begin(f"{kind} to {self._reference.address(state)}")
        self._send(send)
        self._settle(kind, state)

    def _send(self, send: Callable[[], object]) -> None:
        try:
            send()
        except (FaultError, StoppedError):
            raise
        except Exception as error:
            if self._stop.is_set():  # Ctrl-C ends browsers, too
                raise StoppedError from error
            raise FaultError("page", f"{type(error).__name__}: {str(error)[:400]}") from error
        self._changed = time.monotonic()

    def _begin(self, did: str) -> None:
        self._rest(0)
        self._step += 1
        self._did = did

    def _rest(self, seconds: float) -> None:
        if self._stop.wait(seconds):
            raise StoppedError

    def _fault(self, kind: str, text: str) -> None:
        self._record.faults.append(Fault(kind, self._name, self._step, f"visit {self._visit}, {self._did}: {text}"))

    def _settle(self, kind: str, state: ClientState, path: Sequence[ClientState] | None = ()) -> None:
        """Await a state, which may follow others (None: any), and compare the content with the direct computation."""
        changed, self._state = self._state != state, state
        # A client waits even after the soak's end, so that a missing answer is noticed in a short soak, too.
        deadline = time.monotonic() + BOUND
        while not self._wait(lambda: self._shows(state)):
            if time.monotonic() > deadline:
                raise FaultError(
                    "no answer", f"expected {self._reference.address(state)} within {BOUND:g} s{self._said()}"
                )
        seconds = time.monotonic() - self._changed
        self._check([] if path is None else [state, *path])
        failures = list(self._reference.failures(state, self._look()))
        self._record.answers.append((self._record.phase, self._name, kind, seconds if changed else None))
        if failures:
            self._fault("wrong answer", "; ".join(failures))

    def _said(self) -> str:
        return ""
