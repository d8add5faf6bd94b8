"""Logs of autopilots: ULog of PX4, MAVLink of ground stations (.tlog), and data flash of ArduPilot (.bin, or .log as text).

Messages in the order of time become the same rows as those of tables and tracks. A gimbal's angles precede the aircraft's;
without a gimbal the camera is assumed to look down from the aircraft's belly. The extra `live` has the packages that read the
files.
"""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lpn.core.errors import DataError, OtherKindError
from lpn.core.files import printable
from lpn.flight.files.logs import Log, LogRow
from lpn.flight.files.mavlink import MavlinkTelemetry, mavlink_package
from lpn.flight.files.telemetry import TelemetryEntry
from lpn.flight.files.vehicles import VehicleState, euler_degrees

SUFFIXES = (".ulg", ".tlog", ".bin")
# The first bytes of each kind; a .tlog begins with a time. ArduPilot's .log is its .bin as text.
_BEGINNINGS = {".ulg": b"ULog\x01\x12\x35", ".bin": b"\xa3\x95\x80", ".log": b"FMT,"}
_KINDS = {
    ".ulg": "a ULog of PX4", ".tlog": "a MAVLink log of a ground station", ".bin": "a data flash log of ArduPilot",
    ".log": "a data flash log of ArduPilot as text",
}  # fmt: skip
# A smaller time counts from a start; it is not a UTC epoch.
_FIRST_EPOCH = 10**8
# Topics of PX4 that are used.
_PX4 = (
    "vehicle_global_position",
    "vehicle_gps_position",
    "sensor_gps",
    "vehicle_attitude",
    "vehicle_local_position",
    "gimbal_device_attitude_status",
)
_PX4_GPS = ("vehicle_gps_position", "sensor_gps")


def is_vehicle_log(file: Path) -> bool:
    """Tell whether a file has the suffix of an autopilot's log, or is ArduPilot's log as text."""
    suffix = file.suffix.lower()
    return suffix in SUFFIXES or (suffix == ".log" and _beginning(file).startswith(_BEGINNINGS[suffix]))


def read_vehicle_log(file: Path) -> Log:
    """Read a log of an autopilot.

    Raises:
        OtherKindError: if it is of another kind than its suffix says.
        DataError: if it is damaged, or has no position.
        ModuleNotFoundError: if the package that reads it is not installed.
    """
    name = printable(file.name)
    suffix = file.suffix.lower()
    begin, expected = _beginning(file), _BEGINNINGS.get(suffix)
    if not (begin.startswith(expected) if expected is not None else begin[8:9] in (b"\xfe", b"\xfd")):
        found = "is empty" if not begin else f"begins with {begin[:8].hex(' ')}"
        raise OtherKindError(f"{name} {found}; expected {_KINDS[suffix]}.")
    reader = {".ulg": _ulog, ".tlog": _tlog, ".bin": _data_flash, ".log": _data_flash}[suffix]
    notes: list[str] = []
    try:
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            entries = list(reader(file, name, notes))
    except (DataError, ModuleNotFoundError):
        raise
    except Exception as error:  # the packages raise all kinds of errors on damaged bytes
        reason = printable(f"{type(error).__name__}: {error}")[:200]
        raise DataError(
            f"{name} is damaged and cannot be read as {_KINDS[suffix]} ({reason}); copy it again."
        ) from error
    if not entries:
        raise DataError(f"{name} has no position in it; expected the log of a flight with a receiver or a filter.")
    utc = all(entry.clock is not None for entry in entries)
    if not utc:
        notes.append(f"{name} has no time of day; its times are counted from its start.")
    return Log(name, tuple(LogRow(entry) for entry in entries), utc, tuple(notes))


def _beginning(file: Path) -> bytes:
    try:
        with file.open("rb") as opened:
            return opened.read(16)
    except OSError as error:
        raise DataError(f"{printable(file.name)} cannot be read ({error.strerror or error}); check it.") from error


def _ulog(file: Path, name: str, notes: list[str]) -> Iterator[TelemetryEntry]:
    from pyulog import ULog

    log = ULog(str(file), list(_PX4))
    if log.file_corruption:
        notes.append(f"{name} is damaged in places; the rest of it was used.")
    topics = {data.name: data.data for data in reversed(log.data_list)}  # the first instance of each counts
    leads = [lead for topic in _PX4_GPS if (lead := _lead(topics.get(topic, {}))) is not None]
    rows = sorted(
        (float(time) / 1e6, topic, i) for topic, data in topics.items() for i, time in enumerate(data["timestamp"])
    )
    state = VehicleState()
    for time, topic, i in rows:
        message = {key: float(column[i]) for key, column in topics[topic].items()}
        entry = _px4(state, topic, time, message, time + leads[0] if leads else None)
        if entry is not None:
            yield entry
    notes += _outside(state.outside, name)


