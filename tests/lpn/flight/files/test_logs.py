"""Logs and tracks beside photos and videos, values that are none, logs that fit nothing, and clocks that differ."""

from __future__ import annotations

import struct
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from PIL import ExifTags, Image

from lpn.core.errors import DataError
from lpn.flight.files import Flight, FlightOptions, make_flight
from lpn.flight.files.logs import for_video, moments, nearest_in_folders, parse_track, path_parts, read_log
from lpn.flight.files.sources import read_any_log
from tools.fixtures.photos import dji_xmp, exif, write_photo
from tools.fixtures.videos import write_video

AIRDATA = "time(millisecond),datetime(utc),latitude,longitude,isVideo\n" + "".join(
    f"{1000 * i},2024-05-01 12:00:{i:02d},{47 + i / 10_000},8.0,{int(i in (3, 4, 5) or i > 7)}\n" for i in range(12)
)
NOON = 1714564800.0
POINT = '<trkpt lat="{}" lon="8.5"><ele>{}</ele>{}</trkpt>\n'


def written(folder: Path, text: str, name: str = "log.csv") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text, "utf-8")
    return folder / name


def time(second: int, zone: str = "Z") -> str:
    return f"<time>2024-05-01T12:00:{second:02d}{zone}</time>"


def gpx(inside: str) -> str:
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="1.1" creator="a &amp; b" '
        f'xmlns="http://www.topografix.com/GPX/1/1"><trk><name>x</name><trkseg>\n{inside}</trkseg></trk></gpx>'
    )


# One point a second to the north.
TRACK = gpx("".join(POINT.format(47.3 + i / 1000, 500 + i, time(i)) for i in range(20)))
UNTIMED = gpx("".join(POINT.format(47.3 + i / 1000, 500 + i, "") for i in range(2)))


def taken(second: int, hour: int = 12, place: tuple[float, float] | None = None) -> Image.Exif:
    """EXIF of a photo at noon in UTC, or at another hour of an unknown zone."""
    utc = {ExifTags.GPS.GPSDateStamp: "2024:05:01", ExifTags.GPS.GPSTimeStamp: (12.0, 0.0, float(second))}
    clock = {ExifTags.Base.DateTimeOriginal: f"2024:05:01 {hour}:00:{second:02d}"}
    return exif(*(place or (None, None)), camera=clock, gps=utc if hour == 12 else None)


def waypoint(name: str) -> str:
    return f'<gpx version="1.1"><wpt lat="47.1" lon="8.1"><ele>512</ele><name>{name}</name></wpt></gpx>'


ONE, TWO = "100MEDIA/DJI_0001.JPG", "101MEDIA/DJI_0001.JPG"
NOT_TOLD = "so none of them has its values; write the photos' folders into the log."
FAR = "km from those of the photos in the median; check that the log is of this flight"
TWICE = (
    "1 of 1 photos are listed more than once in log.csv with different values, such as a.jpg in lines 2 and 3 and 4;"
)
BARE = "file,lat,lon\nDJI_0001.JPG,47.1,8\n"
LISTED = "filename,lat,lon\na.jpg,47.4,8.5\na.jpg,47.3,8.5\na.jpg,47.4,8.6\n"


