"""One plain sentence on how the photos of a flight were placed."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

from lpn.core.numbers import distance
from lpn.locate.belief import Belief
from lpn.locate.located import LocatedFrame

# The stages whose answers are accepted.
PLACED = {
    "registration": "by laying the photo over the map (registration)",
    "sequence": "by the photos before and after (sequence)",
}


def describe_flight(frames: Sequence[LocatedFrame], verdicts: Sequence[Belief]) -> str:
    """Say how many photos are placed, only guessed, and refused, and how far the placed ones lie from their GPS tags.

    A photo is placed where registration or sequence is accepted, and guessed where there is a most similar window alone.

    Args:
        verdicts: of the frames, see `lpn.locate.belief.beliefs`.
    """
    counts = {stage: sum(verdict.stage == stage for verdict in verdicts) for stage in (*PLACED, "retrieval")}
    placed = sum(counts[stage] for stage in PLACED)
    ways = [f"{counts[stage]:,} {way}" for stage, way in PLACED.items() if counts[stage]]
    guessed, refused = counts["retrieval"], len(frames) - placed - counts["retrieval"]
    pieces = [f"{placed:,} placed"]
    if guessed:
        pieces.append(f"{guessed:,} only guessed, by the most similar window of the map (retrieval)")
    if refused:
        pieces.append(f"{refused:,} refused")
    text = f"A drone flew over this map and took {len(frames):,} photos: {', '.join(pieces)}."
    if ways:
        text += f" Of those placed, {' and '.join(ways)}."
    pairs = zip(frames, verdicts, strict=True)
    errors = [frame.error(one.stage) for frame, one in pairs if one.stage in PLACED]
    known = [error for error in errors if error is not None]
    return f"{text} Half of the placed ones lie within {distance(median(known))} of their GPS tags." if known else text
