"""Selection of the best epoch, by retrieval on held-out places or on the test split."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lpn import descriptors
from lpn.core.arrays import Float32Array
from lpn.core.consoles import Console
from lpn.core.views import View
from lpn.datasets import Dataset, Picture
from lpn.datasets.integrity import check_test_split
from lpn.descriptors.transforms import Change
from lpn.models.base import Model
from lpn.retrieval import metrics
from lpn.tasks.opening import lazy_task
from lpn.training.training_set import paired_pictures

# The metrics of one epoch: a line of log.csv.
EpochMetrics = dict[str, float]


class TestSplit:
    """Retrieval on the test split. The first task selects the epoch, so its result is optimistically biased.

    Args:
        zoom: the training's zoom of each view's pictures, see `Recipe.zoom`.

    Attributes:
        column: the column of log.csv that selects the best epoch.
        description: this metric in words.

    Raises:
        LPNError: when the split is incomplete or one of its pictures is broken, see `lpn.datasets.integrity.check_test_split`.
    """

    __test__ = False  # not a test, despite its name

    def __init__(self, dataset: Dataset, tasks: Sequence[str], zoom: Callable[[View], float]) -> None:
        check_test_split(dataset, tasks)
        self.dataset, self.tasks, self._zoom = dataset, tasks, zoom
        self.column = f"recall@1 {tasks[0]}"
        self.description = (
            f"R@1 of {tasks[0]} on the test split, so this figure is optimistic (with --validate it is not)"
        )

    def measure(self, model: Model, console: Console | None = None) -> EpochMetrics:
        """Measure Recall@1 and AP of every task, in percent; print all metrics if a console is given."""
        row: EpochMetrics = {}
        known: dict[object, Float32Array] = {}

        def described(model: Model, pictures: Sequence[Picture], view: View, change: Change) -> Float32Array:
            change = replace(change, scale=change.scale * self._zoom(view))
            key = (view, change, tuple(picture.path for picture in pictures))
            if key not in known:
                known[key] = descriptors.temporary_descriptors(model, pictures, view, change)
            return known[key]

        lines = []
        for task in self.tasks:
            result = lazy_task(model, self.dataset, task, described).evaluate()
            recalls = "  ".join(f"R@{depth} {result.recall[depth]:.2f}" for depth in ("1", "5", "10", "1%"))
            lines.append(f"{task}: {recalls}  AP {result.ap:.2f}  ({result.queries} queries, {result.gallery} tiles)")
            row |= {f"recall@1 {task}": result.recall["1"], f"ap {task}": result.ap}
        if console is not None:
            zoomed = [
                f"The {view} pictures were zoomed by {zoom:.3g} as in the training; lpn evaluate does so with --calibrate alone."
                for view in ("drone", "satellite")
                if (zoom := self._zoom(view)) != 1
            ]
            console.print("\n".join([*lines, result.sentence, *zoomed]))
        return row


class HeldOut:
    """Retrieval of satellite pictures by drone or street pictures among held-out training places, see `TestSplit`.

    Args:
        places: the files of each set of each place; places without a pair of pictures are not measured.
        zoom: see `TestSplit`.
    """

    def __init__(self, places: Mapping[int, Mapping[str, Sequence[Path]]], zoom: Callable[[View], float]) -> None:
        self._zoom, self.pictures = zoom, paired_pictures(places)
        task, *_ = (f"{view}-to-satellite" for view in self.pictures)
        places_held = len({picture.label for picture in self.pictures["satellite"]})
        self.column = f"recall@1 {task} held out"
        self.description = f"R@1 of {task} on {places_held} places held out of the training"

    def measure(self, model: Model, console: Console | None = None) -> EpochMetrics:
        """Measure Recall@1 and AP among the held-out places only, in percent; nothing is printed."""
        del console
        query, gallery = (
            (
                descriptors.temporary_descriptors(model, pictures, view, Change(scale=self._zoom(view))),
                np.array([picture.label for picture in pictures]),
            )
            for view, pictures in self.pictures.items()
        )
        figures = metrics.evaluate(*query, *gallery)
        return {self.column: figures["recall@1"], self.column.replace("recall@1", "ap"): figures["ap"]}


def best_epoch(history: Sequence[EpochMetrics], column: str) -> tuple[int, float] | None:
    """Return the first epoch, from 1, with the highest metric, and that metric; None if no epoch was measured."""
    scores = [(row[column], -epoch) for epoch, row in enumerate(history, 1) if column in row]
    if not scores:
        return None
    score, epoch = max(scores)
    return -epoch, score
