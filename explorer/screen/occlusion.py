"""Occlusion of one tab's photo: the loss of the answer's score by each covered square, measured in the background."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

from explorer.compute.background_jobs import WorkCancelledError
from explorer.compute.worker import Worker
from explorer.screen.result import ScreenResult
from lpn.core.arrays import Float32Array
from lpn.core.errors import LPNError
from lpn.explain.occlusion import SQUARES, occlude
from lpn.models.base import Model


@dataclass(frozen=True, eq=False)
class Covering:
    """A result whose photo is to be covered square by square.

    Attributes:
        key: identifies photo, angle, answer, and model, without the part weights.
        number: the result's number, which the messages repeat.
        model: describes the photo like the task's pictures, in the background.
    """

    key: Hashable
    number: int
    result: ScreenResult
    model: Model


class Occlusion:
    """Measures the newest result, and shows the losses so far after each batch of squares.

    Args:
        send: hands a message to the page.
    """

    def __init__(self, send: Callable[[dict[str, Any]], None]) -> None:
        self._send = send
        self._covering: Covering | None = None
        # The last complete measurement: another result of the same pair shows it at once.
        self._measured: tuple[Hashable, Float32Array] | None = None
        self._worker = Worker(self._work)

    def follow(self, covering: Covering | None) -> None:
        """Measure a result from now on; with None, measure nothing."""
        self._covering = covering
        if covering is not None:
            self._worker.wake()

    def stop(self) -> None:
        """End after the current batch."""
        self._covering = None
        self._worker.stop()

    def _work(self) -> None:
        covering = self._covering
        if covering is None:
            return
        if self._measured is not None and self._measured[0] == covering.key:
            self._show(covering, self._measured[1], SQUARES**2)
            return
        result = covering.result
        query, other = result.analysis.query, result.described(result.first).descriptor
        model = covering.model.for_task(*result.task.views)
        try:
            for done, losses in occlude(model, query.picture, result.task.query_view, other):
                if self._covering is not covering:
                    return
                self._show(covering, losses, done)
        except (LPNError, WorkCancelledError):  # the photo still shows its activation
            return
        self._measured = covering.key, losses

    def _show(self, covering: Covering, losses: Float32Array, done: int) -> None:
        shown = covering.result.covered(losses)
        self._send({"occlusion": {"number": covering.number, "done": done, "squares": SQUARES**2, "photo": shown}})
