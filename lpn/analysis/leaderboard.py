"""One page about several models on one data set: every task and gallery, parts, turned queries, weathers, speed, and size."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from lpn.analysis.model_table import (
    RESAMPLES,
    GalleryChoice,
    ModelTable,
    compare,
    has_distractors,
    rank_model,
    rank_task,
)
from lpn.analysis.text_tables import TableSection, TextTable, markdown_text
from lpn.core.errors import InputError
from lpn.core.progress import report_progress
from lpn.core.views import views_of
from lpn.datasets import Dataset
from lpn.descriptors import descriptor_reader
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.models.base import Model
from lpn.retrieval.calibration import Calibration
from lpn.retrieval.evaluate import evaluate
from lpn.retrieval.protocol import Protocol
from lpn.retrieval.sides import TaskPictures
from lpn.retrieval.weathers import WeatherResult, evaluate_weathers
from lpn.tasks.task import Task

# Passes of one picture that are timed, after others that are not.
_TIMED, _WARM = 15, 3
_UNITS = "R@1 / AP in percent."


@dataclass(frozen=True)
class ModelFacts:
    """A model without its figures.

    Attributes:
        method, level: see `Contract`.
        input_size: height and width in pixels.
        numbers: of a descriptor.
        megabytes: of its file, 10^6 bytes; None if it was not read from one.
        milliseconds: median of a forward pass of one picture on this machine.
        processor_milliseconds: median of its processor time in all threads, which another program's load hardly changes.
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
        """Collect them, and time some forward passes.

        Args:
            size: bytes of the model's file; None if it was not read from one.
        """
        contract, times = model.contract, list[tuple[float, float]]()
        noise = np.random.default_rng(0).standard_normal((1, 3, *contract.input_size)).astype(np.float32)
        for number in range(_WARM + _TIMED):
            started, worked = time.perf_counter(), time.process_time()
            model.run(noise, model.views[0])
            if number >= _WARM:
                times.append((1000 * (time.perf_counter() - started), 1000 * (time.process_time() - worked)))
        milliseconds, processor_milliseconds = map(statistics.median, zip(*times, strict=True))
        return cls(
            contract.method,
            contract.level,
            contract.input_size,
            contract.n_parts * contract.embedding,
            None if size is None else size / 1e6,
            milliseconds,
            processor_milliseconds,
        )


# Recall@1 and AP in percent.
RecallAndAP = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Leaderboard:
    """The page.

    Attributes:
        data_name: of the data set.
        facts: of each model, by its name.
        tables: for each task and gallery.
        parts: by task and model, the figures of each part alone; of models with several parts.
        turns: by task and model, the figures of queries turned by so many degrees counter-clockwise.
        weathers: by model; empty without them.
    """

    data_name: str
    facts: Mapping[str, ModelFacts]
    tables: Sequence[ModelTable]
    parts: Mapping[str, Mapping[str, Mapping[str, RecallAndAP]]]
    turns: Mapping[str, Mapping[str, Mapping[float, RecallAndAP]]]
    weathers: Mapping[str, WeatherResult]

    @property
    def title(self) -> str:
        """The page's title."""
        return f"Models on {self.data_name}"

    def to_markdown(self) -> str:
        """Return the page in Markdown."""
        lines = [f"# {markdown_text(self.title)}", ""]
        return "\n".join([*lines, *(line for section in self.sections() for line in section.markdown_lines())])

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

    def sections(self) -> Iterator[TableSection]:
        """Yield the page's sections: the models, each task and gallery, parts, turns, and weathers."""
        facts = [
            (
                name,
                of.method,
                of.level,
                "{} x {}".format(*of.input_size),
                f"{of.numbers:,}",
                "" if of.megabytes is None else f"{of.megabytes:.1f}",
                f"{of.milliseconds:.1f}",
                f"{of.processor_milliseconds:.1f}",
            )
            for name, of in self.facts.items()
        ]
        head = ("model", "method", "account", "input", "numbers", "MB", "ms a picture", "ms of processor")
        yield TableSection(
            "",
            [TextTable(head, facts, texts=3)],
            after=f"Times are medians of {_TIMED} forward passes of one picture on the machine that made this page; that of the "
            "processor is the sum over its threads, and hardly changes where other programs compute, too.",
        )
        yield from (table.section for table in self.tables)
        for title, of_tasks in (("Each part alone", self.parts), ("Turned queries, degrees", self.turns)):
            yield from (_changed(f"{title}: {task}", of_models) for task, of_models in of_tasks.items())
        if self.weathers:
            first = next(iter(self.weathers.values()))
            for position, task in enumerate(first.tasks):
                # Rows are the weathers, as in University-WX's table; eleven columns would be too wide for a page.
                of_models = {name: dict(result.rows()) for name, result in self.weathers.items()}
                rows = [
                    (weather, *(_recall_and_ap(of[weather][position]) for of in of_models.values()))
                    for weather, _ in first.rows()
                ]
                table = TextTable(("weather", *of_models), rows)
                last = position + 1 == len(first.tasks)
                yield TableSection(f"Weathers: {task}", [table], _UNITS, first.sentence if last else "")


