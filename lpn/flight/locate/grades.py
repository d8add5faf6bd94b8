"""Doubt about the judges of a flight's photos.

The judge of a photo's ranking is its GPS tag or its details, see `LocatedFlight.judge_of`. A photo whose judge is in doubt counts
neither as right nor as wrong.
"""

from __future__ import annotations

import numpy as np

from lpn.core.arrays import BoolArray, Int64Array
from lpn.flight.locate.located import LocatedFlight, LocatedFrame
from lpn.flight.locate.verdict import judge
from lpn.flight.maps import Window
from lpn.flight.maps.named_window import WindowCut
from lpn.tasks.task import Task


def doubtful_photos(flight: LocatedFlight, task: Task, answers: Int64Array, ranks: Int64Array) -> BoolArray:
    """Return a mask, (Q,), of the photos whose judge is in doubt or accepts no tile.

    Args:
        task: of the flight, see `flight_task`.
        answers: the first tile of each photo, (Q,).
        ranks: 0-based rank of each photo's first true tile, -1 without one, (Q,).
    """
    pairs = enumerate(zip(answers.tolist(), ranks.tolist(), strict=True))
    doubtful = (rank < 0 or is_doubtful(flight, task, i, answer, rank == 0) for i, (answer, rank) in pairs)
    return np.fromiter(doubtful, bool)


def is_doubtful(flight: LocatedFlight, task: Task, query: int, answer: int, right: bool) -> bool:
    """Tell whether the grade of a flight's photo is in doubt.

    Details are in doubt if the tag, the neighbours, or the map contradict them. A tag is in doubt if the details grade this
    answer the opposite way, by more than their 1-sigma radius. The radius excludes the map's error, which moves windows and
    details alike.

    Args:
        answer: the first tile's position in the gallery.
        right: whether it is right by the judge.
    """
    located = flight.frames[query]
    if flight.judge_of(query) == "its details" and judge(located).contradicted:
        return True
    off = off_window(located, window_of(task, answer))
    return off is not None and abs(off) >= located.stages["registration"].own_radius and (off <= 0) is not right


def off_window(located: LocatedFrame, window: Window | None) -> float | None:
    """Return the metres from a window to a photo's registered place, below 0 inside the window.

    None without an accepted registration or a window.
    """
    answer = located.stages.get("registration")
    if answer is None or not answer.accepted or answer.x is None or answer.y is None or window is None:
        return None
    return max(abs(answer.x - window.x), abs(answer.y - window.y)) - window.size / 2


def window_of(task: Task, index: int) -> Window | None:
    """Return the window of a tile; None if the tile is not cut from a map."""
    cut = task.gallery[index].cut
    return cut.window if isinstance(cut, WindowCut) else None
