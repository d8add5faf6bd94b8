"""Registrations that one drone can have flown: jumps between neighbours are found out.

Equal houses in a row give registrations that agree well, one house too far. Neighbours in time tell them: the drone cannot have
been there. The largest set of frames is kept in which each is within reach of the next; of several, the one with the shortest
track. Up to one false registration in 20 leaves the usual speed as it is.
"""

from __future__ import annotations

import numpy as np

from lpn.core.arrays import BoolArray, Float64Array

# The reach of a drone is this many times the 90th percentile of speeds between neighbours, and so many radii.
_FASTER = 1.2
_RADII = 2.0
# Fewer positions tell no usual speed.
_FEWEST = 8


def top_speed(times: Float64Array, places: Float64Array) -> float | None:
    """Return the metres a second that the flight can fly: 1.2 times the 90th percentile of the speeds between neighbours.

    Args:
        times: seconds, ascending, (N,).
        places: metres east and north, (N, 2).

    Returns:
        None with fewer than 8 positions, or if fewer than 7 pairs of neighbours have different times.
    """
    steps = np.diff(times)
    if len(times) < _FEWEST or (steps > 0).sum() < _FEWEST - 1:
        return None
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1)[steps > 0] / steps[steps > 0]
    return float(_FASTER * np.quantile(speeds, 0.9))


def within_reach(times: Float64Array, places: Float64Array, radii: Float64Array, speed: float) -> BoolArray:
    """Return which positions belong to the largest set that can be flown, (N,).

    Two positions can be flown if their distance is at most `speed` times the time between them and twice their joint 1-sigma
    radius. Times in whole seconds may be wrong by one.

    Args:
        times: seconds, ascending, (N,).
        places: metres east and north, (N, 2).
        radii: 1-sigma radii in metres, (N,).
        speed: metres a second.
    """
    slack = 1.0 if (times == np.round(times)).all() else 0.0
    apart = np.linalg.norm(places[:, None] - places, axis=-1)
    # One frame more outweighs any length of the track.
    cost = 1 / (1 + len(times) * apart.max(initial=0.0))
    scores, previous = np.ones(len(times)), np.full(len(times), -1)
    for i in range(1, len(times)):
        reach = speed * (times[i] - times[:i] + slack) + _RADII * np.hypot(radii[:i], radii[i])
        chains = np.where(apart[i, :i] <= reach, scores[:i] - cost * apart[i, :i], 0.0)
        best = int(np.argmax(chains))
        if chains[best] > 0:
            scores[i], previous[i] = chains[best] + 1, best
    kept = np.zeros(len(times), bool)
    at = int(np.argmax(scores)) if len(times) else -1
    while at >= 0:
        kept[at] = True
        at = int(previous[at])
    return kept
