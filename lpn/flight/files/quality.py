"""Checks across the frames of a flight: headings from the course, and notes about jumps and about missing values."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.files import first_few
from lpn.core.numbers import wrap_degrees
from lpn.flight.files.base import Frame, degrees, local_metres

# The course is measured over this many metres; position noise of a metre then turns it by 11 degrees.
_LEAST_STEP = 5.0
# Most seconds between a frame and the neighbours that give its course.
_COURSE_SECONDS = 15.0
# Courses before and after a frame that differ by more degrees are a turn, in which the camera's heading is unknown.
_TURN = 45.0
# A speed in m/s that no drone of this kind flies, and the factor of the median step that a jump exceeds.
_FASTEST, _JUMP = 50.0, 8.0
# Without times, a jump is longer than this in metres.
_FAR = 200.0
_NAMED = 3


def with_courses(frames: Sequence[Frame]) -> tuple[list[Frame], list[str]]:
    """Fill missing headings with the course over ground where the drone moves straight; return notes about it."""
    places, times = local_metres(degrees(frames)), _times(frames)
    made, courses = [], 0
    for i, frame in enumerate(frames):
        course = None if frame.heading is not None else _course(places, times, i)
        courses += course is not None
        made.append(frame if course is None else replace(frame, heading=course, heading_source="course"))
    missing, notes = sum(frame.heading is None for frame in frames), []
    if courses:
        notes.append(
            f"{missing} of {len(frames)} photos have no heading: {courses} got the course over ground, which is the camera's "
            "heading only if the drone flew forwards."
        )
    return made, notes


def flight_notes(frames: Sequence[Frame], oddities: Sequence[Sequence[str]] = ()) -> list[str]:
    """Return notes about a flight: oddities of its frames, missing positions, jumps of the position.

    Args:
        oddities: of each frame, as predicates with the frame as their subject.
    """
    counts = Counter(oddity for some in oddities for oddity in dict.fromkeys(some))
    notes = [f"{count} of {len(frames)} photos: each {oddity}." for oddity, count in counts.items()]
    known = [frame for frame in frames if frame.latitude is not None]
    if frames and not known:
        notes.append(
            f"None of the {len(frames)} photos has a GPS tag. They can be placed without one, but how far off their places are "
            "cannot be measured."
        )
    elif len(known) < len(frames):
        names = [frame.name for frame in frames if frame.latitude is None]
        notes.append(f"{len(names)} of {len(frames)} photos have no GPS tag: {first_few(names, _NAMED)}.")
    return notes + _jumps(known)


def _times(frames: Sequence[Frame]) -> Float64Array:
    return np.array([frame.time for frame in frames], np.float64)


def _course(places: Float64Array, times: Float64Array, at: int) -> float | None:
    """Return the course in degrees at a frame; None if it hovers, turns, or has no position."""
    if np.isnan(places[at, 0]):
        return None
    legs = []
    for step in (-1, 1):
        other = _away(places, times, at, step)
        if other is not None:
            east, north = (places[other] - places[at]) * step
            legs.append(math.degrees(math.atan2(east, north)))
    if not legs or (len(legs) == 2 and abs(wrap_degrees(legs[1] - legs[0])) > _TURN):
        return None
    sine, cosine = (sum(wave(math.radians(leg)) for leg in legs) for wave in (math.sin, math.cos))
    return math.degrees(math.atan2(sine, cosine)) % 360.0


def _away(places: Float64Array, times: Float64Array, at: int, step: int) -> int | None:
    """Return the nearest frame in one direction at least `_LEAST_STEP` away; None without one in `_COURSE_SECONDS`."""
    other = at + step
    while 0 <= other < len(places):
        if abs(times[other] - times[at]) > _COURSE_SECONDS:
            return None
        if np.hypot(*(places[other] - places[at])) >= _LEAST_STEP:
            return other
        other += step
    return None


def _jumps(known: Sequence[Frame]) -> list[str]:
    metres, seconds = np.hypot(*np.diff(local_metres(degrees(known)), axis=0).T), np.diff(_times(known))
    if len(metres) < 2:
        return []
    with np.errstate(divide="ignore", invalid="ignore"):
        fast = np.where(np.isnan(seconds), metres > _FAR, metres / np.maximum(seconds, 1.0) > _FASTEST)
    jumps = np.flatnonzero(fast & (metres > _JUMP * np.median(metres)))
    if not len(jumps):
        return []
    times, first = "once" if len(jumps) == 1 else f"{len(jumps)} times", int(jumps[0])
    return [
        f"The GPS tags jump {times}, first by {metres[first]:.0f} m after {known[first].name}; tags about a jump are doubtful."
    ]
