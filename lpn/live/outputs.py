"""Answers of a flight that goes on, as they are made: GeoJSON lines, MAVLink, and a websocket."""

from __future__ import annotations

import contextlib
import json
import math
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import IO, Any, Literal, get_args
from urllib.parse import urlsplit

from lpn.core.arrays import UInt8Array
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.numbers import heading_figure, wrap_degrees
from lpn.core.resources import is_loopback
from lpn.flights.cameras import rotation
from lpn.live.frames import Say
from lpn.live.telemetry import open_link
from lpn.locate.belief import BestAnswer
from lpn.locate.located import LocatedFrame, StageRecord

# Messages that are sent over MAVLink.
SentAs = Literal["gps", "vision"]
# Degrees by which a camera looks away from straight down: one standard deviation of an unknown tilt, and the most that counts.
_TILT, _MOST_TILT = 5.0, 85.0
# MAVLink's component of visual odometry, flags for what is unknown (altitude; dilution, speeds, vertical accuracy), a 3-D fix.
_COMPONENT = 197
_UNKNOWN_ALTITUDE, _UNKNOWN_RADIUS, _UNKNOWN_REST, _FIX_3D = 1, 64, 2 | 4 | 8 | 16 | 32 | 128, 3
# GPS time: its epoch in seconds since 1970, the seconds by which it leads UTC, and those of a week.
_GPS_EPOCH, _GPS_LEAD, _WEEK = 315_964_800, 18, 604_800
# Lines that wait for a slow reader of the websocket; older ones are dropped. Seconds between two looks whether it has left.
_WAITING, _LOOK = 4, 1.0


@dataclass(frozen=True, eq=False)
class LiveFix:
    """The answer for one frame of a flight that goes on.

    Attributes:
        located: the frame with the answers of its stages.
        best: the answer that counts, of the registration or the sequence, moved below the camera as far as its tilt is known.
        latitude, longitude: WGS 84 degrees; None without a place.
        clock: of the frame in seconds since 1970 in UTC.
        age: seconds from the frame's arrival to the answer.
        dropped: frames before this one that were replaced by newer ones, since the start.
        telemetry_age: seconds between frame and telemetry; None without telemetry.
        pixels: of the frame, RGB (H, W, 3).
    """

    located: LocatedFrame
    best: BestAnswer
    latitude: float | None
    longitude: float | None
    clock: float
    age: float
    dropped: int
    telemetry_age: float | None = None
    pixels: UInt8Array | None = None

    @property
    def answer(self) -> StageRecord:
        """The answer that counts."""
        return self.best.answer

    @property
    def radius(self) -> float | None:
        """1-sigma radius in metres of the camera's place, with the tilt as an error where the answer is the picture's middle."""
        if self.answer.radius is None or self.answer.camera:
            return self.answer.radius
        frame = self.located.frame
        height = frame.flying_height or (self.answer.width or 0.0) / 2
        down = 1.0 if frame.pitch is None else float(rotation(0.0, frame.pitch, frame.roll or 0.0)[2, 2])
        tilt = min(max(math.degrees(math.acos(min(max(down, -1.0), 1.0))), _TILT), _MOST_TILT)
        return math.hypot(self.answer.radius, height * math.tan(math.radians(tilt)))

    @property
    def may_correct(self) -> bool:
        """True if the place may correct the vehicle's own position, which alone holds back none that it contradicts."""
        return self.best.usable or (self.answer.accepted and self.best.doubt == ("tag",))

    def feature(self) -> dict[str, Any]:
        """Return the fix as a feature of GeoJSON (RFC 7946), see docs/live.md."""
        answer, best = self.answer, self.best
        geometry = None
        if self.latitude is not None and self.longitude is not None:
            geometry = {"type": "Point", "coordinates": [round(self.longitude, 8), round(self.latitude, 8)]}
        properties = {
            "frame": printable(self.located.frame.name),
            "stage": best.stage,
            "state": best.state,
            "doubt": ", ".join(best.doubt),
            "checked_beside_middle": best.checked,
            "reason": best.reason,
            "note": best.verdict.reason,
            "time": round(self.clock, 3),
            "camera": answer.camera,
            "radius": _rounded(answer.radius, 2),
            "heading": heading_figure(answer.heading),
            "error": _rounded(self.located.error_of(self.answer), 2),
            "age": round(self.age, 3),
            "dropped": self.dropped,
            "telemetry_age": _rounded(self.telemetry_age, 3),
        }
        return {"type": "Feature", "geometry": geometry, "properties": properties}

    def line(self) -> str:
        """Return the feature as one line."""
        return json.dumps(self.feature(), ensure_ascii=False, allow_nan=False)


