"""The turn by which tiles lie like the query, so that a person sees that the two match."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from lpn.core.numbers import wrap_degrees
from lpn.datasets.geo import Position
from lpn.explain.relative_turn import relative_turn
from lpn.library.answer import Answer


@dataclass(frozen=True)
class MatchingTurn:
    """A turn of the tiles of an answer.

    Attributes:
        degrees: counter-clockwise, above -180 up to 180.
        source: what tells it: the headings of both pictures, the registration of a photo, or the model's maps of the two.
    """

    degrees: float
    source: Literal["heading", "registration", "model"]


def matching_turn(answer: Answer, query: int | None, turned: float, registered: float | None) -> MatchingTurn | None:
    """Return the turn at which the compared tile lies like the query as it is shown.

    Args:
        query: its position among the task's queries; None for the user's own picture, whose heading is not known.
        turned: degrees counter-clockwise by which the query is shown turned.
        registered: the heading of the query's picture, before `turned`, by a registration; None without one.

    Returns:
        None where a picture is no square seen from above, and where nothing tells the turn.
    """
    task = answer.task
    if "street" in task.views or any(task.contract.unrolled(view) for view in task.views):
        return None
    if registered is not None:
        return MatchingTurn(wrap_degrees(registered + turned), "registration")
    places = task.geometry
    if places is not None and query is not None:
        of_query = _heading(places.queries[query], task.query_view)
        of_tile = _heading(places.tiles[answer.chosen.index], task.gallery_view)
        if of_query is not None and of_tile is not None:
            return MatchingTurn(wrap_degrees(of_query - of_tile + turned), "heading")
    if answer.query.trace is None or answer.tile is None or answer.tile.trace is None:
        return None
    by_model = relative_turn(answer.query.trace, answer.tile.trace)
    return None if by_model is None else MatchingTurn(float(wrap_degrees(by_model)), "model")


def _heading(place: Position | None, view: str) -> float | None:
    """Return a picture's heading; a satellite's is north unless its position says another."""
    heading = None if place is None else place.heading
    return 0.0 if heading is None and view == "satellite" else heading
