"""What all browsers look at and none can change: the model, the data set, its descriptors and results."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from threading import Lock

import numpy as np

from explorer import session_state
from explorer.compute.cache import SingleFlightCache
from explorer.compute.inference_scheduler import InferenceScheduler
from explorer.compute.ranking_job import RankingJob
from explorer.compute.request_context import QueuedModel, RequestContext
from explorer.session_state import POSITIVE, SessionState
from explorer.stage.layout import layout_for
from lpn import explain, retrieval
from lpn.analysis.task import Task
from lpn.core import images
from lpn.core.arrays import Float32Array, Float64Array, Int64Array, UInt8Array
from lpn.core.errors import InputError
from lpn.core.views import View
from lpn.datasets import Picture as Picture
from lpn.datasets.city_model import CityModel
from lpn.drawing import mosaic, overlays
from lpn.explain import Correspondences, Evidence
from lpn.models.base import Model
from lpn.models.spec import ModelSpec
from lpn.retrieval import DescribedPicture, Match, Ranking, scoring

TILES = 48
"""Described tiles that are kept: with their feature maps, a large network's are 4 MB each."""
CARDS = 256
"""Small pictures of tiles that are kept, 0.15 MB each."""


class Workspace:
    """A model and a data set, opened once for all browsers; see `explorer.opening`.

    Args:
        model_name, data_name: how they are called in the page.
        rankings: the ranking of each task, at least one.
        spec: how the descriptors' parts divide a picture.
        map_sizes: (h, w) of the feature map that is divided, for each view.
        model: None where descriptors were saved by another program: then queries are seen as they were saved only. Otherwise
            all of its passes go through one queue; `inference.RequestContext` gives each browser its own way in.
        city: the 3-D model for the map.
        root: the data set's folder.
    """

    def __init__(
        self,
        model_name: str,
        data_name: str,
        rankings: list[RankingJob],
        spec: ModelSpec,
        map_sizes: dict[View, tuple[int, int]],
        model: Model | None,
        city: CityModel | None,
        root: Path,
    ) -> None:
        self.root = root
        self.model_name, self.data_name = model_name, data_name
        self.rankings = {ranking.task.name: ranking for ranking in rankings}
        self.tasks = {name: ranking.task for name, ranking in self.rankings.items()}
        self.spec, self.map_sizes, self.city = spec, map_sizes, city
        self.inference = InferenceScheduler()
        own = None if model is None else QueuedModel(model, self.inference, RequestContext(self.inference))
        self.model: QueuedModel | None = own
        self.description = f"saved descriptors, n = {spec.n_parts}, no network" if model is None else model.describe()
        self.first = 0
        self.beside: Workspace | None = None
        """Another model on the same data, to compare with."""
        self.part_names = self._part_names()
        self._tiles: SingleFlightCache[tuple[str, int], DescribedPicture] = SingleFlightCache(TILES)
        self._thumbnail = lru_cache(maxsize=4096)(self._make_thumbnail)
        self._card = lru_cache(maxsize=CARDS)(self._make_card)
        self.masks = lru_cache(maxsize=8)(self._make_masks)
        self._mosaics: dict[str, UInt8Array] = {}
        self._mosaic_lock = Lock()
        self.layout = layout_for(self.spec.input_size)
        self.entry_picture = lru_cache(maxsize=64)(images.load_picture)

    def open_with(self, query: str | None) -> None:
        """Choose the query of the first task that a browser shows first, by its name; InputError when there is none."""
        names = next(iter(self.tasks.values())).query_names
        if query is not None and query not in names:
            raise InputError(f"{self.data_name} has no query {query}; its names are such as {names[0]}.")
        self.first = 0 if query is None else names.index(query)

    def possible(self, state: SessionState) -> SessionState:
        """The state without what needs a network, where there is none: turning, heatmaps, and pictures of one's own."""
        return (
            state
            if self.model is not None
            else replace(session_state.upright(state), heat=False, upload=None, why=False)
        )

    def tile(self, task: Task, index: int, model: QueuedModel | None = None) -> DescribedPicture:
        """A gallery picture as the network sees it; kept, because many queries share their tiles.

        Args:
            model: what is asked where it is not kept; by default the workspace's.
        """
        return self._tiles.get((task.name, index), lambda: self._describe_tile(task, index, model or self.model))

    def thumbnail(self, path: Path) -> str:
        """A 64-pixel JPEG of a picture file as an html address."""
        return self._thumbnail(path)

    def cut(self, picture: UInt8Array, view: View) -> UInt8Array:
        """A picture as its parts are cut from it: unrolled where the network sees it so (SAFA), else as it is."""
        return picture if self.model is None else self.model.as_partitioned(picture, view)

    def card(self, task: Task, index: int) -> UInt8Array:
        """A gallery picture as small as a card shows it, its parts not drawn; not to be changed."""
        return self._card(task.name, index)

    def _make_masks(self, view: View) -> Int64Array:
        """The part of each pixel of a large picture."""
        return overlays.part_masks(self.spec.partition(view), self.map_sizes[view], self.layout.pixels)

    def mosaic(self, task: Task) -> UInt8Array:
        """The task's tiles at their places as one picture, made once for all browsers; the task must have places."""
        assert task.geometry is not None
        with self._mosaic_lock:
            if task.name not in self._mosaics:
                self._mosaics[task.name] = mosaic.draw(task.geometry, [entry.path for entry in task.gallery])
            return self._mosaics[task.name]

    def _part_names(self) -> list[str]:
        """Each part's name, with that of the other views after it where they cut differently (CVUSA)."""
        names = [self.spec.partition(view).names() for view in self.spec.views]
        return [" / ".join(dict.fromkeys(of_part)) for of_part in zip(*names, strict=True)]

    def _describe_tile(self, task: Task, index: int, model: QueuedModel | None) -> DescribedPicture:
        picture = images.load_picture(task.gallery[index].path)
        if model is None:
            return DescribedPicture(picture, task.gallery_descriptors[index], None, None)
        return retrieval.describe_picture(model, picture, task.gallery_view)

    def _make_card(self, name: str, index: int) -> UInt8Array:
        task = self.tasks[name]
        picture = self.entry_picture(task.gallery[index].path)
        return images.resize(self.cut(picture, task.gallery_view), *self.layout.card_pixels)

    def _make_thumbnail(self, path: Path) -> str:
        return overlays.data_uri(overlays.square(images.load_picture(path), 64))


