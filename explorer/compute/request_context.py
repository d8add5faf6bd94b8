"""One who asks the queue before the network, such as a browser, and the model that it asks."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from explorer.compute.batching import SupersededError, joined
from explorer.compute.inference_scheduler import InferenceScheduler
from lpn.core.arrays import Float32Array
from lpn.core.views import View
from lpn.models.base import ForwardPass, Heads, Model

T = TypeVar("T")

STALE = 0.2
"""Seconds that an answer must have waited before another is asked for in its place: preparing that one takes time, too."""


class RequestContext:
    """One who asks, such as a browser; what it asks for is dropped when it leaves.

    Attributes:
        left: whether it is gone.
    """

    def __init__(self, inference: InferenceScheduler) -> None:
        self._inference = inference
        self.left = False
        self._moved = False
        self._once = False
        """Whether what it waits for may be called off: once in an answer, or who moves on and on would never have one."""

    def of(self, model: QueuedModel | None, patient: bool = False) -> QueuedModel | None:
        """A model for this one to ask, None for None.

        Args:
            patient: for long work, which lets answers go before it and is never refused.
        """
        return None if model is None else QueuedModel(model.own, self._inference, self, patient)

    def newest(self, answer: Callable[[], T]) -> T:
        """What `answer` makes of the newest state, which it reads itself; where `moved` is called before the turn of its
        `QueuedModel.replaceable` passes has come, it is called again, in the same place of the queue."""
        self._moved, self._once = False, True
        try:
            try:
                return answer()
            except SupersededError:
                return answer()
        finally:
            self._once = False
            self._inference.free(self)

    def moved(self) -> None:
        """It wants another answer than the one that it may be waiting for."""
        self._moved = True

    def calls_off(self, waited: float) -> bool:
        """Whether a pass that has waited some seconds is not wanted any more; true once in an answer."""
        off = self._moved and self._once and waited >= STALE
        self._once = self._once and not off
        return off

    def leave(self) -> None:
        """It is gone: what it waits for is not computed any more, and raises WorkCancelledError; and so does what it asks later."""
        self._inference.drop(self)


class QueuedModel(Model):
    """A model whose passes wait their turn in a queue; for everything that is not a pass, the model itself.

    Attributes:
        own: the model that computes.
    """

    def __init__(
        self,
        own: Model,
        inference: InferenceScheduler,
        asker: RequestContext,
        patient: bool = False,
        replaceable: bool = False,
    ) -> None:
        self.own, self._inference, self._asker, self._patient = own, inference, asker, patient
        self._replaceable = replaceable
        self.spec, self.fingerprint, self.compute, self.batch = own.spec, own.fingerprint, own.compute, own.batch

    def replaceable(self) -> QueuedModel:
        """The same for passes that are of one state alone: SupersededError where another is wanted meanwhile, see `RequestContext.newest`."""
        return QueuedModel(self.own, self._inference, self._asker, self._patient, replaceable=True)

    def run(self, images: Float32Array, view: View) -> ForwardPass:
        """One pass of pictures (B, 3, H, W), waited for; more pictures than one pass has are several.

        Raises:
            BusyError: when too many answers wait.
            SupersededError: see `replaceable`.
            WorkCancelledError: when who asks has left.
            LPNError: as the model does.
        """
        size = max(self.batch, 1)
        chunks = [images[at : at + size] for at in range(0, len(images), size)] or [images]
        asked = self._asker, self.own
        how = self._patient, self._replaceable
        return joined([self._inference.ask(*asked, chunk, view, *how) for chunk in chunks])

    def heads(self, view: View) -> Heads:
        """The affine heads and cell weights for exact explanation; InputError where the model has none."""
        return self._inference.heads(self.own, view)

    def map_size(self, view: View) -> tuple[int, int]:
        """(h, w) of the feature map of a picture of the model's input size."""
        return self.own.map_size(view)
