"""A data set, described by a model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from lpn.sources.opened import OpenedSource, query_positions
from lpn.sources.options import SourceOptions
from lpn.sources.recognise import NETWORK, TaskSource, file_names

if TYPE_CHECKING:
    from lpn.datasets import Dataset
    from lpn.models.base import Model
    from lpn.tasks.task import Task


class DataSource(TaskSource):
    """A data set, described by a model."""

    noun = "a data set"
    takes = NETWORK | {"task", "calibrate", "csls", "parts", "shift", "scale", "weather", "per_query", "beside_weather"}
    takes |= {"beside", "beside_kind", "beside_pooling"}
    priority = -1  # `open_dataset` reports the error for any other source

    @classmethod
    def recognises(cls, options: SourceOptions) -> bool:
        del options
        return True

    @property
    def title(self) -> str:
        return file_names(self.options.file, self.options.path)

    def open(self, names: Sequence[str] = (), weights: Sequence[float] | None = None) -> OpenedSource:
        from lpn.datasets import open_dataset

        options, dataset = self.options, open_dataset(self.options.path)
        model = options.load()
        scoring = options.task, options.calibrate, options.csls
        return open_data(model, options.name, dataset, *scoring, names=names, weights=weights)

    def to_measure(self) -> list[Task]:
        from lpn.core.views import views_of
        from lpn.datasets import open_dataset
        from lpn.tasks.opening import lazy_task, no_task_error, offered_tasks, task_calibration

        options = self.options
        dataset, model = open_dataset(options.path), options.load()
        tasks = offered_tasks(model, dataset)
        if options.task is None and not tasks:
            raise no_task_error(model, dataset)
        first = options.task or tasks[0]
        swapped = views_of(first)[::-1]
        reverse = [name for name in tasks if options.task is None and views_of(name) == swapped != views_of(first)]
        calibration = task_calibration(model, dataset, options.calibrate)
        return [
            lazy_task(model, dataset, name, model_name=options.name, calibration=calibration, neighbours=options.csls)
            for name in [first, *reverse]
        ]


def open_data(
    model: Model,
    model_name: str,
    dataset: Dataset,
    task: str | None = None,
    calibrate: bool | None = None,
    csls: int = 0,
    every: bool = False,
    names: Sequence[str] = (),
    weights: Sequence[float] | None = None,
) -> OpenedSource:
    """Open a data set with a loaded model.

    Args:
        model_name: the model's name to display.
        calibrate, csls: see `lpn.open_task`.
        every: open every task that model and data set offer, in place of one.
        names, weights: see `TaskSource.open`.

    Raises:
        LPNError: if model and data set do not offer the task, a file cannot be used, or there is no such query.
    """
    from lpn.core.views import views_of
    from lpn.tasks.opening import choose_task, describe_task, offered_tasks, task_calibration

    first = choose_task(model, dataset, task)
    if names:
        query_positions(names, dataset.queries(views_of(first)[0]), dataset.root.name)
    calibration = task_calibration(model, dataset, calibrate)
    tasks = [
        describe_task(model, model_name, dataset, name, weights, calibration, csls)
        for name in (offered_tasks(model, dataset) if every and task is None else [first])
    ]
    return OpenedSource(tasks, model if calibration is None else calibration.applied(model), model)
