"""A drawn flight over a drawn map: stages, records, refusals, and the commands."""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from lpn.cli.main import main
from lpn.core.errors import DataError, InputError
from lpn.core.homography import apply_homography, corner_pixels, four_point_homography
from lpn.datasets.geo import geodesic
from lpn.flight.files import Flight, footprint, open_flight, write_flight
from lpn.flight.locate import pipeline, ranked_stages, registered_stage
from lpn.flight.locate.corrections import Correction, set_correction
from lpn.flight.locate.ground import MapFeatures
from lpn.flight.locate.levelled import PhotoView
from lpn.flight.locate.located import LocatedFlight, LocatedFrame, StageRecord
from lpn.flight.locate.matchers import Ground, SiftMatcher
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.pipeline import locate
from lpn.flight.locate.registered_stage import FlightPrior
from lpn.flight.locate.registration import Expectation, PhotoPlace, Registration, contested, register
from lpn.flight.locate.retrieval import FrameViews, MapRetrieval, WindowGallery, WindowRecord, pyramid_sizes
from lpn.flight.locate.sequence import SequencePoint
from lpn.flight.locate.tags import tags_on_map
from lpn.flight.locate.tracks import best_track, full_track
from lpn.flight.locate.words import Reason
from lpn.flight.maps import Map, Window, open_map
from tests.conftest import Refused
from tests.lpn.flight.locate.scenery import SIDE, GridModel, ground_to_photo, land, photo_of, photographed, write_map
from tools.fixtures.photos import write_photo

SIZE = (360, 270)
HEIGHT = 80.0
FOV = 60.0
WIDTH = 2 * HEIGHT * math.tan(math.radians(FOV / 2))
SIFT = LocateOptions(matcher="sift")
# Centres of the photos in metres east and north of the map's middle, and headings.
PLACES = [(-40.0, -30.0), (-15.0, -28.0), (10.0, -30.0), (35.0, -25.0)]
HEADINGS = [90.0, 85.0, 92.0, 88.0]


@pytest.fixture(scope="module")
def flight(town: Map, tmp_path_factory: pytest.TempPathFactory) -> Flight:
    folder = tmp_path_factory.mktemp("photos")
    flown = photographed(folder, town, PLACES, HEADINGS, SIZE, WIDTH, FOV, pitch=-90.0, roll=0.0)
    third = str(folder / "2.png")
    cv2.imwrite(third, cv2.imread(third)[::-1, ::-1])  # it was saved upside down
    return flown


def test_a_flight_is_registered_without_a_model_and_the_turned_picture_is_named(town: Map, flight: Flight) -> None:
    found = locate(town, flight, None, SIFT)
    answers = [located.stages["registration"] for located in found.frames]
    assert all(answer.accepted for answer in answers), [answer.sentence for answer in answers]
    assert max(located.error("registration") for located in found.frames) < 0.6
    assert found.stages == ["registration"]
    assert any("1 photo is turned by about 180 degrees against its heading: 2.png" in note for note in found.notes)
    assert "turned by 180 degrees" in found.frames[2].sentence
    summary = found.errors()["registration"]
    assert (summary.known, summary.photos) == (4, 4)
    point, frame = full_track(found)[0], flight.frames[0]
    assert (point["tag_latitude"], point["tag_longitude"]) == (frame.latitude, frame.longitude)
    assert point["latitude"] == pytest.approx(frame.latitude, abs=1e-5)


