from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import pytest

from explorer.compute.batching import SupersededError
from explorer.compute.inference_scheduler import BusyError, InferenceScheduler
from explorer.compute.request_context import RequestContext
from explorer.screen import loop as loop_module
from explorer.screen.fields import ScreenState
from explorer.screen.loop import Loop
from lpn.core.errors import DataError
from tools.fixtures.waiting import TIMEOUT, wait_until

STATE = ScreenState(place="data", task="drone-to-satellite")


class Bench:
    """A loop with an answer that waits until it may end."""

    def __init__(self) -> None:
        self.sent: list[dict[str, Any]] = []
        self.answered: list[float] = []
        self.done: list[ScreenState] = []
        self.began, self.may_end = threading.Semaphore(0), threading.Semaphore(0)
        self.errors: list[Exception] = []
        context = RequestContext(InferenceScheduler())
        self.loop = Loop(self._answer, self.sent.append, lambda: context, self.done.append)

    def _answer(self, state: ScreenState) -> dict[str, Any]:
        self.began.release()
        assert self.may_end.acquire(timeout=TIMEOUT)
        if self.errors:
            raise self.errors.pop()
        self.answered.append(state.angle)
        return {"angle": state.angle}

    def show(self, angle: float) -> None:
        self.loop.show(replace(STATE, angle=angle))


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_one_analysis_is_in_flight_and_the_newest_state_is_next(bench: Bench) -> None:
    bench.show(1)
    assert bench.began.acquire(timeout=TIMEOUT)
    for angle in (2, 3, 4):
        bench.show(angle)
    bench.may_end.release(2)
    wait_until(lambda: len(bench.done) == 2)
    bench.loop.stop()
    assert bench.answered == [1, 4]
    assert bench.sent == [{"result": {"angle": 1}}, {"result": {"angle": 4}}]
    assert [state.angle for state in bench.done] == [1, 4]


def test_a_state_that_a_newer_one_supersedes_is_never_sent(bench: Bench) -> None:
    bench.errors = [SupersededError()]
    bench.show(1)
    assert bench.began.acquire(timeout=TIMEOUT)
    bench.show(2)
    bench.may_end.release(3)
    wait_until(lambda: bench.done)
    bench.loop.stop()
    assert bench.sent[0] == {"result": {"angle": 2}}


@pytest.mark.parametrize(
    ("error", "says"),
    [(DataError("The picture is damaged."), "The picture is damaged."), (ValueError("secret"), "the server's log")],
)
def test_an_error_is_said_and_the_loop_goes_on(bench: Bench, error: Exception, says: str) -> None:
    bench.errors = [error]
    bench.may_end.release(2)
    bench.show(1)
    wait_until(lambda: bench.sent)
    assert says in bench.sent[0]["error"]
    assert "secret" not in str(bench.sent)
    bench.show(2)
    wait_until(lambda: bench.done)
    bench.loop.stop()
    assert bench.sent[-1] == {"result": {"angle": 2}}


def test_a_busy_server_is_asked_again(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop_module, "RETRY_AFTER", 0.01)
    bench.errors = [BusyError("full")]
    bench.may_end.release(2)
    bench.show(1)
    wait_until(lambda: bench.done)
    bench.loop.stop()
    assert list(bench.sent[0]) == ["busy"]
    assert bench.sent[-1] == {"result": {"angle": 1}}
