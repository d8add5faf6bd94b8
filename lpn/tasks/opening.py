"""The tasks that a data set and a model both offer, and their opening."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt

from lpn import descriptors
from lpn.core.arrays import DAMAGED_ARRAY, Float32Array
from lpn.core.errors import DataError, InputError, PictureError, StoreError
from lpn.core.files import printable
from lpn.core.progress import counted_among, ended
from lpn.core.views import View, views_of
from lpn.datasets import Dataset, Picture, labels_of
from lpn.datasets.integrity import check_test_split, lists_of
from lpn.descriptors import STORES, open_store
from lpn.descriptors.transforms import Change
from lpn.models.base import Model
from lpn.models.contract import Role
from lpn.retrieval import scoring, transfer
from lpn.retrieval.calibration import MIN_PICTURES, Calibration, ZoomLevel, calibrate
from lpn.retrieval.csls import NEIGHBOURS, check_neighbours
from lpn.tasks.changes import by_csls, calibrated
from lpn.tasks.gallery_geometry import GalleryGeometry
from lpn.tasks.task import Task, descriptor_clauses

log = logging.getLogger(__name__)

# A calibration that ships with a data set, beside stores of its descriptors, so that no picture is described at several zooms.
FOLDER, NAME = Path(STORES) / "calibrated", "calibration.npz"


def lazy_task(
    model: Model,
    dataset: Dataset,
    name: str,
    read: descriptors.Reader | None = None,
    branch: View | None = None,
    released: bool = False,
    model_name: str = "",
    calibration: Calibration | None = None,
    neighbours: int = 0,
) -> Task:
    """List the pictures of a task; a model describes them when their descriptors are first read.

    Args:
        name: the task, such as "drone-to-satellite".
        read: returns descriptors; by default shipped float32 ones, else those of the user's cache, to which new ones are added.
        branch: the branch that describes both sides (Table VI); None for the branch of each view.
        released: whether to read and rotate pictures like the released test code, see `Change.released`, and to carry features
            over to landmarks as released, see `lpn.retrieval.transfer`.
        model_name: the model's name to display.
        calibration: see `task_calibration`; `model` is the model before the calibration.
        neighbours: K of CSLS; 0 ranks without it.

    Raises:
        InputError: when the data set lacks the task, or the model a view, or the calibration does not fit.
        DataError: when the test split is incomplete, or a picture has no position.
    """
    if name not in dataset.tasks():
        raise dataset.lacks_task(name)
    views, contract, change = views_of(name), model.contract, Change(released=released)
    queries, gallery, truth = dataset.queries(views[0]), dataset.gallery(views[1]), dataset.truth(name)
    model = model if branch else model.for_task(*views)
    read = read or descriptors.descriptor_reader(dataset.root)
    for view in views:
        if branch is None and view not in model.views:
            raise InputError(
                f"This model has no {view!r} view; it has {', '.join(model.views)}. To describe both sides with one "
                "of these, use lpn reproduce table6 for landmarks, or lpn.tasks.opening.lazy_task(branch=...) for any data set."
            )
        model.check_view(branch or view)
    query_labels, gallery_labels = labels_of(queries), labels_of(gallery)
    if truth is None and len(set(gallery_labels.tolist())) == 1:
        log.warning(
            "%s shows one place only, so that every answer is right; its metrics say nothing.", dataset.root.name
        )
    clauses = [*descriptor_clauses(contract)]
    clauses += ["pictures read by Pillow without their EXIF orientation, as released"] if released else []
    carried = released and name == "street-to-street" and truth is not None
    if carried:
        contract = replace(contract, n_parts=1, level="one vector", held="", partitions={}, part_names={})
        read, clauses = _carried, [transfer.SENTENCE]
    clauses += ["queries cropped to their boxes"] if any(picture.box for picture in queries) else []
    if branch:
        contract = replace(contract, views=(branch,), groups=(), roles="view")
        clauses.append(f"both sides described by the {branch} branch")

    def describe(some: Sequence[Picture], view: View, change: Change) -> Float32Array:
        return read(model, some, branch or view, change)

    task = Task(
        name=name,
        # Carried features of landmarks are not descriptors of the model, and are not changed.
        model=None if carried else model,
        model_name=printable(model_name),
        data_name=printable(dataset.root.resolve().name),
        root=dataset.root,
        contract=contract,
        map_sizes={},
        queries=queries,
        gallery=gallery,
        query_labels=query_labels,
        gallery_labels=gallery_labels,
        query_descriptors=lambda: describe(queries, views[0], change),
        gallery_descriptors=lambda: describe(gallery, views[1], change),
        truth=truth,
        geometry=GalleryGeometry.of_dataset(dataset, queries, gallery),
        clauses=tuple(clauses),
        change=change,
        describe=describe,
        dataset=dataset,
    )
    return by_csls(calibrated(task, calibration), neighbours)


def _carried(model: Model, pictures: Sequence[Picture], view: View, change: Change) -> Float32Array:
    del change
    return transfer.map_means(model, pictures, view)


def describe_task(
    model: Model,
    model_name: str,
    dataset: Dataset,
    name: str | None = None,
    weights: npt.ArrayLike | None = None,
    calibration: Calibration | None = None,
    neighbours: int = 0,
) -> Task:
    """Describe queries and gallery of a task, or read their stored descriptors.

    Args:
        model_name: the model's name to display.
        name: the task, see `choose_task`.
        weights: part weights, see `scoring.part_weights`.
        calibration, neighbours: see `lazy_task`.

    Raises:
        InputError: when model and data set do not offer the task, or weights or neighbours are invalid.
        LPNError: when pictures, positions, truth, or stores cannot be read.
    """
    name, offered = choose_task(model, dataset, name), offered_tasks(model, dataset)
    scoring.part_weights(model.n_parts, weights)
    task = lazy_task(model, dataset, name, model_name=model_name, calibration=calibration, neighbours=neighbours)
    views, both = task.views, len(task.queries) + len(task.gallery)
    model = model.for_task(*views)
    if neighbours:
        check_neighbours(neighbours, len(task.queries))
    read = descriptors.descriptor_reader(dataset.root)

    def stored(pictures: Sequence[Picture], view: View, role: Role) -> Float32Array:
        if calibration is None:
            with counted_among(0 if role == "query" else len(task.queries), both):
                return descriptors.shipped_or_cached(model, pictures, view, task.root, role)
        return calibration.stored(model, pictures, view, task.root, role, read)

    try:
        with ended():
            queries, gallery = stored(task.queries, views[0], "query"), stored(task.gallery, views[1], "gallery")
    except PictureError:  # name the broken pictures of all lists at once
        check_test_split(dataset, offered)
        raise
    return replace(
        task,
        map_sizes={view: model.map_size(view) for view in views},
        query_descriptors=queries,
        gallery_descriptors=gallery,
        # The explorer replaces the model by one that describes pictures in the background.
        describe=None,
        weights=weights,
        columns=dataset.columns(task.queries),
    )


def scored_tasks(
    model: Model,
    model_name: str,
    dataset: Dataset,
    calibration: Calibration,
    names: Sequence[str],
    neighbours: int = NEIGHBOURS,
) -> list[Task]:
    """Open tasks under the further scorings: calibrated, and, with enough queries, calibrated under CSLS.

    Args:
        model: before the calibration.
        names: of the tasks.
        neighbours: see `describe_task`.

    Raises:
        LPNError: as `describe_task`.
    """
    tasks = [describe_task(model, model_name, dataset, name, calibration=calibration) for name in names]
    return tasks + [by_csls(task, neighbours) for task in tasks if len(task.queries) >= neighbours]


def task_calibration(model: Model, dataset: Dataset, calibrate: bool | None = None) -> Calibration | None:
    """Choose the calibration of a data set's tasks, for the library, every command, and the page; it uses no labels.

    Args:
        calibrate: True for the calibration that ships with the data set, or else a new one; False for none; None for the
            shipped one, if any.

    Returns:
        None to rank plain.

    Raises:
        InputError: when `calibrate` is something else, or a new calibration is impossible.
        LPNError: when pictures cannot be read.
    """
    if calibrate is not None and not isinstance(calibrate, bool):
        raise InputError(f"calibrate is {printable(repr(calibrate))}; expected True, False, or None.")
    shipped = None if calibrate is False else shipped_calibration(model, dataset)
    return new_calibration(model, dataset) if calibrate and shipped is None else shipped


def alike_calibrations(
    models: Sequence[Model], dataset: Dataset, calibrate: bool | None = None
) -> list[Calibration | None]:
    """Choose like `task_calibration` for compared models; they stay plain unless all of them are calibrated."""
    chosen = [task_calibration(model, dataset, calibrate) for model in models]
    return chosen if all(chosen) else [None] * len(chosen)


def no_calibration(model: Model, dataset: Dataset) -> str:
    """Return the reason why a model cannot be calibrated on a data set's pictures, as a sentence; empty if it can."""
    if model.contract.roles == "role":
        return f"{model.contract.method} has different branches for queries and gallery, so no calibration fits both."
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
    """Return the calibration that ships with a data set; None if it is missing, of another model, or lacks a picture."""
    root, folder = dataset.root, dataset.root / FOLDER
    if not (folder / NAME).is_file():
        return None  # do not list the pictures
    lists = _lists(model, dataset)
    try:
        with np.load(folder / NAME, allow_pickle=False) as archive:
            values = dict(archive)
        if str(values["fingerprint"]) != model.fingerprint:
            return None
        zooms, means = dict[View, dict[Path, float]](), dict[View, Float32Array]()
        for view in lists:
            files = (root / name for name in values[f"{view} files"].tolist())
            zooms[view] = dict(zip(files, values[f"{view} zooms"].tolist(), strict=True))
            means[view] = values[f"{view} mean"]
        levels = [
            ZoomLevel(zoom, cost, mean)
            for (zoom, cost), mean in zip(values["levels"].tolist(), values["level_means"], strict=True)
        ]
        tried, ratio = dict(values["tried"].tolist()), float(values["ratio"])
        # These tiles serve to choose the zoom of an uploaded picture.
        tiles = open_store(folder / "gallery_satellite").float32
    except (*DAMAGED_ARRAY, KeyError, StoreError):
        return None
    if any(picture.path not in zooms[view] for view, of_view in lists.items() for some in of_view for picture in some):
        return None
    return Calibration(means, zooms, tried, ratio, levels, tiles)