def test_a_run_goes_on_after_a_kill(town: Map, flight: Flight, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    registered: list[str] = []

    def answer(town: Map, features: MapFeatures, located: LocatedFrame, *rest: object) -> StageRecord:
        del town, features, rest
        registered.append(located.frame.name)
        return StageRecord("accepted", "It agrees.", 1.0, 2.0 + len(registered), radius=0.5, width=WIDTH)

    def run() -> list[StageRecord]:
        return [located.stages["registration"] for located in locate(town, flight, None, SIFT).frames]

    monkeypatch.setattr(registered_stage, "register_frame", answer)
    whole = run()
    records = next((tmp_path / "cache").rglob("*.jsonl"))
    lines = [line for line in records.read_bytes().splitlines() if line]
    assert len(lines) == 4
    records.write_bytes(b"\n".join([*lines[:2], lines[2][:40]]))  # killed within the third line
    registered.clear()
    again = run()
    assert registered == ["2.png", "3.png"]
    assert again[:2] == whole[:2]
    assert run() == again
    assert len(registered) == 2
    # Another height of the first frame changes all answers, because each uses the widths of earlier frames.
    moved = (replace(flight.frames[0], height_above_ground=81.0), *flight.frames[1:])
    locate(town, replace(flight, frames=moved), None, SIFT)
    assert len(registered) == 6


@pytest.mark.parametrize(
    ("count", "tagged", "corrected", "alone"),
    [(4, 0, False, True), (4, 1, False, True), (5, 0, False, False), (4, 0, True, False)],
)
def test_a_few_photos_without_tags_prove_the_map_one_by_one(
    count: int, tagged: int, corrected: bool, alone: bool, town: Map, flight: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four photos are too few for a flight's evidence: without a tag, each must be proven like a single photo."""
    searches: list[registered_stage.PhotoSearch] = []

    def search(one: registered_stage.PhotoSearch) -> StageRecord:
        searches.append(one)
        return StageRecord("refused", "Too few.")

    monkeypatch.setattr(registered_stage, "register_photo", search)
    frames = [replace(flight.frames[i % 4], name=f"{i}.png") for i in range(count)]
    frames = [frame if i < tagged else replace(frame, latitude=None, longitude=None) for i, frame in enumerate(frames)]
    kept = {"0.png": Correction.of(_corners((3.0, 0.0), 90.0), town.frame)} if corrected else None
    locate(town, replace(flight, frames=tuple(frames)), None, SIFT, corrections=kept)
    assert [one.anywhere for one in searches] == [True, False] * (tagged * alone) + [alone] * (count - tagged * alone)


def _corners(place: tuple[float, float], heading: float) -> np.ndarray:
    to_photo = ground_to_photo(place, heading, WIDTH, SIZE)
    return apply_homography(np.linalg.inv(to_photo), corner_pixels(*SIZE))


def test_a_correction_is_the_truth_and_stands_in_place_of_the_registration(
    town: Map, flight: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = StageRecord("accepted", "It agrees.", 3.0, 4.0, camera=True, radius=0.5, width=WIDTH, alone=True)
    monkeypatch.setattr(registered_stage, "register_frame", lambda *_: answer)
    # The last frame has no tilt, so a correction gives only its middle; the first has 10 degrees of roll.
    frames = (replace(flight.frames[0], roll=10.0), *flight.frames[1:3], replace(flight.frames[3], pitch=None))
    laid = {"0.png": ((3.0, 0.0), 90.0), "3.png": ((50.0, 60.0), 88.0), "x.png": ((0, 0), 0)}
    kept = {name: Correction.of(_corners(*given), town.frame) for name, given in laid.items()}
    flown = replace(flight, frames=frames)
    found = locate(town, flown, None, SIFT, corrections=kept)
    first, second, _, last = found.frames
    assert first.by_hand.camera
    # Looking to the left by 10 degrees with the top to the east, the camera is south of its picture's middle.
    np.testing.assert_allclose(first.truth(True), (3.0, -HEIGHT * math.tan(math.radians(10))), atol=1e-3)
    np.testing.assert_allclose(first.truth(False), (3.0, 0.0), atol=1e-3)
    assert first.error("registration") == pytest.approx(4 + HEIGHT * math.tan(math.radians(10)), abs=1e-3)
    assert second.error("registration") == pytest.approx(math.hypot(3 + 15, 4 + 28), abs=1e-3)
    np.testing.assert_allclose(last.truth(False), (50.0, 60.0), atol=1e-3)
    np.testing.assert_allclose(last.truth(True), PLACES[3], atol=1e-3)
    whole, best = full_track(found), best_track(found)
    stages = {"0.png": "by hand", "1.png": "registration", "2.png": "registration", "3.png": "by hand"}
    assert {point["frame"]: point["stage"] for point in whole} == stages
    assert [(point["frame"], point["stage"]) for point in best] == list(stages.items())
    by_hand = whole[-2]
    assert best[0] == by_hand
    assert by_hand["metres_from_tag"] is not None
    assert by_hand["reason"] == "A person laid the photo by hand."
    assert by_hand["note"].startswith("The GPS tag lies ")
    assert by_hand["note"].endswith("The registration lies 18.1 m from there.")
    lost = replace(found.frames[1], stages={"registration": StageRecord("refused", "Too few.", 5.0, 5.0)})
    (point,) = best_track(replace(found, frames=[lost]))
    told = [point.get(name) for name in ("state", "latitude", "reason", "note")]
    assert told == ["refused", None, "Not located.", "Too few."]
    assert found.notes[0].startswith("2 of 4 photos are corrected by hand.")
    assert "left out: x.png." in found.notes[1]
    assert found.audit.largest > 80  # between the last frame's tag and its correction
    plain = locate(town, flown, None, SIFT)
    assert [point["stage"] for point in full_track(plain)] == ["registration"] * 4
    assert plain.frames[0].stages == first.stages


def test_a_registration_in_progress_is_told_without_changing_the_flight(
    town: Map, flight: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "_PARTIAL_INTERVAL", 0.0)
    answer = StageRecord("accepted", "It agrees.", 1.0, 2.0, radius=0.5, width=WIDTH)
    monkeypatch.setattr(registered_stage, "register_frame", lambda *_: answer)
    frames = [LocatedFrame(frame, None) for frame in flight.frames]
    located = LocatedFlight(flight, town, frames, None, ["A note."], None)
    partial: list[LocatedFlight] = []
    whole = pipeline.registered(located, None, SIFT, on_partial=partial.append)
    answered = [["registration" in frame.stages for frame in one.frames] for one in partial]
    assert answered == [[i <= last for i in range(4)] for last in range(3)]
    assert all("registration" in frame.stages for frame in whole.frames)
    assert not any(frame.stages for frame in located.frames)
    assert whole.audit is not None
    assert partial[-1].audit is None


def test_bad_frames_get_a_sentence_and_the_run_goes_on(town: Map, flight: Flight, tmp_path: Path) -> None:
    broken = tmp_path / "broken.jpg"
    broken.write_bytes(b"nothing")
    unknown = replace(flight.frames[1], latitude=None, longitude=None)
    frames = (replace(flight.frames[0], file=broken, name="broken.jpg"), unknown, flight.frames[3])
    found = locate(town, replace(flight, frames=frames), None, replace(SIFT, prior=40.0))
    answers = [located.stages["registration"] for located in found.frames]
    assert [answer.accepted for answer in answers] == [False, False, True]
    assert "not a picture that can be read" in answers[0].sentence
    assert "leave --prior out" in answers[1].sentence
    assert f"it saw the map in a square {2 * (40 + 0.75 * WIDTH):.0f} m wide about it" in answers[2].sentence
    assert found.notes[0].startswith("1 of 3 photos has no GPS tag, so how far off its place is cannot")
    assert [point["state"] for point in full_track(found)] == ["refused", "refused", "accepted"]
    assert "Registration searched around the GPS tags only (prior 40 m)" in found.notes[1]
    assert found.prior == 40


@pytest.mark.parametrize(
    ("moved", "count", "away"),
    [
        ({"latitude": 10.0}, 4, None),  # on the plane
        ({"latitude": 0.0, "longitude": -171.0}, 4, None),  # on the globe's other side
        ({}, 4, 600.0),  # near by
        ({"latitude": 0.0, "longitude": 98.0}, 1, None),  # one photo alone, a quarter of the globe away
    ],
)
def test_a_flight_elsewhere_and_a_tag_far_away_are_told_and_left_out(
    town: Map, flight: Flight, moved: dict[str, float], count: int, away: float | None
) -> None:
    east = town.bounds[2]
    there = dict(zip(("latitude", "longitude"), town.frame.degrees([(east + (away or 0.0), 0.0)])[0], strict=True))
    frames = [replace(frame, **(moved or there)) if i < count else frame for i, frame in enumerate(flight.frames)]
    tags, notes, found = tags_on_map(town, replace(flight, frames=tuple(frames)))
    assert np.isnan(tags).any(axis=1).tolist() == [i < count for i in range(4)]
    assert len(notes) == 1
    if count == 1:
        assert notes[0].startswith("By the GPS tags of 1 of 4 photos, the drone was beyond the map's edge;")
        assert found is None
        return
    middle = town.frame.latitude, town.frame.longitude
    place = frames[0].latitude or 0.0, frames[0].longitude or 0.0
    assert found == pytest.approx(away or float(geodesic(middle, place)), rel=1e-3)
    assert "elsewhere than town, the map" in notes[0]
    assert f"is {(found or 0.0) / 1000:.1f} km from" in notes[0]


def test_a_drone_over_an_empty_part_of_the_map_is_told_apart_from_one_beyond_it(
    town: Map, flight: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Map, "valid_shares", lambda _, centres, __: np.where(centres[:, 0] < -20, 0.0, 1.0))
    latitude, longitude = town.frame.degrees([(town.bounds[2] + 1.0, 0.0)])[0].tolist()
    beyond = replace(flight.frames[1], latitude=latitude, longitude=longitude)
    tags, notes, _ = tags_on_map(town, replace(flight, frames=(flight.frames[0], beyond, *flight.frames[2:])))
    photo_may = "a photo taken there may still show ground on the map."
    assert notes == [
        f"By the GPS tags of 1 of 4 photos, the drone was beyond the map's edge; {photo_may}",
        f"By the GPS tags of 1 of 4 photos, the drone was over an empty part of the map; {photo_may}",
    ]
    assert np.isfinite(tags).all(), "each tag is the truth of its photo all the same"


def test_nothing_to_do_and_wrong_options_are_refused(town: Map, flight: Flight) -> None:
    for given, model, options, message in (
        (Flight("monday", ()), GridModel(), SIFT, "monday has no photo"),
        (flight, GridModel(), replace(SIFT, prior=40.0), "leave --prior or --model out"),
        (flight, None, replace(SIFT, register=False), "nothing to do"),
    ):
        with pytest.raises((DataError, InputError), match=message):
            locate(town, given, model, options)  # type: ignore[arg-type]
    for wrong, message in (
        ({"prior": -1.0}, "prior is -1"),
        ({"map_error": -1.0}, "map's error is -1"),
        ({"speed": 0.0}, "The speed is 0 m/s; expected metres a second above 0"),
        ({"sizes": (0.0,)}, "Sides of windows must be"),
    ):
        with pytest.raises(InputError, match=message):
            LocateOptions(**wrong)  # type: ignore[arg-type]


def test_an_expected_width_is_tried_freely_too(town: Map) -> None:
    assert list(registered_stage.tried_widths(town, 90.0, [])) == [(90.0, True), (90.0, False)]
    assert list(registered_stage.tried_widths(town, 90.0, [50.0])) == [(90.0, True), (90.0, False)]


@pytest.mark.parametrize(("east", "searches"), [(0.0, 1), (90.0, 2)])
def test_a_photo_beyond_what_was_searched_is_searched_again_about_its_place(
    town: Map, flight: Flight, monkeypatch: pytest.MonkeyPatch, east: float, searches: int
) -> None:
    found = Registration(None, "sift", support=20.0, width=WIDTH, centre=np.array([east, 0.0]), covariance=np.eye(2))
    found = replace(found, homography=np.linalg.inv(ground_to_photo((east, 0.0), 0.0, WIDTH, SIZE)))
    answers = [found, Registration(Reason("no match"), "sift")]
    centres: list[list[float]] = []

    def search(matcher: object, photo: object, ground: np.ndarray, *rest: object) -> Registration:
        del matcher, photo, rest
        centres.append(ground[0].tolist())
        return answers[min(len(centres), 2) - 1]

    monkeypatch.setattr(registered_stage, "register", search)
    features = MapFeatures(town, SiftMatcher())
    monkeypatch.setattr(features, "around", lambda places, *_: places)
    located = LocatedFrame(flight.frames[0], None, windows=[WindowRecord(5.0, 0.0, 40.0)])
    answer = registered_stage.register_frame(town, [features], located, SIFT, FlightPrior(), 40.0)
    assert answer.accepted == (searches == 1)
    assert centres[0] == [5.0, 0.0]
    assert set(map(tuple, centres[1:])) == ({(90.0, 0.0)} if searches == 2 else set())


class _MutualMatcher(SiftMatcher):
    """SIFT that, like XFeat, keeps matches of features that several places share."""

    name = "Mutual"
    ratio = 1.0


class _OneEyedMatcher(SiftMatcher):
    """SIFT that describes the whole map, but matches only in its eastern half."""

    def match(self, photo: np.ndarray, ground: Ground) -> np.ndarray:
        pairs = super().match(photo, ground)
        return pairs[ground.points[pairs[:, 1], 0] > 0]


@pytest.mark.slow
def test_a_matcher_that_finds_one_of_two_equal_places_does_not_decide(flight: Flight, tmp_path: Path) -> None:
    ground = land().copy()
    ground[:, : SIDE // 2] = ground[:, SIDE // 2 :]
    town = write_map(tmp_path / "twins.tif", ground)
    size, width = (240, 180), 60.0
    photo = photo_of(ground, ground_to_photo((50.0, 10.0), 90.0, width, size), size)
    file = tmp_path / "photo.png"
    cv2.imwrite(str(file), np.ascontiguousarray(photo[..., ::-1]))
    height = width / 2 / math.tan(math.radians(FOV / 2))
    located = LocatedFrame(replace(flight.frames[0], file=file, height_above_ground=height), None)
    both, one = MapFeatures(town, _MutualMatcher()), MapFeatures(town, _OneEyedMatcher())
    alone = registered_stage.register_frame(town, [one], located, SIFT, FlightPrior(), None)
    after = registered_stage.register_frame(town, [both, one], located, SIFT, FlightPrior(), None)
    assert alone.accepted
    assert alone.x == pytest.approx(50, abs=1)
    assert after.state == "refused"
    assert "Two places of the map fit the photo, so neither counts" in after.sentence


def test_a_place_that_earlier_matches_hardly_support_is_no_rival(town: Map) -> None:
    size, width = (240, 180), 60.0
    photo = PhotoView.plain(photo_of(land(), ground_to_photo((50.0, 10.0), 0.0, width, size), size))
    described = MapFeatures(town, SiftMatcher()).around(None, 0.0, width)
    found = register(SiftMatcher(), photo, described, Expectation(width, 0.0))
    searches = [(SiftMatcher(), described), (_MutualMatcher(), described)]
    away = PhotoPlace(complex(width), -40 - 30j)
    assert found.accepted
    assert contested(found, photo, searches, [away]).accepted
    assert contested(found, photo, searches, [found.places[0]]) is found


def _tilted(flight: Flight, folder: Path) -> Flight:
    """Render one photo from 80 m above the land's middle, tilted by 17 degrees."""
    frame = replace(flight.frames[0], file=folder / "t.png", latitude=None, longitude=None, heading=20.0, pitch=-73.0)
    to_photo = four_point_homography(footprint(frame, HEIGHT), corner_pixels(*SIZE))
    cv2.imwrite(str(frame.file), photo_of(land(), to_photo, SIZE)[..., ::-1])
    return replace(flight, frames=(frame,))


def test_beyond_15_degrees_of_tilt_the_pose_tells_the_camera_and_without_it_the_middle_is_told(
    town: Map, flight: Flight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tilted = _tilted(flight, tmp_path)
    answer = locate(town, tilted, None, SIFT).frames[0].stages["registration"]
    assert (answer.x, answer.y) == (answer.pose.east, answer.pose.north)
    assert answer.distance(np.zeros(2)) < 1.0
    assert "above flat ground" in answer.sentence
    monkeypatch.setattr(registered_stage, "photo_pose", lambda *_: "There is none.")
    monkeypatch.setattr(registered_stage, "FORMAT", "another")  # the cache has the answer with a pose
    answer = locate(town, tilted, None, SIFT).frames[0].stages["registration"]
    assert answer.accepted, answer.sentence
    assert not answer.camera
    assert "of the picture's middle" in answer.sentence
    ahead = HEIGHT * math.tan(math.radians(17.0))
    turn = math.radians(20.0)
    assert math.hypot(answer.x - ahead * math.sin(turn), answer.y - ahead * math.cos(turn)) < 1.0


def test_retrieval_sequence_and_registration_agree(town: Map, flight: Flight) -> None:
    model = GridModel()
    upright = replace(flight, frames=tuple(frame for i, frame in enumerate(flight.frames) if i != 2))
    found = locate(town, upright, model, replace(SIFT, overlap=0.88))  # type: ignore[arg-type]
    assert found.stages == ["retrieval", "sequence", "registration"]
    for located in found.frames:
        assert max(located.error("retrieval"), located.error("sequence")) < 15
        assert [located.stages[name].state for name in found.stages] == ["not verified", "accepted", "accepted"]
        assert located.stages["retrieval"].radius is None
        best = located.windows[0]
        assert sum(best.contributions) == pytest.approx(2 - 2 * best.score, abs=1e-5)
    measured = found.field_measures()
    assert measured["recall@1"] == 100
    assert measured["dis@1"] < 15
    assert measured["ma@20"] == 100


def _ranked(flight: Flight, scores: np.ndarray, broken: dict[int, str]) -> list[LocatedFrame]:
    """Return frames after retrieval and sequence, with given scores (frames, 25) of 5 x 5 windows that are 40 m apart."""
    places = np.stack(np.meshgrid(*[40.0 * np.arange(-2, 3)] * 2), axis=-1).reshape(-1, 2)
    # One part with a dimension for each window: a window's score is its entry of the frame's descriptor.
    gallery = WindowGallery(
        [Window(x, y, 40.0) for x, y in places.tolist()], 0.0, np.eye(25, dtype=np.float32)[:, None]
    )
    described = [None if i in broken else row[None, None].astype(np.float32) for i, row in enumerate(scores)]
    flown = replace(flight, frames=flight.frames[: len(scores)])
    frames = [LocatedFrame(frame, np.zeros(2)) for frame in flown.frames]
    found = MapRetrieval(gallery, [FrameViews(math.nan, 1.0, [0.0])] * len(scores), described, 32, broken)
    ranked_stages.enter_retrieval(found, frames, 2)
    ranked_stages.enter_sequence(found, flown, frames, np.zeros((0, 2)))
    return frames


@pytest.mark.parametrize("turned", [0, 90])
def test_steps_along_the_headings_show_that_the_map_is_of_the_flights_place(flight: Flight, turned: int) -> None:
    columns = [0, 1, 2, 3, 4, 3, 2, 1, 0, 1, 2, 3]
    east = [True] * 5 + [False] * 4 + [True] * 3
    frames = tuple(
        replace(flight.frames[0], time=4.0 * i, heading=float((90 if along else 270) + turned) % 360)
        for i, along in enumerate(east)
    )
    located = _ranked(replace(flight, frames=frames), np.eye(25)[np.array(columns) + 10], {})
    assert [frame.stages["sequence"].heading for frame in located] == [frame.heading for frame in frames]
    accepted = sum(frame.stages["sequence"].accepted for frame in located)
    assert (accepted > 6) == (turned == 0)


@pytest.mark.parametrize(
    ("nearby", "beyond", "code", "told"),
    [
        (1.0, 0.0, "", "The frames about it agree on this place."),
        (0.02, 0.978, "beyond", "beyond the map's edge, or so near it that"),
        (0.6, 0.4, "unsure", "within 30 m of this place with a probability of 0.6"),
    ],
)
def test_a_frame_that_is_beyond_the_map_or_anywhere_is_refused(
    nearby: float, beyond: float, code: str, told: str
) -> None:
    gallery = WindowGallery([Window(0.0, 0.0, 40.0)], 0.0, np.zeros((1, 1, 1), np.float32))
    answer = ranked_stages.sequence_answer(SequencePoint(np.zeros(2), 1.0, 0.0, nearby, beyond), gallery, True)
    assert (answer.code, answer.accepted) == (code, not code)
    assert told in answer.sentence
    assert answer.numbers.get("probability") in (None, 0.97, 0.6)


def test_photos_that_their_details_place_are_not_beyond_the_map(
    town: Map, flight: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    known, beyond = [], []
    entered, of = pipeline.enter_sequence, SequencePoint.of

    def enter(*given: Any) -> None:
        known.append(given[4:])
        beyond.append({})
        entered(*given)

    def point(joint: np.ndarray, *given: Any) -> SequencePoint:
        beyond[-1][len(beyond[-1])] = joint[-given[-1] :].sum()  # from the last frame to the first
        return of(joint, *given)

    monkeypatch.setattr(pipeline, "enter_sequence", enter)
    monkeypatch.setattr(SequencePoint, "of", point)
    blind = replace(flight.frames[2], name="blind.png", file=flight.frames[2].file.with_name("blind.png"), time=4.5)
    cv2.imwrite(str(blind.file), np.full((SIZE[1], SIZE[0], 3), 90, np.uint8))
    frames = (*flight.frames[:3], blind, replace(blind, time=5.0), flight.frames[3])
    found = locate(town, replace(flight, frames=frames), GridModel(), SIFT)  # type: ignore[arg-type]
    states = [frame.stages["registration"].accepted for frame in found.frames]
    assert states == [True, True, True, False, False, True]
    assert known == [(), ({0, 1, 2},)], "the last one stands alone"
    first, again = (np.array(list(reversed(one.values()))) for one in beyond)
    assert (first > 0).all()
    assert again[:3].tolist() == [0.0] * 3
    assert (again[3:] > 0).all()
    assert (again[3:] < first[3:]).all()


def test_a_sequence_refuses_what_it_cannot_place(flight: Flight, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ranked_stages, "EVIDENCE", 0.0)
    sure, lost = np.eye(25)[12], np.zeros(25)
    located = _ranked(flight, np.stack([sure, sure, sure]), {1: "The file is broken."})
    answers = [frame.stages["sequence"] for frame in located]
    assert [answer.state for answer in answers] == ["accepted", "refused", "accepted"]
    assert answers[1].sentence == "The photo cannot be read; the position is a guess from its neighbours."
    assert answers[1].x == pytest.approx(0, abs=1)
    for answer in (frame.stages["sequence"] for frame in _ranked(flight, np.stack([lost, lost]), {})):
        assert answer.state == "refused"
        assert "is larger than a piece of the map, 40 m wide" in answer.sentence


def test_a_retrieval_tells_its_score_and_margin(flight: Flight) -> None:
    scores = np.zeros((1, 25))
    scores[0, 12], scores[0, 0] = 0.9, 0.65
    (frame,) = _ranked(flight, scores, {})
    told = "The best of 25 windows has the score 0.900; the margin to windows apart from it is 0.500 d²; not verified."
    assert frame.stages["retrieval"].sentence == told


def test_frames_that_cannot_be_read_are_misses(town: Map, flight: Flight, tmp_path: Path) -> None:
    (tmp_path / "broken.jpg").write_bytes(b"nothing")
    frames = (replace(flight.frames[0], file=tmp_path / "broken.jpg"), flight.frames[1], flight.frames[3])
    options = LocateOptions(sequence=False, register=False, overlap=0.88)
    found = locate(town, replace(flight, frames=frames), GridModel(), options)  # type: ignore[arg-type]
    measured = found.field_measures()
    assert measured["recall@10"] == pytest.approx(200 / 3)
    assert measured["ma@100"] == pytest.approx(200 / 3)
    assert measured["sdm@1"] < 0.67
    assert measured["dis@1"] < 100
    assert any("1 of 3 photos cannot be read; the retrieval's measures count them" in note for note in found.notes)


def test_windows_have_the_sizes_that_frames_show(town: Map, flight: Flight) -> None:
    assert pyramid_sizes(town, flight.frames) == pytest.approx([0.85 * 0.75 * WIDTH])
    unknown = [replace(frame, fov=None) for frame in flight.frames]
    sizes = pyramid_sizes(town, unknown)
    assert sizes == sorted(sizes)
    assert len(sizes) == 5
    heights = [replace(flight.frames[0], height_above_ground=h) for h in (40.0, 80.0, 120.0)]
    assert len(pyramid_sizes(town, heights)) == 4


def test_the_commands_write_a_track_and_measures(
    town: Map,
    flight: Flight,
    tmp_path: Path,
    refused: Refused,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write_flight(replace(flight, frames=flight.frames[:2]), tmp_path / "flight")
    where = ["--map", str(town.sheets[0].raster.path), "--flight", str(tmp_path / "flight")]
    track = tmp_path / "track.geojson"
    assert main(["locate", *where, "--matcher", "sift", "--limit", "1", "--out", str(track)]) == 0
    features = json.loads(track.read_text())["features"]
    assert [entry["properties"]["state"] for entry in features] == ["accepted"]
    assert features[0]["properties"]["point"] == "camera"
    assert "details matched by SIFT agree" in capsys.readouterr().out
    kept = {"0.png": Correction.of(_corners((5.0, 5.0), 90.0), town.frame)}
    set_correction(tmp_path / "flight" / "corrections.csv", "0.png", kept["0.png"])
    assert main(["locate", *where, "--matcher", "sift", "--limit", "1", "--out", str(track)]) == 0
    assert [entry["properties"]["stage"] for entry in json.loads(track.read_text())["features"]] == ["by hand"]
    said = " ".join(capsys.readouterr().out.split())
    assert "1 of 1 photos are corrected by hand." in said
    assert "Errors are against corrections by hand (1), and the GPS tags of the other photos" in said
    assert "named track.shp" in refused("locate", *where, "--out", tmp_path / "track.shp")
    survey = tmp_path / "survey.csv"
    eastings = town.frame.utm(PLACES[:2]).tolist()
    survey.write_text("photo,easting,northing\n" + "".join(f"{i},{e - 1},{n}\n" for i, (e, n) in enumerate(eastings)))
    compared = ["--positions", str(survey), "--no-corrections"]
    assert "without their CRS" in refused("locate", *where, *compared)
    compared += ["--crs", "32632", "--residuals", str(tmp_path / "residuals.csv"), "--json", str(tmp_path / "all.json")]
    assert main(["locate", *where, *compared]) == 0
    said = capsys.readouterr().out
    assert "Against surveyed positions" in said
    assert "by hand" not in said
    measured = json.loads((tmp_path / "all.json").read_text())
    assert measured["notes"] == ["Radii of registrations include 1.5 m for the error of the map itself."]
    assert (measured["frames"], measured["corrected"], measured["stages"]["registration"]["photos"]) == (2, 0, 2)
    assert measured["surveyed"]["registration"]["camera"]["bias_east"] == pytest.approx(1.0, abs=0.6)
    assert len((tmp_path / "residuals.csv").read_text().splitlines()) == 3
    monkeypatch.setattr(pipeline, "locate", lambda *_: pytest.fail("located before its survey was checked"))
    survey.write_text(survey.read_text() + "x.png,5,5\n0.png,5,5\n")
    same = ["--positions", str(survey), "--residuals", str(tmp_path / "flight" / ".." / "survey.csv")]
    assert "has two surveyed positions of its camera" in refused("locate", *where, *compared)
    assert "--positions and --residuals both name" in refused("locate", *where, *same)
    assert "--crs belongs to --positions" in refused("locate", *where, "--crs", "32632")


def test_the_command_says_beside_the_track_how_many_points_are_guesses(
    town: Map, flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    placed = StageRecord("accepted", "It agrees.", 0.0, 0.0, radius=1.0)
    guessed = StageRecord("not verified", "It is the most similar window.", 0.0, 0.0)
    stages = [{"retrieval": guessed}, *[{"registration": placed}] * 3]
    frames = [LocatedFrame(frame, None, of_frame) for frame, of_frame in zip(flight.frames, stages, strict=True)]
    located = LocatedFlight(flight, town, frames, None, [], None)
    monkeypatch.setattr("lpn.flight.commands.locate.LocateCommand.located", lambda *_: (None, located))
    track = tmp_path / "track.geojson"
    assert main(["locate", "--map", "town", "--flight", "monday", "--best", "--out", str(track)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "track.geojson. Best guesses that nothing has verified: 1 of its 4 points" in printed
    features = json.loads(track.read_text())["features"]
    assert [entry["properties"]["frame"] for entry in features] == [frame.name for frame in flight.frames]


def test_a_kind_reaches_each_model(
    town: Map, data: Path, tmp_path: Path, refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    kinds = []

    def load(*_: object, kind: str | None = None, **__: object) -> None:
        kinds.append(kind)
        raise InputError("It is not opened.")

    monkeypatch.setattr("lpn.load", load)
    write_photo(tmp_path / "a.jpg")
    where = ["--map", str(town.sheets[0].raster.path), "--flight", str(tmp_path), "--out", str(tmp_path / "track.csv")]
    bare = ["--model", "bare.pth", "--kind", "dac"]
    for arguments in (
        ["locate", *where, *bare],
        ["doctor", *bare],
        ["compare", str(data), "--model", "bare.pth", "lpn.onnx", "--kind", "dac", "auto"],
    ):
        assert "It is not opened" in refused(*arguments)
    assert kinds == ["dac"] * 3


# Two photos as taken, and two that someone turned by 180 degrees.
PHOTOS = ("DJI_0024", "DJI_0028", "DJI_0031", "DJI_0034")


@pytest.mark.slow
def test_photos_of_brighton_are_registered_and_turned_ones_are_named() -> None:
    if "LPN_FLIGHTS" not in os.environ:
        pytest.skip("LPN_FLIGHTS names no folder of real flights")
    pytest.importorskip("rasterio")
    folder = Path(os.environ["LPN_FLIGHTS"]) / "brighton"
    flight = open_flight(folder / "photos")
    chosen = tuple(frame for frame in flight.frames if frame.file.stem in PHOTOS)
    found = locate(open_map(folder / "map.jpg"), replace(flight, frames=chosen), None, LocateOptions())
    assert [located.stages["registration"].accepted for located in found.frames] == [True] * 4
    assert max(located.error("registration") or 99.0 for located in found.frames) < 4
    assert any("2 photos are turned" in note and "DJI_0024" in note and "DJI_0028" in note for note in found.notes)
