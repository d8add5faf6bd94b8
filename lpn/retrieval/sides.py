"""The two sides of a task: its pictures and their truth; and a test split that is checked before long work."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from lpn.core.arrays import Int64Array
from lpn.core.views import View, views_of
from lpn.datasets import Dataset, Picture, Truth, labels_of
from lpn.datasets.integrity import check_whole


@dataclass(frozen=True, eq=False)
class TaskPictures:
    """The pictures of a task.

    Attributes:
        name: the task, such as "drone-to-satellite".
        queries, gallery: the pictures.
        truth: true matches and junk of each query; None if labels define the true matches.
    """

    name: str
    queries: Sequence[Picture]
    gallery: Sequence[Picture]
    truth: Sequence[Truth] | None

    @classmethod
    def of(cls, dataset: Dataset, name: str) -> TaskPictures:
        """List both sides of a task.

        Raises:
            InputError: when the data set has other tasks.
            DataError: when it has none, or its test split is incomplete.
        """
        if name not in dataset.tasks():
            raise dataset.lacks_task(name)
        query_view, gallery_view = views_of(name)
        return cls(name, dataset.queries(query_view), dataset.gallery(gallery_view), dataset.truth(name))

    @property
    def views(self) -> tuple[View, View]:
        """The views of queries and gallery."""
        return views_of(self.name)

    @property
    def labels(self) -> tuple[Int64Array, Int64Array]:
        """The place of each query and of each gallery picture, (Q,) and (G,), -1 for junk."""
        return labels_of(self.queries), labels_of(self.gallery)


def check_test_split(dataset: Dataset, tasks: Sequence[str]) -> None:
    """Check a test split before long work, so that the evaluation at its end does not fail.

    Raises:
        InputError: when the data set does not offer one of the tasks, but others.
        PictureError: when a picture of the split is damaged.
        DataError: when there is no task, the test split is incomplete, or a picture lacks the position that its metrics take.
    """
    if missing := [task for task in tasks if task not in dataset.tasks()]:
        raise dataset.lacks_task(missing[0])
    lists = lists_of(dataset, tasks)
    files = list(dict.fromkeys(picture.path for pictures in lists.values() for picture in pictures))
    check_whole(files, f"test pictures of {dataset.root.name}", dataset.root)
    positions = dataset.positions()
    for pictures in lists.values():
        if positions is not None:
            positions.of(pictures)
        if dataset.measured_by is not None:
            dataset.coordinates(pictures)


def lists_of(dataset: Dataset, tasks: Sequence[str]) -> dict[str, list[Picture]]:
    """Return the lists of pictures of some tasks, by keys such as "query drone" and "gallery satellite"."""
    queries = dict.fromkeys(views_of(task)[0] for task in tasks)
    galleries = dict.fromkeys(views_of(task)[1] for task in tasks)
    return {f"query {view}": dataset.queries(view) for view in queries} | {
        f"gallery {view}": dataset.gallery(view) for view in galleries
    }
