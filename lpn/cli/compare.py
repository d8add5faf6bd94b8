"""The command compare: several models on the same queries and gallery."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, cast

import tyro

from lpn.core.errors import InputError
from lpn.core.files import distinct_names
from lpn.core.views import TaskName
from lpn.models.adapters import Kind
from lpn.sources import (
    Arrays,
    CalibrateOption,
    CslsOption,
    Flown,
    Indexed,
    ModelOptions,
    ProviderOption,
    Published,
    TaskSource,
    model_names,
    of_each,
)

if TYPE_CHECKING:
    from lpn.analysis.leaderboard import Leaderboard
    from lpn.analysis.model_table import ModelTable, RankedModel
    from lpn.core.consoles import Console
    from lpn.models.base import Model
    from lpn.retrieval.calibration import Calibration


@dataclass(kw_only=True)
class ComparisonOptions:
    """The comparison."""

    seed: int = 0
    """Seed of the bootstrap."""
    resamples: int = 1000
    """Number of bootstrap resamples."""
    table: Path | None = None
    """File to write the printed figures and paired tests to, as its name ends: Markdown (.md), LaTeX (.tex, which needs its
    package booktabs), or one line a model (.csv)."""
    json: Path | None = None
    """File to write everything to, as JSON."""


@dataclass(kw_only=True)
class ComparisonOfSources(ABC):
    """Compare the rankings of two or more models on the same queries and gallery."""

    comparison: ComparisonOptions = field(default_factory=ComparisonOptions)

    def run(self) -> None:
        from lpn.analysis.model_table import compare
        from lpn.analysis.text_tables import latex_page
        from lpn.core.consoles import wide_console
        from lpn.core.files import check_outputs, write_atomic, write_json

        options = self.comparison
        check_outputs((options.table, ".md", ".tex", ".csv"), (options.json, ".json"))
        table = compare(list(self._ranked()), options.seed, options.resamples)
        _print(table, wide_console())
        if options.table is not None:
            match options.table.suffix.lower():
                case ".md":
                    write_atomic(options.table, table.to_markdown().encode())
                case ".tex":
                    write_atomic(options.table, latex_page([table.section]).encode())
                case _:
                    write_atomic(options.table, table.to_csv())
        if options.json is not None:
            write_json(options.json, table.to_dict())

    @abstractmethod
    def _ranked(self) -> Iterator[RankedModel]:
        """Rank the task by each model."""

    def _ranked_sources(self, sources: Sequence[tuple[str, TaskSource]]) -> Iterator[RankedModel]:
        """Rank the first task of each source, under a name that tells it from the others."""
        from lpn.analysis.model_table import rank_task
        from lpn.sources.opened import open_first_task

        _check_several(len(sources))
        for name, source in sources:
            yield rank_task(open_first_task(source), name)


@dataclass(frozen=True, kw_only=True)
class ComparedModels:
    """The compared models."""

    models: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Models (.onnx, .safetensors, .pth, or a name of lpn models)."""
    kind: Annotated[tuple[Kind | Literal["auto"], ...], tyro.conf.arg(metavar="KIND")] = ()
    """Method of each model in their order: auto, or, for a published .pth that its entries do not identify, such as dac;
    by default auto for all (docs/models.md)."""
    pooling: tuple[str, ...] = ()
    """Pooling of the tokens of each model in their order, such as rings:4, or auto for a model that has parts of its own; by
    default auto for all (docs/models.md)."""
    provider: ProviderOption = "auto"

    def options(self) -> dict[str, ModelOptions]:
        """The options of each model by a name that tells it from the others.

        Raises:
            InputError: if there are more or fewer kinds or poolings than models.
        """
        count = len(self.models)
        kinds = cast("list[Kind | None]", of_each("--kind", self.kind, count, "models"))
        poolings = of_each("--pooling", self.pooling, count, "models")
        names = model_names(self.models, poolings, kinds)
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise InputError(
                f"{twice} is compared with itself; give each model once, or by another --kind or --pooling."
            )
        return {
            name: ModelOptions(model=file, kind=kind, pooling=pooling, provider=self.provider)
            for name, file, kind, pooling in zip(names, self.models, kinds, poolings, strict=True)
        }


