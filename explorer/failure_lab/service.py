"""The tables, maps, and notes of the failure laboratory, computed once for all browsers."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import numpy as np

from explorer.compute.background_jobs import BackgroundJob, BackgroundJobs, ReportProgress, run_in_process
from explorer.lab_choices import MapKind
from explorer.workspace import LazyWorkspace, Workspace
from lpn.analysis import embedding_map, named_views
from lpn.analysis.named_views import NamedView
from lpn.core.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from lpn.core.demo import own_file, own_file_place
from lpn.core.errors import LPNError
from lpn.core.tables import Table
from lpn.datasets.geo import Position
from lpn.datasets.metadata import NOTE, TAGS
from lpn.datasets.rendered import shows_rendered
from lpn.drawing import words
from lpn.drawing.words import Vocabulary, speaking
from lpn.locate.located import LocatedFlight
from lpn.locate.task import stage_columns
from lpn.tasks import notes, query_outcomes
from lpn.tasks.notes import Note
from lpn.tasks.query_outcomes import Outcomes
from lpn.tasks.task import Scoring, Task

_CHANGED = "rank B: none. The data set changed before the second model was opened; stop the app and start it again."


@dataclass(frozen=True, eq=False)
class SecondRanks:
    """The second model's ranks of the same queries.

    Attributes:
        names: of the table's own model, which is A, and of the second one, which is B.
        hits: the queries whose true match B ranks first, (Q,).
        scorings: of A and of B.
        preparable: B can be ranked as A is, once it is prepared by `FailureLab.score_second`.
    """

    names: tuple[str, str]
    hits: BoolArray
    scorings: tuple[Scoring, Scoring] = ("plain", "plain")
    preparable: bool = False

    @property
    def alike(self) -> bool:
        """Both models rank by one scoring, so that their ranks differ by the models alone."""
        return self.scorings[0] == self.scorings[1]


@dataclass(frozen=True)
class SecondProgress:
    """How far the second model's ranks of a task are known.

    Attributes:
        text: a line that says what they wait for, or why there are none; empty once they are there.
        pending: they are being computed.
        offered: the second model's name, if it is opened on request only.
        done, total: pictures of the work that goes on; 0 while they are not known.
    """

    text: str = ""
    pending: bool = False
    offered: str = ""
    done: int = 0
    total: int = 0


# The terms of columns. Their names stay as they are in files; a filter takes the plain words, too.
TERMS = {"rank": "rank", "margin": "margin", "part": "part", "answer": "tile"}


@dataclass(frozen=True, eq=False)
class Findings:
    """The outcomes of all queries of a task, under equal part weights.

    Attributes:
        table: see `query_outcomes.table`, with the columns of `notes`, and those of `compared_ranks` where there is `second`.
        part_names: the names of the parts that `outcomes` numbers.
        notes_error: why the notes cannot be used, in one sentence; empty if they can.
        flight: the flight whose answers `table` has; None without one.
        doubtful: the photos of a flight whose judge is in doubt, see `Workspace.doubtful`, (Q,); None without one.
        second: the second model's ranks; None without one, and until they are known.
    """

    task: Task
    outcomes: Outcomes
    table: Table
    part_names: list[str]
    notes_error: str
    flight: LocatedFlight | None = None
    doubtful: BoolArray | None = None
    second: SecondRanks | None = None

    def is_doubtful(self, row: int) -> bool:
        """Return whether the judge of a query is in doubt, so that nothing is marked as right or wrong."""
        return self.doubtful is not None and self.outcomes.known[row] and bool(self.doubtful[row])

    @cached_property
    def graded(self) -> Outcomes:
        """The outcomes, in which the truth of a query whose judge is in doubt is not known."""
        return (
            self.outcomes
            if self.doubtful is None
            else replace(self.outcomes, known=self.outcomes.known & ~self.doubtful)
        )

    def not_graded(self, rows: Int64Array) -> int:
        """Return how many of the queries in some rows count neither as found nor as failed."""
        return int((~self.graded.known)[rows].sum())

    @property
    def failed(self) -> BoolArray:
        """The queries that failed by a judge that is not in doubt, (Q,)."""
        return self.graded.failed

    def verdict(self, row: int) -> bool | None:
        """Return whether a query is found; None if its truth is not known, or its judge is in doubt."""
        return None if self.is_doubtful(row) else self.outcomes.verdict(row)

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
        origin: the position that a map of the ground counts its metres from; None for embeddings, and for a rendered place,
            which is no real one.
    """

    queries: Float64Array
    tiles: Float64Array
    axes: str = ""
    ground: tuple[UInt8Array, tuple[float, float, float, float]] | None = None
    origin: Position | None = None


