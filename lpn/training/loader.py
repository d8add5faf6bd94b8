"""Batches for training: pictures decoded and augmented by several threads, some batches ahead of the network.

Threads rather than processes: decoding, resizing, and warping leave Python's lock, so two threads do as much as two
processes, and share the pictures that are kept decoded.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lpn.core import images
from lpn.core.arrays import Int64Array, UInt8Array
from lpn.core.errors import InputError
from lpn.core.resources import usable_cores
from lpn.core.views import branch_of
from lpn.training.augmentation import augment, place_draw
from lpn.training.recipes import Recipe
from lpn.training.training_set import TrainingSet

_AHEAD = 2
"""Batches in preparation while one is computed with; more for batches so small that they would leave workers idle."""
_MOST_WORKERS = 16


@dataclass(frozen=True)
class TrainingBatch:
    """One step's input.

    Attributes:
        sets: for each picture set, this process's share of the batch, (b, 3, H, W) float32, normalised, channels last.
        places: class of each place of the whole batch, (B,) int64.
    """

    sets: dict[str, Tensor]
    places: Tensor


class Loader:
    """The batches of a training in order, the same for any number of workers: every place's draws have a seed of their own.

    Args:
        share: the rows of every batch that are prepared.
        workers: threads; 0 for what suits the machine, see `choose_workers`.
        processes: how many processes share the machine.

    Raises:
        InputError: when there are fewer places than a batch has, or the number of workers is negative.
    """

    def __init__(
        self,
        places: TrainingSet,
        recipe: Recipe,
        device: torch.device,
        share: slice = slice(None),
        workers: int = 0,
        processes: int = 1,
    ) -> None:
        if len(places) < 2:
            raise InputError(
                f"There is {len(places) or 'no'} place to train on, and a training tells places apart; give at least two."
            )
        if len(places) < recipe.batch:
            raise InputError(
                f"There are {len(places)} places and a batch of {recipe.batch}; set --batch to at most that."
            )
        if workers < 0:
            raise InputError(
                f"The number of workers is {workers}; expected 1 or more, or 0 for what suits the machine."
            )
        self.places, self.recipe, self.device, self.share = places, recipe, device, share
        self.workers = workers or choose_workers(device, processes)
        rows = len(range(recipe.batch)[share])
        self._ahead = max(_AHEAD, -(-2 * self.workers // rows))
        self._scale, self._offset = (
            torch.from_numpy(values).to(device)[:, None, None] for values in (images.SCALE, images.OFFSET)
        )

    @property
    def steps(self) -> int:
        """Steps per epoch; places that do not fill a batch wait for another epoch's order."""
        return len(self.places) // self.recipe.batch

    def stream(self, first: int, end: int) -> Iterator[TrainingBatch]:
        """The batches of the epochs `first` to `end` - 1, prepared ahead across the border of epochs.

        Close it to stop the workers.

        Raises:
            PictureError: when a picture cannot be read.
        """
        pool = ThreadPoolExecutor(self.workers, "lpn-loader")
        ahead: deque[tuple[Int64Array, list[Future[dict[str, UInt8Array]]]]] = deque()
        try:
            for epoch in range(first, end):
                for chunk in self._chunks(epoch):
                    ahead.append((chunk, [pool.submit(self._place, int(p), epoch) for p in chunk[self.share]]))
                    if len(ahead) > self._ahead:
                        yield self._batch(*ahead.popleft())
            while ahead:
                yield self._batch(*ahead.popleft())
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def _chunks(self, epoch: int) -> list[Int64Array]:
        order = np.random.default_rng([self.recipe.seed, epoch]).permutation(len(self.places))
        return [order[i * self.recipe.batch : (i + 1) * self.recipe.batch] for i in range(self.steps)]

    def _place(self, place: int, epoch: int) -> dict[str, UInt8Array]:
        """One picture of each set, (H, W, 3) uint8: a worker's task."""
        rng = np.random.default_rng([self.recipe.seed, epoch, place])
        angle, mirror = place_draw(self.recipe, rng)
        drawn = {}
        for name, files in self.places.files.items():
            path = files[place][int(rng.integers(len(files[place])))]
            picture = self.places.picture(path)
            panorama = self.places.panoramas and name == "street"
            drawn[name] = augment(picture, self.recipe, rng, angle, mirror, branch_of(name), panorama)
        return drawn

    def _batch(self, chunk: Int64Array, tasks: Sequence[Future[dict[str, UInt8Array]]]) -> TrainingBatch:
        drawn = [task.result() for task in tasks]
        sets = {name: self._network_input([pictures[name] for pictures in drawn]) for name in drawn[0]}
        return TrainingBatch(sets, torch.from_numpy(chunk).to(self.device))

    def _network_input(self, pictures: Sequence[UInt8Array]) -> Tensor:
        """Pictures to the device as bytes, and normalised there."""
        cuda = self.device.type == "cuda"
        raw = torch.empty((len(pictures), *pictures[0].shape), dtype=torch.uint8, pin_memory=cuda)
        np.stack(pictures, out=raw.numpy())
        moved = raw.to(self.device, non_blocking=cuda).permute(0, 3, 1, 2)
        return moved.to(torch.float32).mul_(self._scale).add_(self._offset)


def choose_workers(device: torch.device, processes: int = 1) -> int:
    """How many threads prepare pictures, for each of the processes that share the machine.

    Beside a GPU all cores but the one that drives it, up to 16. Beside a network that computes on the CPU, one in four.
    """
    own = usable_cores() // processes
    return max(1, min(_MOST_WORKERS, own - 1 if device.type == "cuda" else own // 4))
