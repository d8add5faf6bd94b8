"""The verdict on a frame, and the contradictions between its answers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from lpn.flight.files import Frame
from lpn.flight.locate.agreement import MapAgreement
from lpn.flight.locate.located import LocatedFrame, StageRecord
from lpn.flight.locate.registered_stage import with_map_error
from lpn.flight.locate.verdict import TAG_RADIUS, Disagreement, FrameVerdict, disagreements, judge, placed_errors

FRAME = Frame("a", Path("a"), 80, 60, height_above_ground=100.0)
TAG = np.zeros(2)
REFUSED = StageRecord("refused", "Too few matches.")


def registration(x: float, camera: bool = True, radius: float = 1.0) -> StageRecord:
    return StageRecord("accepted", "Matches agree.", x, 0.0, camera, radius, width=100.0)


def sequence(x: float, radius: float = 10.0) -> StageRecord:
    return StageRecord("accepted", "Neighbours agree.", x, 0.0, radius=radius)


def located(tag: np.ndarray | None = TAG, **stages: StageRecord) -> LocatedFrame:
    return LocatedFrame(FRAME, tag, stages)


def judged(tag: np.ndarray | None = TAG, **stages: StageRecord) -> FrameVerdict:
    return judge(located(tag, **stages))


@pytest.mark.parametrize(
    ("metres", "allowed", "told"),
    [(4.0, 3.03, ("4.0", "3.1")), (3.14, 3.03, ("3.14", "3.03")), (3.0304, 3.03, ("3.030", "3.030"))],
)
def test_what_is_allowed_is_a_bound_that_lies_below_what_is_measured(
    metres: float, allowed: float, told: tuple[str, str]
) -> None:
    sentence = Disagreement("registration", "map", metres, allowed).sentence
    assert f"lies {told[0]} m off" in sentence
    assert f"allows {told[1]} m" in sentence


def test_answers_disagree_beyond_three_times_their_common_radius() -> None:
    allowed = 3 * np.hypot(1.0, TAG_RADIUS)
    assert not disagreements(located(registration=registration(allowed - 0.1)))
    (found,) = disagreements(located(registration=registration(allowed + 0.1)))
    assert (found.metres, found.allowed) == pytest.approx((allowed + 0.1, allowed))
    assert found.sentence == "Registration and tag lie 15.4 m apart; their radii allow 15.3 m."


def test_the_error_of_the_map_counts_against_a_tag_alone() -> None:
    both = {"registration": registration(0.0, camera=False), "sequence": sequence(27.0, 9.0)}
    assert not disagreements(located(tag=None, **both))
    both["sequence"] = sequence(35.0, 9.0)
    both["registration"] = with_map_error(both["registration"], 40.0, 39.0)
    (one,) = disagreements(located(tag=None, **both))
    assert one.allowed == pytest.approx(3 * np.hypot(1.0, 9.0)), "the map's error moves both alike"
    far = with_map_error(registration(100.0), 40.0, 39.0)
    assert not disagreements(located(registration=far)), "a tag is not on the map"


def test_the_middle_of_a_picture_may_be_moved_by_an_unknown_tilt() -> None:
    # 100 m high, 15 degrees: 26.8 m more.
    assert not disagreements(located(registration=registration(41.0, camera=False)))
    assert disagreements(located(registration=registration(43.0, camera=False)))
    # Sequence and registration both tell the picture's middle.
    both = {"registration": registration(40.0, camera=False), "sequence": sequence(0.0)}
    assert [one.other for one in disagreements(located(tag=None, **both))] == ["sequence"]


@pytest.mark.parametrize(
    ("pitch", "metres", "doubted"),
    [(-50.0, 83.9, False), (-50.0, 83.9 + 60.0, True), (-50.0, 0.0, True), (-20.0, 200.0, False), (None, 83.9, True)],
)
def test_a_tag_is_compared_with_the_place_below_a_camera_of_known_tilt(
    pitch: float | None, metres: float, doubted: bool
) -> None:
    """From 100 m a camera that looks 40 degrees ahead shows ground that lies 83.9 m before it; beyond 60 it may be anywhere."""
    frame = replace(FRAME, pitch=pitch, roll=0.0)
    answer = msgspec.structs.replace(registration(metres, camera=False), heading=90.0)
    assert bool(disagreements(LocatedFrame(frame, TAG, {"registration": answer}))) == doubted


def test_answers_that_were_refused_or_not_verified_contradict_nothing() -> None:
    far = StageRecord("refused", "", 500.0, 0.0, radius=1.0)
    retrieval = StageRecord("not verified", "", 500.0, 0.0)
    assert not disagreements(located(retrieval=retrieval, sequence=far, registration=far))


PLACED = "Placed by its details, ± 1.0 m on this map"
GUESS = StageRecord("not verified", "The best window.", 1.0, 1.0)
TAG_OFF = "Registration and tag lie 60.0 m apart; their radii allow 15.3 m."
NEIGHBOURS_OFF = "Registration and sequence lie 97.0 m apart; their radii allow 57.0 m."
NEAR, FEW = "Matches agree. It lies 3.0 m from its GPS tag.", "Too few matches."


# The tag and the answers; the verdict's sign, stage, headline, and reason.
@pytest.mark.parametrize(
    ("tag", "stages", "expected"),
    [
        (TAG, {"registration": registration(3.0), "sequence": sequence(5.0)}, (True, "registration", PLACED, NEAR)),
        (
            TAG,
            {"registration": msgspec.structs.replace(registration(3.0), place_error=0.5)},
            (True, "registration", PLACED.replace("this map", "earth"), NEAR),
        ),
        (
            TAG,
            {"registration": registration(60.0), "sequence": sequence(50.0)},
            (None, "registration", f"{PLACED}, but its GPS tag disagrees", TAG_OFF),
        ),
        (
            TAG,
            {"registration": registration(3.0), "sequence": sequence(100.0)},
            (True, "registration", PLACED, f"{NEAR} Its neighbours would place it 97.0 m from here."),
        ),
        (
            None,
            {"registration": registration(3.0), "sequence": sequence(100.0)},
            (None, "registration", f"{PLACED}, but its neighbours disagree", NEIGHBOURS_OFF),
        ),
        (
            TAG,
            {"registration": REFUSED, "sequence": sequence(5.0)},
            (None, "sequence", "Placed by its neighbours only, ± 10 m on this map", FEW),
        ),
        (
            TAG,
            {"registration": REFUSED, "sequence": REFUSED, "retrieval": GUESS},
            (None, "retrieval", "Not placed, a best guess only", FEW),
        ),
        (TAG, {"retrieval": REFUSED}, (False, None, "Not located", FEW)),
        (TAG, {}, (False, None, "Not located", "No stage has an answer.")),
    ],
)
def test_only_a_registration_that_nothing_contradicts_is_believed(
    tag: np.ndarray | None, stages: dict[str, StageRecord], expected: tuple[bool | None, str | None, str, str]
) -> None:
    found = judged(tag, **stages)
    assert (found.sign, found.stage, found.headline, found.reason) == expected
    assert found.contradicted == (found.stage == "registration" and found.sign is None)
    assert found.state == ("contradicted" if found.contradicted else found.answer.state)


def test_places_beside_the_middle_that_lie_elsewhere_on_the_map_contradict_the_registration() -> None:
    def compared(*metres: float, radius: float = 5.0, middle: float | None = None) -> tuple[bool | None, str]:
        agreement = MapAgreement([(0.1, 0.1, one, 0.0) for one in metres], 20.0)
        # The map's place on earth has an error of 4 m, which moves photo and map alike: 3 m are left.
        answer = msgspec.structs.replace(
            registration(3.0, radius=radius), place_error=4.0, map_error=4.0, agreement=agreement, middle_radius=middle
        )
        verdict = judged(registration=answer, sequence=sequence(5.0))
        return verdict.sign, verdict.summary

    doubted = None, "Placed by its details, but away from its middle it does not fit the map"
    assert compared(8.9, 8.9, 15.0) == (True, "Placed by its details")
    assert compared(9.1, 9.1, 9.2) == doubted
    assert compared(15.0, 15.0) == (True, "Placed by its details"), "two places tell too little"
    assert compared(15.0, 15.0, 15.0, radius=9.0)[0], "the radius holds it"
    assert compared(15.0, 15.0, 15.0, radius=9.0, middle=5.0) == doubted, "the error of the tilt moves no ground"
    assert compared(16.0, 14.0, 15.0, 0.1) == doubted, "one place that agrees does not help"


def test_errors_of_placed_photos_are_against_the_tags_whatever_a_person_corrected() -> None:
    corrected = replace(located(registration=registration(3.0)), by_hand=registration(50.0))
    frames = [corrected, located(None, registration=registration(3.0)), located(registration=REFUSED)]
    verdicts = [judge(one) for one in frames]
    assert (verdicts[0].state, verdicts[0].columns["stage"], verdicts[0].doubt) == ("accepted", "by hand", [])
    errors = placed_errors(frames, verdicts)
    assert (errors.photos, errors.median) == (1, 3.0)
    assert placed_errors(frames[1:], verdicts[1:]) is None
