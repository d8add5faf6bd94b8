"""A story as one HTML file: a report on the answers of its steps, each below its caption, without a network."""

from __future__ import annotations

import math
from collections.abc import Callable

from explorer import judge, session_state
from explorer.compute.request_context import QueuedModel
from explorer.reports import safe_file_name
from explorer.session_state import SessionState
from explorer.stage.cards import SHOWN
from explorer.stories.story import Story
from explorer.url_state import UrlState
from explorer.workspace import StateAnalyser, StateAnalysis, Workspace
from lpn import report
from lpn.core.errors import InputError


def export(
    workspace: Workspace,
    url_state: UrlState,
    whole: Story,
    progress: Callable[[int, int], None] | None = None,
    model: QueuedModel | None = None,
) -> tuple[str, bytes]:
    """Write a story as a file that needs no server: (name, UTF-8 HTML), about 0.2 MB a step. Notes are left out.

    A step takes three forward passes at most. It has the answer that it shows, and no map, table, or flight.

    Args:
        progress: called after each step with the numbers of finished and of all steps; what it raises ends the work.
        model: describes pictures; by default the workspace's.

    Raises:
        InputError: when a step shows what is not in the data set, or there is none.
        LPNError: when a picture cannot be read.
    """
    analyser = StateAnalyser(workspace, model, cancellable=False)
    answers, captions = [], []
    for number, step in enumerate(whole.steps, 1):
        state = SessionState(next(iter(workspace.tasks)), workspace.contract.n_parts, query=workspace.first_query)
        state, problems = url_state.read(step.shows, state)
        if problems:
            raise InputError(f"Step {number} of {whole.name!r} cannot be shown: {' '.join(problems)}")
        analysis = analyser.analyse(workspace.supported_state(state), SHOWN)
        answers.append(analysis if judge.is_sure(analysis, workspace) else analysis.ungraded())
        captions.append([step.caption, *_remarks(analysis, workspace)])
    options = report.Options(title=whole.name, captions=captions)
    task = next(iter(workspace.tasks.values()))
    return f"{safe_file_name(whole.name)}.html", report.build(task, answers, options, progress)


def _remarks(analysis: StateAnalysis, workspace: Workspace) -> list[str]:
    """Say what alters the answer of a step, and what of the step the file does not have."""
    state = analysis.state
    altered = session_state.alterations(state, math.prod(workspace.map_sizes[analysis.task.query_view])).values()
    flown = state.flight and workspace.has_flight and not state.why
    shown = "all pictures in a table" if state.lab else "the flight over its map" if flown else "the map"
    lost = f"The app shows {shown} here, which this file does not have." if state.lab or flown or state.map else ""
    return [*([f"Altered by: {', '.join(altered)}."] if altered else []), *([lost] if lost else [])]
