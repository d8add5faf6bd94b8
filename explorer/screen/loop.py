"""One tab's loop: the newest state wins, one analysis runs at a time, and each analysis leads to one result."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

from explorer.compute.batching import SupersededError
from explorer.compute.inference_scheduler import RETRY_AFTER, BusyError
from explorer.compute.request_context import RequestContext
from explorer.compute.worker import Worker
from explorer.screen.fields import ScreenState
from lpn.core.errors import LPNError

ScreenMessage = dict[str, Any]


class Loop:
    """Answers the newest state on its own thread.

    Args:
        answer: returns the result of a state; called on one thread.
        send: hands a message to the page.
        requests: returns the tab's request context of the newest state.
        on_result: called after each result with its state.
    """

    def __init__(
        self,
        answer: Callable[[ScreenState], ScreenMessage],
        send: Callable[[ScreenMessage], None],
        requests: Callable[[], RequestContext],
        on_result: Callable[[ScreenState], None],
    ) -> None:
        self._answer, self._send, self._requests, self._on_result = answer, send, requests, on_result
        # The newest state, and the last answered one, compared by identity.
        self._asked: ScreenState
        self._answered: ScreenState | None = None
        self._worker = Worker(self._work, self._fail)

    def show(self, state: ScreenState) -> None:
        """Answer a state as soon as the current analysis has ended; states in between are skipped."""
        self._asked = state
        self._requests().supersede()
        self._worker.wake()

    def stop(self) -> None:
        """End after the current analysis."""
        self._worker.stop()

    def _work(self) -> float | None:
        if self._answered is self._asked:  # an earlier run has answered it
            return None
        message: ScreenMessage | None = None
        try:
            with self._requests().answering():
                while message is None:  # repeats after a newer state has superseded the request
                    state = self._asked
                    with suppress(SupersededError):
                        message = self._answer(state)
        except BusyError:
            self._send({"busy": "The server is busy. Trying again."})
            return RETRY_AFTER
        self._answered = state
        self._send({"result": message})
        self._on_result(state)
        return None

    def _fail(self, error: Exception) -> None:
        text = str(error) if isinstance(error, LPNError) else "Something failed; the server's log has the details."
        self._send({"error": text})