@dataclass(kw_only=True)
class ComparisonOfPublished(ComparisonOfSources):
    """Compare results of the published test code on the same data set."""

    results: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Results, pytorch_result.mat."""
    data: Path
    """Data set that they were computed on."""

    def _ranked(self) -> Iterator[RankedModel]:
        from lpn.analysis.model_table import rank_published
        from lpn.datasets import open_dataset
        from lpn.retrieval.saved import load_saved

        _check_several(len(self.results))
        dataset = open_dataset(self.data)
        for name, file in zip(distinct_names(self.results), self.results, strict=True):
            yield rank_published(load_saved(file), name, dataset)


@dataclass(kw_only=True)
class ComparisonOfArrays(ComparisonOfSources):
    """Compare the descriptors of several models, as plain arrays, on one list of pictures."""

    queries: tuple[Path, ...]
    """Descriptors of the queries by each model, as .npy, .npz, or .mat."""
    gallery: tuple[Path, ...]
    """Descriptors of the gallery by each model, in the same order."""
    paths: Path
    """List of the pictures, a .csv with file, side, label (docs/data.md)."""
    order: Literal["parts-first", "parts-last"] = "parts-first"
    """Order of the axes: parts-first for arrays (N, n, D), parts-last for (N, D, n)."""
    n_parts: int | None = None
    """Number of parts of two-dimensional arrays; 1 by default."""
    data: Path | None = None
    """Folder that the list's paths are relative to; by default the list's."""

    def _ranked(self) -> Iterator[RankedModel]:
        if len(self.queries) != len(self.gallery):
            raise InputError(
                f"--queries and --gallery name {len(self.queries)} and {len(self.gallery)} files; give both for each model."
            )
        sources = [
            Arrays(
                queries=queries,
                gallery=gallery,
                paths=self.paths,
                order=self.order,
                n_parts=self.n_parts,
                data=self.data,
            )
            for queries, gallery in zip(self.queries, self.gallery, strict=True)
        ]
        return self._ranked_sources(list(zip(distinct_names(self.queries), sources, strict=True)))


@dataclass(kw_only=True)
class ComparisonOfIndexes(ComparisonOfSources):
    """Compare several indexes of the same tiles, such as an exact one and an approximate one, by the searches of one model."""

    indexes: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Indexes, made by lpn index: folders, or milvus://host:port/collection."""
    data: Path
    """Data set of the queries."""
    model: ModelOptions
    depth: int = 100
    """Number of tiles that a search returns."""

    def _ranked(self) -> Iterator[RankedModel]:
        sources = [Indexed(index=index, model=self.model, data=self.data, depth=self.depth) for index in self.indexes]
        return self._ranked_sources(list(zip(self.indexes, sources, strict=True)))


@dataclass(kw_only=True)
class ComparisonOfFlights(ComparisonOfSources):
    """Compare how several models find the windows of a map that the frames of a flight show."""

    models: Annotated[ComparedModels, tyro.conf.arg(name="")]
    map: Path
    """Map under the flight: a folder of lpn map, or a georeferenced picture."""
    flight: Path
    """Flight over the map: a folder of lpn flight, or one of photos."""
    page: Path | None = None
    """Page to write in place of one table: parts, speed, and size of each model, too. It is HTML, Markdown,
    or LaTeX, as the name ends in .html, .md, or .tex."""

    def run(self) -> None:
        if self.page is None:
            super().run()
            return
        from lpn.analysis.leaderboard import task_leaderboard
        from lpn.core.consoles import stage_bars

        models, sizes = _networks(self.page, self.comparison, self.models)
        tasks = {}
        with stage_bars() as on_progress:
            for name, options in self.models.options().items():
                source = Flown(map=self.map, flight=self.flight, model=options)
                tasks[name] = source.locate(on_progress=on_progress, loaded=models[name]).task
        title = f"{self.flight.resolve().name} over {self.map.resolve().stem}"
        board = task_leaderboard(title, models, sizes, tasks, self.comparison.seed, self.comparison.resamples)
        _write_page(board, self.page, self.comparison.json)

    def _ranked(self) -> Iterator[RankedModel]:
        models = self.models.options()
        return self._ranked_sources(
            [(name, Flown(map=self.map, flight=self.flight, model=model)) for name, model in models.items()]
        )


