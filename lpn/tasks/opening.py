"""Tasks of a data set under a model: which of them both offer, and one of them opened."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import cast

import numpy.typing as npt

from lpn import descriptors
from lpn.core.demo import own_file
from lpn.core.errors import DataError, InputError, PictureError
from lpn.core.files import printable
from lpn.core.progress import counted_among
from lpn.core.views import View, views_of
from lpn.datasets import Dataset, Picture
from lpn.models.base import Model
from lpn.models.contract import Role
from lpn.retrieval import scoring
from lpn.retrieval.calibration import MIN_PICTURES, Calibration, calibrate
from lpn.retrieval.csls import NEIGHBOURS, check_neighbours
from lpn.retrieval.evaluate import check_test_split, lists_of
from lpn.retrieval.sides import TaskPictures
from lpn.tasks import notes
from lpn.tasks.gallery_geometry import GalleryGeometry
from lpn.tasks.gallery_task import GalleryTask
from lpn.tasks.notes import Note
from lpn.tasks.shipped_calibration import FOLDER, NAME, read_calibration

_ROLES: tuple[Role, Role] = ("query", "gallery")


def describe_task(
    model: Model,
    model_name: str,
    dataset: Dataset,
    name: str | None = None,
    weights: npt.ArrayLike | None = None,
    tags_and_notes: Mapping[str, Note] | None = None,
    calibration: Calibration | None = None,
    neighbours: int = 0,
) -> GalleryTask:
    """Describe queries and gallery of a task, or read their stored descriptors.

    Args:
        model_name: the model's name to display.
        name: the task, see `choose_task`.
        weights: part weights, see `scoring.part_weights`.
        tags_and_notes: by the query's path; by default those in the data set's folder.
        calibration: see `task_calibration`; its zooms and means are applied to `model`, which is that before the calibration.
        neighbours: K of CSLS; 0 ranks without it.

    Raises:
        InputError: when model and data set do not offer the task, or weights or neighbours are invalid.
        LPNError: when pictures, positions, truth, or stores cannot be read.
    """
    name, offered = choose_task(model, dataset, name), offered_tasks(model, dataset)
    scoring.part_weights(model.n_parts, weights)
    if tags_and_notes is None:
        tags_and_notes = notes.read_notes(own_file(dataset.root, notes.NAME))
    pictures = TaskPictures.of(dataset, name)
    views = pictures.views
    model = model.for_task(*views)
    queries, gallery = pictures.queries, pictures.gallery
    if neighbours:
        check_neighbours(neighbours, len(queries))
    geometry = GalleryGeometry.of_dataset(dataset, queries, gallery)
    try:
        if calibration is None:
            both = len(queries) + len(gallery)
            with counted_among(0, both):
                query_side = descriptors.shipped_or_cached(model, queries, views[0], dataset.root, "query")
            with counted_among(len(queries), both):
                gallery_side = descriptors.shipped_or_cached(model, gallery, views[1], dataset.root, "gallery")
        else:
            query_side, gallery_side = (
                descriptors.shipped_only(calibration.applied(model), side, view, dataset.root, role)
                or calibration.stored(model, side, view, descriptors.descriptor_reader(dataset.root))
                for side, view, role in zip((queries, gallery), views, _ROLES, strict=True)
            )
    except PictureError:  # of one list; name the broken pictures of all lists at once
        check_test_split(dataset, offered)
        raise
    if calibration is not None:
        queries, gallery = calibration.pictures(views[0], queries), calibration.pictures(views[1], gallery)
        model = calibration.applied(model)
    query_labels, gallery_labels = pictures.labels
    identities = query_side.identity, gallery_side.identity
    return GalleryTask(
        name=name,
        model=model,
        model_name=printable(model_name),
        data_name=printable(dataset.root.resolve().name),
        root=dataset.root,
        contract=model.contract,
        map_sizes={view: model.map_size(view) for view in views},
        queries=queries,
        gallery=gallery,
        query_labels=query_labels,
        gallery_labels=gallery_labels,
        query_descriptors=query_side.descriptors,
        gallery_descriptors=gallery_side.descriptors,
        truth=pictures.truth,
        geometry=geometry,
        identity=" ".join(identities) if all(identities) else "",
        weights=weights,
        notes=tags_and_notes,
        columns=dataset.columns(queries),
        calibration=calibration,
        neighbours=neighbours,
    )


def scored_tasks(
    model: Model,
    model_name: str,
    dataset: Dataset,
    calibration: Calibration,
    names: Sequence[str],
    neighbours: int = NEIGHBOURS,
) -> list[GalleryTask]:
    """Open tasks under the scorings besides the plain one: calibrated, and, with queries enough, calibrated and under CSLS.

    Args:
        model: before the calibration.
        names: of the tasks.
        neighbours: see `describe_task`.

    Raises:
        LPNError: as `describe_task`.
    """
    tasks = [describe_task(model, model_name, dataset, name, calibration=calibration) for name in names]
    return tasks + by_csls(tasks, neighbours)


def by_csls(tasks: Iterable[GalleryTask], neighbours: int) -> list[GalleryTask]:
    """Return those of some tasks that have K queries or more, re-ranked by CSLS."""
    return [replace(task, neighbours=neighbours) for task in tasks if len(task.queries) >= neighbours]


def task_calibration(model: Model, dataset: Dataset, calibrate: bool | None = None) -> Calibration | None:
    """Choose the calibration that ranks the tasks of a data set, for the library, every command, and the page; no label counts.

    Args:
        calibrate: True for the calibration that ships with the data set, or else a new one, see `calibrated`; False for none;
            None for the one that ships, if any.

    Returns:
        None to rank plain.

    Raises:
        InputError: when `calibrate` is something else, or a new calibration is impossible.
        LPNError: when pictures cannot be read.
    """
    if calibrate is not None and not isinstance(calibrate, bool):
        raise InputError(f"calibrate is {printable(repr(calibrate))}; expected True, False, or None.")
    shipped = None if calibrate is False else shipped_calibration(model, dataset)
    return calibrated(model, dataset) if calibrate and shipped is None else shipped


def alike_calibrations(
    models: Sequence[Model], dataset: Dataset, calibrate: bool | None = None
) -> list[Calibration | None]:
    """Choose as `task_calibration` does for models that are compared; they stay plain unless all of them are calibrated."""
    chosen = [task_calibration(model, dataset, calibrate) for model in models]
    return chosen if all(chosen) else [None] * len(chosen)


def no_calibration(model: Model, dataset: Dataset) -> str:
    """Return why a model cannot be calibrated on a data set's pictures, as a sentence; empty if it can."""
    if model.contract.roles == "role":
        return f"{model.contract.method} describes a view otherwise as query than as gallery, which one calibration does not fit."
    counts = {view: len({p.path for some in lists for p in some}) for view, lists in _lists(model, dataset).items()}
    if len(counts) < 2:
        return f"A calibration takes pictures of two views, and all are of {' and '.join(counts)}."
    view, fewest = min(counts.items(), key=lambda item: item[1])
    if fewest < MIN_PICTURES:
        return (
            f"A calibration takes {MIN_PICTURES} pictures of each view or more, and there are {fewest} {view} pictures."
        )
    return ""