# The log; the photos with their EXIF; their latitudes with it; a part of a note, and a part of none.
@pytest.mark.parametrize(
    ("name", "text", "photos", "latitudes", "note", "no_note"),
    [
        ("log.csv", "file,lat,lon\nD:\\DCIM\\101MEDIA\\DJI_0001.JPG,47.2,8\nD:\\DCIM\\100MEDIA\\DJI_0001.JPG,47.1,8\n",
         {ONE: None, TWO: None}, (47.1, 47.2), "gives the values of 2 of 2 photos, by name", NOT_TOLD),
        # A row of one folder does not match a photo in another.
        ("log.csv", "file,lat,lon\n100MEDIA/DJI_0001.JPG,47.1,8\n", {ONE: None, TWO: None}, (47.1, None), "1 of 2", NOT_TOLD),
        ("log.csv", BARE + "DJI_0002.JPG,47.3,8\n", {ONE: None, TWO: None}, (None, None), NOT_TOLD, "gives the"),
        ("log.csv", "file,lat,lon\nDJI_0001,47.1,8\n", {ONE: None, TWO: None}, (None, None), NOT_TOLD, "gives the"),
        ("geo.txt", "EPSG:4326\nDJI_0001.JPG 8.1 47.1 500\n", {ONE: None, TWO: None}, (None, None), NOT_TOLD, "gives the"),
        ("track.gpx", waypoint("DJI_0001.JPG"), {ONE: None, TWO: None}, (None, None), NOT_TOLD, "gives the"),
        # The photos' own positions decide.
        ("log.csv", BARE, {ONE: exif(47.10001, 8.0), TWO: exif(47.2, 8.0)}, (47.1, 47.2), "gives the values of 1", NOT_TOLD),
        ("log.csv", BARE, {ONE: exif(47.10001, 8.0), TWO: exif(47.10002, 8.0)}, (47.10001, 47.10002), NOT_TOLD, "gives the"),
        ("log.csv", BARE, {ONE: exif(47.10001, 8.0), TWO: None}, (47.10001, None), NOT_TOLD, "gives the"),
        ("log.csv", LISTED, {"a.jpg": exif(47.30001, 8.5)}, (47.3,), TWICE, FAR),
        ("log.csv", LISTED, {"a.jpg": None}, (47.4,), TWICE, FAR),
        ("log.csv", "filename,lat,lon\na.jpg,47.4,8.5\na.jpg,47.4,8.5\n", {"a.jpg": None}, (47.4,), "by name", "more than once"),
        ("log.csv", "filename,lat,lon\na.jpg,47.301,8.5\n", {"a.jpg": exif(47.3, 8.5)}, (47.301,), "by name", FAR),
        ("log.csv", "filename,lat,lon\na.jpg,8.5,47.3\n", {"a.jpg": exif(47.3, 8.5)}, (8.5,), FAR, "fits none"),
        ("log.csv", "#Label,X/Longitude,Y/Latitude\na,8.5,47.3\n", {"a.JPG": None}, (47.3,), "by name", "fits none"),
        ("track.gpx", waypoint("a.jpg"), {"a.jpg": None}, (47.1,), "by name", "fits none"),
        ("log.csv", "filename,lat,lon\n1.jpg,60.4,22.4\n", {"a.jpg": exif(1.0, 2.0)}, (1.0,),
         "log.csv fits no photo by name, and was not used.", "gives the"),
        # By time
        ("log.csv", AIRDATA, {"a.jpg": taken(4, place=(1.0, 2.0)), "b.jpg": exif(1.0, 2.0)}, (47.0004, 1.0),
         "gives the values of 1 of 2 photos, by UTC", "constant offset"),
        ("track.gpx", TRACK, {"a.jpg": taken(3), "b.jpg": taken(12)}, (47.303, 47.312),
         "track.gpx gives the values of 2 of 2 photos, by UTC; they replace those in the files.", "constant offset"),
        ("track.gpx", TRACK, {"a.jpg": taken(3, 14), "b.jpg": taken(12, 14)}, (47.303, 47.312),
         "2 photos, by their clock, with a constant offset: the log's clock is 2 h behind the photos'; they replace", "by UTC"),
        ("track.gpx", UNTIMED, {"a.jpg": exif(47.3, 8.5)}, (47.3,),
         "track.gpx has no point with a time, so it fits no picture; export a track with times.", "gives the"),
    ],
)  # fmt: skip
def test_photos_take_the_rows_that_are_theirs(
    tmp_path: Path, name: str, text: str, photos: dict[str, Image.Exif | None], latitudes: tuple[float | None, ...],
    note: str, no_note: str,
) -> None:  # fmt: skip
    for file, tags in photos.items():
        write_photo(tmp_path / "photos" / file, tags)
    flight = make_flight([tmp_path / "photos", written(tmp_path, text, name)], tmp_path / "flight")
    found = {frame.name: frame.latitude for frame in flight.frames}
    assert found == pytest.approx(dict(zip(photos, latitudes, strict=True)))
    assert any(note in one for one in flight.notes)
    assert not any(no_note in one for one in flight.notes)
    if note is NOT_TOLD:
        assert all(file in next(one for one in flight.notes if note in one) for file in photos)


