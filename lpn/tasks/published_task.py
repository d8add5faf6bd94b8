"""A published result as a task: ranking, laboratory, and map on its pictures, without a network."""

from __future__ import annotations

from lpn.core.files import printable
from lpn.datasets import Dataset
from lpn.models.spec import Layout, ModelSpec
from lpn.retrieval.saved import PublishedResult, published_pictures
from lpn.tasks.gallery_geometry import GalleryGeometry
from lpn.tasks.gallery_task import GalleryTask

# Size of the feature map for drawing rings without a network: that of a ResNet-50 at 256 pixels.
SAVED_MAP = (16, 16)


def published_task(saved: PublishedResult, dataset: Dataset) -> GalleryTask:
    """Return the task of a published result on its pictures.

    Rings are drawn as University-1652's LPN divides them, and for panoramas as the published CVUSA models do.

    Raises:
        LPNError: when the data set lacks the result's pictures, or its descriptors do not consist of parts of equal norm.
    """
    saved.check_norms()
    pictures, labels = published_pictures(saved, dataset)
    layout: Layout = "cvusa" if dataset.panoramas else "university"
    spec = ModelSpec(views=tuple(dict.fromkeys(pictures.views)), n_parts=saved.n_parts, layout=layout, shared=False)
    contract = spec.contract()
    return GalleryTask(
        name=pictures.name,
        model=None,
        model_name=saved.name,
        data_name=printable(dataset.root.resolve().name),
        root=dataset.root,
        contract=contract,
        map_sizes=dict.fromkeys(contract.views, SAVED_MAP),
        queries=pictures.queries,
        gallery=pictures.gallery,
        query_labels=labels[0],
        gallery_labels=labels[1],
        query_descriptors=saved.query,
        gallery_descriptors=saved.gallery,
        truth=pictures.truth,
        columns=dataset.columns(pictures.queries),
        geometry=GalleryGeometry.of_dataset(dataset, pictures.queries, pictures.gallery),
    )