class LineOutput:
    """GeoJSON, a line each, into a file or to the standard output."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream

    def send(self, fix: LiveFix) -> None:
        """Write a fix at once."""
        self._stream.write(fix.line() + "\n")
        self._stream.flush()

    def close(self) -> None:
        """Leave the stream to its owner."""


class MavlinkOutput:
    """Accepted places that map and sequence do not contradict, as GPS_INPUT or VISION_POSITION_ESTIMATE.

    VISION_POSITION_ESTIMATE is in metres north and east of the vehicle's own origin, so nothing is sent before the vehicle has
    told it by GPS_GLOBAL_ORIGIN.

    Args:
        address: as pymavlink takes it, such as udpout:127.0.0.1:14551.
        sent_as: which message.
        origin: returns latitude and longitude of the vehicle's origin once it is known.
        system: returns the vehicle's id once it is known.

    Raises:
        InputError: if the address cannot be opened.
    """

    def __init__(
        self,
        address: str,
        sent_as: SentAs,
        say: Say,
        origin: Callable[[], tuple[float, float] | None],
        system: Callable[[], int | None],
    ) -> None:
        if sent_as not in get_args(SentAs):
            raise InputError(f"The message is {sent_as!r}; expected gps or vision.")
        self._link = open_link(address, source_component=_COMPONENT, source_system=1)
        self._kind, self._say, self._origin, self._system = sent_as, say, origin, system
        self._waits = False

    def send(self, fix: LiveFix) -> None:
        """Send a fix, unless it is refused, or map or sequence contradict it, see `LiveFix.may_correct`."""
        if not fix.may_correct or fix.latitude is None or fix.longitude is None:
            return
        self._link.mav.srcSystem = self._system() or 1
        if self._kind == "gps":
            self._send_gps(fix, fix.latitude, fix.longitude)
            return
        origin = self._origin()
        if origin is None:
            if not self._waits:
                self._say(
                    "The vehicle has not told its origin (GPS_GLOBAL_ORIGIN) yet; VISION_POSITION_ESTIMATE waits for it."
                )
            self._waits = True
            return
        self._send_vision(fix, fix.latitude, fix.longitude, origin)

    def close(self) -> None:
        """Close the link."""
        self._link.close()

    def _send_gps(self, fix: LiveFix, latitude: float, longitude: float) -> None:
        altitude = fix.located.frame.altitude
        week, rest = divmod(fix.clock - _GPS_EPOCH + _GPS_LEAD, _WEEK)
        self._link.mav.gps_input_send(
            int(1e6 * fix.clock),
            0,
            _UNKNOWN_REST
            | (_UNKNOWN_ALTITUDE if altitude is None else 0)
            | (_UNKNOWN_RADIUS if fix.radius is None else 0),
            int(1000 * rest),
            int(week),
            _FIX_3D,
            round(1e7 * latitude),
            round(1e7 * longitude),
            altitude or 0.0,
            0.0,
            0.0,
            0.0,
            0.0,
            0.0,
            0.0,
            fix.radius or 0.0,
            0.0,
            10,
        )

    def _send_vision(self, fix: LiveFix, latitude: float, longitude: float, origin: tuple[float, float]) -> None:
        import numpy as np

        from lpn.flights.base import local_metres

        east, north = local_metres(np.array([origin, (latitude, longitude)]))[1].tolist()
        frame, radius = fix.located.frame, math.nan if fix.radius is None else fix.radius
        height = frame.height_above_takeoff
        heading = fix.answer.heading
        # The upper triangle of the covariance of x, y, z, roll, pitch, yaw by rows; NaN where nothing is known.
        covariance = [0.0] * 21
        covariance[0] = covariance[6] = radius**2
        covariance[11] = covariance[15] = covariance[18] = covariance[20] = math.nan
        self._link.mav.vision_position_estimate_send(
            int(1e6 * fix.clock),
            north,
            east,
            math.nan if height is None else -height,
            math.nan,
            math.nan,
            math.nan if heading is None else math.radians(wrap_degrees(heading)),
            covariance,
        )


class WebsocketOutput:
    """A websocket that sends each fix as a line of GeoJSON to all that are connected; a slow reader misses lines.

    A page of another host cannot connect: a browser's Origin must have the name of the host itself, and on a loopback address a
    name of this machine. Pages of other ports of the host can.

    Args:
        host, port: to listen on; port 0 takes a free one.

    Attributes:
        port: that it listens on.

    Raises:
        InputError: if the port cannot be listened on.
        ModuleNotFoundError: if websockets is not installed.
    """

    def __init__(self, host: str, port: int) -> None:
        from websockets.sync.server import serve

        self._lock, self._readers = threading.Lock(), list[queue.Queue[str | None]]()
        self._closed, self._is_loopback = False, is_loopback(host)
        try:
            self._server = serve(self._serve, host, port, process_request=self._refuse_other_sites)
        except (OSError, OverflowError) as error:
            raise InputError(
                f"The websocket cannot listen on {printable(host)}:{port} ({getattr(error, 'strerror', None) or error}); choose "
                "another --serve."
            ) from error
        self.port = int(self._server.socket.getsockname()[1])
        self._thread = threading.Thread(target=self._server.serve_forever, name="websocket", daemon=True)
        self._thread.start()

    def send(self, fix: LiveFix) -> None:
        """Send a fix to all that are connected, without waiting for them."""
        line = fix.line()
        with self._lock:
            for reader in self._readers:
                while True:
                    try:
                        reader.put_nowait(line)
                        break
                    except queue.Full:
                        with contextlib.suppress(queue.Empty):
                            reader.get_nowait()

    def close(self) -> None:
        """Disconnect all."""
        with self._lock:
            self._closed = True
            for reader in self._readers:
                with contextlib.suppress(queue.Empty):
                    while True:
                        reader.get_nowait()
                reader.put_nowait(None)
        self._server.shutdown()
        self._thread.join(timeout=2)

    def _serve(self, connection: Any) -> None:
        from websockets.exceptions import ConnectionClosed
        from websockets.protocol import State

        reader: queue.Queue[str | None] = queue.Queue(_WAITING)
        with self._lock:
            if self._closed:
                return
            self._readers.append(reader)
        try:
            while connection.state is State.OPEN:
                with contextlib.suppress(queue.Empty):  # a browser may leave while no frame comes
                    if (line := reader.get(timeout=_LOOK)) is None:
                        break
                    connection.send(line)
        except ConnectionClosed:
            pass
        finally:
            with self._lock:
                self._readers.remove(reader)

    def _refuse_other_sites(self, connection: Any, request: Any) -> Any:
        origin, host = request.headers.get("Origin"), urlsplit(f"//{request.headers.get('Host', '')}").hostname or ""
        # A foreign name may lead to this machine, too.
        if origin is None or (urlsplit(origin).hostname == host and (is_loopback(host) or not self._is_loopback)):
            return None
        return connection.respond(403, "Pages of other sites cannot connect.\n")


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, digits)
