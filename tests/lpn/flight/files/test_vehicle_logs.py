"""Logs of autopilots, written in their real formats by tools.fixtures.vehicle_logs; and damaged ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from lpn.core.errors import DataError
from lpn.flight.files import make_flight
from lpn.flight.files.vehicle_logs import Vehicle, euler_degrees, read_vehicle_log
from tools.fixtures import vehicle_logs
from tools.fixtures.photos import exif, write_photo

WRITERS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "flight.ulg": ("pyulog", vehicle_logs.write_ulog),
    "flight.tlog": ("pymavlink", vehicle_logs.write_tlog),
    "flight.bin": ("pymavlink", vehicle_logs.write_data_flash),
}


def written(folder: Path, name: str) -> Path:
    package, write = WRITERS[name]
    pytest.importorskip(package)
    write(folder / name)
    return folder / name


@pytest.mark.parametrize("name", WRITERS)
def test_a_log_has_positions_heights_and_angles_of_the_aircraft(tmp_path: Path, name: str) -> None:
    log = read_vehicle_log(written(tmp_path, name))
    entries = [row.entry for row in log.rows]
    assert log.utc
    assert len(entries) == 20
    for entry, sample in zip(entries, vehicle_logs.samples(), strict=True):
        assert entry.clock == pytest.approx(vehicle_logs.START + sample.time, abs=0.02)
        assert entry.latitude == pytest.approx(sample.latitude, abs=2e-7)
        assert entry.longitude == pytest.approx(sample.longitude, abs=2e-7)
        assert entry.altitude == pytest.approx(600)
        assert (entry.heading, entry.heading_source) == (pytest.approx(10, abs=0.01), "aircraft")
        # The camera looks down from the belly: a nose 3 degrees down turns it back from straight down.
        assert (entry.pitch, entry.roll) == (pytest.approx(-93, abs=0.01), pytest.approx(2, abs=0.01))
    if name != "flight.ulg":
        assert entries[5].height_above_takeoff == pytest.approx(100)


def test_positions_of_another_vehicle_are_left_out_with_a_note(tmp_path: Path) -> None:
    pytest.importorskip("pymavlink")
    vehicle_logs.write_tlog(tmp_path / "two.tlog", foreign=True)
    log = read_vehicle_log(tmp_path / "two.tlog")
    assert len(log.rows) == 20
    assert log.notes == (
        "two.tlog has positions of several vehicles; those of system 7 were used, and not those of 9.",
    )


@pytest.mark.parametrize("name", ["a.ulg", "a.tlog", "a.bin"])
def test_a_file_of_another_kind_is_refused_in_a_sentence(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"latitude,longitude\n")
    with pytest.raises(DataError, match=r"^a\.\w+ begins with 6c 61 74 69 74 75 64 65; expected a \w+"):
        read_vehicle_log(tmp_path / name)


@pytest.mark.parametrize("name", ["flight.ulg", "flight.tlog", "flight.bin"])
def test_a_log_that_is_cut_short_is_read_so_far(tmp_path: Path, name: str) -> None:
    file = written(tmp_path, name)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    assert 5 <= len(read_vehicle_log(file).rows) < 20


def test_a_log_without_positions_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("pymavlink")
    from pymavlink.dialects.v20 import common

    link = common.MAVLink(None, srcSystem=7, srcComponent=1)
    (tmp_path / "a.tlog").write_bytes(bytes(8) + common.MAVLink_heartbeat_message(2, 3, 0, 0, 0, 3).pack(link))
    with pytest.raises(DataError, match=r"^a\.tlog has no position in it; expected"):
        read_vehicle_log(tmp_path / "a.tlog")


ANGLES = {"Roll": 5, "Pitch": 6, "Yaw": 350}


def test_a_gimbal_counts_before_the_aircraft_while_it_is_recent() -> None:
    vehicle = Vehicle()
    assert vehicle.take("POS", pos(47), 0.0) is not None
    assert vehicle.take("ATT", ANGLES, 0.0) is None
    assert vehicle.take("MNT", {"R": 0, "P": -90, "YB": 20}, 0.0) is None
    entry = vehicle.take("POS", pos(47), 0.5)
    assert entry is not None
    assert (entry.heading, entry.heading_source, entry.pitch) == (pytest.approx(10), "gimbal", -90)
    later = vehicle.take("POS", pos(47), 5.0)
    assert later is not None
    assert later.heading is None


def test_positions_of_the_receiver_alone_give_way_to_filtered_ones_and_return() -> None:
    vehicle, raw = Vehicle(), {**pos(48), "Status": 3}
    assert vehicle.take("POS", pos(47), 0.0) is not None
    assert vehicle.take("GPS", raw, 1.0) is None
    assert vehicle.take("GPS", raw, 9.0) is not None
    assert vehicle.take("GPS", raw, 9.05) is None, "at most ten a second"
    assert vehicle.take("POS", pos(47), 3.0) is not None, "a clock that steps back starts again"


def pos(latitude: float, altitude: float = float("nan")) -> dict[str, float]:
    return {"Lat": latitude, "Lng": 8, "Alt": altitude}


def test_angles_without_a_position_make_entries_once_a_second_has_passed() -> None:
    vehicle = Vehicle()
    for time, expected in ((0.0, True), (0.05, False), (0.2, True)):
        entry = vehicle.take("ATT", ANGLES, time)
        assert (entry is not None and entry.heading == 350.0) == expected
    placed = vehicle.take("POS", pos(47), 0.21)
    assert placed is not None
    assert placed.altitude is None
    assert vehicle.take("ATT", ANGLES, 0.9) is None


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
        ("ATTITUDE", {"roll": 0.0, "pitch": 0.0, "yaw": float("nan")}, {"heading": None, "pitch": -90.0}),
        ("HEARTBEAT", {}, None),
    ],
)  # fmt: skip
def test_each_message_tells_its_values(
    kind: str, message: dict[str, object], expected: dict[str, object] | None
) -> None:
    entry = Vehicle().take(kind, message, 0.0)
    assert (entry is None) == (expected is None)
    for name, value in (expected or {}).items():
        assert getattr(entry, name) == (pytest.approx(value) if isinstance(value, float) else value)


def test_a_quaternion_without_norm_has_no_angles() -> None:
    assert euler_degrees(*vehicle_logs.quaternion(4, -5, 60)) == pytest.approx((4, -5, 60))
    assert all(angle != angle for angle in euler_degrees(0, 0, 0, 0))


@pytest.mark.parametrize("content", [b"\xd3\x00\x13" * 40, b""])
def test_satellite_files_of_djis_cards_are_left_out_and_named(tmp_path: Path, content: bytes) -> None:
    photo = write_photo(tmp_path / "DJI_0001.JPG", exif(47.3, 8.5))
    (tmp_path / "DJI_PPKRAW.bin").write_bytes(content)
    flight = make_flight([photo, tmp_path / "DJI_PPKRAW.bin"], tmp_path / "flight")
    assert [frame.latitude for frame in flight.frames] == [pytest.approx(47.3)]
    assert "Left out, because their kind is not supported: DJI_PPKRAW.bin." in flight.notes


def test_a_damaged_log_of_an_autopilot_is_refused_whatever_its_name_says(tmp_path: Path) -> None:
    photo = write_photo(tmp_path / "DJI_0001.JPG", exif(47.3, 8.5))
    log = tmp_path / "begins with.bin"
    log.write_bytes(b"\xa3\x95\x80\x80" + bytes(200))
    with pytest.raises(DataError):
        make_flight([photo, log], tmp_path / "flight")