def test_a_log_alone_brings_its_photos(tmp_path: Path) -> None:
    for name in ("1.JPG", "2.JPG", "other.JPG"):
        write_photo(tmp_path / "drone" / name)
    rows = "1.JPG,2018-09-13 10:00:00,29.7,115.9\n2.JPG,2018-09-13 10:00:04,29.8,115.9\n"
    flight = make_flight([written(tmp_path, f"filename,date,lat,lon\n{rows}")], tmp_path / "flight")
    assert [(frame.name, frame.time) for frame in flight.frames] == [("1.JPG", 0.0), ("2.JPG", 4.0)]
    alone = written(tmp_path / "alone", "filename,lat,lon\n1.jpg,60.4,22.4\n")
    with pytest.raises(DataError, match=r"No photo that log\.csv names is below its folder"):
        make_flight([alone], tmp_path / "none")


def test_a_log_s_aircraft_does_not_replace_the_gimbal_s_heading(tmp_path: Path) -> None:
    packet = dji_xmp(GimbalYawDegree=190, GimbalPitchDegree=-80, GimbalRollDegree=0)
    write_photo(tmp_path / "gimbal.jpg", exif(1.0, 2.0), packet)
    write_photo(tmp_path / "bare.jpg")
    log = "filename,latitude,longitude,compass_heading\ngimbal.jpg,47,8,10\nbare.jpg,47,8,10\n"
    flight = make_flight([tmp_path, written(tmp_path, log)], tmp_path / "flight")
    found = {frame.name: (frame.latitude, frame.heading, frame.heading_source, frame.pitch) for frame in flight.frames}
    assert found == {"gimbal.jpg": (47.0, 190.0, "gimbal", -80.0), "bare.jpg": (47.0, 10.0, "aircraft", None)}
    said = "keeps the heading of its gimbal, which is better than that of the aircraft"
    assert any(said in note for note in flight.notes)


def test_a_log_s_heading_turns_with_the_picture(tmp_path: Path) -> None:
    write_photo(tmp_path / "a.jpg", exif(1.0, 2.0, main={ExifTags.Base.Orientation: 6}), size=(64, 48))
    log = written(tmp_path, "filename,latitude,longitude,heading,hfov\na.jpg,47,8,40,45\n")
    flight = make_flight([tmp_path / "a.jpg", log], tmp_path / "flight")
    frame = flight.frames[0]
    assert (frame.heading, frame.fov) == (310.0, pytest.approx(34.51, abs=0.01))
    assert "1 of 1 photos: each is turned by 90° by its EXIF orientation, and its heading with it." in flight.notes


FROM_FIRST = "log.csv does not say when the video began; its first row counts as the beginning."
ONLY_START = "log.csv has the start of the video but not its length; all rows from there on were used."
STARTS = "time(millisecond),latitude,longitude,isVideo\n" + "".join(
    f"{1000 * i},{47 + i / 10_000},8.5,{int(i in (3, 12))}\n" for i in range(20)
)


