"""The constant offset between the clock of photos and that of a log or track.

A camera's clock is often local time, and a log's is UTC, or the other way round. The offset is told honestly, or not at all:

1. no offset, where photos lie within the log;
2. else a zone that exists at the log's longitude, where all photos lie within the log at this zone alone;
3. photos that have positions decide among zones, and tell an offset that is no zone, such as that of a wrong clock.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.datasets import geo
from lpn.flight.files.photos import Photo
from lpn.flight.files.telemetry import Telemetry

_HOUR = 3600.0
# A zone's clock is so many hours ahead of the sun's time at most, as in the west of China, and so many behind.
_MOST_AHEAD, _MOST_BEHIND = 3.6, 1.2
# Zones that are no whole hours, in hours, and their longitudes from west to east.
_ODD_ZONES = (
    (-9.5, -142, -138), (-3.5, -60, -52), (-2.5, -60, -52), (3.5, 44, 64), (4.5, 44, 75), (5.5, 68, 98), (5.75, 80, 89),
    (6.5, 92, 102), (8.75, 125, 130), (9.5, 129, 142), (10.5, 129, 160), (11, 158, 160), (12.75, -178, -175), (13.75, -178, -175),
)  # fmt: skip
# Positions of photos and log that agree within so many metres in the median are of one moment.
_NEAR = 30.0
# An offset agrees as well as the best if its median distance is below this multiple of the best one's, or this much above it.
_CLEAR, _CLEAR_METRES = 3.0, 15.0
# Offsets that differ by fewer seconds are one.
_ONE = 30.0
_MOST_OFFSETS, _MOST_PHOTOS = 20_000, 200
# Photos that are spread over fewer metres do not tell an offset.
_LEAST_SPREAD = 60.0
# A zone fits if the log holds this share of the photos. If no zone does, the log may be of one battery: then it fits if the log
# holds at least this number and this share.
_INSIDE = 0.9
_LEAST_INSIDE, _LEAST_SHARE = 3, 0.1
_UTC, _LOCAL = "UTC", "their clock"


@dataclass(frozen=True)
class ClockFit:
    """How photos fit a log by their clocks.

    Attributes:
        offset: seconds to add to a photo's clock for that of the log; None if it cannot be estimated.
        basis: the photos' clock: "UTC", or "their clock".
        sentence: the end of a note: how they fit, or why they do not.
    """

    offset: float | None
    basis: str
    sentence: str


def fit_clocks(photos: Sequence[Photo], telemetry: Telemetry, utc: bool) -> ClockFit:
    """Find the offset at which photos fit a log of moments.

    Args:
        telemetry: of the log, with times in seconds since 1970-01-01 on its clock.
        utc: the log's clock is UTC, as far as it says.
    """
    photos = photos[:: max(1, math.ceil(len(photos) / _MOST_PHOTOS))]
    clocks = {
        _UTC: np.array([photo.utc for photo in photos], np.float64),
        _LOCAL: np.array([photo.local for photo in photos], np.float64),
    }
    plain = _UTC if utc else _LOCAL
    places = np.array([_place(photo) for photo in photos], np.float64).reshape(-1, 2)
    known = {basis: times for basis, times in clocks.items() if np.isfinite(times).any()}
    if not known:
        return ClockFit(None, plain, "the photos have no time")
    if not any(entry.latitude is not None for entry in telemetry.entries):
        return ClockFit(None, plain, "none of its positions has a time")
    off, fits = math.inf, plain in known and bool(_inside(telemetry, known[plain], 0.0).any())
    if fits:
        off = _off(telemetry, known[plain], places, 0.0)
        if off <= _NEAR or off == math.inf or _spread(places) <= _LEAST_SPREAD:
            return ClockFit(0.0, plain, "")
    for find in (partial(_by_zone, utc=utc), _by_places):
        for basis, times in known.items():
            if (fit := find(telemetry, times, places, basis)) is not None:
                return fit
    if fits:
        return ClockFit(0.0, plain, _warning(off))
    for basis, times in known.items():
        fit = _by_zone(telemetry, times, np.full_like(places, math.nan), basis, utc)
        if (
            fit is not None
            and fit.offset is not None
            and (off := _off(telemetry, times, places, fit.offset)) < math.inf
        ):
            fit = replace(fit, sentence=f"{fit.sentence}, {_warning(off)}")
        if fit is not None:
            return fit
    return ClockFit(None, plain, "at no offset of a time zone do the photos' times lie within it")


def _warning(off: float) -> str:
    return f"but its positions are {off:.0f} m from the photos' own in the median, so one of the clocks or positions is wrong"


def _place(photo: Photo) -> tuple[float, float]:
    frame = photo.frame
    if frame.latitude is None or frame.longitude is None:
        return math.nan, math.nan
    return frame.latitude, frame.longitude


def _by_zone(telemetry: Telemetry, times: Float64Array, places: Float64Array, basis: str, utc: bool) -> ClockFit | None:
    """Return the zone at which the photos lie within the log, or a fit that says that several do; None if none does."""
    sign = 1.0 if basis == _UTC else -1.0
    is_between = basis == _LOCAL and not utc
    if is_between:
        # Both zones are unknown. Whole hours come first, as two clocks of one person seldom differ by a part of an hour.
        sets = [[float(h) for h in range(-14, 15) if h], [h / 4 for h in range(-56, 57) if h % 4]]
    else:
        sets = [_zones(_middle_longitude(telemetry))]
    counts = {zone: int(_inside(telemetry, times, sign * zone * _HOUR).sum()) for zones in sets for zone in zones}
    total = int(np.isfinite(times).sum())
    # A log of one battery holds only some of the photos.
    fitting = next(
        (
            matching
            for least in (_INSIDE * total, max(_LEAST_INSIDE, _LEAST_SHARE * total))
            for zones in sets
            if (matching := [zone for zone in zones if counts[zone] >= least])
        ),
        [],
    )
    if not fitting:
        return None
    if _spread(places) > _LEAST_SPREAD:
        fitting = [zone for zone in fitting if _off(telemetry, times, places, sign * zone * _HOUR) <= _NEAR]
        if not fitting:
            return None
    if len(fitting) > 1:
        named = ", ".join(_named(zone) for zone in fitting[:4])
        return ClockFit(
            None,
            basis,
            f"the photos' times lie within it at several offsets, and nothing decides between them: {named}",
        )
    offset = sign * fitting[0] * _HOUR
    clock = "the log's clock is" if basis == _UTC else "the photos' clock is"
    what = f"the log's clock is {_behind(offset)} the photos'" if is_between else f"{clock} {_named(fitting[0])}"
    return ClockFit(offset, basis, f"with a constant offset: {what}")


def _by_places(telemetry: Telemetry, times: Float64Array, places: Float64Array, basis: str) -> ClockFit | None:
    """Return the one offset at which the log passes where the photos were taken; None if there is none."""
    known = np.isfinite(times) & np.isfinite(places[:, 0])
    if known.sum() < 3 or _spread(places[known]) <= _LEAST_SPREAD or not telemetry.entries:
        return None
    times, places = times[known], places[known]
    first, last = telemetry.entries[0].time, telemetry.entries[-1].time
    least, most = first - times.min() - 1, last - times.max() + 1
    if not 0 <= most - least <= _MOST_OFFSETS:
        return None
    offsets = np.arange(least, most + 1, 1.0)
    path = _path(telemetry)
    offs = np.array([np.median(_metres(path, times + offset, places)) for offset in offsets])
    best = int(offs.argmin())
    apart = offs[np.abs(offsets - offsets[best]) > _ONE]
    if offs[best] > _NEAR or (len(apart) and apart.min() < max(_CLEAR * offs[best], offs[best] + _CLEAR_METRES)):
        return None
    # While the drone hovers, offsets near the best one agree as well; the middle of them is taken.
    alike = offsets[(np.abs(offsets - offsets[best]) <= _ONE) & (offs <= offs[best] + 1.0)]
    offset = float(np.median(alike))
    sentence = (
        f"with a constant offset that the photos' own positions imply: the log's clock is {_behind(offset)} the photos'"
    )
    return ClockFit(offset, basis, sentence)


def _behind(offset: float) -> str:
    """Return an offset of the log's clock over the photos' in words, such as "2 h ahead of"."""
    size = abs(offset)
    amount = f"{size / _HOUR:g} h" if size % 900 == 0 and size else f"{size:.0f} s"
    return f"{amount} {'ahead of' if offset >= 0 else 'behind'}"


def _named(zone: float) -> str:
    hours, minutes = divmod(round(abs(zone) * 60), 60)
    return f"UTC{'+' if zone >= 0 else '-'}{hours}" + (f":{minutes:02d}" if minutes else "")


def _zones(longitude: float) -> list[float]:
    """Return the zones that exist at a longitude, in hours, and UTC, which many clocks show."""
    sun = longitude / 15.0
    around = [(float(hours), (hours - sun + 12) % 24 - 12) for hours in range(-12, 15)]
    whole = [hours for hours, ahead in around if hours == 0 or -_MOST_BEHIND <= ahead <= _MOST_AHEAD]
    return whole + [hours for hours, west, east in _ODD_ZONES if west <= longitude <= east and hours not in whole]


def _middle_longitude(telemetry: Telemetry) -> float:
    known = [entry.longitude for entry in telemetry.entries if entry.longitude is not None]
    return known[len(known) // 2] if known else 0.0


def _inside(telemetry: Telemetry, times: Float64Array, offset: float) -> np.typing.NDArray[np.bool_]:
    """Return which of the photos' times the log has a position for."""
    return np.array(
        [math.isfinite(time) and telemetry.at(time + offset)["latitude"] is not None for time in times], bool
    )


