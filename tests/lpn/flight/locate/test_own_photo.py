"""One photo of no flight on a drawn map: its details alone place it and lie at their places; one of another land is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lpn.core.demo import DEMO_FLIGHT, DEMO_PLACE
from lpn.core.homography import apply_homography, corner_pixels, four_point_homography, inverse
from lpn.core.images import load_picture
from lpn.flight.files import Frame, footprint
from lpn.flight.locate import ground, registration
from lpn.flight.locate.ground import MapFeatures
from lpn.flight.locate.levelled import PhotoView
from lpn.flight.locate.located import LocatedFrame
from lpn.flight.locate.matchers import Ground, SiftMatcher, open_matchers
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.own_photo import register_own_photo
from lpn.flight.locate.registered_stage import PhotoSearch, register_photo
from lpn.flight.locate.registration import PhotoPlace, Registration
from lpn.flight.maps import Map, Window, open_map
from tests.lpn.flight.locate.scenery import ground_to_photo, land, photo_of, write_map

SIZE = (320, 240)
# A file with height and field of view, so that one width of 70 m is tried; its size is the camera's.
FLOWN = Frame("own.jpg", Path("own.jpg"), 4000, 3000, height_above_ground=35.0, fov=90.0)


@pytest.fixture
def features(town: Map) -> list[MapFeatures]:
    return [MapFeatures(town, SiftMatcher())]


def photo(of: int = 0) -> np.ndarray:
    return photo_of(land(of), ground_to_photo((20.0, -30.0), 130.0, 70.0, SIZE), SIZE)


def test_a_photo_of_which_nothing_is_known_is_placed_by_its_details(town: Map, features: list[MapFeatures]) -> None:
    progress: list[tuple[int, int]] = []
    own = register_own_photo(town, features, photo(), None, [], lambda *counts: progress.append(counts))
    assert own.answer.accepted
    assert own.whole_map
    assert np.hypot(own.answer.x - 20.0, own.answer.y + 30.0) < 1.0
    assert own.answer.heading == pytest.approx(130.0, abs=1.0)
    assert own.answer.pose is None
    assert "Nothing tells the photo's field of view" in own.answer.finding
    assert own.answer.radius >= 1.0, "the map's own error is part of it"
    assert progress[0] == (0, 4)


@pytest.mark.parametrize(
    ("frame", "tried"),
    [(FLOWN, ""), (None, "The width of its ground is unknown, so 9 to 246 m were tried.")],
)
def test_a_photo_of_another_land_is_refused(
    town: Map, features: list[MapFeatures], frame: Frame | None, tried: str
) -> None:
    own = register_own_photo(town, features, photo(of=1), frame, [])
    assert (own.answer.state, own.answer.finding) == ("refused", tried)
    assert own.answer.reason_and_note[0]
    assert own.answer.details is None


@pytest.mark.slow
def test_a_photo_of_another_place_is_refused_on_the_shipped_map() -> None:
    town = open_map(DEMO_PLACE[0])
    features = [MapFeatures(town, matcher) for matcher in open_matchers()]
    own = register_own_photo(town, features, load_picture(DEMO_FLIGHT[1] / "LPN_0086.webp"), None, [])
    assert (own.answer.accepted, own.whole_map) == (False, True)


def test_what_a_file_with_the_tag_of_another_region_tells_is_not_believed(
    town: Map, features: list[MapFeatures]
) -> None:
    latitude, longitude = town.frame.degrees([(0.0, 0.0)])[0]
    far, near = (
        replace(FLOWN, height_above_ground=5.0, latitude=latitude + off, longitude=longitude) for off in (1, 0)
    )
    own = register_own_photo(town, features, photo(), far, [])
    assert own.answer.accepted
    assert own.located.error("registration") == pytest.approx(111_000, rel=0.01)
    assert not register_own_photo(town, features, photo(), near, []).answer.accepted, "10 m across, it tells"


@pytest.mark.parametrize(
    ("own", "others", "accepted"), [(29, [], False), (30, [], True), (31, [4], False), (31, [17], True)]
)
def test_all_matchers_together_must_support_a_photo_of_anywhere(
    own: float, others: list[float], accepted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(registration, "_total_support", lambda *_: sum(others))
    of_flight = Registration(None, "XFeat", support=own, places=(PhotoPlace(70 + 0j, 20 - 30j),))
    nothing = Ground(np.zeros((0, 2)), np.zeros((0, 1), np.float32), 1.0)
    answer = registration.proven(of_flight, PhotoView.plain(photo()), [(SiftMatcher(), nothing) for _ in others])
    assert answer.accepted == accepted
    needs = f"Its best place has a support of {own + sum(others)}, and a photo of unknown place needs {15 * (2 + len(others))}."
    assert accepted or answer.refusal.sentence == needs


def test_a_large_map_is_searched_about_the_most_similar_windows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ground, "MAX_BLOCKS", 3)
    town, windows = write_map(tmp_path / "town.tif", land()), [Window(25.0, -35.0, 60.0)]
    features = [MapFeatures(town, SiftMatcher())]
    near = register_own_photo(town, features, photo(), None, windows, map_error=7.0)
    assert (near.answer.accepted, near.whole_map, near.answer.map_error) == (True, False, 7.0)
    assert near.answer.radius > 7


def test_what_the_progress_raises_ends_the_search(town: Map, features: list[MapFeatures]) -> None:
    def leave(done: int, total: int) -> None:
        raise InterruptedError(f"{done} of {total}")

    with pytest.raises(InterruptedError, match="0 of 4"):
        register_own_photo(town, features, photo(), None, [], leave)


LARGE = (640, 480)
WIDTH, HEADING = 90.0, 130.0
CAMERA = Frame("own.jpg", Path("own.jpg"), *LARGE, height_above_ground=45.0, fov=90.0, heading=HEADING)
TILTED = replace(CAMERA, pitch=-65.0, roll=0.0)


@pytest.mark.parametrize(
    ("true", "frame"),
    [
        (ground_to_photo((20.0, -30.0), HEADING, WIDTH, LARGE), CAMERA),
        (four_point_homography(footprint(TILTED), corner_pixels(*LARGE)), TILTED),
    ],
    ids=["from above", "levelled"],
)
def test_details_lie_on_the_map_where_the_true_camera_has_them(town: Map, true: np.ndarray, frame: Frame) -> None:
    photo, features = photo_of(land(), true, LARGE), [MapFeatures(town, SiftMatcher())]
    answer = register_photo(PhotoSearch(town, features, LocatedFrame(frame, None), photo, LocateOptions()))
    details = answer.details
    assert answer.inliers > len(details.rows) == 24
    assert 0 < details.median < details.limit
    on_map = details.on_map(np.array(answer.homography).reshape(3, 3), *LARGE)
    by_camera = apply_homography(inverse(true), details.places * LARGE - 0.5)
    assert np.median(np.linalg.norm(on_map - by_camera, axis=1)) < 0.5, "some pixels of the map"
    rows = np.floor(4 * details.places[:, 1])
    assert (np.diff(rows) >= 0).all(), "numbered from the top to the bottom"
    if frame is CAMERA:
        assert details.limit == pytest.approx(0.015 * WIDTH, rel=0.02)
        assert (details.metres <= details.limit).all()
        for quarter in ((0, 0), (0, 1), (1, 0), (1, 1)):
            assert ((details.places >= 0.5) == quarter).all(axis=1).sum() >= 3, "the sample is spread over the photo"
