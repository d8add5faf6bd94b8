"""Registrations that one flight can have: short jumps away and back are found out, and pictures turned unlike the others.

Equal houses in a row give registrations that agree well, one house too far. Neighbours in time tell them: the drone cannot have
been there and back. A false alarm costs a true position, so the limit is generous: frames are found out only in short runs
between neighbours that fit each other, and not at all where they would be many.

Beyond the map's edge photos in a row fit an equal building on the map. Where headings are certain, their turns against these tell
them. Headings may be wrong in another way on another leg, so turns that many frames share are right ones.
"""

from __future__ import annotations

import numpy as np

from lpn.core.arrays import BoolArray, Float64Array, Int64Array
from lpn.core.numbers import wrap_degrees

# Limits of the speed: times the 80th percentile of registered speeds, and times the largest speed of the tags near by.
_REGISTERED, _TAGGED = 1.2, 1.3
# Neighbours on each side whose tags are near by.
_NEAR = 10
# Metres a second that no limit is below: with tags, and without, when it is what common drones can fly.
_LEAST, _COMMON = 10.0, 20.0
_RADII = 2.0
# Fewer positions tell no usual speed.
_FEWEST = 8
# Frames of the longest run that can be found out. A step that cannot be flown costs as much as one frame more.
_LONGEST = 5
_GAP = _LONGEST + 1.0
# Share of the frames above which no frame should be refused.
MOST = 0.1
# A turn is another one if it lies from the median of others by more degrees than this, and than so many times their spread.
_TURNED, _TURNED_SPREADS = 5.0, 2.0
# Degrees from the commonest turn within which turns tell the spread of all. Right ones that vary fill them, and allow 10 degrees.
_ALIKE = 2.5
# Frames of one turn that show another error of the headings.
NEW_HEADING = 10


def top_speeds(times: Float64Array, places: Float64Array, tags: Float64Array | None = None) -> Float64Array | None:
    """Return the metres a second that the drone can fly from each position to the next, (N - 1,).

    It is 1.2 times the 80th percentile of the speeds between neighbours, and at least 1.3 times the largest speed of the tags
    from 10 positions before to 10 after, and 10 m/s. It is at least 20 m/s where there are no tags, and everywhere if half of
    the tags stay as they were.

    Args:
        times: seconds, ascending, (N,).
        places: metres east and north, (N, 2).
        tags: likewise, NaN where there is none.

    Returns:
        None with fewer than 8 positions, or if fewer than 7 pairs of neighbours have different times.
    """
    seconds = np.diff(times)
    if len(times) < _FEWEST or (seconds > 0).sum() < _FEWEST - 1:
        return None
    least = np.full(len(seconds), _COMMON)
    if tags is not None:
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

    Two positions can be flown if their distance is at most the time between them at these speeds and twice their joint 1-sigma
    radius. Times in whole seconds may be wrong by one. A track of positions is sought, each within reach of the next, with
    the most frames; of several, the shortest one. A step of the track that cannot be flown costs 6 frames. The up to 5 frames
    that a step leaves out are jumps if the step can be flown, but neither the way to them nor that from them, or not the whole
    way over them.

    Time and memory are linear in N.

    Args:
        times: seconds, ascending, (N,).
        places: metres east and north, (N, 2).
        radii: 1-sigma radii in metres, (N,).
        speeds: metres a second from each position to the next, (N - 1,).
    """
    count = len(times)
    is_jump = np.zeros(count, bool)
    if count < 3:
        return is_jump
    slack = speeds if (times == np.round(times)).all() else np.zeros_like(speeds)
    far = np.concatenate([[0.0], np.cumsum(speeds * np.diff(times))])

    def steps(lag: int) -> tuple[Float64Array, Float64Array]:
        """Distances from each position to the one `lag` later, and how far the drone gets meanwhile, (N - lag,)."""
        reach = far[lag:] - far[:-lag] + slack[: count - lag] + _RADII * np.hypot(radii[lag:], radii[:-lag])
        return np.linalg.norm(places[lag:] - places[:-lag], axis=1), reach

    lags = [steps(lag) for lag in range(1, min(_LONGEST + 1, count - 1) + 1)]
    # One frame more outweighs any length of the track.
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
    """Return the degrees, 0 .. 180, between a turn and the median of others, (N,) with N > 0; None if it may be one of them.

    It may be one within 5 degrees, or within twice what they spread. Half turns count as none, as files may be saved upside down.
    The degrees that are returned hold them: they are those to the way up that most of the others have.
    """
    from_first = _half_turn(turns - turns[0])
    usual = turns[0] + float(np.median(from_first))
    if abs(float(_half_turn(turn - usual))) <= max(_TURNED, _TURNED_SPREADS * float(np.ptp(from_first))):
        return None
    if (np.abs(wrap_degrees(turns - usual)) > 90).mean() > 0.5:
        usual += 180.0
    return abs(float(wrap_degrees(turn - usual)))


def other_turns(turns: Float64Array) -> dict[int, float]:
    """Return which registrations of a flight are turned unlike the others, and by how many degrees, see `other_turn`.

    The others are those within 2.5 degrees of the commonest turn; they must be half of all, and eight at least. A turn stands
    if ten frames share it to within 5 degrees, or half as many as the commonest one.

    Time is N log N.

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
    """Return how many turns lie within some degrees of each, itself included, (N,)."""
    within = turns % 180.0
    circle = np.sort(np.concatenate([within - 180.0, within, within + 180.0]))
    return np.asarray(circle.searchsorted(within + degrees, "right") - circle.searchsorted(within - degrees, "left"))


def _half_turn(turns: Float64Array) -> Float64Array:
    """Return turns without half turns, in degrees, -90 .. 90."""
    return np.asarray((turns + 90.0) % 180.0 - 90.0, np.float64)
