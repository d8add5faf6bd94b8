"""HTML of both panels, from the templates in `explorer/web/templates/panels`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

from explorer.panels import answer_text
from explorer.web.render import render
from explorer.workspace import StateAnalysis, Workspace
from lpn.analysis.task import Task

HEAT_NOTE = (
    "Activation (channel sum of the last feature map) belongs to one picture. Evidence belongs to the pair: "
    "orange adds to its score, violet takes."
)
SHIFT_NOTE = "In pixels of the network's input, after turning. LPN assumes that the target is in the middle."
SAVED_NOTE = (
    "A saved result without its network: queries cannot be turned or replaced by your own, and there are no heatmaps. "
    "Rings are drawn as published."
)
PARTS_NOTE = (
    "Switch parts off or weight them: the ranking follows at once. R@1 at the top right stays that of all parts alike."
)


class ShownAnalysis(NamedTuple):
    """The analysis that a page shows, its sequence number, and the seconds that drawing it took."""

    analysis: StateAnalysis
    sequence: int
    drawing: float


def hidden(ids: Sequence[str]) -> str:
    """Return a style that hides viser buttons, given by their uuids, which only html presses."""
    return render("panels/hidden_buttons", ids=ids)


def note(text: str, element_id: str = "") -> str:
    """Return a line of dimmed text."""
    return render("panels/note", text=text, id=element_id)


def keys() -> str:
    """Return the list of keyboard shortcuts."""
    return render("panels/keys")


def header(workspace: Workspace, task: Task) -> str:
    """Return the title: model, data set, task, and its metrics, or how far the ranking is that yields them."""
    ranking = workspace.rankings[task.name]
    return render(
        "panels/header",
        workspace=workspace,
        task=task,
        results=None if ranking.result is None else ranking.results,
        done=ranking.n_ranked,
        error=ranking.error,
    )


def verdict(analysis: StateAnalysis, workspace: Workspace) -> str:
    """Return the analysis in words."""
    right, headline, reason = answer_text.verdict(analysis, workspace.part_names)
    all_parts_off = not analysis.state.parts_left()
    return render("panels/verdict", verdict=right, headline=headline, reason=reason, all_parts_off=all_parts_off)


def status(shown: ShownAnalysis | None, waiting: Literal["", "computing", "full"] = "") -> str:
    """Return the status line; its attributes say which state the page shows.

    Args:
        shown: what the page shows; None before the first analysis.
        waiting: "computing" while the next analysis is computed, "full" when the server is busy and the page asks again.
    """
    return render("panels/status", shown=shown, waiting=waiting)


def matches(analysis: StateAnalysis, workspace: Workspace, buttons: Sequence[str]) -> str:
    """Return the ranked tiles as rows: picture, rank, sign, name, error, distance, gap, and the parts' shares.

    A positive below them gets a row of its own, whose button is the last.
    """
    positive = analysis.positive
    below = positive if positive is not None and positive.rank > len(analysis.matches) else None
    full = max(match.distance2 for match in (*analysis.matches, *([below] if below else [])))
    return render(
        "panels/matches",
        rows=list(zip(analysis.matches, buttons, strict=False)),
        below=below,
        last_button=buttons[-1],
        full=max(full, 1e-9),
        gallery=analysis.task.gallery,
        chosen=analysis.chosen.index,
        errors_m=analysis.errors_m,
        part_names=workspace.part_names,
        thumbnail=workspace.thumbnail,
    )


def parts_table(analysis: StateAnalysis, workspace: Workspace) -> str:
    """Return the compared pair part by part; the shares add up to the distance."""
    return render(
        "panels/parts_table",
        chosen=analysis.chosen,
        weights=analysis.ranking.weights,
        part_names=workspace.part_names,
    )


def picker(
    workspace: Workspace,
    task: Task,
    shown: Sequence[int],
    query: int | None,
    page: int,
    pages: int,
    buttons: Sequence[str],
) -> str:
    """Return the thumbnails of one page of queries; the last two buttons turn the page."""
    ranking = workspace.rankings[task.name]
    ranks = None if ranking.result is None else ranking.ranks
    queries = [(index, None if ranks is None else bool(ranks[index] == 0)) for index in shown]
    return render(
        "panels/picker",
        task=task,
        queries=queries,
        chosen=query,
        page=page,
        pages=pages,
        buttons=buttons,
        thumbnail=workspace.thumbnail,
    )
