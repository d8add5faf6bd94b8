"""Photos as cameras of drones write them, and values in them that must not be believed."""

from __future__ import annotations

import io
import math
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from lpn.core.errors import DataError, PictureError
from lpn.core.images import load_picture
from lpn.flight.files import open_flight
from lpn.flight.files.photos import photo_of, read_photo
from tools.fixtures.field_photos import FIELD
from tools.fixtures.photos import dji_xmp, exif, photo_bytes, tiff_exif, with_segment, write_photo, xmp_packet

BASE, GPS = ExifTags.Base, ExifTags.GPS
NOON = {BASE.DateTimeOriginal: "2024:05:01 14:00:00"}


def test_a_picture_that_was_saved_upright_has_the_longer_side_upright() -> None:
    for old in ({}, {BASE.ExifImageWidth: 40, BASE.ExifImageHeight: 30}):  # a program may leave the old sizes
        camera = {BASE.FocalLengthIn35mmFilm: 24, **old}
        photo = photo_of(photo_bytes(exif(camera=camera), size=(30, 40)), Path("b.jpg"))
        assert (photo.frame.width, photo.frame.height, photo.oddities) == (30, 40, ())
        assert photo.frame.fov == pytest.approx(2 * math.degrees(math.atan(math.hypot(36, 24) * 0.6 / 2 / 24)))


def test_the_sensor_s_width_is_that_of_the_picture_as_taken() -> None:
    camera = {
        BASE.FocalLength: 4.5, BASE.FocalPlaneXResolution: 16393.44262, BASE.FocalPlaneResolutionUnit: 2,
        BASE.ExifImageWidth: 4000, BASE.ExifImageHeight: 3000, BASE.FocalLengthIn35mmFilm: 99,
    }  # fmt: skip
    photo = photo_of(photo_bytes(exif(camera=camera)), Path("a.jpg"))
    assert photo.frame.fov == pytest.approx(2 * math.degrees(math.atan(4000 * 25.4 / 16393.44262 / 2 / 4.5)))
    assert "40 x 30 pixels where its EXIF says 4000 x 3000" in photo.oddities[0]
    cut = photo_of(photo_bytes(exif(camera=camera), size=(40, 22)), Path("a.jpg"))
    assert "4000 x 3000; it was cropped, and its field of view may be too wide" in cut.oddities[0]


@pytest.mark.parametrize(
    ("focal", "pixels_per_unit", "unit", "equivalent", "degrees"),
    [
        (35.0, 1666.67, 3, 35, 54.4),
        (35.0, 1666.67, 2, 35, 54.4),  # inches in place of centimetres make it 91 mm
        (8.8, 0.01, 2, 24, 73.7),
        (4.5, 1e6, 2, 99, 19.83),
    ],
)
def test_an_impossible_width_of_a_sensor_is_not_believed(
    focal: float, pixels_per_unit: float, unit: int, equivalent: int, degrees: float
) -> None:
    told = {
        BASE.FocalLength: focal, BASE.FocalPlaneXResolution: pixels_per_unit, BASE.FocalPlaneResolutionUnit: unit,
        BASE.ExifImageWidth: 6000, BASE.ExifImageHeight: 4500, BASE.FocalLengthIn35mmFilm: equivalent,
    }  # fmt: skip
    assert photo_of(photo_bytes(exif(camera=told)), Path("a.jpg")).frame.fov == pytest.approx(degrees, abs=0.1)


def test_a_stated_field_of_view_counts_the_zoom_already() -> None:
    packet = xmp_packet("", {"exif": "http://ns.adobe.com/exif/1.0/"}, 'exif:CameraHorizontalFOV="30"')
    zoomed = exif(camera={BASE.DigitalZoomRatio: 2.0, BASE.FocalLengthIn35mmFilm: 35})
    stated = photo_of(photo_bytes(zoomed, packet), Path("a.jpg"))
    assert (stated.frame.fov, stated.oddities) == (pytest.approx(30.0), ())
    by_lens = photo_of(photo_bytes(zoomed), Path("a.jpg"))
    assert by_lens.frame.fov == pytest.approx(27.8, abs=0.1)
    assert "has a digital zoom of 2, which narrows its field of view" in by_lens.oddities[0]


