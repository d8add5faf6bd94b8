"""Logs of autopilots, written in their real formats by tools.fixtures.vehicle_logs; and damaged ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from lpn.core.errors import DataError
from lpn.flight.files import make_flight
from lpn.flight.files.vehicle_logs import read_vehicle_log
from lpn.flight.files.vehicles import VehicleState, euler_degrees
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


def test_a_gimbal_counts_before_the_aircraft_while_it_is_recent() -> None:
    state = VehicleState()
    state.attitude(0.0, 5, 6, 350)
    state.gimbal(0.0, 0, -90, 20, from_north=False)
    entry = state.position(0.5, 47, 8)
    assert entry is not None
    assert (entry.heading, entry.heading_source, entry.pitch) == (pytest.approx(10), "gimbal", -90)
    later = state.position(5.0, 47, 8)
    assert later is not None
    assert later.heading is None


def test_positions_of_the_receiver_alone_give_way_to_filtered_ones_and_return() -> None:
    state = VehicleState()
    assert state.position(0.0, 47, 8) is not None
    assert state.position(1.0, 48, 8, raw=True) is None
    assert state.position(9.0, 48, 8, raw=True) is not None
    assert state.position(3.0, 47, 8) is not None, "a clock that steps back starts again"


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


def test_an_altitude_that_is_not_known_is_none() -> None:
    entry = VehicleState().position(0.0, 47, 8, float("nan"), float("nan"))
    assert entry is not None
    assert (entry.altitude, entry.height_above_takeoff) == (None, None)
