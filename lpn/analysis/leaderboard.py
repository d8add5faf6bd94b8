"""One page about several models on one data set: every task and gallery, parts, turned queries, weathers, speed, and size."""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lpn.analysis.model_table import ModelTable, compare, comparisons_csv
from lpn.analysis.statistics import RESAMPLES
from lpn.core.errors import InputError
from lpn.core.progress import report_progress
from lpn.core.text_tables import TextTable
from lpn.core.views import views_of
from lpn.datasets import Dataset
from lpn.models.base import Model
from lpn.tasks.changes import turned, with_parts
from lpn.tasks.measure import GalleryChoice
from lpn.tasks.task import Task
from lpn.tasks.weathers import WeatherResult, measure_weathers

# Timed passes of one picture, and untimed ones before them.
_TIMED, _WARM = 15, 3


@dataclass(frozen=True)
class ModelFacts:
    """A model's properties, without its figures.

    Attributes:
        method, level: see `Contract`.
        input_size: height and width in pixels.
        numbers: length of a descriptor.
        megabytes: size of its file, 10^6 bytes; None if it was not read from one.
        milliseconds: median of a forward pass of one picture on this machine.
        processor_milliseconds: median processor time of such a pass in all threads; other programs hardly change it.
    """

    method: str
    level: str
    input_size: tuple[int, int]
    numbers: int
    megabytes: float | None
    milliseconds: float
    processor_milliseconds: float

    @classmethod
    def of(cls, model: Model, size: int | None) -> ModelFacts:
        """Collect the properties, and time some forward passes; `size` is the bytes of the model's file, or None."""
        contract, times = model.contract, list[tuple[float, float]]()
        noise = np.random.default_rng(0).standard_normal((1, 3, *contract.input_size)).astype(np.float32)
        for number in range(_WARM + _TIMED):
            started, worked = time.perf_counter(), time.process_time()
            model.run(noise, model.views[0])
            if number >= _WARM:
                times.append((1000 * (time.perf_counter() - started), 1000 * (time.process_time() - worked)))
        milliseconds, processor_milliseconds = map(statistics.median, zip(*times, strict=True))
        numbers, megabytes = contract.n_parts * contract.embedding, None if size is None else size / 1e6
        times_of_one = milliseconds, processor_milliseconds
        return cls(contract.method, contract.level, contract.input_size, numbers, megabytes, *times_of_one)


# Recall@1 and AP in percent.
RecallAndAP = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Leaderboard:
    """The page's contents.

    Attributes:
        data_name: name of the data set.
        facts: of each model, by its name.
        tables: for each task and gallery.
        parts: figures of each part alone, by task and by model of several parts.
        turns: figures of turned queries, by task and model, for each turn in degrees counter-clockwise.
        weathers: by model; empty if not measured.
    """

    data_name: str
    facts: Mapping[str, ModelFacts]
    tables: Sequence[ModelTable]
    parts: Mapping[str, Mapping[str, Mapping[str, RecallAndAP]]]
    turns: Mapping[str, Mapping[str, Mapping[float, RecallAndAP]]]
    weathers: Mapping[str, WeatherResult]

    @property
    def title(self) -> str:
        return f"Models on {self.data_name}"

    def to_dict(self) -> dict[str, Any]:
        """The page as JSON values."""
        return {
            "data": self.data_name,
            "models": {name: vars(facts) for name, facts in self.facts.items()},
            "tables": [table.to_dict() for table in self.tables],
            "parts": self.parts,
            "turns": self.turns,
            "weathers": {name: result.to_dict() for name, result in self.weathers.items()},
        }

    def to_csv(self) -> bytes:
        """Return the figures and tests of all tasks and galleries, see `comparisons_csv`."""
        return comparisons_csv(self.tables)

    @property
    def printed(self) -> list[TextTable]:
        """The page's tables: the models, each task and gallery, parts, turns, and weathers."""
        facts = [
            (
                *(name, of.method, of.level, "{} x {}".format(*of.input_size), f"{of.numbers:,}"),
                "" if of.megabytes is None else f"{of.megabytes:.1f}",
                *(f"{of.milliseconds:.1f}", f"{of.processor_milliseconds:.1f}"),
            )
            for name, of in self.facts.items()
        ]
        head = ("model", "method", "account", "input", "numbers", "MB", "ms a picture", "ms of processor")
        after = (
            f"Times are medians of {_TIMED} forward passes of one picture on the machine that made this page. The "
            "processor's times are sums over its threads, and other programs hardly change them."
        )
        tables = [TextTable(head, facts, after=after, align="lllr"), *(one for of in self.tables for one in of.printed)]
        for title, of_tasks in (("Each part alone", self.parts), ("Turned queries, degrees", self.turns)):
            tables += [_changed(f"{title}: {task}", "model", of_models) for task, of_models in of_tasks.items()]
        for task in next(iter(self.weathers.values())).tasks if self.weathers else ():
            # Rows are the weathers, as in University-WX's table; eleven columns would be too wide for a page.
            rows: dict[str, dict[Any, RecallAndAP]] = {}
            for model, result in self.weathers.items():
                for weather, figures in result.figures.items():
                    rows.setdefault(weather, {})[model] = figures[task]
            tables.append(_changed(f"Weathers: {task}", "weather", rows))
        if self.weathers:
            tables[-1] = replace(tables[-1], after=next(iter(self.weathers.values())).sentence)
        return tables


