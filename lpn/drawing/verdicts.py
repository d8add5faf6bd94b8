"""The sentences that say what figures mean."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lpn.core.arrays import Float64Array, FloatingArray
from lpn.core.views import View
from lpn.explain import Evidence
from lpn.explain.counterfactual import Effect, Reweighting, Without
from lpn.explain.sweeps import Profile
from lpn.retrieval import Match

_SIDES = ("right", "upper right", "top", "upper left", "left", "lower left", "bottom", "lower right")
_COMPASS = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")
_ONE_SIDED = 0.25
"""How far the middle of some cells must be off the picture's, as a share of their mean distance from it."""


def ordinal(rank: int) -> str:
    """1st, 2nd, 3rd, 4th, ..."""
    suffix = "th" if 10 <= rank % 100 <= 20 else {1: "st", 2: "nd", 3: "rd"}.get(rank % 10, "th")
    return f"{rank}{suffix}"


def where(cells: Float64Array, view: View) -> str:
    """Where in a picture the cells (h, w) above zero lie: "upper right" or, on a satellite tile, "north-east".

    "all around" where they lie on no side more than on others. A tile that is unrolled, so wide, has no north at its top.
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
    return (_COMPASS if view == "satellite" and width < 2 * height else _SIDES)[sector]


def why(found: Evidence, names: Sequence[str], query_view: View, tile_view: View) -> str:
    """One sentence on what a pair's score comes from."""
    added = found.contributions
    most = int(np.argmax(added))
    here, there = where(found.query.cells[most], query_view), where(found.tile.cells[most], tile_view)
    constant = float(found.query.constants[most])
    around = here == there == "all around"
    places = "all over it" if around else f"where {_of('query', here)} agrees with {_of('tile', there)}"
    if constant > found.cosines[most] / 2:
        places = "most of it by a constant that comes from no cell"
    said = f"Part {names[most]} adds most to the score ({added[most]:+.3f} of {found.score:.3f}), {places}."
    constants = float(found.query.constants @ found.weights)
    if constants > found.score / 2 > 0:
        said += (
            f" Of the whole score {constants:+.3f} is constants: what the network takes both pictures for, rather than what they "
            "show."
        )
    least = int(np.argmin(added))
    if added[least] < 0:
        said += f" Part {names[least]} speaks against the pair ({added[least]:+.3f})."
    return said


def verdict(
    first: Match, truth: Match | None, rival: Match | None, part_names: Sequence[str], metres: float | None = None
) -> tuple[bool | None, str, str]:
    """Whether the top match is true, a headline, and one sentence that says why, for a query whose place is known.

    The part that decides is the one with the largest exact difference of shares of the squared distance.

    Args:
        first: the top match.
        truth: the nearest true match, None where the gallery has none.
        rival: the nearest tile that is not true, None where there is none to speak of.
        metres: how far the top match is from what the query shows, where that is known.
    """
    gap = f"the next tile is {first.gap:.3f} further away (d²)" if first.gap is not None else "there is no other tile"
    if truth is None:
        return None, "No true tile", "The gallery has no tile of this place, so no answer can be right."
    if truth.rank == 1:
        if rival is None:
            return True, "Found: the top match is true", f"No wrong tile is near; {gap}."
        part = int(np.argmax(rival.shares - truth.shares))
        gain = float(rival.shares[part] - truth.shares[part])
        ahead = rival.distance2 - truth.distance2
        return (
            True,
            "Found: the top match is true",
            f"It leads the best wrong tile by {ahead:.3f} (d²); part {part_names[part]} does most of it (+{gain:.3f}).",
        )
    part = int(np.argmax(truth.shares - first.shares))
    loss = float(truth.shares[part] - first.shares[part])
    behind = truth.distance2 - first.distance2
    off = "" if metres is None else f" The answer is {metres:,.0f} m off."
    return (
        False,
        f"Wrong: the true tile is {ordinal(truth.rank)}",
        f"It is {behind:.3f} (d²) behind the top match; part {part_names[part]} costs it most ({loss:+.3f}).{off}",
    )


