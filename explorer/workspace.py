"""The workspace that all browsers share, with a model, a data set, and its tasks; and answers to one browser's questions."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import cast

import numpy as np

from explorer.compute.background_jobs import BackgroundJob, BackgroundJobs, ReportProgress
from explorer.compute.cache import SingleFlightCache
from explorer.compute.inference_scheduler import InferenceScheduler
from explorer.compute.own_photos import OwnPhotoJobs
from explorer.compute.ranking_job import RankingJob, TaskRanking
from explorer.compute.request_context import QueuedModel, RequestContext
from explorer.compute.scorings import Scorings
from explorer.feeds import Feeds, Side
from lpn.analysis import answer_context
from lpn.analysis.answer_context import AnswerDistances
from lpn.core import images
from lpn.core.arrays import BoolArray, UInt8Array
from lpn.core.errors import InputError, LPNError, PictureError
from lpn.core.resources import yield_cores
from lpn.core.tables import Table
from lpn.core.views import View
from lpn.datasets import Picture as Picture
from lpn.descriptors.weather import CLEAR, Weather
from lpn.drawing import mosaic, verdicts
from lpn.drawing.part_areas import PartAreas
from lpn.flight.locate.grades import doubtful_photos, is_doubtful
from lpn.flight.locate.located import LocatedFlight
from lpn.flight.maps import Map
from lpn.library.analyser import QueryAnalyser, QueryRequest, describe_tile
from lpn.library.answer import Answer
from lpn.models.base import Model
from lpn.models.contract import Contract
from lpn.retrieval import DescribedPicture
from lpn.tasks import query_outcomes
from lpn.tasks.query_outcomes import Outcomes
from lpn.tasks.task import Scoring, Task, scored_key

log = logging.getLogger(__name__)

# Number of described tiles in the cache; with the feature map of a large network, each takes 4 MB.
TILES = 48
# Bytes of the cached tiles. A model with a map for each part, such as SDPL, takes up to 42 MB a tile, so few fit.
TILE_BYTES = 400_000_000
# Maximum of described queries in the cache, and of their bytes. Each angle of a query counts as one.
QUERIES, QUERY_BYTES = 1000, 150_000_000
# Side of a thumbnail in pixels.
_THUMBNAIL = 64
# Longer side in pixels of a picture on the screen.
_SHOWN = 800
# Grey level of a picture that cannot be read.
_UNREADABLE = 60
# Up to this many queries, an explanation computes all outcomes at once.
_QUICK_OUTCOMES = 20_000


class Workspace:
    """A model and a data set, opened once for all browsers; see `explorer.opening`.

    Args:
        model_name, data_name: display names.
        rankings: the ranking of each task, at least one.
        contract: the model's contract, with the partition of each view that has one.
        map_sizes: (h, w) of the feature map of each view.
        model: None for saved descriptors, whose queries cannot be changed. All forward passes go through one queue;
            `RequestContext` gives each browser its own access.
        root: the data set's folder.
        flight: its frames are the queries; None for a data set. Registration, which may take minutes, replaces it.
        basemap: the map that windows are cut from; None without one.
        own_photos: registers the user's own photos on the map; None without a map.
        weather: the weather of all queries.
    """

    def __init__(
        self,
        model_name: str,
        data_name: str,
        rankings: list[RankingJob],
        contract: Contract,
        map_sizes: dict[View, tuple[int, int]],
        model: Model | None,
        root: Path,
        flight: LocatedFlight | None = None,
        basemap: Map | None = None,
        own_photos: OwnPhotoJobs | None = None,
        weather: Weather = CLEAR,
    ) -> None:
        self.root, self.weather = root, weather
        self.flight, self.basemap, self.own_photos = flight, basemap, own_photos
        self.model_name, self.data_name = model_name, data_name
        # Rankings by the keys of their tasks; calibration adds the rankings under the further scorings.
        self.rankings = {ranking.task.key: ranking for ranking in rankings}
        self.tasks = {ranking.task.name: ranking.task for ranking in rankings}
        # Scorings of a new page, the preferred first; a task takes the first that it has, without regard to its figures.
        self.opens_with: tuple[Scoring, ...] = ()
        self.scorings: Scorings = Scorings(
            "Saved descriptors and indexes cannot be calibrated, because that takes pictures."
        )
        self.contract, self.map_sizes = contract, map_sizes
        self.inference = InferenceScheduler()
        own = None if model is None else QueuedModel(model, self.inference, RequestContext(self.inference))
        self.model: QueuedModel | None = own
        self.description = (
            f"saved descriptors, n = {contract.n_parts}, no network" if model is None else model.describe()
        )
        self.first_query = 0
        # Other models on the same data.
        self.beside: list[LazyWorkspace] = []
        self._own = LazyWorkspace(model_name, lambda: self, self)
        # The labels of all workspaces of the app by their keys if there are several, and this workspace's key.
        self.choices: Mapping[str, str] = {}
        self.key = ""
        # The app's workspaces that are open, by their keys.
        self.opened: Callable[[], Mapping[str, Workspace]] = dict
        # The file that keeps stories; None for the default beside the data.
        self.stories: Path | None = None
        self.registration: BackgroundJob[None] | None = None
        names = [contract.names(view) for view in contract.views]
        # Such as "ring / strip" if a part's name differs between views (CVUSA).
        self.part_names = [" / ".join(dict.fromkeys(of_part)) for of_part in zip(*names, strict=True)]
        self._tiles: SingleFlightCache[tuple[str, bool, int], DescribedPicture] = SingleFlightCache(
            TILES, TILE_BYTES, lambda tile: 0 if tile.trace is None else tile.trace.nbytes
        )
        self._queries: SingleFlightCache[Hashable, DescribedPicture] = SingleFlightCache(
            QUERIES, QUERY_BYTES, lambda one: one.picture.nbytes + (0 if one.trace is None else one.trace.nbytes)
        )
        # Serves lists and pictures to browsers.
        self.feeds = Feeds(list(self.tasks.values()), self._picture_file)
        # A 64-pixel JPEG of a picture; plain grey for a picture that cannot be read.
        self.thumbnail_file = lru_cache(maxsize=4096)(self._make_thumbnail)
        self._outcomes = lru_cache(maxsize=8)(self._make_outcomes)
        # The ungraded photos under each ranking of the newest flights.
        self._doubtful: SingleFlightCache[tuple[LocatedFlight, TaskRanking], BoolArray] = SingleFlightCache(4)
        self._answer_distances = lru_cache(maxsize=8)(self._measure_answer_distances)
        self._fixed_areas = lru_cache(maxsize=8)(lambda view: PartAreas.of(contract, view, map_sizes[view], None))
        self._mosaics: dict[str, UInt8Array] = {}
        self._mosaic_lock = Lock()
        self.load_picture = lru_cache(maxsize=64)(Picture.load)

    @property
    def models(self) -> list[LazyWorkspace]:
        """All models on the data, from which a state selects one by its number: this workspace's, and those beside it."""
        return [self._own, *self.beside]

    def choose_first_query(self, query: str | None) -> None:
        """Choose by name the query that a new browser shows first.

        Args:
            query: a query of the first task; None for its first query.
        """
        names = next(iter(self.tasks.values())).query_names
        if query is not None and query not in names:
            raise InputError(f"{self.data_name} has no query {query}; names look like {names[0]}.")
        self.first_query = 0 if query is None else names.index(query)

    def tile(self, task: Task, index: int, model: Model | None = None) -> DescribedPicture:
        """Return a described gallery picture, from the cache if possible.

        Args:
            model: describes a tile that is not in the cache, see `scored_model`; by default the workspace's model.
        """
        return self._tiles.get(_tile_key(task, index), lambda: describe_tile(task, index, model or self.model))

    def described_query(self, key: Hashable, describe: Callable[[], DescribedPicture]) -> DescribedPicture:
        """Return a described query, from the cache if possible; each browser describes it by itself, as work may be cancelled."""
        known = self._queries.peek(key)
        described = describe() if known is None else known
        return self._queries.get(key, lambda: described)

    def scored_model(self, model: Model, task: Task) -> Model:
        """Return the model that describes pictures as the task does: calibrated if the task is."""
        as_opened = self.tasks[task.name].calibration is task.calibration
        return model if as_opened or task.calibration is None else task.calibration.applied(model)

    def default_scoring(self, name: str) -> Scoring:
        """Return the scoring that a task opens with: the first ready one of `opens_with`, else the opened task's scoring."""
        ready = (scoring for scoring in self.opens_with if scored_key(name, scoring) in self.rankings)
        return next(ready, self.tasks[name].scoring)

    def ranking(self, name: str, scoring: str) -> RankingJob:
        """Return the ranking of a task under a scoring, or as the task was opened if this ranking is not ready."""
        return self.rankings.get(scored_key(name, cast("Scoring", scoring)), self.rankings[self.tasks[name].key])

    def shared_task(self, task: Task, others: Iterable[Workspace]) -> Task:
        """Return a task under its scoring if all other workspaces rank it so, else as this workspace opened it."""
        alike = all(task.key in other.rankings for other in others if task.name in other.tasks)
        return task if alike else self.tasks[task.name]

    def ranked_as(self, task: Task) -> RankingJob | None:
        """Return the ranking of another workspace's task: under its scoring, else as opened; None if there is none."""
        own = self.tasks.get(task.name)
        return None if own is None else self.rankings.get(task.key, self.rankings[own.key])

    def outcomes(self, task: Task) -> tuple[Outcomes, Table] | None:
        """Return the outcomes of all queries and their table; None until they are ranked, and for large tasks.

        The truth of an ungraded query counts as unknown.
        """
        ranked = self.rankings[task.key].result is not None
        quick = len(task.queries) <= _QUICK_OUTCOMES
        known = self._outcomes(task.key) if ranked and quick else None
        if known is None or self.flight is None:
            return known
        return replace(known[0], known=self.graded(self.rankings[task.key])), known[1]

    def doubtful(self, ranking: RankingJob) -> BoolArray | None:
        """Return the photos whose grade is in doubt, see `grades.doubtful_photos`, (Q,); None without a flight or ranks."""
        flight, result = self.flight, ranking.result
        if flight is None or result is None:
            return None
        ranked = result.ranking
        return self._doubtful.get(
            (flight, result),
            lambda: doubtful_photos(flight, ranking.task, ranked.best, ranked.first),
        )

    def graded(self, ranking: RankingJob) -> BoolArray:
        """Return the graded queries, (Q,): ranked, of a known place, and of a grade that is not in doubt."""
        known, doubtful = ranking.task.known, self.doubtful(ranking)
        graded = np.full(len(ranking.task.queries), ranking.result is not None)
        if known is not None:
            graded &= known
        return graded if doubtful is None else graded & ~doubtful

    def judged(self, answer: Answer) -> Answer:
        """Return an answer without grades if its photo's grade is in doubt, see `lpn.flight.locate.grades`."""
        flight, first = self.flight, answer.matches[0]
        if flight is None or answer.index is None or first.true is None:
            return answer
        sure = answer.positive is not None and not is_doubtful(
            flight, answer.task, answer.index, first.index, first.true
        )
        return answer if sure else answer.ungraded()

    def counts(self, ranking: RankingJob) -> tuple[int, int]:
        """Return the numbers of right and of graded queries; zeros before they are ranked."""
        graded = self.graded(ranking)
        return (int((graded & ~ranking.failed).sum()) if graded.any() else 0), int(graded.sum())

    def results(self, ranking: RankingJob) -> dict[str, float] | None:
        """Return the figures of the graded queries, see `TaskRanking.measured`; None before they are ranked."""
        result = ranking.result
        return None if result is None else result.measured(self.graded(ranking))

    def answer_distances(self, task: Task) -> AnswerDistances | None:
        """Return the distances of a task's answers; None until it is ranked, without descriptors, and for large tasks."""
        ranked = self.rankings[task.key].result is not None
        quick = len(task.queries) <= _QUICK_OUTCOMES
        return self._answer_distances(task.key) if ranked and quick else None

    def register_flight(self, register: Callable[[ReportProgress], LocatedFlight]) -> BackgroundJob[None]:
        """Start the registration of the flight in the background; it replaces `flight` several times."""

        def work(report: ReportProgress) -> None:
            yield_cores()  # registration takes minutes, and answers must not wait for it
            self.flight = register(report)

        self.registration = BackgroundJob(work, self)
        return self.registration

    def _picture_file(self, task: Task, side: Side, index: int, large: bool) -> bytes:
        """Return a JPEG of a picture: as its parts are drawn, at most 800 pixels a side, or a thumbnail."""
        of_query = side == "query"
        picture = (task.queries if of_query else task.gallery)[index]
        if not large:
            return self.thumbnail_file(picture)
        # The page zooms a query itself, because it turns the query; a tile's file is zoomed already.
        whole = (
            images.crop(self.load_picture(picture), picture.box, picture.name) if of_query else picture.load_zoomed()
        )
        view = task.query_view if of_query else task.gallery_view
        return images.jpeg(images.shrink(self.as_partitioned(whole, view), _SHOWN), 85)

    def as_partitioned(self, picture: UInt8Array, view: View) -> UInt8Array:
        """Return the picture on which parts are drawn, see `Model.as_partitioned`."""
        return picture if self.model is None else self.model.as_partitioned(picture, view)

    def areas(self, view: View, described: DescribedPicture | None = None) -> PartAreas | None:
        """Return the areas of the parts: of the view's partition, else of the picture's cells; None without either."""
        fixed = self._fixed_areas(view)
        trace = None if described is None else described.trace
        return PartAreas.of(self.contract, view, self.map_sizes[view], trace) if fixed is None else fixed

    @property
    def without_cells(self) -> str:
        """One sentence with the reason for which there is neither evidence nor a heatmap; empty if there are both."""
        if self.model is None:
            return "Evidence and heatmaps need the network: open the data set with a model."
        return "" if self.contract.has_cells else verdicts.no_cells(self.contract)

    def mosaic(self, task: Task) -> UInt8Array:
        """Return one cached picture of all tiles at their positions; the task must have a geometry."""
        assert task.geometry is not None
        with self._mosaic_lock:
            if task.name not in self._mosaics:
                if self.basemap is not None:
                    west, south, east, north = task.geometry.bounds()
                    origin = task.geometry.origin
                    x, y = self.basemap.frame.xy([origin.latitude], [origin.longitude])[0].tolist()
                    drawn, _ = self.basemap.picture((x + west, y + south, x + east, y + north), mosaic.LARGEST)
                else:
                    drawn = mosaic.draw(task.geometry, task.gallery)
                self._mosaics[task.name] = drawn
            return self._mosaics[task.name]

    def _make_outcomes(self, name: str) -> tuple[Outcomes, Table] | None:
        job = self.rankings[name]
        assert job.result is not None
        task = job.task
        try:
            outcomes = query_outcomes.outcomes_of(task, job.result.ranking)
            return outcomes, query_outcomes.table(task, outcomes, self.part_names)
        except LPNError:  # damaged metadata, which the failure laboratory reports
            return None

    def _measure_answer_distances(self, name: str) -> AnswerDistances:
        job = self.rankings[name]
        assert job.result is not None
        return answer_context.answer_distances(*job.task.sides(), job.result.ranking, job.task.known)

    def _make_thumbnail(self, picture: Picture) -> bytes:
        try:
            square = images.resize(picture.load(), _THUMBNAIL, _THUMBNAIL)
        except PictureError:  # a flight may have unreadable frames
            square = np.full((_THUMBNAIL, _THUMBNAIL, 3), _UNREADABLE, np.uint8)
        return images.jpeg(square, 80)


