"""Registrations that a map of another place would have by chance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lpn.flights import Frame
from lpn.locate.located import LocatedFrame, StageRecord
from lpn.locate.map_proof import refuse_unproven

BOUNDS = (-500.0, -500.0, 500.0, 500.0)


def flight(places: dict[int, tuple[float, float]], frames: int = 20, tagged: int = 0) -> list[LocatedFrame]:
    """Frames of which some are registered at places, as pictures of 60 m, and the first ones have a tag on the map."""
    made = []
    for i in range(frames):
        located = LocatedFrame(Frame(f"{i}", Path("a"), 40, 30), np.zeros(2) if i < tagged else None)
        answer = StageRecord("refused", "Too few.")
        if i in places:
            answer = StageRecord("accepted", "It fits.", *places[i], radius=1.0, width=60.0)
        located.stages["registration"] = answer
        made.append(located)
    return made


def accepted(frames: list[LocatedFrame]) -> int:
    return sum(located.stages["registration"].accepted for located in frames)


SCATTERED = {i: (97.0 * i % 800 - 400, 231.0 * i % 800 - 400) for i in range(0, 20, 4)}
TRACK = {i: (40.0 * i, 0.0) for i in range(5)}


@pytest.mark.parametrize(
    ("places", "tagged", "kept"),
    [
        (SCATTERED, 0, 0),  # 5 of 20 are as many as by chance
        (SCATTERED, 10, 5),  # tags on the map show that it is the flight's
        (TRACK, 0, 5),  # neighbours overlap
        ({i: SCATTERED[i - i % 4] for i in range(10)}, 0, 10),  # half of all are more than by chance
        ({}, 0, 0),
    ],
)
def test_few_registrations_without_a_tag_on_the_map_are_no_proof(
    places: dict[int, tuple[float, float]], tagged: int, kept: int
) -> None:
    frames = flight(places, tagged=tagged)
    notes = refuse_unproven(frames, BOUNDS)
    assert accepted(frames) == kept
    assert len(notes) == (kept < len(places))
    if notes:
        assert "Only 5 of 20 photos fit this map, as by chance on a map of another place" in notes[0]
        refused = frames[0].stages["registration"]
        assert refused.unverified
        assert refused.x == places[0][0]


def test_few_photos_an_accepted_sequence_and_a_correction_are_left() -> None:
    few = flight({0: (0.0, 0.0)}, frames=4)
    assert refuse_unproven(few, BOUNDS) == []
    assert accepted(few) == 1
    for stage in ("sequence", "by hand"):
        frames = flight({0: (0.0, 0.0)})
        if stage == "sequence":
            frames[3].stages[stage] = StageRecord("accepted", "Neighbours agree.", 0.0, 0.0)
        else:
            frames[3].by_hand = StageRecord("accepted", "Corrected.", 0.0, 0.0)
        assert refuse_unproven(frames, BOUNDS) == []
        assert accepted(frames) == 1
