"""What all browsers look at and none can change: the model, the data set, its descriptors and results."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import cast

import numpy as np
import numpy.typing as npt

import lpn
from explorer import chart, overlays
from explorer.chart import Places
from explorer.session import TRUTH, State
from lpn import explain, features, geo, images, metrics, retrieval
from lpn.city import CityModel, city_model
from lpn.datasets import Picture as Entry
from lpn.datasets import open_dataset
from lpn.errors import DataError, InputError
from lpn.evaluate import error_shares
from lpn.files import printable
from lpn.images import Picture
from lpn.model import FloatArray, Model
from lpn.retrieval import Described, Match, Ranking
from lpn.spec import View

log = logging.getLogger(__name__)

STORES = "descriptors"
"""Folder of a data set in which stores of its test split may come along: `query_drone`, `gallery_satellite`, ..."""
DISPLAY = 384
"""Side in pixels of the large pictures."""


@dataclass(frozen=True, eq=False)
class Task:
    """One direction of retrieval with everything precomputed.

    Attributes:
        name: such as "drone-to-satellite".
        queries, gallery: the pictures.
        labels: the place each gallery picture shows, (G,).
        descriptors: of the gallery, (G, n, D).
        ranks: 0-based rank of the first true match of each query, -1 when it has none, (Q,).
        results: recall and AP in percent, see `lpn.metrics.evaluate`; with positions, `median error m` and more.
        places: where the pictures are, None where the data set has no `geo.csv`.
    """

    name: str
    query_view: View
    gallery_view: View
    queries: list[Entry]
    gallery: list[Entry]
    labels: npt.NDArray[np.int64]
    descriptors: FloatArray
    ranks: npt.NDArray[np.int64]
    results: dict[str, float]
    places: Places | None


class Exhibit:
    """A model and a data set, opened once for all browsers.

    Args:
        query: name of the query of the first task that a browser shows first; without it, that task's first.

    Raises:
        LPNError: when model or data set cannot be used, or there is no such query.
    """

    def __init__(self, data: Path, model: Path, query: str | None = None) -> None:
        self.model: Model = lpn.load(model)
        self.model_name, self.data_name = printable(model.name), printable(data.resolve().name)
        dataset = open_dataset(data)
        pairs = [cast("tuple[View, View]", tuple(name.split("-to-"))) for name in dataset.tasks()]
        known = [pair for pair in pairs if set(pair) <= set(self.model.views)]
        if not known:
            raise DataError(
                f"The test split of {self.data_name} offers {', '.join(dataset.tasks()) or 'no task'}, but the model knows "
                f"only the views {', '.join(self.model.views)}; give a data set or a model that fit each other."
            )
        where = geo.positions(data)
        self.tasks = {
            task.name: task
            for task in (self._open(data, where, dataset.queries(q), dataset.gallery(g), q, g) for q, g in known)
        }
        self.first = 0 if query is None else self._position(query)
        self.city = None if where is None else _city(data)
        self.part_names = self._part_names()
        self.map_sizes = {view: self.model.map_size(view) for view in self.model.views}
        self._tile = lru_cache(maxsize=256)(self._describe_tile)
        self._thumbnail = lru_cache(maxsize=4096)(self._make_thumbnail)
        self._mosaics: dict[str, Picture] = {}
        self._mosaic_lock = Lock()
        self.entry_picture = lru_cache(maxsize=64)(images.load_picture)

    def _position(self, query: str) -> int:
        names = [entry.name for entry in next(iter(self.tasks.values())).queries]
        if query not in names:
            raise InputError(f"{self.data_name} has no query {query}; its names are such as {names[0]}.")
        return names.index(query)

    def tile(self, task: Task, index: int) -> Described:
        """A gallery picture as the network sees it; kept, because many queries share their tiles."""
        return self._tile(task.gallery[index].path, task.gallery_view)

    def thumbnail(self, path: Path) -> str:
        """A 64-pixel JPEG of a picture file as an html address."""
        return self._thumbnail(path)

    def masks(self, view: View, size: int = DISPLAY) -> npt.NDArray[np.int64]:
        """The part of each pixel of a size x size picture."""
        return overlays.part_masks(self.model.spec.partition(view), self.map_sizes[view], size)

    def _open(
        self,
        data: Path,
        where: geo.Positions | None,
        queries: list[Entry],
        gallery: list[Entry],
        query_view: View,
        gallery_view: View,
    ) -> Task:
        query = self._described(data / STORES / f"query_{query_view}", queries, query_view)
        tiles = self._described(data / STORES / f"gallery_{gallery_view}", gallery, gallery_view)
        laid = None if where is None else chart.places(where.of(queries), where.of(gallery))
        query_labels, labels = (np.array([entry.label for entry in entries]) for entries in (queries, gallery))
        near: dict[str, float] = {}
        if laid is not None:
            best = metrics.best(query, tiles, labels)
            near = error_shares(geo.metres(laid.queries, [laid.tiles[index] for index in best]))
        return Task(
            f"{query_view}-to-{gallery_view}",
            query_view,
            gallery_view,
            queries,
            gallery,
            labels,
            tiles,
            metrics.ranks(query, query_labels, tiles, labels),
            metrics.evaluate(query, query_labels, tiles, labels) | near,
            laid,
        )

    def mosaic(self, task: Task) -> Picture:
        """The task's tiles at their places as one picture, made once for all browsers; the task must have places."""
        assert task.places is not None
        with self._mosaic_lock:
            if task.name not in self._mosaics:
                self._mosaics[task.name] = chart.mosaic(task.places, [entry.path for entry in task.gallery])
            return self._mosaics[task.name]

    def _described(self, shipped: Path, pictures: list[Entry], view: View) -> FloatArray:
        """From the store that came with the data set, else from the user's cache."""
        found = features.shipped_descriptors(self.model, pictures, view, shipped)
        return features.cached_descriptors(self.model, pictures, view) if found is None else found

    def _part_names(self) -> list[str]:
        """Each part's name, with that of the other views after it where they cut differently (CVUSA)."""
        names = [self.model.spec.partition(view).names() for view in self.model.views]
        return [" / ".join(dict.fromkeys(of_part)) for of_part in zip(*names, strict=True)]

    def _describe_tile(self, path: Path, view: View) -> Described:
        return retrieval.describe_picture(self.model, images.load_picture(path), view)

    def _make_thumbnail(self, path: Path) -> str:
        return overlays.data_uri(overlays.square(images.load_picture(path), 64))


