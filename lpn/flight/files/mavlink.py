"""Messages of MAVLink as telemetry, for logs of a ground station and for live links alike.

Positions are GLOBAL_POSITION_INT, or GPS_RAW_INT where no filter speaks; angles ATTITUDE, GIMBAL_DEVICE_ATTITUDE_STATUS, and
MOUNT_ORIENTATION; heights above ground DISTANCE_SENSOR that looks down, and TERRAIN_REPORT.
"""

from __future__ import annotations

import math
import os
from collections import Counter, defaultdict
from typing import Any

from lpn.flight.files.telemetry import TelemetryEntry
from lpn.flight.files.vehicles import VehicleState, euler_degrees

# Values of MAVLink's enumerations: a gimbal whose yaw is from north (lock, or in the earth's frame), a sensor that looks down, a
# fix in three dimensions, an altitude that counts as unknown.
_YAW_LOCK, _YAW_IN_EARTH, _LOOKS_DOWN, _FIX_3D = 16, 32, 25, 3
_POSITIONS = ("GLOBAL_POSITION_INT", "GPS_RAW_INT")


class MavlinkTelemetry:
    """Entries from the messages of one vehicle; those of other systems are counted, and left out.

    Args:
        system: id of the vehicle, 1 to 255. None takes the first that sends a position.
        needs_position: whether entries have positions. Without, attitudes make entries, too, while no position comes, and the
            first system that sends one is the vehicle.

    Attributes:
        foreign: positions of other systems, by id.
        jumps: how often the vehicle's clock, time since boot, stepped back or ahead of the link's by more than 5 s.
    """

    _JUMP = 5.0

    def __init__(self, system: int | None = None, needs_position: bool = True) -> None:
        self.system, self._needs_position = system, needs_position
        self.foreign: Counter[int] = Counter()
        self.jumps = 0
        # An attitude may come before the position that tells which vehicle counts.
        self._states: defaultdict[int, VehicleState] = defaultdict(VehicleState)
        self._lead: float | None = None

    @property
    def outside(self) -> int:
        """The number of positions that were none on the Earth."""
        return 0 if self.system is None else self._states[self.system].outside

    def take(self, message: Any, time: float, clock: float | None = None) -> TelemetryEntry | None:
        """Take a message of pymavlink; return the entry of a position.

        Args:
            time: seconds at which it came, or was logged.
            clock: that moment in seconds since 1970, for the entry, if it is known.
        """
        kind = message.get_type()
        sender = message.get_srcSystem()
        placed = kind in _POSITIONS and (message.lat or message.lon)
        if self.system is None and (placed or (kind == "ATTITUDE" and not self._needs_position)):
            self.system = sender
        if self.system not in (None, sender):
            self.foreign[sender] += kind in _POSITIONS
            return None
        state = self._states[sender]
        match kind:
            case "GLOBAL_POSITION_INT":
                self._watch(message.time_boot_ms / 1000, time)
                state.above_takeoff(time, message.relative_alt / 1000)
                return state.position(
                    time,
                    message.lat / 1e7,
                    message.lon / 1e7,
                    message.alt / 1000,
                    message.relative_alt / 1000,
                    clock=clock,
                )
            case "GPS_RAW_INT" if message.fix_type >= _FIX_3D:
                return state.position(
                    time, message.lat / 1e7, message.lon / 1e7, message.alt / 1000, raw=True, clock=clock
                )
            case "ATTITUDE":
                state.attitude(time, *(math.degrees(angle) for angle in (message.roll, message.pitch, message.yaw)))
                return None if self._needs_position else state.unplaced(time, clock)
            case "MOUNT_ORIENTATION":
                north = getattr(message, "yaw_absolute", math.nan)
                known = math.isfinite(north) and bool(north)
                state.gimbal(time, message.roll, message.pitch, north if known else message.yaw, known)
            case "GIMBAL_DEVICE_ATTITUDE_STATUS":
                state.gimbal(time, *euler_degrees(*message.q), bool(message.flags & (_YAW_LOCK | _YAW_IN_EARTH)))
            case "DISTANCE_SENSOR" if message.orientation == _LOOKS_DOWN:
                if message.min_distance < message.current_distance < message.max_distance:
                    state.above_ground(time, message.current_distance / 100)
            case "TERRAIN_REPORT" if message.loaded:
                state.above_ground(time, message.current_height)
        return None

    def _watch(self, boot: float, time: float) -> None:
        """Count a jump of the vehicle's clock against the link's."""
        lead = boot - time
        if self._lead is not None and abs(lead - self._lead) > self._JUMP:
            self.jumps += 1
        self._lead = lead


def mavlink_package() -> Any:
    """Return pymavlink's `mavutil`, which reads and writes version 2 of the protocol.

    Raises:
        ModuleNotFoundError: if pymavlink is not installed.
    """
    os.environ.setdefault("MAVLINK20", "1")
    from pymavlink import mavutil

    return mavutil