def test_times_are_utc_where_a_photo_tells_it(tmp_path: Path) -> None:
    gps = {GPS.GPSDateStamp: "2024:05:01", GPS.GPSTimeStamp: (12.0, 0.0, 5.0)}
    write_photo(tmp_path / "1.jpg", exif(1.0, 2.0, camera=NOON, gps=gps))
    later = {BASE.DateTimeOriginal: "2024:05:01 14:00:10", BASE.SubsecTimeOriginal: "25"}
    write_photo(tmp_path / "2.jpg", exif(1.0, 2.0, camera=later))
    flight = open_flight(tmp_path)
    assert flight.utc
    assert flight.times.tolist() == [1714564805.0, 1714564815.25]
    assert "The camera's clock is 5 s behind UTC+2." in flight.notes
    drifted = {GPS.GPSDateStamp: "2024:05:01", GPS.GPSTimeStamp: (12.0, 0.0, 14.0)}
    write_photo(tmp_path / "0.jpg", exif(1.0, 2.0, camera=NOON, gps=drifted))
    assert "The camera's clock and UTC move apart by 9 s during the flight." in open_flight(tmp_path).notes
    zoned = later | {BASE.OffsetTimeOriginal: "+02:00"}
    assert photo_of(photo_bytes(exif(camera=zoned)), Path("3.jpg")).utc == 1714564810.25
    exposed = photo_bytes(xmp=dji_xmp(UTCAtExposure="2024-05-01T12:00:00.1234567"))
    assert photo_of(exposed, Path("4.jpg")).utc == pytest.approx(1714564800.123456)


def test_times_without_a_zone_are_from_the_first_photo_and_order_the_flight(tmp_path: Path) -> None:
    for name, second in (("9.jpg", 30), ("10.jpg", 0), ("8.jpg", 12)):
        write_photo(tmp_path / name, exif(1.0, 2.0, camera={BASE.DateTimeOriginal: f"2024:05:01 14:00:{second:02d}"}))
    flight = open_flight(tmp_path)
    assert [(frame.name, frame.time) for frame in flight.frames] == [("10.jpg", 0), ("8.jpg", 12), ("9.jpg", 30)]
    assert not flight.utc
    assert any("seconds since the first photo" in note for note in flight.notes)
    write_photo(tmp_path / "11.jpg")
    flight = open_flight(tmp_path)
    assert [frame.name for frame in flight.frames] == ["8.jpg", "9.jpg", "10.jpg", "11.jpg"]
    assert any("1 of 4 photos have no time" in note for note in flight.notes)


LOCAL, NO_ZONE, NO_TIME = 1714572000.0, "exif:OffsetTimeOriginal", "exif:DateTimeOriginal"


