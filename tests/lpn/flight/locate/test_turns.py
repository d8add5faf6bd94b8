"""Registrations that are turned unlike the others of their flight."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lpn.core.arrays import Float64Array
from lpn.flight.files import Frame
from lpn.flight.files.base import HeadingSource
from lpn.flight.locate.located import LocatedFrame, StageRecord
from lpn.flight.locate.turns import other_turns, refuse_turned

# Turns against a gimbal's headings with a degree of noise; 178 degrees are those of a file that is upside down.
USUAL = np.array([-1.7, -2.5, 178.0, -1.0, -1.9, -1.6, -2.1, -181.0] * 2)
TURNS = np.append(USUAL, [6.7, 8.5, 7.7, 7.2, 8.8])
LAST = {16, 17, 18, 19, 20}


@pytest.mark.parametrize(
    ("turns", "other"),
    [
        (TURNS, LAST),
        # They may be the first frames, headings may be wrong by anything that is constant, and none are half turns.
        *((TURNS[::-1] + wrong, {0, 1, 2, 3, 4}) for wrong in (88.0, 90.0, 179.0, -91.0)),
        # A registration turned the opposite way does not hide them.
        (np.append(TURNS, -7.1), LAST | {21}),
        # Within 5 degrees a turn may be right, and headings that vary allow more.
        (np.append(USUAL, 5.0), {16}),
        (np.append(USUAL, 3.0), set()),
        (np.append(USUAL, [5.0, -4.0, 0.5]), set()),
        # Many share another turn: eight of 24, ten of 260, legs, or three settings of the compass.
        (np.append(TURNS, [8.0, 7.5, 7.0]), set()),
        (np.concatenate([np.zeros(200), np.full(10, 12.0), np.zeros(50)]), set()),
        (np.tile([*[-6.0] * 6, *[6.0] * 6], 4), set()),
        (np.repeat([-30.0, 0.0, 30.0], 12), set()),
        # Few turns, any turns, and none tell nothing.
        (np.append(np.zeros(7), 40.0), set()),
        (np.random.default_rng(0).uniform(-180, 180, 100), set()),
        (np.zeros(0), set()),
    ],
)
def test_a_few_registrations_that_are_turned_unlike_the_others_are_found_out(
    turns: Float64Array, other: set[int]
) -> None:
    assert other_turns(turns).keys() == other


def test_a_half_turn_is_no_ground_for_a_refusal_but_is_named_in_one() -> None:
    assert other_turns(TURNS)[18] == pytest.approx(9.5, abs=0.3)
    assert other_turns(np.append(TURNS, 188.0))[21] == pytest.approx(170, abs=0.3), "most others stand upright"
    assert other_turns(np.append(TURNS + 180.0, 188.0))[21] == pytest.approx(10, abs=0.3)


def registered(answers: list[StageRecord], source: HeadingSource = "gimbal") -> list[LocatedFrame]:
    """Return frames, a second each, with these registrations."""
    frames = [
        Frame(f"{i}", Path("a"), 80, 60, float(i), heading=0.0, heading_source=source) for i in range(len(answers))
    ]
    return [LocatedFrame(frame, None, {"registration": one}) for frame, one in zip(frames, answers, strict=True)]


@pytest.mark.parametrize("source", ["gimbal", "aircraft", "course"])
def test_registrations_turned_unlike_the_others_are_refused_where_headings_are_certain(source: HeadingSource) -> None:
    turns = [-2.0] * 16 + [7.0] * 4  # the map ends at 16, and the photos beyond it fit a hall there
    answers = [
        StageRecord("accepted", "", 8.0 * min(i, 16), 0.0, radius=0.5, turn=turn) for i, turn in enumerate(turns)
    ]
    frames = registered(answers, source)
    notes = refuse_turned(frames)
    found = {i: one.stages["registration"].numbers for i, one in enumerate(frames) if one.stages["registration"].code}
    assert found == ({i: {"degrees": 9.0} for i in range(16, 20)} if source == "gimbal" else {})
    assert len(notes) == bool(found)
    assert not notes or "4 of 20 registrations, turned by 9.0° against their headings, unlike the others" in notes[0]