@pytest.mark.parametrize(
    ("text", "number", "first", "count", "note"),
    [
        (AIRDATA, 0, 47.0003, 3, None),
        (AIRDATA, 1, 47.0008, 4, None),
        (STARTS, 0, 47.0003, 9, ONLY_START),
        (STARTS, 1, 47.0012, 8, ONLY_START),
        ("timestamp,lat,lon\n1714564800.5,1,2\n1714564801.5,1.1,2\n", 0, 1.0, 2, FROM_FIRST),
        ("date,lat,lon\n2024-05-01T12:00:00+02:00,1,2\n", 0, 1.0, 1, FROM_FIRST),
    ],
)
def test_recordings_of_a_log_begin_with_the_video(
    tmp_path: Path, text: str, number: int, first: float, count: int, note: str | None
) -> None:
    log = read_log(written(tmp_path, text))
    entries, notes = for_video(log, number)
    assert [entry.time for entry in entries] == [float(i) for i in range(count)]
    assert entries[0].latitude == pytest.approx(first)
    assert notes == ([] if note is None else [note])
    assert log.utc == (text is not STARTS)
    if "isVideo" in text:
        with pytest.raises(DataError, match=r"log\.csv has 2 recordings, and this is video 3"):
            for_video(log, 2)


def test_each_video_has_its_own_recording_of_a_log(tmp_path: Path) -> None:
    films = [write_video(tmp_path / name, 2) for name in ("a.mp4", "b.mp4")]
    flight = make_flight([*films, written(tmp_path, AIRDATA)], tmp_path / "flight")
    first = {frame.name[0]: frame.latitude for frame in reversed(flight.frames)}
    assert first == pytest.approx({"a": 47.0003, "b": 47.0008})


@pytest.mark.parametrize(
    ("name", "text", "begins", "start", "note"),
    [
        ("log.csv", AIRDATA, None, 47.0003, ""),
        ("log.csv", "filename,lat,lon\n1.jpg,60.4,22.4\n", None, None, "log.csv has no times"),
        ("track.gpx", TRACK, None, 47.3, "track.gpx does not say when the video began; its first row counts as the beginning"),
        ("track.gpx", TRACK, 10, 47.31, "The video's start in track.gpx follows from the video file's time"),
    ],
)  # fmt: skip
def test_a_video_takes_its_positions_from_a_log(
    tmp_path: Path, name: str, text: str, begins: int | None, start: float | None, note: str
) -> None:
    video = write_video(tmp_path / "a.mp4", 3)
    if begins is not None:
        pytest.importorskip("av")
        data = bytearray(video.read_bytes())
        # The film's header has its creation in seconds since 1904.
        at = data.index(b"mvhd") + 8
        data[at : at + 4] = struct.pack(">I", int(NOON) + begins + 2_082_844_800)
        video.write_bytes(data)
    flight = make_flight([video, written(tmp_path, text, name)], tmp_path / "flight")
    step = 1 / 1000 if name == "track.gpx" else 1 / 10_000
    for frame in flight.frames:
        expected = None if start is None else pytest.approx(start + step * (frame.time or 0))
        assert frame.latitude == expected
    assert any(note in one for one in flight.notes)


@pytest.mark.parametrize("zone", ["Z", "+00:00", ".0000Z", ""])
def test_a_gpx_track_is_a_log_of_moments_in_utc(zone: str) -> None:
    log = parse_track(gpx("".join(POINT.format(47.3, 500 + i, time(i, zone)) for i in range(3))), "a.gpx")
    found = [(row.clock, row.latitude, row.longitude, row.altitude) for row in log.entries]
    assert found == [(NOON + i, 47.3, 8.5, 500.0 + i) for i in range(3)]
    assert log.utc == (zone != "")
    assert log.notes == ()


