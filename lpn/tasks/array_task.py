"""Plain arrays as a task: ranking, laboratory, map, and confusions without a model."""

from __future__ import annotations

from lpn.models.contract import Contract
from lpn.retrieval.saved import PlainArrays, places_of
from lpn.tasks.gallery_geometry import GalleryGeometry
from lpn.tasks.gallery_task import GalleryTask


def array_task(arrays: PlainArrays, name: str) -> GalleryTask:
    """Return the task of plain arrays; it has a map if every gallery picture has a position.

    Args:
        name: of the model that made them, to display.
    """
    result, views = arrays.result, arrays.views
    n, size = result.query.shape[1:]
    contract = Contract(
        method="plain arrays",
        title=f"plain arrays, n = {n}",
        views=tuple(dict.fromkeys(views)),
        input_size=(256, 256),
        n_parts=n,
        embedding=size,
        level="one vector" if n == 1 else "parts only",
        mirror="none",
    )
    tiles = places_of(arrays.positions)
    return GalleryTask(
        name="-to-".join(views),
        model=None,
        model_name=name,
        data_name=arrays.root.resolve().name,
        root=arrays.root,
        contract=contract,
        map_sizes=dict.fromkeys(contract.views, (1, 1)),
        queries=arrays.queries,
        gallery=arrays.gallery,
        query_labels=result.query_labels,
        gallery_labels=result.gallery_labels,
        query_descriptors=result.query,
        gallery_descriptors=result.gallery,
        truth=arrays.truth(),
        geometry=None if tiles is None else GalleryGeometry.of(arrays.query_positions, tiles),
        identity=arrays.identity,
    )
