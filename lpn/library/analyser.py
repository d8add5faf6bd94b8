"""Answer one query: describe it, rank the gallery, and describe the compared tile."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from datetime import date
from functools import partial
from typing import Generic, Literal, TypeVar

import numpy as np

from lpn import retrieval
from lpn.core import images
from lpn.core.arrays import Float32Array, Float64Array, UInt8Array
from lpn.core.errors import InputError
from lpn.datasets import Picture
from lpn.datasets.geo import Position
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.library.answer import Answer, pair_evidence
from lpn.models.base import Model
from lpn.retrieval import DescribedPicture, Match, Ranking, scoring
from lpn.tasks.task import RankUnderWeights, Task

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class OwnPicture:
    """A user's picture, outside the data set and of unknown place.

    Attributes:
        picture: (H, W, 3) uint8.
        place: latitude and longitude of the camera in degrees; None if the file has none.
        key: its name in addresses of the page; empty without a page.
        day: the day of the picture; None if its file lacks it.
        facts: names and values from its file, for display.
    """

    name: str
    picture: UInt8Array
    place: tuple[float, float] | None = None
    key: str = ""
    day: date | None = None
    facts: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, eq=False)
class QueryRequest:
    """The query to analyse, and the options.

    Attributes:
        query: position among the task's queries, or a user's picture.
        change: applied to the query before it is described.
        weights: part weights, see `scoring.part_weights`; None for equal ones.
        region: cells of the query's feature map, row by row, that restrict the search; empty for all.
        compare: the tile to compare with: a gallery position, "positive", or None for the top match, which also replaces an
            unranked tile.
        evidence, correspondences: whether to compute them for the compared pair.
    """

    query: int | OwnPicture
    change: Change = UNCHANGED
    weights: tuple[float, ...] | None = None
    region: tuple[int, ...] = ()
    compare: int | Literal["positive"] | None = None
    evidence: bool = False
    correspondences: bool = False


@dataclass(frozen=True, eq=False)
class _Photo:
    """A query to describe: its pixels before the change, the change, its zoom, and the key of the changed picture."""

    own: OwnPicture | None
    index: int | None
    name: str
    source: UInt8Array
    change: Change
    zoom: float
    key: Hashable


# A cache of described pictures: takes a key, and a function that describes the picture if the cache lacks it.
KeepDescribed = Callable[[Hashable, Callable[[], DescribedPicture]], DescribedPicture]


def described_key(task: Task, query: int, change: Change) -> Hashable:
    """Return the key of a described query of a task; `change` comes from `Change.for_picture`."""
    picture = task.queries[query]
    return picture.path, picture.box, task.key, change


class _LastValue(Generic[T]):
    """A cache of one value, for the last key."""

    def __init__(self) -> None:
        self._entry: tuple[Hashable, T] | None = None

    def get(self, key: Hashable, compute: Callable[[], T]) -> T:
        if self._entry is None or self._entry[0] != key:
            self._entry = key, compute()
        return self._entry[1]


class QueryAnalyser:
    """Analyses queries, and reuses intermediate results of the last request; for one thread at a time.

    Args:
        model: describes queries, by `Model.for_task` of their task; None if only stored descriptors are available.
        describe_tile: describes a tile of a task by its gallery position, see the function `describe_tile`; may use a cache.
        load: reads a picture without its box; may use a cache.
        keep: a cache of described queries: takes a `described_key`, and a function that describes a query that is missing.
    """

    def __init__(
        self,
        model: Model | None,
        describe_tile: Callable[[Task, int], DescribedPicture],
        load: Callable[[Picture], UInt8Array] = Picture.load,
        keep: KeepDescribed = lambda _, describe: describe(),
    ) -> None:
        self._model, self._describe_tile, self._load, self._keep = model, describe_tile, load, keep
        self._source: _LastValue[UInt8Array] = _LastValue()
        self._query: _LastValue[DescribedPicture] = _LastValue()
        self._ahead: dict[QueryRequest, tuple[_Photo, DescribedPicture]] = {}
        self._zoom: _LastValue[float] = _LastValue()
        self._search: _LastValue[RankUnderWeights] = _LastValue()

    def describe_ahead(self, task: Task, requests: Sequence[QueryRequest]) -> None:
        """Describe the queries of some requests in one batch for later calls of `analyse`, with the same errors."""
        if self._model is None or not requests:
            return
        photos = [self._photo(task, request) for request in requests]
        pictures, changes = [photo.source for photo in photos], [photo.change for photo in photos]
        described = retrieval.describe_pictures(self._model.for_task(*task.views), pictures, task.query_view, changes)
        self._ahead = dict(zip(requests, zip(photos, described, strict=True), strict=True))

    def analyse(self, task: Task, request: QueryRequest, k: int, tile: bool = True) -> Answer:
        """Answer one request.

        Args:
            k: number of matches.
            tile: whether to describe the compared tile at once; evidence needs it.

        Raises:
            InputError: when there is no such query, or no tile to rank.
            LPNError: when a picture cannot be read or described.
        """
        started = time.perf_counter()
        ahead = self._ahead.pop(request, None)
        photo = self._photo(task, request) if ahead is None else ahead[0]
        index = photo.index
        query = self._query.get(photo.key, lambda: self._described(task, photo) if ahead is None else ahead[1])
        weights = scoring.part_weights(task.contract.n_parts, request.weights)
        # The descriptor of a region depends on the part weights.
        search_key = photo.key, request.region, request.weights if request.region else None
        search = self._search.get(search_key, lambda: start_search(task, index, query, request.region, weights))
        ranking = search(weights)
        matches = ranking.top(k)
        if not matches:
            raise InputError("The gallery has no tile that is not junk; a query needs at least one.")
        chosen = _chosen(ranking, request.compare)
        compared = self._describe_tile(task, chosen.index) if tile or request.evidence else None
        return Answer(
            task=task,
            name=photo.name,
            index=index,
            query=query,
            ranking=ranking,
            matches=matches,
            chosen=chosen,
            describe_tile=self._describe_tile,
            tile=compared,
            positive=ranking.positive(),
            errors_m=_errors_m(task, photo),
            source=photo.source,
            zoom=photo.zoom,
            pair_evidence=pair_evidence(
                query, compared, weights, request.correspondences, ranking.csls_of(chosen.index)
            )
            if request.evidence and compared is not None
            else None,
            seconds=time.perf_counter() - started,
        )

    def _described(self, task: Task, photo: _Photo) -> DescribedPicture:
        """Describe a query, or take its stored descriptor without a network."""
        index = photo.index
        if self._model is None:
            if index is None:
                raise InputError(f"{task.model_name} has no network, only descriptors; choose a query of the data set.")
            return DescribedPicture(photo.source, task.query_descriptors[index], None, None)
        model = self._model.for_task(*task.views)
        describe = partial(retrieval.describe_picture, model, photo.source, task.query_view, photo.change)
        return describe() if index is None else self._keep(described_key(task, index, photo.change), describe)

    def _photo(self, task: Task, request: QueryRequest) -> _Photo:
        """Return the query of a request, and its change."""
        query = request.query
        own, index = (query, None) if isinstance(query, OwnPicture) else (None, query)
        if index is not None and not 0 <= index < len(task.queries):
            raise InputError(f"There is no query {index}; queries have positions 0 to {len(task.queries) - 1}.")
        picture = task.queries[index or 0]
        key = own or (picture.path, picture.box)
        source = self._source.get(
            key, lambda: own.picture if own else images.crop(self._load(picture), picture.box, picture.name)
        )
        zoom = picture.zoom if own is None else self._zoom.get((own, task.key), lambda: self._own_zoom(task, own))
        change = request.change.for_picture(picture, zoom)
        return _Photo(
            own, index, own.name if own else picture.name, source, change, zoom, (key, task.key, index, request.change)
        )

    def _own_zoom(self, task: Task, own: OwnPicture) -> float:
        """Return the zoom that the task's calibration chooses for the user's own picture; 1 without a calibration."""
        if self._model is None or task.calibration is None:
            return 1.0
        return task.calibration.own_zoom(self._model, own.picture, task.query_view)


def _errors_m(task: Task, photo: _Photo) -> Float64Array | None:
    """Return metres from a query's place, or from the camera of a user's picture, to each tile, (G,)."""
    if task.geometry is not None and photo.index is not None:
        return task.geometry.errors_m(photo.index)
    place = None if photo.own is None else photo.own.place
    return None if task.geometry is None or place is None else task.geometry.metres_from(Position(*place))


def describe_tile(task: Task, index: int, model: Model | None) -> DescribedPicture:
    """Describe a gallery picture; without a model or the picture, take its stored descriptor."""
    picture = task.gallery[index].load_zoomed()
    if model is None or task.gallery[index].missing:
        return DescribedPicture(picture, task.gallery_descriptors[index], None, None)
    return retrieval.describe_picture(model.for_task(*task.views), picture, task.gallery_view)


def start_search(
    task: Task, index: int | None, query: DescribedPicture, region: tuple[int, ...], weights: Float32Array
) -> RankUnderWeights:
    """Compare a query, or a region of it, with the gallery.

    Args:
        index: the query's position; None for a picture outside the task.
        region: cells of the query's feature map, row by row; empty for all.
        weights: part weights with sum one, (n,); the descriptor of a region depends on them.
    """
    if not region or query.trace is None:
        return task.start_search(index, query.descriptor)
    size = query.trace.size
    inside = np.isin(np.arange(size[0] * size[1]), region)
    descriptor = query.trace.region(inside.reshape(size), weights)
    lengths = len(descriptor) * (descriptor**2).sum(axis=1)
    return task.start_search(index, descriptor, lengths)


def _chosen(ranking: Ranking, compare: int | Literal["positive"] | None) -> Match:
    if compare == "positive":
        return ranking.positive() or ranking.match(0)
    return ranking.find(compare) if compare is not None and ranking.holds(compare) else ranking.match(0)
