"""The tables, maps, and notes of the failure laboratory, computed once for all browsers."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Literal

import numpy as np

from explorer.compute.background_jobs import BackgroundJob, BackgroundJobs, ReportProgress, run_in_process
from explorer.workspace import Workspace
from lpn.analysis import embedding_map, notes
from lpn.analysis.notes import Note
from lpn.analysis.query_outcomes import Outcomes
from lpn.analysis.task import Task
from lpn.core.arrays import Float64Array, UInt8Array
from lpn.core.errors import LPNError
from lpn.core.tables import Table
from lpn.datasets.metadata import NOTE, TAGS
from lpn.locate.pipeline import LocatedFlight
from lpn.locate.task import stage_columns

MapKind = Literal["pca", "umap", "ground"]


@dataclass(frozen=True, eq=False)
class Findings:
    """The outcomes of all queries of a task, under equal part weights.

    Attributes:
        table: see `query_outcomes.table`, with the columns of `notes`.
        part_names: the names of the parts that `outcomes` numbers.
        notes_error: why the notes cannot be used, in one sentence; empty if they can.
        flight: the flight whose answers `table` has; None without one.
    """

    task: Task
    outcomes: Outcomes
    table: Table
    part_names: list[str]
    notes_error: str
    flight: LocatedFlight | None = None

    def note(self, row: int) -> Note:
        """Return the tags and the note of a query."""
        tags, text = (str(self.table.columns[name].values[row]) for name in (TAGS, NOTE))
        return Note(tuple(tags.split()), text)


@dataclass(frozen=True, eq=False)
class MapPoints:
    """Queries and tiles on a plane.

    Attributes:
        queries, tiles: (Q, 2) and (G, 2), y upwards; NaN for queries whose places are unknown.
        axes: the axes in words; may be empty.
        ground: a picture of the ground, and its west, south, east, and north border; None for embeddings.
    """

    queries: Float64Array
    tiles: Float64Array
    axes: str = ""
    ground: tuple[UInt8Array, tuple[float, float, float, float]] | None = None


class FailureLab:
    """Tables and maps of a workspace's tasks; thread-safe. A `client` is any object that stands for one browser."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace, self._jobs, self._lock = workspace, BackgroundJobs(), threading.Lock()
        self._findings: dict[str, Findings] = {}
        self.notes = workspace.root / notes.NAME

    @property
    def has_umap(self) -> bool:
        """Tell if the extra for UMAP is installed."""
        return find_spec("umap") is not None

    def findings(self, task: str) -> Findings | None:
        """Return a task's findings with the newest notes and the newest answers of a flight; None before they are computed."""
        flight = self._workspace.flight
        with self._lock:
            findings = self._findings.get(task)
            if findings is not None and flight is not None and findings.flight is not flight:
                table = findings.table.with_columns(stage_columns(flight))
                findings = self._findings[task] = replace(findings, table=table, flight=flight)
            return findings

    def build(self, task: str, client: object) -> BackgroundJob[None]:
        """Start or join the computation of a task's findings."""
        return self._jobs.join(task, client, lambda progress: self._build(self._workspace.tasks[task], progress))

    def points(self, kind: MapKind, task: str, client: object) -> BackgroundJob[MapPoints]:
        """Start or join the computation of a map; `ground` requires that the task has places."""
        return self._jobs.join(
            (kind, task), client, lambda progress: self._points(kind, self._workspace.tasks[task], progress)
        )

    def retry(self, task: str, work: Literal["table"] | MapKind) -> None:
        """Forget that the table or a map failed, so that the next request computes it again."""
        self._jobs.forget_failed(task if work == "table" else (work, task))

    def leave(self, client: object, task: str | None = None, kind: MapKind | None = None) -> None:
        """Stop waiting for a table (`task`), for a map (`task` and `kind`), or for anything.

        Work that no browser waits for is cancelled.
        """
        self._jobs.leave(client, None if task is None else task if kind is None else (kind, task))

    def set_note(self, path: str, tags: str, text: str) -> None:
        """Store the tags and the note of a query on disk, and show them in all browsers.

        Raises:
            LPNError: as `notes.set_note`; then nothing has changed.
        """
        stored = notes.set_note(self.notes, path, tags, text)
        with self._lock:
            for name, findings in self._findings.items():
                table = findings.table.with_columns(notes.columns(stored, findings.table.paths))
                self._findings[name] = replace(findings, table=table, notes_error="")

    def _build(self, task: Task, progress: ReportProgress) -> None:
        progress(0, len(task.queries))
        ranking = self._workspace.rankings[task.name].wait(self, progress).ranking
        task = task.current()
        outcomes = task.outcomes_of(ranking)
        progress(len(task.queries), len(task.queries))
        part_names = self._workspace.part_names
        table = task.tabulate(outcomes, part_names)
        with self._lock:
            stored, error = self._read_notes()
            table = table.with_columns(notes.columns(stored, table.paths))
            self._findings[task.name] = Findings(task, outcomes, table, part_names, error)

    def _read_notes(self) -> tuple[dict[str, Note], str]:
        try:
            return notes.read_notes(self.notes), ""
        except LPNError as error:  # the table is useful without notes
            return {}, str(error)

    def _points(self, kind: MapKind, task: Task, progress: ReportProgress) -> MapPoints:
        if kind == "ground":
            task = task.current()
            assert task.geometry is not None
            ground = self._workspace.mosaic(task), task.geometry.bounds()
            return MapPoints(task.geometry.query_ground, task.geometry.ground, ground=ground)
        if kind == "umap":
            descriptors = np.asarray(task.query_descriptors), np.asarray(task.gallery_descriptors)
            embedding = run_in_process(progress, embedding_map.umap, *descriptors)
            axes = "neighbours are alike; distances between groups mean little"
            return MapPoints(embedding.queries, embedding.tiles, axes)
        embedding = embedding_map.pca(task.query_descriptors, task.gallery_descriptors)
        assert embedding.variance is not None
        first, second = 100 * embedding.variance
        axes = f"{first:.0f} % of the variance across, {second:.0f} % upwards"
        return MapPoints(embedding.queries, embedding.tiles, axes)
