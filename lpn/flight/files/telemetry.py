"""Telemetry: the values of a subtitle or log row at one moment, and interpolated between moments."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lpn.core.arrays import BoolArray, Float64Array
from lpn.core.errors import DataError
from lpn.core.numbers import wrap_degrees
from lpn.flight.files import cameras
from lpn.flight.files.base import HeadingSource, local_metres, on_earth

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
    """Values at one moment or of one picture, as in `Frame`; None where unknown.

    Attributes:
        time: seconds from the start of a video or log; NaN if unknown.
        clock: seconds since 1970-01-01 on the camera's or drone's clock, whose zone is unknown.
        file: its picture; None in a log of moments.
        recording: whether the drone was recording a video; None if unknown.
        line: its number in a log's file, from 1; 0 elsewhere.
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
    file: str | None = None
    recording: bool | None = None
    line: int = 0

    def values(self) -> dict[str, Any]:
        """Return those of `VALUES` that are known."""
        return {name: value for name in VALUES if (value := getattr(self, name)) is not None}


@dataclass(frozen=True)
class Log:
    """A log of a flight, or the subtitles of a video.

    Attributes:
        utc: True if the log names the entries' `clock` as UTC.
        notes: sentences about oddities.
        end: of the last subtitle, in seconds from the video's start; None in a log.
    """

    name: str
    entries: tuple[TelemetryEntry, ...]
    utc: bool
    notes: tuple[str, ...]
    end: float | None = None


def entry_of(
    time: float,
    clock: float | None,
    told: Mapping[str, float | None],
    file: str | None = None,
    recording: bool | None = None,
    line: int = 0,
) -> TelemetryEntry:
    """Return the entry of a row, subtitle, or message, with the angles of the gimbal, camera, or aircraft, in this order.

    A position off the Earth or at (0, 0), and a gimbal's or camera's three angles of 0, are unknown.

    Args:
        told: values in metres and degrees by their names in `lpn.flight.files.dialects.UNITS`; None or NaN where unknown.
        time, clock, file, recording, line: see `TelemetryEntry`.
    """
    known = {what: value for what, value in told.items() if value is not None and math.isfinite(value)}
    latitude, longitude = known.get("latitude"), known.get("longitude")
    if latitude is None or longitude is None or not (latitude or longitude) or not on_earth(latitude, longitude):
        latitude = longitude = None
    heading, pitch, roll, source = _angles(known)
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
        file,
        recording,
        line,
    )


def _angles(known: Mapping[str, float]) -> tuple[float | None, float | None, float | None, HeadingSource]:
    heading, pitch, roll = (known.get(what) for what in ("gimbal_heading", "gimbal_pitch", "gimbal_roll"))
    if heading is not None and (heading or pitch or roll):
        if pitch is not None:
            heading, pitch, roll = cameras.from_gimbal(heading, pitch, roll or 0.0)
        return heading, pitch, roll, "gimbal"
    direction, nose, bank = (known.get(what) for what in ("direction", "nose", "bank"))
    if direction == nose == 0 and not bank:
        direction = nose = bank = None
    pitch = (pitch or None) if nose is None else nose - 90.0
    if direction is not None:
        return direction, pitch, bank, "camera"
    return known.get("heading"), pitch, bank, "aircraft"


class Telemetry:
    """Entries in the order of their times, interpolated linearly.

    A receiver updates its position a few times a second, and the entries between repeat it. Positions are therefore interpolated
    between their changes.
    """

    def __init__(self, entries: Sequence[TelemetryEntry]) -> None:
        self.entries = tuple(sorted(entries, key=lambda entry: entry.time))
        times = np.array([entry.time for entry in self.entries], np.float64)
        self._gap = max(_GAP, _GAPS * float(np.median(np.diff(times)))) if len(times) > 1 else _GAP
        moved = _changes(times, [(entry.latitude, entry.longitude) for entry in self.entries])
        # Times at which each value is known; then times and values for interpolation.
        self._known: dict[str, tuple[Float64Array, Float64Array, Float64Array]] = {}
        for name in (*_LINEAR, *_ANGLES):
            values = np.array([getattr(entry, name) for entry in self.entries], np.float64)
            keep = known = ~np.isnan(values)
            if name in ("latitude", "longitude"):
                keep = known & moved
            kept = np.unwrap(values[keep], period=360.0) if name in _ANGLES else values[keep]
            self._known[name] = times[known], times[keep], kept
        self._sources = [entry.heading_source for entry in self.entries if entry.heading is not None]

    def at(self, time: float) -> dict[str, Any]:
        """Return those of `VALUES` that are known at a time in seconds."""
        values: dict[str, Any] = {name: value for name in self._known if (value := self._value(name, time)) is not None}
        if "longitude" in values:
            values["longitude"] = wrap_degrees(values["longitude"])
        if "heading" in values:
            values["heading"] %= 360.0
            values["heading_source"] = self._sources[int(np.abs(self._known["heading"][0] - time).argmin())]
        return values

    def times_by_distance(self, metres: float) -> list[float]:
        """Return the times at which 0, 1, 2, ... times `metres` have been flown since the first known position.

        Raises:
            DataError: if there are more than a million.
        """
        _, times, latitudes = self._known["latitude"]
        if not len(times):
            return []
        places = np.stack([latitudes, self._known["longitude"][2]], axis=1)
        flown = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(local_metres(places), axis=0).T))])
        # A hovering drone keeps its distance; the first time counts.
        flown, first = np.unique(flown, return_index=True)
        if flown[-1] > _MOST_MARKS * metres:
            raise DataError(
                f"The flight is {flown[-1] / 1000:.0f} km long, and a picture every {metres:g} m is too many; "
                "give more metres, or choose by seconds."
            )
        marks = np.arange(0.0, flown[-1] + 1e-9, metres)
        return [float(time) for time in np.interp(marks, flown, times[first])]

    def _value(self, name: str, time: float) -> float | None:
        known, times, values = self._known[name]
        after = int(np.searchsorted(known, time, "right"))
        around = known[max(after - 1, 0) : after + 1]
        is_between = len(around) == 2 and around[0] <= time <= around[1] and around[1] - around[0] <= self._gap
        if not is_between:
            # Before, after, and in a gap the nearer entry's value holds.
            nearest = float(min(around, key=lambda other: abs(other - time), default=math.inf))
            if abs(nearest - time) > _HOLD:
                return None
            time = nearest if len(around) == 2 else time
        return float(np.interp(time, times, values))


def _changes(times: Float64Array, places: Sequence[tuple[float | None, float | None]]) -> BoolArray:
    """Return a mask of the entries at which the position changes, and of the last entry of each hover."""
    keep = np.zeros(len(places), bool)
    start = 0
    for i in range(1, len(places) + 1):
        if i == len(places) or places[i] != places[start]:
            keep[start] = True
            # A hovering drone moves off at the end of the hover, not during it.
            keep[i - 1] |= times[i - 1] - times[start] > _HOLD or i == len(places)
            start = i
    return keep