@dataclass(frozen=True, eq=False)
class PairEvidence:
    """Why the compared pair has its score: exact evidence, and which cells agree.

    Attributes:
        evidence: cell by cell, under the state's part weights.
        correspondences: of the query's cells and of the tile's; None where the window that shows them is closed.
    """

    evidence: Evidence
    correspondences: tuple[Correspondences, Correspondences] | None


@dataclass(frozen=True, eq=False)
class StateAnalysis:
    """Everything the views draw for one state."""

    state: SessionState
    task: Task
    name: str
    query: DescribedPicture
    ranking: Ranking
    matches: list[Match]
    chosen: Match
    tile: DescribedPicture
    truth: Match | None
    errors_m: Float64Array | None
    """Metres from what the query shows to each tile, (G,); None where that is not known."""
    source: UInt8Array
    """The query's picture before it is turned, shifted, or zoomed."""
    pair_evidence: PairEvidence | None
    """Of the compared pair; None where nobody looks at them, or no network is at hand."""
    seconds: float


class StateAnalyser:
    """Answers one browser's states, keeping what the next state can use again.

    Args:
        model: the browser's own way to the workspace's model, by default the workspace's.
    """

    def __init__(self, workspace: Workspace, model: QueuedModel | None = None) -> None:
        self._workspace, self._model = workspace, model or workspace.model
        self._asked = (
            None if self._model is None else self._model.cancellable()
        )  # unlike tiles, which others wait for, too
        self._picture_key: object = None
        self._picture: UInt8Array
        self._query_key: object = None
        self._query: DescribedPicture
        self._searched_key: object = None
        self._lengths: Float32Array | None = None
        self._cosines: Float32Array
        self._ranking: Ranking | None = None
        self._ranking_key: object = None

    def analyse(self, state: SessionState, k: int) -> StateAnalysis:
        """Describe, compare, and rank; only what changed since the last state is computed.

        Raises:
            BusyError: when the network has too much to do; the same state can be asked for again.
            SupersededError: when the state changed, see `RequestContext.compute_newest`.
            LPNError: when it cannot be answered.
        """
        started = time.perf_counter()
        task = self._workspace.tasks[state.task]
        entry = task.queries[state.query]
        source = state.upload or (entry.path, entry.box)
        if self._picture_key != source:
            self._picture = state.upload.picture if state.upload else self._shown(entry)
            self._picture_key = source
        key = (source, task.name, state.query, state.change)
        if self._query_key != key:
            self._query = self._described(task, state)
            self._query_key, self._searched_key = key, None
        weights = scoring.part_weights(state.n_parts, state.part_values())
        searched = (key, state.region, state.part_values() if state.region else None)
        if self._searched_key != searched:
            descriptor = self._searched(state, weights)
            self._cosines = scoring.part_cosines(descriptor, task.gallery_descriptors)
            self._lengths = state.n_parts * (descriptor**2).sum(axis=1) if state.region else None
            self._searched_key = searched
        ranked = (searched, state.part_values())
        if self._ranking is None or self._ranking_key != ranked:
            of = None if state.upload else state.query
            self._ranking = task.rank(of, self._cosines, weights, self._lengths)
            self._ranking_key = ranked
        ranking = self._ranking
        matches = ranking.top(k)
        truth = ranking.truth()
        chosen = matches[0]
        if state.selected == POSITIVE:
            chosen = truth or chosen
        elif state.selected is not None and ranking.holds(state.selected):
            chosen = ranking.find(state.selected)
        tile = self._workspace.tile(task, chosen.index, self._model)
        name = state.upload.name if state.upload else entry.name
        off = None if task.geometry is None or state.upload else task.geometry.errors_m(state.query)
        reasons = self._reasons(state, weights, tile)
        seconds = time.perf_counter() - started
        return StateAnalysis(
            state, task, name, self._query, ranking, matches, chosen, tile, truth, off, self._picture, reasons, seconds
        )

    def _searched(self, state: SessionState, weights: Float32Array) -> Float32Array:
        """What is searched by: the query's descriptor, or that of its painted cells alone."""
        trace = self._query.trace
        if not state.region or trace is None:
            return self._query.descriptor
        painted = np.zeros(trace.size[0] * trace.size[1], bool)
        painted[[cell for cell in state.region if cell < len(painted)]] = True
        return trace.region(painted.reshape(trace.size), weights)

    def _reasons(self, state: SessionState, weights: Float32Array, tile: DescribedPicture) -> PairEvidence | None:
        one, other = self._query.trace, tile.trace
        if one is None or other is None or not (state.why or (state.heat and state.heat_kind == "evidence")):
            return None
        correspondences = explain.counterparts(one, other, weights) if state.why else None
        return PairEvidence(explain.evidence(one, other, weights), correspondences)

    def _shown(self, entry: Picture) -> UInt8Array:
        """What is meant of a query's picture."""
        picture = self._workspace.entry_picture(entry.path)
        return images.crop(picture, entry.box, entry.name)

    def _described(self, task: Task, state: SessionState) -> DescribedPicture:
        if self._asked is None:
            return DescribedPicture(self._picture, task.query_descriptors[state.query], None, None)
        # A picture of one's own is what the task's queries are.
        change = state.change.for_picture(task.queries[state.query])
        return retrieval.describe_picture(self._asked, self._picture, task.query_view, change)
