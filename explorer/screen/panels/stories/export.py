"""A story as one page that needs no server: a report of its steps' answers, each below its caption."""

from __future__ import annotations

from explorer.compute.background_jobs import ReportProgress
from explorer.screen import fields
from explorer.screen.fields import ScreenState
from explorer.screen.panel import Tab
from explorer.screen.panels.report.pages import file_name, reported
from explorer.screen.panels.stories.story import Story
from explorer.screen.result import STRIP
from explorer.workspace import Workspace, WorkspaceAnalyser
from lpn import report
from lpn.core.errors import InputError
from lpn.library.answer import Answer


def save_story(tab: Tab, story: Story) -> None:
    """Have the browser save a story; its notes are left out.

    Raises:
        InputError: when the story has no step, or a step shows something that no longer exists.
    """
    if not story.steps:
        raise InputError("The story has no step yet; press S to keep this page as the first step.")
    base, context = tab.base, tab.background
    shown = [_state(base, step.shows, number) for number, step in enumerate(story.steps, 1)]

    def make(progress: ReportProgress) -> tuple[str, bytes]:
        answers: list[Answer] = []
        for workspace, state in shown:
            model = context.queued(workspace.model, background=True)
            task = workspace.ranking(state.task, state.scoring).task
            answer = WorkspaceAnalyser(workspace, model, cancellable=False).analyse(task, state.question(), STRIP)
            answers.append(reported(workspace, answer, model))
            progress(len(answers), 2 * len(shown))
        captions = [[step.caption, *_remarks(*one)] for step, one in zip(story.steps, shown, strict=True)]
        options = report.Options(title=story.name, captions=captions)
        page = report.build(answers[0].task, answers, options, lambda done, total: progress(total + done, 2 * total))
        return f"{file_name(story.name)}.html", page

    tab.download("Story", make)


def _state(base: Workspace, shows: str, number: int) -> tuple[Workspace, ScreenState]:
    """Return the state of a step, and the workspace of its place and model."""
    given = fields.parsed(shows)
    workspace = ({base.key: base} | dict(base.opened())).get(given.get("show", base.key))
    if workspace is None:
        raise InputError(f"Step {number} shows a place that is not open yet; open that step, then save the story.")
    state, problems = fields.from_values(given, workspace)
    if problems:
        raise InputError(f"Step {number} cannot be shown: {problems[0]} Remove the step, or add it again.")
    of_model = workspace.models[int(state.model)].workspace
    if of_model is None:
        raise InputError(f"Step {number} shows a model that is not open yet; open that step, then save the story.")
    return of_model, state


def _remarks(workspace: Workspace, state: ScreenState) -> list[str]:
    """List the settings of a step that differ from the defaults, and the panel that the file lacks."""
    weights = ", ".join(f"{weight:g}" for weight in state.weights)
    said = [
        f"Model: {workspace.model_name}." if state.model != "0" else "",
        f"The photo is turned by {state.angle:g}°." if state.angle else "",
        f"Weights of the {workspace.contract.part_noun}s: {weights}." if weights else "",
        "The app shows a panel here, which this file does not have." if state.panel else "",
    ]
    return [sentence for sentence in said if sentence]