def test_points_that_are_none_on_the_earth_are_left_out() -> None:
    log = parse_track(gpx(POINT.format("nan", 5, time(1)) + POINT.format(47.3, "nan", time(2))), "a.gpx")
    assert [(row.latitude, row.altitude) for row in log.entries] == [(47.3, None)]
    assert log.notes == ("1 of 2 points of a.gpx have no time, or no position on the Earth, and were left out.",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is no GPX"),
        ("PK\x03\x04damaged", "is no GPX"),
        ("<gpx>", "is cut off or damaged, so it was not read; export the track again"),
        (TRACK[:300], "is cut off or damaged"),
        (TRACK.replace("47.3", "47,3"), "is cut off or damaged"),
        (gpx(""), "has no point with a position"),
        (gpx(POINT.format(147.3, 5, time(1))), "has no point with a position on the Earth"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><gpx>&a;</gpx>', "has a DTD or entities"),
        ("<!DOCTYPE x SYSTEM 'file:///etc/passwd'><gpx></gpx>", "has a DTD or entities"),
    ],
)
def test_files_that_are_no_tracks_are_refused_in_one_sentence(text: str, message: str) -> None:
    with pytest.raises(DataError) as error:
        parse_track(text, "a.gpx")
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("name", "instead"), [("track.kml", "GPX or CSV"), ("flight.bag", "CSV, .ulg, .tlog, or .bin"), ("CLIP.ASS", "SRT")]
)
def test_a_file_of_a_kind_that_is_not_read_is_refused_wherever_it_is_named(
    tmp_path: Path, name: str, instead: str
) -> None:
    file = written(tmp_path, "<kml/>", name)
    told = f"{file} is {file.suffix.upper()}, which is not read; give the flight as {instead}."
    for given in ([write_photo(tmp_path / "a.jpg"), file], [file]):
        with pytest.raises(DataError) as error:
            make_flight(given, tmp_path / "flight")
        assert str(error.value) == told
    with pytest.raises(DataError, match="which is not read"):
        read_any_log(file)


# The column, and its cells; the headings, pitches, or fields of view that are read; a part of a note.
@pytest.mark.parametrize(
    ("column", "cells", "expected", "note"),
    [
        ("yaw", ["10"] * 15 + ["-9999"] + ["20"] * 4, [10.0] * 15 + [None] + [20.0] * 4,
         "1 of 20 values of the column yaw of log.csv, first in line 17, were not used; expected from -360 to 360 degrees."),
        ("yaw", ["10", "-9999"], [None] * 2, "was left out: it holds -9999; expected angles from -360 to 360 degrees"),
        ("yaw", ["9000", "9010", "120"], [None] * 3, "name another unit behind a column, as in (cdeg)."),
        ("gimbal_pitch", ["270", "275", "285.5"], [-90.0, -85.0, -74.5], ""),
        ("gimbal_pitch", ["90", "85"], [None, None],
         "all its angles look up, by 85 degrees or more, and -90 should be straight down; give the pitch with --pitch"),
        ("fov", ["0", "0"], [None] * 2, "fov of log.csv was left out: it holds 0; expected angles from 0.1 to 170"),
        ("fov", ["70"] * 10 + ["170", "0.1", "175"], [70.0] * 10 + [170.0, 0.1, None],
         "1 of 13 values of the column fov of log.csv, first in line"),
    ],
)  # fmt: skip
def test_angles_beyond_their_range_are_not_used(
    tmp_path: Path, column: str, cells: list[str], expected: list[float | None], note: str
) -> None:
    log = read_log(written(tmp_path, f"lat,lon,{column}\n" + "".join(f"47.3,8.5,{cell}\n" for cell in cells)))
    names = {"yaw": "heading", "gimbal_pitch": "pitch", "fov": "fov"}
    found = [getattr(row, names[column]) for row in log.entries]
    assert found == [None if angle is None else pytest.approx(angle) for angle in expected]
    assert any(note in line for line in log.notes) if note else not log.notes


@pytest.mark.parametrize(
    ("dates", "clock", "says"),
    [
        (("5/13/2024 12:00:00", "5/1/2024 12:00:00"), 1715601600.0, False),
        (("13/5/2024 12:00:00", "1/5/2024 12:00:00"), 1715601600.0, False),
        (("5/1/2024 12:00 PM", "5/1/2024 12:00 AM"), NOON, True),
        (("1714564800000", ""), NOON, False),
        (("1714564800000000", ""), NOON, False),
    ],
)
def test_dates_of_every_spelling_are_read_for_the_file_as_a_whole(
    tmp_path: Path, dates: tuple[str, str], clock: float, says: bool
) -> None:
    log = read_log(written(tmp_path, "date,lat,lon\n" + "".join(f"{date},47.3,8.5\n" for date in dates)))
    assert log.entries[0].clock == clock
    assert any("no date in it rules that out" in note for note in log.notes) == says


