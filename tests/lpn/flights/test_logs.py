"""Logs of the programs that people use, their units, and logs that fit nothing."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from PIL import ExifTags

from lpn.core.errors import DataError
from lpn.flights import make_flight
from lpn.flights.logs import for_video, read_log, rows_by_name
from tools.fixtures.photos import dji_xmp, exif, write_photo
from tools.fixtures.videos import write_video

WILDNAV = (
    "Filename,Latitude,Longitude,Altitude,Gimball_Roll,Gimball_Yaw,Gimball_Pitch,Flight_Roll,Flight_Yaw,Flight_Pitch\n"
    "1.jpg,60.403241,22.462133,+119.98,+0.00,-4.70,-89.30,-8.50,+1.60,-11.00\n"
    "2.jpg,60.402258,22.465155,+120.01,+0.00,+0.00,+0.00,-1.00,-86.80,-10.90\n"
)
VISLOC = (
    "num,filename,date,lat,lon,height,Omega,Kappa,Phi1,Phi2\n"
    "1,01_0001.JPG,2018-09-13 10:00:00,29.774065,115.970635,405.251007,1.5,-2.5,-170.0,10\n"
    "2,01_0002.JPG,2018-09-13 10:00:04,29.775065,115.970635,405.251007,0.5,0.5,-170.0,10\n"
)
AIRDATA = (
    "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),height_above_ground_at_drone_location(feet),"
    "altitude_above_seaLevel(feet), compass_heading(degrees), pitch(degrees),isVideo,gimbal_heading(degrees),"
    "gimbal_pitch(degrees),gimbal_roll(degrees)\n"
    + "".join(
        f"{1000 * i},2024-05-01 12:00:{i:02d},{47 + i / 10_000},8.0,{100 + i},{90 + i},1000,350,5,{int(i in (3, 4, 5) or i > 7)},"
        "10,-90,0\n"
        for i in range(12)
    )
)


def written(folder: Path, text: str, name: str = "log.csv") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text, "utf-8")
    return folder / name


def test_wildnav_s_rows_are_read(tmp_path: Path) -> None:
    log = read_log(written(tmp_path, WILDNAV))
    first, second = (rows_by_name(log)[name][0].entry for name in ("1.jpg", "2.jpg"))
    assert (first.latitude, first.longitude, first.height_above_takeoff, first.altitude) == (
        60.403241,
        22.462133,
        119.98,
        None,
    )
    assert (first.heading, first.heading_source, first.pitch, first.roll) == (
        pytest.approx(355.3),
        "gimbal",
        -89.3,
        0.0,
    )
    # A gimbal of which all angles are 0 is unknown, so the aircraft's heading counts.
    assert (second.heading, second.heading_source, second.pitch) == (pytest.approx(273.2), "aircraft", None)
    assert any("counts as height above take-off" in note for note in log.notes)


def test_uav_visloc_brings_its_photos(tmp_path: Path) -> None:
    for name in ("01_0001.JPG", "01_0002.JPG", "other.JPG"):
        write_photo(tmp_path / "drone" / name)
    flight = make_flight([written(tmp_path, VISLOC, "01.csv")], tmp_path / "flight")
    assert [frame.name for frame in flight.frames] == ["01_0001.JPG", "01_0002.JPG"]
    frame = flight.frames[0]
    assert (frame.latitude, frame.longitude, frame.height_above_takeoff) == (29.774065, 115.970635, 405.251007)
    assert (frame.heading, frame.heading_source, frame.pitch, frame.roll) == (190.0, "aircraft", -88.5, -2.5)
    assert flight.times.tolist() == [0.0, 4.0]
    assert any("does not say above what" in note for note in flight.notes)


def test_a_log_s_aircraft_does_not_replace_the_gimbal_s_heading(tmp_path: Path) -> None:
    packet = dji_xmp(GimbalYawDegree=190, GimbalPitchDegree=-80, GimbalRollDegree=0)
    write_photo(tmp_path / "gimbal.jpg", exif(1.0, 2.0), packet)
    write_photo(tmp_path / "bare.jpg")
    log = "filename,latitude,longitude,compass_heading\ngimbal.jpg,47,8,10\nbare.jpg,47,8,10\n"
    flight = make_flight([tmp_path, written(tmp_path, log)], tmp_path / "flight")
    found = {frame.name: (frame.latitude, frame.heading, frame.heading_source, frame.pitch) for frame in flight.frames}
    assert found == {"gimbal.jpg": (47.0, 190.0, "gimbal", -80.0), "bare.jpg": (47.0, 10.0, "aircraft", None)}
    assert any(
        "keeps the heading of its gimbal, which is better than that of the aircraft" in note for note in flight.notes
    )


@pytest.mark.parametrize(("orientation", "heading"), [(1, 40.0), (3, 220.0), (6, 310.0), (8, 130.0)])
def test_a_log_s_heading_turns_with_the_picture(tmp_path: Path, orientation: int, heading: float) -> None:
    write_photo(tmp_path / "a.jpg", exif(1.0, 2.0, main={ExifTags.Base.Orientation: orientation}))
    for columns, values, pitch in (("heading", "40", None), ("gimbal_yaw,gimbal_pitch", "40,-90", -90.0)):
        log = written(tmp_path, f"filename,latitude,longitude,{columns}\na.jpg,47,8,{values}\n")
        flight = make_flight([tmp_path / "a.jpg", log], tmp_path / "flight")
        assert flight.frames[0].heading == pytest.approx(heading)
        assert flight.frames[0].pitch == (None if pitch is None else pytest.approx(pitch))
        assert any("by its EXIF orientation" in note for note in flight.notes) == (orientation != 1)


def test_airdata_s_feet_become_metres_and_its_recordings_begin_with_the_video(tmp_path: Path) -> None:
    log = read_log(written(tmp_path, AIRDATA))
    assert log.utc
    entries, notes = for_video(log, 0)
    assert notes == []
    assert [entry.time for entry in entries] == [0.0, 1.0, 2.0]
    assert entries[0].latitude == pytest.approx(47.0003)
    assert entries[0].height_above_takeoff == pytest.approx(103 * 0.3048)
    assert entries[0].height_above_ground == pytest.approx(93 * 0.3048)
    assert entries[0].altitude == pytest.approx(304.8)
    assert (entries[0].heading, entries[0].heading_source, entries[0].pitch) == (10.0, "gimbal", -90.0)
    assert [entry.time for entry in for_video(log, 1)[0]] == [0.0, 1.0, 2.0, 3.0]
    with pytest.raises(DataError, match=r"log\.csv tells of 2 recordings, and this is video 3"):
        for_video(log, 2)
    video = write_video(tmp_path / "a.mp4", 3)
    flight = make_flight([video, tmp_path / "log.csv"], tmp_path / "flight")
    assert [frame.latitude for frame in flight.frames] == pytest.approx(
        [47.0003 + (f.time or 0) / 10_000 for f in flight.frames]
    )


def test_a_log_of_moments_fits_photos_by_utc(tmp_path: Path) -> None:
    gps = {ExifTags.GPS.GPSDateStamp: "2024:05:01", ExifTags.GPS.GPSTimeStamp: (12.0, 0.0, 4.0)}
    write_photo(tmp_path / "a.jpg", exif(1.0, 2.0, gps=gps))
    write_photo(tmp_path / "b.jpg", exif(1.0, 2.0))
    flight = make_flight([tmp_path / "a.jpg", tmp_path / "b.jpg", written(tmp_path, AIRDATA)], tmp_path / "flight")
    assert [frame.latitude for frame in flight.frames] == pytest.approx([47.0004, 1.0])
    assert any("gives the values of 1 of 2 photos, by UTC" in note for note in flight.notes)


def test_a_log_that_fits_nothing_is_told_and_the_run_goes_on(tmp_path: Path) -> None:
    photo = write_photo(tmp_path / "other.jpg", exif(1.0, 2.0))
    flight = make_flight([photo, written(tmp_path, WILDNAV)], tmp_path / "flight")
    assert flight.frames[0].latitude == 1.0
    assert "log.csv fits none of the 1 photos by name, and was not used." in flight.notes
    with pytest.raises(DataError, match=r"No photo that log\.csv names is below its folder"):
        make_flight([written(tmp_path / "alone", WILDNAV)], tmp_path / "none")
    video = write_video(tmp_path / "a.mp4", 1)
    flight = make_flight([video, tmp_path / "log.csv"], tmp_path / "flight")
    assert any("log.csv tells no times" in note for note in flight.notes)


def test_generic_names_units_and_separators_are_known(tmp_path: Path) -> None:
    header = "File;Lat;Lng;Rel Alt [ft];Yaw (rad);FOV;elapsed_ms"
    rows = "photos\\A.JPG;10;-20;100;3.14159265;70;1500\nb.jpg;0;0;N/A;;;\n"
    log = read_log(written(tmp_path, f"\ufeffsep=;\n{header}\n{rows}"))
    entry = rows_by_name(log)["a.jpg"][0].entry
    assert (entry.latitude, entry.longitude, entry.fov, entry.time) == (10.0, -20.0, 70.0, 1.5)
    assert entry.height_above_takeoff == pytest.approx(30.48)
    assert (entry.heading, entry.heading_source) == (pytest.approx(180.0), "aircraft")
    empty = rows_by_name(log)["b.jpg"][0].entry
    assert (empty.latitude, empty.height_above_takeoff, empty.heading, math.isnan(empty.time)) == (
        None,
        None,
        None,
        True,
    )
    assert "1 of 2 rows of log.csv have no position." in log.notes
    fathoms = read_log(written(tmp_path, "lat,lon,rel_alt(fathoms)\n1,2,3\n"))
    assert fathoms.rows[0].entry.height_above_takeoff is None
    assert "in an unknown unit" in fathoms.notes[0]


def test_a_log_without_a_recording_begins_with_the_video_and_says_so(tmp_path: Path) -> None:
    log = read_log(written(tmp_path, "timestamp,lat,lon\n1714564800.5,1,2\n1714564802.5,1.1,2\n"))
    entries, notes = for_video(log, 0)
    assert [entry.time for entry in entries] == [0.0, 2.0]
    assert "its first row counts as the beginning" in notes[0]
    dated = read_log(written(tmp_path, "date,lat,lon\n2024-05-01T12:00:00+02:00,1,2\n"))
    assert dated.utc
    assert dated.rows[0].entry.clock == 1714557600.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"log\.csv is empty"),
        ("a,b\n1,2\n", r"log\.csv has the columns a, b; expected latitude and longitude"),
        ("lat,lon\n", r"log\.csv has column names and no row"),
        ("lat,lon\n1,2\nx,3\n", r"Line 3 of log\.csv has the latitude 'x'; expected a number"),
        ("sep=,\nlat,lon\n\n1,2\n\nx,3\n", r"Line 6 of log\.csv has the latitude 'x'"),
        ('lat,lon,name\n1,2,"a\nb"\nx,3,c\n', r"Line 4 of log\.csv has the latitude 'x'"),
        ("lat,lon\n100,3\n", r"Line 2 of log\.csv has the position 100, 3; expected degrees"),
        ("lat,lon\n1,inf\n", r"Line 2 of log\.csv has the longitude 'inf'"),
    ],
)
def test_damaged_logs_are_refused_by_their_row(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        read_log(written(tmp_path, text))
