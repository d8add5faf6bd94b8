"""Registrations that a map of another place would have by chance."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from lpn.flight.files import Frame
from lpn.flight.locate.located import LocatedFrame, StageRecord
from lpn.flight.locate.map_proof import refuse_unproven

BOUNDS = (-500.0, -500.0, 500.0, 500.0)


def flight(
    places: dict[int, tuple[float, float]], frames: int = 20, tagged: int = 0, tag: tuple[float, float] = (0.0, 0.0)
) -> list[LocatedFrame]:
    """Frames of which some are registered at places, as pictures of 60 m, and the first ones have a tag."""
    made = []
    for i in range(frames):
        located = LocatedFrame(Frame(f"{i}", Path("a"), 40, 30), np.array(tag) if i < tagged else None)
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
        (SCATTERED, 20, 0),  # nor do tags on the map that lie elsewhere on it
        (TRACK, 0, 5),  # neighbours overlap
        ({i: (90.0 * i - 400, 400.0 * (i % 2)) for i in range(10)}, 0, 10),  # half of all are more than by chance
        ({}, 0, 0),
    ],
)
def test_few_registrations_that_no_tag_confirms_are_no_proof(
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


@pytest.mark.parametrize(("apart", "views"), [(14.0, "one view"), (16.0, "2 views")])
def test_photos_of_one_view_count_once(apart: float, views: str) -> None:
    """A drone hovers over what fits by chance. Its pictures are 60 m wide, so those within 15 m are of one view."""
    frames = flight({i: (apart * (i % 2), 0.0) for i in range(20)})
    notes = refuse_unproven(frames, BOUNDS)
    assert notes[0].startswith(f"The 20 of 20 photos that fit this map show {views}, as by chance on a map of another")
    assert accepted(frames) == 0


def test_a_view_is_known_by_its_middle_and_not_by_the_camera() -> None:
    frames = flight(dict.fromkeys(range(20), (0.0, 0.0)))
    for i, located in enumerate(frames):  # the camera turns about its place
        answer = located.stages["registration"]
        laid = [1.5, 0.0, 40.0 * i, 0.0, -1.5, 0.0, 0.0, 0.0, 1.0]
        located.stages["registration"] = msgspec.structs.replace(answer, camera=True, homography=laid)
    assert refuse_unproven(frames, BOUNDS) == []


@pytest.mark.parametrize(("metres", "agreeing", "kept"), [(14.0, 3, 5), (14.0, 2, 0), (40.0, 5, 0)])
def test_tags_with_which_half_of_the_registrations_agree_are_a_proof(metres: float, agreeing: int, kept: int) -> None:
    """A tag has 5 m, and a registration of a camera 1 m here, so that they may lie 15 m apart."""
    frames = flight(SCATTERED)
    for number, (i, (x, y)) in enumerate(SCATTERED.items()):
        frames[i].tag = np.array([x, y + (metres if number < agreeing else 200.0)])
        frames[i].stages["registration"] = msgspec.structs.replace(frames[i].stages["registration"], camera=True)
    refuse_unproven(frames, BOUNDS)
    assert accepted(frames) == kept


def test_the_tags_of_photos_that_are_not_registered_tell_nothing() -> None:
    frames = flight({0: (0.0, 0.0)}, frames=8)
    frames[0].tag = np.array([3.0, 4.0])
    for located in frames[1:]:
        located.tag = np.array([9000.0, 0.0])  # the drone was beyond the map
    assert refuse_unproven(frames, BOUNDS) == []
    assert accepted(frames) == 1


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


# Places within 20 m of tags of photos that do not overlap, and tags that lie where they do.
NEAR = {i: (160.0 * i - 400 + 8, 10.0) for i in range(5)}
FORGED = {i: (160.0 * i - 400, 0.0) for i in NEAR}


@pytest.mark.parametrize(
    ("prior", "kept"),
    [
        (None, 5),  # the tags were not used, and agree
        (100.0, 5),  # five of five lie near them though the search saw much more
        (15.0, 0),  # each would do so by chance in every second draw
    ],
)
def test_tags_that_the_search_used_prove_only_what_chance_does_not(prior: float | None, kept: int) -> None:
    frames = flight(NEAR)
    for i, tag in FORGED.items():
        frames[i].tag = np.array(tag)
    notes = refuse_unproven(frames, BOUNDS, prior=prior)
    assert accepted(frames) == kept
    if notes:
        assert "prove little, as only the map within 15 m of each was searched" in notes[0]


def test_neighbours_whose_tags_overlap_prove_nothing_with_a_prior() -> None:
    frames = flight(TRACK)
    for i in TRACK:
        frames[i].tag = np.array([40.0 * i, 22.0])
    assert not refuse_unproven(frames, BOUNDS)
    assert accepted(frames) == 5
    assert refuse_unproven(frames, BOUNDS, prior=15.0)
    assert accepted(frames) == 0


@pytest.mark.parametrize(("side", "kept"), [(50.0, 0), (600.0, 5)])
def test_neighbours_prove_the_map_only_where_a_model_has_much_ground_searched(side: float, kept: int) -> None:
    frames = flight(TRACK)
    for i, located in enumerate(frames):
        located.stages["sequence"] = StageRecord("refused", "Near.", 40.0 * i, 0.0, unverified=True)
    refuse_unproven(frames, BOUNDS, side=side)
    assert accepted(frames) == kept


def test_false_registrations_about_the_sequence_s_answers_hardly_ever_prove_the_map() -> None:
    """A fifth of the photos fits anywhere that was searched about a track of the sequence; exp(-4) of 40 flights are 1."""
    generator, side, proven = np.random.default_rng(0), 50.0, 0
    for _ in range(40):
        frames = flight({}, frames=60)
        track = np.cumsum(generator.normal(0.0, 20.0, (60, 2)), axis=0)
        for located, place in zip(frames, track, strict=True):
            located.stages["sequence"] = StageRecord("refused", "Near.", place[0], place[1], unverified=True)
            east, north = place + generator.uniform(-40.0, 40.0, 2)  # a picture of 60 m within 70 m of the place
            if generator.random() < 0.2:
                answer = StageRecord("accepted", "By chance.", east, north, radius=1.0, width=60.0)
                located.stages["registration"] = answer
        refuse_unproven(frames, BOUNDS, side=side)
        proven += accepted(frames) > 0
    assert proven <= 1


def test_a_photo_without_a_tag_hides_none_with_one_of_its_view() -> None:
    places = {2 * i + more: (x + more, y) for i, (x, y) in NEAR.items() for more in (0, 1)}
    frames = flight(places)
    for i, tag in FORGED.items():
        frames[2 * i + 1].tag = np.array(tag)
    assert not refuse_unproven(frames, BOUNDS, prior=100.0)
    assert accepted(frames) == len(places)


@pytest.mark.parametrize(("apart", "kept"), [(24.0, 0), (40.0, 2)])
def test_photos_of_the_same_things_agree_once_with_tags_that_the_search_used(apart: float, kept: int) -> None:
    frames = flight({3: (0.0, 0.0), 8: (apart, 0.0)})
    for i, x in ((3, 0.0), (8, apart)):
        frames[i].tag = np.array([x, 10.0])
    refuse_unproven(frames, BOUNDS, prior=60.0)
    assert accepted(frames) == kept