@pytest.mark.parametrize(
    ("stamp", "offset", "local", "utc", "unreadable"),
    [
        ("2024:05:01 14:00:00", "", LOCAL, None, ""), ("2024-05-01 14:00:00", "", LOCAL, None, ""),
        ("2024-05-01T14:00:00Z", "", LOCAL, LOCAL, ""), ("2024:05:01 14:00:00 +0200", "", LOCAL, LOCAL - 7200, ""),
        ("2024/05/01 4:00:00 +0200", "", LOCAL - 36_000, LOCAL - 43_200, ""),
        ("2024:05:01 14:00: 7", "", LOCAL + 7, None, ""), ("2024:05:01 14:00:00-0300", "", LOCAL, LOCAL + 10_800, ""),
        ("2024:05:01 14:00:00.25", "", LOCAL + 0.25, None, ""), ("2024:05:01 14:00:00\x00\x00", "", LOCAL, None, ""),
        ("0000:00:00 00:00:00", "", None, None, ""), ("    :  :     :  :  ", "", None, None, ""),
        ("2024:05:01 14:00:00", "-05:00", LOCAL, LOCAL + 18_000, ""),
        ("2024:05:01 14:00:00", "-0500", LOCAL, LOCAL + 18_000, ""),
        ("2024:05:01 14:00:00", "   :  ", LOCAL, None, ""), ("2024:05:01 14:00:00", "EST", LOCAL, None, NO_ZONE),
        ("2024:05:01 14:00:00", "+25:00", LOCAL, None, NO_ZONE), ("2024:05:01 14:00:00+25:00", "", LOCAL, None, NO_ZONE),
        ("1999:99:99 99:99:99", "", None, None, NO_TIME),
    ],
)  # fmt: skip
def test_times_and_zones_as_programs_write_them(
    stamp: str, offset: str, local: float | None, utc: float | None, unreadable: str
) -> None:
    tags = {BASE.DateTimeOriginal: stamp, BASE.OffsetTimeOriginal: offset}
    photo = photo_of(photo_bytes(exif(camera=tags)), Path("a.jpg"))
    assert (photo.local, photo.utc) == (local, utc)
    assert photo.oddities == ((f"has values that cannot be read: {unreadable}",) if unreadable else ())


def test_the_time_of_an_edit_is_no_time_of_a_photo() -> None:
    edited = {BASE.DateTime: "2024:06:09 09:09:09"}
    digitized = exif(main=edited, camera={BASE.DateTimeDigitized: "2024:05:01 14:00:00"})
    assert photo_of(photo_bytes(digitized), Path("a.jpg")).local == 1714572000.0
    # A program that made a JPEG of a DNG kept XMP alone.
    packet = xmp_packet(
        "", {"xmp": "http://ns.adobe.com/xap/1.0/"},
        'xmp:ModifyDate="2024-06-09T09:09:09+03:00" xmp:CreateDate="2024-05-01T14:00:00+03:00"',
    )  # fmt: skip
    photo = photo_of(photo_bytes(exif(main=edited), packet), Path("a.jpg"))
    assert (photo.local, photo.utc, photo.oddities) == (1714572000.0, 1714561200.0, ())


def test_broken_photos_are_left_out_and_named(tmp_path: Path) -> None:
    whole = photo_bytes(exif(1.0, 2.0))
    (tmp_path / "a.jpg").write_bytes(whole)
    (tmp_path / "b.jpg").write_bytes(whole[:-200])
    (tmp_path / "c.jpg").write_bytes(b"no picture")
    flight = open_flight(tmp_path)
    assert [frame.name for frame in flight.frames] == ["a.jpg"]
    note = next(note for note in flight.notes if "left out" in note)
    assert note.startswith("2 of 3 photos are left out: b.jpg is cut short")
    assert "c.jpg is not a picture" in note
    (tmp_path / "a.jpg").unlink()
    with pytest.raises(DataError, match=r"No photo of 2 can be read\. b\.jpg"):
        open_flight(tmp_path)
    with pytest.raises(PictureError, match=r"nowhere\.jpg cannot be read"):
        read_photo(tmp_path / "nowhere.jpg")


@pytest.mark.parametrize("name", FIELD)
def test_photos_as_people_have_them(name: str) -> None:
    data, expected, note = FIELD[name]
    photo = photo_of(data, Path("a.jpg"))
    found = {field: getattr(photo if field == "utc" else photo.frame, field) for field in expected}
    assert found == {
        field: pytest.approx(value, abs=1e-6) if isinstance(value, float) else value
        for field, value in expected.items()
    }
    assert photo.oddities == () if note is None else any(note in oddity for oddity in photo.oddities)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF"])
