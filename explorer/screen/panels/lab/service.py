"""The laboratory's tables, maps, and notes of a workspace, computed once for all tabs."""

from __future__ import annotations

import threading
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import numpy as np

from explorer.compute.background_jobs import BackgroundJob, BackgroundJobs, ReportProgress, run_in_process
from explorer.compute.ranking_job import RankingJob
from explorer.workspace import Workspace
from lpn.analysis import embedding_map
from lpn.core.arrays import BoolArray, Float64Array, UInt8Array
from lpn.core.demo import own_file, own_file_place
from lpn.core.errors import LPNError
from lpn.core.tables import Table
from lpn.datasets.geo import Position
from lpn.datasets.metadata import NOTE, TAGS
from lpn.datasets.rendered import shows_rendered
from lpn.flight.locate.located import LocatedFlight
from lpn.flight.locate.task import stage_columns
from lpn.tasks import notes, query_outcomes
from lpn.tasks.notes import Note
from lpn.tasks.query_outcomes import Outcomes
from lpn.tasks.task import Scoring, Task

PlaneKind = Literal["ground", "pca", "umap"]


@dataclass(frozen=True, eq=False)
class OtherRanks:
    """A second model's ranks of the same queries.

    Attributes:
        names: the names of model A, whose ranks the table has, and of the second model B.
        hits: the queries whose true match B ranks first, (Q,).
        scorings: of A and of B; if they are equal, ranks differ by the models alone.
    """

    names: tuple[str, str]
    hits: BoolArray
    scorings: tuple[Scoring, Scoring]


@dataclass(frozen=True, eq=False)
class LabFindings:
    """The outcomes of all queries of a task, under equal part weights.

    Attributes:
        outcomes: the outcomes of all queries; see also `graded`.
        table: see `query_outcomes.table`, with the columns of `notes`, and with `compared_ranks` if there is a `second`.
        part_names: the names of the parts that `outcomes` numbers.
        notes_error: one sentence with the reason for which the notes cannot be used; empty if they can.
        flight: the flight whose answers `table` has; None without one.
        doubtful: the photos of a flight whose grade is in doubt, (Q,); None without a flight.
        second: the second model's ranks; None without one.
    """

    task: Task
    outcomes: Outcomes
    table: Table
    part_names: list[str]
    notes_error: str
    flight: LocatedFlight | None = None
    doubtful: BoolArray | None = None
    second: OtherRanks | None = None

    @cached_property
    def graded(self) -> Outcomes:
        """The outcomes; the truth of a query whose grade is in doubt counts as unknown."""
        if self.doubtful is None:
            return self.outcomes
        return replace(self.outcomes, known=self.outcomes.known & ~self.doubtful)

    def note(self, query: int) -> Note:
        """Return the tags and the note of a query."""
        tags, text = (str(self.table.columns[name].values[query]) for name in (TAGS, NOTE))
        return Note(tuple(tags.split()), text)

    def compared(self, names: tuple[str, str], other: RankingJob) -> LabFindings:
        """Return the findings with another model's ranks of the same queries.

        Raises:
            LPNError: when the data set changed before the other model was opened.
        """
        if [one.path for one in self.task.queries] != [one.path for one in other.task.queries]:
            raise LPNError(f"The queries of {names[1]} differ, because the data set changed; start the app again.")
        columns = query_outcomes.compared_ranks(self.table, other.ranks)
        hits = self.outcomes.known & (other.ranks == 0)
        second = OtherRanks(names, hits, (self.task.scoring, other.task.scoring))
        return replace(self, table=self.table.with_columns(columns), second=second)


@dataclass(frozen=True, eq=False)
class PlanePoints:
    """Queries and tiles on a plane.

    Attributes:
        queries, tiles: (Q, 2) and (G, 2), y upwards; NaN for an unknown place. Places on the ground are in metres.
        axes: the axes in words; may be empty.
        ground: a picture of the ground, and its west, south, east, and north border; None for descriptors.
        origin: the geographic origin of the metres; None for descriptors, and for a rendered place.
    """

    queries: Float64Array
    tiles: Float64Array
    axes: str = ""
    ground: tuple[UInt8Array, tuple[float, float, float, float]] | None = None
    origin: Position | None = None


def map_kinds(task: Task) -> dict[PlaneKind, str]:
    """Return a task's maps and their names; UMAP needs its extra, and has a limit of pictures."""
    kinds: dict[PlaneKind, str] = {} if task.geometry is None else {"ground": "Ground"}
    kinds["pca"] = "PCA"
    few = len(task.queries) + len(task.gallery) <= embedding_map.MOST_FOR_UMAP
    return kinds | ({"umap": "UMAP"} if few and find_spec("umap") is not None else {})


