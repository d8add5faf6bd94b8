"""The constant offset between the clocks of photos and of a log or track.

A camera's clock often has local time where the log has UTC, or the reverse. Offsets up to 14 hours either way are tried in steps
of a quarter hour. The best one puts the most photos within the log, and brings the log nearest to the photos' own positions. If
several are as good, the offset is unknown, and the user gives it as --clock-offset. If both clocks are in UTC, or neither,
offset 0 is taken if it is one of the best.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.flight.files.base import degrees, local_metres
from lpn.flight.files.photos import Photo
from lpn.flight.files.telemetry import Telemetry

_QUARTER, _MOST_QUARTERS = 900.0, 56
# An offset is possible if the share _SOME of photos is within the log (a log may be of one battery), and likely if _MOST is.
_SOME, _MOST = 0.1, 0.9
# Positions of photos and log whose median distance is below _NEAR metres are simultaneous. An offset is as good as the best if
# its median is below _CLEAR times the best median, or less than _CLEAR_METRES above it.
_NEAR, _CLEAR, _CLEAR_METRES = 30.0, 3.0, 15.0
_MOST_PHOTOS = 200
_BEYOND = 10.0


class ClockFit(NamedTuple):
    """The fit of the photos' clock to the clock of a log.

    Attributes:
        offset: seconds to add to a photo's time to get the log's time; None if it is unknown.
        basis: the photos' clock: "UTC", or "their clock".
        sentence: the end of a note about the fit, or about the reason for none.
    """

    offset: float | None
    basis: str
    sentence: str


def fit_clocks(photos: Sequence[Photo], telemetry: Telemetry, utc: bool, given: float | None = None) -> ClockFit:
    """Find the offset at which photos fit a log of moments.

    Args:
        telemetry: of the log, with times in seconds since 1970-01-01 on its clock.
        utc: True if the log names its clock as UTC.
        given: a known offset, which is used without a search.
    """
    photos = photos[:: max(1, math.ceil(len(photos) / _MOST_PHOTOS))]
    clocks = [("UTC", [photo.utc for photo in photos]), ("their clock", [photo.local for photo in photos])]
    clocks = clocks if utc else clocks[::-1]
    like = clocks[0][0]
    known = [(basis, np.array(times, np.float64)) for basis, times in clocks if any(t is not None for t in times)]
    if not known:
        return ClockFit(None, like, "the photos have no time")
    if not any(entry.latitude is not None for entry in telemetry.entries):
        return ClockFit(None, known[0][0], "none of its positions has a time")
    if given is not None:
        return ClockFit(given, known[0][0], f"with the offset of {given:g} s given with --clock-offset")
    places = degrees([photo.frame for photo in photos])
    fits = [_fit(telemetry, times, places, basis, basis == like) for basis, times in known]
    return next((fit for fit in fits if fit.offset is not None), fits[0])


def _fit(telemetry: Telemetry, times: Float64Array, places: Float64Array, basis: str, is_like: bool) -> ClockFit:
    """Return the best offset of one of the photos' clocks; `is_like` if this clock and the log's are both UTC, or neither."""
    offsets = _QUARTER * np.array(sorted(range(-_MOST_QUARTERS, _MOST_QUARTERS + 1), key=abs))
    shares, metres = np.array([_score(telemetry, times + offset, places) for offset in offsets]).T
    likely = shares >= _MOST
    best = likely if likely.any() else shares >= _SOME
    near = (shares >= _SOME) & (metres <= _NEAR)
    if near.any():
        least = metres[near].min()
        best = near & (metres <= max(_CLEAR * least, least + _CLEAR_METRES))
    choices = offsets[best].tolist()
    if not choices:
        return ClockFit(None, basis, "the photos' times lie within it at no offset of a time zone")
    if len(choices) > 1 and not (is_like and choices[0] == 0):
        return ClockFit(
            None,
            basis,
            "the photos' times lie within it at several offsets, and nothing decides between them; give one, in seconds, with "
            f"--clock-offset: {', '.join(f'{offset:g}' for offset in choices[:4])}",
        )
    offset, away = choices[0], metres[best][0]
    parts = []
    if offset:
        ahead = "ahead of" if offset > 0 else "behind"
        parts.append(f"with a constant offset: the log's clock is {abs(offset) / 3600:g} h {ahead} the photos'")
    if away > _NEAR:
        parts.append(
            f"but its positions are {away:.0f} m from the photos' own in the median, so one of the clocks or positions is "
            "wrong; give the offset with --clock-offset"
        )
    return ClockFit(offset, basis, ", ".join(parts))


def _score(telemetry: Telemetry, times: Float64Array, places: Float64Array) -> tuple[float, float]:
    """Return the share of photos within the log, and the median metres between positions (NaN if unknown)."""
    first, last = telemetry.entries[0].time, telemetry.entries[-1].time
    # `Telemetry.at` decides how long values hold beyond the log's ends.
    during = np.flatnonzero((times > first - _BEYOND) & (times < last + _BEYOND))
    told = [(places[i], telemetry.at(float(times[i]))) for i in during]
    pairs = [
        (place, (known["latitude"], known["longitude"])) for place, known in told if known.get("latitude") is not None
    ]
    metres = [np.hypot(*local_metres(np.array(pair, np.float64))[1]) for pair in pairs if not np.isnan(pair[0]).any()]
    return len(pairs) / np.isfinite(times).sum(), float(np.median(metres)) if metres else math.nan
