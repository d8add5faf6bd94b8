"""Heading, height, and position of each arriving picture, by a MAVLink link or from a log of any kind."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.flight.files import logs
from lpn.flight.files.base import Frame
from lpn.flight.files.cameras import upright_values
from lpn.flight.files.mavlink import MavlinkTelemetry, mavlink_package
from lpn.flight.files.sources import read_any_log
from lpn.flight.files.subtitles import read_subtitles
from lpn.flight.files.telemetry import VALUES, Telemetry, TelemetryEntry
from lpn.flight.files.videos import SUBTITLES
from lpn.flight.live.frames import ArrivedPicture, Say

# Seconds for which quickly changing values hold, and heights.
FRESH, _HEIGHT_HOLDS = 2.0, 10.0
_QUICK = ("heading", "heading_source", "pitch", "roll", "latitude", "longitude")
# Most entries of a link in memory, some seconds' worth.
_ENTRIES = 256
_WAIT = 0.2


class TelemetryValue(NamedTuple):
    """A picture's frame with its telemetry, and the seconds between the two; None without telemetry."""

    frame: Frame
    age: float | None


class LiveTelemetry:
    """A source of heading, height, and position of pictures; this base class adds nothing to the picture's file."""

    # True if the telemetry's field of view is across the longer side of the picture, as in subtitles.
    _across_longer_side = False

    def value(self, picture: ArrivedPicture) -> TelemetryValue:
        """Return the picture's frame with the telemetry at its time."""
        return TelemetryValue(picture.frame, None)

    def _frame(self, picture: ArrivedPicture, known: dict[str, Any]) -> Frame:
        """Return the picture's frame with known values of the telemetry, turned as the picture is."""
        upright = upright_values(known, picture.turns, picture.frame, self._across_longer_side)
        return replace(picture.frame, **upright)

    def close(self) -> None:
        """Stop reading."""


class LogTelemetry(LiveTelemetry):
    """A log or track, matched by UTC where both have it, else with the first picture at the log's first row.

    Raises:
        DataError: if it has no times.
    """

    def __init__(self, file: Path, say: Say) -> None:
        self._first: float | None = None
        self._across_longer_side = file.suffix.lower() in SUBTITLES
        if self._across_longer_side:
            entries, self._utc = list(read_subtitles(file).entries), False
            self._by_clock = Telemetry([])
        else:
            log = read_any_log(file)
            clocked, _ = logs.moments(log)
            self._by_clock, self._utc = Telemetry(clocked), log.utc and bool(clocked)
            entries, _ = logs.for_video(log, 0)
        self._elapsed = Telemetry(entries)
        if not self._elapsed.entries:
            raise DataError(f"{printable(file.name)} has no moment with a position; expected the log of a flight.")
        self._start = self._elapsed.entries[0].time
        self._say, self._name, self._warned = say, printable(file.name), False

    def value(self, picture: ArrivedPicture) -> TelemetryValue:
        at = picture.frame.time
        if self._utc and picture.utc and at is not None:
            known = self._by_clock.at(at)
        else:
            at = picture.received if at is None else at
            self._first = at if self._first is None else self._first
            known = self._elapsed.at(self._start + at - self._first)
        known = {name: value for name, value in known.items() if value is not None}
        if not known:
            if not self._warned:
                self._say(
                    f"{self._name} has nothing at the time of {printable(picture.frame.name)}; it may have ended."
                )
            self._warned = True
            return TelemetryValue(picture.frame, None)
        return TelemetryValue(self._frame(picture, known), 0.0)


class MavlinkLink(LiveTelemetry):
    """A link by MAVLink, read by a thread of its own.

    The first system that sends a position is the vehicle. Heading, tilt, and position count for 2 s, heights for 10 s.

    Args:
        address: in pymavlink's format, such as udp:127.0.0.1:14550, tcp:127.0.0.1:5760, or a serial device.

    Raises:
        InputError: if the address cannot be opened.
        ModuleNotFoundError: if pymavlink is not installed.
    """

    def __init__(self, address: str, say: Say) -> None:
        self._link = open_link(address)
        self._telemetry = MavlinkTelemetry(needs_position=False)
        self._say, self._address = say, printable(address)
        self._entries: deque[TelemetryEntry] = deque(maxlen=_ENTRIES)
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._jumps, self._foreign, self._late = 0, set[int](), False
        self._thread = threading.Thread(target=self._read, name="telemetry", daemon=True)
        self._thread.start()

    @property
    def system(self) -> int | None:
        """Id of the vehicle, once one was heard."""
        return self._telemetry.system

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
        known: dict[str, Any] = {name: value for name in VALUES if (value := getattr(nearest, name)) is not None}
        if abs(age) > FRESH:
            self._warn(
                f"Telemetry is {age:.1f} s late; frames have no heading and no position, and their height counts for some "
                "seconds more."
            )
            known = {name: value for name, value in known.items() if name not in _QUICK}
        elif self._late:
            self._late = False
            self._say("Telemetry is in time again.")
        if abs(age) > _HEIGHT_HOLDS:
            known = {}
        return TelemetryValue(self._frame(picture, known), age)

    def _warn(self, sentence: str) -> None:
        if not self._late:
            self._say(sentence)
        self._late = True

    def _read(self) -> None:
        while not self._stop.is_set():
            try:
                message = self._link.recv_match(blocking=True, timeout=_WAIT)
            except Exception as error:  # damaged bytes, or a link that breaks; the flight goes on
                self._warn(f"{self._address} failed ({printable(str(error))[:100]}); it is read on.")
                self._stop.wait(_WAIT)
                continue
            if message is not None:
                self._take(message)

    def _take(self, message: Any) -> None:
        entry = self._telemetry.take(message, time.monotonic())
        if entry is not None:
            with self._lock:
                self._entries.append(entry)
        for other, count in list(self._telemetry.foreign.items()):
            if count and other not in self._foreign:
                self._foreign.add(other)
                self._say(
                    f"System {other} sends positions by {self._address}, too; those of system {self.system} are taken."
                )
        if self._telemetry.jumps > self._jumps:
            self._jumps = self._telemetry.jumps
            self._say("The vehicle's clock has jumped; the time at which its messages come counts.")


def open_link(address: str) -> Any:
    """Return pymavlink's connection of an address.

    Raises:
        InputError: if it cannot be opened.
    """
    mavutil = mavlink_package()
    try:
        return mavutil.mavlink_connection(address, dialect="all")
    except Exception as error:  # sockets, serial ports, and pymavlink raise what they like
        reason = printable(str(error) or type(error).__name__)[:150]
        raise InputError(
            f"The MAVLink address {printable(address)} cannot be opened ({reason}); expected one such as udp:127.0.0.1:14550, "
            "tcp:127.0.0.1:5760, or a serial device."
        ) from error


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
