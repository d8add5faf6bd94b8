"""Messages of MAVLink as telemetry, for logs of a ground station and for live links.

Positions come from GLOBAL_POSITION_INT, or from GPS_RAW_INT without a filter. Angles come from ATTITUDE,
GIMBAL_DEVICE_ATTITUDE_STATUS, and MOUNT_ORIENTATION, and heights above ground from a DISTANCE_SENSOR that looks down and from
TERRAIN_REPORT.
"""

from __future__ import annotations

import math
import os
from collections import Counter, defaultdict
from typing import Any

from lpn.flight.files.telemetry import TelemetryEntry
from lpn.flight.files.vehicles import VehicleState, euler_degrees

# Values of MAVLink's enumerations: a gimbal's yaw from north (lock, or in the earth's frame), a sensor that looks down, a fix in
# three dimensions, an unknown altitude.
_YAW_LOCK, _YAW_IN_EARTH, _LOOKS_DOWN, _FIX_3D = 16, 32, 25, 3
_POSITIONS = ("GLOBAL_POSITION_INT", "GPS_RAW_INT")


class MavlinkTelemetry:
    """A converter of one vehicle's messages to entries; positions of other systems are only counted.

    Args:
        system: id of the vehicle, 1 to 255. None takes the first that sends a position.
        needs_position: whether every entry has a position. If not, attitudes also make entries while no position comes, and the
            first system that sends either is the vehicle.

    Attributes:
        foreign: positions of other systems, by id.
        jumps: number of steps of the vehicle's clock (time since boot) against the link's by more than 5 s.
    """

    _JUMP = 5.0

    def __init__(self, system: int | None = None, needs_position: bool = True) -> None:
        self.system, self._needs_position = system, needs_position
        self.foreign: Counter[int] = Counter()
        self.jumps = 0
        # An attitude may come before the position that selects the vehicle.
        self._states: defaultdict[int, VehicleState] = defaultdict(VehicleState)
        self._lead: float | None = None

    @property
    def outside(self) -> int:
        return 0 if self.system is None else self._states[self.system].outside

    def take(self, message: Any, time: float, clock: float | None = None) -> TelemetryEntry | None:
        """Take a message of pymavlink; return the entry of a position.

        Args:
            time: seconds of its arrival or log entry.
            clock: the same moment in seconds since 1970, if known.
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
    """Return pymavlink's `mavutil`, set to version 2 of the protocol.

    Raises:
        ModuleNotFoundError: if pymavlink is not installed.
    """
    os.environ.setdefault("MAVLINK20", "1")
    from pymavlink import mavutil

    return mavutil
