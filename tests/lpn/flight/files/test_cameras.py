"""Footprints against rays that are cast one by one, and fields of view against arithmetic by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lpn.flight.files import Frame, footprint, ground_width
from lpn.flight.files.cameras import fov_of_equivalent, from_gimbal, turned

DOWN = Frame("a", Path("a"), 400, 300, heading=0.0, heading_source="gimbal", pitch=-90.0, roll=0.0, fov=60.0)


def turn(vector: np.ndarray, axis: np.ndarray, degrees: float) -> np.ndarray:
    """Turn a vector about an axis by the right hand (Rodrigues' formula)."""
    angle = math.radians(degrees)
    return (
        vector * math.cos(angle)
        + np.cross(axis, vector) * math.sin(angle)
        + axis * (axis @ vector) * (1 - math.cos(angle))
    )


def cast(frame: Frame, height: float, column: float, row: float) -> np.ndarray | None:
    """Cast the ray of a pixel to the ground: metres east and north; (east, north, up), axes turned one after another."""
    east, north, up = np.eye(3)
    # A camera that looks straight down: the turn by roll about the top, by pitch about the right, by heading about down.
    top, right, axis = north, east, -up
    around = frame.roll or 0.0
    top, right, axis = top, turn(right, top, around), turn(axis, top, around)
    over = (frame.pitch or 0.0) + 90.0
    # Tilting looks ahead, about the level right-hand direction of the heading.
    top, right, axis = (turn(v, east, over) for v in (top, right, axis))
    top, right, axis = (turn(v, -up, frame.heading or 0.0) for v in (top, right, axis))
    focal_length = frame.width / 2 / math.tan(math.radians(frame.fov or 0.0) / 2)
    ray = axis * focal_length + right * (column - frame.width / 2) - top * (row - frame.height / 2)
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


def test_a_picture_from_above_is_a_rectangle_with_its_top_to_the_heading() -> None:
    half = 50 * math.tan(math.radians(30))
    corners = [(-half, 0.75 * half), (half, 0.75 * half), (half, -0.75 * half), (-half, -0.75 * half)]
    np.testing.assert_allclose(footprint(DOWN, 50.0), corners)
    east = footprint(replace(DOWN, heading=90.0), 50.0)
    assert east is not None
    np.testing.assert_allclose(east, [(north, -east) for east, north in corners], atol=1e-12)
    assert ground_width(DOWN, 50.0) == pytest.approx(2 * half)


def test_heights_of_the_frame_are_used_and_unknown_values_give_none() -> None:
    low = replace(DOWN, height_above_takeoff=50.0)
    np.testing.assert_allclose(footprint(low), footprint(DOWN, 50.0))
    np.testing.assert_allclose(footprint(replace(low, height_above_ground=30.0)), footprint(DOWN, 30.0))
    assert footprint(DOWN) is None
    assert ground_width(DOWN) is None
    for unknown in ({"heading": None}, {"pitch": None}, {"fov": None}, {"height_above_takeoff": -2.0}):
        assert footprint(replace(low, **unknown)) is None
    assert footprint(replace(low, pitch=0.0)) is None
    assert ground_width(replace(low, pitch=0.0)) is None
    assert ground_width(replace(low, pitch=None, heading=None)) == ground_width(low)
    assert ground_width(replace(low, pitch=-30.0)) == pytest.approx(2 * (ground_width(low) or 0))


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


def test_a_gimbal_upside_down_turns_the_picture() -> None:
    assert from_gimbal(30.0, -90.0, 180.0)[0] == pytest.approx(210.0)
    assert from_gimbal(-30.0, -90.0, 0.0) == (330.0, -90.0, 0.0)
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
    assert found is not None
    assert expected is not None
    # After one turn clockwise the corner at the bottom left is at the top left.
    np.testing.assert_allclose(found, np.roll(expected, turns, axis=0), atol=1e-9)


def test_equivalent_focal_lengths_compare_diagonals() -> None:
    # 1/2.3 inch (6.17 mm wide), 1 inch (13.2 mm wide), and the film itself.
    assert fov_of_equivalent(20.27, 3.61) == pytest.approx(2 * math.degrees(math.atan(6.17 / 2 / 3.61)), rel=5e-3)
    assert fov_of_equivalent(24.0, 8.8) == pytest.approx(2 * math.degrees(math.atan(13.2 / 2 / 8.8)), rel=5e-3)
    assert fov_of_equivalent(50.0, 50.0) == pytest.approx(2 * math.degrees(math.atan(36 / 2 / 50)))
    assert fov_of_equivalent(20.0) == fov_of_equivalent(20.0, 3.61)
