"""Sources over a map: a flight, and an index of a map's windows. `lpn.sources` finds both by their entry points."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.sources import OpenedSource, SourceOptions, TaskSource
from lpn.sources.kinds.index import IndexSource
from lpn.sources.opened import query_positions, weighted
from lpn.sources.recognise import NETWORK, file_names

if TYPE_CHECKING:
    from lpn.flight.locate.located import LocatedFlight
    from lpn.flight.maps import Map
    from lpn.index import Index
    from lpn.index.queries import IndexQueries
    from lpn.models.base import Model
    from lpn.tasks.task import Task


@dataclass(frozen=True, eq=False, kw_only=True)
class OpenedFlight(OpenedSource):
    """The task of a source over a map.

    Attributes:
        map: the map that windows are cut from.
        located: the flight, located without registration; None for the windows of an index.
    """

    map: Map
    located: LocatedFlight | None = None

    def graded(self) -> tuple[Task, Collection[int]]:
        """Register each photo; a contradicted GPS tag grades no photo. See `OpenedSource.graded`."""
        import numpy as np

        from lpn.flight.locate.grades import doubtful_photos
        from lpn.flight.locate.pipeline import registered
        from lpn.flight.locate.task import stage_columns

        if self.located is None:
            return super().graded()
        task = self.task
        located = registered(self.located, self.network)
        best, first = task.retrieved.best, task.retrieved.first
        doubtful = set(np.flatnonzero(doubtful_photos(located, task, best, first)).tolist())
        task = replace(task, columns=[*task.columns, *stage_columns(located)])
        return task.without_truth(doubtful), doubtful


class WindowSource(IndexSource):
    """An index of a map's windows, searched with the queries of any index, or with the frames of a flight."""

    noun = "an index of a map's windows"
    takes = IndexSource.takes | {"map"}
    priority = 1

    @classmethod
    def recognises(cls, options: SourceOptions) -> bool:
        return options.map is not None and super().recognises(options)

    @property
    def where(self) -> str:
        return self.options.index or super().where

    @cached_property
    def basemap(self) -> Map:
        from lpn.flight.maps import open_map

        assert self.options.map is not None
        return open_map(self.options.map)

    def queries(self, model: Model, index: Index) -> IndexQueries:
        from lpn.flight.files import open_flight
        from lpn.flight.locate.task import flight_queries

        if self.options.index is None:
            return super().queries(model, index)
        flight, folder = open_flight(self.options.path), self.options.path
        return flight_queries(model, flight, self.basemap, index, folder)

    def open(self, names: Sequence[str] = (), weights: Sequence[float] | None = None) -> OpenedFlight:
        opened = super().open(names, weights)
        return OpenedFlight(opened.tasks, opened.model, opened.network, map=self.basemap)


class FlightSource(TaskSource):
    """A flight over a map: frames are the queries, windows of the map the gallery."""

    noun = "a flight"
    takes = NETWORK | {"map", "index", "register", "map_error", "beside", "beside_kind", "beside_pooling"}

    @classmethod
    def recognises(cls, options: SourceOptions) -> bool:
        from lpn.datasets import known_layouts
        from lpn.flight.files.folder import is_flight

        if is_flight(options.path):
            return True
        # A folder of photos with a map is a flight.
        marked = any(not layout.deep and layout.recognises(options.path) for layout in known_layouts())
        return options.map is not None and not options.path.is_file() and not marked

    @property
    def map_path(self) -> Path:
        """The map under the flight; InputError without one."""
        if self.options.map is None:
            raise InputError(f"{printable(self.options.path.name)} is a flight; give the map under it as --map.")
        return self.options.map

    @property
    def title(self) -> str:
        files = self.options.file, self.options.map, self.options.path
        return file_names(*(file for file in files if file is not None))

    def open(self, names: Sequence[str] = (), weights: Sequence[float] | None = None) -> OpenedFlight:
        if self.options.index is not None and self.map_path:
            return WindowSource(self.options).open(names, weights)
        return self.locate(None, names, weights)

    def to_measure(self) -> list[Task]:
        if getattr(self.options, "rotate", 0):  # an option of lpn evaluate
            raise InputError(
                f"{printable(self.options.path.name)} is a flight, whose queries are cut out of photos and not turned; leave "
                "--rotate out."
            )
        return super().to_measure()

    def locate(
        self,
        overlap: float | None = None,
        names: Sequence[str] = (),
        weights: Sequence[float] | None = None,
        shipped: Path | None = None,
        loaded: Model | None = None,
    ) -> OpenedFlight:
        """Open the flight with windows that overlap by a share of their sides, `LocateOptions.overlap` by default.

        Args:
            shipped: see `lpn.flight.locate.pipeline.locate`.
            loaded: the model if already loaded.
        """
        from lpn.flight.files import open_flight
        from lpn.flight.locate.options import LocateOptions
        from lpn.flight.locate.pipeline import locate
        from lpn.flight.locate.task import flight_task
        from lpn.flight.maps import open_map
        from lpn.retrieval import scoring

        ground, flight = open_map(self.map_path), open_flight(self.options.path)
        model = loaded or self.options.load()
        for view in ("satellite", "drone"):
            model.check_view(view)
        scoring.part_weights(model.n_parts, weights)
        query_positions(names, flight.frames, flight.name)
        options = LocateOptions(register=False, overlap=LocateOptions.overlap if overlap is None else overlap)
        located = locate(ground, flight, model, options, shipped=shipped)
        task = flight_task(model, self.options.name, located, self.options.path)
        notes = [printable(note) for note in (*ground.notes, *flight.notes, *located.notes)]
        return OpenedFlight([weighted(task, weights)], task.model, model, notes, map=ground, located=located)
