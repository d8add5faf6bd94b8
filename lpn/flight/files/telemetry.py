"""Telemetry: the values of a subtitle or log row at one moment, and interpolated between moments."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError
from lpn.core.numbers import wrap_degrees
from lpn.flight.files import cameras
from lpn.flight.files.base import HeadingSource, local_metres

# Values are not interpolated between entries more than `_GAP` seconds and more than `_GAPS` median steps apart.
_GAP, _GAPS = 5.0, 3.0
# A value holds for this many seconds before its first and after its last entry.
_HOLD = 1.5
_MOST_MARKS = 1_000_000
_LINEAR = ("latitude", "height_above_ground", "height_above_takeoff", "altitude", "pitch", "roll", "fov")
_ANGLES = ("longitude", "heading")
# The values that a frame takes from telemetry.
VALUES = (*_LINEAR, *_ANGLES, "heading_source")


@dataclass(frozen=True)
class TelemetryEntry:
    """Values at one moment, as in `Frame`; None where unknown.

    Attributes:
        time: seconds from the start of a video or log.
        clock: seconds since 1970-01-01 on the camera's or drone's clock, whose zone is unknown.
    """

    time: float
    clock: float | None = None
    latitude: float | None = None
    longitude: float | None = None
    height_above_ground: float | None = None
    height_above_takeoff: float | None = None
    altitude: float | None = None
    heading: float | None = None
    heading_source: HeadingSource | None = None
    pitch: float | None = None
    roll: float | None = None
    fov: float | None = None


def entry_of(time: float, clock: float | None, told: Mapping[str, float | None]) -> TelemetryEntry:
    """Return the entry of a row, subtitle, or message, with the angles of the gimbal, camera, or aircraft, in this order.

    A position off the Earth or at (0, 0), and a gimbal's or camera's three angles of 0, are unknown.

    Args:
        told: values in metres and degrees by their names in `lpn.flight.files.dialects.UNITS`; None or NaN where unknown.
    """
    known = {what: value for what, value in told.items() if value is not None and math.isfinite(value)}
    latitude, longitude = known.get("latitude"), known.get("longitude")
    if (
        latitude is None
        or longitude is None
        or not (latitude or longitude)
        or abs(latitude) > 90
        or abs(longitude) > 180
    ):
        latitude = longitude = None
    heading, pitch, roll = (known.get(f"gimbal_{angle}") for angle in ("heading", "pitch", "roll"))
    source: HeadingSource = "gimbal"
    if heading is None or not (heading or pitch or roll):
        looked, nose, bank = (known.get(what) for what in ("direction", "nose", "bank"))
        if nose is not None and looked is not None and not (looked or nose or bank):
            looked = nose = bank = None
        heading, source = (known.get("heading"), "aircraft") if looked is None else (looked, "camera")
        pitch, roll = (pitch or None) if nose is None else nose - 90.0, bank
    elif pitch is not None:
        heading, pitch, roll = cameras.from_gimbal(heading, pitch, roll or 0.0)
    return TelemetryEntry(
        time,
        clock,
        latitude,
        longitude,
        known.get("height_above_ground"),
        known.get("height_above_takeoff"),
        known.get("altitude"),
        None if heading is None else heading % 360.0,
        None if heading is None else source,
        pitch,
        roll,
        known.get("fov"),
    )


class Telemetry:
    """Entries in the order of their times, interpolated linearly.

    A receiver updates its position a few times a second, and the entries between repeat it. Positions are therefore interpolated
    between their changes.
    """

    def __init__(self, entries: Sequence[TelemetryEntry]) -> None:
        self.entries = tuple(sorted(entries, key=lambda entry: entry.time))
        self._times = np.array([entry.time for entry in self.entries], np.float64)
        steps = np.diff(self._times)
        self._gap = max(_GAP, _GAPS * float(np.median(steps))) if len(steps) else _GAP
        # Times at which each value is known; then times and values for interpolation.
        self._known_times: dict[str, Float64Array] = {}
        self._known: dict[str, tuple[Float64Array, Float64Array]] = {}
        for name in (*_LINEAR, *_ANGLES):
            values = np.array([getattr(entry, name) for entry in self.entries], np.float64)
            keep = ~np.isnan(values)
            self._known_times[name] = self._times[keep]
            if name in ("latitude", "longitude"):
                keep &= self._changes()
            angle = name in _ANGLES
            self._known[name] = self._times[keep], np.unwrap(values[keep], period=360.0) if angle else values[keep]

        self._sources = [entry.heading_source for entry in self.entries if entry.heading is not None]

    def at(self, time: float) -> dict[str, float | HeadingSource | None]:
        """Return the value of each of `VALUES` at a time in seconds."""
        values: dict[str, float | HeadingSource | None] = {name: self._value(name, time) for name in self._known}
        if (longitude := values["longitude"]) is not None:
            values["longitude"] = wrap_degrees(float(longitude))
        values["heading_source"] = None
        if (heading := values["heading"]) is not None:
            values["heading"] = float(heading) % 360.0
            values["heading_source"] = self._sources[int(np.abs(self._known_times["heading"] - time).argmin())]
        return values

    def times_by_distance(self, metres: float) -> list[float]:
        """Return the times at which 0, 1, 2, ... times `metres` have been flown since the first known position.

        Raises:
            DataError: if there are more than a million.
        """
        times, latitudes = self._known["latitude"]
        longitudes = self._known["longitude"][1]
        if not len(times):
            return []
        flown = np.cumsum(np.hypot(*np.diff(local_metres(np.stack([latitudes, longitudes], axis=1)), axis=0).T))
        flown = np.concatenate([[0.0], flown])
        # A hovering drone keeps its distance; the first time counts.
        flown, first = np.unique(flown, return_index=True)
        if flown[-1] > _MOST_MARKS * metres:
            raise DataError(
                f"The flight is {flown[-1] / 1000:.0f} km long, and a picture every {metres:g} m is too many; "
                "give more metres, or choose by seconds."
            )
        marks = np.arange(0.0, flown[-1] + 1e-9, metres)
        return [float(time) for time in np.interp(marks, flown, times[first])]

    def _changes(self) -> np.typing.NDArray[np.bool_]:
        """Return a mask of the entries at which the position changes, and of the last entry of each hover."""
        places = [(entry.latitude, entry.longitude) for entry in self.entries]
        keep = np.zeros(len(places), bool)
        start = 0
        for i in range(1, len(places) + 1):
            if i == len(places) or places[i] != places[start]:
                keep[start] = True
                # A hovering drone moves off at the end of the hover, not during it.
                keep[i - 1] |= self._times[i - 1] - self._times[start] > _HOLD or i == len(places)
                start = i
        return keep

    def _value(self, name: str, time: float) -> float | None:
        times = self._known_times[name]
        after = int(np.searchsorted(times, time, "right"))
        around = times[max(after - 1, 0) : after + 1]
        if not len(around) or (np.abs(around - time).min() > _HOLD and not self._between(around, time)):
            return None
        if len(around) == 2 and not self._between(around, time):
            # In a gap the nearer entry's value holds.
            time = float(around[np.abs(around - time).argmin()])
        return float(np.interp(time, *self._known[name]))

    def _between(self, around: Float64Array, time: float) -> bool:
        """Tell whether a time lies between two entries without a gap."""
        return len(around) == 2 and around[0] <= time <= around[1] and around[1] - around[0] <= self._gap