def test_the_first_row_of_a_moment_counts_and_fractions_of_seconds_come_from_the_elapsed_time(tmp_path: Path) -> None:
    noon = "2024-05-01 12:00:0"
    log = read_log(
        written(tmp_path, f"datetime(utc),lat,lon\n{noon}0,,8\n{noon}0,47.0,8\n{noon}0,47.9,8\n{noon}1,47.1,8")
    )
    said = (
        "1 of 2 moments of log.csv are listed more than once with different positions; the first row of each was used."
    )
    for entries, notes in (moments(log), for_video(log, 0)):
        assert [entry.latitude for entry in entries] == [47.0, 47.1]
        assert notes[-1] == said
    # Airdata has ten rows a second, whole seconds of UTC, and milliseconds from the start, here 0.3 s past a second.
    rows = [f"{100 * i},{noon}{(3 + i) // 10},{47 + i / 1000},8" for i in range(30)]
    entries, notes = moments(read_log(written(tmp_path, "time(millisecond),datetime(utc),lat,lon\n" + "\n".join(rows))))
    assert not notes
    assert [round(entry.time - NOON, 3) for entry in entries[:3]] == [0.3, 0.4, 0.5]


def test_logs_that_were_joined_have_the_line_of_names_again(tmp_path: Path) -> None:
    log = read_log(written(tmp_path, "name,lat,lon\na.jpg,47.3,8.5\nname,lat,lon\nb.jpg,47.4,8.5\n"))
    assert [(row.file, row.latitude, row.line) for row in log.entries] == [("a.jpg", 47.3, 2), ("b.jpg", 47.4, 4)]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("geo.txt", "EPSG:4326\na.jpg,8.1,47.1,400\n"),
        ("geo.txt", "EPSG:4326\na.jpg, 8.1, 47.1, 400, 10, 0, 0, 0.5, 0.5\n"),
        ("geo.txt", "EPSG:4326\na.jpg\t8.1\t47.1\t400\n"),
        ("log.csv", "name,lat,lon,alt,note;a;b;c;d;e\na.jpg,47.1,8.1,400,x\n"),
        ("log.csv", "name;lat;lon;alt;a, b, c, d, e\na.jpg;47,1;8,1;400;x\n"),
    ],
)
def test_the_signs_between_values_are_found(tmp_path: Path, name: str, text: str) -> None:
    (row,) = read_log(written(tmp_path, text, name)).entries
    assert (row.file, row.latitude, row.longitude, row.altitude) == ("a.jpg", 47.1, 8.1, 400.0)


@pytest.mark.parametrize(
    ("name", "content", "notes"),
    [
        ("area.geojson", b'{"type": "FeatureCollection", "features": []}', []),
        ("readme.txt", b"hello\n", ["readme.txt begins with 'hello'; expected a line of column names"]),
        ("DJIFlightRecord.txt", b"\x00\x01\x02", ["DJIFlightRecord.txt is no text. A flight record of DJI's app is encrypted"]),
        # DJI's cards have files of satellites beside the photos.
        ("DJI_PPKRAW.bin", b"\xd3\x00\x13" * 40, []),
        ("DJI_PPKRAW.bin", b"", []),
    ],
)  # fmt: skip
def test_files_that_are_no_logs_are_left_out_and_named(
    tmp_path: Path, name: str, content: bytes, notes: list[str]
) -> None:
    (tmp_path / name).write_bytes(content)
    flight = make_flight([write_photo(tmp_path / "a.jpg", taken(0)), tmp_path / name], tmp_path / "flight")
    assert [frame.name for frame in flight.frames] == ["a.jpg"]
    for note in [f"Left out, because their kind is not supported: {name}.", *notes]:
        assert any(one.startswith(note) for one in flight.notes)


