"""Figures 1, 7, and 8 of the paper as PNGs (heatmaps and retrieved pictures), and the pictures for Figures 3 and 4."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lpn import descriptors, retrieval
from lpn.core import images
from lpn.core.errors import InputError
from lpn.core.views import View
from lpn.datasets import Dataset, Picture
from lpn.drawing.network_figures import PictureOfView
from lpn.drawing.plots import encode, pyplot
from lpn.models.base import Model
from lpn.retrieval import scoring

# Frames of true and false matches, yellow and blue as in the paper; a tick or a cross stands beside them.
TRUE, FALSE = "#f2c200", "#2f6fdb"


def heatmaps(
    models: Sequence[tuple[str, Model]], dataset: Dataset, view: View, names: Sequence[str] = (), count: int = 4
) -> bytes:
    """Draw Figure 7, or for one place Figure 1, as a PNG: query and tile of some places under each network's channel sum.

    Args:
        models: name and network.
        view: view of the queries, drone for (a) and street for (b).
        names: the shown queries; without any, `count` spread over the list.

    Raises:
        InputError: when there is no such query.
    """
    tiles = {picture.label: picture for picture in dataset.gallery("satellite")}
    chosen = named(dataset, view, names, count)
    rows: list[tuple[Picture, View]] = [
        row for query in chosen for row in ((query, view), (tiles[query.label], "satellite"))
    ]
    size = (2.1 * (1 + len(models)), 4.2 * len(chosen)) if view == "drone" else (10.2, 2.9 * len(chosen))
    figure, axes = pyplot().subplots(len(rows), 1 + len(models), figsize=size, layout="constrained", squeeze=False)
    for cells, (entry, of_view) in zip(axes, rows, strict=True):
        picture = images.load_picture(entry.path)
        cells[0].imshow(picture)
        for cell, (_, model) in zip(cells[1:], models, strict=True):
            # A polar network sees the unrolled tile.
            seen = model.as_partitioned(picture, of_view)
            height, width = seen.shape[:2]
            heat = retrieval.describe_picture(model, picture, of_view).activation
            cell.imshow(seen)
            cell.imshow(heat, cmap="inferno", alpha=0.55, extent=(0, width, height, 0), interpolation="bilinear")
    for cell, title in zip(axes[0], ("picture", *(name for name, _ in models)), strict=True):
        cell.set_title(title, fontsize=9)
    for cell in axes.flat:
        cell.set_axis_off()
    return encode(figure, 100)


def retrievals(model: Model, dataset: Dataset, views: Sequence[View], names: Sequence[str] = (), top: int = 5) -> bytes:
    """Draw Figure 8 as a PNG: queries and their nearest pictures, framed yellow if true and blue if false.

    Args:
        views: the views of the queries. Satellite queries search drone pictures, all others search tiles.
        names: the shown queries of the first view; the other views show the same places.
        top: number of nearest pictures.

    Raises:
        InputError: when there is no such query.
    """
    chosen = named(dataset, views[0], names)
    labels = {picture.label for picture in chosen}
    shown_queries = [(picture, views[0]) for picture in chosen]
    shown_queries += [(p, view) for view in views[1:] for p in dataset.queries(view) if p.label in labels]
    size = (1.7 * (1 + top), 1.85 * len(shown_queries))
    figure, axes = pyplot().subplots(len(shown_queries), 1 + top, figsize=size, layout="constrained", squeeze=False)
    for row, (query, view) in zip(axes, shown_queries, strict=True):
        other: View = "drone" if view == "satellite" else "satellite"
        gallery = dataset.gallery(other)
        described = descriptors.cached_descriptors(model, gallery, other)
        described_query = retrieval.describe_picture(model, images.load_picture(query.path), view)
        cosines = scoring.part_cosines(described_query.descriptor, described)
        order = np.argsort(-cosines.mean(axis=1), kind="stable")[:top]
        for cell in row:
            cell.set_xticks([])
            cell.set_yticks([])
        for cell, entry in zip(row, [query, *(gallery[index] for index in order)], strict=False):
            cell.imshow(images.shrink(images.load_picture(entry.path), 256))
            right = entry.label == query.label
            query_cell = cell is row[0]
            title = f"{view} {query.name}" if query_cell else f"{'✓' if right else '✗'} {entry.name}"
            cell.set_title(title, fontsize=7)
            for side in cell.spines.values():
                side.set(linewidth=0 if query_cell else 3, color=TRUE if right else FALSE)
    return encode(figure, 100)


def described(model: Model, dataset: Dataset, names: Sequence[str] = ()) -> list[PictureOfView]:
    """Describe a drone query, the first of `names` if there are any, and its tile for Figures 3 and 4."""
    (query,) = named(dataset, "drone", names[:1], count=1)
    tile = next(picture for picture in dataset.gallery("satellite") if picture.label == query.label)
    made = []
    pair: dict[View, Picture] = {"drone": query, "satellite": tile}
    for view, entry in pair.items():
        picture = images.load_picture(entry.path)
        one = retrieval.describe_picture(model, picture, view)
        assert one.activation is not None  # an LPN has a map
        made.append(PictureOfView(view, model.as_partitioned(picture, view), one.activation, one.descriptor))
    return made


def named(dataset: Dataset, view: View, names: Sequence[str] = (), count: int = 4) -> list[Picture]:
    """Return queries of a view with a satellite tile by their names; without names, `count` spread over the list.

    Raises:
        InputError: when there is no such query, or it has no tile.
    """
    tiles = {picture.label for picture in dataset.gallery("satellite")}
    queries = dataset.queries(view)
    pictures = [picture for picture in queries if picture.label in tiles]
    by_name = {picture.name: picture for picture in pictures}
    for name in names:
        if name not in by_name:
            raise InputError(f"There is no query {name} with a tile; names are such as {queries[0].name}.")
    if names or not pictures:
        return [by_name[name] for name in names]
    count = min(count, len(pictures))
    return [pictures[len(pictures) * step // count] for step in range(count)]
