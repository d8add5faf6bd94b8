"""The five kinds of source; each is a group of options of the command line, too."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import tyro

from lpn.core.errors import InputError
from lpn.core.files import distinct_names, printable
from lpn.core.progress import CountProgress, Progress
from lpn.core.resources import ProviderName
from lpn.core.texts import listed
from lpn.core.views import TaskName
from lpn.models.adapters import Kind
from lpn.sources.opened import OpenedSource, query_positions, weighted

if TYPE_CHECKING:
    from lpn.datasets import Dataset
    from lpn.models.base import Model
    from lpn.retrieval.saved import PlainArrays
    from lpn.tasks.task import Task

# Options of a model, which many commands have.
KindOption = Annotated[
    Kind | None,
    tyro.conf.arg(
        metavar="KIND",
        help="Method of a published .pth, such as dac, if its entries do not identify it; see docs/models.md.",
    ),
]
PoolingOption = Annotated[
    str | None,
    tyro.conf.arg(
        help="Pooling of tokens, of a vision transformer, timm:NAME:FILE, or an .onnx of tokens: mean, gem, cls, cls+mean, or "
        "rings:N; see docs/models.md."
    ),
]
ProviderOption = Annotated[
    ProviderName,
    tyro.conf.arg(
        help="Provider: auto (LPN_PROVIDER, else a GPU if one works, else the CPU), cpu, cuda, or, for an .onnx, any of ONNX "
        "Runtime's, such as coreml."
    ),
]

CalibrateOption = Annotated[
    bool | None,
    tyro.conf.DisallowNone,
    tyro.conf.arg(
        help="Calibrate the model on the pictures of all tasks, without labels: choose the zoom at which drone pictures and "
        "tiles show the same ground, and subtract each view's mean (docs/evaluation.md). By default only where a calibration "
        "ships with the data set.",
        help_behavior_hint="",
    ),
]
CslsOption = Annotated[
    int,
    tyro.conf.arg(
        help="Re-rank by CSLS over this many nearest queries of each tile, such as 3: tiles that are near to all queries move "
        "away. It needs no labels, but all queries together (docs/evaluation.md). 0 for none."
    ),
]
# The model of a command that names none.
SHIPPED_MODEL = Path("city-lpn")


def shipped_model() -> Path:
    """Return the model of a command that names none, and say so on the terminal."""
    from lpn.core.consoles import terminal

    sentence = f"The model is {SHIPPED_MODEL}, which ships and knows a rendered city alone; --model takes another."
    terminal().print(sentence, highlight=False, markup=False, soft_wrap=True)
    return SHIPPED_MODEL


def no_progress(stage: str, done: int, total: int) -> None:
    """Report nothing."""


def model_names(
    files: Sequence[Path], poolings: Sequence[str | None], kinds: Sequence[str | None] | None = None
) -> list[str]:
    """Return printable names of models that tell them apart.

    They are those of their files, how their tokens are pooled, and, where that is not enough, the kinds that were named.
    """
    distinct = list(dict.fromkeys(files))
    names = dict(
        zip(distinct, [file.name for file in distinct] if len(distinct) == 1 else distinct_names(distinct), strict=True)
    )
    named = [names[file] + (f", {pooling}" if pooling else "") for file, pooling in zip(files, poolings, strict=True)]
    return [
        f"{name}, {kind}" if kind and named.count(name) > 1 else name
        for name, kind in zip(named, kinds or [None] * len(named), strict=True)
    ]


def of_each(option: str, values: Sequence[str], count: int, models: str) -> list[str | None]:
    """Return an option's value for each of several models in their order, None for "auto"; None for all without values.

    Args:
        option: its name, such as "--beside-kind".
        models: what takes the option, for the message: "models of --beside".

    Raises:
        InputError: if there are more or fewer values than models.
    """
    if values and len(values) != count:
        found = f"{len(values)} {option.rpartition('-')[2]}{'s' * (len(values) > 1)}"
        raise InputError(f"Found {found} for {count} {models}; give one for each in their order, or auto.")
    return [None if value == "auto" else value for value in values] or [None] * count


@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """A trained model."""

    model: Path | None = None
    """Trained model: .onnx (needs no torch), .safetensors, .pth, or a name of lpn models; by default city-lpn, which ships."""
    kind: KindOption = None
    pooling: PoolingOption = None
    provider: ProviderOption = "auto"

    @property
    def name(self) -> str:
        """The file's name and the pooling of its tokens, to display."""
        return model_names([self.file], [self.pooling])[0]

    @property
    def file(self) -> Path:
        """The model that is named, or the one that ships."""
        return self.model or SHIPPED_MODEL

    def load(self) -> Model:
        """Open the model, see `lpn.load` for the errors."""
        import lpn

        return lpn.load(self.model or shipped_model(), self.provider, kind=self.kind, pooling=self.pooling)


def _file_names(*files: Path) -> str:
    return listed([printable(file.resolve().name) for file in files])


