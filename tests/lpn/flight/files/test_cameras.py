"""Footprints against rays that are cast one by one, and fields of view against arithmetic by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lpn.flight.files import Frame, footprint, ground_width
from lpn.flight.files.cameras import fov_of_equivalent, from_gimbal, turned, upright_values
from lpn.flight.files.lenses import Lens

DOWN = Frame("a", Path("a"), 400, 300, heading=0.0, heading_source="gimbal", pitch=-90.0, roll=0.0, fov=60.0)


def turn(vector: np.ndarray, axis: np.ndarray, degrees: float) -> np.ndarray:
    """Turn a vector about an axis by the right hand (Rodrigues' formula)."""
    sine, cosine = math.sin(math.radians(degrees)), math.cos(math.radians(degrees))
    return vector * cosine + np.cross(axis, vector) * sine + axis * (axis @ vector) * (1 - cosine)


def cast(frame: Frame, height: float, column: float, row: float) -> np.ndarray | None:
    """Cast the ray of a pixel to the ground: metres east and north; (east, north, up), axes turned one after another."""
    east, north, up = np.eye(3)
    focal_length = frame.width / 2 / math.tan(math.radians(frame.fov or 0.0) / 2)
    # A camera that looks straight down, with its top to the north.
    ray = -up * focal_length + east * (column - frame.width / 2) - north * (row - frame.height / 2)
    # It turns by the roll about its top, looks ahead by the pitch, and turns by the heading.
    for axis, degrees in ((north, frame.roll or 0.0), (east, (frame.pitch or 0.0) + 90.0), (-up, frame.heading or 0.0)):
        ray = turn(ray, axis, degrees)
    return None if ray[2] >= 0 else ray[:2] * height / -ray[2]


def test_a_footprint_is_where_the_rays_of_the_corners_meet_the_ground() -> None:
    rng = np.random.default_rng(0)
    met = 0
    for _ in range(300):
        heading, pitch, roll, fov = rng.uniform((0, -130, -40, 20), (360, -20, 40, 100))
        frame = replace(DOWN, heading=heading, pitch=pitch, roll=roll, fov=fov)
        rays = [cast(frame, 70.0, *corner) for corner in ((0, 0), (400, 0), (400, 300), (0, 300))]
        found = footprint(frame, 70.0)
        if found is not None:
            met += 1
            np.testing.assert_allclose(found, np.array(rays), rtol=1e-9, atol=1e-9)
        else:
            # None is for a corner above the horizon, or so near to it that it is 50 heights away.
            assert any(ray is None or np.hypot(*ray) > 40 * 70.0 for ray in rays)
    assert 100 < met < 300


def test_the_width_on_the_ground_takes_the_frame_s_height_and_pitch() -> None:
    low = replace(DOWN, height_above_takeoff=50.0)
    width = 2 * 50 * math.tan(math.radians(30))
    assert ground_width(DOWN, 50.0) == ground_width(low) == pytest.approx(width)
    assert ground_width(replace(low, height_above_ground=30.0)) == ground_width(DOWN, 30.0)
    assert ground_width(replace(low, pitch=None, heading=None)) == pytest.approx(width)
    assert ground_width(replace(low, pitch=-30.0)) == pytest.approx(2 * width)
    np.testing.assert_allclose(footprint(low), footprint(DOWN, 50.0))
    for unknown in ({"heading": None}, {"pitch": None}, {"fov": None}, {"height_above_takeoff": -2.0}, {"pitch": 0.0}):
        assert footprint(replace(low, **unknown)) is None
    assert [footprint(DOWN), ground_width(DOWN), ground_width(replace(low, pitch=0.0))] == [None] * 3


def gimbal_ray(yaw: float, pitch: float, roll: float, right: float, above: float) -> np.ndarray:
    """The direction of a pixel of a gimbal's camera (east, north, up), turned from one that looks level to the north."""
    east, north, up = np.eye(3)
    ray = north + right * east + above * up
    for axis, degrees in ((north, roll), (east, pitch), (-up, yaw)):
        ray = turn(ray, axis, degrees)
    return ray


@pytest.mark.parametrize(
    "angles", [(30.0, -90.0, 180.0), (200.0, -85.0, 3.0), (10.0, -60.0, -20.0), (77.0, -90.0, 0.0)]
)
def test_a_gimbal_s_angles_become_those_of_the_picture(angles: tuple[float, float, float]) -> None:
    heading, pitch, roll = from_gimbal(*angles)
    frame = replace(DOWN, heading=heading, pitch=pitch, roll=roll)
    tangent = math.tan(math.radians(30))
    for column, row in ((0, 0), (400, 0), (123, 280)):
        ray = gimbal_ray(*angles, (column - 200) / 200 * tangent, (150 - row) / 200 * tangent)
        np.testing.assert_allclose(cast(frame, 1.0, column, row), ray[:2] / -ray[2], atol=1e-9)


def test_a_gimbal_upside_down_turns_the_picture_and_a_level_one_keeps_its_angles() -> None:
    assert from_gimbal(30.0, -90.0, 180.0)[0] == pytest.approx(210.0)
    assert from_gimbal(-30.0, -10.0, 2.0) == (330.0, -10.0, 2.0)


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_a_turned_picture_shows_the_same_ground(turns: int) -> None:
    frame = replace(DOWN, heading=40.0, pitch=-75.0, roll=5.0)
    heading, pitch, roll = turned(40.0, -75.0, 5.0, turns)
    sides = (300, 400) if turns % 2 else (400, 300)
    fov = 2 * math.degrees(math.atan(math.tan(math.radians(30)) * sides[0] / 400))
    found = footprint(
        replace(frame, width=sides[0], height=sides[1], heading=heading, pitch=pitch, roll=roll, fov=fov), 60.0
    )
    expected = footprint(frame, 60.0)
    # After one turn clockwise the corner at the bottom left is at the top left.
    np.testing.assert_allclose(found, np.roll(expected, turns, axis=0), atol=1e-9)


@pytest.mark.parametrize(
    ("turns", "size", "across_longer_side", "heading", "fov"),
    [
        (0, (64, 48), False, 40.0, 45.0), (0, (48, 64), False, 40.0, 45.0), (0, (48, 64), True, 40.0, 34.51),
        (1, (48, 64), False, 310.0, 34.51), (1, (64, 48), False, 310.0, 57.82), (1, (48, 64), True, 310.0, 34.51),
        (2, (64, 48), True, 220.0, 45.0), (3, (48, 64), False, 130.0, 34.51),
    ],
)  # fmt: skip
def test_telemetry_turns_with_the_picture(
    turns: int, size: tuple[int, int], across_longer_side: bool, heading: float, fov: float
) -> None:
    frame = replace(DOWN, width=size[0], height=size[1])
    told = upright_values({"heading": 40.0, "fov": 45.0}, turns, frame, across_longer_side)
    assert told == {"heading": pytest.approx(heading), "fov": pytest.approx(fov, abs=0.01)}
    down = upright_values({"heading": 40.0, "pitch": -90.0}, turns, frame)
    assert (down["heading"], down["pitch"]) == pytest.approx((heading, -90.0))
    of_lens = replace(frame, lens=Lens(0.7, 0.7, 0.0, 0.0))
    assert "fov" not in upright_values({"fov": 45.0}, turns, of_lens, across_longer_side)


def test_equivalent_focal_lengths_compare_diagonals() -> None:
    # 1/2.3 inch (6.17 mm wide), 1 inch (13.2 mm wide), and the film itself.
    assert fov_of_equivalent(20.27, 3.61) == pytest.approx(2 * math.degrees(math.atan(6.17 / 2 / 3.61)), rel=5e-3)
    assert fov_of_equivalent(24.0, 8.8) == pytest.approx(2 * math.degrees(math.atan(13.2 / 2 / 8.8)), rel=5e-3)
    assert fov_of_equivalent(50.0, 50.0) == pytest.approx(2 * math.degrees(math.atan(36 / 2 / 50)))
    assert fov_of_equivalent(20.0) == fov_of_equivalent(20.0, 3.61)
