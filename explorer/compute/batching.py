"""Requests for forward passes, and their computation in batches."""

from __future__ import annotations

from collections.abc import Hashable
from concurrent.futures import Future
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, cast

import numpy as np

from lpn.core.arrays import Float32Array
from lpn.core.errors import LPNError
from lpn.core.views import View
from lpn.models.base import Model
from lpn.models.contract import ForwardPass

if TYPE_CHECKING:
    from explorer.compute.request_context import RequestContext


class SupersededError(Exception):
    """A newer request has replaced this one."""


@dataclass(eq=False)
class InferenceRequest:
    """Pictures of one view that wait for a forward pass.

    Attributes:
        images: (B, 3, H, W).
        background: long work; interactive requests go first.
        cancellable: dropped when `context` supersedes it.
        enqueued: time at which it was made, in seconds.
        position: order among interactive requests; the smallest is first.
    """

    context: RequestContext
    model: Model
    images: Float32Array
    view: View
    background: bool
    cancellable: bool
    enqueued: float
    position: int = 0
    future: Future[ForwardPass] = field(default_factory=Future)

    @property
    def batch_key(self) -> Hashable:
        """A key that is equal for requests that may share a batch."""
        return self.model, self.view, self.images.shape[1:], self.images.dtype

    def fail(self, error: BaseException) -> None:
        """Raise an error in the waiting thread; SystemExit and the like become LPNError, so that the thread survives."""
        if not isinstance(error, Exception):
            error = LPNError(f"The forward pass raised {type(error).__name__}; try again.")
        self.future.set_exception(error)


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
    first, alone = batch[0], len(batch) == 1
    try:
        images = first.images if alone else np.concatenate([request.images for request in batch])
        result = first.model.run(images, first.view)
        results = [result] if alone else _split(result, [len(request.images) for request in batch])
    except BaseException as error:  # wake every waiting thread
        if alone:
            first.fail(error)
        else:
            for request in batch:
                compute([request])
        return
    for request, result in zip(batch, results, strict=True):
        request.future.set_result(result)


def _split(result: ForwardPass, sizes: list[int]) -> list[ForwardPass]:
    """Return a copy of each request's rows; a slice would keep the whole batch in memory."""
    return [
        ForwardPass(*(None if array is None else array[begin:end].copy() for array in result))  # type: ignore[arg-type]
        for begin, end in pairwise(np.cumsum([0, *sizes]))
    ]


def concatenate(results: list[ForwardPass]) -> ForwardPass:
    """Join the results of consecutive batches."""
    if len(results) == 1:
        return results[0]
    joined = [
        None if column[0] is None else np.concatenate(cast("list[Float32Array]", column))
        for column in zip(*results, strict=True)
    ]
    return ForwardPass(cast(Float32Array, joined[0]), *joined[1:])