class TaskSource(ABC):
    """A source of tasks; `open` opens them.

    Attributes:
        WORD: names the source on the command line.
    """

    WORD: ClassVar[str]

    @property
    @abstractmethod
    def title(self) -> str:
        """The names of its files, to display."""

    @abstractmethod
    def open(
        self,
        names: Sequence[str] = (),
        weights: Sequence[float] | None = None,
        on_progress: Progress = no_progress,
    ) -> OpenedSource:
        """Open the source.

        Args:
            names: names that queries of the first task must have; they are checked before pictures are described.
            weights: part weights of the task, checked likewise; equal by default.
            on_progress: called with a stage and the numbers of finished and of all its steps.

        Raises:
            LPNError: if a file cannot be used, or there is no such query.
        """


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
    on_progress: CountProgress | None = None,
) -> OpenedSource:
    """Open a data set under an opened model, see `Data`.

    Args:
        model_name: the model's name to display.
        calibrate, csls: see `lpn.open_task`.
        every: open every task that model and data set offer, in place of one.
        names, weights: see `TaskSource.open`.
        on_progress: see `lpn.tasks.opening.describe_task`, once for each task.

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
        describe_task(model, model_name, dataset, name, weights, {}, calibration, on_progress, csls)
        for name in (offered_tasks(model, dataset) if every and task is None else [first])
    ]
    return OpenedSource(tasks, model if calibration is None else calibration.applied(model), model)


@dataclass(frozen=True, kw_only=True)
class Data(TaskSource):
    """A data set, described by a model."""

    WORD = "data"

    data: Path
    """Data set in any layout of docs/data.md."""
    model: Annotated[ModelOptions, tyro.conf.arg(name="")] = field(default_factory=ModelOptions)
    task: Annotated[TaskName | None, tyro.conf.arg(metavar="TASK")] = None
    """Views of query and gallery, by default the first task of the data set that the model supports."""
    calibrate: CalibrateOption = None
    csls: CslsOption = 0

    @property
    def title(self) -> str:
        return _file_names(self.model.file, self.data)

    def open(
        self,
        names: Sequence[str] = (),
        weights: Sequence[float] | None = None,
        on_progress: Progress = no_progress,
    ) -> OpenedSource:
        from lpn.datasets import open_dataset

        del on_progress
        dataset = open_dataset(self.data)
        return open_data(
            self.model.load(),
            self.model.name,
            dataset,
            self.task,
            self.calibrate,
            self.csls,
            names=names,
            weights=weights,
        )


class WithoutNetwork(TaskSource):
    """A source of descriptors alone."""

    @abstractmethod
    def task(self) -> Task:
        """Read the task."""

    def open(
        self,
        names: Sequence[str] = (),
        weights: Sequence[float] | None = None,
        on_progress: Progress = no_progress,
    ) -> OpenedSource:
        """See `TaskSource.open`."""
        del on_progress
        task = self.task()
        query_positions(names, task.queries, task.data_name)
        return OpenedSource([weighted(task, weights)])


@dataclass(frozen=True, kw_only=True)
class Published(WithoutNetwork):
    """A result of the published test code on its pictures, without a network."""

    WORD = "published"

    saved: Path
    """Result of the published test code, pytorch_result.mat."""
    data: Path
    """Data set that it was computed on."""
    n_parts: int | None = None
    """Number of parts of its descriptors; 1 by default."""

    @property
    def title(self) -> str:
        return _file_names(self.saved, self.data)

    def task(self) -> Task:
        from lpn.datasets import open_dataset
        from lpn.retrieval.saved import check_n_parts, load_saved
        from lpn.tasks.published_task import published_task

        return published_task(load_saved(self.saved, check_n_parts(self.n_parts)), open_dataset(self.data))


@dataclass(frozen=True, kw_only=True)
class Arrays(WithoutNetwork):
    """Descriptors that any model made, without a network."""

    WORD = "arrays"

    queries: Path
    """Descriptors of the queries that any model made, as .npy, .npz, or .mat."""
    gallery: Path
    """Descriptors of the gallery, in such a file."""
    paths: Path | None = None
    """List of the pictures, a .csv with file, side, label, latitude, longitude (docs/data.md); without it rows are numbered, and
    nobody knows what is right."""
    order: Literal["parts-first", "parts-last"] = "parts-first"
    """Order of the axes: parts-first for arrays (N, n, D), parts-last for (N, D, n)."""
    n_parts: int | None = None
    """Number of parts of two-dimensional arrays; 1 by default."""
    data: Path | None = None
    """Folder that the list's paths are relative to; by default the list's."""

    @property
    def title(self) -> str:
        return _file_names(self.queries, self.gallery)

    def task(self) -> Task:
        from lpn.tasks.array_task import array_task

        return array_task(self.load(), printable(self.queries.name))

    def load(self) -> PlainArrays:
        """Read the arrays, see `load_arrays` for the errors."""
        from lpn.retrieval.saved import check_n_parts, load_arrays

        n_parts = None if self.n_parts is None else check_n_parts(self.n_parts)
        return load_arrays(self.queries, self.gallery, self.paths, n_parts, self.order, self.data)


@dataclass(frozen=True, kw_only=True)
class Indexed(TaskSource):
    """An index of tiles, searched with queries of a data set, of a folder of pictures, or of a flight."""

    WORD = "index"

    index: str
    """Index of tiles, made by lpn index: a folder, or milvus://host:port/collection."""
    model: Annotated[ModelOptions, tyro.conf.arg(name="")] = field(default_factory=ModelOptions)
    data: Path | None = None
    """Data set of the queries; beside --pictures the folder that the tiles' names are relative to."""
    pictures: Path | None = None
    """Folder of plain pictures to search for, whose places nobody knows."""
    map: Path | None = None
    """Map whose windows the index holds, from which their pictures are cut; --flight needs it."""
    flight: Path | None = None
    """Flight over that map, a folder of lpn flight or one of photos, whose frames are the queries."""
    depth: int = 100
    """Number of tiles that a search returns; ranks beyond it are not known."""

    @property
    def title(self) -> str:
        return f"{_file_names(self.model.file)} and the index"

    def open(
        self,
        names: Sequence[str] = (),
        weights: Sequence[float] | None = None,
        on_progress: Progress = no_progress,
    ) -> OpenedSource:
        from lpn.datasets import open_dataset
        from lpn.flights import open_flight
        from lpn.index import open_index
        from lpn.index.queries import dataset_queries, picture_queries
        from lpn.index.shared import SharedIndex
        from lpn.index.task import index_task
        from lpn.locate.index_queries import flight_queries
        from lpn.maps import open_map
        from lpn.retrieval import scoring

        flown = self.flight is not None
        of_data = self.data is not None or self.pictures is not None
        if flown == of_data or (flown and self.map is None):
            raise InputError(
                "An index has tiles and no queries; give one kind of queries: --data, --pictures, or --flight with --map."
            )
        model = self.model.load()
        scoring.part_weights(model.n_parts, weights)
        index = SharedIndex(open_index(self.index))
        ground = None if self.map is None else open_map(self.map)
        if self.flight is not None and ground is not None:
            queries = flight_queries(
                model,
                open_flight(self.flight),
                ground,
                index,
                self.flight,
                lambda done, total: on_progress("frames", done, total),
            )
        elif self.pictures is not None:
            queries = picture_queries(model, self.pictures, index, self.data)
        else:
            assert self.data is not None
            queries = dataset_queries(model, open_dataset(self.data), index)
        query_positions(names, queries.pictures, queries.data_name)
        task = index_task(model, self.model.name, index, queries, self.depth, ground)
        return OpenedSource([weighted(task, weights)], model, model, map=ground)


