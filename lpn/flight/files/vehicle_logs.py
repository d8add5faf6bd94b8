"""Logs of autopilots: ULog of PX4, MAVLink of ground stations (.tlog), and data flash of ArduPilot (.bin, or .log as text).

Messages in the order of time become the same rows as those of tables and tracks, see `lpn.flight.files.vehicles`. The extra
`live` has the packages that read the files.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lpn.core.errors import DataError, OtherKindError
from lpn.core.files import printable
from lpn.flight.files.logs import Log, LogRow
from lpn.flight.files.vehicles import Vehicle, mavlink_package

SUFFIXES = (".ulg", ".tlog", ".bin")
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
    vehicle = Vehicle()
    try:
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            entries = [entry for message in messages(file) if (entry := vehicle.take(*message)) is not None]
    except ModuleNotFoundError:
        raise
    except Exception as error:  # the packages raise all kinds of errors on damaged bytes
        reason = printable(f"{type(error).__name__}: {error}")[:200]
        raise DataError(f"{name} is damaged and cannot be read as {kind} ({reason}); copy it again.") from error
    entries = [entry for entry in entries if entry.latitude is not None]
    if not entries:
        raise DataError(f"{name} has no position in it; expected the log of a flight with a receiver or a filter.")
    notes = []
    if vehicle.others:
        others = ", ".join(map(str, sorted(vehicle.others)))
        notes.append(
            f"{name} has positions of several vehicles; those of system {vehicle.system} were used, and not those of {others}."
        )
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


# The name, fields, time, and clock of a message, and the MAVLink id of its sender.
_Message = tuple[str, Mapping[str, Any], float, float | None, int]


def _ulog(file: Path) -> Iterator[_Message]:
    from pyulog import ULog

    log = ULog(str(file), list(_PX4))
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


def _tlog(file: Path) -> Iterator[_Message]:
    with contextlib.closing(mavlink_package().mavlogfile(str(file))) as log:
        while (message := log.recv_msg()) is not None:
            yield message.get_type(), vars(message), *_times(message), message.get_srcSystem()


def _data_flash(file: Path) -> Iterator[_Message]:
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