def _same_queries(first: Task, second: Task) -> bool:
    return [query.path for query in first.queries] == [query.path for query in second.queries]


class FailureLab:
    """Tables and maps of a workspace's tasks; thread-safe. A `client` is any object that stands for one browser."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace, self._jobs, self._lock = workspace, BackgroundJobs(), threading.Lock()
        self._findings: dict[str, Findings] = {}
        # The same with the ranks of one of the models beside, and the findings that they were added to.
        self._compared: dict[tuple[str, int], tuple[Findings, Findings]] = {}
        # The preparations of the further scorings of models beside the workspace's own.
        self._scoring: dict[int, BackgroundJob[None]] = {}

    @property
    def notes(self) -> Path:
        """The file of tags and notes; OutputError for the demo's if the user has no folder for them."""
        return own_file(self._workspace.root, notes.NAME)

    @property
    def notes_place(self) -> str:
        """Where the notes are, in words and without the server's folders."""
        return own_file_place(self._workspace.root, notes.NAME, "data")

    @property
    def has_umap(self) -> bool:
        """Tell if the extra for UMAP is installed."""
        return find_spec("umap") is not None

    def findings(self, task: str, beside: int = 0) -> Findings | None:
        """Return a task's findings with all that is known by now; None before they are computed.

        They include the newest notes, the newest answers of a flight, and the ranks of the second model.

        Args:
            beside: which of the models beside the workspace's own is the second one.
        """
        flight = self._workspace.flight
        with self._lock:
            findings = self._findings.get(task)
            if findings is not None and flight is not None and findings.flight is not flight:
                table = findings.table.with_columns(stage_columns(flight))
                doubtful = self._workspace.doubtful(self._workspace.rankings[task])
                findings = self._findings[task] = replace(findings, table=table, flight=flight, doubtful=doubtful)
            if findings is None:
                return None
            before = self._compared.get((task, beside))
            if before is None or before[0] is not findings or self._ranked_anew(before[1], beside):
                compared = self._with_second(findings, self._second(beside))
                if compared is findings:
                    return findings
                before = self._compared[task, beside] = findings, compared
            return before[1]

    def _ranked_anew(self, compared: Findings, beside: int) -> bool:
        """Return True if the second model ranks by another scoring than its ranks in the findings."""
        second = self._second(beside)
        ranking = None if second is None or second.workspace is None else second.workspace.ranked_as(compared.task)
        return (
            compared.second is not None and ranking is not None and ranking.task.scoring != compared.second.scorings[1]
        )

    def _second(self, beside: int) -> LazyWorkspace | None:
        return self._workspace.beside[beside] if beside < len(self._workspace.beside) else None

    def join_second(self, task: str, client: object, beside: int = 0) -> SecondProgress:
        """Start or join the ranking of a task by the second model, once that is open; tell how far it is."""
        second = self._second(beside)
        if second is None:
            return SecondProgress()
        if second.workspace is None:
            if second.opening:
                done, total = second.progress
                return SecondProgress(f"rank B: opening {second.label}", True, done=done, total=total)
            failed = f"rank B: {second.label} is not open. {second.error}" if second.error else ""
            return SecondProgress(failed, offered=second.label)
        preparation, name = self._scoring.get(beside), second.workspace.model_name
        if preparation is not None and not preparation.wait(0) and preparation.join(client):
            done, total = preparation.done, preparation.total
            pictures = f"{done:,} of {total:,} pictures" if total else "its pictures"
            return SecondProgress(f"rank B: calibrating {name}, {pictures}", True, done=done, total=total)
        ranking = second.workspace.ranked_as(self._workspace.rankings[task].task)
        if ranking is None:
            return SecondProgress(f"rank B: {second.workspace.model_name} does not know the views of {task}")
        if ranking.result is not None:
            same = _same_queries(self._workspace.rankings[task].task, ranking.task)
            return SecondProgress(self.second_failure(beside) if same else _CHANGED)
        job = ranking.join(client)
        if ranking.error:
            return SecondProgress(f"rank B: none. {ranking.error}")
        total = len(ranking.task.queries)
        return SecondProgress(f"rank B: ranking {job.done:,} of {total:,} queries", True, done=job.done, total=total)

    def open_second(self, beside: int = 0, again: bool = True) -> None:
        """Open the second model in the background, if there is one that is not open.

        Args:
            again: try again after a failure.
        """
        second = self._second(beside)
        if second is not None and second.workspace is None and (again or not second.error):
            second.open()

    def score_second(self, client: object, beside: int = 0) -> None:
        """Prepare the further scorings of the second model, so that it is ranked as the workspace's own; see `join_second`."""
        second = self._second(beside)
        if second is not None and second.workspace is not None:
            job = second.workspace.scorings.prepare(client)
            if job is not None:
                self._scoring[beside] = job

    def scores_second(self, beside: int = 0) -> bool:
        """Return True while further scorings of the second model are prepared."""
        job = self._scoring.get(beside)
        return job is not None and not job.cancelled and not job.wait(0)

    def second_failure(self, beside: int = 0) -> str:
        """Say that the second model could not be prepared for further scorings, and why; "" otherwise."""
        job, second = self._scoring.get(beside), self._second(beside)
        if job is None or job.error is None or job.cancelled or second is None or second.workspace is None:
            return ""
        return f"rank B: {second.workspace.model_name} is not calibrated. {job.error}"

    def leave_second(self, client: object) -> None:
        """Stop waiting for the ranks of all models beside the workspace's own."""
        for job in list(self._scoring.values()):
            job.leave(client)
        for second in self._workspace.beside:
            for ranking in () if second.workspace is None else second.workspace.rankings.values():
                ranking.leave(client)

    def _with_second(self, findings: Findings, other: LazyWorkspace | None) -> Findings:
        second = None if other is None else other.workspace
        ranking = None if second is None else second.ranked_as(findings.task)
        if second is None or ranking is None or ranking.result is None:
            return findings
        if not _same_queries(findings.task, ranking.task):
            return findings
        ranked = ranking.result.ranking
        columns = query_outcomes.compared_ranks(findings.table, ranked.first)
        names = self._workspace.model_name, second.model_name
        scorings = findings.task.scoring, ranking.task.scoring
        hits = findings.outcomes.known & (ranked.first == 0)
        ranks = SecondRanks(names, hits, scorings, scorings[0] != scorings[1] and not second.scorings.why_not)
        return replace(findings, table=findings.table.with_columns(columns), second=ranks)

    def build(self, task: str, client: object) -> BackgroundJob[None]:
        """Start or join the computation of a task's findings."""
        return self._jobs.join(
            task, client, lambda progress: self._build(self._workspace.rankings[task].task, progress)
        )

    def points(self, kind: MapKind, task: str, client: object) -> BackgroundJob[MapPoints]:
        """Start or join the computation of a map; `ground` requires that the task has places."""
        return self._jobs.join(
            (kind, task), client, lambda progress: self._points(kind, self._workspace.rankings[task].task, progress)
        )

    def second_points(self, kind: MapKind, task: str, client: object, beside: int) -> BackgroundJob[MapPoints] | None:
        """Start or join the computation of a map of the second model's descriptors; None until its ranks are known.

        Its tiles are in the order of the workspace's own model; those that it lacks have no place.
        """
        findings, second = self.findings(task, beside), self._second(beside)
        if findings is None or findings.second is None or second is None or second.workspace is None:
            return None
        ranking, first = second.workspace.ranked_as(findings.task), findings.task
        if ranking is None:
            return None
        other = ranking.task

        def work(progress: ReportProgress) -> MapPoints:
            points = self._points(kind, other, progress)
            places = {tile.path: place for tile, place in zip(other.gallery, points.tiles, strict=True)}
            tiles = [places.get(tile.path, (np.nan, np.nan)) for tile in first.gallery]
            return replace(points, tiles=np.array(tiles, np.float64).reshape(-1, 2))

        return self._jobs.join((kind, task, second.label), client, work)

    def retry(self, task: str, work: Literal["table"] | MapKind) -> None:
        """Forget that the table or a map failed, so that the next request computes it again."""
        self._jobs.forget_failed(task if work == "table" else (work, task))

    def leave(self, client: object, task: str | None = None, kind: MapKind | None = None) -> None:
        """Stop waiting for a table (`task`), for a map (`task` and `kind`), or for anything.

        Work that no browser waits for is cancelled.
        """
        self._jobs.leave(client, None if task is None else task if kind is None else (kind, task))

    def set_note(self, path: str, tags: str, text: str, before: Note | None = None) -> None:
        """Store the tags and the note of a query on disk, and show them in all browsers.

        Raises:
            LPNError: as `notes.set_note`; then nothing has changed.
        """
        try:
            self._show_notes(notes.set_note(self.notes, path, tags, text, before))
        except notes.ChangedNoteError:
            self._show_notes(notes.read_notes(self.notes))  # another program may have changed it
            raise

    def add_tags(self, paths: Sequence[str], tags: str) -> None:
        """Add tags to several queries on disk, and show them in all browsers; errors as for `notes.add_tags`."""
        self._show_notes(notes.add_tags(self.notes, paths, tags))

    def _show_notes(self, stored: Mapping[str, Note]) -> None:
        with self._lock:
            for name, findings in self._findings.items():
                table = findings.table.with_columns(notes.columns(stored, findings.table.paths))
                self._findings[name] = replace(findings, table=table, notes_error="")

    @property
    def views_place(self) -> str:
        """Where the named views are, in words and without the server's folders."""
        return own_file_place(self._workspace.root, named_views.NAME, "data")

    def views(self, task: str) -> tuple[NamedView, ...]:
        """Return a task's named views, by name; DataError if their file is damaged."""
        return tuple(view for view in named_views.read_views(self._views_file) if view.task == task)

    def save_view(self, view: NamedView) -> None:
        """Save a view, see `named_views.save_view`."""
        named_views.save_view(self._views_file, view)

    def remove_view(self, task: str, name: str) -> None:
        """Remove a view, see `named_views.remove_view`."""
        named_views.remove_view(self._views_file, task, name)

    @property
    def _views_file(self) -> Path:
        return own_file(self._workspace.root, named_views.NAME)

    def _build(self, task: Task, progress: ReportProgress) -> None:
        progress(0, len(task.queries))
        ranking = self._workspace.rankings[task.key].wait(self, progress).ranking
        outcomes = task.outcomes_of(ranking)
        progress(len(task.queries), len(task.queries))
        part_names = self._workspace.part_names
        table = _named_plainly(task.tabulate(outcomes, part_names), self._workspace.vocabulary(True))
        with self._lock:
            stored, error = self._read_notes()
            table = table.with_columns(notes.columns(stored, table.paths))
            self._findings[task.key] = Findings(task, outcomes, table, part_names, error)

    def _read_notes(self) -> tuple[dict[str, Note], str]:
        try:
            return notes.read_notes(self.notes), ""
        except LPNError as error:  # the table is useful without notes
            return {}, str(error)

    def _points(self, kind: MapKind, task: Task, progress: ReportProgress) -> MapPoints:
        if kind == "ground":
            assert task.geometry is not None
            places = task.geometry
            ground = self._workspace.mosaic(task), places.bounds()
            origin = None if shows_rendered(self._workspace.root) else places.origin
            return MapPoints(places.query_ground, places.ground, ground=ground, origin=origin)
        if kind == "umap":
            queries, gallery = map(np.asarray, task.sides())
            embedding = run_in_process(progress, embedding_map.umap, queries, gallery)
            axes = "neighbours are alike; distances between groups mean little"
            return MapPoints(embedding.queries, embedding.tiles, axes)
        embedding = embedding_map.pca(*task.sides())
        assert embedding.variance is not None
        first, second = 100 * embedding.variance
        axes = f"{first:.0f} % of the variance across, {second:.0f} % upwards"
        return MapPoints(embedding.queries, embedding.tiles, axes)


def _named_plainly(table: Table, vocabulary: Vocabulary) -> Table:
    """Return a table whose filters also take the words that a page with plain words has above its columns."""
    with speaking(vocabulary):
        return table.with_columns(
            [
                replace(table.columns[name], also=(words.say(term),))
                for name, term in TERMS.items()
                if name in table.columns
            ]
        )
