"""What a first visitor is told: five things, and where each is seen."""

from __future__ import annotations

from dataclasses import dataclass

from explorer.layout import Layout, Point
from explorer.workspace import Workspace


@dataclass(frozen=True)
class Step:
    """One card of the tour.

    Attributes:
        title, text: what it says; html of our own.
        keys: a sentence for who has a keyboard.
        selectors: of what it is about in the page, the first of them that is seen.
        box: left, lower, right, and upper border of what it is about on the stage, in stage units; None where none is.
    """

    title: str
    text: str
    keys: str = ""
    selectors: tuple[str, ...] = ()
    box: tuple[float, float, float, float] | None = None


def steps(workspace: Workspace) -> list[Step]:
    """The five steps for a model and data set; what these do not have is not spoken of."""
    layout, task = workspace.layout, next(iter(workspace.tasks.values()))
    live, mapped = workspace.model is not None, task.geometry is not None
    rings = workspace.spec.partition(task.query_view).kind == "rings" and workspace.spec.n_parts > 1
    parts = "square rings around the centre" if rings else "parts"
    query = Step(
        "A picture goes in",
        f"This {task.query_view} picture is the query: where was it taken? The panel <i>Query</i> has all of them"
        f"{', and takes one of your own' if live else ''}.",
        f"<kbd>N</kbd> takes the next one{'; <kbd>J</kbd> and <kbd>L</kbd> turn it' if live else ''}.",
        box=_box(layout.query, layout.picture),
    )
    ring = Step(
        "Part by part",
        f"Both pictures are divided into {parts}, and each part is compared with its counterpart. A bar is the part's share "
        "of the squared distance d²: the longer, the less they agree.",
        box=_box(*layout.gutter),
    )
    ranked = Step(
        "The ranking",
        "The nearest tiles, best first, with ✓ at the true place. Press one, here or on the stage, to compare it with "
        "the query. In the panel <i>Parts</i> you weight the parts, and the ranking follows.",
        selectors=("#lpn-matches",),
        box=_cards(layout),
    )
    why = Step(
        "Why this tile?",
        "This says which part decided."
        + (
            " <i>Why this tile?</i>, further down, shows the evidence cell by cell; it adds up to the score."
            if live
            else ""
        ),
        "<kbd>Y</kbd> opens it." if live else "",
        selectors=("#lpn-verdict",),
    )
    whole = "rings" if rings else "parts"
    more = Step(
        "Look around",
        f"Under <i>Look</i> you take the {whole} apart{' and see the map' if mapped else ''}. The list at the top has every "
        "command. <i>Link</i> copies an address that brings back what you see.",
        f"<kbd>X</kbd> {whole} apart{', <kbd>M</kbd> map' if mapped else ''}, <kbd>Ctrl K</kbd> every command.",
        selectors=("#lpn-header .tools",),
    )
    return [query, ring, ranked, why, more]


def _box(centre: Point, size: Point) -> tuple[float, float, float, float]:
    return centre[0] - size[0] / 2, centre[1] - size[1] / 2, centre[0] + size[0] / 2, centre[1] + size[1] / 2


def _cards(layout: Layout) -> tuple[float, float, float, float]:
    half = layout.columns * layout.step[0] / 2
    return -half, layout.cards_top - layout.step[1], half, layout.cards_top
