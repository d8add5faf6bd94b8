"""The verdict on an analysis in words."""

from __future__ import annotations

import math
from dataclasses import dataclass

from explorer.compute.ranking_job import TaskRanking
from explorer.workspace import StateAnalysis, Workspace
from lpn.analysis import answer_context
from lpn.core.arrays import FloatingArray
from lpn.core.numbers import distance
from lpn.drawing import verdicts
from lpn.retrieval import Match

# From here on a picture's GPS tag is that of another region than the tiles'.
_ELSEWHERE_M = 10_000.0
# The shapes of an own picture and of the network's input differ visibly from here on.
_PRESSED = 1.05
OWN_KEPT = "Your picture stays in this server's memory until you close this page, and goes nowhere else."
_PICTURES = {"drone": "drone pictures", "satellite": "satellite pictures", "street": "street pictures"}


@dataclass(frozen=True, eq=False)
class Lead:
    """By how much the answer leads another tile, part by part.

    Attributes:
        shares: d² of the other tile minus d² of the answer, each part's share, (n,).
        other: the other tile in words.
        index: the other tile's position in the gallery.
    """

    shares: FloatingArray
    other: str
    index: int

    @property
    def total(self) -> float:
        """The lead in d²."""
        return float(self.shares.sum())

    @property
    def decisive(self) -> list[int]:
        """The parts that make most of it, see `verdicts.leading_parts`."""
        return verdicts.leading_parts(self.shares)


def verdict(analysis: StateAnalysis, part_names: list[str]) -> tuple[bool | None, str, str]:
    """Return whether the top match is right (None: unknown), a headline, and the reason; see `lpn.drawing.verdicts`."""
    first, depth = analysis.matches[0], analysis.ranking.depth
    if analysis.ranking.relevant is None:
        gap = "there is no other tile"
        if first.gap is not None:
            gap = f"the next tile is {first.gap:.3f} further away (d²)"
        if analysis.state.upload is None:
            return None, "Nearest tile", f"Its true place is not known here; {gap}."
        place = "Its true place is not known here"
        if analysis.errors_m is not None and math.isfinite(error := float(analysis.errors_m[first.index])):
            place = _elsewhere(analysis) or f"Its GPS tag lies {distance(error)} from the middle of this tile"
        return None, "Your picture: nearest tile", f"{place}; {gap}."
    if analysis.positive is None and depth is not None:
        return False, f"No true tile among the {depth} found", "The search does not tell what follows them."
    hardest_negative = next((match for match in analysis.matches if not match.true), None)
    return verdicts.verdict(first, analysis.positive, hardest_negative, part_names, _error_m(analysis))


def plain_verdict(analysis: StateAnalysis) -> tuple[bool | None, str, str]:
    """Return whether the top match is right (None: unknown), one word for it, and one sentence without a technical term."""
    first, positive, error_m = analysis.matches[0], analysis.positive, _error_m(analysis)
    pictures = f"{analysis.task.tiles:,} {_PICTURES[analysis.task.gallery_view]}"
    if analysis.ranking.relevant is None:
        place = _elsewhere(analysis) or "The true place is not known here, so it is not graded"
        text = f"This is the most similar of {pictures}. {place}."
        return None, "Best match", text
    if positive is None and analysis.ranking.depth is None:
        return False, "Wrong", f"None of the {pictures} shows this place, so no answer can be right."
    if first.true:
        off = "" if error_m is None else f", {distance(error_m)} off"
        return True, "Right", f"The model compared {pictures} and found the right place{off}."
    away = "another place" if error_m is None else f"a place {distance(error_m)} away"
    rank = "is not near the top" if positive is None or positive.beyond else f"came {verdicts.ordinal(positive.rank)}"
    return False, "Wrong", f"The model compared {pictures} and chose {away}; the right one {rank}."


def own_shape(analysis: StateAnalysis, workspace: Workspace) -> str:
    """Say that an own picture is pressed into the shape of the network's input; empty if it has that shape."""
    picture = analysis.state.upload
    if picture is None:
        return ""
    (height, width), (rows, columns) = picture.picture.shape[:2], workspace.contract.input_size
    stretched = (width / height) / (columns / rows)
    if 1 / _PRESSED < stretched < _PRESSED:
        return ""
    shape = "a square" if rows == columns else f"{columns} × {rows} pixels"
    return f"Your picture is {width} × {height} pixels; the model sees it pressed into {shape}."


def _elsewhere(analysis: StateAnalysis) -> str:
    """Say that no tile is near the GPS tag of one's own picture; "" if one is, or without a tag."""
    if analysis.state.upload is None or analysis.errors_m is None:
        return ""
    nearest = float(analysis.errors_m.min())  # NaN if a tile has no position, which may then show the place
    if not nearest >= _ELSEWHERE_M:
        return ""
    return f"Your picture's GPS tag lies {distance(nearest)} from the nearest of them, so no answer can be right"


def lead(analysis: StateAnalysis) -> Lead | None:
    """Return the lead of the top match over the tile that it is best compared with; None where there is none.

    For a right answer, that is the hardest negative; for a wrong one, the nearest positive; without a truth, the next tile.
    """
    first, others = analysis.matches[0], analysis.matches[1:]
    rival: Match | None
    if first.true is None or (first.true is False and analysis.positive is None):
        rival, name = next(iter(others), None), "the next best picture"
    elif first.true:
        rival, name = next((match for match in others if not match.true), None), "the best wrong picture"
    else:
        rival, name = analysis.positive, "the right picture"
    return None if rival is None else Lead(rival.shares - first.shares, name, rival.index)


def context(analysis: StateAnalysis, workspace: Workspace, total: float) -> str:
    """Say how the answer to a query as it is compares with those to all queries of the task; empty where that is not known.

    Args:
        total: the answer's lead over the best wrong picture, if it is right.
    """
    state, first = analysis.state, analysis.matches[0]
    as_it_is = not state.upload and not state.change and not state.region and len(set(state.part_values())) == 1
    known = workspace.outcomes(analysis.task) if as_it_is and first.true is not None else None
    if known is None:
        return ""
    outcomes, table = known
    if first.true:
        return answer_context.describe_lead(outcomes, total)
    return "" if workspace.has_flight else answer_context.describe_failure(outcomes, table, state.query)


def overall(ranking: TaskRanking | None) -> str:
    """Return how often the top match is right over all queries of a task, in words; empty while it is not known."""
    if ranking is None or not (graded := int(ranking.results["queries"])):
        return ""
    share = ranking.results["recall@1"]
    right = f"{share / 100 * graded:,.0f} times ({math.floor(share)} %)"  # never rounded up to all
    return f"Over all {graded:,} pictures its first answer is right {right}."


def _error_m(analysis: StateAnalysis) -> float | None:
    """Return the metres from what the query shows to the top match; None where that is unknown."""
    error_m = math.nan if analysis.errors_m is None else float(analysis.errors_m[analysis.matches[0].index])
    return error_m if math.isfinite(error_m) else None  # a tile of an index may have no position