def _lists(model: Model, dataset: Dataset) -> dict[View, list[Sequence[Picture]]]:
    """Return for each view the picture lists of all tasks that a model offers."""
    lists: dict[View, list[Sequence[Picture]]] = {}
    for name, pictures in lists_of(dataset, offered_tasks(model, dataset)).items():
        lists.setdefault(cast(View, name.split()[1]), []).append(pictures)
    return lists


def new_calibration(model: Model, dataset: Dataset) -> Calibration:
    """Calibrate a model on the pictures of all tasks that it offers, so that one model searches all tasks.

    Raises:
        InputError: when the model's branches have roles, so that descriptors depend on the task, or pictures are too few.
        LPNError: when pictures cannot be read.
    """
    tasks = offered_tasks(model, dataset)
    if not tasks:
        raise no_task_error(model, dataset)
    check_test_split(dataset, tasks)
    if reason := no_calibration(model, dataset):
        raise InputError(f"{reason.rstrip('.')}; leave --calibrate out.")
    return calibrate(model, _lists(model, dataset), descriptors.descriptor_reader(dataset.root))


def offered_tasks(model: Model, dataset: Dataset) -> list[str]:
    """Return the tasks of a data set whose views a model knows."""
    return [name for name in dataset.tasks() if set(views_of(name)) <= set(model.views)]


def no_task_error(model: Model, dataset: Dataset) -> DataError:
    """Return the error for a model and a data set without any of `offered_tasks`."""
    if not (tasks := dataset.tasks()):
        return dataset.no_task()
    name = printable(dataset.root.resolve().name)
    wanted = [f"{role}_{view}" for role in ("query", "gallery") for view in model.views]
    # Pictures of a view may be listed once for both roles. A view without pictures is not in the layout.
    listed = {key.removeprefix("test/") for key, pictures in dataset.lists().items() if pictures}
    has_views = all(any(view in key for key in listed) for view in model.views)
    missing = ", ".join(one for one in wanted if has_views and not listed & {one, one.partition("_")[2]})
    return DataError(
        f"The test split of {name} is for {', '.join(tasks)}, and the model knows only {' and '.join(model.views)} pictures; "
        f"{f'add the missing pictures ({missing}), or ' if missing else ''}choose another data set or model."
    )


def choose_task(model: Model, dataset: Dataset, name: str | None = None) -> str:
    """Return the task `name`, by default the first of `offered_tasks`.

    Raises:
        DataError: when there is none.
        InputError: when the data set lacks the task, or the model does not know its views.
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
