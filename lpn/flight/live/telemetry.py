"""Heading, height, and position of each arriving picture, by a MAVLink link or from a log of any kind."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.flight.files import logs
from lpn.flight.files.base import Frame
from lpn.flight.files.cameras import upright_values
from lpn.flight.files.sources import read_any_log
from lpn.flight.files.telemetry import Telemetry, TelemetryEntry
from lpn.flight.files.vehicle_logs import Vehicle, mavlink_package
from lpn.flight.live.frames import ArrivedPicture, Say

# Seconds for which values count: quickly changing ones, and heights.
FRESH, _HEIGHT_HOLDS = 2.0, 10.0
_SLOW = ("height_above_ground", "height_above_takeoff", "altitude", "fov")
# Maximum number of a link's entries in memory, enough for some seconds.
_ENTRIES = 256
_WAIT = 0.2


class TelemetryValue(NamedTuple):
    """A picture's frame with its telemetry, and the seconds between the two; None without telemetry."""

    frame: Frame
    age: float | None


class LiveTelemetry:
    """A source of heading, height, and position of pictures; this base class uses only the data in the picture's file."""

    def value(self, picture: ArrivedPicture) -> TelemetryValue:
        """Return the picture's frame with the telemetry at its time."""
        return TelemetryValue(picture.frame, None)

    def close(self) -> None:
        """Stop reading."""


def _with(picture: ArrivedPicture, told: dict[str, Any], across_longer_side: bool = False) -> Frame:
    """Return the picture's frame with known values of the telemetry, turned as the picture is."""
    return replace(picture.frame, **upright_values(told, picture.turns, picture.frame, across_longer_side))


class LogTelemetry(LiveTelemetry):
    """A log or track, matched by UTC where both have it; else the first picture is matched with the log's first row.

    Raises:
        DataError: if it has no times.
    """

    def __init__(self, file: Path, say: Say) -> None:
        log = read_any_log(file)
        # The field of view of subtitles is across the longer side of the picture.
        self._across_longer_side = log.end is not None
        self._by_clock = Telemetry(logs.moments(log)[0] if log.utc else [])
        self._elapsed = Telemetry(logs.for_video(log, 0)[0])
        self._start = self._elapsed.entries[0].time
        self._first: float | None = None
        self._say, self._name, self._warned = say, printable(file.name), False

    def value(self, picture: ArrivedPicture) -> TelemetryValue:
        at = picture.frame.time
        if self._by_clock.entries and picture.utc and at is not None:
            told = self._by_clock.at(at)
        else:
            at = picture.received if at is None else at
            self._first = at if self._first is None else self._first
            told = self._elapsed.at(self._start + at - self._first)
        if told:
            return TelemetryValue(_with(picture, told, self._across_longer_side), 0.0)
        if not self._warned:
            self._say(f"{self._name} has nothing at the time of {printable(picture.frame.name)}; it may have ended.")
        self._warned = True
        return TelemetryValue(picture.frame, None)


class MavlinkLink(LiveTelemetry):
    """A link by MAVLink, read in a separate thread.

    Heading, tilt, and position count for 2 s, heights for 10 s.

    Args:
        address: in pymavlink's format, such as udp:127.0.0.1:14550, tcp:127.0.0.1:5760, or a serial device.

    Raises:
        InputError: if the address cannot be opened.
        ModuleNotFoundError: if pymavlink is not installed.
    """

    def __init__(self, address: str, say: Say) -> None:
        mavutil = mavlink_package()
        self._address = printable(address)
        try:
            self._link = mavutil.mavlink_connection(address, dialect="all")
        except Exception as error:  # sockets, serial ports, and pymavlink raise all kinds of errors
            reason = printable(str(error) or type(error).__name__)[:150]
            raise InputError(
                f"The MAVLink address {self._address} cannot be opened ({reason}); expected one such as udp:127.0.0.1:14550, "
                "tcp:127.0.0.1:5760, or a serial device."
            ) from error
        self.vehicle = Vehicle()
        self._say, self._late = say, False
        self._entries: deque[TelemetryEntry] = deque(maxlen=_ENTRIES)
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._read, name="telemetry", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join(timeout=5 * _WAIT)
        self._link.close()

    def value(self, picture: ArrivedPicture) -> TelemetryValue:
        with self._lock:
            entries = list(self._entries)
        if not entries:
            self._warn(f"No position has come by {self._address} yet; frames have no heading and no height.")
            return TelemetryValue(picture.frame, None)
        # Prefer an entry with a position to a slightly nearer one without.
        nearest = min(entries, key=lambda entry: abs(entry.time - picture.received) + FRESH * (entry.latitude is None))
        age = picture.received - nearest.time
        if abs(age) > FRESH:
            self._warn(
                f"Telemetry is {age:.1f} s late; frames have no heading and no position, and their height counts for some "
                "seconds more."
            )
        elif self._late:
            self._late = False
            self._say("Telemetry is in time again.")
        told = nearest.values() if abs(age) <= _HEIGHT_HOLDS else {}
        if abs(age) > FRESH:
            told = {name: told[name] for name in _SLOW if name in told}
        return TelemetryValue(_with(picture, told), age)

    def _warn(self, sentence: str) -> None:
        if not self._late:
            self._say(sentence)
        self._late = True

    def _read(self) -> None:
        told = set[int]()
        while not self._stop.is_set():
            try:
                message = self._link.recv_match(blocking=True, timeout=_WAIT)
            except Exception as error:  # damaged bytes, or a link that breaks; the flight goes on
                self._warn(f"{self._address} failed ({printable(str(error))[:100]}); reading continues.")
                self._stop.wait(_WAIT)
                continue
            if message is None:
                continue
            system = message.get_srcSystem()
            entry = self.vehicle.take(message.get_type(), vars(message), time.monotonic(), system=system)
            if entry is not None:
                with self._lock:
                    self._entries.append(entry)
            for other in self.vehicle.others - told:
                told.add(other)
                self._say(
                    f"System {other} sends positions by {self._address}, too; those of system {self.vehicle.system} are taken."
                )


def open_telemetry(source: str | None, say: Say) -> LiveTelemetry:
    """Open a log or track if `source` is a file, else a MAVLink link; None opens a source without telemetry.

    Raises:
        DataError: if the log cannot be read.
        InputError: if the address cannot be opened.
    """
    if source is None:
        return LiveTelemetry()
    path = Path(source)
    if path.exists() and not path.is_char_device():
        return LogTelemetry(path, say)
    if ":" not in source and not path.is_char_device():
        raise InputError(
            f"There is no {printable(source)}; give a log, a track, or an address such as udp:127.0.0.1:14550."
        )
    return MavlinkLink(source, say)