def _city(data: Path) -> CityModel | None:
    """The data set's 3-D model; one that cannot be used is no reason not to start."""
    try:
        return city_model(data)
    except DataError as error:
        log.warning("The map has no city: %s", error)
        return None


@dataclass(frozen=True, eq=False)
class Answer:
    """Everything the views draw for one state."""

    state: State
    task: Task
    name: str
    query: Described
    ranking: Ranking
    matches: list[Match]
    chosen: Match
    tile: Described
    truth: Match | None
    off: geo.FloatArray | None
    """Metres from what the query shows to each tile, (G,); None where that is not known."""
    seconds: float


class Analyst:
    """Answers one browser's states, keeping what the next state can use again."""

    def __init__(self, exhibit: Exhibit) -> None:
        self._exhibit = exhibit
        self._picture_key: object = None
        self._picture: Picture
        self._query_key: object = None
        self._query: Described
        self._cosines: FloatArray

    def answer(self, state: State, k: int) -> Answer:
        """Describe, compare, and rank; only what changed since the last state is computed."""
        started = time.perf_counter()
        task = self._exhibit.tasks[state.task]
        entry = task.queries[state.query]
        source = state.upload or entry.path
        if self._picture_key != source:
            self._picture = state.upload.picture if state.upload else self._exhibit.entry_picture(entry.path)
            self._picture_key = source
        if self._query_key != (source, task.name, state.angle):
            self._query = retrieval.describe_picture(self._exhibit.model, self._picture, task.query_view, state.angle)
            self._cosines = explain.part_cosines(self._query.descriptor, task.descriptors)
            self._query_key = (source, task.name, state.angle)
        weights = explain.part_weights(state.n_parts, state.part_values())
        ranking = retrieval.rank(self._cosines, weights, task.labels, None if state.upload else entry.label)
        matches = ranking.top(k)
        truth = ranking.truth()
        chosen = matches[0]
        if state.selected == TRUTH:
            chosen = truth or chosen
        elif state.selected is not None:
            chosen = ranking.find(state.selected)
        tile = self._exhibit.tile(task, chosen.index)
        name = state.upload.name if state.upload else entry.name
        off = None if task.places is None or state.upload else task.places.off(state.query)
        seconds = time.perf_counter() - started
        return Answer(state, task, name, self._query, ranking, matches, chosen, tile, truth, off, seconds)
