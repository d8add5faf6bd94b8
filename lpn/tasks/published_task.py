"""A published result as a task: ranking, laboratory, and map on its pictures, without a network."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lpn.core.files import printable
from lpn.core.views import View
from lpn.datasets import Dataset, Picture, labels_of
from lpn.models.spec import Layout, ModelSpec
from lpn.retrieval.saved import PublishedResult, truth_of_rows
from lpn.tasks.gallery_geometry import GalleryGeometry
from lpn.tasks.task import Task

# Size of the feature map for drawing rings without a network: that of a ResNet-50 at 256 pixels.
SAVED_MAP = (16, 16)
_LAYOUT: Layout = "university"


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
    queries, gallery = list[Picture](), list[Picture]()
    labels, truth, layout = (saved.query_labels, saved.gallery_labels), None, _LAYOUT
    views: Sequence[View] = saved.views or ("drone", "satellite")
    if dataset is None:
        saved.check_labels()
    else:
        views, queries, gallery = saved.pictures(dataset)
        layout = "cvusa" if dataset.panoramas else layout
        truth = truth_of_rows(dataset, "-to-".join(views), queries, gallery)
        if truth is not None:  # labels of the result name one true tile of several, or are numbered otherwise
            labels = labels_of(queries), labels_of(gallery)
    spec = ModelSpec(views=tuple(dict.fromkeys(views)), n_parts=saved.n_parts, layout=layout, shared=False)
    contract, root = spec.contract(), Path(saved.name) if dataset is None else dataset.root
    return Task(
        name=saved.task if dataset is None else "-to-".join(views),
        model=None,
        model_name=name or saved.name,
        data_name=printable(root.resolve().name),
        root=root,
        contract=contract,
        map_sizes=dict.fromkeys(contract.views, SAVED_MAP),
        queries=queries,
        gallery=gallery,
        query_labels=labels[0],
        gallery_labels=labels[1],
        query_descriptors=saved.query,
        gallery_descriptors=saved.gallery,
        truth=truth,
        columns=() if dataset is None else dataset.columns(queries),
        geometry=None if dataset is None else GalleryGeometry.of_dataset(dataset, queries, gallery),
        clauses=("descriptors as saved",),
    )
