"""The workspace that all browsers share: a model, a data set, and its tasks; and the analysis of one browser's states."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from threading import Lock

from explorer import session_state
from explorer.compute.cache import SingleFlightCache
from explorer.compute.inference_scheduler import InferenceScheduler
from explorer.compute.ranking_job import RankingJob
from explorer.compute.request_context import QueuedModel, RequestContext
from explorer.layout import layout_for
from explorer.session_state import POSITIVE, SessionState
from lpn.analysis.analyser import Analysis, QueryAnalyser, QueryRequest, describe_tile
from lpn.analysis.task import Task
from lpn.core import images
from lpn.core.arrays import Int64Array, UInt8Array
from lpn.core.errors import InputError
from lpn.core.views import View
from lpn.datasets import Picture as Picture
from lpn.datasets.city_model import CityModel
from lpn.drawing import mosaic, overlays
from lpn.models.base import Model
from lpn.models.spec import ModelSpec
from lpn.retrieval import DescribedPicture

# Cached described tiles; with their feature maps, those of a large network take 4 MB each.
TILES = 48
# Cached cards, 0.15 MB each.
CARDS = 256


class Workspace:
    """A model and a data set, opened once for all browsers; see `explorer.opening`.

    Args:
        model_name, data_name: names for people.
        rankings: the ranking of each task, at least one.
        spec: how parts divide a picture.
        map_sizes: (h, w) of the feature map of each view.
        model: None where another program computed the descriptors, so that queries cannot be changed. Otherwise all of its
            forward passes go through one queue; `RequestContext` gives each browser its own access.
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
        # Another model on the same data, to compare with.
        self.beside: Workspace | None = None
        self.part_names = self._part_names()
        self._tiles: SingleFlightCache[tuple[str, int], DescribedPicture] = SingleFlightCache(TILES)
        self._thumbnail = lru_cache(maxsize=4096)(self._make_thumbnail)
        self._card = lru_cache(maxsize=CARDS)(self._make_card)
        self.masks = lru_cache(maxsize=8)(self._make_masks)
        self._mosaics: dict[str, UInt8Array] = {}
        self._mosaic_lock = Lock()
        self.layout = layout_for(self.spec.input_size)
        self.load_picture = lru_cache(maxsize=64)(images.load_picture)

    def open_with(self, query: str | None) -> None:
        """Choose by name the query of the first task that a browser shows first; InputError when there is none."""
        names = next(iter(self.tasks.values())).query_names
        if query is not None and query not in names:
            raise InputError(f"{self.data_name} has no query {query}; its names are such as {names[0]}.")
        self.first = 0 if query is None else names.index(query)

    def possible(self, state: SessionState) -> SessionState:
        """The state; without a network, upright and without heatmaps, evidence, and pictures of one's own."""
        return (
            state
            if self.model is not None
            else replace(session_state.upright(state), heat=False, upload=None, why=False)
        )

    def tile(self, task: Task, index: int, model: QueuedModel | None = None) -> DescribedPicture:
        """A described gallery picture, cached because many queries share their tiles.

        Args:
            model: describes the tile where it is not cached; by default the workspace's.
        """
        return self._tiles.get((task.name, index), lambda: describe_tile(task, index, model or self.model))

    def thumbnail(self, path: Path) -> str:
        """A 64-pixel JPEG of a picture file as a data URI."""
        return self._thumbnail(path)

    def cut(self, picture: UInt8Array, view: View) -> UInt8Array:
        """A picture in the shape that parts divide: unrolled for SAFA, else unchanged."""
        return picture if self.model is None else self.model.as_partitioned(picture, view)

    def card(self, task: Task, index: int) -> UInt8Array:
        """A gallery picture at a card's size, without its parts; read only."""
        return self._card(task.name, index)

    def _make_masks(self, view: View) -> Int64Array:
        """The part of each pixel of a stage picture."""
        return overlays.part_masks(self.spec.partition(view), self.map_sizes[view], self.layout.pixels)

    def mosaic(self, task: Task) -> UInt8Array:
        """The task's tiles at their positions as one picture, drawn once; the task must have a geometry."""
        assert task.geometry is not None
        with self._mosaic_lock:
            if task.name not in self._mosaics:
                self._mosaics[task.name] = mosaic.draw(task.geometry, [entry.path for entry in task.gallery])
            return self._mosaics[task.name]

    def _part_names(self) -> list[str]:
        """Each part's name; where the views divide differently (CVUSA), the names in all views."""
        names = [self.spec.partition(view).names() for view in self.spec.views]
        return [" / ".join(dict.fromkeys(of_part)) for of_part in zip(*names, strict=True)]

    def _make_card(self, name: str, index: int) -> UInt8Array:
        task = self.tasks[name]
        picture = self.load_picture(task.gallery[index].path)
        return images.resize(self.cut(picture, task.gallery_view), *self.layout.card_pixels)

    def _make_thumbnail(self, path: Path) -> str:
        return overlays.data_uri(overlays.square(images.load_picture(path), 64))


@dataclass(frozen=True, eq=False)
class StateAnalysis(Analysis):
    """The analysis of the query that a state shows."""

    state: SessionState


class StateAnalyser:
    """Analyses one browser's states, see `QueryAnalyser`.

    Args:
        model: the browser's queued model, by default the workspace's.
    """

    def __init__(self, workspace: Workspace, model: QueuedModel | None = None) -> None:
        self._workspace = workspace
        model = model or workspace.model
        # A newer state may supersede the query's description, but not that of a tile, which other browsers wait for.
        self._analyser = QueryAnalyser(
            None if model is None else model.cancellable(),
            lambda task, index: workspace.tile(task, index, model),
            workspace.load_picture,
        )

    def analyse(self, state: SessionState, k: int) -> StateAnalysis:
        """Analyse the state's query, with its k nearest tiles.

        Raises:
            BusyError: when the inference queue is full; the same state can be requested again.
            SupersededError: when a newer state is wanted, see `RequestContext.compute_newest`.
            LPNError: when the query cannot be analysed.
        """
        request = QueryRequest(
            query=state.upload or state.query,
            change=state.change,
            weights=state.part_values(),
            region=state.region,
            compare="positive" if state.selected == POSITIVE else state.selected,
            evidence=state.why or (state.heat and state.heat_kind == "evidence"),
            correspondences=state.why,
        )
        analysis = self._analyser.analyse(self._workspace.tasks[state.task], request, k)
        return StateAnalysis(**vars(analysis), state=state)
