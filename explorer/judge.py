"""The judge of a flight's photo, see `lpn.locate.located.LocatedFlight.judge_of`, and how far it may be believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from explorer.compute.ranking_job import RankingJob
from explorer.workspace import StateAnalysis, Workspace
from lpn.core.arrays import BoolArray
from lpn.locate.belief import Belief, belief
from lpn.locate.located import Judge, LocatedFlight, LocatedFrame
from lpn.maps import Window
from lpn.maps.named_window import WindowCut
from lpn.tasks.task import Task

# The words for the piece that each judge calls right.
_PIECES: dict[Judge, str] = {
    "its details": "the piece where details place the photo",
    "its GPS tag": "the piece where the photo's GPS tag lies",
    "its GPS tag without its lag": "the piece where the photo's GPS tag lies without its lag",
}


def judged_piece(analysis: StateAnalysis, workspace: Workspace) -> str:
    """Return what the piece is called that is right by a judge of a flight's photo whom nothing confirms; "" for any other judge.

    Nothing confirms one that another method contradicts, nor any of a flight whose check does not confirm the radii.
    """
    flight = workspace.flight
    if flight is None or analysis.state.upload is not None or flight.rendered:
        return ""
    query = analysis.state.query
    if not _contradicted(belief(flight.frames[query])) and confirmed(workspace) is not False:
        return ""
    return _PIECES[flight.judge_of(query)]


def is_sure(analysis: StateAnalysis, workspace: Workspace) -> bool:
    """Return False for a photo whose judge is in doubt, see `is_doubtful`, or by whose judge no piece can be right."""
    if workspace.flight is None or analysis.state.upload is not None:
        return True
    if analysis.positive is None and analysis.ranking.depth is None:
        return False
    first = analysis.matches[0]
    return first.true is None or not is_doubtful(
        workspace.flight, analysis.task, analysis.state.query, first.index, first.true
    )


def shown(analysis: StateAnalysis, workspace: Workspace) -> StateAnalysis:
    """Return an analysis for signs and colours: without grades where the judge is not sure.

    Of `Analysis.ungraded` it differs in the piece that this judge calls right, which stays, as the screen names it.
    """
    if is_sure(analysis, workspace):
        return analysis
    positive = analysis.positive
    named = None if positive is None else replace(positive, true=None)
    return replace(analysis.ungraded(), ranking=analysis.ranking, positive=named)


def doubtful(flight: LocatedFlight | None, ranking: RankingJob) -> BoolArray | None:
    """Return the photos of a flight whose judge is in doubt, or by whose judge no piece is right, (Q,).

    None without a flight, and until all photos are ranked.
    """
    if flight is None or ranking.result is None:
        return None
    pairs = zip(ranking.result.ranking.best.tolist(), ranking.ranks.tolist(), strict=True)
    return np.array(
        [
            rank < 0 or is_doubtful(flight, ranking.task, query, answer, rank == 0)
            for query, (answer, rank) in enumerate(pairs)
        ],
        bool,
    )


def is_doubtful(flight: LocatedFlight, task: Task, query: int, answer: int, right: bool) -> bool:
    """Return whether the grade of a flight's photo is in doubt.

    Its details are doubtful judges where its tag, its neighbours, or the map contradict them, and so is its tag where the details
    say the opposite of this answer.

    Args:
        answer: the first tile's position in the gallery.
        right: it is right by the judge.
    """
    by_details = flight.judge_of(query) == "its details" and _contradicted(belief(flight.frames[query]))
    return by_details or is_disputed(flight, task, query, answer, right)


def is_disputed(flight: LocatedFlight, task: Task, query: int, answer: int, right: bool) -> bool:
    """Return whether the details of a flight's photo contradict its judge on an answer.

    They place the photo's middle on an answer that is wrong, or off a right one. They do neither without an accepted
    registration, and where its 1-sigma radius leaves it open. The map's error moves both alike.

    Args:
        answer, right: see `is_doubtful`.
    """
    located = flight.frames[query]
    off = off_window(located, window_of(task, answer))
    return off is not None and abs(off) >= located.stages["registration"].own_radius and (off <= 0) is not right


def off_window(located: LocatedFrame, window: Window | None) -> float | None:
    """Return the metres from a piece of the map to a photo's registered place, below 0 inside of the piece.

    None without an accepted registration, or a piece of a map.
    """
    answer = located.stages.get("registration")
    if answer is None or not answer.accepted or answer.x is None or answer.y is None or window is None:
        return None
    return max(abs(answer.x - window.x), abs(answer.y - window.y)) - window.size / 2


def window_of(task: Task, index: int) -> Window | None:
    """Return where a tile lies on the map; None where it is no piece of one."""
    cut = task.gallery[index].cut
    return cut.window if isinstance(cut, WindowCut) else None


def confirmed(workspace: Workspace) -> bool | None:
    """Return if the tags of the flight's photos lie within three radii as often as with radii that are right; None without."""
    return None if workspace.flight is None else workspace.flight.radii_confirmed.get("registration")


def _contradicted(verdict: Belief) -> bool:
    return verdict.stage == "registration" and verdict.sign is None
