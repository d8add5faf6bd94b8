"""One plain sentence on how the photos of a flight were placed."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

from lpn.core.numbers import distance
from lpn.locate.belief import Belief
from lpn.locate.located import LocatedFrame

_WAYS = {
    "registration": "by laying the photo over the map (registration)",
    "sequence": "by the photos before and after (sequence)",
    "retrieval": "by the most similar window of the map alone (retrieval)",
}


def describe_flight(frames: Sequence[LocatedFrame], verdicts: Sequence[Belief]) -> str:
    """Say how many photos each stage places, and how far from their GPS tags they lie.

    Args:
        verdicts: of the frames, see `lpn.locate.belief.beliefs`.
    """
    counts = {stage: sum(verdict.stage == stage for verdict in verdicts) for stage in _WAYS}
    ways = [f"{count:,} {way}" for (_, way), count in zip(_WAYS.items(), counts.values(), strict=True) if count]
    nowhere = len(frames) - sum(counts.values())
    text = f"A drone flew over this map and took {len(frames):,} photos. Placed: {', '.join(ways) or 'none yet'}"
    if ways and nowhere:
        text += f"; {nowhere:,} not placed"
    pairs = zip(frames, verdicts, strict=True)
    errors = [frame.error(one.stage) for frame, one in pairs if one.stage is not None]
    known = [error for error in errors if error is not None]
    return f"{text}. Half of them lie within {distance(median(known))} of their GPS tags." if known else f"{text}."
