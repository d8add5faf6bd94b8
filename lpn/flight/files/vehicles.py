"""Messages of autopilots as telemetry: those of PX4, MAVLink, and ArduPilot by one mapping, for logs and for live links.

The latest attitude, gimbal angles, and heights complete each position. A gimbal's angles precede the aircraft's; without a gimbal
the camera is assumed to look down from the aircraft's belly.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

from lpn.flight.files.telemetry import TelemetryEntry, entry_of

# Seconds for which an angle or a height holds, and for which a filtered position suppresses raw ones.
_HOLD = 1.0
# Least seconds between two entries, enough for pictures and small for a log of an hour.
_LEAST_STEP = 0.1
# Values of MAVLink's enumerations: a gimbal's yaw from north (lock, or in the earth's frame), a sensor that looks down, a fix in
# three dimensions.
_YAW_FROM_NORTH, _LOOKS_DOWN, _FIX_3D = 16 | 32, 25, 3
_ATTITUDE = ("bank", "nose", "heading")
_GIMBAL = ("gimbal_roll", "gimbal_pitch", "gimbal_heading", "gimbal_turn")
_POSITION = ("latitude", "longitude", "altitude", "height_above_takeoff")
_PLAIN, _INTEGERS = (1.0,) * 4, (1e-7, 1e-7, 1e-3, 1e-3)
_OLD_PX4 = (_POSITION, ("lat", "lon", "alt"), _INTEGERS)
# What messages tell, their fields for it, and the factors to degrees and metres.
_FIELDS: dict[str, tuple[tuple[str, ...], tuple[str, ...], tuple[float, ...]]] = {
    # MAVLink
    "ATTITUDE": (_ATTITUDE, ("roll", "pitch", "yaw"), (math.degrees(1),) * 3),
    "MOUNT_ORIENTATION": (_GIMBAL, ("roll", "pitch", "yaw_absolute", "yaw"), _PLAIN),
    "GLOBAL_POSITION_INT": (_POSITION, ("lat", "lon", "alt", "relative_alt"), _INTEGERS),
    "GPS_RAW_INT": (_POSITION, ("lat", "lon", "alt"), _INTEGERS),
    # ArduPilot
    "ATT": (_ATTITUDE, ("Roll", "Pitch", "Yaw"), _PLAIN),
    "MNT": (_GIMBAL, ("R", "P", "YE", "YB"), _PLAIN),
    "POS": (_POSITION, ("Lat", "Lng", "Alt", "RelHomeAlt"), _PLAIN),
    "GPS": (_POSITION, ("Lat", "Lng", "Alt"), _PLAIN),
    # PX4
    "vehicle_global_position": (_POSITION, ("lat", "lon", "alt"), _PLAIN),
    "vehicle_gps_position": (_POSITION, ("latitude_deg", "longitude_deg", "altitude_msl_m"), _PLAIN),
    "sensor_gps": (_POSITION, ("latitude_deg", "longitude_deg", "altitude_msl_m"), _PLAIN),
}
# Positions of a receiver without a filter, and the field of their kind of fix.
_RECEIVERS = {"GPS_RAW_INT": "fix_type", "GPS": "Status", "vehicle_gps_position": "fix_type", "sensor_gps": "fix_type"}


class Vehicle:
    """A converter of one vehicle's messages to entries.

    Attributes:
        system: MAVLink id of the vehicle: of the first system that sends a position or an attitude.
        others: ids of other systems that send positions, which are left out.
    """

    def __init__(self) -> None:
        self.system: int | None = None
        self.others: set[int] = set()
        # The time and value of what was told last.
        self._held: dict[str, tuple[float, float]] = {}
        self._filtered = self._placed = self._last = -math.inf

    def take(
        self, kind: str, message: Mapping[str, Any], time: float, clock: float | None = None, system: int = 0
    ) -> TelemetryEntry | None:
        """Take a message.

        Args:
            kind, message: its name, and its fields.
            time: seconds of one clock.
            clock: the same moment in seconds since 1970, if known.
            system: MAVLink id of the sender.

        Returns:
            The entry of a position, or of angles and heights if no position has come for 1 s; at most ten a second. Positions of
            a receiver alone are left out while filtered ones come.
        """
        told = {what: float(value) for what, value in told_by(kind, message).items() if math.isfinite(value)}
        if not told:
            return None
        has_position = bool(told.get("latitude") or told.get("longitude"))
        if self.system is None and (has_position or "heading" in told):
            self.system = system
        if self.system not in (None, system):
            self.others |= {system} if has_position else set()
            return None
        turn = told.pop("gimbal_turn", math.nan) + self._now(time).get("heading", math.nan)
        if "gimbal_heading" not in told and math.isfinite(turn):
            told["gimbal_heading"] = turn
        self._held |= {what: (time, value) for what, value in told.items() if what not in _POSITION[:3]}
        entry = entry_of(time, clock, self._now(time) | told)
        if entry.latitude is None:
            if 0 <= time - self._placed < _HOLD:
                return None
        elif kind in _RECEIVERS and 0 <= time - self._filtered <= 2 * _HOLD:
            return None
        elif kind not in _RECEIVERS:
            self._filtered = time
        # A clock that steps back starts again. A position does not wait for an entry without one.
        last = self._last if entry.latitude is None else self._placed
        if 0 <= time - last < _LEAST_STEP - 1e-6:
            return None
        self._last = time
        self._placed = self._placed if entry.latitude is None else time
        return entry

    def _now(self, time: float) -> dict[str, float]:
        return {what: value for what, (told, value) in self._held.items() if abs(time - told) <= _HOLD}


def told_by(kind: str, message: Mapping[str, Any]) -> dict[str, float]:
    """Return what a message tells in metres and degrees, by the names in `lpn.flight.files.dialects.UNITS`; NaN where unknown.

    `gimbal_turn` is a gimbal's yaw from the aircraft's nose.
    """
    if kind in _RECEIVERS and message.get(_RECEIVERS[kind], 0) < _FIX_3D:
        return {}
    is_old = kind in ("vehicle_gps_position", "sensor_gps") and "lat" in message  # before PX4 1.14
    fields = _OLD_PX4 if is_old else _FIELDS.get(kind, ((), (), ()))
    told = {what: factor * message.get(field, math.nan) for what, field, factor in zip(*fields, strict=False)}
    metres = math.nan
    match kind:
        case "vehicle_attitude":
            return dict(zip(_ATTITUDE, euler_degrees(*_quaternion(message)), strict=True))
        case "gimbal_device_attitude_status" | "GIMBAL_DEVICE_ATTITUDE_STATUS":
            roll, pitch, yaw = euler_degrees(*_quaternion(message))
            flags = int(message.get("flags", message.get("device_flags", 0)))
            what = "gimbal_heading" if flags & _YAW_FROM_NORTH else "gimbal_turn"
            return {"gimbal_roll": roll, "gimbal_pitch": pitch, what: yaw}
        case "MOUNT_ORIENTATION" | "MNT" if not told["gimbal_heading"]:
            del told["gimbal_heading"]  # 0 is unknown
        case "vehicle_global_position" if message.get("terrain_alt_valid"):
            metres = told["altitude"] - message.get("terrain_alt", math.nan)
        case "vehicle_local_position" if message.get("dist_bottom_valid"):
            metres = message.get("dist_bottom", math.nan)
        case "DISTANCE_SENSOR" if message["orientation"] == _LOOKS_DOWN:
            if message["min_distance"] < message["current_distance"] < message["max_distance"]:
                metres = message["current_distance"] / 100
        case "TERRAIN_REPORT" if message["loaded"]:
            metres = message["current_height"]
        case "RFND" if message.get("Orient", message.get("Orient1")) == _LOOKS_DOWN:
            metres = message.get("Dist", message.get("Dist1", math.nan))
    return told | ({"height_above_ground": metres} if metres > 0 else {})


def _quaternion(message: Mapping[str, Any]) -> Sequence[float]:
    return message.get("q") or [message.get(f"q[{i}]", math.nan) for i in range(4)]


def euler_degrees(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return roll, pitch, and yaw (about z, then y, then x) of a quaternion in degrees; NaN if its norm is not about 1."""
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if not 0.9 < norm < 1.1:
        return math.nan, math.nan, math.nan
    w, x, y, z = (value / norm for value in (w, x, y, z))
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(min(1.0, max(-1.0, 2 * (w * y - z * x))))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return math.degrees(roll), math.degrees(pitch), math.degrees(yaw)


def mavlink_package() -> Any:
    """Return pymavlink's `mavutil`, set to version 2 of the protocol.

    Raises:
        ModuleNotFoundError: if pymavlink is not installed.
    """
    os.environ.setdefault("MAVLINK20", "1")
    from pymavlink import mavutil

    return mavutil
