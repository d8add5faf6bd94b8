"""Autopilots: logs of PX4 (.ulg), ground stations (MAVLink's .tlog), and ArduPilot (.bin, or .log as text), and their messages.

One mapping serves all messages, in logs and by live links. The latest attitude, gimbal angles, and heights complete each
position. A gimbal's angles replace the aircraft's; without a gimbal the camera is assumed to look down from the aircraft's
belly. The extra `live` has the packages that read the files.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lpn.core.errors import DataError, OtherKindError
from lpn.core.files import printable
from lpn.flight.files.base import on_earth
from lpn.flight.files.telemetry import Log, TelemetryEntry, entry_of

SUFFIXES = (".ulg", ".tlog", ".bin")
# A smaller time counts from a start; it is not a UTC epoch.
_FIRST_EPOCH = 10**8
# Topics of PX4 that are used.
_PX4_GPS = ("vehicle_gps_position", "sensor_gps")
_PX4 = ("vehicle_global_position", "vehicle_local_position", "vehicle_attitude", "gimbal_device_attitude_status")
# Seconds for which an angle or a height counts; a filtered position suppresses raw ones for twice as long.
_HOLD = 1.0
# Minimum seconds between two entries: short enough for pictures, and long enough to keep a log of an hour small.
_LEAST_STEP = 0.1
# Values of MAVLink's enumerations: a gimbal's yaw from north (lock, or in the earth's frame), a sensor that looks down, a fix in
# three dimensions.
_YAW_FROM_NORTH, _LOOKS_DOWN, _FIX_3D = 16 | 32, 25, 3
_ATTITUDE = ("bank", "nose", "heading")
_GIMBAL = ("gimbal_roll", "gimbal_pitch", "gimbal_heading", "gimbal_turn")
_POSITION = ("latitude", "longitude", "altitude", "height_above_takeoff")
_PLAIN, _INTEGERS = (1.0,) * 4, (1e-7, 1e-7, 1e-3, 1e-3)
# For each kind of message the names of its values, its fields, and their factors to degrees and metres.
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

    Args:
        needs_position: whether only a position selects the vehicle; otherwise an attitude does, too.

    Attributes:
        system: MAVLink id of the vehicle: of the first system that sends a position, or an attitude.
        others: ids of other systems that send positions, which are left out.
        outside: number of positions that are not on the Earth.
    """

    def __init__(self, needs_position: bool = False) -> None:
        self.system: int | None = None
        self.others: set[int] = set()
        self.outside = 0
        self._needs_position = needs_position
        # The last time and number of each value, by system.
        self._held: defaultdict[int, dict[str, tuple[float, float]]] = defaultdict(dict)
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
        held = self._held[system]
        turn = told.pop("gimbal_turn", math.nan) + _recent(held, time).get("heading", math.nan)
        if "gimbal_heading" not in told and math.isfinite(turn):
            told["gimbal_heading"] = turn
        # The angles of one gimbal's message belong together.
        if not told.keys() >= set(_GIMBAL[:3]):
            told = {what: value for what, value in told.items() if what not in _GIMBAL}
        if not told:
            return None
        held |= {what: (time, value) for what, value in told.items() if what not in _POSITION[:3]}
        has_position = bool(told.get("latitude") or told.get("longitude"))
        if self.system is None and (has_position or ("heading" in told and not self._needs_position)):
            self.system = system
        if self.system not in (None, system):
            self.others |= {system} if has_position else set()
            return None
        self.outside += not on_earth(told.get("latitude", 0.0), told.get("longitude", 0.0))
        entry = entry_of(time, clock, _recent(held, time) | told)
        if entry.latitude is None:
            if 0 <= time - self._placed < _HOLD:
                return None
        elif kind in _RECEIVERS and 0 <= time - self._filtered <= 2 * _HOLD:
            return None
        elif kind not in _RECEIVERS:
            self._filtered = time
        # After a clock steps back, entries start anew. A position does not wait for an entry without a position.
        last = self._last if entry.latitude is None else self._placed
        if 0 <= time - last < _LEAST_STEP - 1e-6:
            return None
        self._last = time
        self._placed = self._placed if entry.latitude is None else time
        return entry


def _recent(held: Mapping[str, tuple[float, float]], time: float) -> dict[str, float]:
    return {what: value for what, (told, value) in held.items() if abs(time - told) <= _HOLD}


def told_by(kind: str, message: Mapping[str, Any]) -> dict[str, float]:
    """Return the values of a message in metres and degrees, by the names in `lpn.flight.files.dialects.UNITS`; NaN where unknown.

    `gimbal_turn` is a gimbal's yaw from the aircraft's nose.
    """
    if kind in _RECEIVERS and message.get(_RECEIVERS[kind], 0) < _FIX_3D:
        return {}
    is_old = kind in _PX4_GPS and "lat" in message  # before PX4 1.14
    fields = _FIELDS.get("GPS_RAW_INT" if is_old else kind, ((), (), ()))
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


def is_vehicle_log(file: Path) -> bool:
    """Return whether a file has the suffix of an autopilot's log, or is ArduPilot's log as text."""
    suffix = file.suffix.lower()
    return suffix in SUFFIXES or (suffix == ".log" and _beginning(file).startswith(_KINDS[suffix][0]))