def test_sizes_are_those_of_the_picture_as_it_is_loaded(tmp_path: Path, kind: str) -> None:
    camera = {BASE.FocalLength: 4.0, BASE.FocalLengthIn35mmFilm: 23}
    for orientation in range(1, 9):
        told = exif(main={BASE.Orientation: orientation}, camera=camera)
        file = tmp_path / f"{orientation}.x"
        Image.new("RGB", (320, 240)).save(file, kind, exif=told.tobytes() if kind != "TIFF" else told)
        height, width = load_picture(file).shape[:2]
        frame = read_photo(file).frame
        assert (frame.width, frame.height) == (width, height), orientation
        if kind != "TIFF":  # Pillow writes no camera's tags into a TIFF
            expected = 58.876173 if orientation >= 5 else 73.920206
            assert frame.fov == pytest.approx(expected, abs=1e-6), orientation


def test_the_heading_of_a_mirrored_picture_is_that_of_its_top_as_it_is_loaded(tmp_path: Path) -> None:
    # A picture with its top to the north-east, whose corner there is white; a program stored it in every orientation.
    upright = np.zeros((240, 320, 3), np.uint8)
    upright[:60, -80:] = 255
    stored = {
        1: upright, 2: upright[:, ::-1], 3: upright[::-1, ::-1], 4: upright[::-1], 5: upright.swapaxes(0, 1),
        6: np.rot90(upright, 1), 7: np.rot90(upright, 2).swapaxes(0, 1), 8: np.rot90(upright, -1),
    }  # fmt: skip
    # The gimbal's yaw is the direction of the stored picture's top, where that is mirrored to the side first.
    yaws = {1: 45, 2: 45, 3: 225, 4: 225, 5: 315, 6: 135, 7: 135, 8: 315}
    for orientation, pixels in stored.items():
        told = exif(main={BASE.Orientation: orientation})
        data = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(pixels)).save(data, "JPEG", exif=told.tobytes())
        packet = dji_xmp(GimbalYawDegree=yaws[orientation], GimbalPitchDegree=-90, GimbalRollDegree=0)
        file = tmp_path / f"{orientation}.jpg"
        file.write_bytes(with_segment(data.getvalue(), b"http://ns.adobe.com/xap/1.0/\x00" + packet))
        assert load_picture(file)[20, -20].min() > 200, orientation
        photo = read_photo(file)
        assert photo.frame.heading == pytest.approx(45.0), orientation
        mirrored = [oddity for oddity in photo.oddities if "is mirrored by its EXIF orientation" in oddity]
        assert len(mirrored) == (orientation in (2, 4, 5, 7))


def test_one_damaged_directory_of_exif_leaves_the_others() -> None:
    told = tiff_exif(main={BASE.Orientation.value: (3, b"\x06\x00")}, gps={1: (2, b"N\x00")})
    pointer = told.index(b"\x25\x88\x04\x00") + 8
    damaged = told[:pointer] + b"\xff\xff\xff\x0f" + told[pointer + 4 :]
    frame = photo_of(photo_bytes(damaged), Path("a.jpg")).frame
    assert (frame.width, frame.height, frame.latitude) == (30, 40, None)


def test_the_facts_are_those_of_the_file() -> None:
    told = exif(
        46.25, -91.5, {BASE.Make: "Canon", BASE.Model: "Canon PowerShot"},
        {BASE.DateTimeOriginal: "2024:05:01 14:00:07"},
        {GPS.GPSDateStamp: "2024:05:01", GPS.GPSTimeStamp: (12.0, 0.0, 7.0)},
    )  # fmt: skip
    data = photo_bytes(told)
    assert photo_of(data, Path("b.jpg")).facts(data) == [
        ("File", "b.jpg"),
        ("SHA-256", sha256(data).hexdigest()),
        ("Size", f"40 × 30 pixels, {len(data):,} bytes"),
        ("Taken", "2024-05-01 14:00:07 by the camera's clock, 2024-05-01 12:00:07 UTC"),
        ("Camera", "Canon PowerShot"),
        ("GPS tag", "46.250000, -91.500000 (latitude and longitude of the camera)"),
    ]
    other = photo_of(photo_bytes(exif(main={BASE.Make: "DJI", BASE.Model: "FC330"})), Path("b.jpg"))
    assert other.camera == "DJI FC330"
    assert {other.facts(data)[i][1] for i in (3, 5)} == {"unknown"}
