"""Open a workspace: a model on a data set, or a published result on its pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

from explorer.compute.background_jobs import ReportProgress
from explorer.compute.own_photos import OwnPhotoJobs
from explorer.compute.ranking_job import RankingJob
from explorer.compute.scorings import Scorings
from explorer.workspace import LazyWorkspace, Workspace
from lpn.core.consoles import terminal
from lpn.core.errors import InputError, LPNError
from lpn.core.files import printable
from lpn.core.requirements import missing_package
from lpn.core.resources import yield_cores
from lpn.core.texts import counted
from lpn.datasets import Dataset, open_dataset, warn_left_out
from lpn.descriptors.transforms import Change
from lpn.descriptors.weather import CLEAR, Weather, WeatherName
from lpn.flight.locate.located import LocatedFlight
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.pipeline import registered
from lpn.flight.locate.source import FlightSource, OpenedFlight
from lpn.models.base import Model
from lpn.retrieval.calibration import Calibration
from lpn.retrieval.csls import NEIGHBOURS, check_neighbours
from lpn.sources import ModelOptions, OpenedSource, SourceOptions, model_names, source_of
from lpn.sources.kinds.data import open_data
from lpn.tasks.changes import by_csls, changed
from lpn.tasks.opening import (
    choose_task,
    new_calibration,
    no_calibration,
    scored_tasks,
    shipped_calibration,
    task_calibration,
)
from lpn.tasks.task import Scoring, Task

# Seconds for which the start waits for registration; cached answers take less.
REGISTRATION_WAIT = 3.0
# Overlap of the windows of an offered flight. `lpn locate` describes four times as many; here a user waits.
OFFERED_OVERLAP = 0.5


def open_model(
    data: Path,
    model: Path | ModelOptions | Model,
    query: str | None = None,
    beside: Sequence[ModelOptions] = (),
    baseline: Path | None = None,
    calibrate: bool | None = None,
    csls: int = 0,
    task: str | None = None,
    beside_weathers: Sequence[WeatherName] = (),
) -> Workspace:
    """Open a model on the tasks of a data set whose views it knows.

    Args:
        model: a model, its file, or the options that load it.
        query: name of the query of the first task that a new browser shows; by default the task's first query.
        beside: other models to compare with on the same data. All are loaded, but only the first is opened; the others
            describe their pictures when a browser asks for it.
        baseline: a model of one part for comparison if `beside` is empty; opened when a browser asks for it.
        calibrate, csls: how the page ranks when it opens, see `lpn.open_task`. A browser may ask for the other scorings.
        task: the only task to open; by default all.
        beside_weathers: weathers in which to compare the model with itself; described when a browser asks for it.

    Raises:
        LPNError: when a model or the data set cannot be used, a model or a weather is given twice, or there is no such query.
    """
    own = ModelOptions(model=model) if isinstance(model, Path) else model
    provider = own.provider if isinstance(own, ModelOptions) else "auto"
    names = _names([own, *beside] if isinstance(own, ModelOptions) else beside)
    name = printable(own.contract.method) if isinstance(own, Model) else names.pop(0)
    _check_weathers(beside_weathers)
    if beside_weathers and isinstance(own, ModelOptions):
        own = own.load()
    scoring = task, calibrate, csls
    workspace = _open_one(data, own, name, scoring)
    dataset = next(iter(workspace.tasks.values())).dataset
    assert dataset is not None
    warn_left_out(dataset.root.name, dataset.unread(), "picture")
    workspace.choose_first_query(query)
    opens = []
    for options, other_name in zip(beside, names, strict=True):
        other = options.load()
        choose_task(other, dataset)
        opens.append(partial(_open_one, data, other, other_name, scoring))
    _put_beside(workspace, names, opens)
    for weather in map(Weather, beside_weathers):
        assert isinstance(own, Model)
        label = f"{workspace.model_name} {weather.describe()}"
        workspace.beside.append(LazyWorkspace(label, partial(_in_weather, workspace, own, weather, label)))
    if baseline is not None and not beside:
        options = ModelOptions(model=baseline, provider=provider)
        opens_it = _naming_files([baseline], partial(_open_one, data, options, baseline.name, scoring))
        workspace.beside.append(LazyWorkspace("the baseline (n = 1)", opens_it))
    return workspace


def _in_weather(workspace: Workspace, model: Model, weather: Weather, label: str) -> Workspace:
    """Open a workspace's tasks again with all queries in a weather, except tasks whose queries are tiles."""
    yield_cores()  # the work describes all queries, and answers must not wait for it
    tasks = [task for task in workspace.tasks.values() if task.query_view != "satellite"]
    if not tasks:
        raise InputError("All queries are satellite tiles, which have no weather; leave --beside-weather out.")
    changed_tasks = [replace(changed(task, Change(weather=weather)), model_name=label) for task in tasks]
    return _workspace(OpenedSource(changed_tasks, model), weather=weather)


