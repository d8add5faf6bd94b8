"""Requests for forward passes, and their computation in batches."""

from __future__ import annotations

import threading
from collections.abc import Hashable
from itertools import pairwise
from typing import TYPE_CHECKING, cast

import numpy as np

from lpn.core.arrays import Float32Array
from lpn.core.errors import LPNError
from lpn.core.views import View
from lpn.models.base import ForwardPass, Model

if TYPE_CHECKING:
    from explorer.compute.request_context import RequestContext


class SupersededError(Exception):
    """A newer request has replaced this one."""


class InferenceRequest:
    """Pictures (B, 3, H, W) of one view that wait for a forward pass.

    Args:
        background: long work, which lets interactive requests go first.
        cancellable: dropped when `context` supersedes it.
        enqueued: time at which it was made, in seconds.

    Attributes:
        position: order among interactive requests; the smallest is first.
        batch_key: requests of equal keys may share a batch.
    """

    def __init__(
        self,
        context: RequestContext,
        model: Model,
        images: Float32Array,
        view: View,
        background: bool,
        cancellable: bool,
        enqueued: float,
    ) -> None:
        self.context, self.model, self.images, self.view = context, model, images, view
        self.background, self.cancellable, self.enqueued = background, cancellable, enqueued
        self.position = 0
        self.batch_key: Hashable = (model, view, images.shape[1:], images.dtype)
        self._finished = threading.Event()
        self._result: ForwardPass | None = None
        self._error: BaseException | None = None

    def finish(self, result: ForwardPass) -> None:
        """Wake the waiting thread with a result."""
        self._result = result
        self._finished.set()

    def fail(self, error: BaseException) -> None:
        """Wake the waiting thread with an error."""
        self._error = error
        self._finished.set()

    def wait(self) -> ForwardPass:
        """Wait for the result; raise the error if it failed."""
        self._finished.wait()
        if isinstance(self._error, Exception):
            raise self._error
        if self._error is not None:  # SystemExit and the like must not end the waiting thread
            raise LPNError(f"The network ended with {type(self._error).__name__}; try again.")
        assert self._result is not None
        return self._result


def next_batch(requests: list[InferenceRequest]) -> list[InferenceRequest]:
    """Return the first request, and further ones that fit into its batch."""
    batch, size = requests[:1], len(requests[0].images) if requests else 0
    for request in requests[1:]:
        if request.batch_key == batch[0].batch_key and size + len(request.images) <= request.model.batch:
            batch.append(request)
            size += len(request.images)
    return batch


def compute(batch: list[InferenceRequest]) -> None:
    """Compute a batch. If it fails, compute each request alone, so that one bad request does not fail the others."""
    first = batch[0]
    try:
        if len(batch) == 1:
            first.finish(first.model.run(first.images, first.view))
            return
        results = _split(
            first.model.run(np.concatenate([request.images for request in batch]), first.view),
            [len(request.images) for request in batch],
        )
    except BaseException as error:  # every waiting thread must be woken
        if len(batch) == 1:
            first.fail(error)
        else:
            for request in batch:
                compute([request])
        return
    for request, result in zip(batch, results, strict=True):
        request.finish(result)


def _split(result: ForwardPass, sizes: list[int]) -> list[ForwardPass]:
    """Return each request's rows as copies; a view would keep the whole batch in memory."""
    return [
        ForwardPass(*(None if array is None else array[begin:end].copy() for array in result))  # type: ignore[arg-type]
        for begin, end in pairwise(np.cumsum([0, *sizes]))
    ]


def concatenate(results: list[ForwardPass]) -> ForwardPass:
    """Join the results of consecutive batches."""
    if len(results) == 1:
        return results[0]
    parts, features, attention = (
        None if column[0] is None else np.concatenate(cast("list[Float32Array]", column))
        for column in zip(*results, strict=True)
    )
    return ForwardPass(cast(Float32Array, parts), cast(Float32Array, features), attention)
