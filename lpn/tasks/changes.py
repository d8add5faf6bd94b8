"""Changes of a task: turned, in weather, with some parts, centred, calibrated, averaged, or by CSLS.

Pictures are described when the changed task's descriptors are first read. Each change adds its clause to the sentence of
`lpn.tasks.measure`. Changes of pictures come first, because the others use the descriptors of pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError
from lpn.core.progress import counted_among, ended
from lpn.core.views import View
from lpn.datasets import Picture
from lpn.descriptors import cached_descriptors
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.descriptors.weather import CLEAR, Weather, WeatherName
from lpn.models.base import Model, normalise
from lpn.models.contract import Role
from lpn.retrieval import calibration as calibrations
from lpn.retrieval.calibration import Calibration
from lpn.tasks.task import Task


def why_not(task: Task) -> str:
    """Return the reason why queries of a task cannot be changed, as a sentence about turned queries; empty if they can."""
    if task.model is None:
        return "These are descriptors without their network, so queries cannot be turned."
    if any(picture.cut is not None for picture in task.queries):
        return "The queries are cut out of other pictures, so descriptors of turned queries are not stored."
    return task.no_truth


def turned(task: Task, degrees: float) -> Task:
    """Turn all queries by degrees counter-clockwise, see `changed`."""
    return changed(task, replace(task.change, rotate=float(degrees % 360)))


def in_weather(task: Task, weather: WeatherName) -> Task:
    """Draw a weather on all queries, see `changed`."""
    return changed(task, replace(task.change, weather=Weather(weather)))


def changed(task: Task, change: Change) -> Task:
    """Change all queries; this replaces an earlier change of them.

    Descriptors are cached by the change, so a second call needs no network. As in University-WX, weather falls on the gallery
    if the queries are tiles and the gallery is not.

    Raises:
        InputError: when the task cannot be changed, see `why_not`, or compares tiles with tiles, which have no weather.
    """
    change = replace(
        change, released=task.change.released, around=any(picture.panorama for picture in task.queries[:1])
    )
    if change == task.change:
        return task
    if reason := why_not(task):
        raise InputError(reason)
    if change.weather and task.views == ("satellite", "satellite"):
        raise InputError(f"{task.name} has satellite tiles on both sides, which have no weather; leave --weather out.")
    before, after = _of_sides(task, task.change), _of_sides(task, change)
    described: dict[str, Callable[[], Float32Array]] = {}
    for side, pictures, view, one, other in zip(
        ("query_descriptors", "gallery_descriptors"),
        (task.queries, task.gallery),
        task.views,
        before,
        after,
        strict=True,
    ):
        if one != other:
            described[side] = _describing(task, pictures, view, other)
    clauses = [clause for clause in task.clauses if clause not in _clauses(task, task.change)]
    return task.with_fields(
        **described,
        change=change,
        clauses=(*clauses, *_clauses(task, change)),
    )


def calibrated(task: Task, calibration: Calibration | None) -> Task:
    """Zoom the pictures by a calibration, and subtract each view's mean; None leaves the task plain.

    Calibrated descriptors that ship with the data set are read, so that no picture is described at several zooms.

    Raises:
        InputError: when the task's pictures are changed already, or one branch describes both views.
    """
    if calibration is None:
        return task
    if task.model is None or task.change or not set(task.views) <= set(task.contract.views):
        raise InputError(
            "A calibration centres each view, and needs the view's own branch and our protocol; leave out --centre, another "
            "branch, and the released protocol, and change pictures after the calibration."
        )
    model, plain, views = task.model, task.describe, task.views

    def read(model: Model, pictures: Sequence[Picture], view: View, change: Change = UNCHANGED) -> Float32Array:
        return cached_descriptors(model, pictures, view, change) if plain is None else plain(pictures, view, change)

    def describe(pictures: Sequence[Picture], view: View, change: Change) -> Float32Array:
        return calibration.read(model, pictures, view, read, change)

    def stored(side: int, role: Role) -> Float32Array:
        return calibration.stored(model, (task.queries, task.gallery)[side], views[side], task.root, role, read)

    sides = [calibration.pictures(view, side) for view, side in zip(views, (task.queries, task.gallery), strict=True)]
    moved = calibration.applied(model)
    return task.with_fields(
        model=moved,
        contract=moved.contract,
        queries=sides[0],
        gallery=sides[1],
        query_descriptors=lambda: stored(0, "query"),
        gallery_descriptors=lambda: stored(1, "gallery"),
        describe=describe,
        calibration=calibration,
        clauses=(*task.clauses, calibration.describe()),
    )


def centred(task: Task) -> Task:
    """Subtract the queries' mean from each query and the gallery's mean from each tile, part by part.

    Raises:
        InputError: for a calibrated task, whose means are already subtracted.
    """
    if task.calibration is not None:
        raise InputError("The task is calibrated, which centres each view; leave --centre or the calibration out.")
    return _derived(
        task,
        "the mean of the queries and that of the gallery subtracted, and each part normalised again",
        query_descriptors=lambda: calibrations.centred(task.sides()[0]),
        gallery_descriptors=lambda: calibrations.centred(task.sides()[1]),
    )


def averaged(task: Task) -> Task:
    """Average the queries of each place: sum their descriptors, and normalise each part.

    The places are sorted by label, and have neither positions nor groups.

    Raises:
        InputError: when true matches are listed for each query.
    """
    if task.truth is not None:
        raise InputError(
            f"Each query of {task.data_name} has its own list of true matches; only queries with labels can be averaged, "
            "so evaluate them one by one."
        )
    order = np.argsort(task.query_labels, kind="stable")
    places, starts = np.unique(task.query_labels[order], return_index=True)
    rows = np.split(order, starts[1:])

    def described() -> Float32Array:
        queries = task.query_descriptors
        return normalise(np.stack([queries[some].sum(axis=0) for some in rows]))

    return _derived(
        task,
        f"the {len(order)} query pictures averaged to one query per place",
        query_descriptors=described,
        query_labels=places,
        queries=[task.queries[some[0]] for some in rows] if len(task.queries) else [],
        geometry=None,
        dataset=None,
        columns=(),
    )


def with_parts(task: Task, parts: Sequence[int] | None) -> Task:
    """Compare only some parts (Table V): numbers from 1, without duplicates, in the given order; None for all.

    Raises:
        InputError: when a part does not exist, or is not a whole number, or no part is given.
    """
    count = task.contract.n_parts
    if parts is not None and not (isinstance(parts, Collection) and all(map(_whole, parts))):
        raise InputError(f"The parts are {parts!r:.60}; expected whole numbers from 1 to {count}, such as [1].")
    chosen = tuple(range(1, count + 1) if parts is None else dict.fromkeys(parts))
    if not chosen or any(not 1 <= part <= count for part in chosen):
        raise InputError(f"The parts are {', '.join(map(str, chosen)) or 'none'}; there are parts 1 to {count}.")
    if chosen == tuple(range(1, count + 1)):
        return task
    columns = np.array(chosen) - 1
    named = f"part{'s' if len(chosen) > 1 else ''} {', '.join(map(str, chosen))}"
    numbers = task.parts or range(1, count + 1)
    return _derived(
        task,
        f"{named} of {count} only",
        query_descriptors=lambda: task.sides()[0][:, columns],
        gallery_descriptors=lambda: task.sides()[1][:, columns],
        parts=tuple(numbers[column] for column in columns),
        contract=replace(
            task.contract,
            title=f"{task.contract.title}, {named}",
            n_parts=len(chosen),
            level="one vector" if len(chosen) == 1 else "parts only",
            held="",
            partitions={},
            part_names={view: [task.contract.names(view)[i] for i in columns] for view in task.contract.views},
        ),
    )


def _whole(value: object) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def by_csls(task: Task, neighbours: int) -> Task:
    """Re-rank by CSLS over the K nearest queries of each tile, see `lpn.retrieval.csls`; 0 changes nothing."""
    return task.with_fields(neighbours=neighbours) if neighbours else task


def _derived(task: Task, clause: str, **changes: Any) -> Task:
    """Return a task with descriptors that are computed from the descriptors of `task`, without a network."""
    return task.with_fields(
        **{"model": None, "describe": None, "weights": None, **changes}, clauses=(*task.clauses, clause)
    )


def _of_sides(task: Task, change: Change) -> tuple[Change, Change]:
    still = Change(released=change.released)
    if task.query_view == "satellite" != task.gallery_view:
        return replace(change, weather=CLEAR), replace(still, weather=change.weather)
    return change, still


def _clauses(task: Task, change: Change) -> list[str]:
    of_queries, of_gallery = _of_sides(task, change)
    bicubic = ", bicubic" if change.rotate and not change.around and not change.released else ""
    clauses = [f"queries {of_queries.describe()}{bicubic}"] if of_queries.describe() else []
    return [*clauses, f"gallery pictures {of_gallery.describe()}"] if of_gallery.weather else clauses


def _describing(task: Task, pictures: Sequence[Picture], view: View, change: Change) -> Callable[[], Float32Array]:
    """Return a function that describes changed pictures as the task describes its pictures."""
    if task.describe is not None:
        describe = task.describe
        return lambda: describe(pictures, view, change)

    def described() -> Float32Array:
        model, done = task.model, 0
        assert model is not None

        def read(some: Sequence[Picture], zoom: float) -> Float32Array:
            nonlocal done
            before, done = done, done + len(some)
            with counted_among(before, len(pictures)):
                return cached_descriptors(model, some, view, replace(change, scale=change.scale * zoom))

        with ended():
            return calibrations.by_zoom(model, pictures, np.array([picture.zoom for picture in pictures]), read)

    return described
