"""A model's retrieval in the ten weathers of University-WX, in the form of MuseNet's leaderboard."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from lpn.core.notebook_html import percentages
from lpn.descriptors.weather import WEATHERS, WeatherName
from lpn.tasks.changes import in_weather
from lpn.tasks.measure import Result, measure
from lpn.tasks.task import Task


@dataclass(frozen=True, eq=False)
class WeatherResult:
    """The results of one or two tasks in each weather.

    Attributes:
        results: for each of `WEATHERS`, the result of each task.
    """

    MEAN: ClassVar[str] = "mean"

    results: Mapping[WeatherName, Mapping[str, Result]]

    @property
    def tasks(self) -> list[str]:
        """The tasks, such as "drone-to-satellite" and its reverse."""
        return list(self.results["normal"])

    @cached_property
    def figures(self) -> dict[str, dict[str, tuple[float, float]]]:
        """Recall@1 and AP of each task in percent by weather, and last their means over the weathers, `MEAN`."""
        figures: dict[str, dict[str, tuple[float, float]]] = {
            name: {task: (result.recall["1"], result.ap) for task, result in of_tasks.items()}
            for name, of_tasks in self.results.items()
        }
        means = np.mean([list(of.values()) for of in figures.values()], axis=0).tolist()
        return {
            **figures,
            self.MEAN: {task: (recall, ap) for task, (recall, ap) in zip(self.tasks, means, strict=True)},
        }

    @property
    def sentence(self) -> str:
        """The protocol of the figures, in the first weather that is not normal."""
        first = next(iter(self.results["fog"].values()))
        sizes = " and ".join(f"{result.queries:,} queries {task}" for task, result in self.results["normal"].items())
        return f"R@1 and AP in percent on {sizes}; weather in drone and street pictures only. In fog: {first.sentence}"

    def to_dict(self) -> dict[str, Any]:
        """The results as JSON values: `weathers`, by weather and task, and `mean`, by task."""
        of_weathers = {
            name: {task: result.to_dict() for task, result in of.items()} for name, of in self.results.items()
        }
        means = {task: {"recall@1": recall, "ap": ap} for task, (recall, ap) in self.figures[self.MEAN].items()}
        return {"weathers": of_weathers, "mean": means}

    def _repr_html_(self) -> str:
        rows = {
            name: {f"{task} {metric}": of[task][i] for task in of for i, metric in enumerate(("R@1", "AP"))}
            for name, of in self.figures.items()
        }
        return percentages(self.sentence, "weather", rows)


def measure_weathers(tasks: Sequence[Task]) -> WeatherResult:
    """Measure tasks in each of `WEATHERS`; weather falls on all pictures but satellite tiles.

    Args:
        tasks: such as drone-to-satellite and its reverse, under one model.

    Raises:
        InputError: if a task compares tiles with tiles, or cannot be changed, see `lpn.tasks.changes`.
    """
    results: dict[WeatherName, dict[str, Result]] = {}
    for task in tasks:
        in_weather(task, "fog")  # refuse before pictures are described
    for name in WEATHERS:
        results[name] = {task.name: measure(in_weather(task, name)) for task in tasks}
    return WeatherResult(results)