def _check_weathers(weathers: Sequence[WeatherName]) -> None:
    if "normal" in weathers or len(set(weathers)) < len(weathers):
        raise InputError(f"--beside-weather has {', '.join(weathers)}; expected weathers other than normal, each once.")


def _put_beside(workspace: Workspace, names: Sequence[str], opens: Sequence[Callable[[], Workspace]]) -> None:
    """Put models beside a workspace's own: open the first now, and the others when a browser asks for them."""
    for name, open_workspace in zip(names, opens, strict=True):
        workspace.beside.append(LazyWorkspace(name, _naming_files([], open_workspace)))
    if opens:
        first = opens[0]()
        workspace.beside[0] = LazyWorkspace(names[0], lambda: first, first)


def _names(models: Sequence[ModelOptions]) -> list[str]:
    """Return the models' display names; InputError for two equal choices of file, kind, and pooling."""
    given = [(one.file.absolute(), one.kind, one.pooling) for one in models]
    for i, one in enumerate(models):
        if given[i] in given[:i]:
            raise InputError(f"{printable(one.file.name)} is given twice; --model and --beside need different models.")
    return model_names([one.file for one in models], [one.pooling for one in models], [one.kind for one in models])


def _open_one(
    data: Path,
    model: ModelOptions | Model,
    model_name: str,
    scoring: tuple[str | None, bool | None, int],
) -> Workspace:
    """Open one model on a data set, see `open_model`; `scoring` has its arguments `task`, `calibrate`, and `csls`."""
    data_name = printable(data.resolve().name)
    with _status(f"Opening {model_name} and {data_name}"):
        opened = model if isinstance(model, Model) else model.load()
        dataset = open_dataset(data)
    task, calibrate, csls = scoring
    workspace = _workspace(open_data(opened, model_name, dataset, task, False, every=True))
    _offer_scorings(workspace, opened, model_name, dataset, calibrate, csls)
    return workspace


def _offer_scorings(
    workspace: Workspace,
    model: Model,
    model_name: str,
    dataset: Dataset,
    calibrate: bool | None,
    csls: int,
) -> None:
    """Offer calibrated and CSLS scorings: at once if a calibration ships or is asked for, else on request; see `open_model`."""
    tasks = list(workspace.tasks.values())
    if csls:
        check_neighbours(csls, max(len(task.queries) for task in tasks))
    asked = task_calibration(model, dataset, calibrate)
    ready = asked or shipped_calibration(model, dataset)

    def rank(scored: Iterable[Task]) -> None:
        for ranking in [_begin_ranking(task) for task in scored if task.key not in workspace.rankings]:
            workspace.rankings[ranking.task.key] = ranking

    def rank_by(calibration: Calibration) -> None:
        names = list(workspace.tasks)
        rank(scored_tasks(model, model_name, dataset, calibration, names, csls or NEIGHBOURS))

    def prepare(_: ReportProgress) -> None:
        yield_cores()  # answers must not wait for it
        rank_by(new_calibration(model, dataset))

    if csls and asked is None:
        rank(by_csls(task, csls) for task in tasks if len(task.queries) >= csls)
    if ready is not None:
        rank_by(ready)
    why_not = "" if ready is not None else no_calibration(model, dataset)
    workspace.scorings = Scorings(why_not, prepare if ready is None and not why_not else None)
    opens_with: dict[Scoring, object] = {"csls": csls, "calibrated": asked}
    workspace.opens_with = tuple(scoring for scoring, wanted in opens_with.items() if wanted)
    if calibrate and asked is not None:
        _say(f"{printable(model_name)} is {asked.describe()}.")


