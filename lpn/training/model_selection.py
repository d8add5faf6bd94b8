"""Which epoch of a training is the best, and what that is measured on: places held out, or the test split."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol, cast

import numpy as np
from rich.console import Console

from lpn import descriptors
from lpn.core.arrays import Float32Array
from lpn.core.views import View
from lpn.datasets import Dataset, Picture
from lpn.descriptors.transforms import Change
from lpn.models.base import Model
from lpn.retrieval import metrics
from lpn.retrieval.evaluate import check_test_split, evaluate

Row = dict[str, float]
"""One epoch's figures, a line of log.csv."""


class Judge(Protocol):
    """Measures a model in the middle of its training."""

    column: str
    """The figure the best epoch is chosen by, as log.csv calls it."""
    said: str
    """The same in words."""

    def measure(self, model: Model) -> Row:
        """A model's figures in percent."""
        ...


class TestSplit:
    """Retrieval on the test split: the first task decides, which flatters the model chosen.

    Raises:
        LPNError: when a picture of it is broken or it is incomplete, see `lpn.retrieval.evaluate.check_test_split`.
    """

    __test__ = False  # for pytest, which takes it for a test by its name

    def __init__(self, dataset: Dataset, tasks: Sequence[str]) -> None:
        check_test_split(dataset, tasks)
        self.dataset, self.tasks = dataset, tasks
        self.column = f"recall@1 {tasks[0]}"
        self.said = f"R@1 of {tasks[0]} on the test split, which flatters it there (--validate does not)"

    def measure(self, model: Model, console: Console | None = None) -> Row:
        """Recall@1 and AP of every task, and where a console is given, what Recall@5 and the others are too."""
        row: Row = {}
        seen: dict[object, Float32Array] = {}

        def once(model: Model, pictures: Sequence[Picture], view: View, change: Change) -> Float32Array:
            key = (view, change, tuple(picture.path for picture in pictures))
            if key not in seen:
                seen[key] = descriptors.temporary_descriptors(model, pictures, view, change)
            return seen[key]

        for task in self.tasks:
            result = evaluate(model, self.dataset, task, read=once)
            recall = result.recall
            if console is not None:
                console.print(
                    f"{task}: R@1 {recall['1']:.2f}  R@5 {recall['5']:.2f}  R@10 {recall['10']:.2f}  "
                    f"R@1% {recall['1%']:.2f}  AP {result.ap:.2f}  ({result.queries} queries, {result.gallery} tiles)"
                )
            row |= {f"recall@1 {task}": recall["1"], f"ap {task}": result.ap}
        if console is not None:
            console.print(result.said)
        return row


class HeldOut:
    """Retrieval of the satellite pictures of training places that were held out, by their drone or street pictures."""

    def __init__(self, places: Mapping[int, Mapping[str, Sequence[Path]]]) -> None:
        first = next(iter(places.values()))
        self.view: View = "drone" if "drone" in first else "street"
        self.pictures = {
            view: [Picture(file, label, file.name) for label, sets in places.items() for file in sets[view]]
            for view in (self.view, "satellite")
        }
        task = f"{self.view}-to-satellite"
        self.column = f"recall@1 {task} held out"
        self.said = f"R@1 of {task} on {len(places)} places held out of the training"

    def measure(self, model: Model) -> Row:
        """Recall@1 and AP among the held-out places alone."""
        sides = [
            (
                descriptors.temporary_descriptors(model, pictures, cast(View, view)),
                np.array([picture.label for picture in pictures]),
            )
            for view, pictures in self.pictures.items()
        ]
        figures = metrics.evaluate(*sides[0], *sides[1])
        return {self.column: figures["recall@1"], self.column.replace("recall@1", "ap"): figures["ap"]}


def best(history: Sequence[Row], column: str) -> tuple[int, float] | None:
    """The epoch, counted from 1, whose figure is the highest, the first of equals, and the figure; None without any."""
    scores = [(row[column], -epoch) for epoch, row in enumerate(history, 1) if column in row]
    if not scores:
        return None
    score, epoch = max(scores)
    return -epoch, score
