"""Registrations that one drone can have flown, and jumps away and back."""

from __future__ import annotations

import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from lpn.core.arrays import Float64Array
from lpn.flight.files import Frame, open_flight
from lpn.flight.files.base import HeadingSource
from lpn.flight.locate.continuity import jumps, other_turns, refuse_contradicted, top_speeds
from lpn.flight.locate.located import LocatedFrame, StageRecord
from lpn.flight.maps import LocalFrame

EAST = np.array([1.0, 0.0])


def flown(speeds: list[float], step: float, seed: int = 0) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return times, places, and radii of a drone that flies east at these speeds, a frame each `step` seconds."""
    times = (np.arange(len(speeds)) + 0.01) * step
    noise = np.random.default_rng(seed).normal(0, 0.6, (len(speeds), 2))
    return times, np.outer(np.cumsum(speeds) * step, EAST) + noise, np.full(len(speeds), 0.6)


def found(
    times: Float64Array, places: Float64Array, radii: Float64Array, tags: Float64Array | None = None
) -> list[int]:
    speeds = top_speeds(times, places, np.full_like(places, np.nan) if tags is None else tags)
    assert speeds is not None
    return np.flatnonzero(jumps(times, places, radii, speeds)).tolist()


UNEVEN = (
    [0] * 60 + [10] * 5 + [0] * 35,
    [0] * 40 + [300] + [0] * 39,
    [2] * 112 + [-18] * 8,
    [0] * 60 + [28] * 5 + [0] * 35,
)


@pytest.mark.parametrize("step", [0.5, 1.0, 2.4])
@pytest.mark.parametrize("speeds", UNEVEN)
def test_true_positions_of_uneven_flights_stay(speeds: list[float], step: float) -> None:
    times, places, radii = flown(speeds, step)
    assert found(times, places, radii) == []
    # Late tags, too.
    assert found(times, places, radii, places[np.maximum(np.arange(len(places)) - 2, 0)]) == []


@pytest.mark.parametrize("name", ["brighton", "caliterra", "seneca"])
def test_tags_of_real_flights_are_positions_that_were_flown(name: str) -> None:
    if "LPN_FLIGHTS" not in os.environ:
        pytest.skip("LPN_FLIGHTS does not name the folder of the real flights")
    flight = open_flight(Path(os.environ["LPN_FLIGHTS"]) / name / "photos")
    places = LocalFrame(*np.nanmean(flight.degrees, axis=0).tolist()).xy(*flight.degrees.T)
    assert found(flight.times, places, np.full(len(places), 1.0)) == []
    assert found(flight.times, places, np.full(len(places), 1.0), places) == []


def test_the_next_house_within_a_second_is_found_out_without_tags() -> None:
    times, places, radii = flown([8.0] * 60, 1.0)
    places[8:10] += (-4.0, 38.0)
    places[20] += (75.0, 0.0)
    assert found(times, places, radii) == [8, 9, 20]
    # A jump at the end has no way back.
    places[59] += (0.0, 38.0)
    assert found(times, places, radii) == [8, 9, 20]


@pytest.mark.parametrize("jump", [(0.0, 38.0), (38.0, 0.0), (-38.0, 0.0)])
def test_tags_tell_the_speed_so_that_the_next_house_in_two_seconds_is_found_out(jump: tuple[float, float]) -> None:
    times, places, radii = flown([8.0] * 60, 2.4)
    tags = places + 5.0
    places[30] += jump
    assert found(times, places, radii, tags) == [30]
    # Tags that stay as they were tell no speed.
    assert found(times, places, radii, np.zeros_like(tags)) == found(times, places, radii)


def test_long_runs_stay_and_whole_seconds_may_be_wrong_by_one() -> None:
    times, places, radii = flown([8.0] * 40, 1.0)
    far = places.copy()
    far[10:16] += (0.0, 200.0)
    assert found(times, far, radii) == []
    far[15] -= (0.0, 200.0)
    assert found(times, far, radii) == [10, 11, 12, 13, 14]
    near = places.copy()
    near[20] += (0.0, 30.0)
    assert found(times, near, radii) == [20]
    assert found(np.floor(times), near, radii) == []


def test_a_few_positions_or_equal_times_tell_no_speed() -> None:
    times, places, _ = flown([8.0] * 7, 1.0)
    assert top_speeds(times, places, places) is None
    assert top_speeds(np.zeros(20), np.zeros((20, 2)), np.zeros((20, 2))) is None
    assert jumps(np.zeros(0), np.zeros((0, 2)), np.zeros(0), np.zeros(0)).tolist() == []
    assert jumps(np.zeros(2), np.zeros((2, 2)), np.zeros(2), np.zeros(1)).tolist() == [False, False]


def test_memory_is_linear() -> None:
    times, places, radii = flown([8.0] * 4000, 1.0)
    places[1000] += (0.0, 60.0)
    tracemalloc.start()
    try:
        assert found(times, places, radii) == [1000]
        assert tracemalloc.get_traced_memory()[1] < 2000 * len(times)
    finally:
        tracemalloc.stop()


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


@pytest.mark.parametrize("false", [{5}, {5, 6, 15, 16}])
def test_a_registration_that_no_drone_can_have_flown_to_is_refused_unless_they_are_many(false: set[int]) -> None:
    frames = registered([StageRecord("accepted", "", 8.0 * i, 60.0 * (i in false), radius=0.5) for i in range(30)])
    notes = refuse_contradicted(frames)
    refused = {i for i, one in enumerate(frames) if not one.stages["registration"].accepted}
    assert refused == (false if len(false) == 1 else set())
    assert ["4 of 30 registrations lie where" in note for note in notes] == [True] * (len(false) > 1)
    for i in refused:
        answer = frames[i].stages["registration"]
        assert (answer.code, answer.numbers, answer.x, answer.y) == ("jump", {"speed": 20.0}, 40.0, 60.0)


@pytest.mark.parametrize("source", ["gimbal", "aircraft", "course"])
def test_registrations_turned_unlike_the_others_are_refused_where_headings_are_certain(source: HeadingSource) -> None:
    turns = [-2.0] * 16 + [7.0] * 4  # the map ends at 16, and the photos beyond it fit a hall there
    answers = [
        StageRecord("accepted", "", 8.0 * min(i, 16), 0.0, radius=0.5, turn=turn) for i, turn in enumerate(turns)
    ]
    frames = registered(answers, source)
    notes = refuse_contradicted(frames)
    found = {i: one.stages["registration"].numbers for i, one in enumerate(frames) if one.stages["registration"].code}
    assert found == ({i: {"degrees": 9.0} for i in range(16, 20)} if source == "gimbal" else {})
    assert len(notes) == bool(found)
    assert not notes or "4 of 20 registrations, turned by 9.0° against their headings, unlike the others" in notes[0]