@dataclass(frozen=True, kw_only=True)
class Flown(TaskSource):
    """A flight over a map: frames are the queries, windows of the map the gallery."""

    WORD = "flight"

    map: Path
    """Map under the flight: a folder of lpn map, or a georeferenced picture."""
    flight: Path
    """Flight over the map: a folder of lpn flight, or one of photos."""
    model: Annotated[ModelOptions, tyro.conf.arg(name="")] = field(default_factory=ModelOptions)

    @property
    def title(self) -> str:
        return _file_names(self.model.file, self.map, self.flight)

    def open(
        self,
        names: Sequence[str] = (),
        weights: Sequence[float] | None = None,
        on_progress: Progress = no_progress,
    ) -> OpenedSource:
        return self.locate(None, on_progress, names, weights)

    def locate(
        self,
        overlap: float | None = None,
        on_progress: Progress = no_progress,
        names: Sequence[str] = (),
        weights: Sequence[float] | None = None,
        shipped: Path | None = None,
        loaded: Model | None = None,
    ) -> OpenedSource:
        """Open the flight with windows that overlap by a share of their sides, `LocateOptions.overlap` by default.

        Args:
            shipped: see `lpn.locate.pipeline.locate`.
            loaded: the model, if it is loaded already.
        """
        from lpn.flights import open_flight
        from lpn.locate.options import LocateOptions
        from lpn.locate.pipeline import locate
        from lpn.locate.task import flight_task
        from lpn.maps import open_map
        from lpn.retrieval import scoring

        ground, flight, model = open_map(self.map), open_flight(self.flight), loaded or self.model.load()
        for view in ("satellite", "drone"):
            model.check_view(view)
        scoring.part_weights(model.n_parts, weights)
        query_positions(names, flight.frames, flight.name)
        options = LocateOptions(register=False, overlap=LocateOptions.overlap if overlap is None else overlap)
        located = locate(ground, flight, model, options, on_progress, shipped=shipped)
        task = flight_task(model, self.model.name, located, self.flight)
        notes = [printable(note) for note in (*ground.notes, *flight.notes, *located.notes)]
        return OpenedSource([weighted(task, weights)], task.model, model, located, notes=notes)
