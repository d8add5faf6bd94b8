"""Files about the screen's contents: the report of one answer or of the worst ones, and a paper's figure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from explorer.compute.background_jobs import ReportProgress
from explorer.screen.panel import Tab
from explorer.screen.rail import listed_queries
from explorer.screen.result import ScreenResult
from explorer.workspace import Workspace
from lpn import report
from lpn.core.arrays import Float32Array
from lpn.core.demo import own_file
from lpn.core.errors import InputError, LPNError
from lpn.library.answer import Answer
from lpn.models.base import Model
from lpn.tasks import notes
from lpn.tasks.task import Task

# Queries of the report of the worst answers.
_WORST = 30


def save_answer(tab: Tab) -> None:
    """Have the browser save a report of the shown answer."""
    shown, model = _shown(tab)

    def make(progress: ReportProgress) -> tuple[str, bytes]:
        workspace, answer = shown.workspace, reported(shown.workspace, shown.analysis, model)
        options = report.Options(change=shown.question.change, doubtful=_doubtful(workspace, answer.task))
        task = _noted(tab, workspace, answer.task, model, answer.ranking.weights)
        return f"{file_name(answer.name)}.html", report.build(task, [answer], options, progress)

    tab.download("Report", make)


def save_worst(tab: Tab) -> None:
    """Have the browser save a report of the worst missed queries; the rail's search does not narrow them."""
    workspace, ranking = tab.workspace, tab.ranking
    if ranking.result is None:
        raise InputError("The photos are still being ranked; ask for their report when that is done.")
    queries = listed_queries(replace(tab.state, filter="missed", find=""), workspace, ranking)[:_WORST].tolist()
    if not queries:
        raise InputError("No photo is missed, so there is nothing to report; save an answer instead.")
    model = tab.background.queued(workspace.model, background=True)
    options = report.Options(selection="the worst failures", doubtful=_doubtful(workspace, ranking.task))

    def make(progress: ReportProgress) -> tuple[str, bytes]:
        task = _noted(tab, workspace, ranking.task, model)
        return f"{file_name(task.name)}-failures.html", report.build(task, queries, options, progress)

    tab.download("Report", make)


def save_figure(tab: Tab) -> None:
    """Have the browser save the shown answer as a paper's figure, as wide as a page."""
    shown, model = _shown(tab)

    def make(_: ReportProgress) -> tuple[str, bytes]:
        answer = reported(shown.workspace, shown.analysis, model)
        return f"{file_name(answer.name)}.pdf", answer.paper_figure().encode("pdf")

    tab.download("Figure", make)


def reported(workspace: Workspace, answer: Answer, model: Model | None = None) -> Answer:
    """Return an answer for a report: without a grade if the screen does not count it; `model` describes its further tiles."""
    index, ranking = answer.index, workspace.rankings[answer.task.key]
    if index is not None and ranking.result is not None and not workspace.graded(ranking)[index]:
        answer = answer.ungraded()
    scored = None if model is None else workspace.scored_model(model, answer.task)
    return replace(answer, describe_tile=lambda task, index: workspace.tile(task, index, scored))


def _shown(tab: Tab) -> tuple[ScreenResult, Model | None]:
    """Return the shown answer, and the model that describes its workspace's pictures in the background."""
    if tab.result is None:
        raise InputError("There is no answer yet; wait until its numbers stand there, and save it then.")
    return tab.result, tab.background.queued(tab.result.workspace.model, background=True)


def file_name(name: str) -> str:
    """Return the start of a file name that is valid on any system."""
    return "".join(letter if letter.isalnum() or letter in "-_" else "-" for letter in name)[:60] or "report"


def _noted(
    tab: Tab, workspace: Workspace, task: Task, model: Model | None, weights: Float32Array | None = None
) -> Task:
    """Return the task with part weights, the model that describes pictures, and the user's notes if they are readable."""
    bound = None if model is None else workspace.scored_model(model, task).for_task(*task.views)
    try:
        stored = notes.read_notes(own_file(workspace.root, notes.NAME))
    except LPNError as error:  # a report is useful without notes
        tab.note(f"Notes are left out: {error}")
        stored = {}
    return replace(task, model=bound, weights=weights, notes=stored)


def _doubtful(workspace: Workspace, task: Task) -> set[int]:
    doubtful = workspace.doubtful(workspace.rankings[task.key])
    return set() if doubtful is None else set(np.flatnonzero(doubtful).tolist())