def test_folders_tell_apart_names_with_and_without_a_suffix() -> None:
    named = [path_parts(path) for path in ("A/1", "B/1", "C\\B\\1", "1")]
    assert nearest_in_folders(path_parts("/flights/b/1.JPG"), named) == [1, 2]
    assert nearest_in_folders(path_parts("c/b/1.JPG"), named) == [2]
    assert nearest_in_folders(path_parts("1.JPG"), named) == [0, 1, 2, 3]


# A log of ten minutes that flies about in a way of which no part resembles another.
PATH = [(47.3 + i / 40_000 + (i % 97) / 9_000, 8.5 + i * i / 9_000_000) for i in range(600)]


def straight(seconds: int) -> list[tuple[float, float]]:
    return [(47.3 + i / 400_000, 8.5) for i in range(seconds)]


def a_log(
    file: Path, column: str = "datetime(utc)", ahead: float = 0.0, path: list[tuple[float, float]] = PATH
) -> Path:
    """Write a log from noon of a row each second, five on a straight path, whose clock is ahead of UTC by some seconds."""
    rows = [
        f"{datetime.fromtimestamp(NOON + i + ahead, UTC):%Y-%m-%d %H:%M:%S},{path[i][0]},{path[i][1]}\n"
        for i in range(0, len(path), 1 if path is PATH else 5)
    ]
    file.write_text(f"{column},latitude,longitude\n" + "".join(rows), "utf-8")
    return file


def photos(
    folder: Path,
    seconds: list[int],
    ahead: float = 0.0,
    utc: bool = False,
    path: list[tuple[float, float]] | None = None,
) -> Path:
    """Write photos of some seconds of the log, whose camera's clock is ahead of UTC, with their places if a path is given."""
    for second in seconds:
        true, taken = (datetime.fromtimestamp(NOON + second + late, UTC) for late in (0, ahead))
        stamp = {ExifTags.GPS.GPSDateStamp: f"{true:%Y:%m:%d}"}
        gps: dict[int, Any] = {**stamp, ExifTags.GPS.GPSTimeStamp: (true.hour, true.minute, true.second)}
        place = (None, None) if path is None else path[second]
        camera: dict[int, Any] = {ExifTags.Base.DateTimeOriginal: f"{taken:%Y:%m:%d %H:%M:%S}"}
        write_photo(folder / f"{second:04d}.jpg", exif(*place, camera=camera, gps=gps if utc else None))
    return folder


def note_of(flight: Flight) -> str:
    return next(note for note in flight.notes if note.startswith("log."))


def is_on(flight: Flight, path: list[tuple[float, float]]) -> bool:
    """Tell whether each photo is where the log was at its second."""
    places = [path[int(frame.name[:4])] for frame in flight.frames]
    return [(frame.latitude, frame.longitude) for frame in flight.frames] == [
        pytest.approx(one, abs=2e-5) for one in places
    ]


FOUR, HOUR = [20, 130, 420, 560], 3600.0
OFFSET = "with a constant offset: the log's clock is {} the photos'"
SEVERAL = "at several offsets, and nothing decides between them; give one, in seconds, with --clock-offset: "