def read_vehicle_log(file: Path) -> Log:
    """Read a log of an autopilot.

    Raises:
        OtherKindError: if it is of another kind than its suffix says.
        DataError: if it is damaged, or has no position.
        ModuleNotFoundError: if the package that reads it is not installed.
    """
    name, suffix = printable(file.name), file.suffix.lower()
    expected, kind, messages = _KINDS[suffix]
    begin = _beginning(file)
    if not begin.startswith(expected) or (suffix == ".tlog" and begin[8:9] not in (b"\xfe", b"\xfd")):
        found = "is empty" if not begin else f"begins with {begin[:8].hex(' ')}"
        raise OtherKindError(f"{name} {found}; expected {kind}.")
    vehicle, notes = Vehicle(needs_position=True), list[str]()
    try:
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            entries = [entry for message in messages(file, notes) if (entry := vehicle.take(*message)) is not None]
    except ModuleNotFoundError:
        raise
    except Exception as error:  # the packages raise all kinds of errors on damaged bytes
        reason = printable(f"{type(error).__name__}: {error}")[:200]
        raise DataError(f"{name} is damaged and cannot be read as {kind} ({reason}); copy it again.") from error
    entries = [entry for entry in entries if entry.latitude is not None]
    if not entries:
        raise DataError(f"{name} has no position in it; expected the log of a flight with a receiver or a filter.")
    if vehicle.others:
        others = ", ".join(map(str, sorted(vehicle.others)))
        notes.append(
            f"{name} has positions of several vehicles; those of system {vehicle.system} were used, and not those of {others}."
        )
    if vehicle.outside:
        notes.append(f"{vehicle.outside} positions of {name} are not on the Earth, and were left out.")
    utc = all(entry.clock is not None for entry in entries)
    if not utc:
        notes.append(f"{name} has no time of day; its times are counted from its start.")
    return Log(name, tuple(entries), utc, tuple(notes))


def _beginning(file: Path) -> bytes:
    try:
        with file.open("rb") as opened:
            return opened.read(16)
    except OSError as error:
        raise DataError(f"{printable(file.name)} cannot be read ({error.strerror or error}); check it.") from error


# The name, fields, time, and clock of a message, and the MAVLink id of its sender.
_Message = tuple[str, Mapping[str, Any], float, float | None, int]


def _ulog(file: Path, notes: list[str]) -> Iterator[_Message]:
    from pyulog import ULog

    log = ULog(str(file), [*_PX4_GPS, *_PX4])
    if log.file_corruption:
        notes.append(f"{printable(file.name)} is damaged in places; the rest of it was used.")
    topics = {data.name: data.data for data in reversed(log.data_list)}  # the first instance of each counts
    leads = [lead for topic in _PX4_GPS if (lead := _lead(topics.get(topic, {}))) is not None]
    rows = sorted(
        (float(time) / 1e6, topic, i) for topic, data in topics.items() for i, time in enumerate(data["timestamp"])
    )
    for time, topic, i in rows:
        message = {key: float(column[i]) for key, column in topics[topic].items()}
        yield topic, message, time, time + leads[0] if leads else None, 0


def _lead(receiver: dict[str, Any]) -> float | None:
    """Return the seconds from the log's clock to UTC by a receiver's messages; None if it has no time."""
    if "time_utc_usec" not in receiver:
        return None
    utc = receiver["time_utc_usec"].astype(np.float64) / 1e6
    known = utc > _FIRST_EPOCH
    return float(np.median((utc - receiver["timestamp"] / 1e6)[known])) if known.any() else None


def _tlog(file: Path, _: list[str]) -> Iterator[_Message]:
    with contextlib.closing(mavlink_package().mavlogfile(str(file))) as log:
        while (message := log.recv_msg()) is not None:
            yield message.get_type(), vars(message), *_times(message), message.get_srcSystem()


def _data_flash(file: Path, _: list[str]) -> Iterator[_Message]:
    mavlink_package()
    from pymavlink import DFReader

    opened = DFReader.DFReader_text if file.suffix.lower() == ".log" else DFReader.DFReader_binary
    with contextlib.closing(opened(str(file))) as log:
        while (message := log.recv_match(type=["GPS", "POS", "ATT", "MNT", "RFND"])) is not None:
            yield message.get_type(), message.to_dict(), *_times(message), 0


def _times(message: Any) -> tuple[float, float | None]:
    time = float(message._timestamp)
    return time, time if time > _FIRST_EPOCH else None


# The first bytes of each kind, its name, and its reader; a .tlog begins with a time. ArduPilot's .log is its .bin as text.
_KINDS = {
    ".ulg": (b"ULog\x01\x12\x35", "a ULog of PX4", _ulog),
    ".tlog": (b"", "a MAVLink log of a ground station", _tlog),
    ".bin": (b"\xa3\x95\x80", "a data flash log of ArduPilot", _data_flash),
    ".log": (b"FMT,", "a data flash log of ArduPilot as text", _data_flash),
}
