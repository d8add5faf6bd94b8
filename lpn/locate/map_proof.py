"""Registrations that are as few as on a map of another place, where nothing else shows that the map is of the flight's place.

A photo of another place fits a map by chance now and then, most often where trees stand on both. On such maps up to two of nine
photos did. So registrations that are not more than that prove nothing by their number. They prove something by their places if
neighbours overlap on the ground: each does so by chance with the share of the map that lies so near.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import msgspec

from lpn.locate.located import LocatedFrame

# Share of the photos that fit a map of another place by chance, and the log odds that exceed it.
_CHANCE, _EVIDENCE = 0.2, 4.0
# Flights of fewer frames tell nothing either way.
_FEWEST = 5


def refuse_unproven(frames: Sequence[LocatedFrame], bounds: tuple[float, float, float, float]) -> list[str]:
    """Refuse the accepted registrations of a flight unless something shows that the map is of its place; return a sentence.

    It is shown by tags of half of the frames, by a correction, by an accepted answer of the sequence, by the number
    of registrations, or by neighbours that overlap. Flights of fewer than five frames are left as they are.

    Args:
        frames: their registrations are replaced.
        bounds: x0, y0, x1, y1 of the map in metres.
    """
    registered = [located for located in frames if _registered(located)]
    known = 2 * sum(located.tag is not None for located in frames) >= len(frames) or any(
        located.by_hand is not None or ("sequence" in located.stages and located.stages["sequence"].accepted)
        for located in frames
    )
    if len(frames) < _FEWEST or not registered or known:
        return []
    if -_log_chance(len(registered), len(frames)) >= _EVIDENCE:
        return []
    if _overlaps(frames, bounds) >= _EVIDENCE + math.log(len(frames)):
        return []
    count = len(registered)
    sentence = (
        f"Only {count} of {len(frames)} photos fit{'s' if count == 1 else ''} this map, as by chance on a map of another place, "
        "and few or no tags lie on it"
    )
    for located in registered:
        answer = located.stages["registration"]
        located.stages["registration"] = msgspec.structs.replace(
            answer, state="refused", unverified=True, sentence=f"{sentence}. {answer.sentence}"
        )
    return [f"{sentence}, so none was accepted; check that the map is of the flight's place."]


def _registered(located: LocatedFrame) -> bool:
    answer = located.stages.get("registration")
    return answer is not None and answer.accepted


def _log_chance(count: int, frames: int) -> float:
    """Return the logarithm of the probability that so many of the frames fit by chance, or more (binomial)."""
    logs = [
        math.lgamma(frames + 1) - math.lgamma(k + 1) - math.lgamma(frames - k + 1)
        + k * math.log(_CHANCE) + (frames - k) * math.log(1 - _CHANCE)
        for k in range(count, frames + 1)
    ]  # fmt: skip
    most = max(logs)
    return most + math.log(sum(math.exp(log - most) for log in logs))


def _overlaps(frames: Sequence[LocatedFrame], bounds: tuple[float, float, float, float]) -> float:
    """Return the log odds of neighbours in the flight whose registered pictures overlap."""
    area = (bounds[2] - bounds[0]) * (bounds[3] - bounds[1])
    odds = 0.0
    for one, other in pairwise(frames):
        if not (_registered(one) and _registered(other)):
            continue
        a, b = one.stages["registration"], other.stages["registration"]
        reach = ((a.width or 0.0) + (b.width or 0.0)) / 2
        if a.x is None or a.y is None or b.x is None or b.y is None or reach <= 0:
            continue
        if math.hypot(a.x - b.x, a.y - b.y) <= reach:
            odds -= min(0.0, math.log(math.pi * reach**2 / area))
    return odds
