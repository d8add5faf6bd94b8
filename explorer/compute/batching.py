"""Requests for a pass of the network, what is computed with what, and a batch of them computed."""

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
    """Another answer is wanted in place of the one that was asked for."""


class InferenceRequest:
    """Pictures (B, 3, H, W) of one view that wait for their pass."""

    def __init__(
        self,
        asker: RequestContext,
        model: Model,
        images: Float32Array,
        view: View,
        patient: bool,
        replaceable: bool,
        since: float,
    ) -> None:
        self.asker, self.model, self.images, self.view, self.patient = asker, model, images, view, patient
        self.replaceable, self.since = replaceable, since
        self.place = 0
        """Among the answers, the least first."""
        self.kind: Hashable = (model, view, images.shape[1:], images.dtype)
        """Requests of one kind can be computed in one pass."""
        self._ended = threading.Event()
        self._found: ForwardPass | None = None
        self._error: Exception | None = None

    def end(self, found: ForwardPass | None = None, error: Exception | None = None) -> None:
        """Hand over the outcome."""
        self._found, self._error = found, error
        self._ended.set()

    def wait(self) -> ForwardPass:
        """The outcome, waited for; raises what went wrong."""
        self._ended.wait()
        if self._error is not None:
            raise self._error
        assert self._found is not None
        return self._found


def together(waiting: list[InferenceRequest]) -> list[InferenceRequest]:
    """The oldest request, and what can be computed with it."""
    batch, size = waiting[:1], len(waiting[0].images) if waiting else 0
    for request in waiting[1:]:
        if request.kind == batch[0].kind and size + len(request.images) <= request.model.batch:
            batch.append(request)
            size += len(request.images)
    return batch


def told(error: BaseException) -> Exception:
    """An error as it can be raised in the thread that asked, which is not to end by it."""
    return (
        error
        if isinstance(error, Exception)
        else LPNError(f"The network ended with {type(error).__name__}; try again.")
    )


def compute(batch: list[InferenceRequest]) -> None:
    """Run a batch, and hand each request its rows. Where several fail, each is tried alone: what is wrong with one is not
    wrong with the others."""
    first = batch[0]
    try:
        alone = len(batch) == 1
        images = first.images if alone else np.concatenate([request.images for request in batch])
        found = first.model.run(images, first.view)
        rows = [found] if alone else _divided(found, [len(request.images) for request in batch])
    except BaseException as error:  # who asked waits until there is an outcome
        if len(batch) == 1:
            first.end(error=told(error))
        else:
            for request in batch:
                compute([request])
        return
    for request, own in zip(batch, rows, strict=True):
        request.end(own)


def _divided(found: ForwardPass, sizes: list[int]) -> list[ForwardPass]:
    """Each request's rows, copied: a row that is kept would keep the whole batch."""
    ends = np.cumsum([0, *sizes])
    return [
        ForwardPass(*(None if array is None else array[begin:end].copy() for array in found))  # type: ignore[arg-type]
        for begin, end in pairwise(ends)
    ]


def joined(passes: list[ForwardPass]) -> ForwardPass:
    """The passes of pictures that were too many for one, as if they had been one."""
    if len(passes) == 1:
        return passes[0]
    columns = zip(*passes, strict=True)
    parts, features, attention = (
        None if c[0] is None else np.concatenate(cast("list[Float32Array]", c)) for c in columns
    )
    return ForwardPass(cast(Float32Array, parts), cast(Float32Array, features), attention)