def shipped_calibration(model: Model, dataset: Dataset) -> Calibration | None:
    """Return the calibration of a model that ships with a data set; None without one."""
    if not (dataset.root / FOLDER / NAME).is_file():
        return None  # do not list the pictures
    return read_calibration(model, dataset.root, _lists(model, dataset))


def _lists(model: Model, dataset: Dataset) -> dict[View, list[Sequence[Picture]]]:
    """Return for each view the lists of pictures of all tasks that a model offers."""
    lists: dict[View, list[Sequence[Picture]]] = {}
    for name, pictures in lists_of(dataset, offered_tasks(model, dataset)).items():
        lists.setdefault(cast(View, name.split()[1]), []).append(pictures)
    return lists


def calibrated(model: Model, dataset: Dataset) -> Calibration:
    """Calibrate a model on the pictures of all tasks that it offers, so that all tasks are searched by one model.

    Raises:
        InputError: when the model's branches have roles, so that a task decides its descriptors, or pictures are too few.
        LPNError: when pictures cannot be read.
    """
    if model.contract.roles == "role":
        raise InputError(
            f"{model.contract.method} describes a view otherwise as query than as gallery, and a calibration is for all tasks; "
            "leave --calibrate out."
        )
    tasks = offered_tasks(model, dataset)
    if not tasks:
        raise no_task_error(model, dataset)
    check_test_split(dataset, tasks)
    return calibrate(model, _lists(model, dataset), descriptors.descriptor_reader(dataset.root))


def offered_tasks(model: Model, dataset: Dataset) -> list[str]:
    """The tasks of a data set whose views a model knows."""
    return [name for name in dataset.tasks() if set(views_of(name)) <= set(model.views)]


def no_task_error(model: Model, dataset: Dataset) -> DataError:
    """Return the error for a model and a data set without any of `offered_tasks`."""
    if not (tasks := dataset.tasks()):
        return dataset.no_task()
    name = printable(dataset.root.resolve().name)
    wanted = [f"{role}_{view}" for role in ("query", "gallery") for view in model.views]
    # Pictures of a view may be listed once for both roles. Of a view without any, the layout has none.
    listed = {key.removeprefix("test/") for key, pictures in dataset.lists().items() if pictures}
    has_views = all(any(view in key for key in listed) for view in model.views)
    missing = ", ".join(one for one in wanted if has_views and not listed & {one, one.partition("_")[2]})
    return DataError(
        f"The test split of {name} is for {', '.join(tasks)}, and the model knows only {' and '.join(model.views)} pictures; "
        f"{f'mend what is missing there ({missing}), or ' if missing else ''}choose another data set or model."
    )


def choose_task(model: Model, dataset: Dataset, name: str | None = None) -> str:
    """The given task, or the first of `offered_tasks`.

    Raises:
        DataError: when there is none.
        InputError: when the data set does not have the task, or the model does not know its views.
    """
    offered = offered_tasks(model, dataset)
    if not offered:
        raise no_task_error(model, dataset)
    name = name or offered[0]
    if name not in offered:
        raise InputError(
            f"The task is {name}; with this model, {dataset.root.name} has the tasks {', '.join(offered)}."
        )
    return name