def leaderboard(
    models: Mapping[str, Model],
    sizes: Mapping[str, int],
    dataset: Dataset,
    turns: Sequence[float] = (),
    weathers: bool = False,
    seed: int = 0,
    resamples: int = RESAMPLES,
    calibrations: Mapping[str, Calibration | None] = MappingProxyType({}),
    csls: int = 0,
) -> Leaderboard:
    """Measure models on all tasks of a data set that all of them know, on the full gallery and without distractors.

    Args:
        models: by their names.
        sizes: bytes of the files of those that were read from one.
        turns: degrees counter-clockwise by which all queries are turned as well (Table IV).
        weathers: measure the ten weathers of University-WX as well.
        seed, resamples: of the bootstrap, see `model_table`.
        calibrations: of the calibrated models.
        csls: K of CSLS; 0 ranks without it.

    Raises:
        InputError: when no task is known to all models, or a measure is not possible on one of them.
        DataError: when the test split is incomplete.
    """
    tasks = [
        task for task in dataset.tasks() if all(set(views_of(task)) <= set(model.views) for model in models.values())
    ]
    if not dataset.tasks():
        raise dataset.no_task()
    if not tasks:
        raise InputError(
            f"No task of {dataset.root.name} is known to all of {', '.join(models)}; compare fewer models."
        )
    read, done = descriptor_reader(dataset.root), 0
    stages = len(models) * (1 + len(tasks) * (1 + len(turns)) + (1 if weathers else 0))

    def report() -> None:
        nonlocal done
        done += 1
        report_progress("Taking measures", done, stages)

    def figures(name: str, task: str, change: Change = UNCHANGED, parts: tuple[int, ...] | None = None) -> RecallAndAP:
        protocol = Protocol(change, parts, csls=csls)
        result = evaluate(models[name], dataset, task, protocol, read, calibrations.get(name))
        return result.recall["1"], result.ap

    facts = {}
    for name, model in models.items():
        facts[name] = ModelFacts.of(model, sizes.get(name))
        report()
    tables: list[ModelTable] = []
    parts: dict[str, dict[str, dict[str, RecallAndAP]]] = {}
    turned: dict[str, dict[str, dict[float, RecallAndAP]]] = {}
    for task in tasks:
        galleries: list[GalleryChoice] = ["full"]
        if has_distractors(TaskPictures.of(dataset, task)):
            galleries.append("without-distractors")
        for gallery in galleries:
            ranked = [
                rank_model(model, name, dataset, task, gallery, read, calibrations.get(name), csls)
                for name, model in models.items()
            ]
            tables.append(compare(ranked, seed, resamples))
        for name, model in models.items():
            report()
            if model.n_parts > 1:
                alone = {str(part): figures(name, task, parts=(part,)) for part in range(1, model.n_parts + 1)}
                parts.setdefault(task, {})[name] = {**alone, "all": figures(name, task)}
            for degrees in turns:
                turned.setdefault(task, {}).setdefault(name, {})[degrees] = figures(
                    name, task, Change(rotate=float(degrees))
                )
                report()
    of_weathers, flown = {}, [task for task in tasks if set(views_of(task)) != {"satellite"}]
    for name, model in models.items() if weathers else ():
        of_weathers[name] = evaluate_weathers(model, dataset, flown, Protocol(csls=csls), calibrations.get(name))
        report()
    return Leaderboard(dataset.root.resolve().name, facts, tables, parts, turned, of_weathers)


def task_leaderboard(
    name: str,
    models: Mapping[str, Model],
    sizes: Mapping[str, int],
    tasks: Mapping[str, Task],
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> Leaderboard:
    """Measure models on one task that each of them has opened, such as a flight over a map.

    Args:
        name: of the data.
        models: by their names.
        sizes: bytes of the files of those that were read from one.
        tasks: of each model, by its name, with the same queries and gallery.
        seed, resamples: of the bootstrap, see `model_table`.

    Raises:
        InputError: when the tasks differ in their queries or gallery, or no query's truth is known.
    """
    table = compare([rank_task(task, model) for model, task in tasks.items()], seed, resamples)
    parts: dict[str, dict[str, RecallAndAP]] = {}
    for model, task in tasks.items():
        if (count := task.contract.n_parts) > 1:
            weights = {str(part + 1): [float(part == one) for one in range(count)] for part in range(count)}
            ranked = {part: rank_task(task, model, alone) for part, alone in weights.items()}
            ranked["all"] = rank_task(task, model)
            parts[model] = {
                part: (100 * float(one.within(1).mean()), 100 * float(one.precision.mean()))
                for part, one in ranked.items()
            }
    facts = {model: ModelFacts.of(network, sizes.get(model)) for model, network in models.items()}
    return Leaderboard(name, facts, [table], {table.task: parts} if parts else {}, {}, {})


def _changed(title: str, of_models: Mapping[str, Mapping[Any, RecallAndAP]]) -> TableSection:
    """Return a section with Recall@1 and AP, a row for each model and a column for each change."""
    names = list(dict.fromkeys(change for of in of_models.values() for change in of))
    rows = [
        (model, *(_recall_and_ap(figures[name]) if name in figures else "" for name in names))
        for model, figures in of_models.items()
    ]
    head = ("model", *(f"{name:g}" if isinstance(name, float) else str(name) for name in names))
    return TableSection(title, [TextTable(head, rows)], _UNITS)


def _recall_and_ap(figures: RecallAndAP) -> str:
    return "{:.2f} / {:.2f}".format(*figures)
