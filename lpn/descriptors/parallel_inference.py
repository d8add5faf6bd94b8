"""Data-parallel inference: descriptors of many pictures, with a batch per thread.

Each thread reads and prepares a batch and runs the network. On ONNX Runtime the network runs in all threads at once, one core
each, without the synchronisation at every layer that intra-op parallelism needs. A network that must be called by one thread
at a time (on a GPU, or in PyTorch) is locked, while the other threads prepare their batches. Memory holds only the batches in
progress.
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

# Opening a single-threaded session pays off from this many pictures per thread.
_MIN_PICTURES = 32


class DescribedBatch(NamedTuple):
    """The descriptors of one batch.

    Attributes:
        items: positions of the pictures that were described, (B,).
        descriptors: their descriptors, (B, n, D) float32.
        broken: positions of unreadable pictures, with the error.
    """

    items: list[int]
    descriptors: Float32Array
    broken: list[tuple[int, PictureError]]


def describe_each(
    model: Model, items: Sequence[T], prepare: Callable[[T], Float32Array], view: View, threads: int | None = None
) -> Iterator[DescribedBatch]:
    """Yield descriptors of all items, with mirrors if the contract sums both, batch by batch in order of completion.

    After an error, batches in progress are completed and yielded before it is raised.

    Args:
        items: any values, one for each picture.
        prepare: converts an item to the network input, (3, H, W) float32; called by several threads. An item for which it
            raises PictureError is reported as broken.
        threads: number of threads; by default all usable cores.
    """
    threads = min(threads or usable_cores(), -(-len(items) // model.batch))
    if not items:
        return
    if threads > 1 and len(items) >= _MIN_PICTURES * threads:
        model = model.for_parallel_inference()
    lock = nullcontext() if model.parallel else threading.Lock()
    batches = iter([range(a, min(a + model.batch, len(items))) for a in range(0, len(items), model.batch)])

    def work(batch: range) -> DescribedBatch:
        described, inputs, broken = [], [], []
        for i in batch:
            try:
                inputs.append(prepare(items[i]))
                described.append(i)
            except PictureError as error:
                broken.append((i, error))
        if not inputs:
            return DescribedBatch([], np.zeros((0, model.n_parts, model.embedding), np.float32), broken)
        stacked = np.stack(inputs)
        with lock:
            return DescribedBatch(described, model.descriptors(stacked, view), broken)

    failed: BaseException | None = None
    pool = ThreadPoolExecutor(threads, "lpn-inference")
    try:
        # One more batch than threads, so that no thread is idle while this one yields.
        waiting: set[Future[DescribedBatch]] = {pool.submit(work, batch) for batch in islice(batches, threads + 1)}
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
