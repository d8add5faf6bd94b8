"""The place below the camera of a registered photo, from its tilt."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.homography import middle_pixel
from lpn.flight.files import Frame
from lpn.flight.files.cameras import rotation
from lpn.flight.locate.located import StageRecord
from lpn.flight.locate.registration import Registration, is_turned_over

# Largest tilt in degrees for which the camera's place is returned, and 1-sigma errors of a gimbal's and an aircraft's tilt.
_MAX_TILT = 15.0
_TILT_ERROR, _AIRCRAFT_TILT_ERROR = 1.5, 5.0
# The least cosine of a tilt from which the place below the camera is computed: 60 degrees.
_LEAST_DOWN = 0.5
# 1-sigma errors of the direction of a tilted camera in degrees, and of its height as a share.
_DIRECTION_ERROR, _HEIGHT_ERROR = 5.0, 0.1


def camera_place(frame: Frame, size: tuple[int, int], registration: Registration) -> tuple[Float64Array, float] | None:
    """Return the place below the camera in metres, (2,), and its 1-sigma radius.

    Evenly spread matches determine the photo's middle best: a linear model's variance at (x, y) is 1 + 12 (x / w)^2 +
    12 (y / h)^2 times the variance at the middle of w x h pixels. An error of the tilt moves the place by the height times its
    tangent: 1.5 degrees for a gimbal, and 5 for an aircraft, which banks between the photo and its record.

    Returns:
        None if the tilt is unknown or above 15 degrees, or the model bends too much between the middle and the place.
    """
    nadir = nadir_pixel(frame, size)
    if nadir is None or registration.radius is None or registration.width is None or registration.homography is None:
        return None
    down = float(rotation(0.0, frame.pitch or 0.0, frame.roll or 0.0)[2, 2])
    if down < math.cos(math.radians(_MAX_TILT)):
        return None
    middle = middle_pixel(*size)
    moved = np.array(nadir) - middle
    if registration.turned:  # the file was turned after the flight
        moved = -moved
    depth, there = (float(registration.homography[2] @ (*pixel, 1.0)) for pixel in (middle, middle + moved))
    if not 0.5 < there / depth < 2:
        return None
    spread = registration.radius * math.sqrt(1 + 12 * float(((moved / size) ** 2).sum()))
    height = height_of_width(frame, registration.width)
    radius = math.hypot(spread, height * math.tan(math.radians(told_tilt_error(frame))))
    return registration.to_metres((middle + moved)[None])[0], radius


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
    heading = answer.heading if answer.heading is not None else frame.heading
    if answer.x is None or answer.y is None or answer.camera or answer.radius is None or heading is None:
        return answer
    if frame.pitch is None:
        return answer
    if is_turned_over(answer.turn):
        heading += 180.0
    north, east, down = rotation(heading, frame.pitch, frame.roll or 0.0)[:, 2].tolist()
    if down < _LEAST_DOWN:
        return answer
    height = frame.flying_height
    if answer.width is not None and frame.fov is not None:
        height = height_of_width(frame, answer.width)
    if height is None:
        return answer
    away = height * math.hypot(north, east) / down
    radius = math.hypot(
        answer.radius,
        height / down**2 * math.radians(told_tilt_error(frame)),
        away * math.hypot(math.radians(_DIRECTION_ERROR), _HEIGHT_ERROR),
    )
    return msgspec.structs.replace(
        answer, x=answer.x - height * east / down, y=answer.y - height * north / down, camera=True, radius=radius
    )


def told_tilt(frame: Frame) -> float:
    """Return the degrees from straight down to the camera's direction; 0 if unknown."""
    return 0.0 if frame.pitch is None else math.degrees(math.acos(rotation(0.0, frame.pitch, frame.roll or 0.0)[2, 2]))


def told_tilt_error(frame: Frame) -> float:
    """Return the default 1-sigma error of a frame's tilt in degrees."""
    return _AIRCRAFT_TILT_ERROR if frame.heading_source == "aircraft" else _TILT_ERROR


def height_of_width(frame: Frame, width: float) -> float:
    """Return the height in metres of a camera of known tilt and field of view over ground of a width in metres."""
    down = float(rotation(0.0, frame.pitch or 0.0, frame.roll or 0.0)[2, 2])
    return down * width / 2 / math.tan(math.radians(frame.fov or 0.0) / 2)


def nadir_pixel(frame: Frame, size: tuple[int, int]) -> tuple[float, float] | None:
    """Return the pixel (column, row) of the point below the camera, possibly outside of the picture.

    Args:
        size: width and height of the picture in pixels.

    Returns:
        None if pitch, roll, or field of view is unknown, or the camera looks less than 30 degrees down.
    """
    if frame.pitch is None or frame.roll is None or frame.fov is None:
        return None
    top, right, axis = rotation(0.0, frame.pitch, frame.roll)[2]
    if axis < _LEAST_DOWN:
        return None
    focal = size[0] / 2 / math.tan(math.radians(frame.fov) / 2)
    return (size[0] - 1) / 2 + focal * right / axis, (size[1] - 1) / 2 - focal * top / axis