def describe_margin(margin: FloatingArray, part_names: Sequence[str], name: str = "the true tile") -> str:
    """Say by how much a tile leads or trails another one, and which part decides it.

    Args:
        margin: each part's share of the margin in squared distance, (n,).
        name: of the tile.
    """
    total = float(margin.sum())
    name = f"{name[0].upper()}{name[1:]}"
    part = int(np.argmax(margin) if total >= 0 else np.argmin(margin))
    if total >= 0:
        return f"{name} leads by {total:.3f} (d²); part {part_names[part]} does most of it ({margin[part]:+.3f})."
    return f"{name} is {-total:.3f} (d²) behind; part {part_names[part]} costs it most ({margin[part]:+.3f})."


def left_out(found: Without, part_names: Sequence[str], who: str = "the true tile") -> str:
    """One sentence on which part, were it left out, would change the place of the truth, or of who is followed, most."""
    if found.now.rank == 1:
        lost = [i for i, one in enumerate(found.without) if one is not None and one.rank > 1]
        if not lost:
            return f"No single part is needed: without any one of them {who} stays first."
        worst = max(lost, key=lambda i: found.without[i].rank)  # type: ignore[union-attr]
        standing = found.without[worst]
        assert standing is not None
        more = f" ({len(lost)} of {len(found.without)} parts are needed)" if len(lost) > 1 else ""
        return f"Without part {part_names[worst]} {who} would fall to {ordinal(standing.rank)}{more}."
    if found.cure is not None:
        return f"Without part {part_names[found.cure]} {who} would be first."
    ranks = {i: one.rank for i, one in enumerate(found.without) if one is not None}
    said = "No single part is to blame alone"
    best = min(ranks, key=ranks.__getitem__, default=0)
    if ranks and ranks[best] < found.now.rank:
        said += f": at best, without part {part_names[best]}, {who} would be {ordinal(ranks[best])}"
    elif ranks:
        said += f": {who} ranks no better without any one of them"
    if found.best_alone is not None:
        said += f"; part {part_names[found.best_alone]} alone puts it first"
    return f"{said}."


def reweighted(change: Reweighting | None, effect: Effect | None) -> str:
    """One sentence on the smallest change of part weights that puts the truth first, and what it does to all queries."""
    if change is None:
        return "No choice of part weights would put the true tile first."
    shares = " : ".join(f"{100 * weight:.0f}" for weight in change.weights)
    said = f"The smallest change of part weights that puts the true tile first is {shares} %"
    if effect is None:
        return f"{said}."
    return f"{said}; {helps(effect)}."


def helps(effect: Effect) -> str:
    """What other part weights do to all queries, as the end of a sentence."""
    verb = "helps" if effect.helps else "harms" if len(effect.lost) > len(effect.gained) else "neither helps nor harms"
    return (
        f"over all {effect.queries:,} queries it {verb}: {len(effect.gained)} gained, {len(effect.lost)} lost, R@1 "
        f"{effect.before:.1f} to {effect.after:.1f} %"
    )


def turned(profile: Profile, views: tuple[View, View]) -> str:
    """What turning the query would change: where what is followed ranks best, and what the top score says.

    Args:
        views: of the query and of the tiles.
    """
    best = profile.best_rank
    who = "The true tile" if best.true else "The tile"
    now = profile.unchanged
    if not best.change.rotate or (now is not None and now.rank == best.rank):
        said = f"{who} ranks best with the query as it is ({ordinal(best.rank if now is None else now.rank)})."
    else:
        before = "" if now is None else f" instead of {ordinal(now.rank)}"
        said = f"{who} ranks best when the query is turned {_signed(best.change.rotate)}: {ordinal(best.rank)}{before}."
    return f"{said} {heading(profile, views)}".strip()


def heading(profile: Profile, views: tuple[View, View]) -> str:
    """Where the top of the query points, guessed from the top score alone; empty where that would mean nothing.

    It means something for a drone's picture, which has one heading, against satellite tiles, which are north-up.
    """
    blind = profile.best_blind
    found = profile.heading()
    if found is None or views != ("drone", "satellite"):
        return ""
    return (
        f"The top score, seen without knowing the truth, is highest at {_signed(blind.change.rotate)}: by that, the picture's "
        f"top points {found:.0f}° clockwise from north, a rough guess."
    )


def _signed(degrees: float) -> str:
    """A turn by the shorter way: 240 degrees are -120."""
    return f"{degrees - 360 if degrees > 180 else degrees:g}°"


def _of(picture: str, place: str) -> str:
    return f"all of the {picture}" if place == "all around" else f"the {picture}'s {place}"
