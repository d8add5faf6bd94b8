"""Registrations that a map of another place would have by chance, and those that are turned unlike the others."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from lpn.core.arrays import Float64Array
from lpn.flight.files import Frame
from lpn.flight.files.base import HeadingSource
from lpn.flight.locate.agreement import MapAgreement
from lpn.flight.locate.located import LocatedFrame, StageRecord, WindowRecord
from lpn.flight.locate.map_evidence import ENOUGH, MapEvidence, judge_map
from lpn.flight.locate.turns import other_turns, refuse_turned

Places = dict[int, tuple[float, float]]
BOUNDS = (-500.0, -500.0, 500.0, 500.0)


def flight(
    places: Places, frames: int = 20, tags: Places | None = None, camera: bool = True, followed: bool = False
) -> list[LocatedFrame]:
    """Return frames of which some are registered at places, as pictures of 60 m, and some have tags.

    Args:
        camera: whether places with tags are the camera's; other places may lie 8 m farther from their tags here.
        followed: whether all have answers of the sequence, along `TRACK`.
    """
    made, tags = [], tags or {}
    for i in range(frames):
        located = LocatedFrame(Frame(f"{i}", Path("a"), 40, 30), np.array(tags[i]) if i in tags else None)
        located.stages["registration"] = StageRecord("refused", "Too few.")
        if i in places:
            answer = StageRecord("accepted", "It fits.", *places[i], camera and i in tags, radius=1.0, width=60.0)
            located.stages["registration"] = answer
        if followed:
            located.stages["sequence"] = StageRecord("refused", "Near.", 40.0 * i, 0.0, code="unproven")
        made.append(located)
    return made


def accepted(frames: list[LocatedFrame]) -> int:
    return sum(located.stages["registration"].accepted for located in frames)


SCATTERED = {i: (97.0 * i % 800 - 400, 231.0 * i % 800 - 400) for i in range(0, 20, 4)}
TRACK = {i: (40.0 * i, 0.0) for i in range(5)}
NEAR = {i: (160.0 * i - 400 + 8, 10.0) for i in range(5)}
FORGED = {i: (160.0 * i - 400, 0.0) for i in NEAR}
# A photo without a tag beside each with one, of the same view.
PAIRS = {2 * i + more: (x + more, y) for i, (x, y) in NEAR.items() for more in (0, 1)}


def off(metres: float, agreeing: int) -> list[LocatedFrame]:
    """Scattered places with tags `metres` off for some, and 200 m for the others."""
    tags = {i: (x, y + (metres if k < agreeing else 200.0)) for k, (i, (x, y)) in enumerate(SCATTERED.items())}
    return flight(SCATTERED, tags=tags)


def apart(metres: float) -> list[LocatedFrame]:
    """Two registered photos of 20, `metres` apart, with tags."""
    return flight({3: (0.0, 0.0), 8: (metres, 0.0)}, tags={3: (0.0, 10.0), 8: (metres, 10.0)})


def one(frames: int, tag: tuple[float, float] = (3.0, 4.0)) -> list[LocatedFrame]:
    """One registered photo with a tag, the first of some."""
    return flight({0: (0.0, 0.0)}, frames, {0: tag})


@pytest.mark.parametrize(
    ("frames", "prior", "side", "kept"),
    [
        (flight({}), None, None, 0),
        # As many as by chance, with tags that merely lie on the map, and more than by chance.
        (flight(SCATTERED), None, None, 0),
        (flight(SCATTERED, tags=dict.fromkeys(range(20), (0.0, 0.0)), camera=False), None, None, 0),
        (flight({i: (90.0 * i - 400, 400.0 * (i % 2)) for i in range(10)}), None, None, 10),
        (flight({i: (90.0 * i - 400, 0.0) for i in range(4)}, 5), None, None, 4),
        (flight({i: (90.0 * i - 400, 0.0) for i in range(3)}, 5), None, None, 0),
        # Neighbours overlap, but a drone that hovers over a chance fit has one view, or views of common objects.
        (flight(TRACK), None, None, 5),
        (flight({i: (14.0 * (i % 2), 0.0) for i in range(20)}), None, None, 0),
        (flight({i: (16.0 * (i % 2), 0.0) for i in range(20)}), None, None, 0),
        # A tag has 5 m, and a registration of a camera 1 m here, so that they may lie 15 m apart.
        (off(14.0, 3), None, None, 5),
        (off(14.0, 2), None, None, 5),
        (off(40.0, 5), None, None, 0),
        # One that agrees proves a large map alone, and on a narrow search it does not.
        (one(8), None, None, 1),
        (one(1), None, None, 1),
        (one(1), 15.0, None, 0),
        (one(1, (300.0, 4.0)), None, None, 0),
        # Tags that the search used prove little: each agrees by chance in every second draw within 15 m.
        (flight(NEAR, tags=FORGED, camera=False), None, None, 5),
        (flight(NEAR, tags=FORGED, camera=False), 100.0, None, 5),
        (flight(NEAR, tags=FORGED, camera=False), 15.0, None, 0),
        (flight(TRACK, tags={i: (40.0 * i, 22.0) for i in TRACK}, camera=False), 15.0, None, 0),
        (flight(PAIRS, tags={2 * i + 1: tag for i, tag in FORGED.items()}), 100.0, None, 10),
        # Photos of the same things agree once.
        (apart(24.0), 60.0, None, 0),
        (apart(40.0), 60.0, None, 2),
        # Neighbours prove the map only where a model has much ground searched.
        (flight(TRACK, followed=True), None, 50.0, 0),
        (flight(TRACK, followed=True), None, 600.0, 5),
    ],
)
def test_a_map_is_that_of_the_flight_where_all_evidence_together_says_so(
    frames: list[LocatedFrame], prior: float | None, side: float | None, kept: int
) -> None:
    places = accepted(frames)
    notes = judge_map(frames, MapEvidence(BOUNDS, prior, side))
    assert accepted(frames) == kept
    assert len(notes) == (kept < places)
    refused = [located.stages["registration"] for located in frames if located.stages["registration"].unverified]
    assert len(refused) == places - kept
    for answer in refused:
        assert answer.x is not None
        assert answer.sentence.startswith(f"Only {places} of {len(frames)} photos fit this map (different views: ")
        assert answer.sentence.endswith(" It fits.")
    if notes:
        assert "check that the map is of the flight's place" in notes[0]


def test_a_view_is_known_by_its_middle_and_not_by_the_camera() -> None:
    frames = flight(dict.fromkeys(range(20), (0.0, 0.0)))
    for i, located in enumerate(frames):  # the camera turns about its place
        answer = located.stages["registration"]
        laid = [1.5, 0.0, 40.0 * i, 0.0, -1.5, 0.0, 0.0, 0.0, 1.0]
        located.stages["registration"] = msgspec.structs.replace(answer, camera=True, homography=laid)
    assert judge_map(frames, MapEvidence(BOUNDS)) == []


def test_places_that_the_map_contradicts_away_from_their_middle_prove_nothing() -> None:
    frames = flight(TRACK)
    misfit = MapAgreement([(0.5, 0.5, 9.0, 9.0)] * 4, 20.0)
    for i in TRACK:
        answer = frames[i].stages["registration"]
        frames[i].stages["registration"] = msgspec.structs.replace(answer, agreement=misfit)
    judge_map(frames, MapEvidence(BOUNDS))
    assert accepted(frames) == 0


@pytest.mark.parametrize("known", ["sequence", "by hand", "alone"])
def test_an_accepted_sequence_a_correction_and_details_that_suffice_alone_show_the_map(known: str) -> None:
    frames = flight({0: (0.0, 0.0)})
    found = StageRecord("accepted", "Found.", 0.0, 0.0, alone=known == "alone")
    if known == "by hand":
        frames[3].by_hand = found
    else:
        frames[3].stages["sequence" if known == "sequence" else "registration"] = found
    assert judge_map(frames, MapEvidence(BOUNDS)) == []
    assert frames[0].stages["registration"].accepted


def test_what_the_sequence_holds_back_is_accepted_as_it_was_found() -> None:
    frames = flight(TRACK, followed=True)
    judge_map(frames, MapEvidence(BOUNDS, side=600.0))
    assert {(one.stages["sequence"].state, one.stages["sequence"].sentence) for one in frames} == {
        ("accepted", "Near.")
    }


@pytest.mark.parametrize(("ground", "most"), [(60.0, 0), (400.0, 2)])
def test_false_registrations_about_the_sequence_s_answers_hardly_ever_prove_the_map(ground: float, most: int) -> None:
    """A fifth of the photos fits anywhere that was searched about a track of the sequence; exp(-3) of 40 flights are 2."""
    generator, side, half, proven = np.random.default_rng(0), 50.0, ground / 2, 0
    for _ in range(40):
        frames = flight({}, frames=60)
        track = np.cumsum(generator.normal(0.0, 20.0, (60, 2)), axis=0).clip(-half, half)
        for located, place in zip(frames, track, strict=True):
            located.stages["sequence"] = StageRecord("refused", "Near.", place[0], place[1], code="unproven")
            east, north = (place + generator.uniform(-40.0, 40.0, 2)).clip(-half, half)
            if generator.random() < 0.2:
                answer = StageRecord("accepted", "By chance.", east, north, radius=1.0, width=60.0)
                located.stages["registration"] = answer
        judge_map(frames, MapEvidence((-half, -half, half, half), side=side))
        proven += accepted(frames) > 0
    assert proven <= most


@pytest.mark.parametrize(("searched", "proven"), [(None, True), (20.0, False)])
def test_a_search_that_cannot_fail_to_agree_proves_nothing(searched: float | None, proven: bool) -> None:
    """Photos of 20 m that overlap beside the answers of windows of 99 m, each after one that fits nowhere."""
    evidence = MapEvidence((-500.0, -500.0, 500.0, 500.0), side=99.0)
    for i in range(40):
        located, lost = flight({0: (25.0 * i - 480.0, 3.0)}, 2)
        located.stages["sequence"] = StageRecord("accepted", "Near.", 25.0 * i - 480.0, 0.0)
        answer = located.stages["registration"]
        located.stages["registration"] = msgspec.structs.replace(answer, width=20.0)
        if searched is None:
            located.windows = [WindowRecord(east, -400.0, 99.0, 0.0, 0.0, [], []) for east in (-400.0, 400.0)]
        for one in (located, *[lost] * 6):
            evidence.add(one, searched)
    assert (evidence.log_odds > ENOUGH) == proven


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