def _tile_key(task: Task, index: int) -> tuple[str, bool, int]:
    return task.name, task.calibration is not None, index


class LazyWorkspace:
    """A further workspace, opened once for all browsers: at the start, or when a browser asks for it.

    Args:
        label: display name, such as "the baseline (n = 1)".
        open_workspace: opens it; it may describe all pictures, whose progress is shown.
        opened: the workspace if it is open already.
    """

    def __init__(self, label: str, open_workspace: Callable[[], Workspace], opened: Workspace | None = None) -> None:
        self.label, self._opened = label, opened
        self._open, self._jobs = open_workspace, BackgroundJobs()
        self._job: BackgroundJob[Workspace] | None = None
        self._lock = Lock()

    @property
    def workspace(self) -> Workspace | None:
        """The workspace; None until it is open."""
        return self._job.value if self._opened is None and self._job is not None else self._opened

    @property
    def error(self) -> str:
        """One sentence with the reason of a failed opening, else empty."""
        return "" if self._job is None else self._job.error or ""

    @property
    def progress(self) -> tuple[int, int]:
        """The numbers of described and of all pictures during the opening; (0, 0) until they are known."""
        return (0, 0) if self._job is None else (self._job.done, self._job.total)

    @property
    def asked(self) -> bool:
        """True once its opening has begun."""
        return self._opened is not None or self._job is not None

    def opening(self) -> BackgroundJob[Workspace] | None:
        """Return the job that opens it, see `open`; None if it is open."""
        return self.open() if self.workspace is None else None

    def open(self) -> BackgroundJob[Workspace]:
        """Open it in the background, unless it is open or being opened; after a failure, try again."""
        with self._lock:
            self._job = self._jobs.join("open", self, lambda _: self._open())
            return self._job


