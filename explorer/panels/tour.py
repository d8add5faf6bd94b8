"""The steps of the tour: a card of text, and the element or the part of the stage that it is about."""

from __future__ import annotations

from dataclasses import dataclass

from explorer.layout import Layout, Point
from explorer.web.render import render
from explorer.workspace import Workspace


@dataclass(frozen=True)
class TourStep:
    """One card of the tour.

    Attributes:
        html: title, text, and a sentence for users with a keyboard.
        selectors: elements of the page that the card is about; the first visible one counts.
        box: left, lower, right, and upper border of the card's subject on the stage, in stage units; None if it has none.
    """

    html: str
    selectors: tuple[str, ...] = ()
    box: tuple[float, float, float, float] | None = None


def steps(workspace: Workspace) -> list[TourStep]:
    """Return the five steps for a model and data set; they do not mention what these lack."""
    layout, task = workspace.layout, next(iter(workspace.tasks.values()))

    def html(step: str) -> str:
        return render(
            "tour_step",
            step=step,
            query_view=task.query_view,
            rings=workspace.parts_word == "rings",
            cells=workspace.contract.has_cells,
            live=workspace.model is not None,
            mapped=task.geometry is not None,
        )

    return [
        TourStep(html("query"), box=_box(layout.query, layout.picture)),
        TourStep(html("parts"), box=_box(*layout.gutter)),
        TourStep(html("ranking"), selectors=("#lpn-matches",), box=_cards(layout)),
        TourStep(html("verdict"), selectors=("#lpn-verdict",)),
        TourStep(html("controls"), selectors=("#lpn-header .tools",)),
    ]


def _box(centre: Point, size: Point) -> tuple[float, float, float, float]:
    return centre[0] - size[0] / 2, centre[1] - size[1] / 2, centre[0] + size[0] / 2, centre[1] + size[1] / 2


def _cards(layout: Layout) -> tuple[float, float, float, float]:
    half = layout.columns * layout.step[0] / 2
    return -half, layout.cards_top - layout.step[1], half, layout.cards_top
