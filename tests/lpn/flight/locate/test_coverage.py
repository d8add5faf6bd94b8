from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lpn.flight.files import Frame, footprint
from lpn.flight.locate.coverage import corners_of, outline, seen_by
from lpn.flight.locate.located import LocatedFrame, StageRecord
from tests.lpn.flight.locate.scenery import ground_to_photo

FRAME = Frame(
    "a", Path("a"), 80, 60, height_above_ground=30.0, heading=40.0, heading_source="gimbal", pitch=-80.0, fov=60.0
)
TAG = np.array([100.0, -50.0])


def test_corners_are_those_of_the_outermost_pixels() -> None:
    homography = np.linalg.inv(ground_to_photo((10.0, 20.0), 90.0, 80.0, (80, 60)))
    # The top of the picture points east: its right is south.
    expected = [(40.0, 60.0), (40.0, -20.0), (-20.0, -20.0), (-20.0, 60.0)]
    np.testing.assert_allclose(corners_of(homography, 80, 60), expected, atol=1e-9)


def test_a_picture_that_shows_the_horizon_has_no_corners() -> None:
    homography = np.array([[1.0, 0, 0], [0, -1, 0], [0, -1 / 20, 1]])
    assert corners_of(homography, 80, 30) is None
    assert corners_of(homography, 80, 10) is not None


def test_an_accepted_registration_comes_before_the_cameras_model() -> None:
    matrix = np.linalg.inv(ground_to_photo((0.0, 0.0), 0.0, 40.0, (80, 60))).ravel().tolist()
    stages = {"registration": StageRecord("accepted", "", 0.0, 0.0, homography=matrix)}
    found = outline(LocatedFrame(FRAME, TAG, stages))
    assert found.registered
    np.testing.assert_allclose(found.corners[0], (-20.0, 15.0), atol=1e-9)
    stages = {"registration": StageRecord("refused", "", 0.0, 0.0, homography=matrix)}
    refused = outline(LocatedFrame(FRAME, TAG, stages))
    assert not refused.registered
    np.testing.assert_allclose(refused.corners, footprint(FRAME) + TAG)


def test_without_a_tag_the_sequence_places_the_picture_and_without_both_nothing_is_known() -> None:
    stages = {"sequence": StageRecord("accepted", "", 7.0, 9.0, radius=20.0)}
    found = outline(LocatedFrame(FRAME, None, stages))
    # A camera at 30 m, 10 degrees from straight down, sees in its middle the ground 30 tan(10°) ahead.
    camera = found.corners[0] - footprint(FRAME)[0]
    ahead = 30 * np.tan(np.radians(10)) * np.array([np.sin(np.radians(40)), np.cos(np.radians(40))])
    np.testing.assert_allclose(camera + ahead, (7.0, 9.0), atol=1e-6)
    assert outline(LocatedFrame(FRAME, None)) is None
    assert outline(LocatedFrame(Frame("a", Path("a"), 80, 60), TAG)) is None


@pytest.mark.parametrize(("spot", "frames"), [((100.0, -50.0), [0]), ((7.0, 9.0), [2]), ((5000.0, 0.0), [])])
def test_frames_that_show_a_spot(spot: tuple[float, float], frames: list[int]) -> None:
    stages = {"sequence": StageRecord("accepted", "", 7.0, 9.0, radius=20.0)}
    outlines = [outline(LocatedFrame(FRAME, TAG)), None, outline(LocatedFrame(FRAME, None, stages))]
    assert seen_by(outlines, *spot) == frames
