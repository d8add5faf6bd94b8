"""The command evaluate: recall and AP of a source."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from lpn.cli.parsing import numbers
from lpn.core.consoles import wide_console
from lpn.core.errors import InputError
from lpn.core.files import check_outputs, write_atomic, write_json
from lpn.core.text_tables import TextTable
from lpn.descriptors.weather import WeatherName
from lpn.sources import Advanced, SourceOptions, source_of

if TYPE_CHECKING:
    from lpn.tasks.measure import Result
    from lpn.tasks.task import Task
    from lpn.tasks.weathers import WeatherResult

# Tiles listed by --per-query.
_LISTED = 10


@dataclass(kw_only=True)
class EvaluateCommand(SourceOptions):
    """Measure recall and AP of a source: a test split under a model, a saved result, an index, or the retrieval of a flight."""

    rotate: float = 0.0
    """Degrees counter-clockwise by which each query is rotated first (Table IV)."""
    shift: Advanced[int] = 0
    """Pixels of the network's input to shift each query to the right; a negative number shifts it to the left. The side
    that is uncovered becomes black."""
    scale: Advanced[float] = 1.0
    """Zoom factor of each query about its centre; below 1 with a black border."""
    weather: WeatherName | Literal["all"] = "normal"
    """Weather of University-WX in drone or street pictures, on either side. With all, the ten weathers are measured in both
    directions, and the leaderboard's table is printed."""
    parts: str | None = None
    """Parts to use, numbered from 1 and separated by commas, such as 1,2 (Table V); by default all parts."""
    centre: Advanced[bool] = False
    """Of saved descriptors: subtract the mean of all queries from each query, and that of the gallery from each tile, part by
    part. It needs no labels, and makes up for places and cameras that differ from those of the training."""
    json: Path | None = None
    """File to write the measures to, as JSON."""
    per_query: Path | None = None
    """File to write a line for each query to, as CSV: its rank, AP, and the names and scores of the ten nearest tiles."""

    def run(self) -> None:
        from lpn.tasks.measure import measure
        from lpn.tasks.weathers import measure_weathers

        check_outputs((self.json, ".json"), (self.per_query, ".csv"))
        if self.weather == "all" and self.per_query is not None:
            raise InputError(
                "--per-query lists the queries in one weather; choose one with --weather, or leave it out."
            )
        if self.centre and self.n_parts is None and self.gallery is None and self.path.suffix.lower() == ".mat":
            raise InputError(
                "Centring normalises each part, and a saved result does not contain the number of parts; give it with --n-parts "
                "(1 for a baseline)."
            )
        source = source_of(self)
        opened = source.to_measure()
        tasks = [self._changed(task) for task in opened]
        title = tasks[0].model_name
        if opened[0].model is not None:  # the network of saved descriptors is unknown
            title += f" ({tasks[0].contract.title}) on {tasks[0].data_name}"
        if self.weather == "all":
            weathers = measure_weathers(tasks)
            _print_weathers(title, weathers)
            written = weathers.to_dict()
        else:
            result = measure(tasks[0], 0 if self.per_query is None else _LISTED)
            _print_result(title, result)
            written = result.to_dict()
            if self.per_query is not None:
                write_atomic(self.per_query, result.queries_csv())
        if self.json is not None:
            write_json(self.json, written)

    def _changed(self, task: Task) -> Task:
        """Return a task changed by the options; InputError if one of them is out of range."""
        from lpn.descriptors.transforms import Change
        from lpn.descriptors.weather import Weather
        from lpn.tasks.changes import centred, changed, with_parts

        change = Change(
            self.rotate, self.shift, self.scale, weather=Weather("normal" if self.weather == "all" else self.weather)
        )
        task = changed(task, change) if change else task
        task = centred(task) if self.centre else task
        return with_parts(task, numbers(self.parts, int, "parts", "numbers from 1, such as 1,2"))


def _print_result(title: str, result: Result) -> None:
    """Print a table of recall and AP, and the protocol below it."""
    from lpn.tasks.measure import WITHOUT

    of_group, rows = [result.group_name] if result.groups else [], []
    for group, galleries in [("all", result.galleries), *result.groups.items()]:
        for figures in galleries:
            values = map(_figure, (*figures.recall.values(), figures.ap))
            names = (result.task, *([group] if of_group else []))
            rows.append((*names, str(figures.queries), figures.name, *values))
    head = ("task", *of_group, "queries", "gallery", *(f"recall@{k}" for k in result.recall), "ap")
    console = wide_console()
    TextTable(head, rows, title, result.sentence, align="r").print(console)
    if any(figures.gallery_name == WITHOUT for figures in result.galleries):
        console.print(
            f"The rows {WITHOUT} drop the gallery pictures of places that no query shows, as Sample4Geo, DAC, and CAMP do; LPN, "
            "FSRA, MCCG, and SDPL rank the full gallery. Figures of the two do not compare."
        )
    if result.measures:
        units = {"dis": " m", "ma": " %", "hit rate": " %", "region_recall": " %", "flight_recall": " %"}
        named = (
            f"{_title(key)} {value:.4g}{units.get(key.split('@')[0], '')}" for key, value in result.measures.items()
        )
        console.print(f"Metrics of the field: {', '.join(named)}.")
    if near := result.distances():
        shares = ", ".join(f"{value:.1f} % {key}" for key, value in near.items() if key.startswith("within"))
        median = f"{near['median error m']:.1f} m"
        console.print(
            f"By the positions, the median error of the top match is {median}; the shares of queries are {shares}."
        )


def _print_weathers(title: str, result: WeatherResult) -> None:
    """Print University-WX's table: a row for each weather, and their mean."""

    head = ("weather", *(name for task in result.tasks for name in (f"{task}\nR@1", "\nAP")))
    rows = [
        (name, *(_figure(value) for pair in figures.values() for value in pair))
        for name, figures in result.figures.items()
    ]
    TextTable(head, rows, title, result.sentence, ruled=(len(rows) - 1,)).print(wide_console())


def _figure(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2f}"


def _title(key: str) -> str:
    """Return a metric's name from its key, such as "SDM@3 (DenseUAV)" from "sdm_denseuav@3"."""
    name, _, depth = key.partition("@")
    titles = {
        **{"sdm_denseuav": "SDM@{} (DenseUAV)", "sdm_gta_uav": "SDM@{} (GTA-UAV)", "dis": "Dis@{}", "ma": "MA@{} m"},
        **{f"{group}_recall": f"mean R@{{}} of {group}s" for group in ("region", "flight")},
    }
    return titles.get(name, name).format(depth)
