"""Registrations that contradict the rest of a flight: short jumps away and back, and pictures at another turn.

Equal houses in a row give good registrations one house too far. The drone cannot have reached such a place and left it in time.
A false alarm costs a true position, so the limits are generous: only short runs between consistent neighbours count, and none if
there are many.

Several photos from beyond the map's edge may fit one equal building on the map. Their turns against certain headings reveal them.
The error of headings may change from leg to leg, so turns that many frames share count as right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lpn.core.arrays import BoolArray, Float64Array, Int64Array
from lpn.core.numbers import wrap_degrees
from lpn.flight.locate.located import LocatedFrame, tag_positions
from lpn.flight.locate.retrieval import heading_is_certain

# The speed limit as a multiple of the 80th percentile of registered speeds, and of the largest speed of near tags.
_REGISTERED, _TAGGED = 1.2, 1.3
# Neighbours on each side whose tags count as near.
_NEAR = 10
# Least speed limits in metres a second: with tags, and without tags for common drones.
_LEAST, _COMMON = 10.0, 20.0
_RADII = 2.0
# Fewest positions for a usual speed.
_FEWEST = 8
# Frames of the longest run that is detected. An impossible step costs one frame more.
_LONGEST = 5
_GAP = _LONGEST + 1.0
# If a larger share of the frames is suspect, none is refused.
MOST = 0.1
# A turn differs from others if its distance from their median exceeds these degrees, and this multiple of their spread.
_TURNED, _TURNED_SPREADS = 5.0, 2.0
# Degrees from the commonest turn within which turns define the spread. If they fill this range, 10 degrees are allowed.
_ALIKE = 2.5
# Frames of one turn that prove a new error of the headings.
NEW_HEADING = 10


# Shift of a picture's middle by the tilt, as a share of the ground width: 8 degrees at 70 degrees of view.
_SWAY = 0.1


def refuse_contradicted(frames: Sequence[LocatedFrame]) -> list[str]:
    """Refuse registrations that others of the flight contradict, by turn or by place; return sentences about it."""
    return [*_refuse_turned(frames), *_refuse_jumps(frames, True), *_refuse_jumps(frames, False)]


def _refuse_turned(frames: Sequence[LocatedFrame]) -> list[str]:
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
        f"Refused, as equal buildings may be shown: {len(found)} of {len(turned)} registrations, turned by {by} against their "
        "headings, unlike the others. They may be right where the headings of a whole leg are off."
    ]


def _refuse_jumps(frames: Sequence[LocatedFrame], of_camera: bool) -> list[str]:
    """Refuse places of cameras, or of pictures' middles, that the drone cannot reach and leave in time, unless they are many."""
    timed = [
        (located, answer)
        for located in frames
        if (answer := located.stages["registration"]).accepted
        and answer.camera == of_camera
        and answer.radius is not None
        and located.frame.time is not None
    ]
    times = np.array([located.frame.time for located, _ in timed], np.float64)
    places = np.array([(answer.x, answer.y) for _, answer in timed], np.float64).reshape(-1, 2)
    sway = 0.0 if of_camera else _SWAY
    # The map's error moves neighbours alike.
    radii = np.array([math.hypot(answer.own_radius, sway * (answer.width or 0.0)) for _, answer in timed])
    speeds = top_speeds(times, places, tag_positions(located for located, _ in timed))
    if speeds is None:
        return []
    found = np.flatnonzero(jumps(times, places, radii, speeds))
    if len(found) > MOST * len(timed):
        return [
            f"{len(found)} of {len(timed)} registrations lie where the drone would have had to be faster than it flies to "
            "get there and back. These are too many to tell which of all are wrong, so none of them was refused; check the track."
        ]
    for i in found:
        located, answer = timed[i]
        located.stages["registration"] = answer.refused("jump", speed=float(speeds[i - 1 : i + 1].max()))
    return []


