"""A story as one HTML file: each step drawn as a slide, its pictures inside, and no network."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from explorer import judge, session_state
from explorer.compute.request_context import QueuedModel
from explorer.panels import answer_text
from explorer.reports import safe_file_name
from explorer.session_state import SessionState
from explorer.stage import pair_picture
from explorer.stage.cards import SHOWN
from explorer.stories.story import Step, Story
from explorer.url_state import UrlState
from explorer.web import style
from explorer.web.render import render
from explorer.workspace import StateAnalyser, StateAnalysis, Workspace
from lpn.core.errors import InputError
from lpn.core.files import TYPED, printable
from lpn.drawing import charts, overlays, verdicts
from lpn.retrieval import Match

_WEB = Path(__file__).parents[1] / "web"
# Ranked tiles below a slide.
_RANKED = 5


@dataclass(frozen=True, eq=False)
class Slide:
    """A step as the file shows it.

    Attributes:
        pictures: of query and compared tile, as the stage draws them.
        evidence: one sentence, where the step shows the explain window.
        bars: its bars, one for each part.
        lost: one sentence on what of the step is not drawn; empty if all is.
        ranked: the nearest tiles: match, name, thumbnail, and metres that it is off, None if unknown.
    """

    step: Step
    analysis: StateAnalysis
    right: bool | None
    headline: str
    reason: str
    altered: list[str]
    pictures: tuple[str, str]
    evidence: str
    bars: list[Markup]
    lost: str
    ranked: list[tuple[Match, str, str, float | None]]


def export(
    workspace: Workspace,
    url_state: UrlState,
    whole: Story,
    dark: bool,
    progress: Callable[[int, int], None] | None = None,
    model: QueuedModel | None = None,
) -> tuple[str, bytes]:
    """Draw a story as a file that needs no server: (name, UTF-8 HTML), about 0.2 MB a step. Notes are left out.

    A step takes two forward passes at most. It has the pair that it compares, and no map, table, or flight.

    Args:
        progress: called after each step with the numbers of finished and of all steps; what it raises ends the work.
        model: describes pictures; by default the workspace's.

    Raises:
        InputError: when a step shows what is not in the data set.
        LPNError: when a picture cannot be read.
    """
    analyser = StateAnalyser(workspace, model, cancellable=False)
    slides = []
    for number, step in enumerate(whole.steps, 1):
        state = SessionState(next(iter(workspace.tasks)), workspace.contract.n_parts, query=workspace.first_query)
        state, problems = url_state.read(step.shows, state)
        if problems:
            raise InputError(f"Step {number} of {whole.name!r} cannot be shown: {' '.join(problems)}")
        analysis = analyser.analyse(workspace.supported_state(state), SHOWN)
        slides.append(_slide(workspace, step, analysis))
        if progress is not None:
            progress(number, len(whole.steps))
    page = render(
        "stories/exported",
        story=whole,
        slides=slides,
        part_names=workspace.part_names,
        stacked=workspace.layout.stacked,
        data_name=workspace.data_name,
        model_name=workspace.model_name,
        scheme="dark" if dark else "light",
        style=Markup(style.variables(dark) + charts.STYLE + _read("css/exported_story.css")),
        script=Markup(_read("js/exported_story.js")),
    )
    return f"{safe_file_name(whole.name)}.html", printable(page, TYPED).encode()


def _slide(workspace: Workspace, step: Step, analysis: StateAnalysis) -> Slide:
    state, task = analysis.state, analysis.task
    right, headline, reason = answer_text.verdict(analysis, workspace)
    cells = math.prod(workspace.map_sizes[task.query_view])
    analysis = judge.shown(analysis, workspace)
    pair = analysis.pair_evidence
    explained = pair.evidence if pair is not None and state.why else None
    sides = enumerate(zip(task.views, (analysis.query, analysis.tile), strict=True))
    query, tile = (
        overlays.data_uri(pair_picture.draw(workspace, analysis, side, workspace.areas(view, described)), 88)
        for side, (view, described) in sides
    )
    return Slide(
        step,
        analysis,
        right,
        headline,
        reason,
        list(session_state.alterations(state, cells).values()),
        (query, tile),
        "" if explained is None else verdicts.describe_evidence(explained, workspace.part_names, *task.views),
        [] if explained is None else charts.evidence_bars(explained, charts.evidence_span([explained])),
        _lost(state, workspace),
        [_ranked(workspace, analysis, match) for match in analysis.matches[:_RANKED]],
    )


def _lost(state: SessionState, workspace: Workspace) -> str:
    """Say what of a step the file does not have; empty if it has all."""
    flown = state.flight and workspace.has_flight and not state.why
    shown = "all pictures in a table" if state.lab else "the flight over its map" if flown else "the map"
    return f"The app shows {shown} here, which this file does not have." if state.lab or flown or state.map else ""


def _ranked(workspace: Workspace, analysis: StateAnalysis, match: Match) -> tuple[Match, str, str, float | None]:
    tile = analysis.task.gallery[match.index]
    off = math.nan if analysis.errors_m is None else float(analysis.errors_m[match.index])
    return match, tile.title, workspace.thumbnail(tile), off if np.isfinite(off) else None


def _read(name: str) -> str:
    return (_WEB / name).read_text("utf-8")
