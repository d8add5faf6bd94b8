"""A published result as a task: ranking, laboratory, and map on its pictures, without a network."""

from __future__ import annotations

from pathlib import Path

from lpn.core.files import printable
from lpn.datasets import Dataset
from lpn.models.spec import Layout, ModelSpec
from lpn.retrieval.saved import PublishedResult, published_pictures
from lpn.retrieval.sides import TaskPictures
from lpn.tasks.gallery_geometry import GalleryGeometry
from lpn.tasks.task import Task

# Size of the feature map for drawing rings without a network: that of a ResNet-50 at 256 pixels.
SAVED_MAP = (16, 16)


def published_task(saved: PublishedResult, dataset: Dataset) -> Task:
    """Return the task of a published result on its pictures, whose parts have the norms of exact contributions.

    Raises:
        LPNError: when the data set lacks the result's pictures, or its descriptors do not consist of parts of equal norm.
    """
    saved.check_norms()
    return saved_task(saved, dataset)


def saved_task(saved: PublishedResult, dataset: Dataset | None = None, name: str | None = None) -> Task:
    """Return the task of a published result, whatever its norms; without a data set, labels tell what is true.

    Rings are drawn as University-1652's LPN divides them, and for panoramas as the published CVUSA models do.

    Args:
        name: to display; by default the result's.

    Raises:
        DataError: when the data set lacks the result's pictures, or without one, no query has a label of the gallery.
    """
    if dataset is None:
        saved.check_labels()
        pictures, labels = TaskPictures(saved.task, [], [], None), (saved.query_labels, saved.gallery_labels)
    else:
        pictures, labels = published_pictures(saved, dataset)
    layout: Layout = "cvusa" if dataset is not None and dataset.panoramas else "university"
    views = saved.views or ("drone", "satellite") if dataset is None else pictures.views
    contract = ModelSpec(
        views=tuple(dict.fromkeys(views)), n_parts=saved.n_parts, layout=layout, shared=False
    ).contract()
    root = Path(saved.name) if dataset is None else dataset.root
    return Task(
        name=pictures.name,
        model=None,
        model_name=name or saved.name,
        data_name=printable(root.resolve().name),
        root=root,
        contract=contract,
        map_sizes=dict.fromkeys(contract.views, SAVED_MAP),
        queries=pictures.queries,
        gallery=pictures.gallery,
        query_labels=labels[0],
        gallery_labels=labels[1],
        query_descriptors=saved.query,
        gallery_descriptors=saved.gallery,
        truth=pictures.truth,
        columns=() if dataset is None else dataset.columns(pictures.queries),
        geometry=None if dataset is None else GalleryGeometry.of_dataset(dataset, pictures.queries, pictures.gallery),
        clauses=("descriptors as saved",),
    )
