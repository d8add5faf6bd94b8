"""The photos of a flight whose look can be graded: those whose judge nothing contradicts.

The judge of a photo is its GPS tag, or its details, see `LocatedFlight.judge_of`. A photo whose judge is in doubt counts neither
as right nor as wrong, wherever right and wrong answers are counted.
"""

from __future__ import annotations

import numpy as np

from lpn.core.arrays import BoolArray, Int64Array
from lpn.flight.locate.belief import Belief, FlightVerdicts, belief
from lpn.flight.locate.located import LocatedFlight, LocatedFrame
from lpn.flight.maps import Window
from lpn.flight.maps.named_window import WindowCut
from lpn.tasks.task import Task


def doubtful_photos(
    flight: LocatedFlight, task: Task, answers: Int64Array, ranks: Int64Array, verdicts: FlightVerdicts | None = None
) -> BoolArray:
    """Return the photos of a flight whose judge is in doubt, or by whose judge no tile is right, (Q,).

    Args:
        task: of the flight, see `flight_task`.
        answers: the first tile of each photo, (Q,).
        ranks: 0-based rank of each photo's first true tile, -1 without one, (Q,).
        verdicts: of the flight; by default they are looked for.
    """
    beliefs = (verdicts or FlightVerdicts.of(flight)).beliefs
    return np.array(
        [
            rank < 0 or is_doubtful(flight, task, query, answer, rank == 0, verdict)
            for query, (answer, rank, verdict) in enumerate(zip(answers.tolist(), ranks.tolist(), beliefs, strict=True))
        ],
        bool,
    )


def is_doubtful(
    flight: LocatedFlight, task: Task, query: int, answer: int, right: bool, verdict: Belief | None = None
) -> bool:
    """Return whether the grade of a flight's photo is in doubt.

    Its details are doubtful judges where its tag, its neighbours, or the map contradict them, and so is its tag where the details
    say the opposite of this answer.

    Args:
        answer: the first tile's position in the gallery.
        right: it is right by the judge.
        verdict: on the photo; by default it is looked for.
    """
    by_details = flight.judge_of(query) == "its details" and (verdict or belief(flight.frames[query])).contradicted
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
