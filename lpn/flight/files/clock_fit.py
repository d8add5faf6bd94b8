"""The constant offset between the clock of photos and that of a log or track.

A camera's clock is often local time where a log's is UTC, or the reverse. Offsets up to 14 hours either way are tried in steps of
a quarter hour. The best one puts the most photos within the log, and brings the log nearest to the photos' own positions. If
several are as good, the offset is unknown, and the user gives it as --clock-offset. Only offset 0 between clocks of one kind
needs no proof.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.flight.files.base import degrees, local_metres
from lpn.flight.files.photos import Photo
from lpn.flight.files.telemetry import Telemetry


# An offset, the class of the share of photos within the log, and the median distance of positions in metres (NaN if unknown).
class _Score(NamedTuple):
    offset: float
    level: int
    metres: float


_QUARTER, _HOUR = 900.0, 3600.0
_MOST_QUARTERS = 56
# An offset is possible from the first share of photos within the log (a log may be of one battery), and likely from the second.
_SOME, _MOST = 0.1, 0.9
# Positions of photos and log whose median distance is below _NEAR metres are simultaneous. An offset is as good as the best if
# its median is below _CLEAR times the best median, or less than _CLEAR_METRES above it.
_NEAR, _CLEAR, _CLEAR_METRES = 30.0, 3.0, 15.0
_MOST_PHOTOS = 200
_BEYOND = 10.0
_UTC, _LOCAL = "UTC", "their clock"


@dataclass(frozen=True)
class ClockFit:
    """The fit of the photos' clock to a log's.

    Attributes:
        offset: seconds to add to a photo's clock for that of the log; None if it is unknown.
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
    clocks = {
        _UTC: np.array([photo.utc for photo in photos], np.float64),
        _LOCAL: np.array([photo.local for photo in photos], np.float64),
    }
    like = _UTC if utc else _LOCAL
    known = [basis for basis in (like, _LOCAL if utc else _UTC) if np.isfinite(clocks[basis]).any()]
    if not known:
        return ClockFit(None, like, "the photos have no time")
    if not any(entry.latitude is not None for entry in telemetry.entries):
        return ClockFit(None, known[0], "none of its positions has a time")
    if given is not None:
        return ClockFit(given, known[0], f"with the offset of {given:g} s given with --clock-offset")
    places = degrees([photo.frame for photo in photos])
    fits = (_fit(telemetry, clocks[basis], places, basis, basis == like) for basis in known)
    first = next(fits)
    return first if first.offset is not None else next((fit for fit in fits if fit.offset is not None), first)


def _fit(telemetry: Telemetry, times: Float64Array, places: Float64Array, basis: str, is_like: bool) -> ClockFit:
    """Return the best offset of one of the photos' clocks; `is_like` if it is of the log's kind."""
    quarters = sorted(range(-_MOST_QUARTERS, _MOST_QUARTERS + 1), key=abs)
    scores = [_score(telemetry, times, places, _QUARTER * quarter) for quarter in quarters]
    level = max(score.level for score in scores)
    if level == 0:
        return ClockFit(None, basis, "at no offset of a time zone do the photos' times lie within it")
    best = [score for score in scores if score.level == level]
    if near := [score for score in scores if score.level and score.metres <= _NEAR]:
        least = min(score.metres for score in near)
        best = [score for score in near if score.metres <= max(_CLEAR * least, least + _CLEAR_METRES)]
    if is_like and best[0].offset == 0:
        best = best[:1]
    if len(best) == 1:
        return ClockFit(best[0].offset, basis, _sentence(best[0]))
    offsets = ", ".join(f"{score.offset:g}" for score in best[:4])
    return ClockFit(
        None,
        basis,
        "the photos' times lie within it at several offsets, and nothing decides between them; give one, in seconds, with "
        f"--clock-offset: {offsets}",
    )


def _sentence(score: _Score) -> str:
    """Describe the fit at an offset, with a warning if positions disagree."""
    ahead = "ahead of" if score.offset > 0 else "behind"
    parts = []
    if score.offset:
        parts.append(f"with a constant offset: the log's clock is {abs(score.offset) / _HOUR:g} h {ahead} the photos'")
    if score.metres > _NEAR:
        parts.append(
            f"but its positions are {score.metres:.0f} m from the photos' own in the median, so one of the clocks or positions "
            "is wrong; --clock-offset tells the offset"
        )
    return ", ".join(parts)


def _score(telemetry: Telemetry, times: Float64Array, places: Float64Array, offset: float) -> _Score:
    first, last = telemetry.entries[0].time, telemetry.entries[-1].time
    # `Telemetry.at` decides how long values hold beyond the log's ends.
    during = np.flatnonzero((times + offset > first - _BEYOND) & (times + offset < last + _BEYOND))
    found = {int(i): telemetry.at(float(times[i]) + offset) for i in during}
    inside = {i: (values["latitude"], values["longitude"]) for i, values in found.items() if "latitude" in values}
    share = len(inside) / np.isfinite(times).sum()
    pairs = [np.array([places[i], place], np.float64) for i, place in inside.items() if not math.isnan(places[i, 0])]
    metres = [float(np.hypot(*local_metres(pair)[1])) for pair in pairs]
    return _Score(offset, int(share >= _SOME) + int(share >= _MOST), float(np.median(metres)) if metres else math.nan)