@dataclass(frozen=True)
class Workspaces:
    """The first workspace of a page, not opened yet, and further workspaces by their keys in addresses.

    Attributes:
        label: display name of the first workspace.
    """

    open_workspace: Callable[[], Workspace]
    others: Mapping[str, LazyWorkspace] = field(default_factory=dict)
    label: str = ""


class WorkspaceAnalyser:
    """Answers one browser's questions, see `QueryAnalyser`.

    Args:
        model: the browser's queued model; by default the workspace's.
        cancellable: a newer question may supersede the query's forward pass, but not a tile's, which other browsers share.
    """

    def __init__(self, workspace: Workspace, model: QueuedModel | None = None, cancellable: bool = True) -> None:
        self._workspace = workspace
        model = model or workspace.model
        self._tile_model = model
        self._model = model.cancellable() if model is not None and cancellable else model
        self._analysers: dict[bool, QueryAnalyser] = {}

    def analyse(self, task: Task, request: QueryRequest, k: int) -> Answer:
        """Answer a question about a task of the workspace, with the k nearest tiles.

        Raises:
            BusyError: when the inference queue is full; the caller may retry.
            SupersededError: when a newer question superseded this one, see `RequestContext.answering`.
            LPNError: when the query cannot be analysed.
        """
        if self._workspace.weather:
            request = replace(request, change=replace(request.change, weather=self._workspace.weather))
        return self._workspace.judged(self._analyser_of(task).analyse(task, request, k))

    def _analyser_of(self, task: Task) -> QueryAnalyser:
        """Return the analyser whose model describes pictures as the task does."""
        calibrated = task.calibration is not None
        if calibrated not in self._analysers:
            workspace = self._workspace
            query_model, tile_model = (
                None if model is None else workspace.scored_model(model, task)
                for model in (self._model, self._tile_model)
            )
            self._analysers[calibrated] = QueryAnalyser(
                query_model,
                lambda task, index: workspace.tile(task, index, tile_model),
                workspace.load_picture,
                workspace.described_query,
            )
        return self._analysers[calibrated]