@dataclass(kw_only=True)
class CompareCommand(ComparisonOfSources):
    """Compare two or more models on the same queries and gallery: figures with intervals, and paired tests.

    Results of the published test code (pytorch_result.mat) may stand among the models. One model with --calibrate or --csls is
    compared with itself, ranked plain.
    """

    SOURCES: ClassVar[dict[str, type[ComparisonOfSources]]] = {
        Published.WORD: ComparisonOfPublished,
        Arrays.WORD: ComparisonOfArrays,
        Indexed.WORD: ComparisonOfIndexes,
        Flown.WORD: ComparisonOfFlights,
    }

    models: Annotated[ComparedModels, tyro.conf.arg(name="")]
    data: Path
    """Data set in any layout of docs/data.md."""
    task: Annotated[TaskName | None, tyro.conf.arg(metavar="TASK")] = None
    """Views of query and gallery; by default the first task of the data set."""
    gallery: Literal["full", "without-distractors"] = "full"
    """The gallery that all of them rank: full (as LPN and FSRA do), or without-distractors (as Sample4Geo and DAC do)."""
    calibrate: CalibrateOption = None
    csls: CslsOption = 0
    page: Path | None = None
    """Page to write in place of one table: all tasks, both galleries, parts, speed, and size of each model. It is HTML,
    Markdown, or LaTeX, as the name ends in .html, .md, or .tex."""
    turns: Annotated[tuple[float, ...], tyro.conf.arg(metavar="DEGREES")] = ()
    """Turns of all queries, counter-clockwise, that the page measures as well (Table IV)."""
    weathers: bool = False
    """Measure the ten weathers of University-WX on the page as well (docs/weather.md)."""

    def run(self) -> None:
        if self.page is None:
            if self.turns or self.weathers:
                raise InputError("--turns and --weathers belong to a page; give its file with --page.")
            super().run()
        else:
            self._measure_page(self.page)

    def _measure_page(self, page: Path) -> None:
        from lpn.analysis.leaderboard import leaderboard
        from lpn.core.consoles import stage_bars
        from lpn.datasets import open_dataset
        from lpn.tasks.opening import alike_calibrations

        if self.task or self.gallery != "full":
            raise InputError("A page has all tasks and galleries; leave --task and --gallery out.")
        models, sizes = _networks(page, self.comparison, self.models)
        dataset = open_dataset(self.data)
        calibrations = alike_calibrations(list(models.values()), dataset, self.calibrate)
        titles = {
            name: _scored_name(name, calibration, self.csls)
            for name, calibration in zip(models, calibrations, strict=True)
        }
        models = {titles[name]: model for name, model in models.items()}
        sizes = {titles[name]: size for name, size in sizes.items()}
        with stage_bars("Taking {}") as on_progress:
            board = leaderboard(
                models,
                sizes,
                dataset,
                self.turns,
                self.weathers,
                self.comparison.seed,
                self.comparison.resamples,
                on_progress,
                dict(zip(models, calibrations, strict=True)),
                self.csls,
            )
        _write_page(board, page, self.comparison.json)

    def _ranked(self) -> Iterator[RankedModel]:
        from lpn.analysis.model_table import rank_model, rank_published
        from lpn.datasets import open_dataset
        from lpn.descriptors import descriptor_reader
        from lpn.retrieval.saved import load_saved
        from lpn.tasks.opening import alike_calibrations

        files = self.models.models
        if not files or (len(files) < 2 and not self.calibrate and not self.csls):
            raise InputError(
                f"A comparison takes two models or more, or one with --calibrate or --csls; found {len(files)}."
            )
        models = self.models.options()
        saved = [name for name, model in models.items() if model.file.suffix.lower() == ".mat"]
        if saved and (self.calibrate or self.csls):
            raise InputError(
                f"{saved[0]} holds descriptors, not pictures, so it can be neither calibrated nor ranked anew; leave it, or "
                "--calibrate and --csls, out."
            )
        dataset = open_dataset(self.data)
        tasks = dataset.tasks()
        task = self.task or (tasks[0] if tasks else "drone-to-satellite")
        networks = {name: options.load() for name, options in models.items() if name not in saved}
        calibrated = alike_calibrations(list(networks.values()), dataset, False if saved else self.calibrate)
        calibrations = dict(zip(networks, calibrated, strict=True))
        read = descriptor_reader(dataset.root)
        for name, options in models.items():
            if name in saved:
                if options.kind is not None:
                    raise InputError(
                        f"{name} holds descriptors and needs no kind; give auto in place of {options.kind}."
                    )
                result = rank_published(load_saved(options.file), name, dataset, self.gallery)
                if result.task != task:
                    raise InputError(f"{name} is a result of {result.task}; expected {task}, so choose it with --task.")
                yield result
            else:
                scored = (calibrations[name], self.csls)
                # One model is compared with itself, ranked plain.
                rows = [scored] if len(models) > 1 else dict.fromkeys([(None, 0), (scored[0], 0), scored])
                for calibration, csls in rows:
                    title = _scored_name(name, calibration, csls)
                    yield rank_model(networks[name], title, dataset, task, self.gallery, read, calibration, csls)


