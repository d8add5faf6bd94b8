"""The pinhole camera over flat ground: fields of view, footprints, and widths of pictures on the ground.

The angles turn a camera that looks straight down with the picture's top to the north. The first turn is about the picture's
upward direction (roll), the second about its rightward direction (pitch + 90), the third about the vertical (heading). Near the
vertical, where nearly all pictures are taken, these angles have no gimbal lock. A gimbal counts its roll about the
optical axis instead, which near the vertical is the heading; `from_gimbal` converts.

Vectors are (north, east, down); those of a camera's body are (picture's top, picture's right, optical axis).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.flight.files.base import Frame

# Rays that go down by less than this per metre count as above the horizon: they meet the ground beyond 50 heights.
_LEAST_DOWN = 0.02
# A gimbal's angles are converted below this pitch in degrees. Above it the picture's top points to the sky, so it has no heading.
_STEEP = -45.0
# The body's axes in the axes of a gimbal: (optical axis, right, picture's bottom).
_BODY_IN_GIMBAL = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
# Diagonal in millimetres of the 36 x 24 mm film that equivalent focal lengths refer to.
_FILM_DIAGONAL = math.hypot(36.0, 24.0)
# Limits of a frame's field of view in degrees.
FOV_RANGE = 0.1, 170.0


def rotation(heading: float, pitch: float, roll: float) -> Float64Array:
    """Return the matrix from the camera's body to (north, east, down), (3, 3); angles in degrees as in `Frame`."""
    return _yaw_pitch_roll(heading, pitch + 90.0, roll)


def from_gimbal(yaw: float, pitch: float, roll: float) -> tuple[float, float, float]:
    """Convert a gimbal's yaw, pitch, and roll about the optical axis to heading, pitch, and roll of a `Frame`, in degrees.

    Above a pitch of -45 degrees the angles are returned unchanged; both conventions agree where the roll is 0.
    """
    if roll == 0 or pitch > _STEEP:
        return yaw % 360.0, pitch, roll
    return angles(_yaw_pitch_roll(yaw, pitch, roll) @ _BODY_IN_GIMBAL)


def turned(
    heading: float | None, pitch: float | None, roll: float | None, turns: int
) -> tuple[float | None, float | None, float | None]:
    """Return a picture's angles in degrees after quarter turns clockwise, which bring its left side to the top."""
    if turns and pitch is not None:
        matrix = rotation(heading or 0.0, pitch, roll or 0.0) @ _yaw_pitch_roll(-90.0 * turns, 0.0, 0.0)
        upright, pitch, roll = angles(matrix)
    else:
        upright = ((heading or 0.0) - 90.0 * turns) % 360.0
    return None if heading is None else upright, pitch, roll


def upright_values(
    values: Mapping[str, Any], turns: int, frame: Frame, across_longer_side: bool = False
) -> dict[str, Any]:
    """Return telemetry of a frame with the angles of the upright picture and the field of view across its width.

    A frame of known lens keeps the lens's field of view.

    Args:
        values: named as in `Frame`; None where unknown.
        turns: quarter turns clockwise from the picture as it was taken to the frame.
        across_longer_side: whether the field of view spans the longer side (as in subtitles), not the width before the turns.
    """
    upright = dict(values)
    told = turned(values.get("heading"), values.get("pitch"), values.get("roll"), turns)
    upright |= {n: angle for n, angle in zip(("heading", "pitch", "roll"), told, strict=True) if angle is not None}
    is_across_height = frame.height > frame.width if across_longer_side else turns % 2 == 1
    if frame.lens is not None:
        upright.pop("fov", None)
    elif is_across_height and (fov := values.get("fov")) is not None:
        upright["fov"] = fov_across(fov, frame.width / frame.height)
    return upright