def _naming_files(files: Sequence[Path], open_workspace: Callable[[], Workspace]) -> Callable[[], Workspace]:
    """Return a function whose error messages name files without their folders, because a browser shows them."""

    def opened() -> Workspace:
        try:
            return open_workspace()
        except ModuleNotFoundError as error:
            raise missing_package(error) from error
        except LPNError as error:
            text = str(error)
            for file in files:
                text = text.replace(str(file), printable(file.name))
            raise type(error)(text) from error

    return opened


def open_source(options: SourceOptions, query: str | None = None) -> Workspace:
    """Recognise a source, and open its tasks.

    Args:
        query: name of the query that a new browser shows first.

    Raises:
        LPNError: when the source cannot be used, or there is no such query.
    """
    source = source_of(options)
    with _status(f"Opening {source.title}"):
        opened = source.open()
    workspace = _workspace(opened)
    _print_notes(opened)
    workspace.choose_first_query(query)
    return workspace


def open_tasks(tasks: Sequence[Task], query: str | None = None) -> Workspace:
    """Open tasks of one model on one data set that are open already.

    Args:
        query: name of the query of the first task that a new browser shows first.

    Raises:
        InputError: when there is no such query.
    """
    workspace = _workspace(OpenedSource(tasks, tasks[0].model))
    workspace.choose_first_query(query)
    return workspace


def open_flight_over(
    map_path: Path,
    flight_path: Path,
    model: ModelOptions,
    query: str | None = None,
    beside: Sequence[ModelOptions] = (),
    register: bool = True,
    overlap: float = LocateOptions.overlap,
    shipped: Path | None = None,
    map_error: float | None = None,
) -> Workspace:
    """Open a flight over a map: its frames are the queries, the map's windows the gallery, see `lpn.flight.locate.task`.

    Retrieval and sequence are computed before the app starts, or read from the user's cache. Registration goes on in the
    background, unless its answers are cached.

    Args:
        map_path: a map that `lpn.flight.maps.open_map` opens.
        flight_path: a folder of lpn flight, or a folder of photos.
        query: name of the frame that a new browser shows first; by default the flight's first readable one.
        beside: other models to compare with on the same flight. All are loaded, but only the first is opened; the others
            describe windows and frames when a browser asks for it.
        register: whether photos are laid over the map.
        overlap: share of a window's side that its neighbour covers, in [0, 1).
        shipped: a folder of answers of `model` that ship with the flight, see `lpn.flight.locate.shipped`.
        map_error: 1-sigma error of the map's positions in metres, part of every radius, see `LocateOptions.map_error`.

    Raises:
        LPNError: when map, flight, or a model cannot be used, a model is given twice, or there is no such frame.
    """
    name, *names = _names([model, *beside])
    locating = LocateOptions(register=False, overlap=overlap, map_error=map_error)
    source = FlightSource(_over(map_path, flight_path, model))
    opened = _open_flown(source, name, overlap, shipped)
    workspace, located, network = _flight_workspace(opened, map_error), opened.located, opened.network
    assert located is not None
    assert network is not None
    if shipped is None:  # otherwise, the flight panel shows them
        _print_notes(opened)
    broken = () if located.retrieval is None else located.retrieval.broken
    readable = (frame.frame.name for i, frame in enumerate(located.frames) if i not in broken)
    workspace.choose_first_query(next(readable, None) if query is None else query)
    opens = []
    for options, other_name in zip(beside, names, strict=True):
        loaded = options.load()  # a model that cannot be loaded ends the start
        other = FlightSource(_over(map_path, flight_path, options))
        opens.append(partial(_open_flight_beside, other, other_name, overlap, loaded))
    _put_beside(workspace, names, opens)
    if register:
        _begin_registration(workspace, located, network, locating)
    return workspace


