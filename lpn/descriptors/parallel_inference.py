"""Descriptors of many pictures at the speed of the machine.

Several threads each take the next few pictures, read and prepare them, and have the network compute. A network on the CPU
runs in all of them at once, one core to each: nothing is divided among cores and put together again at every layer, and no
core waits for another. A network that is best used by one caller at a time (on a GPU, or in PyTorch) is used in turn, while
the other threads prepare what comes next. Either way no more pictures are in memory than the threads have in hand.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import nullcontext
from itertools import islice
from typing import NamedTuple, TypeVar

import numpy as np

from lpn.core.arrays import Float32Array
from lpn.core.errors import PictureError
from lpn.core.resources import usable_cores
from lpn.core.views import View
from lpn.models.base import Model

T = TypeVar("T")

_WORTH_OPENING = 32
"""Pictures for each stream from which a network of its own for streams pays for being opened."""


class DescribedRow(NamedTuple):
    """A few pictures.

    Attributes:
        items: positions of the pictures that were described, (B,).
        descriptors: theirs, (B, n, D) float32.
        broken: positions of pictures that could not be read, with what is wrong.
    """

    items: list[int]
    descriptors: Float32Array
    broken: list[tuple[int, PictureError]]


def describe_each(
    model: Model, items: Sequence[T], prepare: Callable[[T], Float32Array], view: View, streams: int | None = None
) -> Iterator[DescribedRow]:
    """Descriptors of all items, mirror included, a few at a time, in the order in which they are done.

    After an error what is in hand is finished and given before it is raised, so that it need not be computed again.

    Args:
        items: whatever stands for a picture.
        prepare: makes an item the network's input, (3, H, W) float32; called by several threads at once. Where it raises
            PictureError, the others go on.
        streams: threads; by default as many as there are cores.
    """
    streams = min(streams or usable_cores(), -(-len(items) // model.batch))
    if not items:
        return
    if streams > 1 and len(items) >= _WORTH_OPENING * streams:
        model = model.for_parallel_inference()
    turn = nullcontext() if model.parallel else threading.Lock()
    batches = iter([range(a, min(a + model.batch, len(items))) for a in range(0, len(items), model.batch)])

    def work(batch: range) -> DescribedRow:
        described, inputs, broken = [], [], []
        for i in batch:
            try:
                inputs.append(prepare(items[i]))
                described.append(i)
            except PictureError as error:
                broken.append((i, error))
        if not inputs:
            return DescribedRow([], np.zeros((0, model.n_parts, model.spec.embedding), np.float32), broken)
        stacked = np.stack(inputs)
        with turn:
            return DescribedRow(described, model.descriptors(stacked, view), broken)

    failed: BaseException | None = None
    pool = ThreadPoolExecutor(streams, "lpn-stream")
    try:
        # One more than there are threads, so that none waits for this one to wake up.
        waiting: set[Future[DescribedRow]] = {pool.submit(work, batch) for batch in islice(batches, streams + 1)}
        while waiting:
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            if failed is None:
                waiting |= {pool.submit(work, batch) for batch in islice(batches, len(done))}
            for future in done:
                if (error := future.exception()) is not None:
                    failed = failed or error
                else:
                    yield future.result()
        if failed is not None:
            raise failed
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
