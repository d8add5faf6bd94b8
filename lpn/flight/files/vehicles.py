"""The state of a vehicle from messages of its own clock: position, attitude, gimbal, and height, as one entry a position."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from lpn.flight.files import cameras
from lpn.flight.files.telemetry import TelemetryEntry

# Seconds for which an angle or a height holds, and for which a filtered position suppresses raw ones.
_HOLD = 1.0
# Least seconds between two entries, enough for pictures and small for a log of an hour.
_LEAST_STEP = 0.1


@dataclass
class VehicleState:
    """The latest attitude, gimbal angles, and heights, which complete each position.

    Times are seconds of one clock. Angles are in degrees: heading clockwise from north, pitch positive with the nose up, roll
    positive with the right side down.
    """

    _attitude: tuple[float, float, float, float] | None = None
    _gimbal: tuple[float, float, float, float] | None = None
    _above_ground: tuple[float, float] | None = None
    _above_takeoff: tuple[float, float] | None = None
    _unplaced: float = -math.inf
    _filtered: float = -math.inf
    _last: float = -math.inf
    outside: int = field(default=0, init=False)

    def attitude(self, time: float, roll: float, pitch: float, heading: float) -> None:
        """Take the attitude of the aircraft."""
        if all(map(math.isfinite, (roll, pitch, heading))):
            self._attitude = time, roll, pitch, heading

    def gimbal(self, time: float, roll: float, pitch: float, yaw: float, from_north: bool) -> None:
        """Take the angles of a gimbal; its yaw is from north, or from the aircraft's nose."""
        known = self._current(self._attitude, time)
        if not from_north:
            yaw = math.nan if known is None else yaw + known[3]
        if all(map(math.isfinite, (roll, pitch, yaw))):
            self._gimbal = time, roll, pitch, yaw

    def above_ground(self, time: float, metres: float) -> None:
        """Take a measured height above ground."""
        if math.isfinite(metres) and metres > 0:
            self._above_ground = time, metres

    def above_takeoff(self, time: float, metres: float) -> None:
        """Take a height above take-off, for entries without a position."""
        if math.isfinite(metres):
            self._above_takeoff = time, metres

    def unplaced(self, time: float, clock: float | None = None) -> TelemetryEntry | None:
        """Return an entry without a position; None less than 1 s after one with a position, and 0.1 s after any."""
        if 0 <= time - self._last < _HOLD or 0 <= time - self._unplaced < _LEAST_STEP - 1e-6:
            return None
        self._unplaced = time
        height = self._current(self._above_takeoff, time)
        return self._entry(TelemetryEntry(time, clock, height_above_takeoff=None if height is None else height[1]))

    def position(
        self,
        time: float,
        latitude: float,
        longitude: float,
        altitude: float | None = None,
        above_takeoff: float | None = None,
        raw: bool = False,
        clock: float | None = None,
    ) -> TelemetryEntry | None:
        """Return the entry of a position; `raw` marks one of the receiver alone, without a filter.

        Returns:
            None if it is no position on the Earth, comes less than 0.1 s after the last, or is raw while filtered ones come.
        """
        if latitude == longitude == 0 or not (math.isfinite(latitude) and math.isfinite(longitude)):
            return None
        if abs(latitude) > 90 or abs(longitude) > 180:
            self.outside += 1
            return None
        if raw and 0 <= time - self._filtered <= 2 * _HOLD:
            return None
        if not raw:
            self._filtered = time
        # A clock that steps back starts again.
        if 0 <= time - self._last < _LEAST_STEP - 1e-6:
            return None
        self._last = time
        # An unknown altitude may be NaN.
        takeoff, altitude = (h if h is not None and math.isfinite(h) else None for h in (above_takeoff, altitude))
        return self._entry(TelemetryEntry(time, clock, latitude, longitude, None, takeoff, altitude))

    def _entry(self, entry: TelemetryEntry) -> TelemetryEntry:
        height = self._current(self._above_ground, entry.time)
        entry = replace(entry, height_above_ground=None if height is None else height[1])
        if (gimbal := self._current(self._gimbal, entry.time)) is not None and any(gimbal[1:]):
            heading, pitch, roll = cameras.from_gimbal(gimbal[3], gimbal[2], gimbal[1])
            return replace(entry, heading=heading, pitch=pitch, roll=roll, heading_source="gimbal")
        if (attitude := self._current(self._attitude, entry.time)) is None:
            return entry
        # Without a gimbal the camera looks down from the aircraft's belly.
        _, roll, pitch, heading = attitude
        return replace(entry, heading=heading % 360.0, pitch=pitch - 90.0, roll=roll, heading_source="aircraft")

    @staticmethod
    def _current(value: tuple[float, ...] | None, time: float) -> tuple[float, ...] | None:
        return value if value is not None and abs(time - value[0]) <= _HOLD else None


def euler_degrees(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return roll, pitch, and yaw (about z, then y, then x) of a quaternion in degrees; NaN if its norm is not about 1."""
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if not 0.9 < norm < 1.1:
        return math.nan, math.nan, math.nan
    w, x, y, z = (value / norm for value in (w, x, y, z))
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(float(np.clip(2 * (w * y - z * x), -1, 1)))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return math.degrees(roll), math.degrees(pitch), math.degrees(yaw)
