"""The place of the camera of a registered photo, from its tilt, and the error of a flight's tilts from the scatter of places."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.homography import middle_pixel
from lpn.flight.files import Frame
from lpn.flight.files.cameras import rotation
from lpn.flight.locate.registration import Registration, is_turned_over

if TYPE_CHECKING:
    from lpn.flight.locate.located import LocatedFrame, StageRecord

# Largest tilt in degrees for which the camera's place is returned, and 1-sigma errors of a gimbal's and an aircraft's tilt.
_MAX_TILT = 15.0
_TILT_ERROR, _AIRCRAFT_TILT_ERROR = 1.5, 5.0
# The least cosine of a tilt from which the place below the camera is computed: 60 degrees.
_LEAST_DOWN = 0.5
# 1-sigma errors of the direction of a tilted camera in degrees, and of its height as a share.
_DIRECTION_ERROR, _HEIGHT_ERROR = 5.0, 0.1
# Radii keep this share of a tilt's default error, for the part that frames have in common.
COMMON = 0.5
# Neighbours that are compared with a parabola in time, the minimum of such groups, and the maximum of seconds between two.
_NEIGHBOURS = 4
_LEAST_GROUPS = 12
_GAP = 30.0
# Limit of a squared difference in variances (Huber), and the mean of the limited square for normal errors.
_CUT = 4.0
_MEAN = 2 * (1 - math.exp(-_CUT / 2))
# Resolution of the estimate in degrees.
_EXACT = 0.01


def frame_tilt(frame: Frame) -> float:
    """Return the degrees from straight down to the camera's direction; 0 if unknown."""
    return 0.0 if frame.pitch is None else math.degrees(math.acos(rotation(0.0, frame.pitch, frame.roll or 0.0)[2, 2]))


def frame_tilt_error(frame: Frame) -> float:
    """Return the default 1-sigma error of a frame's tilt in degrees; an aircraft banks between the photo and its record."""
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


def scattered_radii(
    frames: Sequence[LocatedFrame], answers: Sequence[StageRecord]
) -> tuple[dict[int, float], list[str]]:
    """Return smaller radii of accepted cameras if their places scatter less than the tilts' default error, and sentences.

    An error that frames have in common, such as a camera mounted askew, moves a whole leg and does not scatter. So the error
    of the tilt is the root of the sum of two squares: of the scatter, and of `COMMON` times the default error. Radii never grow.

    Args:
        answers: of the registration for each frame, without the map's error.

    Returns:
        The radii in metres by the frame's position, also without the map's error.
    """
    radii: dict[int, float] = {}
    notes = []
    for told in sorted({frame_tilt_error(located.frame) for located in frames}):
        rows = [
            (located.frame.time, height_of_width(located.frame, answer.width), answer.radius, answer.x, answer.y, i)
            for i, (located, answer) in enumerate(zip(frames, answers, strict=True))
            if located.stages["registration"].accepted
            and answer.camera
            and not answer.by_pose
            and answer.radius is not None
            and answer.width is not None
            and located.frame.time is not None
            and frame_tilt_error(located.frame) == told
        ]
        times, heights, held, x, y, numbers = np.array(sorted(rows), np.float64).reshape(-1, 6).T
        spreads = np.sqrt(np.maximum(held**2 - (heights * math.tan(math.radians(told))) ** 2, 0))
        scatter = tilt_error(times, np.stack([x, y], axis=1), spreads, heights, told)
        degrees = math.hypot(scatter, COMMON * told)
        if degrees >= told:
            continue
        smaller = np.hypot(spreads, heights * math.tan(math.radians(degrees)))
        radii |= zip(numbers.astype(int).tolist(), smaller.tolist(), strict=True)
        notes.append(
            f"Neighbouring places of the camera scatter by an error of {scatter:.1f} degrees in the tilts. An error that "
            f"photos have in common does not scatter; {COMMON * told:.2g} degrees are assumed for it. So radii count with "
            f"{degrees:.1f} in place of {told:g} degrees."
        )
    return radii, notes


def tilt_error(
    times: Float64Array, places: Float64Array, spreads: Float64Array, heights: Float64Array, most: float
) -> float:
    """Estimate the 1-sigma error of a flight's tilts in degrees, along each axis.

    A drone flies smoothly, so its place is nearly a parabola in time over four neighbouring frames, and their third divided
    difference is pure error. Its variance is the sum of the squared coefficients times spread^2 + (height tan(tilt))^2. The tilt
    solves Huber's second proposal: the squares over their variances, limited to 4, have the mean of normal errors. An error that
    a leg's frames have in common, such as a camera mounted askew, stays unseen.

    Args:
        times: seconds, ascending, (N,).
        places: of the camera in metres, (N, 2).
        spreads: 1-sigma radii of the places without the tilt's error, (N,) metres.
        heights: above ground in metres, (N,).
        most: the largest result in degrees. It is returned if the places scatter more, as in a flight that turns between its
            frames. It is also returned for fewer than 12 groups of four frames less than 30 s apart.
    """
    squares, shares = [], []
    for i in range(len(times) - _NEIGHBOURS + 1):
        group = slice(i, i + _NEIGHBOURS)
        gaps = np.diff(times[group])
        if not ((gaps > 0) & (gaps <= _GAP)).all():
            continue
        apart = times[group, None] - times[group]
        np.fill_diagonal(apart, 1)
        weights = 1 / apart.prod(axis=1)
        weights /= np.linalg.norm(weights)
        squares.append(((weights @ places[group]) ** 2).sum())
        shares.append([(weights**2) @ values[group] ** 2 for values in (spreads, heights)])
    if len(squares) < _LEAST_GROUPS:
        return most
    scatter, (own, height) = np.array(squares), np.array(shares).T

    def too_small(degrees: float) -> bool:
        variances = np.maximum(own + height * math.tan(math.radians(degrees)) ** 2, 1e-12)
        return bool(np.minimum(scatter / variances, _CUT).mean() > _MEAN)

    low, high = 0.0, most
    if too_small(high):
        return most
    while high - low > _EXACT:
        middle = (low + high) / 2
        low, high = (middle, high) if too_small(middle) else (low, middle)
    return high