def _over(map_path: Path, flight_path: Path, model: ModelOptions) -> SourceOptions:
    named = {one.name: getattr(model, one.name) for one in fields(ModelOptions)}
    return SourceOptions(source=str(flight_path), map=map_path, **named)


def _open_flight_beside(source: FlightSource, name: str, overlap: float, loaded: Model) -> Workspace:
    return _flight_workspace(_open_flown(source, name, overlap, loaded=loaded))


def _flight_workspace(opened: OpenedFlight, map_error: float | None = None) -> Workspace:
    workspace = _workspace(opened, map_error)
    workspace.scorings = Scorings("Frames are cut to the ground of map windows, so a flight needs no calibration.")
    return workspace


def offered(label: str, files: Sequence[Path], open_workspace: Callable[[], Workspace]) -> LazyWorkspace:
    """Return a workspace with shipped answers, which is opened when a browser asks for it.

    Args:
        label: its name on the page.
        files: its files; its error messages name them without folders.
    """
    return LazyWorkspace(label, _naming_files(files, open_workspace))


def _open_flown(
    source: FlightSource,
    name: str,
    overlap: float,
    shipped: Path | None = None,
    loaded: Model | None = None,
) -> OpenedFlight:
    """Open a flight without registration, under a display name of its model."""
    with _status(f"Opening {source.title}"):
        return source.locate(overlap, shipped=shipped, loaded=loaded).named(name)


def _workspace(source: OpenedSource, map_error: float | None = None, weather: Weather = CLEAR) -> Workspace:
    """Return a workspace of tasks on the same data, and begin to rank their galleries."""
    first, model = source.task, source.model
    flown = source if isinstance(source, OpenedFlight) else None
    return Workspace(
        first.model_name,
        first.data_name,
        [_begin_ranking(task) for task in source.tasks],
        first.contract,
        dict(first.map_sizes) if model is None else {view: model.map_size(view) for view in model.views},
        model,
        first.root,
        None if flown is None else flown.located,
        None if flown is None else flown.map,
        None if flown is None else OwnPhotoJobs(flown.map, map_error),
        weather,
    )


def _print_notes(source: OpenedSource) -> None:
    for note in source.notes:
        _say(note)


def _say(text: str) -> None:
    terminal().print(text, highlight=False, markup=False, soft_wrap=True)


def _begin_registration(workspace: Workspace, located: LocatedFlight, model: Model, options: LocateOptions) -> None:
    """Register in the background, and wait for the cached answers."""

    def publish(partial: LocatedFlight) -> None:
        workspace.flight = partial

    def register(_: ReportProgress) -> LocatedFlight:
        return registered(located, model, options, on_partial=publish)

    job = workspace.register_flight(register)
    with _status("Registering frames; the page opens while this goes on"):
        job.wait(REGISTRATION_WAIT)


def _begin_ranking(task: Task) -> RankingJob:
    ranking = RankingJob(task)
    with _status(f"Ranking {counted(task.tiles, 'picture')} for {counted(len(task.queries), 'query')}, {task.name}"):
        ranking.start()
    return ranking


def _status(text: str) -> AbstractContextManager[object]:
    """Show a line on the terminal while work goes on."""
    return terminal().status(f"{text} (Ctrl-C stops)")
