"""The two sides of a task: its pictures, their truth, and their descriptors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from lpn import descriptors
from lpn.core.arrays import Float32Array, Int64Array
from lpn.core.views import View, views_of
from lpn.datasets import Dataset, Picture, Truth, labels_of
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.models.base import Model
from lpn.retrieval.calibration import Calibration


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

    def described(
        self,
        model: Model,
        read: descriptors.Reader,
        change: Change = UNCHANGED,
        gallery_change: Change = UNCHANGED,
        branch: View | None = None,
        calibration: Calibration | None = None,
    ) -> tuple[Float32Array, Float32Array]:
        """Read the descriptors of both sides, (Q, n, D) and (G, n, D).

        Args:
            model: that of the task, see `Model.for_task`, unless there is a branch.
            read: returns descriptors.
            change, gallery_change: applied to each query, and to each gallery picture.
            branch: describes both sides; None for each view's own.
            calibration: the model's, which has a branch for each view; None for none.

        Raises:
            LPNError: when a picture cannot be read.
        """
        if calibration is not None:
            return (
                calibration.read(model, self.queries, self.views[0], read, change),
                calibration.read(model, self.gallery, self.views[1], read, gallery_change),
            )
        query_branch, gallery_branch = (branch or view for view in self.views)
        return read(model, self.queries, query_branch, change), read(
            model, self.gallery, gallery_branch, gallery_change
        )