# Seconds of the photos, and their clock and places; the log; a part of the note.
@pytest.mark.parametrize(
    ("seconds", "taken", "logged", "note"),
    [
        (FOUR, {"ahead": 2 * HOUR}, {}, f"4 of 4 photos, by their clock, {OFFSET.format('2 h behind')}; they replace"),
        (FOUR, {"ahead": -5 * HOUR}, {}, OFFSET.format("5 h ahead of")),
        (FOUR, {"ahead": 5.75 * HOUR}, {}, OFFSET.format("5.75 h behind")),
        (FOUR, {}, {}, "log.csv gives the values of 4 of 4 photos, by their clock; they replace those in the files."),
        # A log in local time fits photos in UTC, even if it says UTC.
        (FOUR, {"utc": True}, {"ahead": 2 * HOUR}, OFFSET.format("2 h ahead of")),
        (FOUR, {"utc": True}, {"ahead": 2 * HOUR, "column": "datetime(local)"}, OFFSET.format("2 h ahead of")),
        (FOUR, {"utc": True}, {"ahead": 2 * HOUR, "column": "date"}, OFFSET.format("2 h ahead of")),
        # A long log holds the photos at several offsets, and passes their places, or holds most of them, at one.
        (FOUR, {"ahead": HOUR, "path": straight(7200)}, {"path": straight(7200)}, OFFSET.format("1 h behind")),
        ([20, 600, 1200, 1750], {"ahead": HOUR}, {"path": straight(1800)}, OFFSET.format("1 h behind")),
        # Clocks of one kind need no offset.
        (FOUR, {"utc": True}, {"path": straight(7200)}, "of 4 of 4 photos, by UTC; they replace those in the files."),
        # Nothing tells the offset.
        (FOUR, {}, {"ahead": -3 * HOUR, "path": straight(18_000)}, SEVERAL),
        (FOUR, {}, {"ahead": 30 * 24 * HOUR}, "the photos' times lie within it at no offset of a time zone"),
    ],
)  # fmt: skip
def test_an_offset_of_clocks_is_estimated_where_the_files_determine_it(
    tmp_path: Path, seconds: list[int], taken: dict[str, Any], logged: dict[str, Any], note: str
) -> None:
    files = [photos(tmp_path / "photos", seconds, **taken), a_log(tmp_path / "log.csv", **logged)]
    flight = make_flight(files, tmp_path / "flight")
    assert note in note_of(flight)
    if "gives the values" in note_of(flight):
        assert is_on(flight, logged.get("path", PATH))
        # The offset also tells the photos' time in UTC.
        assert flight.utc == ("utc" in logged.get("column", "utc") or "utc" in taken)
        assert flight.times[0] == (NOON + seconds[0] if flight.utc else 0)
    else:
        assert note_of(flight).startswith("log.csv fits no photo by ")
        assert all(frame.latitude is None for frame in flight.frames)


def test_an_offset_that_is_no_zone_is_given_or_said(tmp_path: Path) -> None:
    # Photos and log overlap without an offset, 34 s apart.
    taken = photos(tmp_path / "photos", [20, 130, 300, 420, 560], 34.0, path=PATH)
    files = [taken, a_log(tmp_path / "log.csv", "date")]
    note = note_of(make_flight(files, tmp_path / "flight"))
    assert "by their clock, but its positions are " in note
    assert "so one of the clocks or positions is wrong; give the offset with --clock-offset" in note
    flight = make_flight(files, tmp_path / "told", FlightOptions(clock_offset=-34.0))
    assert "with the offset of -34 s given with --clock-offset" in note_of(flight)
    assert is_on(flight, PATH)


def test_photos_without_a_time_fit_no_log(tmp_path: Path) -> None:
    write_photo(tmp_path / "bare" / "a.jpg")
    flight = make_flight([tmp_path / "bare", a_log(tmp_path / "log.csv")], tmp_path / "flight")
    assert note_of(flight) == "log.csv fits no photo by UTC, and was not used: the photos have no time."


def test_logs_of_two_batteries_fit_the_photos_of_both(tmp_path: Path) -> None:
    photos(tmp_path / "photos", [20, 60, 130, 420, 500, 560], 2 * HOUR)
    rows = a_log(tmp_path / "log.csv").read_text().splitlines(keepends=True)
    (tmp_path / "log.1.csv").write_text("".join(rows[:201]))
    (tmp_path / "log.2.csv").write_text("".join([rows[0], *rows[401:]]))
    flight = make_flight([tmp_path / "photos", tmp_path / "log.1.csv", tmp_path / "log.2.csv"], tmp_path / "flight")
    assert is_on(flight, PATH)
    assert sum("gives the values of 3 of 6 photos" in note for note in flight.notes) == 2
