"""The queue in front of the network, shared by all browsers.

A calling thread waits for its result. So it has at most one request in the queue, and first-in, first-out order is
fair. Background work (sweeps, reports, a second model) has its own queue. Interactive requests have priority, but every
fourth batch is background work, so that it cannot starve. The interactive queue is bounded (back-pressure): further
requests raise `BusyError`, and refused browsers are admitted before new ones. A superseded request gives its place to
the next request of its browser.
"""

from __future__ import annotations

import atexit
import logging
import threading
import time
from bisect import insort
from collections.abc import Callable, Iterable
from itertools import count
from typing import TYPE_CHECKING
from weakref import WeakSet

from explorer.compute.background_jobs import WorkCancelledError
from explorer.compute.batching import InferenceRequest, SupersededError, compute, next_batch
from explorer.compute.cache import SingleFlightCache
from lpn.core.arrays import Float32Array
from lpn.core.errors import LPNError
from lpn.core.views import View
from lpn.models.base import Model
from lpn.models.contract import ForwardPass, Heads

if TYPE_CHECKING:
    from explorer.compute.request_context import RequestContext

log = logging.getLogger(__name__)

# Interactive requests in the queue. A large network takes 0.1 s for each on two cores, so the last one waits for 3 s.
MAX_QUEUED = 32
# While background requests wait, one batch in this many is a background batch.
BACKGROUND_INTERVAL = 4
# Seconds after which a refused browser should retry.
RETRY_AFTER = 0.5
# Seconds for which a refused browser's place in the queue is reserved.
RESERVATION = 4 * RETRY_AFTER
# Seconds without requests after which the thread ends; the next request starts another one.
IDLE_TIMEOUT = 60.0
# Seconds that the end of the program waits for the batches being computed.
END_TIMEOUT = 10.0
_MAX_HEADS = 16
_MAX_BOUND = 16


class BusyError(LPNError):
    """The queue of interactive requests is full."""


