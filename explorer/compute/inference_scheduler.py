"""One queue before the network for all browsers: what waits is computed together, in the order in which it came.

A thread that asks waits for its pass, so it has one in the queue at a time, and the order of coming is a round among all that
ask: nobody waits longer than one pass of everybody else. Long work (profiles, reports, a second model) asks for a pass at a
time, too. Answers go before it, yet one of `TURN` passes is its own. Of answers no more wait than there is room for;
the next are refused, and who was refused is taken before those who come for the first time. Who wants another answer by the
time its turn is next asks for that one in the same place.
"""

from __future__ import annotations

import logging
import threading
import time
from bisect import insort
from collections.abc import Callable, Iterable
from itertools import count
from typing import TYPE_CHECKING

from explorer.compute.background_jobs import WorkCancelledError
from explorer.compute.batching import InferenceRequest, SupersededError, compute, together, told
from lpn.core.arrays import Float32Array
from lpn.core.errors import LPNError
from lpn.core.views import View
from lpn.models.base import ForwardPass, Heads, Model

if TYPE_CHECKING:
    from explorer.compute.request_context import RequestContext

log = logging.getLogger(__name__)

ROOM = 32
"""Answers that wait at a time. A large network on two cores takes a tenth of a second for each, so the last waits for three."""
TURN = 4
"""Of so many passes, one is of long work where some waits, however many answers do."""
AGAIN = 0.5
"""Seconds after which who was refused had best ask again."""
KEPT = 4 * AGAIN
"""Seconds for which a place is kept for who was refused, and may come again."""
IDLE = 60.0
"""Seconds without work after which the queue's thread ends; the next request begins one."""


class BusyError(LPNError):
    """More answers wait than there is room for."""


class InferenceScheduler:
    """The queue, and the one thread that computes what waits in it.

    A pass has at most `Model.batch` pictures, four of an exported model, which is two browsers' pictures with their mirrors:
    a CPU's cores are busy with one picture already, so a larger batch takes longer in proportion, all of it wait for the next
    answers, and the memory of its feature maps. A model in PyTorch says eight, on a GPU 64.

    Args:
        room: answers that wait at a time.
        clock: seconds from any beginning.
    """

    def __init__(self, room: int = ROOM, clock: Callable[[], float] = time.monotonic) -> None:
        self._room, self._clock = room, clock
        self._changed = threading.Condition()
        self._answers: list[InferenceRequest] = []
        self._long: list[InferenceRequest] = []
        self._passed_over = 0
        """Passes since long work had its turn, while some waits."""
        self._refused: dict[RequestContext, float] = {}
        """Who was refused, the first first, and until when a place is kept."""
        self._places = count()
        self._held: dict[RequestContext, int] = {}
        """The places of those who were told that another answer is wanted, and have not asked for it yet."""
        self._thread: threading.Thread | None = None
        self._heads: dict[tuple[Model, View], Heads] = {}
        self._heads_lock = threading.Lock()

    @property
    def waiting(self) -> int:
        """Requests that are in the queue, without those that are being computed."""
        with self._changed:
            return len(self._answers) + len(self._long)

    def heads(self, model: Model, view: View) -> Heads:
        """A model's heads, read once: some models make them anew, of many megabytes, whenever they are asked."""
        with self._heads_lock:
            key = model, view
            if key not in self._heads:
                self._heads[key] = model.heads(view)
            return self._heads[key]

    def ask(
        self,
        asker: RequestContext,
        model: Model,
        images: Float32Array,
        view: View,
        patient: bool = False,
        replaceable: bool = False,
    ) -> ForwardPass:
        """One pass, waited for.

        Raises:
            BusyError: when too many answers wait.
            SupersededError: when it is replaceable, and the asker has moved on.
            WorkCancelledError: when the asker has left.
        """
        request = InferenceRequest(asker, model, images, view, patient, replaceable, self._clock())
        with self._changed:
            if asker.left:
                raise WorkCancelledError
            if patient:
                self._long.append(request)
            else:
                if asker not in self._held:
                    self._admit(asker)
                    self._held[asker] = next(self._places)
                request.place = self._held.pop(asker)
                insort(self._answers, request, key=lambda one: one.place)
            if self._thread is None:
                try:
                    self._begin()
                except BaseException:  # as when there can be no more threads: this one would wait for ever
                    self._take([request])
                    raise
            self._changed.notify_all()
        return request.wait()

    def drop(self, asker: RequestContext) -> None:
        """Take out of the queue what an asker waits for; see `RequestContext.leave`."""
        with self._changed:
            asker.left = True
            self._refused.pop(asker, None)
            self._held.pop(asker, None)
            dropped = [request for request in (*self._answers, *self._long) if request.asker is asker]
            self._take(dropped)
        for request in dropped:
            request.end(error=WorkCancelledError())

    def free(self, asker: RequestContext) -> None:
        """Give the place of an asker back that was to ask for another answer."""
        with self._changed:
            self._held.pop(asker, None)

    def _begin(self) -> None:
        thread = threading.Thread(target=self._loop, name="explorer-inference", daemon=True)
        thread.start()
        self._thread = thread

    def _admit(self, asker: RequestContext) -> None:
        """Raise BusyError unless there is room beside those who were refused before."""
        now = self._clock()
        self._refused = {one: until for one, until in self._refused.items() if until > now}
        before = list(self._refused)
        place = before.index(asker) if asker in self._refused else len(before)
        if place >= self._room - len(self._answers) - len(self._held):
            self._refused[asker] = now + KEPT  # in its old place, where it had one
            raise BusyError(
                f"{len(self._answers)} answers are waited for already, and no more are taken; ask again in a moment."
            )
        self._refused.pop(asker, None)

    def _loop(self) -> None:
        try:
            self._work()
        except BaseException as error:
            log.exception("The queue before the network failed")
            with self._changed:  # nobody would answer these; who asks next begins anew
                lost, self._thread = [*self._answers, *self._long], None
                self._take(lost)
            for request in lost:
                request.end(error=told(error))

    def _work(self) -> None:
        while True:
            with self._changed:
                while not self._answers and not self._long:
                    if not self._changed.wait(IDLE) and not self._answers and not self._long:
                        self._thread = None
                        return
                batch = self._next()
                moved = self._moved()
            for request in moved:  # what is wanted instead is prepared during the pass
                request.end(error=SupersededError())
            compute(batch)
            del batch  # its pictures would stay until the next

    def _next(self) -> list[InferenceRequest]:
        """The oldest request of those whose turn it is, and what can be computed with it."""
        long = not self._answers or (bool(self._long) and self._passed_over >= TURN - 1)
        self._passed_over = self._passed_over + 1 if self._long and not long else 0
        # Never both in a pass: an answer would take as long as both.
        batch = together(self._long if long else self._answers)
        self._take(batch)
        return batch

    def _moved(self) -> list[InferenceRequest]:
        """Those of the next pass of answers that are not wanted as they are, taken out; their places are held."""
        now = self._clock()
        moved = [one for one in together(self._answers) if one.replaceable and one.asker.calls_off(now - one.since)]
        self._take(moved)
        self._held.update((request.asker, request.place) for request in moved)
        return moved

    def _take(self, requests: Iterable[InferenceRequest]) -> None:
        for request in requests:
            (self._long if request.patient else self._answers).remove(request)
