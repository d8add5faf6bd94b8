"""Logs of the programs that people use, their units, and logs that fit nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import ExifTags

from lpn.core.errors import DataError
from lpn.flight.files import make_flight
from lpn.flight.files.logs import for_video, moments, nearest_in_folders, path_parts, read_log
from tools.fixtures.photos import dji_xmp, exif, write_photo
from tools.fixtures.videos import write_video

VISLOC = (
    "num,filename,date,lat,lon,height,Omega,Kappa,Phi1,Phi2\n"
    "1,01_0001.JPG,2018-09-13 10:00:00,29.774065,115.970635,405.251007,1.5,-2.5,-170.0,10\n"
    "2,01_0002.JPG,2018-09-13 10:00:04,29.775065,115.970635,405.251007,0.5,0.5,-170.0,10\n"
)
AIRDATA = "time(millisecond),datetime(utc),latitude,longitude,isVideo\n" + "".join(
    f"{1000 * i},2024-05-01 12:00:{i:02d},{47 + i / 10_000},8.0,{int(i in (3, 4, 5) or i > 7)}\n" for i in range(12)
)
NAMED = "filename,lat,lon\n1.jpg,60.403241,22.462133\n"


def written(folder: Path, text: str, name: str = "log.csv") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text, "utf-8")
    return folder / name


def test_a_log_alone_brings_its_photos(tmp_path: Path) -> None:
    for name in ("01_0001.JPG", "01_0002.JPG", "other.JPG"):
        write_photo(tmp_path / "drone" / name)
    flight = make_flight([written(tmp_path, VISLOC, "01.csv")], tmp_path / "flight")
    assert [frame.name for frame in flight.frames] == ["01_0001.JPG", "01_0002.JPG"]
    assert [frame.latitude for frame in flight.frames] == [29.774065, 29.775065]
    assert flight.times.tolist() == [0.0, 4.0]


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
    write_photo(tmp_path / "a.jpg", exif(1.0, 2.0, main={ExifTags.Base.Orientation: orientation}), size=(64, 48))
    fov = 34.51 if orientation > 4 else 45.0
    for columns, values, pitch in (
        ("heading,hfov", "40,45", None),
        ("gimbal_yaw,gimbal_pitch,hfov", "40,-90,45", -90.0),
    ):
        log = written(tmp_path, f"filename,latitude,longitude,{columns}\na.jpg,47,8,{values}\n")
        flight = make_flight([tmp_path / "a.jpg", log], tmp_path / "flight")
        assert (flight.frames[0].heading, flight.frames[0].fov) == (
            pytest.approx(heading),
            pytest.approx(fov, abs=0.01),
        )
        assert flight.frames[0].pitch == (None if pitch is None else pytest.approx(pitch))
        assert any("by its EXIF orientation" in note for note in flight.notes) == (orientation != 1)


def test_recordings_of_a_log_begin_with_the_video(tmp_path: Path) -> None:
    log = read_log(written(tmp_path, AIRDATA))
    assert log.utc
    entries, notes = for_video(log, 0)
    assert notes == []
    assert [entry.time for entry in entries] == [0.0, 1.0, 2.0]
    assert entries[0].latitude == pytest.approx(47.0003)
    assert [entry.time for entry in for_video(log, 1)[0]] == [0.0, 1.0, 2.0, 3.0]
    with pytest.raises(DataError, match=r"log\.csv has 2 recordings, and this is video 3"):
        for_video(log, 2)
    video = write_video(tmp_path / "a.mp4", 3)
    flight = make_flight([video, tmp_path / "log.csv"], tmp_path / "flight")
    assert [frame.latitude for frame in flight.frames] == pytest.approx(
        [47.0003 + (f.time or 0) / 10_000 for f in flight.frames]
    )


def test_a_log_that_tells_only_when_the_recording_began_is_used_from_there_on(tmp_path: Path) -> None:
    rows = [f"{1000 * i},{47 + i / 1000},8.5,{int(i in (3, 12))}\n" for i in range(20)]
    log = read_log(written(tmp_path, "time(millisecond),latitude,longitude,isVideo\n" + "".join(rows)))
    entries, notes = for_video(log, 0)
    assert [(entry.time, entry.latitude) for entry in entries] == [
        (float(i), pytest.approx(47.003 + i / 1000)) for i in range(9)
    ]
    assert notes == ["log.csv has the start of the video but not its length; all rows from there on were used."]
    assert [entry.time for entry in for_video(log, 1)[0]] == [float(i) for i in range(8)]
    with pytest.raises(DataError, match=r"log\.csv has 2 recordings, and this is video 3"):
        for_video(log, 2)


def test_a_log_of_moments_fits_photos_by_utc(tmp_path: Path) -> None:
    gps = {ExifTags.GPS.GPSDateStamp: "2024:05:01", ExifTags.GPS.GPSTimeStamp: (12.0, 0.0, 4.0)}
    write_photo(tmp_path / "a.jpg", exif(1.0, 2.0, gps=gps))
    write_photo(tmp_path / "b.jpg", exif(1.0, 2.0))
    flight = make_flight([tmp_path / "a.jpg", tmp_path / "b.jpg", written(tmp_path, AIRDATA)], tmp_path / "flight")
    assert [frame.latitude for frame in flight.frames] == pytest.approx([47.0004, 1.0])
    assert any("gives the values of 1 of 2 photos, by UTC" in note for note in flight.notes)


def test_a_log_that_fits_nothing_is_told_and_the_run_goes_on(tmp_path: Path) -> None:
    photo = write_photo(tmp_path / "other.jpg", exif(1.0, 2.0))
    flight = make_flight([photo, written(tmp_path, NAMED)], tmp_path / "flight")
    assert flight.frames[0].latitude == 1.0
    assert "log.csv fits none of the 1 photos by name, and was not used." in flight.notes
    with pytest.raises(DataError, match=r"No photo that log\.csv names is below its folder"):
        make_flight([written(tmp_path / "alone", NAMED)], tmp_path / "none")
    video = write_video(tmp_path / "a.mp4", 1)
    flight = make_flight([video, tmp_path / "log.csv"], tmp_path / "flight")
    assert any("log.csv has no times" in note for note in flight.notes)


def test_a_log_without_a_recording_begins_with_the_video_and_says_so(tmp_path: Path) -> None:
    log = read_log(written(tmp_path, "timestamp,lat,lon\n1714564800.5,1,2\n1714564802.5,1.1,2\n"))
    entries, notes = for_video(log, 0)
    assert [entry.time for entry in entries] == [0.0, 2.0]
    assert "its first row counts as the beginning" in notes[0]
    dated = read_log(written(tmp_path, "date,lat,lon\n2024-05-01T12:00:00+02:00,1,2\n"))
    assert dated.utc
    assert dated.rows[0].entry.clock == 1714557600.0


# The column, and its cells; the headings, pitches, or fields of view that are read; a part of a note.
ANGLES: tuple[tuple[str, list[str], list[float | None], str], ...] = (
    (
        "yaw", ["10"] * 15 + ["-9999"] + ["20"] * 4, [10.0] * 15 + [None] + [20.0] * 4,
        "1 of 20 values of the column yaw of log.csv are not from -360 to 360 degrees and were not used, first in line 17.",
    ),
    ("yaw", ["10", "-9999", "20"], [None] * 3, "was left out: it holds -9999, and expected are angles from -360 to 360 degrees"),
    ("yaw", ["9000", "9010", "120"], [None] * 3, "another unit is named behind a column, as in (cdeg)."),
    ("gimbal_pitch", ["270", "275", "285.5"], [-90.0, -85.0, -74.5], ""),
    ("gimbal_pitch", ["90", "85"], [None, None],
     "looks up by 85 degrees and more, where -90 should be straight down; --pitch tells it"),
    ("gimbal_pitch", ["-60"], [-60.0], ""),
    ("fov", ["0", "0"], [None] * 2, "column fov of log.csv was left out: it holds 0, and expected are angles from 0.1 to 170"),
    ("fov", ["70"] * 10 + ["170", "0.1", "175"], [70.0] * 10 + [170.0, 0.1, None],
     "1 of 13 values of the column fov of log.csv are"),
)  # fmt: skip


@pytest.mark.parametrize(("column", "cells", "expected", "note"), ANGLES)
def test_angles_beyond_their_range_are_not_used(
    tmp_path: Path, column: str, cells: list[str], expected: list[float | None], note: str
) -> None:
    log = read_log(written(tmp_path, f"lat,lon,{column}\n" + "".join(f"47.3,8.5,{cell}\n" for cell in cells)))
    names = {"yaw": "heading", "gimbal_pitch": "pitch", "fov": "fov"}
    found = [getattr(row.entry, names[column]) for row in log.rows]
    assert found == [None if angle is None else pytest.approx(angle) for angle in expected]
    assert any(note in line for line in log.notes) if note else not log.notes


@pytest.mark.parametrize(
    ("dates", "clock", "says"),
    [
        (("5/13/2024 12:00:00", "5/1/2024 12:00:00"), 1715601600.0, False),
        (("13/5/2024 12:00:00", "1/5/2024 12:00:00"), 1715601600.0, False),
        (("5/1/2024 12:00 PM", "5/1/2024 12:00 AM"), 1714564800.0, True),
        (("01.05.2024 12:00:00", "02.05.2024 12:00:00"), 1714564800.0, False),
        (("1714564800000", ""), 1714564800.0, False),
        (("1714564800000000", ""), 1714564800.0, False),
    ],
)
def test_dates_of_every_spelling_are_read_for_the_file_as_a_whole(
    tmp_path: Path, dates: tuple[str, str], clock: float, says: bool
) -> None:
    log = read_log(written(tmp_path, "date,lat,lon\n" + "".join(f"{date},47.3,8.5\n" for date in dates)))
    assert log.rows[0].entry.clock == clock
    assert any("nothing in it rules that out" in note for note in log.notes) == says


def test_labels_without_an_ending_name_their_pictures(tmp_path: Path) -> None:
    write_photo(tmp_path / "DJI_0001.JPG")
    log = written(tmp_path, "#Label,X/Longitude,Y/Latitude\nDJI_0001,8.5,47.3\n")
    assert make_flight([log], tmp_path / "flight").frames[0].latitude == 47.3


def test_the_first_row_of_a_moment_counts_and_fractions_of_seconds_come_from_the_elapsed_time(tmp_path: Path) -> None:
    rows = [
        "2024-05-01 12:00:00,,8",
        "2024-05-01 12:00:00,47.0,8",
        "2024-05-01 12:00:00,47.9,8",
        "2024-05-01 12:00:01,47.1,8",
    ]
    log = read_log(written(tmp_path, "datetime(utc),lat,lon\n" + "\n".join(rows)))
    for entries in (moments(log), for_video(log, 0)[0]):
        assert [entry.latitude for entry in entries] == [47.0, 47.1]
    # Airdata has ten rows a second, whole seconds of UTC, and milliseconds from the start, here 0.3 s past a second.
    rows = [f"{100 * i},2024-05-01 12:00:0{(3 + i) // 10},{47 + i / 1000},8" for i in range(30)]
    entries = moments(read_log(written(tmp_path, "time(millisecond),datetime(utc),lat,lon\n" + "\n".join(rows))))
    assert [round(entry.time - 1714564800.0, 3) for entry in entries[:3]] == [0.3, 0.4, 0.5]


def test_a_few_positions_that_are_none_are_left_out_and_many_refuse_the_log(tmp_path: Path) -> None:
    rows = [f"{'-5.797e+148' if i == 7 else 47 + i / 1000},8.5\n" for i in range(30)]
    log = read_log(written(tmp_path, "lat,lon\n" + "".join(rows)))
    assert [row.line for row in log.rows if row.entry.latitude is None] == [9]
    assert log.notes == (
        "1 of 30 values of the column lat of log.csv are not from -90 to 90 degrees and were not used, first in line 9.",
        "1 of 30 rows of log.csv have no position.",
    )
    with pytest.raises(DataError, match=r"Line 2 of log\.csv has the position 64\.0359, 407\.553; expected degrees"):
        read_log(written(tmp_path, "Lat,Lng\n64.0359128,407.5528816\n64.0359138,407.5528816\n"))


def test_text_that_is_no_log_is_left_out_and_the_run_goes_on(tmp_path: Path) -> None:
    photo = write_photo(tmp_path / "a.jpg", exif(47.3, 8.5))
    files = [
        photo,
        written(tmp_path, "hello\n", "readme.txt"),
        written(tmp_path, "\x00\x01\x02", "DJIFlightRecord.txt"),
    ]
    notes = make_flight(files, tmp_path / "flight").notes
    assert "Left out, because their kind is not supported: readme.txt, DJIFlightRecord.txt." in notes
    assert any(note.startswith("readme.txt begins with 'hello'; expected a line of column names") for note in notes)
    assert any(
        note.startswith("DJIFlightRecord.txt is no text. A flight record of DJI's app is encrypted") for note in notes
    )


def test_folders_tell_apart_names_with_and_without_a_suffix() -> None:
    named = [path_parts(path) for path in ("A/1", "B/1", "C\\B\\1", "1")]
    assert nearest_in_folders(path_parts("/flights/b/1.JPG"), named) == [1, 2]
    assert nearest_in_folders(path_parts("c/b/1.JPG"), named) == [2]
    assert nearest_in_folders(path_parts("1.JPG"), named) == [0, 1, 2, 3]