def common_tasks(models: Mapping[str, Model], dataset: Dataset) -> list[str]:
    """Return the names of the data set's tasks that all models know; DataError or InputError without any."""
    if not dataset.tasks():
        raise dataset.no_task()
    tasks = [
        task for task in dataset.tasks() if all(set(views_of(task)) <= set(model.views) for model in models.values())
    ]
    if not tasks:
        raise InputError(
            f"No task of {dataset.root.name} is known to all of {', '.join(models)}; compare fewer models."
        )
    return tasks


def leaderboard(
    data_name: str,
    models: Mapping[str, Model],
    sizes: Mapping[str, int],
    tasks: Sequence[str],
    opened: Callable[[str, str], Task],
    turns: Sequence[float] = (),
    weathers: bool = False,
    seed: int = 0,
    resamples: int = RESAMPLES,
    groups: Sequence[str] = (),
) -> Leaderboard:
    """Measure models on tasks, on the full gallery and without distractors.

    Args:
        models: by their names.
        sizes: bytes of the models' files, if they were read from files.
        tasks: names of the tasks.
        opened: opens a task by model name and task name; all models have equal queries and galleries.
        turns: degrees counter-clockwise by which all queries are turned as well (Table IV).
        weathers: measure the ten weathers of University-WX as well.
        seed, resamples: of the bootstrap, see `model_table`.
        groups: of the models in the tables of tasks, see `model_table.compare`.

    Raises:
        InputError: when a model does not support a measure, no query's truth is known, or queries or galleries differ.
    """
    done, stages = itertools.count(1), len(models) * (1 + len(tasks) * (1 + len(turns)) + weathers)

    def report() -> None:
        report_progress("Taking measures", next(done), stages)

    def measured(task: Task) -> RecallAndAP:
        result = task.evaluate()
        return result.recall["1"], result.ap

    facts, tables = dict[str, ModelFacts](), list[ModelTable]()
    for name, model in models.items():
        facts[name] = ModelFacts.of(model, sizes.get(name))
        report()
    parts: dict[str, dict[str, dict[str, RecallAndAP]]] = {}
    of_turns: dict[str, dict[str, dict[float, RecallAndAP]]] = {}
    for name in tasks:
        results = []
        for model_name in models:
            task = opened(model_name, name)
            results.append(task.with_fields(model_name=model_name).evaluate())
            report()
            if (count := task.contract.n_parts) > 1:
                alone = {str(part): measured(with_parts(task, [part])) for part in range(1, count + 1)}
                parts.setdefault(name, {})[model_name] = {**alone, "all": (results[-1].recall["1"], results[-1].ap)}
            for degrees in turns:
                of_turns.setdefault(name, {}).setdefault(model_name, {})[degrees] = measured(turned(task, degrees))
                report()
        galleries: tuple[GalleryChoice, ...] = ("full", "without-distractors")
        tables += [
            compare([result.ranked(gallery) for result in results], seed, resamples, groups)
            for gallery in galleries[: len(results[0].galleries)]
        ]
    of_weathers, flown = {}, [task for task in tasks if set(views_of(task)) != {"satellite"}]
    for name in models if weathers else ():
        of_weathers[name] = measure_weathers([opened(name, task) for task in flown])
        report()
    return Leaderboard(data_name, facts, tables, parts, of_turns, of_weathers)


def _changed(title: str, rows: str, figures: Mapping[str, Mapping[Any, RecallAndAP]]) -> TextTable:
    """Return a table of Recall@1 and AP by row and column; `rows` names the rows."""
    names = list(dict.fromkeys(column for of in figures.values() for column in of))
    cells = [
        (row, *("{:.2f} / {:.2f}".format(*of[name]) if name in of else "" for name in names))
        for row, of in figures.items()
    ]
    head = (rows, *(f"{name:g}" if isinstance(name, float) else str(name) for name in names))
    return TextTable(head, cells, f"{title}, R@1 / AP in percent")
