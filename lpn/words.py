"""The sentences that say what figures mean."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lpn.explain import Evidence, Exact
from lpn.spec import View

_SIDES = ("right", "upper right", "top", "upper left", "left", "lower left", "bottom", "lower right")
_COMPASS = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")
_ONE_SIDED = 0.25
"""How far the middle of some cells must be off the picture's, as a share of their mean distance from it."""


def ordinal(rank: int) -> str:
    """1st, 2nd, 3rd, 4th, ..."""
    suffix = "th" if 10 <= rank % 100 <= 20 else {1: "st", 2: "nd", 3: "rd"}.get(rank % 10, "th")
    return f"{rank}{suffix}"


def where(cells: Exact, view: View) -> str:
    """Where in a picture the cells (h, w) above zero lie: "upper right" or, on a satellite tile, "north-east".

    "all around" where they lie on no side more than on others.
    """
    weights = np.maximum(cells, 0.0)
    height, width = cells.shape
    up = 0.5 - (np.arange(height)[:, None] + 0.5) / height
    right = (np.arange(width)[None, :] + 0.5) / width - 0.5
    total = float((weights * np.hypot(up, right)).sum())
    east, north = float((weights * right).sum()), float((weights * up).sum())
    if total <= 0 or np.hypot(east, north) < _ONE_SIDED * total:
        return "all around"
    sector = round(np.degrees(np.arctan2(north, east)) / 45) % 8
    return (_COMPASS if view == "satellite" else _SIDES)[sector]


def why(found: Evidence, names: Sequence[str], query_view: View, tile_view: View) -> str:
    """One sentence on what a pair's score comes from."""
    added = found.contributions
    most = int(np.argmax(added))
    here, there = where(found.query.cells[most], query_view), where(found.tile.cells[most], tile_view)
    around = here == there == "all around"
    places = "all over it" if around else f"where {_of('query', here)} agrees with {_of('tile', there)}"
    said = f"Part {names[most]} adds most to the score ({added[most]:+.3f} of {found.score:.3f}), {places}."
    least = int(np.argmin(added))
    if added[least] < 0:
        said += f" Part {names[least]} speaks against the pair ({added[least]:+.3f})."
    return said


def _of(picture: str, place: str) -> str:
    return f"all of the {picture}" if place == "all around" else f"the {picture}'s {place}"
