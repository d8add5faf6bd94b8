"""What the failure laboratory looks at, made once for all browsers: a table of each task, its maps, and people's notes."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Literal

import numpy as np

from explorer.compute.background_jobs import BackgroundJob, BackgroundJobs, ReportProgress, in_process
from explorer.workspace import Workspace
from lpn.analysis import embedding_map, notes, query_outcomes
from lpn.analysis.notes import Note
from lpn.analysis.query_outcomes import Outcomes
from lpn.analysis.task import Task
from lpn.core.arrays import Float64Array, UInt8Array
from lpn.core.errors import LPNError
from lpn.core.tables import Table
from lpn.datasets import geo
from lpn.datasets.metadata import NOTE, TAGS

MapKind = Literal["pca", "umap", "ground"]


@dataclass(frozen=True, eq=False)
class Findings:
    """What became of all queries of a task, under equal part weights.

    Attributes:
        table: see `failures.table`, with the columns of `notes`.
        flaw: why notes cannot be used, in one sentence; empty where they can.
    """

    task: Task
    outcomes: Outcomes
    table: Table
    flaw: str

    def note(self, row: int) -> Note:
        """What a person said of a query."""
        tags, text = (str(self.table.columns[name].values[row]) for name in (TAGS, NOTE))
        return Note(tuple(tags.split()), text)


@dataclass(frozen=True, eq=False)
class Points:
    """Queries and tiles on a plane.

    Attributes:
        queries, tiles: (Q, 2) and (G, 2), y upwards.
        axes: what the axes are, in words; may be empty.
        ground: a picture of what lies under them and its west, south, east, and north border; None for embeddings.
    """

    queries: Float64Array
    tiles: Float64Array
    axes: str = ""
    ground: tuple[UInt8Array, tuple[float, float, float, float]] | None = None


class Laboratory:
    """Tables and maps of an workspace's tasks; thread-safe."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace, self._jobs, self._lock = workspace, BackgroundJobs(), threading.Lock()
        self._findings: dict[str, Findings] = {}
        self.notes = workspace.root / notes.NAME

    @property
    def umap(self) -> bool:
        """Whether the extra for UMAP is installed."""
        return find_spec("umap") is not None

    def findings(self, task: str) -> Findings | None:
        """A task's table with the newest notes, None before it is made."""
        return self._findings.get(task)

    def build(self, task: str, who: object) -> BackgroundJob[None]:
        """Make a task's table."""
        return self._jobs.join(task, who, lambda progress: self._build(self._workspace.tasks[task], progress))

    def points(self, kind: MapKind, task: str, who: object) -> BackgroundJob[Points]:
        """Make a map of a task; `ground` only where the task has places."""
        return self._jobs.join(
            (kind, task), who, lambda progress: self._points(kind, self._workspace.tasks[task], progress)
        )

    def again(self, task: str, kind: MapKind | None = None) -> None:
        """Forget that a table or map could not be made."""
        self._jobs.forget_failed(task if kind is None else (kind, task))

    def leave(self, who: object, task: str | None = None, kind: MapKind | None = None) -> None:
        """Wait no longer for a table or map, or for anything; work that nobody waits for ends."""
        self._jobs.leave(who, None if task is None else task if kind is None else (kind, task))

    def say(self, path: str, tags: str, text: str) -> None:
        """Keep what a person says of a query, for all browsers and on disk.

        Raises:
            LPNError: as `notes.set_note`; then nothing has changed.
        """
        said = notes.set_note(self.notes, path, tags, text)
        with self._lock:
            for name, found in self._findings.items():
                table = found.table.with_columns(notes.columns(said, found.table.paths))
                self._findings[name] = replace(found, table=table, flaw="")

    def _build(self, task: Task, progress: ReportProgress) -> None:
        progress(0, len(task.queries))
        ranking = self._workspace.rankings[task.name].wait(self, progress).ranking
        outcomes = query_outcomes.outcomes_of(ranking, task.query_descriptors, task.gallery_descriptors)
        progress(len(task.queries), len(task.queries))
        made = query_outcomes.table(
            self._workspace.root, task.queries, task.gallery, outcomes, self._workspace.part_names
        )
        with self._lock:
            said, flaw = self._said()
            table = made.with_columns(notes.columns(said, made.paths))
            self._findings[task.name] = Findings(task, outcomes, table, flaw)

    def _said(self) -> tuple[dict[str, Note], str]:
        try:
            return notes.read_notes(self.notes), ""
        except LPNError as error:  # no reason to show no table
            return {}, str(error)

    def _points(self, kind: MapKind, task: Task, progress: ReportProgress) -> Points:
        if kind == "ground":
            assert task.geometry is not None
            queries = geo.on_plane(task.geometry.queries, task.geometry.origin)
            ground = self._workspace.mosaic(task), task.geometry.bounds()
            return Points(queries, task.geometry.ground, ground=ground)
        if kind == "umap":
            found = in_process(
                progress, embedding_map.umap, np.asarray(task.query_descriptors), np.asarray(task.gallery_descriptors)
            )
            return Points(found.queries, found.tiles, "neighbours are alike; distances between groups mean little")
        found = embedding_map.pca(task.query_descriptors, task.gallery_descriptors)
        assert found.variance is not None
        first, second = 100 * found.variance
        axes = f"{first:.0f} % of the variance across, {second:.0f} % upwards"
        return Points(found.queries, found.tiles, axes)