def _off(telemetry: Telemetry, times: Float64Array, places: Float64Array, offset: float) -> float:
    """Return the median distance in metres between the photos' own positions and the log's; infinity if none is known."""
    known = np.isfinite(times) & np.isfinite(places[:, 0])
    known[known] = _inside(telemetry, times[known], offset)
    return (
        float(np.median(_metres(_path(telemetry), times[known] + offset, places[known]))) if known.any() else math.inf
    )


def _path(telemetry: Telemetry) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return the times, latitudes, and unwrapped longitudes of a log's positions."""
    known = [
        (e.time, e.latitude, e.longitude)
        for e in telemetry.entries
        if e.latitude is not None and e.longitude is not None
    ]
    times, latitudes, longitudes = np.array(known, np.float64).reshape(-1, 3).T
    return times, latitudes, np.unwrap(longitudes, period=360.0)


def _metres(
    path: tuple[Float64Array, Float64Array, Float64Array], times: Float64Array, places: Float64Array
) -> Float64Array:
    """Return the distances in metres of positions from a path at times."""
    at, latitudes, longitudes = path
    north, east = geo.metres_per_degree(float(np.clip(np.median(places[:, 0]), -89, 89)))
    across = (np.interp(times, at, longitudes) - places[:, 1] + 180) % 360 - 180
    return np.asarray(np.hypot((np.interp(times, at, latitudes) - places[:, 0]) * north, across * east), np.float64)


def _spread(places: Float64Array) -> float:
    """Return the diagonal in metres of the known positions' bounds."""
    known = places[np.isfinite(places[:, 0])]
    if not len(known):
        return 0.0
    north, east = geo.metres_per_degree(float(np.clip(np.median(known[:, 0]), -89, 89)))
    longitudes = np.unwrap(known[:, 1], period=360.0)
    return float(math.hypot(np.ptp(known[:, 0]) * north, np.ptp(longitudes) * east))
