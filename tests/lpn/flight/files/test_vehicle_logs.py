"""Logs of autopilots, written in their real formats by tools.fixtures.vehicle_logs; and damaged ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from lpn.core.errors import DataError
from lpn.flight.files.sources import read_any_log
from lpn.flight.files.telemetry import TelemetryEntry
from lpn.flight.files.vehicle_logs import Vehicle, euler_degrees
from tools.fixtures import vehicle_logs

WRITERS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "flight.ulg": ("pyulog", vehicle_logs.write_ulog),
    "flight.tlog": ("pymavlink", vehicle_logs.write_tlog),
    "flight.bin": ("pymavlink", vehicle_logs.write_data_flash),
}
ANGLES = {"Roll": 5, "Pitch": 6, "Yaw": 350}
PLACE = {"Lat": 47, "Lng": 8, "Alt": math.nan}


@pytest.mark.parametrize("name", WRITERS)
def test_a_log_has_positions_heights_and_angles_of_the_aircraft(tmp_path: Path, name: str) -> None:
    package, write = WRITERS[name]
    pytest.importorskip(package)
    write(tmp_path / name)
    log = read_any_log(tmp_path / name)
    entries = log.entries
    assert log.utc
    for entry, sample in zip(entries, vehicle_logs.samples(), strict=True):
        assert entry.clock == pytest.approx(vehicle_logs.START + sample.time, abs=0.02)
        assert (entry.latitude, entry.longitude) == pytest.approx((sample.latitude, sample.longitude), abs=2e-7)
        assert entry.altitude == pytest.approx(600)
        assert (entry.heading, entry.heading_source) == (pytest.approx(10, abs=0.01), "aircraft")
        # The camera looks down from the belly: a nose 3 degrees down turns it back from straight down.
        assert (entry.pitch, entry.roll) == (pytest.approx(-93, abs=0.01), pytest.approx(2, abs=0.01))
    if name != "flight.ulg":
        assert entries[5].height_above_takeoff == pytest.approx(100)
    # A log that is cut short is read so far.
    whole = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(whole[: len(whole) // 2])
    assert 5 <= len(read_any_log(tmp_path / name).entries) < 20


def test_a_ulog_that_is_damaged_in_places_says_so(tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    vehicle_logs.write_ulog(tmp_path / "flight.ulg")
    whole = bytearray((tmp_path / "flight.ulg").read_bytes())
    middle = len(whole) // 2
    whole[middle : middle + 40] = bytes(40)
    (tmp_path / "flight.ulg").write_bytes(whole)
    log = read_any_log(tmp_path / "flight.ulg")
    assert 5 <= len(log.entries) < 20
    assert log.notes == ("flight.ulg is damaged in places; the rest of it was used.",)


def test_positions_of_another_vehicle_are_left_out_with_a_note(tmp_path: Path) -> None:
    pytest.importorskip("pymavlink")
    vehicle_logs.write_tlog(tmp_path / "two.tlog", foreign=True)
    log = read_any_log(tmp_path / "two.tlog")
    assert len(log.entries) == 20
    said = "two.tlog has positions of several vehicles; those of system 7 were used, and not those of 9."
    assert log.notes == (said,)


def heartbeat() -> bytes:
    from pymavlink.dialects.v20 import common

    link = common.MAVLink(None, srcSystem=7, srcComponent=1)
    return bytes(8) + bytes(common.MAVLink_heartbeat_message(2, 3, 0, 0, 0, 3).pack(link))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.ulg", b"latitude,longitude\n", r"^a\.ulg begins with 6c 61 74 69 74 75 64 65; expected a ULog of PX4\.$"),
        ("a.tlog", b"latitude,longitude\n", r"^a\.tlog begins with 6c 61 74 69 74 75 64 65; expected a MAVLink log"),
        ("a.bin", b"latitude,longitude\n", r"^a\.bin begins with 6c 61 74 69 74 75 64 65; expected a data flash log"),
        ("a.bin", b"\xa3\x95\x80\x80" + bytes(200), r"^a\.bin (is damaged|has no position)"),
        ("a.tlog", heartbeat, r"^a\.tlog has no position in it; expected"),
    ],
)
def test_a_log_that_cannot_be_read_is_refused_in_a_sentence(
    tmp_path: Path, name: str, content: bytes | Callable[[], bytes], message: str
) -> None:
    pytest.importorskip("pymavlink")
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content())
    with pytest.raises(DataError, match=message):
        read_any_log(tmp_path / name)


# Messages with their times; the values of the last one's entry, None if it makes none.
@pytest.mark.parametrize(
    ("messages", "expected"),
    [
        ([("POS", PLACE, 0.0)], {"latitude": 47.0, "altitude": None, "height_above_takeoff": None}),
        # A gimbal counts before the aircraft while it is recent.
        ([("ATT", ANGLES, 0.0), ("MNT", {"R": 0, "P": -90, "YB": 20}, 0.0), ("POS", PLACE, 0.5)],
         {"heading": 10.0, "heading_source": "gimbal", "pitch": -90.0}),
        # Angles of two of its messages never mix.
        ([("MNT", {"R": 0, "P": -90, "YE": 20}, 0.0), ("MNT", {"R": 0, "P": -30, "YB": 5}, 0.4), ("POS", PLACE, 0.5)],
         {"heading": 20.0, "heading_source": "gimbal", "pitch": -90.0}),
        ([("MNT", {"R": 0, "P": -90, "YB": 20}, 0.0), ("POS", PLACE, 0.5)], {"heading": None, "pitch": None}),
        ([("MNT", {"R": 0, "P": -90, "YB": 20}, 0.0)], None),
        ([("ATT", ANGLES, 0.0), ("POS", PLACE, 5.0)], {"heading": None}),
        # Positions of the receiver alone give way to filtered ones, and return.
        ([("POS", PLACE, 0.0), ("GPS", {**PLACE, "Status": 3}, 1.0)], None),
        ([("POS", PLACE, 0.0), ("GPS", {**PLACE, "Status": 3}, 9.0)], {"latitude": 47.0}),
        ([("POS", PLACE, 9.0), ("POS", PLACE, 9.05)], None),
        ([("POS", PLACE, 9.0), ("POS", PLACE, 3.0)], {"latitude": 47.0}),
        # Angles make entries of their own once no position has come for a second.
        ([("ATT", ANGLES, 0.0)], {"heading": 350.0, "latitude": None}),
        ([("ATT", ANGLES, 0.0), ("ATT", ANGLES, 0.05)], None),
        ([("ATT", ANGLES, 0.0), ("POS", PLACE, 0.01)], {"heading": 350.0, "latitude": 47.0}),
        ([("POS", PLACE, 0.0), ("ATT", ANGLES, 0.9)], None),
    ],
)  # fmt: skip
def test_what_was_told_last_completes_a_position(
    messages: list[tuple[str, dict[str, float], float]], expected: dict[str, object] | None
) -> None:
    vehicle = Vehicle()
    entries = [vehicle.take(*message) for message in messages]
    check(entries[-1], expected)


def test_an_attitude_selects_the_vehicle_only_where_no_position_is_needed() -> None:
    for needs_position, system in ((True, 9), (False, 7)):
        vehicle = Vehicle(needs_position)
        vehicle.take("ATT", ANGLES, 0.0, system=7)
        vehicle.take("HEARTBEAT", {}, 0.0, system=8)
        entry = vehicle.take("POS", PLACE, 0.0, system=9)
        assert vehicle.system == system
        assert (entry is not None) == needs_position
        assert vehicle.others == (set() if needs_position else {9})


def test_positions_off_the_earth_are_counted() -> None:
    vehicle = Vehicle()
    for time, latitude in enumerate((47.0, 147.0, -91.0)):
        assert vehicle.take("POS", {**PLACE, "Lat": latitude}, time) is not None
    assert vehicle.outside == 2


def check(entry: TelemetryEntry | None, expected: dict[str, object] | None) -> None:
    assert (entry is None) == (expected is None)
    for name, value in (expected or {}).items():
        assert getattr(entry, name) == (pytest.approx(value) if isinstance(value, float) else value)


Q = vehicle_logs.quaternion(0, -60, 20)


@pytest.mark.parametrize(
    ("kind", "message", "expected"),
    [
        ("sensor_gps", {"fix_type": 3, "lat": 473010000, "lon": 85010000, "alt": 500000}, {"altitude": 500.0}),
        ("sensor_gps", {"fix_type": 2, "lat": 473010000, "lon": 85010000, "alt": 500000}, None),
        ("vehicle_global_position", {"lat": 47, "lon": 8, "alt": 90, "terrain_alt_valid": 1, "terrain_alt": 30},
         {"height_above_ground": 60.0}),
        ("vehicle_local_position", {"dist_bottom_valid": 1, "dist_bottom": 12.5}, {"height_above_ground": 12.5}),
        ("DISTANCE_SENSOR", {"orientation": 25, "min_distance": 10, "current_distance": 900, "max_distance": 4000},
         {"height_above_ground": 9.0}),
        ("DISTANCE_SENSOR", {"orientation": 0, "min_distance": 10, "current_distance": 900, "max_distance": 4000}, None),
        ("TERRAIN_REPORT", {"loaded": 5, "current_height": 33.0}, {"height_above_ground": 33.0}),
        ("RFND", {"Orient": 25, "Dist": 8.0}, {"height_above_ground": 8.0}),
        ("MOUNT_ORIENTATION", {"roll": 0, "pitch": -90, "yaw": 5, "yaw_absolute": 40}, {"heading": 40.0, "pitch": -90.0}),
        ("GIMBAL_DEVICE_ATTITUDE_STATUS", {"q": Q, "flags": 32}, {"heading": 20.0, "pitch": -60.0, "heading_source": "gimbal"}),
        ("gimbal_device_attitude_status", {**{f"q[{i}]": q for i, q in enumerate(Q)}, "device_flags": 16.0}, {"heading": 20.0}),
        ("ATTITUDE", {"roll": 0.0, "pitch": 0.0, "yaw": math.nan}, {"heading": None, "pitch": -90.0}),
        ("HEARTBEAT", {}, None),
    ],
)  # fmt: skip
def test_each_message_tells_its_values(
    kind: str, message: dict[str, object], expected: dict[str, object] | None
) -> None:
    check(Vehicle().take(kind, message, 0.0), expected)


def test_a_quaternion_without_norm_has_no_angles() -> None:
    assert euler_degrees(*vehicle_logs.quaternion(4, -5, 60)) == pytest.approx((4, -5, 60))
    assert all(angle != angle for angle in euler_degrees(0, 0, 0, 0))
