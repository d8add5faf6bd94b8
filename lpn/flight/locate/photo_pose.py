"""The pose of a registered photo's camera, from its matches and the map's heights."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.homography import apply_homography, inverse
from lpn.flight.files import Frame
from lpn.flight.locate.camera_place import frame_tilt_error
from lpn.flight.locate.camera_pose import CameraPose, PoseMatches, solve_pose
from lpn.flight.locate.levelled import PhotoView
from lpn.flight.locate.matchers import Complex
from lpn.flight.locate.registration import Registration, is_turned_over
from lpn.flight.maps import Map

# Reach of the second round of matching around the first pose's predictions, as a share of the picture's width.
_REACH = 0.02
# Ground within this many widths of the picture's middle, by the plane's model, may be in the picture.
_SEEN = 1.0
# Sigmas by which a pose's tilt may differ from the photo's.
_SIGMAS = 3.0
# 1-sigma error of a match in pixels of the compared pictures.
_MATCH_ERROR = 1.0


def photo_pose(basemap: Map, frame: Frame, view: PhotoView, registration: Registration) -> CameraPose | str:
    """Solve the pose of a photo's camera; on flat ground if the map has no elevation.

    Args:
        view: the registered picture.
        registration: of the photo, with its matches; `homography` and `width` are of the photo itself.

    Returns:
        The pose, or a sentence with the reason for none; "" without matches.
    """
    ground, plane, metres = registration.ground, registration.homography, registration.width
    if ground is None or plane is None or metres is None:
        return ""
    heights = None if basemap.elevation is None else basemap.heights
    noise = _MATCH_ERROR * max(1.0, ground.resolution * view.size[0] / metres)
    # If neither heights nor the photo tell the tilt, noise and relief may pass for one.
    proven = heights is None and (frame.pitch is None or frame.roll is None)
    parameters = 8 if registration.model == "homography" else 4 if proven else 6

    def raised(places: Float64Array) -> Float64Array:
        return np.column_stack([places, np.zeros(len(places)) if heights is None else heights(places)])

    def collected(u: Complex, places: Float64Array) -> PoseMatches:
        points = raised(places)
        known = np.isfinite(points[:, 2])
        return PoseMatches(view.pixels(u)[known], points[known], view.size, plane, parameters, noise)

    def again(predict: Callable[[Float64Array], Float64Array]) -> PoseMatches:
        # The plane's model limits the ground that the photo may show.
        on_plane = np.abs(view.units(apply_homography(inverse(plane), ground.points)))
        near = np.flatnonzero(on_plane < _SEEN)
        predicted = np.full(len(ground.points), np.nan, np.complex128)
        predicted[near] = view.units(predict(raised(ground.points[near])))
        u, chosen = registration.rematch(predicted, _REACH)
        return collected(u, ground.points[chosen])

    best = registration.places[0]
    first = collected(best.u, np.stack([best.m.real, best.m.imag], axis=1))
    solved = solve_pose(first, frame.fov, heights, None if heights is None else again, proven)
    return (
        solved
        if isinstance(solved, str)
        else _contradiction(frame, solved, is_turned_over(registration.turn)) or solved
    )


def _contradiction(frame: Frame, solved: CameraPose, turned: bool) -> str:
    """Return a sentence if pitch or roll contradict the photo's; "" if they agree within three sigmas."""
    if frame.pitch is None or frame.roll is None:
        return ""
    way = -1 if turned else 1  # the file was turned after the flight
    told = way * (frame.pitch + 90) - 90, way * frame.roll
    limits = [_SIGMAS * math.hypot(frame_tilt_error(frame), float(sigma)) for sigma in solved.sigmas[4:]]
    if abs(solved.pitch - told[0]) <= limits[0] and abs(solved.roll - told[1]) <= limits[1]:
        return ""
    return (
        f"The matches would have the camera at a pitch of {solved.pitch:.1f}° and a roll of {solved.roll:.1f}°, and the photo "
        f"tells {told[0]:.1f}° and {told[1]:.1f}°, so there is no pose."
    )
