"""One browser's access to the inference scheduler, and models that use it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from explorer.compute.batching import concatenate
from explorer.compute.inference_scheduler import InferenceScheduler
from lpn.core.arrays import Float32Array
from lpn.core.views import View
from lpn.models.base import Model
from lpn.models.contract import ForwardPass, Heads

# A request is superseded only after this many seconds in the queue, because its successor takes time to prepare.
MIN_WAIT = 0.2


class RequestContext:
    """The source of requests, such as a browser; closing it cancels its requests.

    Attributes:
        closed: `close` was called.
    """

    def __init__(self, scheduler: InferenceScheduler) -> None:
        self._scheduler = scheduler
        self.closed = False
        self._superseded = False
        # Cancel at most once per answer; otherwise a user who keeps dragging would never see one (starvation).
        self._may_cancel = False

    def queued(self, model: Model | None, background: bool = False) -> QueuedModel | None:
        """Return a model whose requests belong to this context, or None without a model.

        Args:
            background: long work; it yields to interactive requests and is never refused.
        """
        if isinstance(model, QueuedModel):
            model = model.model
        return None if model is None else QueuedModel(model, self._scheduler, self, background)

    @contextmanager
    def answering(self) -> Iterator[None]:
        """Let a newer state supersede the block's request once; the request then raises SupersededError.

        The next request of the block takes the same place in the queue.
        """
        self._superseded, self._may_cancel = False, True
        try:
            yield
        finally:
            self._may_cancel = False
            self._scheduler.release_position(self)

    def supersede(self) -> None:
        """Record that the state has changed; a waiting request may be out of date."""
        self._superseded = True

    def try_cancel(self, waited: float) -> bool:
        """Return whether to cancel a request; True at most once per answer.

        Args:
            waited: seconds that the request has spent in the queue.
        """
        cancel = self._superseded and self._may_cancel and waited >= MIN_WAIT
        self._may_cancel = self._may_cancel and not cancel
        return cancel

    def close(self) -> None:
        """Cancel the waiting requests and refuse later ones: all raise WorkCancelledError."""
        self._scheduler.close_context(self)


class QueuedModel(Model):
    """A model whose forward passes wait in the scheduler's queue.

    Attributes:
        model: the model without the queue.
    """

    def __init__(
        self,
        model: Model,
        scheduler: InferenceScheduler,
        context: RequestContext,
        background: bool = False,
        cancellable: bool = False,
    ) -> None:
        self.model, self._scheduler, self._context = model, scheduler, context
        self._background, self._cancellable = background, cancellable
        self.contract, self.spec, self.fingerprint = model.contract, model.spec, model.fingerprint
        self.precision, self.batch, self.branches = model.precision, model.batch, model.branches
        self.means, self.whitening = model.means, model.whitening

    def cancellable(self) -> QueuedModel:
        """Return a copy of this model whose requests a newer state may supersede; they then raise SupersededError."""
        return QueuedModel(self.model, self._scheduler, self._context, self._background, cancellable=True)

    def for_task(self, query: View, gallery: View) -> QueuedModel:
        """Return the model for the queries and the gallery of one task, see `Model.for_task`."""
        if self.contract.roles == "view":
            return self
        bound = self._scheduler.bound(self.model, query, gallery)
        return QueuedModel(bound, self._scheduler, self._context, self._background, self._cancellable)

    def run(self, images: Float32Array, view: View) -> ForwardPass:
        """Compute pictures (B, 3, H, W), in several batches if necessary.

        Raises:
            BusyError: when the queue is full.
            SupersededError: see `cancellable`.
            WorkCancelledError: when the context is closed.
            LPNError: when the model cannot compute the pictures.
        """
        size = max(self.batch, 1)
        chunks = [images[start : start + size] for start in range(0, len(images), size)] or [images]
        return concatenate(
            [
                self._scheduler.run(self._context, self.model, chunk, view, self._background, self._cancellable)
                for chunk in chunks
            ]
        )

    def heads(self, view: View) -> Heads:
        """Return the heads of a view, which are equal for all pictures, see `Model.heads`."""
        return self._scheduler.heads(self.model, view)

    def map_size(self, view: View) -> tuple[int, int]:
        """Return (h, w) of the feature map of a picture of the model's input size."""
        return self.model.map_size(view)
