"""Registrations whose turn against a reliable heading differs from the usual turn of their flight.

Several photos from beyond the map's edge may fit one equal building on the map, and their turns reveal them. The error of
headings may change from leg to leg, so turns that many frames share count as right.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lpn.core.arrays import Float64Array, Int64Array
from lpn.core.numbers import wrap_degrees
from lpn.flight.locate.located import LocatedFrame
from lpn.flight.locate.retrieval import heading_is_certain

# Minimum of turns that define the usual turn.
_FEWEST = 8
# A turn differs from others if its distance from their median exceeds these degrees, and this multiple of their spread.
_TURNED, _TURNED_SPREADS = 5.0, 2.0
# Degrees from the commonest turn within which turns define the spread. If they fill this range, 10 degrees are allowed.
_ALIKE = 2.5
# Frames of one turn that prove a new error of the headings.
NEW_HEADING = 10


def refuse_turned(frames: Sequence[LocatedFrame]) -> list[str]:
    """Refuse registrations of an unusual turn against a certain heading; return a sentence about them."""
    # There is no limit on their share: beyond the edge of a map 5 of 21 were false.
    turned = [
        (located, answer, answer.turn)
        for located in frames
        if (answer := located.stages["registration"]).accepted
        and answer.turn is not None
        and heading_is_certain(located.frame)
    ]
    found = other_turns(np.array([turn for *_, turn in turned], np.float64))
    for i, degrees in found.items():
        located, answer, _ = turned[i]
        located.stages["registration"] = answer.refused("turned", degrees=degrees)
    if not found:
        return []
    by = " to ".join(dict.fromkeys(f"{f(found.values()):.1f}°" for f in (min, max)))
    return [
        f"Refused, as they may lie on equal buildings: {len(found)} of {len(turned)} registrations, turned by {by} against their "
        "headings, unlike the others. They may be right where the headings of a whole leg are off."
    ]


def other_turn(turn: float, turns: Float64Array) -> float | None:
    """Return the degrees, 0 .. 180, between a turn and the median of others, (N,) with N > 0; None if it fits them.

    A turn fits within 5 degrees, or within twice the spread of the others. The comparison ignores half turns, as files may be
    saved upside down. The returned degrees include half turns, and count from the way up of most other turns.
    """
    from_first = _half_turn(turns - turns[0])
    usual = turns[0] + float(np.median(from_first))
    if abs(float(_half_turn(turn - usual))) <= max(_TURNED, _TURNED_SPREADS * float(np.ptp(from_first))):
        return None
    if (np.abs(wrap_degrees(turns - usual)) > 90).mean() > 0.5:
        usual += 180.0
    return abs(float(wrap_degrees(turn - usual)))


def other_turns(turns: Float64Array) -> dict[int, float]:
    """Return the indices of turns that do not fit the others, with the degrees of `other_turn`.

    The others are the turns within 2.5 degrees of the commonest one; they must be half of all, and at least eight. A turn
    also fits if at least ten turns, or half as many as near the commonest one, lie within 5 degrees. The time is O(N log N).

    Args:
        turns: against certain headings in degrees, (N,).
    """
    alike = _sharing(turns, _ALIKE)
    if not len(turns) or (most := int(alike.max())) < max(_FEWEST, len(turns) / 2):
        return {}
    usual = turns[np.abs(_half_turn(turns - turns[alike.argmax()])) <= _ALIKE]
    few = np.flatnonzero(_sharing(turns, _TURNED) < min(NEW_HEADING, most / 2)).tolist()
    return {i: apart for i in few if (apart := other_turn(float(turns[i]), usual)) is not None}


def _sharing(turns: Float64Array, degrees: float) -> Int64Array:
    """Count the turns within some degrees of each, itself included, (N,)."""
    within = turns % 180.0
    circle = np.sort(np.concatenate([within - 180.0, within, within + 180.0]))
    return np.asarray(circle.searchsorted(within + degrees, "right") - circle.searchsorted(within - degrees, "left"))


def _half_turn(turns: Float64Array) -> Float64Array:
    """Return turns modulo half turns, in degrees, -90 .. 90."""
    return np.asarray((turns + 90.0) % 180.0 - 90.0, np.float64)
