"""Tracks as GPX beside photos and videos, and files that are damaged or harmful."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from PIL import ExifTags

from lpn.core.errors import DataError
from lpn.flight.files import make_flight
from lpn.flight.files.logs import parse_track
from lpn.flight.files.sources import read_any_log
from tools.fixtures.photos import exif, write_photo
from tools.fixtures.videos import write_video

HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'


def time(second: int, zone: str = "Z") -> str:
    return f"2024-05-01T12:00:{second:02d}{zone}"


def gpx(points: int = 20, zone: str = "Z", decimal: str = ".") -> str:
    """A track of one point a second to the north."""
    inside = "".join(
        f'<trkpt lat="47{decimal}3{i:02d}" lon="8{decimal}5"><ele>{500 + i}</ele><time>{time(i, zone)}</time></trkpt>\n'
        for i in range(points)
    )
    return (
        HEAD
        + '<gpx version="1.1" creator="a &amp; b" xmlns="http://www.topografix.com/GPX/1/1"><trk><name>x</name><trkseg>\n'
        f"{inside}</trkseg></trk></gpx>"
    )


WITHOUT_TIMES = "{1} has {0} points without a time, so it fits no picture; export a track with times."


@pytest.mark.parametrize("zone", ["Z", "+00:00", ".0000Z", ""])
def test_a_gpx_track_is_a_log_of_moments_in_utc(zone: str) -> None:
    log = parse_track(gpx(3, zone), "a.gpx")
    assert [(r.entry.clock, r.entry.latitude, r.entry.longitude, r.entry.altitude) for r in log.rows] == [
        (1714564800.0 + i, pytest.approx(47.3 + i / 1000), 8.5, 500.0 + i) for i in range(3)
    ]
    assert log.utc == (zone != "")
    assert log.notes == ()


def test_numbers_that_are_none_are_no_position_and_no_altitude() -> None:
    point = '<trkpt lat="{}" lon="8.5"><ele>{}</ele><time>2024-05-01T12:00:0{}Z</time></trkpt>'
    text = gpx(0).replace("</trkseg>", point.format("nan", 5, 1) + point.format(47.3, "nan", 2) + "</trkseg>")
    log = parse_track(text, "a.gpx")
    assert [(row.entry.latitude, row.entry.altitude) for row in log.rows] == [(47.3, None)]
    assert log.notes == ("1 of 2 points of a.gpx have no time, or no position on the Earth, and were left out.",)
    with pytest.raises(DataError, match="has no point with a position on the Earth"):
        parse_track(gpx(0).replace("</trkseg>", point.format(147.3, 5, 1) + "</trkseg>"), "a.gpx")


def test_waypoints_named_as_pictures_are_their_positions(tmp_path: Path) -> None:
    place = '<wpt lat="47.3" lon="8.5"><ele>512</ele><name>DJI_0001.JPG</name></wpt>'
    (tmp_path / "places.gpx").write_text(f'<gpx version="1.1">{place}</gpx>', "utf-8")
    write_photo(tmp_path / "DJI_0001.JPG")
    frame = make_flight([tmp_path / "places.gpx"], tmp_path / "flight").frames[0]
    assert (frame.latitude, frame.longitude, frame.altitude) == (47.3, 8.5, 512.0)


@pytest.mark.parametrize(
    ("hour", "offset"), [(12, ""), (14, ", with a constant offset: the log's clock is 2 h behind the photos'")]
)
def test_photos_take_their_positions_from_a_track(tmp_path: Path, hour: int, offset: str) -> None:
    (tmp_path / "track.gpx").write_text(gpx(), "utf-8")
    for second in (3, 7, 12):
        clock = {ExifTags.GPS.GPSDateStamp: "2024:05:01", ExifTags.GPS.GPSTimeStamp: (12.0, 0.0, float(second))}
        taken = {ExifTags.Base.DateTimeOriginal: f"2024:05:01 {hour}:00:{second:02d}"}
        write_photo(tmp_path / "photos" / f"{second:02d}.jpg", exif(camera=taken, gps=clock if hour == 12 else None))
    flight = make_flight([tmp_path / "photos", tmp_path / "track.gpx"], tmp_path / "flight")
    assert [frame.latitude for frame in flight.frames] == pytest.approx([47.303, 47.307, 47.312])
    assert [frame.altitude for frame in flight.frames] == pytest.approx([503.0, 507.0, 512.0])
    how = "UTC" if hour == 12 else "their clock"
    said = f"track.gpx gives the values of 3 of 3 photos, by {how}{offset}; they replace those in the files."
    assert said in flight.notes


@pytest.mark.parametrize(
    ("second", "note"),
    [
        (None, "track.gpx does not say when the video began; its first row counts as the beginning"),
        (10, "The time in the video's file says where in track.gpx it began"),
    ],
)
def test_a_video_takes_its_positions_from_a_track(tmp_path: Path, second: int | None, note: str) -> None:
    av = pytest.importorskip("av")
    (tmp_path / "track.gpx").write_text(gpx(), "utf-8")
    with (
        av.open(str(write_video(tmp_path / "plain.mp4", 3))) as source,
        av.open(str(tmp_path / "a.mp4"), "w") as target,
    ):
        target.metadata.update({} if second is None else {"creation_time": time(second)})
        pictures = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.stream = pictures
                target.mux(packet)
    flight = make_flight([tmp_path / "a.mp4", tmp_path / "track.gpx"], tmp_path / "flight")
    start = 47.3 + (second or 0) / 1000
    assert [frame.latitude for frame in flight.frames] == pytest.approx(
        [start + (frame.time or 0) / 1000 for frame in flight.frames]
    )
    assert any(note in one for one in flight.notes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is no GPX"),
        ("PK\x03\x04damaged", "is no GPX"),
        ("<gpx>", "is cut off or damaged, so it was not read; export the track again"),
        (gpx(3)[:300], "is cut off or damaged"),
        (gpx(3, decimal=","), "is cut off or damaged"),
        ('<gpx version="1.1"></gpx>', "has no point with a position"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><gpx>&a;</gpx>', "has a DTD or entities"),
        ("<!DOCTYPE x SYSTEM 'file:///etc/passwd'><gpx></gpx>", "has a DTD or entities"),
    ],
)
def test_files_that_are_no_tracks_are_refused_in_one_sentence(text: str, message: str) -> None:
    with pytest.raises(DataError) as error:
        parse_track(text, "a.gpx")
    assert message in str(error.value)


def test_a_track_without_times_fits_nothing_and_the_run_goes_on(tmp_path: Path) -> None:
    (tmp_path / "track.gpx").write_text(gpx(2).replace("time>", "tame>"), "utf-8")
    photo = write_photo(tmp_path / "a.jpg", exif(47.3, 8.5))
    flight = make_flight([photo, tmp_path / "track.gpx"], tmp_path / "flight")
    assert flight.frames[0].latitude == 47.3
    assert WITHOUT_TIMES.format(2, "track.gpx") in flight.notes
    assert any(note.startswith("track.gpx fits none of the 1 photos by") for note in flight.notes)


@pytest.mark.parametrize(
    ("name", "instead"),
    [
        ("track.kml", "GPX or CSV"),
        ("track.geojson", "GPX or CSV"),
        ("flight.bag", "CSV, .ulg, .tlog, or .bin"),
        ("clip.vtt", "SRT"),
        ("CLIP.ASS", "SRT"),
    ],
)
def test_a_file_of_a_kind_that_is_not_read_is_refused_wherever_it_is_named(
    tmp_path: Path, name: str, instead: str
) -> None:
    (file := tmp_path / name).write_text('<kml xmlns="http://www.opengis.net/kml/2.2"/>', "utf-8")
    photo = write_photo(tmp_path / "a.jpg", exif(47.3, 8.5))
    told = rf"{re.escape(name)} is {file.suffix.upper()}, which is not read; give the flight as {re.escape(instead)}\.$"
    for given in ([photo, file], [file]):
        with pytest.raises(DataError, match=told):
            make_flight(given, tmp_path / "flight")
    with pytest.raises(DataError, match=told):
        read_any_log(file)
