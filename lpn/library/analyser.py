"""Answer one query: describe it, rank the gallery, and describe the compared tile."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from functools import lru_cache, partial
from typing import Literal

import numpy as np

from lpn import retrieval
from lpn.core import images
from lpn.core.arrays import Float32Array, Float64Array, UInt8Array
from lpn.core.errors import InputError
from lpn.core.views import View
from lpn.datasets import Picture
from lpn.datasets.geo import Position
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.library.answer import Answer, pair_evidence
from lpn.models.base import Model
from lpn.retrieval import DescribedPicture, Match, Ranking, scoring
from lpn.retrieval.calibration import Calibration
from lpn.tasks.task import RankUnderWeights, Task


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


@dataclass(frozen=True)
class _Photo:
    """A query to describe: its pixels before the change, and the change. Photos of one key are equal.

    Attributes:
        described: its description if it was computed ahead.
    """

    key: Hashable
    task: Task = field(compare=False)
    own: OwnPicture | None = field(compare=False)
    index: int | None = field(compare=False)
    name: str = field(compare=False)
    source: UInt8Array = field(compare=False)
    change: Change = field(compare=False)
    described: DescribedPicture | None = field(default=None, compare=False)


# A cache of described pictures: takes a key, and a function that describes the picture if the cache lacks it.
KeepDescribed = Callable[[Hashable, Callable[[], DescribedPicture]], DescribedPicture]


def described_key(task: Task, query: int, change: Change) -> Hashable:
    """Return the key of a described query of a task; `change` comes from `Change.for_picture`."""
    picture = task.queries[query]
    return picture.path, picture.box, task.key, change


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
        self._ahead: dict[QueryRequest, _Photo] = {}
        # The results of the last request.
        self._source, self._own_zoom = lru_cache(1)(self._read), lru_cache(1)(self._measure_own_zoom)
        self._described, self._search = lru_cache(1)(self._describe), lru_cache(1)(self._start_search)

    def describe_ahead(self, task: Task, requests: Sequence[QueryRequest]) -> None:
        """Describe the queries of some requests in one batch for later calls of `analyse`, with the same errors."""
        if self._model is None or not requests:
            return
        photos = [self._photo(task, request) for request in requests]
        pictures, changes = [photo.source for photo in photos], [photo.change for photo in photos]
        described = retrieval.describe_pictures(self._model.for_task(*task.views), pictures, task.query_view, changes)
        ahead = (replace(photo, described=one) for photo, one in zip(photos, described, strict=True))
        self._ahead = dict(zip(requests, ahead, strict=True))

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
        photo = self._ahead.pop(request, None) or self._photo(task, request)
        query = self._described(photo)
        weights = scoring.part_weights(task.contract.n_parts, request.weights)
        # The descriptor of a region depends on the part weights.
        ranking = self._search(photo, request.region, request.weights if request.region else None)(weights)
        matches = ranking.top(k)
        if not matches:
            raise InputError("The gallery has no tile that is not junk; a query needs at least one.")
        chosen = _chosen(ranking, request.compare)
        compared = self._describe_tile(task, chosen.index) if tile or request.evidence else None
        return Answer(
            task=task,
            name=photo.name,
            index=photo.index,
            query=query,
            ranking=ranking,
            matches=matches,
            chosen=chosen,
            describe_tile=self._describe_tile,
            tile=compared,
            positive=ranking.positive(),
            errors_m=_errors_m(task, photo),
            source=photo.source,
            zoom=photo.change.zoom,
            pair_evidence=pair_evidence(
                query, compared, weights, request.correspondences, ranking.csls_of(chosen.index)
            )
            if request.evidence and compared is not None
            else None,
            seconds=time.perf_counter() - started,
        )

    def _photo(self, task: Task, request: QueryRequest) -> _Photo:
        """Return the query of a request, and its change."""
        query = request.query
        if isinstance(query, OwnPicture):
            zoom = 1.0 if task.calibration is None else self._own_zoom(task.calibration, query, task.query_view)
            change = request.change.for_picture(task.queries[0], zoom)
            return _Photo((query, task.key, change), task, query, None, query.name, query.picture, change)
        if not 0 <= query < len(task.queries):
            raise InputError(f"There is no query {query}; queries have positions 0 to {len(task.queries) - 1}.")
        picture = task.queries[query]
        change = request.change.for_picture(picture)
        key = picture, query, task.key, change
        return _Photo(key, task, None, query, picture.name, self._source(picture), change)

    def _read(self, picture: Picture) -> UInt8Array:
        return images.crop(self._load(picture), picture.box, picture.name)

    def _measure_own_zoom(self, calibration: Calibration, own: OwnPicture, view: View) -> float:
        return 1.0 if self._model is None else calibration.own_zoom(self._model, own.picture, view)

    def _describe(self, photo: _Photo) -> DescribedPicture:
        """Describe a query, or take its stored descriptor without a network."""
        task, index = photo.task, photo.index
        if photo.described is not None:
            return photo.described
        if self._model is None:
            if index is None:
                raise InputError(f"{task.model_name} has no network, only descriptors; choose a query of the data set.")
            return DescribedPicture(photo.source, task.query_descriptors[index], None, None)
        model = self._model.for_task(*task.views)
        describe = partial(retrieval.describe_picture, model, photo.source, task.query_view, photo.change)
        return describe() if index is None else self._keep(described_key(task, index, photo.change), describe)

    def _start_search(
        self, photo: _Photo, region: tuple[int, ...], weights: tuple[float, ...] | None
    ) -> RankUnderWeights:
        task = photo.task
        part_weights = scoring.part_weights(task.contract.n_parts, weights)
        return start_search(task, photo.index, self._described(photo), region, part_weights)


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
