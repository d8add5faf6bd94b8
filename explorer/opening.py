"""Opens what the explorer shows: a model on a data set, or a result that another program saved, on its pictures."""

from __future__ import annotations

import logging
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
from rich.console import Console

import lpn
from explorer.compute.ranking_job import RankingJob
from explorer.stage import gallery_geometry
from explorer.workspace import Task, Workspace
from lpn import descriptors
from lpn.core.arrays import Int64Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.views import View, views_of
from lpn.datasets import Dataset, Picture, geo, open_dataset
from lpn.datasets.city_model import CityModel, city_model
from lpn.descriptors import StoredDescriptors
from lpn.models.spec import Layout, ModelSpec
from lpn.retrieval.published_results import Saved
from lpn.retrieval.ranking_cache import Sides

log = logging.getLogger(__name__)

SAVED_MAP = (16, 16)
"""Cells by which rings are drawn where no network says them: those of a ResNet-50 at 256 pixels."""


def open_model(data: Path, model: Path, query: str | None = None, beside: Path | None = None) -> Workspace:
    """A model and all tasks of a data set that it knows the views of.

    Args:
        beside: another model to compare it with on the same data.
        query: name of the query of the first task that a browser shows first; without it, that task's first.

    Raises:
        LPNError: when model or data set cannot be used, or there is no such query.
    """
    data_name = printable(data.resolve().name)
    with _saying(f"Opening {printable(model.name)} and {data_name}"):
        opened = lpn.load(model)
        dataset = open_dataset(data)
    pairs = [views_of(name) for name in dataset.tasks()]
    known = [pair for pair in pairs if set(pair) <= set(opened.views)]
    if not known:
        raise DataError(
            f"The test split of {data_name} offers {', '.join(dataset.tasks()) or 'no task'}, but the model knows "
            f"only the views {', '.join(opened.views)}; give a data set or a model that fit each other."
        )
    where = geo.positions(data)
    tasks = []
    for views in known:
        queries, gallery = dataset.queries(views[0]), dataset.gallery(views[1])
        asked = descriptors.stored_side(opened, queries, views[0], data, "query")
        tiles = descriptors.stored_side(opened, gallery, views[1], data, "gallery")
        tasks.append(_task(dataset, where, views, queries, gallery, asked, tiles))
    map_sizes = {view: opened.map_size(view) for view in opened.views}
    city = None if where is None else _city(data)
    workspace = Workspace(printable(model.name), data_name, tasks, opened.spec, map_sizes, opened, city, dataset.root)
    workspace.open_with(query)
    if beside is not None:
        workspace.beside = open_model(data, beside)
    return workspace


def open_saved(data: Path, saved: Saved, query: str | None = None) -> Workspace:
    """A saved result and the pictures it is of; there is no network, so nothing can be described again.

    Rings are drawn as University-1652's LPN cuts them, and for panoramas as the published CVUSA models do.

    Raises:
        LPNError: when the data set lacks the result's pictures, or its descriptors do not consist of parts of equal norm.
    """
    saved.check_norms()
    dataset = open_dataset(data)
    views, queries, gallery = saved.pictures(dataset)
    where = geo.positions(data)
    labels = saved.query_labels, saved.gallery_labels
    asked, tiles = (descriptors.StoredDescriptors(values, "") for values in (saved.query, saved.gallery))
    task = _task(dataset, where, views, queries, gallery, asked, tiles, labels)
    layout: Layout = "cvusa" if dataset.panoramas else "university"
    spec = ModelSpec(views=tuple(dict.fromkeys(views)), n_parts=saved.n_parts, layout=layout, shared=False)
    map_sizes = dict.fromkeys(spec.views, SAVED_MAP)
    city = None if where is None else _city(data)
    workspace = Workspace(saved.name, printable(data.resolve().name), [task], spec, map_sizes, None, city, dataset.root)
    workspace.open_with(query)
    return workspace


def _task(
    dataset: Dataset,
    where: geo.Positions | None,
    views: tuple[View, View],
    queries: list[Picture],
    gallery: list[Picture],
    asked: StoredDescriptors,
    tiles: StoredDescriptors,
    given: tuple[Int64Array, Int64Array] | None = None,
) -> Task:
    """Everything about one direction; labels are the pictures' own unless others are given."""
    name = "-to-".join(views)
    laid = None if where is None else gallery_geometry.places(where.of(queries), where.of(gallery))
    own = tuple(np.array([entry.label for entry in entries], np.int64) for entries in (queries, gallery))
    query_labels, labels = given or own
    truth = None if given else dataset.truth(name)
    identity = f"{asked.identity} {tiles.identity}" if asked.identity and tiles.identity else ""
    standing = RankingJob(Sides(asked.descriptors, tiles.descriptors, query_labels, labels, truth, identity), laid)
    with _saying(f"Ranking {len(gallery):,} pictures for {len(queries):,} queries, {name}"):
        standing.begin()
    return Task(
        name,
        *views,
        queries,
        gallery,
        query_labels,
        labels,
        truth,
        asked.descriptors,
        tiles.descriptors,
        laid,
        standing,
    )


def _saying(text: str) -> AbstractContextManager[object]:
    """What is going on, on a terminal, for as long as it goes on."""
    return Console(stderr=True).status(f"{text} (Ctrl-C stops)")


def _city(data: Path) -> CityModel | None:
    """The data set's 3-D model; one that cannot be used is no reason not to start."""
    try:
        return city_model(data)
    except DataError as error:
        log.warning("The map has no city: %s", error)
        return None
