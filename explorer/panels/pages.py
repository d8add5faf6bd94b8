"""HTML of both panels, from the templates in `explorer/web/templates/panels`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

from explorer import judge, session_state
from explorer.compute import scorings
from explorer.compute.background_jobs import BackgroundJob
from explorer.panels import answer_text
from explorer.panels.radius_text import with_radius
from explorer.stage import pair_picture
from explorer.web.render import render
from explorer.workspace import StateAnalysis, Workspace
from lpn.drawing import overlays, verdicts, words
from lpn.tasks.task import Task

_SCALE = 90, 8  # width and height of the heatmap legend's colours in pixels
HEAT_NOTE = (
    "Activation (channel sum of the last feature map) belongs to one picture. Evidence belongs to the pair: "
    "orange raises its score, violet lowers it."
)
SHIFT_NOTE = (
    "Shifts are in pixels of the network's input and follow the rotation. LPN assumes that the target is in the middle."
)
WEATHER_NOTE = "Weathers of University-WX, drawn on the query before it is rotated. Strength 1 is the benchmark's."
SAVED_NOTE = (
    "These are descriptors without their network: queries cannot be rotated or uploaded, and there are no heatmaps."
)
RINGS_NOTE = "Rings are drawn as published."
ARRAYS_NOTE = "Plain arrays do not say where a part lies in a picture."
PARTS_NOTE = (
    "Switch parts off or weight them: the ranking follows at once, and the figures of the whole task stand below."
)


class ShownAnalysis(NamedTuple):
    """The analysis that a page shows, and its sequence number."""

    analysis: StateAnalysis
    sequence: int


def hidden(ids: Sequence[str]) -> str:
    """Return a style that hides viser buttons by uuid; html of the page clicks them."""
    return render("panels/hidden_buttons", ids=ids)


def main_button(button: str) -> str:
    """Return a style that draws a viser button, given by its uuid, as the one that stands out."""
    return render("panels/main_button", id=button)


def note(text: str, element_id: str = "") -> str:
    """Return a line of dimmed text."""
    return render("panels/note", text=text, id=element_id)


def keys(workspace: Workspace) -> str:
    """Return the list of keyboard shortcuts."""
    return render(
        "panels/keys",
        flight=workspace.has_flight,
        parts=f"{workspace.contract.part_noun}s" if workspace.has_parts else "",
        network=workspace.model is not None,
        cells=not workspace.without_cells,
    )


def heat_legend(analysis: StateAnalysis, workspace: Workspace) -> str:
    """Return the legend of the heatmap over the stage's pair; empty without one."""
    kind, part = pair_picture.heat_kind(analysis), analysis.state.heat_part
    if kind is None or analysis.state.first_screen or analysis.state.flight or analysis.state.shows_reasons:
        return ""
    scale = overlays.evidence_scale if kind == "evidence" else overlays.heat_scale
    of = "," if words.plain() else " of"
    of_part = "" if part is None else f"{of} {words.say('part')} {workspace.part_names[part]}"
    return render("panels/heat_legend", kind=kind, of_part=of_part, scale=overlays.data_uri(scale(*_SCALE), 95))


def header(workspace: Workspace, task: Task, preparing: BackgroundJob[None] | None = None, own: bool = False) -> str:
    """Return the title: model, data set, task, and its metrics, or the progress of their ranking.

    Args:
        preparing: the preparation of a scoring that the page waits for.
        own: an own picture is shown, for which the metrics of the task do not stand.
    """
    ranking = workspace.rankings[task.key]
    return render(
        "panels/header",
        workspace=workspace,
        task=task,
        pictures=verdicts.pictures_of(task),
        results=workspace.results(ranking),
        done=ranking.n_ranked,
        error=ranking.error,
        scorings=scorings.choices(workspace.rankings, task.name),
        no_scorings=workspace.scorings.why_not,
        preparing=preparing,
        own=own,
        no_link=answer_text.NO_LINK if own else "",
    )


def verdict(analysis: StateAnalysis, workspace: Workspace) -> str:
    """Return the analysis in words."""
    right, headline, reason = answer_text.verdict(analysis, workspace)
    look, concluded = answer_text.flight_verdict(analysis, workspace, answer_text.plain_verdict(analysis, workspace))
    if words.plain() and concluded is not None:
        right, headline, reason = look
    if not judge.is_sure(analysis, workspace):
        right = None
    registered = workspace.details(analysis)
    all_parts_off = not analysis.state.parts_left()
    note = analysis.query_note
    if registered is not None and registered.accepted:  # the turn that the search tried would look like another heading
        note = "" if words.plain() else f"{note}; by its registration {registered.heading or 0:.0f}°" if note else ""
    return render(
        "panels/verdict",
        doubted=concluded is not None and concluded[0] is None and registered is not None and registered.accepted,
        verdict=right,
        headline=headline,
        reason=with_radius(reason, registered, workspace),
        concluded=None if concluded is None else (concluded[0], with_radius(concluded[1], registered, workspace)),
        comparing="" if analysis.own_photo is None else answer_text.comparing(analysis.own_photo),
        alone=workspace.has_flight and analysis.state.upload is None,
        note=" ".join(
            filter(
                None, (f"The {words.say('query')}: {note}." if note else "", answer_text.own_shape(analysis, workspace))
            )
        ),
        all_parts_off=all_parts_off,
        alterations=session_state.alterations(analysis.state, math.prod(workspace.map_sizes[analysis.task.query_view])),
    )


def status(last: ShownAnalysis | None, waiting: Literal["", "computing", "full"] = "") -> str:
    """Return the status line; its attributes identify the state that the page shows.

    Args:
        last: what the page shows; None before the first analysis.
        waiting: "computing" while the next analysis is computed, "full" while the server is busy and the page retries.
    """
    return render("panels/status", last=last, waiting=waiting)


def matches(analysis: StateAnalysis, workspace: Workspace, buttons: Sequence[str]) -> str:
    """Return the ranked tiles as rows: picture, rank, sign, name, error, distance, gap, and the parts' shares.

    A positive of a lower rank is appended as a further row, which uses the last button.
    """
    analysis = judge.shown(analysis, workspace)
    positive, own = analysis.positive, analysis.registered
    below = positive if positive is not None and positive.rank > len(analysis.matches) else None
    full = max(match.distance2 for match in (*analysis.matches, *([below] if below else [])))
    return render(
        "panels/matches",
        rows=list(zip(analysis.matches, buttons, strict=False)),
        below=below,
        right=judge.judged_piece(analysis, workspace) or f"the {words.say('positive')}",
        last_button=buttons[-1],
        full=max(full, 1e-9),
        gallery=analysis.task.gallery,
        chosen=analysis.chosen.index,
        # Where details place an own picture, the distance of its tag from a piece tells nothing more.
        errors_m=None if own is not None and own.answer.accepted else analysis.errors_m,
        part_names=workspace.part_names,
        several=workspace.has_parts,
        thumbnail=workspace.thumbnail,
    )


def parts_table(analysis: StateAnalysis, workspace: Workspace) -> str:
    """Return the compared pair part by part; the shares add up to the distance."""
    chosen, weights = analysis.chosen, analysis.ranking.weights
    terms = [-constant for constant in chosen.constants or ()]
    return render(
        "panels/parts_table",
        chosen=chosen,
        taken=verdicts.rounded_cosines((chosen.cosines * weights).tolist(), terms)[1],
        weights=weights,
        part_names=workspace.part_names,
        claim=analysis.task.contract.claim,
    )