def footprint(frame: Frame, height: float | None = None) -> Float64Array | None:
    """Return the corners of a picture on flat ground, in metres east and north of the camera: (4, 2).

    The order is top left, top right, bottom right, bottom left of the picture. An unknown roll counts as 0. None stands for an
    unknown height, heading, pitch, or field of view, and for a corner at the horizon or above.

    Args:
        height: of the camera above the ground in metres; by default the frame's `flying_height`.
    """
    height = frame.flying_height if height is None else height
    if height is None or height <= 0 or frame.heading is None or frame.pitch is None or frame.fov is None:
        return None
    right = math.tan(math.radians(frame.fov) / 2)
    top = right * frame.height / frame.width
    corners = np.array([(top, -right, 1.0), (top, right, 1.0), (-top, right, 1.0), (-top, -right, 1.0)])
    rays = corners @ rotation(frame.heading, frame.pitch, frame.roll or 0.0).T
    down = rays[:, 2]
    if (down < _LEAST_DOWN * np.linalg.norm(rays, axis=1)).any():
        return None
    return np.asarray(rays[:, [1, 0]] * (height / down)[:, None], np.float64)


def ground_width(frame: Frame, height: float | None = None) -> float | None:
    """Return the metres of flat ground across a picture's middle row, with a `height` as in `footprint`.

    An unknown pitch counts as straight down, and the roll as 0. None stands for an unknown height or field of view, and for a
    camera that looks at the horizon or above.
    """
    height = frame.flying_height if height is None else height
    if height is None or height <= 0 or frame.fov is None:
        return None
    down = 1.0 if frame.pitch is None else -math.sin(math.radians(frame.pitch))
    return None if down < _LEAST_DOWN else 2 * height / down * math.tan(math.radians(frame.fov) / 2)


def fov_of_sensor(width: float, focal_length: float) -> float:
    """Return the field of view in degrees across a width of the sensor; both in one unit, such as millimetres or pixels."""
    return 2 * math.degrees(math.atan(width / 2 / focal_length))


def fov_of_equivalent(equivalent: float, focal_length: float | None = None) -> float:
    """Return the horizontal field of view in degrees of a 35 mm equivalent and a true focal length in millimetres.

    Equivalent focal lengths compare diagonals. The sensor's proportions follow from its diagonal: 1 inch, APS-C, and full frame
    are 3:2, others and unknown ones 4:3. A picture of 16:9 has the sensor's full width.
    """
    diagonal = _FILM_DIAGONAL * (focal_length or 0.0) / equivalent
    wide = 14.0 <= diagonal <= 18.0 or diagonal >= 25.0
    proportion = 3 / math.hypot(3, 2) if wide else 4 / 5
    return fov_of_sensor(_FILM_DIAGONAL * proportion, equivalent)


def fov_across(fov: float, ratio: float) -> float:
    """Return the field of view in degrees across `ratio` times the length that `fov` spans."""
    return 2 * math.degrees(math.atan(math.tan(math.radians(fov) / 2) * ratio))


def angles(matrix: Float64Array) -> tuple[float, float, float]:
    """Return heading, pitch, and roll in degrees of a matrix (3, 3); the inverse of `rotation`."""
    tilt = -math.degrees(math.asin(min(1.0, max(-1.0, float(matrix[2, 0])))))
    heading = math.degrees(math.atan2(matrix[1, 0], matrix[0, 0]))
    return heading % 360.0, tilt - 90.0, math.degrees(math.atan2(matrix[2, 1], matrix[2, 2]))


def angles_of_view(matrix: Float64Array) -> tuple[float, float, float]:
    """Return heading, pitch, and roll in degrees of OpenCV's rotation (3, 3) from (east, north, up) to (right, down, forward)."""
    right, down, forward = matrix
    body = np.stack([-down, right, forward], axis=1)
    return angles(body[[1, 0, 2]] * np.array([[1.0], [1.0], [-1.0]]))


def _yaw_pitch_roll(yaw: float, pitch: float, roll: float) -> Float64Array:
    (cy, sy), (cp, sp), (cr, sr) = ((math.cos(math.radians(a)), math.sin(math.radians(a))) for a in (yaw, pitch, roll))
    about_down = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_right = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_forward = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return np.asarray(about_down @ about_right @ about_forward, np.float64)