class InferenceScheduler:
    """The queue and its one thread, which computes the requests in batches.

    A batch has at most `Model.batch` pictures. Exported models have small batches, because one picture occupies all cores
    of a CPU: larger batches would only increase memory and latency.

    Args:
        max_queued: bound of the interactive queue.
        clock: returns seconds.
    """

    def __init__(self, max_queued: int = MAX_QUEUED, clock: Callable[[], float] = time.monotonic) -> None:
        self._max_queued, self._clock = max_queued, clock
        self._changed = threading.Condition()
        self._interactive: list[InferenceRequest] = []
        self._background: list[InferenceRequest] = []
        self._batches_since_background = 0
        # Refused contexts, oldest first, and the times until which their places are reserved.
        self._refused: dict[RequestContext, float] = {}
        self._positions = count()
        # After a request is superseded, its context keeps the position for its next request.
        self._kept_positions: dict[RequestContext, int] = {}
        self._thread: threading.Thread | None = None
        self._ending = False
        _SCHEDULERS.add(self)
        self._heads: SingleFlightCache[tuple[Model, View], Heads] = SingleFlightCache(_MAX_HEADS)
        self._bound: SingleFlightCache[tuple[Model, View, View], Model] = SingleFlightCache(_MAX_BOUND)

    def heads(self, model: Model, view: View) -> Heads:
        """Return a model's heads, cached: some models read many megabytes for each call."""
        return self._heads.get((model, view), lambda: model.heads(view))

    def bound(self, model: Model, query: View, gallery: View) -> Model:
        """Return a model for a task, see `Model.for_task`. All browsers share it, so that their requests share batches."""
        return self._bound.get((model, query, gallery), lambda: model.for_task(query, gallery))

    def run(
        self,
        context: RequestContext,
        model: Model,
        images: Float32Array,
        view: View,
        background: bool = False,
        cancellable: bool = False,
    ) -> ForwardPass:
        """Queue a request and wait for its result.

        Raises:
            BusyError: when the queue is full.
            SupersededError: when `context` superseded a cancellable request.
            WorkCancelledError: when the context is closed.
        """
        request = InferenceRequest(context, model, images, view, background, cancellable, self._clock())
        with self._changed:
            if context.closed:
                raise WorkCancelledError
            if background:
                self._background.append(request)
            else:
                if context not in self._kept_positions:
                    self._admit(context)
                    self._kept_positions[context] = next(self._positions)
                request.position = self._kept_positions.pop(context)
                insort(self._interactive, request, key=lambda other: other.position)
            if self._thread is None:
                try:
                    self._start_thread()
                except BaseException:  # for example too many threads
                    self._remove([request])
                    raise
            self._changed.notify_all()
        return request.future.result()

    def close_context(self, context: RequestContext) -> None:
        """Close a context: fail its requests and give up its positions."""
        with self._changed:
            context.closed = True
            self._refused.pop(context, None)
            self._kept_positions.pop(context, None)
            dropped = [request for request in (*self._interactive, *self._background) if request.context is context]
            self._remove(dropped)
        for request in dropped:
            request.fail(WorkCancelledError())

    def release_position(self, context: RequestContext) -> None:
        """Give up the position that is reserved for a context's next request."""
        with self._changed:
            self._kept_positions.pop(context, None)

    def end(self) -> threading.Thread | None:
        """Compute no batch after the present one, and return the thread that computes it. Waiting requests get no result."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()
            return self._thread

    def _start_thread(self) -> None:
        thread = threading.Thread(target=self._loop, name="explorer-inference", daemon=True)
        thread.start()
        self._thread = thread

    def _admit(self, context: RequestContext) -> None:
        """Raise BusyError if all free places are reserved for other contexts."""
        now = self._clock()
        self._refused = {other: until for other, until in self._refused.items() if until > now}
        waiting = list(self._refused)
        ahead = waiting.index(context) if context in self._refused else len(waiting)
        if ahead >= self._max_queued - len(self._interactive) - len(self._kept_positions):
            self._refused[context] = now + RESERVATION  # renewing an entry keeps its place in the order
            raise BusyError(f"{len(self._interactive)} requests are queued, which is the limit; try again in a moment.")
        self._refused.pop(context, None)

    def _loop(self) -> None:
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._interactive or self._background or self._ending, IDLE_TIMEOUT)
                    if self._ending:
                        return
                    if not self._interactive and not self._background:
                        self._thread = None
                        return
                    batch = self._next_batch()
                    superseded = self._take_superseded()
                for request in superseded:  # their contexts prepare the next request while this batch is computed
                    request.fail(SupersededError())
                compute(batch)
                del batch  # frees the pictures
        except BaseException as error:
            log.exception("The inference scheduler failed")
            with self._changed:  # fail all requests; the next one starts another thread
                lost, self._thread = [*self._interactive, *self._background], None
                self._remove(lost)
            for request in lost:
                request.fail(error)

    def _next_batch(self) -> list[InferenceRequest]:
        """Take the next batch, of either interactive or background requests only."""
        background = not self._interactive or (
            bool(self._background) and self._batches_since_background >= BACKGROUND_INTERVAL - 1
        )
        counting = bool(self._background) and not background
        self._batches_since_background = self._batches_since_background + 1 if counting else 0
        batch = next_batch(self._background if background else self._interactive)
        self._remove(batch)
        return batch

    def _take_superseded(self) -> list[InferenceRequest]:
        """Take the superseded requests out of the next interactive batch, but keep their positions."""
        now = self._clock()
        superseded = [
            request
            for request in next_batch(self._interactive)
            if request.cancellable and request.context.try_cancel(now - request.enqueued)
        ]
        self._remove(superseded)
        self._kept_positions.update((request.context, request.position) for request in superseded)
        return superseded

    def _remove(self, requests: Iterable[InferenceRequest]) -> None:
        for request in requests:
            (self._background if request.background else self._interactive).remove(request)


_SCHEDULERS: WeakSet[InferenceScheduler] = WeakSet()


@atexit.register
def _end_all() -> None:
    """Stop all schedulers before the interpreter ends: it would end a thread inside C++ code, which aborts the process."""
    deadline = time.monotonic() + END_TIMEOUT
    for thread in [scheduler.end() for scheduler in list(_SCHEDULERS)]:
        if thread is not None:
            thread.join(max(deadline - time.monotonic(), 0))
