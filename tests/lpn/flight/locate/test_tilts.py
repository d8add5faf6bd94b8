"""The place of a camera below its tilted photo, and the error of a flight's tilts from the scatter of such places."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lpn.core.homography import corner_pixels, four_point_homography
from lpn.flight.files import Frame, footprint
from lpn.flight.files.base import HeadingSource
from lpn.flight.locate.camera_place import camera_place, frame_tilt_error, height_of_width, scattered_radii, tilt_error
from lpn.flight.locate.errors import RIGHT_CALIBRATION
from lpn.flight.locate.located import LocatedFrame, StageRecord
from lpn.flight.locate.registration import Registration

HEIGHT, SPREAD = 100.0, 0.2
FRAME = Frame("a", Path("a"), 80, 60, heading_source="gimbal", pitch=-90.0, roll=0.0, fov=70.0)


@pytest.mark.parametrize(("source", "degrees"), [("gimbal", 1.5), ("aircraft", 5.0)])
def test_the_camera_is_where_the_footprint_has_it_and_its_radius_holds_the_error_of_the_tilt(
    source: HeadingSource, degrees: float
) -> None:
    frame = replace(FRAME, heading=30.0, heading_source=source, pitch=-80.0, roll=7.0)
    corners = footprint(frame, HEIGHT)
    homography = four_point_homography(corner_pixels(80, 60), corners)
    laid = Registration(None, "SIFT", covariance=0.04 * np.eye(2)).laid(homography, (80, 60), None)
    found = camera_place(frame, (80, 60), laid)
    np.testing.assert_allclose(found[0], 0, atol=1e-6)
    by_tilt = height_of_width(frame, laid.width) * math.tan(math.radians(degrees))
    assert math.hypot(0.2, by_tilt) < found[1] < math.hypot(0.3, by_tilt)
    straight = replace(frame, pitch=-90.0, roll=0.0)
    by_tilt = height_of_width(straight, laid.width) * math.tan(math.radians(degrees))
    middle = camera_place(straight, (80, 60), laid)
    assert middle[1] == pytest.approx(math.hypot(0.2, by_tilt))
    assert camera_place(replace(frame, roll=None), (80, 60), laid) is None
    assert camera_place(replace(frame, pitch=-70.0), (80, 60), laid) is None


def _flown(count: int, degrees: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times, places, and the errors of the places of a smooth flight."""
    times = np.cumsum(3 + rng.uniform(-0.3, 0.3, count))
    track = np.stack([150 * np.sin(times / 40), 4 * times], axis=1)
    deviation = math.hypot(SPREAD, HEIGHT * math.tan(math.radians(degrees)))
    errors = rng.normal(0, deviation, track.shape)
    return times, track + errors, np.linalg.norm(errors, axis=1)


def _registered(
    times: np.ndarray, places: np.ndarray, radius: float, width: float
) -> tuple[list[LocatedFrame], list[StageRecord]]:
    answers = [StageRecord("accepted", "It agrees.", float(x), float(y), True, radius, width=width) for x, y in places]
    rows = zip(times.tolist(), answers, strict=True)
    return [LocatedFrame(replace(FRAME, time=time), None, {"registration": answer}) for time, answer in rows], answers


@pytest.mark.parametrize("degrees", [0.3, 0.8])
def test_the_scatter_tells_the_tilts_error_and_radii_cover_as_they_should(degrees: float) -> None:
    rng = np.random.default_rng(1)
    within: dict[int, list[float]] = {k: [] for k in RIGHT_CALIBRATION}
    tilts = []
    for _ in range(12):
        times, places, errors = _flown(60, degrees, rng)
        places[17] += 40.0  # one false place
        tilts.append(tilt_error(times, places, np.full(60, SPREAD), np.full(60, HEIGHT), 1.5))
        radius = math.hypot(SPREAD, HEIGHT * math.tan(math.radians(tilts[-1])))
        for k, shares in within.items():
            shares.append(100 * float(np.mean(errors <= k * radius)))
    assert np.mean(tilts) == pytest.approx(degrees, rel=0.15)
    for k, right in RIGHT_CALIBRATION.items():
        assert np.mean(within[k]) == pytest.approx(right, abs=7)


def test_what_the_flight_cannot_tell_keeps_the_prior() -> None:
    rng = np.random.default_rng(0)
    times, places, _ = _flown(60, 0.3, rng)
    values = np.full(60, SPREAD), np.full(60, HEIGHT)
    assert tilt_error(times * 20, places, *values, 1.5) == 1.5  # a minute apart
    assert tilt_error(times[:14], places[:14], values[0][:14], values[1][:14], 1.5) == 1.5
    assert tilt_error(times, rng.permutation(places), *values, 1.5) == 1.5


def test_radii_of_a_smooth_flight_count_with_its_own_tilts() -> None:
    told, width = frame_tilt_error(FRAME), 140.0
    height = height_of_width(FRAME, width)
    times, places, _ = _flown(40, 0.4, np.random.default_rng(2))
    radius = math.hypot(SPREAD, height * math.tan(math.radians(told)))
    frames, answers = _registered(times, places, radius, width)
    radii, (note,) = scattered_radii(frames, answers)
    assert "in place of 1.5 degrees" in note
    assert list(radii) == list(range(40))
    assert 0.5 * radius < min(radii.values()) <= max(radii.values()) < 0.7 * radius
    assert scattered_radii(frames[:10], answers[:10]) == ({}, [])


def test_a_tilt_that_is_wrong_by_the_same_angle_along_each_leg_stays_within_the_radii() -> None:
    """The camera is mounted askew by 0.8 degrees, so its places lie behind on the way there, and ahead on the way back."""
    rng = np.random.default_rng(5)
    times = np.arange(48.0) * 3 + np.repeat(np.arange(4), 12) * 11
    ways = np.repeat([1.0, -1.0, 1.0, -1.0], 12)
    flown = np.tile(15.0 * np.arange(12), 4)
    truth = np.stack([np.repeat(40.0 * np.arange(4), 12), np.where(ways > 0, flown, 165 - flown)], axis=1)
    places = truth + rng.normal(0, HEIGHT * math.tan(math.radians(0.3)), truth.shape)
    places[:, 1] -= ways * HEIGHT * math.tan(math.radians(0.8))
    width = 2 * HEIGHT * math.tan(math.radians(35.0))
    radius = math.hypot(SPREAD, HEIGHT * math.tan(math.radians(1.5)))
    smaller, (note,) = scattered_radii(*_registered(times, places, radius, width))
    assert "0.75 degrees are assumed for it" in note
    radii = np.array(list(smaller.values()))
    errors = np.linalg.norm(places - truth, axis=1)
    assert radii.max() < 0.7 * radius
    for k, right in ((1, RIGHT_CALIBRATION[1] - 5), (2, 98), (3, 100)):
        assert 100 * (errors <= k * radii).mean() >= right