def _scored_name(name: str, calibration: Calibration | None, csls: int) -> str:
    """Return a model's name with how it is ranked."""
    return name + (", calibrated" if calibration else "") + (", CSLS" if csls else "")


def _networks(
    page: Path, options: ComparisonOptions, compared: ComparedModels
) -> tuple[dict[str, Model], dict[str, int]]:
    """Return the networks of a page by their names, and the bytes of their files."""
    from lpn.core.files import check_outputs
    from lpn.models.shipped import model_file

    if options.table is not None:
        raise InputError("--table and --page are both given, and a page has tables of its own; leave one of them out.")
    models = compared.options()
    saved = [name for name, model in models.items() if model.file.suffix.lower() == ".mat"]
    if saved:
        raise InputError(f"{saved[0]} holds descriptors, and a page needs networks; leave it out.")
    _check_several(len(models))
    check_outputs((page, ".html", ".htm", ".md", ".tex"), (options.json, ".json"))
    files = {name: model_file(model.file) for name, model in models.items()}
    sizes = {name: file.stat().st_size for name, file in files.items() if file.is_file()}
    return {name: model.load() for name, model in models.items()}, sizes


def _write_page(board: Leaderboard, page: Path, json: Path | None) -> None:
    """Write a page as HTML, LaTeX, or Markdown, and its figures as JSON."""
    from lpn.analysis.text_tables import latex_page
    from lpn.core.files import write_atomic, write_json
    from lpn.report import build_leaderboard

    match page.suffix.lower():
        case ".html" | ".htm":
            written = build_leaderboard(board)
        case ".tex":
            written = latex_page(board.sections()).encode()
        case _:
            written = board.to_markdown().encode()
    write_atomic(page, written)
    if json is not None:
        write_json(json, board.to_dict())
    tables = f"{len(board.tables)} table{'s' * (len(board.tables) > 1)} of tasks and galleries"
    print(f"{page}: {len(board.facts)} models, {tables}")


def _check_several(models: int) -> None:
    if models < 2:
        raise InputError(f"A comparison takes two models or more; found {models}.")


def _print(comparison: ModelTable, console: Console) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table(title=f"{comparison.task}, {comparison.gallery_name}")
    names = list(comparison.figures[0])
    for name in ("model", *names):
        table.add_column(name, justify="left" if name == "model" else "right")
    for one, figures in zip(comparison.models, comparison.figures, strict=True):
        table.add_row(Text(one.name), *map(str, figures.values()))
    tests = Table(title="Queries that only one of two models finds first")
    for name in ("A", "B", "only A", "only B", "both", "neither", "p"):
        tests.add_column(name, justify="left" if name in "AB" else "right")
    for test in comparison.tests:
        counts = (test.only_first, test.only_second, test.both, test.neither)
        tests.add_row(Text(test.first), Text(test.second), *map(str, counts), f"{test.p:.3g}")
    console.print(table, tests)
    console.print(comparison.sentence, markup=False, highlight=False)
