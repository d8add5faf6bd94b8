"""The page *Where it fails* in words: the number of wrong answers, one of them at a time, and the kinds of picture that fail."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from explorer import judge
from explorer.panels import place_text
from explorer.session_state import SessionState
from explorer.workspace import StateAnalysis, Workspace
from lpn.analysis import answer_context, wrong_answers
from lpn.analysis.answer_context import FailingKind
from lpn.core.arrays import BoolArray, Int64Array
from lpn.core.numbers import distance
from lpn.core.texts import ordinal
from lpn.drawing import verdicts, words
from lpn.flights.cut import TurnedFrame
from lpn.locate.summary import doubted_clause
from lpn.maps.named_window import WindowCut

# Kinds of picture that are listed at most.
_MOST_KINDS = 5
# A photo's middle that lies this share of the answer's width beyond its edge, or less, is near it.
_NEAR = 0.25
# Widths on the ground by this factor apart are of different scales; the windows of a pyramid are often this factor apart.
_SCALE = math.sqrt(2)


@dataclass(frozen=True)
class WrongAnswer:
    """One wrong answer among all of its task.

    Attributes:
        number, count: its position, from 1, the most wrong first, and the number of all.
        overall: how many answers are wrong, and how many of them another method mends.
        kinds: of picture, that fail more often than by chance, the least likely first.
        chance: a sentence that there are none; "" if there are, or if no kinds can be told apart.
        sentence: how far and in which direction the answer lies, and at which place in the list the right one came.
        reasons: the verdict's headline, and what was measured that may be why.
    """

    number: int
    count: int
    overall: str
    kinds: Sequence[str]
    chance: str
    sentence: str
    reasons: Sequence[str]


def rows(workspace: Workspace, state: SessionState) -> Int64Array | None:
    """Return the queries of a state's task whose first answer is wrong, the most wrong first; None if that is not known."""
    known = workspace.outcomes(workspace.task_of(state))
    return None if known is None else wrong_answers.worst_first(*known)


def wrong_answer(analysis: StateAnalysis, workspace: Workspace) -> WrongAnswer | None:
    """Return the wrong answer that the page of them shows; None if it is closed, or the answer is none of them."""
    state, task = analysis.state, analysis.task
    known = workspace.outcomes(task) if state.fails and not state.upload and analysis.matches[0].true is False else None
    if known is None:
        return None
    outcomes, table = known
    listed = wrong_answers.worst_first(outcomes, table)
    at = np.flatnonzero(listed == state.query)
    if not len(at):
        return None
    kinds = answer_context.failing_kinds(outcomes, table, task.query_labels)
    right = judge.judged_piece(analysis, workspace) or "the right one"
    by_chance = answer_context.by_chance(len(listed))
    return WrongAnswer(
        int(at[0]) + 1,
        len(listed),
        _overall(listed, outcomes.known, workspace),
        [f"{words.capitalised(_name(kind))}: {kind.numbers}." for kind in kinds or ()][:_MOST_KINDS],
        "" if kinds or kinds is None else f"{words.capitalised(by_chance)}.",
        _sentence(analysis, right),
        [f"{analysis.verdict.headline}.", *_reasons(analysis, workspace, right, kinds or ())],
    )


def _name(kind: FailingKind) -> str:
    return kind.name(words.column_name(kind.column.name))


def _overall(listed: Int64Array, known: BoolArray, workspace: Workspace) -> str:
    flight, verdicts_of_all = workspace.flight, workspace.verdicts
    graded, which = int(known.sum()), "" if known.all() else "graded "
    share = 100 * len(listed) / graded
    wrong = f"he first answer is wrong for {len(listed):,} of {graded:,} {which}pictures ({share:.0f} %)."
    tried = [] if flight is None else ["registration" in located.stages for located in flight.frames]
    if verdicts_of_all is None or not any(tried):
        return f"T{wrong}"
    placed = [one for one in map(verdicts_of_all.beliefs.__getitem__, listed.tolist()) if one.stage == "registration"]
    all_of_them = f"all {len(placed):,}" if len(placed) == len(listed) else f"{len(placed):,} of these {len(listed):,}"
    so_far = "" if all(map(tried.__getitem__, listed.tolist())) else "so far "
    placed_all_the_same = f"{so_far}{all_of_them} are placed all the same{doubted_clause(placed)}."
    return f"By their look alone, t{wrong} Laid over the map by their details, {placed_all_the_same}"


def _sentence(analysis: StateAnalysis, right: str) -> str:
    compared = f"The model compared {analysis.task.tiles:,} {verdicts.pictures_of(analysis.task)} and chose"
    positive = analysis.positive
    came = "none of them shows the place" if positive is None else f"{right} came {ordinal(positive.rank)}"
    return f"{compared} {_away(analysis)}; {came}."


def _away(analysis: StateAnalysis) -> str:
    """Say how far from the place, and in which direction, the answer lies."""
    offset, metres = _offset(analysis), analysis.errors_m
    if offset is None or metres is None:
        return "another place"
    direction = verdicts.compass(math.degrees(math.atan2(*offset)))
    return f"one that lies {distance(float(metres[analysis.matches[0].index]))} to the {direction}"


def _offset(analysis: StateAnalysis) -> tuple[float, float] | None:
    """Return the metres east and north from the place that the query shows to the middle of the answer; None if not known."""
    places, answer = analysis.task.geometry, analysis.matches[0].index
    if places is None:
        return None
    east, north = (places.ground[answer] - places.query_ground[analysis.state.query]).tolist()
    return (east, north) if math.isfinite(east) and math.isfinite(north) else None


def _reasons(analysis: StateAnalysis, workspace: Workspace, right: str, kinds: Sequence[FailingKind]) -> list[str]:
    """Say what was measured of a wrong answer that may be why.

    Args:
        right: what the right piece is called, also below.
    """
    task, answer = analysis.task, analysis.matches[0].index
    tile = task.gallery[answer]
    reasons = []
    if off_map := place_text.off_map(tile, "this answer"):
        reasons.append(off_map)
    offset = _offset(analysis)
    if isinstance(tile.cut, WindowCut) and offset is not None:
        window = tile.cut.window
        beyond = max(map(abs, offset)) - window.size / 2
        if 0 <= beyond < _NEAR * window.size:
            reasons.append(f"A near miss: the photo's middle lies {distance(beyond)} beyond the edge of this answer.")
    reasons += _scale(analysis, workspace, right)
    reasons += [
        f"It is of a kind that fails more often: {_name(kind)}."
        for kind in kinds[:_MOST_KINDS]
        if kind.rate.holds(kind.column)[analysis.state.query]
    ]
    return reasons


def _scale(analysis: StateAnalysis, workspace: Workspace, right: str) -> list[str]:
    """Say if a photo that is laid over the map shows ground of another width than the answer, and that than the right one."""
    task, registered, positive = analysis.task, workspace.details(analysis), analysis.positive
    query, tile = task.queries[analysis.state.query].cut, task.gallery[analysis.matches[0].index].cut
    true = None if positive is None else task.gallery[positive.index].cut
    if registered is None or not registered.accepted or registered.width is None:
        return []
    if not isinstance(query, TurnedFrame) or not isinstance(tile, WindowCut) or not isinstance(true, WindowCut):
        return []
    side, size = query.share * registered.width, tile.window.size
    if max(side / size, size / side) < _SCALE or round(size) == round(true.window.size):
        return []
    others = f"this answer {size:.0f} m and {right} {true.window.size:.0f} m"
    return [f"The scales differ: the photo's square shows {side:.0f} m of ground from side to side, {others}."]
