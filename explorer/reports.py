"""Files to download that take long to make: reports, the same as those of `lpn report`, and stories."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
import viser

from explorer import judge
from explorer.compute.background_jobs import BackgroundJob, ReportProgress, WorkCancelledError
from explorer.compute.request_context import QueuedModel
from explorer.workspace import StateAnalysis, Workspace
from lpn import report
from lpn.core.arrays import Float32Array
from lpn.core.demo import own_file
from lpn.core.errors import LPNError
from lpn.core.files import TYPED, printable
from lpn.core.progress import CountProgress
from lpn.library import Answer
from lpn.locate.task import stage_columns
from lpn.models.base import Model
from lpn.tasks import notes
from lpn.tasks.task import Task

# Seconds for which the page tells that a file is made.
_TOLD = 6.0


class FileProgress(Protocol):
    """Reports the finished and the total amount of work on a file, and what is counted; see `ReportProgress`."""

    def __call__(self, done: int, total: int, what: str = "done") -> None: ...


# A function that makes a report with a model and returns the file's name and contents.
MakeReport = Callable[[FileProgress, QueuedModel | None], tuple[str, bytes]]


def _with_notes(workspace: Workspace, task: Task, model: Model | None, weights: Float32Array | None = None) -> Task:
    """Return the task with these part weights, the user's notes, and what is known of a flight."""
    columns = [*task.columns, *([] if workspace.flight is None else stage_columns(workspace.flight))]
    stored = notes.read_notes(own_file(workspace.root, notes.NAME))
    bound = None if model is None else workspace.scored_model(model, task).for_task(*task.views)
    return replace(task, model=bound, weights=weights, notes=stored, columns=columns)


def of_analysis(
    workspace: Workspace,
    analysis: StateAnalysis,
    progress: Callable[[int, int], None] | None = None,
    model: Model | None = None,
    said: report.Said | None = None,
) -> tuple[str, bytes]:
    """Report on the shown query and the tile that it is compared with; returns the file's name and contents.

    Args:
        said: what the first screen says of it, which stands first.

    Raises:
        LPNError: when a file of the data set cannot be read.
    """
    state, task, model = analysis.state, analysis.task, model or workspace.model
    tile_model = None if model is None else workspace.scored_model(model, task)
    answer = analysis if state.upload or judge.is_sure(analysis, workspace) else analysis.ungraded()
    answer = replace(answer, describe_tile=lambda task, index: workspace.tile(task, index, tile_model))
    query: int | report.OwnPicture | Answer = answer
    if state.region:  # the shares of painted cells have no evidence of the whole picture beside them
        query = report.OwnPicture(analysis.name, analysis.source) if state.upload else state.query
    options = report.Options(change=state.change, said=said, doubtful=_doubtful(workspace, task))
    task = _with_notes(workspace, task, model, analysis.ranking.weights)
    return f"{safe_file_name(analysis.name)}.html", report.build(task, [query], options, progress)


def of_selection(
    workspace: Workspace,
    task: Task,
    queries: Sequence[int],
    chosen: str,
    progress: Callable[[int, int], None] | None = None,
    model: Model | None = None,
) -> tuple[str, bytes]:
    """Report on several queries of a task; returns the file's name and contents.

    Args:
        chosen: a description of the selection.

    Raises:
        LPNError: when there are too many queries, or a file of the data set cannot be read.
    """
    options = report.Options(selection=chosen, doubtful=_doubtful(workspace, task))
    return f"{safe_file_name(task.name)}.html", report.build(
        _with_notes(workspace, task, model or workspace.model), queries, options, progress
    )


def _doubtful(workspace: Workspace, task: Task) -> set[int]:
    """Return the photos of a flight that are not graded as their judge is in doubt."""
    doubtful = workspace.doubtful(workspace.rankings[task.key])
    return set() if doubtful is None else set(np.flatnonzero(doubtful).tolist())


def safe_file_name(name: str) -> str:
    """Return a file name that is valid on any system."""
    return "".join(letter if letter.isalnum() or letter in "-_" else "-" for letter in name)[:60] or "report"


class Reporter:
    """Makes one browser's files in the background, one at a time; a notification shows the progress.

    Args:
        model: the queued model for background work.
        on_progress: receives the finished and the total amount of work, (0, 0) at its end.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        model: QueuedModel | None,
        on_progress: CountProgress = lambda *_: None,
    ) -> None:
        self._client, self._model, self._left = client, model, False
        self._on_progress = on_progress
        self._job: BackgroundJob[None] | None = None

    def make(self, work: MakeReport, noun: str = "report", control: str = "Report") -> None:
        """Start a report, or cancel what is in progress.

        Args:
            noun: what is made, for the notification.
            control: the label of what starts and cancels it.
        """
        if self._left:
            return
        job = self._job
        if job is not None and not job.wait(0):
            job.leave(self)
            return
        self._job = BackgroundJob(lambda progress: self._run(work, noun, control, progress), self)

    def refuse(self, why: str) -> None:
        """Say why there is no report, in a sentence."""
        if not self._left:
            self._client.add_notification("No report", printable(why, TYPED), auto_close_seconds=_TOLD)

    def leave(self) -> None:
        """Cancel the report in progress; the browser has disconnected."""
        self._left = True
        if self._job is not None:
            self._job.leave(self)

    def _run(self, work: MakeReport, noun: str, control: str, progress: ReportProgress) -> None:
        cancel = f"Press “{control}” again to cancel."
        notification = self._client.add_notification(f"Making a {noun}", cancel, loading=True, auto_close_seconds=None)

        def on_progress(done: int, total: int, what: str = "done") -> None:
            progress(done, total)
            notification.body = f"{done:,} of {total:,} {what}. {cancel}"
            self._on_progress(done, total)

        try:
            name, contents = work(on_progress, self._model)
        except Exception as error:
            text = f"{type(error).__name__}: the details are in the server's log."
            if isinstance(error, WorkCancelledError):
                text = f"The {noun} was cancelled."
            elif isinstance(error, LPNError):
                text = printable(str(error), TYPED)
            notification.title, notification.body, notification.loading = f"No {noun}", text, False
            raise
        finally:
            self._on_progress(0, 0)
        # The page may ignore a removal that follows an update at once, so the notification closes by itself.
        notification.title, notification.body = f"The {noun} is made", f"The browser saves {name}."
        notification.loading, notification.auto_close_seconds = False, _TOLD
        self._client.send_file_download(name, contents, save_immediately=True)
