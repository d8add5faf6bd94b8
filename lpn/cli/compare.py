"""The command compare: several models on the same queries and gallery."""

from __future__ import annotations

from collections.abc import Iterator, Sized
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from lpn.core.consoles import wide_console
from lpn.core.errors import InputError
from lpn.core.files import check_outputs, distinct_names, printable, write_atomic, write_json
from lpn.core.text_tables import latex_page, markdown_page
from lpn.core.texts import counted, listed
from lpn.core.views import TaskName
from lpn.models.adapters import Kind
from lpn.sources import (
    SHIPPED_MODEL,
    Advanced,
    CalibrateOption,
    CslsOption,
    ModelOptions,
    ProviderOption,
    SourceOptions,
    TaskSource,
    kind_of,
    model_names,
    of_each,
    shipped_model,
    source_of,
)
from lpn.sources.kinds.data import DataSource
from lpn.sources.kinds.saved import ResultSource

if TYPE_CHECKING:
    from lpn.analysis.leaderboard import Leaderboard
    from lpn.analysis.model_table import ModelTable
    from lpn.tasks.measure import RankedModel
    from lpn.tasks.task import Task

# Endings of the files that tables are written to.
_ENDINGS = (".md", ".tex", ".csv", ".html", ".htm")


@dataclass(kw_only=True)
class CompareCommand:
    """Compare two or more models on the same queries and gallery: figures with intervals, and paired tests.

    lpn compare ROOT --model A B compares models on a data set, and on a flight with --map MAP. Saved results, arrays, and indexes
    are compared as several sources, also beside models: lpn compare ROOT result.mat --model A. One model with --calibrate or
    --csls is compared with itself, ranked plain.
    """

    source: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")] = ()
    """Sources, each as lpn evaluate takes it; one that takes a model is opened with each model."""
    model: tuple[Path, ...] = ()
    """Models (.onnx, .safetensors, .pth, or a name of lpn models); by default the shipped city-lpn."""
    kind: Advanced[Annotated[tuple[Kind | Literal["auto"], ...], tyro.conf.arg(metavar="KIND")]] = ()
    """Methods of the models in their order: auto, or a method such as dac for a published .pth without entries that
    identify it; by default auto for all (docs/models.md)."""
    pooling: Advanced[tuple[str, ...]] = ()
    """Pooling of the tokens of each model in their order, such as rings:4, or auto for a model that defines its parts; by
    default auto for all (docs/models.md)."""
    provider: ProviderOption = "auto"
    data: Path | None = None
    """Data set of an index's queries or of a .mat's pictures, by default the first source; folder that the paths of --paths
    are relative to."""
    map: Path | None = None
    """Map under a flight, or of an index's windows: a folder of lpn map, or a georeferenced picture."""
    task: Annotated[TaskName | None, tyro.conf.arg(metavar="TASK")] = None
    """Views of query and gallery; by default the first task of the data set."""
    calibrate: CalibrateOption = None
    csls: CslsOption = 0
    gallery: Advanced[tuple[Path, ...]] = ()
    """Of arrays: descriptors of the gallery for each of the arrays in their order."""
    paths: Advanced[Path | None] = None
    """Of arrays: list of the pictures, a .csv with file, side, label (docs/data.md)."""
    order: Advanced[Literal["parts-first", "parts-last"]] = "parts-first"
    """Of arrays: order of the axes, parts-first for (N, n, D), parts-last for (N, D, n)."""
    n_parts: Advanced[int | None] = None
    """Number of parts of two-dimensional arrays; 1 by default."""
    without_distractors: bool = False
    """Leave the gallery's distractors out, as Sample4Geo and DAC do; by default all rank the full gallery, as LPN and FSRA do."""
    group: tuple[str, ...] = ()
    """Group of each model in their order, such as LPN LPN LPN SAFA SAFA SAFA for three runs (seeds) of each. A group is one
    row with mean and standard deviation, and groups are compared; by default each model is one."""
    seed: Advanced[int] = 0
    """Seed of the bootstrap."""
    resamples: Advanced[int] = 1000
    """Number of bootstrap resamples."""
    table: Path | None = None
    """File to write the printed figures and paired tests to. Its ending chooses Markdown (.md), LaTeX with the package
    booktabs (.tex), HTML (.html), or one line for each model or group (.csv)."""
    json: Path | None = None
    """File to write everything to, as JSON."""
    page: Path | None = None
    """Page about a data set to write in place of one table: all tasks, both galleries, parts, speed, and size of each model. It
    is HTML, Markdown, LaTeX, or CSV, as the name ends in .html, .md, .tex, or .csv."""
    turns: Annotated[tuple[float, ...], tyro.conf.arg(metavar="DEGREES")] = ()
    """Turns of all queries, counter-clockwise, that the page measures as well (Table IV)."""
    weathers: bool = False
    """Measure the ten weathers of University-WX on the page as well (docs/weather.md)."""

    def run(self) -> None:
        from lpn.analysis.model_table import compare

        for option, values in {"--kind": self.kind, "--pooling": self.pooling}.items():
            if values and not self.model:
                raise InputError(f"{option} needs --model; give both, or leave it out.")
        if self.page is not None:
            self._measure_page(self.page)
            return
        if self.turns or self.weathers:
            raise InputError("--turns and --weathers belong to a page; give its file with --page.")
        check_outputs((self.table, *_ENDINGS), (self.json, ".json"))
        table = compare(list(self._ranked()), self.seed, self.resamples, self.group)
        for one in table.printed:
            one.print(wide_console())
        _write(table, self.table, self.json)

    def _sources(self) -> dict[str, TaskSource]:
        """Return each source with each model by a distinct name; InputError if an option fits no source, or a name repeats."""
        if not self.source:
            raise InputError("There is no SOURCE; give its path first, as lpn evaluate takes it.")
        shared = ("provider", "data", "map", "task", "calibrate", "csls", "paths", "order", "n_parts")
        common = {"model": self.model[0] if self.model else None, **{name: getattr(self, name) for name in shared}}
        given = [
            SourceOptions(source=source, gallery=gallery, **common)
            for source, gallery in zip(self.source, self._galleries(), strict=True)
        ]
        kinds = [kind_of(options) for options in given]
        taken = frozenset[str]().union(*(kind.takes for kind in kinds))
        # A scoring applies to all sources or to none; `source_of` names the kinds that take it.
        taken -= {name for name in ("calibrate", "csls") if getattr(self, name)}
        models = self._models() if "model" in taken else []
        several = sum("model" in kind.takes for kind in kinds) > 1
        names = distinct_names([Path(source) for source in self.source])
        found: list[tuple[str, TaskSource]] = []
        for options, kind, name in zip(given, kinds, names, strict=True):
            unfit: dict[str, Any] = {
                one.name: one.default for one in fields(SourceOptions) if one.name in taken - kind.takes
            }
            options = replace(options, **unfit)
            if kind is ResultSource and self.data is None and kinds[0] is DataSource:
                options.data = given[0].path
            if "model" not in kind.takes:
                if options.gallery is not None and names.count(name) > 1:  # other galleries for the same queries
                    name += f", {distinct_names(self.gallery)[self.gallery.index(options.gallery)]}"
                found.append((name, source_of(options)))
                continue
            for model_name, model in models:
                title = (name if len(models) == 1 else f"{model_name}, {name}") if several else model_name
                found.append((title, source_of(replace(options, **vars(model)))))
        titles = [title for title, _ in found]
        if twice := next((title for title in titles if titles.count(title) > 1), None):
            raise InputError(
                f"{twice} is compared with itself; give each source once, and each model once or by another --kind or --pooling."
            )
        if models and not self.model:
            shipped_model()  # reported once, however many sources
        return dict(found)

    def _galleries(self) -> list[Path | None]:
        """Return the gallery of each source in their order; None for sources without one."""
        if not self.gallery:
            return [None] * len(self.source)
        endings = [Path(source).suffix.lower() for source in self.source]
        # A .mat holds arrays if a gallery remains for it, else a result of the published test code.
        for taken in ((".npy", ".npz", ".mat"), (".npy", ".npz")):
            if sum(ending in taken for ending in endings) == len(self.gallery):
                left = iter(self.gallery)
                return [next(left) if ending in taken else None for ending in endings]
        raise InputError(
            f"{listed(list(map(printable, self.source)))} are the sources, and --gallery names {len(self.gallery)}; give one for "
            "each .npy, .npz, or .mat of queries in their order."
        )

    def _models(self) -> list[tuple[str, ModelOptions]]:
        """Return the name and the options of each model."""
        files = self.model or (SHIPPED_MODEL,)
        kinds = of_each("--kind", self.kind, len(files), "models")
        poolings = of_each("--pooling", self.pooling, len(files), "models")
        return [
            (name, ModelOptions(model=file, kind=kind, pooling=pooling, provider=self.provider))
            for name, file, kind, pooling in zip(
                model_names(files, poolings, kinds), files, kinds, poolings, strict=True
            )
        ]

    def _ranked(self) -> Iterator[RankedModel]:
        from lpn.tasks.measure import measure, scored_names

        sources = list(self._sources().items())
        several = len(sources) > 1
        if not several and (self.calibrate or self.csls):  # compared with itself, ranked plain
            ((name, source),) = sources
            off = {"calibrate": False} if "calibrate" in source.takes else {}
            changes: list[dict[str, Any]] = [{"csls": 0, **off}, {"csls": 0}, {}]
            sources = [(name, source_of(replace(source.options, **change))) for change in changes]
        _check_count(sources, ", or one with --calibrate or --csls")
        tasks = [(name, source.to_measure()[0]) for name, source in sources]
        if several and not all(task.calibration for _, task in tasks):  # all models are then ranked plain
            for place, (name, task) in enumerate(tasks):
                if task.calibration is not None:
                    alike = source_of(replace(sources[place][1].options, calibrate=False))
                    tasks[place] = name, alike.to_measure()[0]
        titles = scored_names([(name, task.calibration, task.neighbours) for name, task in tasks])
        scored = dict(zip(titles, (task for _, task in tasks), strict=True))
        for title, task in scored.items():
            result = measure(task.with_fields(model_name=title))
            yield result.ranked("without-distractors" if self.without_distractors else "full")

    def _measure_page(self, page: Path) -> None:
        from lpn.analysis.leaderboard import common_tasks, leaderboard
        from lpn.datasets import open_dataset
        from lpn.models.shipped import model_file
        from lpn.tasks.measure import scored_names
        from lpn.tasks.opening import alike_calibrations, lazy_task

        if self.table is not None:
            raise InputError("--table and --page are both given, and a page has its own tables; leave one of them out.")
        if self.task or self.without_distractors:
            raise InputError("A page has all tasks and galleries; leave --task and --without-distractors out.")
        sources = self._sources()
        if other := next((one.noun for one in sources.values() if not isinstance(one, DataSource)), None):
            raise InputError(f"A page is about a data set, and {other} is given; write a --table in place of it.")
        if len(self.source) > 1:
            raise InputError(
                f"A page is about one data set, and {len(self.source)} are given; give one, or leave --page out."
            )
        _check_count(sources)
        check_outputs((page, *_ENDINGS), (self.json, ".json"))
        networks = [source.options.load() for source in sources.values()]
        dataset = open_dataset(Path(self.source[0]))
        chosen = alike_calibrations(networks, dataset, self.calibrate)
        titles = scored_names([(name, one, self.csls) for name, one in zip(sources, chosen, strict=True)])
        models, calibrations = dict(zip(titles, networks, strict=True)), dict(zip(titles, chosen, strict=True))
        files = [model_file(source.options.file) for source in sources.values()]

        def opened(name: str, task: str) -> Task:
            return lazy_task(models[name], dataset, task, calibration=calibrations[name], neighbours=self.csls)

        board = leaderboard(
            dataset.root.resolve().name,
            models,
            {title: file.stat().st_size for title, file in zip(titles, files, strict=True) if file.is_file()},
            common_tasks(models, dataset),
            opened,
            self.turns,
            self.weathers,
            self.seed,
            self.resamples,
            self.group,
        )
        _write(board, page, self.json)
        tables = counted(len(board.tables), "table")
        print(f"{page}: {counted(len(board.facts), 'model')}, {tables} of tasks and galleries")


def _check_count(sources: Sized, also: str = "") -> None:
    if len(sources) < 2:
        raise InputError(f"A comparison takes two models or more{also}; found {len(sources)}.")


def _write(result: Leaderboard | ModelTable, page: Path | None, json: Path | None) -> None:
    """Write tables as HTML, LaTeX, CSV, or Markdown, and their figures as JSON."""
    from lpn.report import table_page

    if page is not None:
        match page.suffix.lower():
            case ".html" | ".htm":
                written = table_page(result.title, result.printed)
            case ".tex":
                written = latex_page(result.printed).encode()
            case ".csv":
                written = result.to_csv()
            case _:
                written = markdown_page(result.printed, result.title).encode()
        write_atomic(page, written)
    if json is not None:
        write_json(json, result.to_dict())
