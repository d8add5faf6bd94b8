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
from lpn.flight.locate.camera_place import camera_place, height_of_width
from lpn.flight.locate.registration import Registration

HEIGHT, SPREAD = 100.0, 0.2
FRAME = Frame("a", Path("a"), 80, 60, heading_source="gimbal", pitch=-90.0, roll=0.0, fov=70.0)


@pytest.mark.parametrize(("source", "degrees"), [("gimbal", 1.5), ("aircraft", 5.0)])
def test_the_camera_is_where_the_footprint_has_it_and_its_radius_holds_the_error_of_the_tilt(
    source: HeadingSource, degrees: float
) -> None:
    frame = replace(FRAME, heading=30.0, heading_source=source, pitch=-80.0, roll=7.0)
    corners = footprint(frame, HEIGHT)
    assert corners is not None
    homography = four_point_homography(corner_pixels(80, 60), corners)
    laid = Registration(None, "SIFT", covariance=0.04 * np.eye(2)).laid(homography, (80, 60), None)
    found = camera_place(frame, (80, 60), laid)
    assert found is not None
    np.testing.assert_allclose(found[0], 0, atol=1e-6)
    assert laid.width is not None
    by_tilt = height_of_width(frame, laid.width) * math.tan(math.radians(degrees))
    assert math.hypot(0.2, by_tilt) < found[1] < math.hypot(0.3, by_tilt)
    straight = replace(frame, pitch=-90.0, roll=0.0)
    by_tilt = height_of_width(straight, laid.width) * math.tan(math.radians(degrees))
    middle = camera_place(straight, (80, 60), laid)
    assert middle is not None
    assert middle[1] == pytest.approx(math.hypot(0.2, by_tilt))
    assert camera_place(replace(frame, roll=None), (80, 60), laid) is None
    assert camera_place(replace(frame, pitch=-70.0), (80, 60), laid) is None