def _lead(receiver: dict[str, Any]) -> float | None:
    """Return the seconds from the log's clock to UTC by a receiver's messages; None if it has no time."""
    if "time_utc_usec" not in receiver:
        return None
    utc = receiver["time_utc_usec"].astype(np.float64) / 1e6
    known = utc > _FIRST_EPOCH
    return float(np.median((utc - receiver["timestamp"] / 1e6)[known])) if known.any() else None


def _px4(
    state: VehicleState, topic: str, time: float, message: dict[str, float], clock: float | None
) -> TelemetryEntry | None:
    """Take a message of PX4; return the entry of a position."""
    angles = euler_degrees(*(message.get(f"q[{i}]", math.nan) for i in range(4)))
    if topic == "vehicle_attitude":
        state.attitude(time, *angles)
    elif topic == "gimbal_device_attitude_status":
        # Flags of MAVLink: 16 locks the yaw to north, 32 marks a yaw from north.
        state.gimbal(time, *angles, bool(int(message.get("device_flags", 0)) & 48))
    elif topic == "vehicle_local_position":
        if message.get("dist_bottom_valid"):
            state.above_ground(time, message.get("dist_bottom", math.nan))
    elif topic in _PX4_GPS and message.get("fix_type", 0) >= 3:
        if "latitude_deg" in message:
            scales = {"latitude_deg": 1.0, "longitude_deg": 1.0, "altitude_msl_m": 1.0}
        else:  # before PX4 1.14
            scales = {"lat": 1e7, "lon": 1e7, "alt": 1e3}
        latitude, longitude, altitude = (message.get(key, math.nan) / scale for key, scale in scales.items())
        return state.position(time, latitude, longitude, altitude, raw=True, clock=clock)
    elif topic == "vehicle_global_position" and "lat" in message:
        altitude = message.get("alt", math.nan)
        if message.get("terrain_alt_valid"):
            state.above_ground(time, altitude - message.get("terrain_alt", math.nan))
        return state.position(time, message["lat"], message.get("lon", math.nan), altitude, clock=clock)
    return None


def _tlog(file: Path, name: str, notes: list[str]) -> Iterator[TelemetryEntry]:
    mavutil = mavlink_package()
    log = mavutil.mavlogfile(str(file))
    telemetry = MavlinkTelemetry()
    with contextlib.closing(log):
        while (message := log.recv_msg()) is not None:
            time = float(message._timestamp)
            entry = telemetry.take(message, time, time if time > _FIRST_EPOCH else None)
            if entry is not None:
                yield entry
    if others := [str(system) for system, count in sorted(telemetry.foreign.items()) if count]:
        notes.append(
            f"{name} has positions of several vehicles; those of system {telemetry.system} were used, and not those of "
            f"{', '.join(others)}."
        )
    notes += _outside(telemetry.outside, name)


def _data_flash(file: Path, name: str, notes: list[str]) -> Iterator[TelemetryEntry]:
    mavlink_package()
    from pymavlink import DFReader

    state = VehicleState()
    opened = DFReader.DFReader_text if file.suffix.lower() == ".log" else DFReader.DFReader_binary
    with contextlib.closing(opened(str(file))) as log:
        while (message := log.recv_match(type=["GPS", "POS", "ATT", "MNT", "RFND"])) is not None:
            time = float(message._timestamp)
            clock = time if time > _FIRST_EPOCH else None
            if (entry := _ardupilot(state, message.get_type(), time, message.to_dict(), clock)) is not None:
                yield entry
    notes += _outside(state.outside, name)


def _ardupilot(
    state: VehicleState, kind: str, time: float, message: dict[str, Any], clock: float | None
) -> TelemetryEntry | None:
    """Take a message of ArduPilot; return the entry of a position."""
    match kind:
        case "ATT":
            state.attitude(time, message["Roll"], message["Pitch"], message["Yaw"])
        case "MNT" if {"R", "P"} <= message.keys():
            # YE is the yaw from north, and YB from the nose; NaN if unknown to the mount.
            north = message.get("YE", math.nan)
            known = math.isfinite(north)
            state.gimbal(time, message["R"], message["P"], north if known else message.get("YB", math.nan), known)
        case "RFND" if message.get("Orient", message.get("Orient1")) == 25:
            state.above_ground(time, message.get("Dist", message.get("Dist1", math.nan)))
        case "POS":
            above = message.get("RelHomeAlt")
            return state.position(time, message["Lat"], message["Lng"], message["Alt"], above, clock=clock)
        case "GPS" if message.get("Status", 0) >= 3:
            return state.position(time, message["Lat"], message["Lng"], message["Alt"], raw=True, clock=clock)
    return None


def _outside(count: int, name: str) -> list[str]:
    return [f"{count} positions of {name} are none on the Earth, and were left out."] if count else []
