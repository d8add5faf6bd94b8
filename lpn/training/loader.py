"""Batches for training: worker threads decode and augment pictures a few batches ahead of the network.

The workers are threads, not processes: decoding, resizing, and warping release Python's global lock, and threads share the
cache of decoded pictures.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lpn.core import images
from lpn.core.arrays import BoolArray, Int64Array, UInt8Array
from lpn.core.errors import InputError
from lpn.core.resources import usable_cores
from lpn.core.views import branch_of
from lpn.training.augmentation import augment, draw_place_pose
from lpn.training.map_windows import MapWindows
from lpn.training.recipe import Recipe
from lpn.training.training_set import TrainingSet

# Minimum number of batches prepared ahead of the network; small batches need more to keep all workers busy.
_PREFETCH = 2
_MAX_WORKERS = 16

# The pictures of each set of a row, or one picture of one set.
_Drawn = dict[str, list[UInt8Array]]
_Row = Callable[[], _Drawn]
# The class of each row of a batch, by set.
_Labels = dict[str, Int64Array]


@dataclass(frozen=True)
class TrainingBatch:
    """The input of one step.

    Attributes:
        sets: for each picture set, its rows of the batch: (B, 3, H, W) float32, normalised, channels last.
        labels: for each picture set, the class of each row, (B,) int64.
        overlaps: for windows of a map, the pairs of rows that share ground, (B, B) bool; else None.
    """

    sets: dict[str, Tensor]
    labels: dict[str, Tensor]
    overlaps: Tensor | None = None

    @property
    def pictures(self) -> int:
        """Number of pictures in all sets."""
        return sum(len(labels) for labels in self.labels.values())


class Loader:
    """The batches of a training in order, sampled by the recipe.

    With `sampling = places`, a row of a batch is one place in each set, with one picture, or with `positives` drone pictures. If
    a place has no picture in a set, its row there shows another place with that place's label, drawn anew each epoch;
    `lpn.training.losses` compares only rows of equal labels.

    Each place of an epoch, or each picture with `sampling = pictures`, has its own random seed, so the number of workers changes
    no result.

    Args:
        workers: number of threads; 0 chooses one for the machine, see `choose_workers`.

    Raises:
        InputError: when there are fewer places or pictures than rows in a batch, or the number of workers is negative.
    """

    def __init__(
        self, places: TrainingSet | MapWindows, recipe: Recipe, device: torch.device, workers: int = 0
    ) -> None:
        if len(places) < 2:
            raise InputError(f"The training set has {len(places) or 'no'} place; training needs at least two.")
        if workers < 0:
            raise InputError(
                f"The number of workers is {workers}; expected 1 or more, or 0 to choose it automatically."
            )
        self.places, self.recipe, self.device = places, recipe, device
        self._pictures: dict[str, list[tuple[Path, int]]] = {}
        self._files: dict[str, list[list[Path]]] = {}
        if isinstance(places, TrainingSet) and recipe.sampling == "pictures":
            self._pictures = places.pictures()
        elif isinstance(places, TrainingSet):
            self._files = places.drawn_from()
        # The places with pictures, by set.
        self._there = {name: np.flatnonzero([bool(of) for of in files]) for name, files in self._files.items()}
        # An epoch ends with the shortest set.
        self._length = min(map(len, self._pictures.values()), default=len(places))
        if self._length < recipe.batch:
            what = f"pictures in the smallest set, {self.shortest}," if self._pictures else "places"
            without = ", or leave that set out with --no-google" if self.shortest == "google" else ""
            raise InputError(
                f"There are {self._length} {what} and a batch of {recipe.batch}; set --batch to at most {self._length}{without}."
            )
        self.workers = workers or choose_workers(device)
        self._prefetch = max(_PREFETCH, -(-2 * self.workers // recipe.batch))
        self._scale, self._offset = (
            torch.from_numpy(values).to(device)[:, None, None] for values in images.scale_and_offset()
        )

    @property
    def shortest(self) -> str:
        """The set with the fewest pictures, which ends an epoch; empty if sampling goes over places."""
        return min(self._pictures, key=lambda name: len(self._pictures[name]), default="")

    @property
    def steps(self) -> int:
        """Steps per epoch. An incomplete last batch is left out."""
        return self._length // self.recipe.batch

    def stream(self, first: int, end: int) -> Iterator[TrainingBatch]:
        """Yield the batches of epochs `first` to `end` - 1. Close the iterator to stop the workers.

        Raises:
            PictureError: when a picture cannot be read.
        """
        pool = ThreadPoolExecutor(self.workers, "lpn-loader")
        ahead: deque[tuple[_Labels, BoolArray | None, list[Future[_Drawn]]]] = deque()
        try:
            for epoch in range(first, end):
                for labels, overlaps, rows in self._batches(epoch):
                    ahead.append((labels, overlaps, [pool.submit(row) for row in rows]))
                    if len(ahead) > self._prefetch:
                        yield self._batch(*ahead.popleft())
            while ahead:
                yield self._batch(*ahead.popleft())
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def _batches(self, epoch: int) -> Iterator[tuple[_Labels, BoolArray | None, list[_Row]]]:
        """Yield each batch's labels by set, its pairs of windows that share ground, and the work for its rows."""
        seed, sets = [self.recipe.seed, epoch], self.places
        if isinstance(sets, MapWindows):
            for places in self._chunks(len(sets), seed):
                rows: list[_Row] = [partial(sets.draw, place, epoch) for place in places.tolist()]
                yield dict.fromkeys(sets.views, places), sets.overlapping(places, epoch), rows
        elif self.recipe.sampling == "places":
            for places in self._chunks(len(sets), seed):
                labels = {
                    name: self._labels_of(name, number, places, epoch) for number, name in enumerate(self._files, 1)
                }
                rows = [
                    partial(
                        self._draw,
                        sets,
                        [*seed, place],
                        {name: self._files[name][of[row]] for name, of in labels.items()},
                    )
                    for row, place in enumerate(places.tolist())
                ]
                yield {name: np.repeat(of, self._per_place(name)) for name, of in labels.items()}, None, rows
        else:
            orders = [
                self._chunks(len(pictures), [*seed, number]) for number, pictures in enumerate(self._pictures.values())
            ]
            # The orders of longer sets have more chunks.
            for chunks in zip(*orders, strict=False):
                of_sets = list(zip(self._pictures, chunks, strict=True))
                labels = {
                    name: np.array([self._pictures[name][i][1] for i in chunk], np.int64) for name, chunk in of_sets
                }
                # A seed that ends in zero would repeat the random numbers of the set's order.
                rows = [
                    partial(self._draw, sets, [*seed, number, index + 1], {name: [self._pictures[name][index][0]]})
                    for number, (name, chunk) in enumerate(of_sets)
                    for index in chunk.tolist()
                ]
                yield labels, None, rows

    def _chunks(self, count: int, seed: list[int]) -> list[Int64Array]:
        """Shuffle the numbers below `count`, and cut them into whole batches."""
        order = np.random.default_rng(seed).permutation(count)
        batch = self.recipe.batch
        return [order[start : start + batch] for start in range(0, count - batch + 1, batch)]

    def _per_place(self, name: str) -> int:
        """Pictures of a place in a batch of places."""
        return self.recipe.positives if name == "drone" else 1

    def _labels_of(self, name: str, number: int, places: Int64Array, epoch: int) -> Int64Array:
        """Return the place shown by each row of a set: its own, or another one if that has no picture in the set.

        Args:
            number: the set's number, from 1; a zero would repeat the random numbers of `_draw`.
        """
        labels = places.copy()
        for row, place in enumerate(places):
            if not self._files[name][place]:
                rng = np.random.default_rng([self.recipe.seed, epoch, int(place), number])
                labels[row] = rng.choice(self._there[name])
        return labels

    def _draw(self, places: TrainingSet, seed: list[int], files: Mapping[str, Sequence[Path]]) -> _Drawn:
        """Draw and augment pictures of each set, (H, W, 3) uint8 each, in a worker."""
        recipe, rng = self.recipe, np.random.default_rng(seed)
        angle, mirror = draw_place_pose(recipe, rng) if recipe.sampling == "places" else (0.0, False)
        drawn = {}
        for name, of in files.items():
            count, panorama = self._per_place(name), places.panoramas and name == "street"
            # Too few files are repeated in turn, as released.
            chosen = [rng.integers(len(of))] if count == 1 else np.resize(rng.permutation(len(of)), count)
            pictures = (places.picture(of[int(i)]) for i in chosen)
            drawn[name] = [augment(one, recipe, rng, angle, mirror, branch_of(name), panorama) for one in pictures]
        return drawn

    def _batch(self, labels: _Labels, overlaps: BoolArray | None, tasks: Sequence[Future[_Drawn]]) -> TrainingBatch:
        rows = [task.result() for task in tasks]
        sets = {name: self._network_input([one for row in rows for one in row.get(name, ())]) for name in labels}
        shared = None if overlaps is None else torch.from_numpy(overlaps).to(self.device)
        return TrainingBatch(sets, {name: torch.from_numpy(of).to(self.device) for name, of in labels.items()}, shared)

    def _network_input(self, pictures: Sequence[UInt8Array]) -> Tensor:
        """Move pictures to the device as bytes, and normalise them there."""
        cuda = self.device.type == "cuda"
        raw = torch.empty((len(pictures), *pictures[0].shape), dtype=torch.uint8, pin_memory=cuda)
        np.stack(pictures, out=raw.numpy())
        moved = raw.to(self.device, non_blocking=cuda).permute(0, 3, 1, 2)
        return moved.to(torch.float32).mul_(self._scale).add_(self._offset)


def choose_workers(device: torch.device) -> int:
    """Choose the number of worker threads.

    With a GPU these are all cores but one, at most 16. Otherwise a quarter of the cores, as the network needs the others.
    """
    cores = usable_cores()
    return max(1, min(_MAX_WORKERS, cores - 1 if device.type == "cuda" else cores // 4))
