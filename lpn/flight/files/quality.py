"""The frames of a flight together: one clock, headings from the course, and notes about jumps and missing values."""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.files import first_few
from lpn.core.numbers import wrap_degrees
from lpn.flight.files.base import Frame, degrees, local_metres
from lpn.flight.files.photos import Photo

# The course is measured over this many metres; position noise of a metre then turns it by 11 degrees.
_LEAST_STEP = 5.0
# Maximum of seconds between a frame and the neighbours that give its course.
_COURSE_SECONDS = 15.0
# Courses before and after a frame that differ by more degrees are a turn, in which the camera's heading is unknown.
_TURN = 45.0
# A speed in m/s that no drone of this kind flies, and the factor of the median step that a jump exceeds.
_FASTEST, _JUMP = 50.0, 8.0
# Without times, a jump is longer than this in metres.
_FAR = 200.0
_NAMED = 3
# Seconds of a quarter of an hour, by which zones differ.
_QUARTER = 900.0


def set_times(photos: Sequence[Photo]) -> tuple[list[Frame], bool, list[str]]:
    """Put the photos of a flight on one clock, and order them by time, then by name.

    Returns:
        Frames, whether their times are UTC (else seconds since the first), and notes about the clocks.
    """
    lags = sorted(photo.utc - photo.local for photo in photos if photo.utc is not None and photo.local is not None)
    is_utc = any(photo.utc is not None for photo in photos)
    lag = math.nan if is_utc else 0.0
    if lags:
        lag = lags[len(lags) // 2]
    by_lag = [None if photo.local is None else photo.local + lag for photo in photos]
    times = np.array(
        [late if photo.utc is None else photo.utc for photo, late in zip(photos, by_lag, strict=True)], np.float64
    )
    known = np.isfinite(times)
    notes = []
    if lags:
        zone = -round(lag / _QUARTER) * _QUARTER
        name = f"UTC{zone / 3600:+g}" if zone else "UTC"
        late = lag + zone
        if abs(late) > 2:
            notes.append(f"The camera's clock is {abs(late):.0f} s {'behind' if late > 0 else 'ahead of'} {name}.")
        if (spread := lags[-1] - lags[0]) > 2:
            notes.append(f"The camera's clock and UTC move apart by {spread:.0f} s during the flight.")
    if known.any() and not is_utc:
        times -= np.nanmin(times)
        notes.append("No photo has its time in UTC: times are seconds since the first photo.")
    frames = [
        replace(photo.frame, time=None if math.isnan(time) else time)
        for photo, time in zip(photos, times.tolist(), strict=True)
    ]
    if missing := int((~known).sum()):
        notes.append(f"{missing} of {len(frames)} photos have no time: the photos are in the order of their names.")
    by_time = missing == 0
    return sorted(frames, key=lambda frame: (by_time and frame.time, natural(frame.name))), is_utc, notes


def natural(name: str) -> list[tuple[int, str]]:
    """Return a sort key that compares numbers in names by value: "9.jpg" precedes "10.jpg"."""
    return [(int(digits or 0), letters.casefold()) for digits, letters in re.findall(r"([0-9]*)([^0-9]*)", name)]


def with_courses(frames: Sequence[Frame]) -> tuple[list[Frame], list[str]]:
    """Fill missing headings with the course over ground where the drone moves straight; return notes about it."""
    made = list(frames)
    missing = [i for i, frame in enumerate(frames) if frame.heading is None]
    metres, times = local_metres(degrees(frames)), _times(frames)
    for i in missing:
        if (course := _course(metres - metres[i], np.abs(times - times[i]), i)) is not None:
            made[i] = replace(frames[i], heading=course, heading_source="course")
    if not (courses := sum(made[i].heading is not None for i in missing)):
        return made, []
    return made, [
        f"{len(missing)} of {len(frames)} photos have no heading: {courses} got the course over ground, which is the camera's "
        "heading only if the drone flew forwards."
    ]


def flight_notes(frames: Sequence[Frame], oddities: Sequence[Sequence[str]] = ()) -> list[str]:
    """Return notes about a flight: oddities of its frames, missing positions, jumps of the position.

    Args:
        oddities: of each frame, as predicates with the frame as their subject.
    """
    counts = Counter(oddity for some in oddities for oddity in some)
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
    metres = np.hypot(*np.diff(local_metres(degrees(known)), axis=0).T)
    seconds = np.diff(_times(known))
    fast = np.where(np.isnan(seconds), metres > _FAR, metres > _FASTEST * np.maximum(seconds, 1.0))
    usual = float(np.median(metres)) if len(metres) > 1 else math.inf
    jumps = np.flatnonzero(fast & (metres > _JUMP * usual))
    if len(jumps):
        count = "once" if len(jumps) == 1 else f"{len(jumps)} times"
        notes.append(
            f"The GPS tags jump {count}, first by {metres[jumps[0]]:.0f} m after {known[jumps[0]].name}; tags about a jump are "
            "doubtful."
        )
    return notes


def _times(frames: Sequence[Frame]) -> Float64Array:
    return np.array([frame.time for frame in frames], np.float64)


def _course(metres: Float64Array, seconds: Float64Array, at: int) -> float | None:
    """Return the course in degrees at a frame; None if it hovers, turns, or has no position.

    Args:
        metres: to each frame, east and north, (N, 2); NaN where unknown.
        seconds: to each frame, (N,); NaN where unknown.
    """
    legs = []
    for others, sign in ((range(at - 1, -1, -1), -1), (range(at + 1, len(metres)), 1)):
        near = itertools.takewhile(lambda other: not seconds[other] > _COURSE_SECONDS, others)
        leg = next((metres[other] for other in near if np.hypot(*metres[other]) >= _LEAST_STEP), None)
        if leg is not None:
            legs.append(math.degrees(math.atan2(*(sign * leg))))
    if not legs or abs(turn := wrap_degrees(legs[-1] - legs[0])) > _TURN:
        return None
    return (legs[0] + turn / 2) % 360.0