def top_speeds(times: Float64Array, places: Float64Array, tags: Float64Array) -> Float64Array | None:
    """Return the metres a second that the drone can fly from each position to the next, (N - 1,); None for too few positions.

    The speed is a multiple of the 80th percentile of the speeds between neighbours, and of the largest speed of the tags near by.
    Tags are ignored if half of them repeat the tag before.

    Args:
        times: seconds, ascending, (N,).
        places: metres east and north, (N, 2).
        tags: likewise, NaN where there is none.
    """
    seconds = np.diff(times)
    if len(times) < _FEWEST or (seconds > 0).sum() < _FEWEST - 1:
        return None
    least = np.full(len(seconds), _COMMON)
    tag_speeds = np.linalg.norm(np.diff(tags, axis=0), axis=1)
    tag_speeds[seconds > 0] /= seconds[seconds > 0]
    if (tag_speeds > 0).sum() > len(tag_speeds) / 2:
        padded = np.pad(np.where(seconds > 0, tag_speeds, 0), _NEAR, "edge")
        largest = np.lib.stride_tricks.sliding_window_view(padded, 2 * _NEAR + 1).max(axis=1)
        least = np.where(np.isnan(largest), _COMMON, np.maximum(_LEAST, _TAGGED * largest))
    moved = np.linalg.norm(np.diff(places, axis=0), axis=1)
    usual = float(np.quantile(moved[seconds > 0] / seconds[seconds > 0], 0.8))
    return np.asarray(np.maximum(least, _REGISTERED * usual), np.float64)


def jumps(times: Float64Array, places: Float64Array, radii: Float64Array, speeds: Float64Array) -> BoolArray:
    """Return which positions are jumps away and back, (N,).

    A step between two positions is possible if its length is at most the distance flown at these speeds plus twice the joint
    1-sigma radius. Times in whole seconds may be wrong by one. The best track maximises the frames on it minus 6 for each
    impossible step; the shorter of two equal tracks wins. A step may leave out up to 5 frames. These frames are jumps if the
    step is possible, and either the ways to them and back are both impossible, or the whole way over them is. Time and memory
    are linear in N.

    Args:
        times, places: see `top_speeds`, which returns `speeds`.
        radii: 1-sigma radii in metres, (N,).
    """
    count = len(times)
    is_jump = np.zeros(count, bool)
    if count < 3:
        return is_jump
    slack = speeds if (times == np.round(times)).all() else np.zeros_like(speeds)
    far = np.concatenate([[0.0], np.cumsum(speeds * np.diff(times))])

    def steps(lag: int) -> tuple[Float64Array, Float64Array]:
        """Return distances from each position to the one `lag` later, and the drone's reach meanwhile, (N - lag,) each."""
        reach = far[lag:] - far[:-lag] + slack[: count - lag] + _RADII * np.hypot(radii[lag:], radii[:-lag])
        return np.linalg.norm(places[lag:] - places[:-lag], axis=1), reach

    lags = [steps(lag) for lag in range(1, min(_LONGEST + 1, count - 1) + 1)]
    # One more frame outweighs any length of the track.
    metre = 1 / (1 + count * float(np.linalg.norm(np.ptp(places, axis=0))))
    gains = [(1 - metre * apart - _GAP * (apart > reach)).tolist() for apart, reach in lags]
    scores, previous = [1.0] * count, [-1] * count
    for i in range(1, count):
        for lag in range(1, min(len(gains), i) + 1):
            score = scores[i - lag] + gains[lag - 1][i - lag]
            if score > scores[i]:
                scores[i], previous[i] = score, i - lag
    last = int(np.argmax(scores))
    while (first := previous[last]) >= 0:
        apart, reach = lags[last - first - 1]
        if last - first > 1 and apart[first] <= reach[first]:
            way, can = (values[first:last] for values in lags[0])
            if (way[0] > can[0] and way[-1] > can[-1]) or way.sum() > reach[first] + _RADII * radii[
                first + 1 : last
            ].sum():
                is_jump[first + 1 : last] = True
        last = first
    return is_jump


def other_turn(turn: float, turns: Float64Array) -> float | None:
    """Return the degrees, 0 .. 180, between a turn and the median of others, (N,) with N > 0; None if it fits them.

    A turn fits within 5 degrees, or within twice the spread of the others. The comparison ignores half turns, as files may be
    saved upside down. The returned degrees include half turns, against the way up of most others.
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
    also fits if ten turns lie within 5 degrees of it, or half as many as near the commonest one. Time is O(N log N).

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
