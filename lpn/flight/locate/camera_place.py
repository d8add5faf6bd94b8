"""The place of the camera of a registered photo, from its tilt."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.homography import middle_pixel
from lpn.flight.files import Frame
from lpn.flight.files.cameras import rotation
from lpn.flight.locate.registration import Registration, is_turned_over

if TYPE_CHECKING:
    from lpn.flight.locate.located import StageRecord

# Largest tilt in degrees for which the camera's place is returned, and 1-sigma errors of a gimbal's and an aircraft's tilt.
_MAX_TILT = 15.0
_TILT_ERROR, _AIRCRAFT_TILT_ERROR = 1.5, 5.0
# The least cosine of a tilt from which the place below the camera is computed: 60 degrees.
_LEAST_DOWN = 0.5
# 1-sigma errors of the direction of a tilted camera in degrees, and of its height as a share.
_DIRECTION_ERROR, _HEIGHT_ERROR = 5.0, 0.1


def frame_tilt(frame: Frame) -> float:
    """Return the degrees from straight down to the camera's direction; 0 if unknown."""
    return 0.0 if frame.pitch is None else math.degrees(math.acos(rotation(0.0, frame.pitch, frame.roll or 0.0)[2, 2]))


def frame_tilt_error(frame: Frame) -> float:
    """Return the 1-sigma error of a frame's tilt in degrees; an aircraft banks between the photo and its record."""
    return _AIRCRAFT_TILT_ERROR if frame.heading_source == "aircraft" else _TILT_ERROR


def height_of_width(frame: Frame, width: float) -> float:
    """Return the height in metres of a camera of known tilt and field of view over ground of a width in metres."""
    down = float(rotation(0.0, frame.pitch or 0.0, frame.roll or 0.0)[2, 2])
    return down * width / 2 / math.tan(math.radians(frame.fov or 0.0) / 2)


def camera_place(frame: Frame, size: tuple[int, int], registration: Registration) -> tuple[Float64Array, float] | None:
    """Return the place below the camera in metres, (2,), and its 1-sigma radius.

    Evenly spread matches determine the photo's middle best. A linear model's variance at (x, y) is 1 + 12 (x / w)^2 +
    12 (y / h)^2 times the variance at the middle of w x h pixels. An error of the tilt moves the place by the height times its
    tangent.

    Returns:
        None if the tilt is unknown or above 15 degrees, or the homography's depth halves or doubles from the middle to the place.
    """
    radius, width, homography = registration.radius, registration.width, registration.homography
    if frame.pitch is None or frame.roll is None or frame.fov is None:
        return None
    if radius is None or width is None or homography is None:
        return None
    top, right, down = rotation(0.0, frame.pitch, frame.roll)[2].tolist()
    if down < math.cos(math.radians(_MAX_TILT)):
        return None
    focal, middle = size[0] / 2 / math.tan(math.radians(frame.fov) / 2), middle_pixel(*size)
    moved = np.array([right, -top]) * focal / down
    if is_turned_over(registration.turn):  # the file was turned after the flight
        moved = -moved
    depth, there = (float(homography[2] @ (*pixel, 1.0)) for pixel in (middle, middle + moved))
    if not 0.5 < there / depth < 2:
        return None
    spread = radius * math.sqrt(1 + 12 * float(((moved / size) ** 2).sum()))
    by_tilt = height_of_width(frame, width) * math.tan(math.radians(frame_tilt_error(frame)))
    return registration.to_metres((middle + moved)[None])[0], math.hypot(spread, by_tilt)


def below_camera(frame: Frame, answer: StageRecord) -> StageRecord:
    """Move an answer from the ground at the picture's middle to the ground below the camera, if the tilt is known.

    On flat ground their distance is the height times the tangent of the tilt, in the direction of the picture's top. The radius
    includes the 1-sigma errors of tilt (1.5 degrees for a gimbal, 5 for an aircraft), direction (5 degrees), and height (a
    tenth).

    Args:
        answer: of any stage for the frame; a camera's place is returned unchanged.

    Returns:
        The answer unchanged where heading, pitch, or height is unknown, or the camera looks less than 30 degrees down.
    """
    heading, height = answer.heading if answer.heading is not None else frame.heading, frame.flying_height
    if answer.width is not None and frame.fov is not None and frame.pitch is not None:
        height = height_of_width(frame, answer.width)
    if answer.x is None or answer.y is None or answer.camera or answer.radius is None:
        return answer
    if heading is None or frame.pitch is None or height is None:
        return answer
    heading += 180.0 * is_turned_over(answer.turn)
    north, east, down = rotation(heading, frame.pitch, frame.roll or 0.0)[:, 2].tolist()
    if down < _LEAST_DOWN:
        return answer
    away = height * math.hypot(north, east) / down
    radius = math.hypot(
        answer.radius,
        height / down**2 * math.radians(frame_tilt_error(frame)),
        away * math.hypot(math.radians(_DIRECTION_ERROR), _HEIGHT_ERROR),
    )
    x, y = answer.x - height * east / down, answer.y - height * north / down
    return msgspec.structs.replace(answer, x=x, y=y, camera=True, radius=radius)
