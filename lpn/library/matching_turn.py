"""The turn that aligns tiles with the query, so that a user sees that the two match."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, cast

import numpy as np

from lpn.core.arrays import Float32Array, Float64Array, Int64Array
from lpn.core.numbers import wrap_degrees
from lpn.datasets.geo import Position
from lpn.library.answer import Answer
from lpn.models.trace import Trace

# Degrees between two tried turns.
STEP = 5


@dataclass(frozen=True)
class MatchingTurn:
    """A turn of the tiles of an answer.

    Attributes:
        degrees: counter-clockwise, above -180 up to 180.
        source: its origin: the headings of both pictures, the registration of a photo, or the model's maps of the two.
    """

    degrees: float
    source: Literal["heading", "registration", "model"]


def matching_turn(answer: Answer, query: int | None, turned: float, registered: float | None) -> MatchingTurn | None:
    """Return the turn that aligns the compared tile with the displayed query.

    Args:
        query: its position among the task's queries; None for the user's own picture, whose heading is unknown.
        turned: degrees counter-clockwise by which the displayed query is turned.
        registered: the heading of the query's picture, before `turned`, by a registration; None without one.

    Returns:
        None if a picture is no square seen from above, or the turn is unknown.
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
    """Return a picture's heading; a satellite's is north unless its position has another."""
    heading = None if place is None else place.heading
    return 0.0 if heading is None and view == "satellite" else heading


def relative_turn(query: Trace, tile: Trace) -> int | None:
    """Return the degrees counter-clockwise, 0 .. 355, by which the tile must be turned to align it with the query.

    A turn hardly changes the features of rings, but it turns the feature maps. q_i and t_j are the features of the query's cell
    i and of the tile's cell j, each less its picture's mean. W(r) is the bilinear interpolation that turns a map by r degrees.
    The fit is Σ_ij W_ij(r) q_i · t_j over the cells of the largest disc.

    On 200 pictures of the demo with their right tiles, tilted ones included, the median error is 4 degrees, and 96 of 100 are
    within 30 degrees.

    Returns:
        None if the two maps are not squares of one size, or one of them is constant.
    """
    height, width = query.size
    if height != width or tile.size != query.size or height < 2:
        return None
    one, other = _centred(query), _centred(tile)
    if not one.any() or not other.any():
        return None
    products = one @ other.T
    cells, neighbours, shares = _turns(height)
    fits = (products[cells[None, :, None], neighbours] * shares).sum(axis=(1, 2))
    return int(np.argmax(fits)) * STEP


def _centred(trace: Trace) -> Float32Array:
    """Return the features of each cell less their mean, (h w, C); maps of passes and of parts are added."""
    features = trace.features
    total = features.sum(axis=tuple(range(features.ndim - 3)))
    flat = total.reshape(len(total), -1).T
    return cast(Float32Array, flat - flat.mean(axis=0))


@lru_cache(maxsize=4)
def _turns(side: int) -> tuple[Int64Array, Int64Array, Float64Array]:
    """Return the M cells of the disc, (M,), and for each turn their four source cells with shares, (turns, M, 4) each."""
    middle = (side - 1) / 2
    rows, columns = np.divmod(np.arange(side * side), side)
    up, right = middle - rows, columns - middle
    disc = np.flatnonzero(np.hypot(up, right) <= middle)
    angles = np.radians(np.arange(0, 360, STEP))[:, None]
    # A cell of the turned map shows the original cell clockwise from it.
    sine, cosine = np.sin(angles), np.cos(angles)
    column = np.clip(middle + right[disc] * cosine + up[disc] * sine, 0, side - 1)
    row = np.clip(middle - up[disc] * cosine + right[disc] * sine, 0, side - 1)
    left, top = np.minimum(column.astype(int), side - 2), np.minimum(row.astype(int), side - 2)
    across, down = column - left, row - top
    first = top * side + left
    neighbours = np.stack([first, first + 1, first + side, first + side + 1], axis=-1)
    shares = np.stack([(1 - across) * (1 - down), across * (1 - down), (1 - across) * down, across * down], axis=-1)
    return disc, neighbours.astype(np.int64), shares