class Lab:
    """Tables, maps, and notes of a workspace's tasks; thread-safe. A `client` is any object that identifies a tab."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace, self._jobs, self._lock = workspace, BackgroundJobs(), threading.Lock()
        self._findings: dict[str, LabFindings] = {}

    @property
    def _notes(self) -> Path:
        """The file of tags and notes; OutputError for the demo if the user has no home folder."""
        return own_file(self._workspace.root, notes.NAME)

    @property
    def notes_place(self) -> str:
        """The place of the notes, in words and without the server's folders."""
        return own_file_place(self._workspace.root, notes.NAME, "data")

    def findings(self, task: str) -> LabFindings | None:
        """Return a task's findings with the newest notes and flight answers; None before they are computed."""
        flight = self._workspace.flight
        with self._lock:
            findings = self._findings.get(task)
            if findings is not None and flight is not None and findings.flight is not flight:
                table = findings.table.with_columns(stage_columns(flight))
                doubtful = self._workspace.doubtful(self._workspace.rankings[task])
                findings = self._findings[task] = replace(findings, table=table, flight=flight, doubtful=doubtful)
            return findings

    def build(self, task: str, client: object) -> BackgroundJob[None]:
        """Start or join the computation of a task's findings; a failed one starts again."""
        return self._jobs.join(task, client, lambda progress: self._build(self._workspace.rankings[task], progress))

    def points(self, kind: PlaneKind, task: str, client: object) -> BackgroundJob[PlanePoints]:
        """Start or join the computation of a map; `ground` requires that the task has places."""
        ranked = self._workspace.rankings[task].task
        return self._jobs.join((kind, task), client, lambda progress: self._points(kind, ranked, progress))

    def leave(self, client: object, key: Hashable | None = None) -> None:
        """Stop waiting for a map, by its kind and task, or for all work; work without a waiting tab is cancelled."""
        self._jobs.leave(client, key)

    def set_note(self, path: str, tags: str, text: str, before: Note | None) -> None:
        """Store the tags and the note of a query on disk.

        Raises:
            LPNError: as for `notes.set_note`; then nothing has changed.
        """
        try:
            self._show_notes(notes.set_note(self._notes, path, tags, text, before))
        except notes.ChangedNoteError:
            self._show_notes(notes.read_notes(self._notes))
            raise

    def add_tags(self, paths: Sequence[str], tags: str) -> None:
        """Add tags to several queries on disk; errors as for `notes.add_tags`."""
        self._show_notes(notes.add_tags(self._notes, paths, tags))

    def _show_notes(self, stored: Mapping[str, Note]) -> None:
        with self._lock:
            for name, findings in self._findings.items():
                table = findings.table.with_columns(notes.columns(stored, findings.table.paths))
                self._findings[name] = replace(findings, table=table, notes_error="")

    def _build(self, ranking: RankingJob, progress: ReportProgress) -> None:
        task, part_names = ranking.task, self._workspace.part_names
        outcomes = query_outcomes.outcomes_of(task, ranking.wait(self, progress).ranking)
        table = query_outcomes.table(task, outcomes, part_names)
        with self._lock:
            try:
                stored, error = notes.read_notes(self._notes), ""
            except LPNError as failure:  # the table is useful without notes
                stored, error = {}, str(failure)
            table = table.with_columns(notes.columns(stored, table.paths))
            self._findings[task.key] = LabFindings(task, outcomes, table, part_names, error)

    def _points(self, kind: PlaneKind, task: Task, progress: ReportProgress) -> PlanePoints:
        if kind == "ground":
            assert task.geometry is not None
            places = task.geometry
            ground = self._workspace.mosaic(task), places.bounds()
            origin = None if shows_rendered(self._workspace.root) else places.origin
            return PlanePoints(places.query_ground, places.ground, ground=ground, origin=origin)
        if kind == "umap":
            found = run_in_process(progress, embedding_map.umap, *map(np.asarray, task.sides()))
            return PlanePoints(found.queries, found.tiles, "neighbours are alike; distances between groups mean little")
        found = embedding_map.pca(*task.sides())
        assert found.variance is not None
        across, upwards = 100 * found.variance
        return PlanePoints(
            found.queries, found.tiles, f"{across:.0f} % of the variance across, {upwards:.0f} % upwards"
        )


# The laboratories of open workspaces: a few places, each with a few models.
lab_of = lru_cache(maxsize=16)(Lab)
