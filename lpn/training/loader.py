"""Batches for training: worker threads decode and augment pictures a few batches ahead of the network.

The workers are threads, not processes: decoding, resizing, and warping release Python's global lock, and threads share the
cache of decoded pictures.
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
from lpn.training.augmentation import augment, draw_place_pose
from lpn.training.recipes import Recipe
from lpn.training.training_set import TrainingSet

# Minimum number of batches prepared ahead of the network; small batches need more to keep all workers busy.
_PREFETCH = 2
_MAX_WORKERS = 16


@dataclass(frozen=True)
class TrainingBatch:
    """The input of one step.

    Attributes:
        sets: for each picture set, this process's share of the batch: (b, 3, H, W) float32, normalised, channels last.
        places: class of each place of the whole batch, (B,) int64.
    """

    sets: dict[str, Tensor]
    places: Tensor


class Loader:
    """The batches of a training in order. Each place has its own random seed, so the number of workers changes no result.

    Args:
        share: the rows of every batch that this process prepares.
        workers: number of threads; 0 chooses one for the machine, see `choose_workers`.
        processes: number of processes that share the machine.

    Raises:
        InputError: when there are fewer places than rows in a batch, or the number of workers is negative.
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
            raise InputError(f"The training set has {len(places) or 'no'} place; training needs at least two.")
        if len(places) < recipe.batch:
            raise InputError(
                f"There are {len(places)} places and a batch of {recipe.batch}; set --batch to at most {len(places)}."
            )
        if workers < 0:
            raise InputError(
                f"The number of workers is {workers}; expected 1 or more, or 0 to choose it automatically."
            )
        self.places, self.recipe, self.device, self.share = places, recipe, device, share
        self.workers = workers or choose_workers(device, processes)
        rows = len(range(recipe.batch)[share])
        self._prefetch = max(_PREFETCH, -(-2 * self.workers // rows))
        self._scale, self._offset = (
            torch.from_numpy(values).to(device)[:, None, None] for values in (images.SCALE, images.OFFSET)
        )

    @property
    def steps(self) -> int:
        """Steps per epoch. An incomplete last batch is left out."""
        return len(self.places) // self.recipe.batch

    def stream(self, first: int, end: int) -> Iterator[TrainingBatch]:
        """Yield the batches of epochs `first` to `end` - 1. Close the iterator to stop the workers.

        Raises:
            PictureError: when a picture cannot be read.
        """
        pool = ThreadPoolExecutor(self.workers, "lpn-loader")
        ahead: deque[tuple[Int64Array, list[Future[dict[str, UInt8Array]]]]] = deque()
        try:
            for epoch in range(first, end):
                for chunk in self._chunks(epoch):
                    ahead.append((chunk, [pool.submit(self._draw, int(p), epoch) for p in chunk[self.share]]))
                    if len(ahead) > self._prefetch:
                        yield self._batch(*ahead.popleft())
            while ahead:
                yield self._batch(*ahead.popleft())
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def _chunks(self, epoch: int) -> list[Int64Array]:
        order = np.random.default_rng([self.recipe.seed, epoch]).permutation(len(self.places))
        return [order[i * self.recipe.batch : (i + 1) * self.recipe.batch] for i in range(self.steps)]

    def _draw(self, place: int, epoch: int) -> dict[str, UInt8Array]:
        """Draw and augment one picture of each set, (H, W, 3) uint8; runs in a worker."""
        rng = np.random.default_rng([self.recipe.seed, epoch, place])
        angle, mirror = draw_place_pose(self.recipe, rng)
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
        """Move pictures to the device as bytes, and normalise them there."""
        cuda = self.device.type == "cuda"
        raw = torch.empty((len(pictures), *pictures[0].shape), dtype=torch.uint8, pin_memory=cuda)
        np.stack(pictures, out=raw.numpy())
        moved = raw.to(self.device, non_blocking=cuda).permute(0, 3, 1, 2)
        return moved.to(torch.float32).mul_(self._scale).add_(self._offset)


def choose_workers(device: torch.device, processes: int = 1) -> int:
    """Choose the number of worker threads for each of the processes that share the machine.

    With a GPU these are all cores but one, at most 16. Otherwise a quarter of the cores, as the network needs the others.
    """
    own = usable_cores() // processes
    return max(1, min(_MAX_WORKERS, own - 1 if device.type == "cuda" else own // 4))
