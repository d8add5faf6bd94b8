"""Tests of a photo's file as evidence."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

from PIL import ExifTags

from lpn.flight.files.photo_file import PhotoFile
from tools.fixtures.photos import exif, write_photo

BASE, GPS = ExifTags.Base, ExifTags.GPS


def test_the_facts_are_those_of_the_file(tmp_path: Path) -> None:
    told = exif(
        46.25,
        -91.5,
        main={BASE.Make: "Canon", BASE.Model: "Canon PowerShot"},
        camera={BASE.DateTimeOriginal: "2024:05:01 14:00:07"},
        gps={GPS.GPSDateStamp: "2024:05:01", GPS.GPSTimeStamp: (12.0, 0.0, 7.0)},
    )
    data = write_photo(tmp_path / "a.jpg", told).read_bytes()
    assert PhotoFile.of(data, Path("b.jpg")).facts == [
        ("File", "b.jpg"),
        ("SHA-256", sha256(data).hexdigest()),
        ("Size", f"40 × 30 pixels, {len(data):,} bytes"),
        ("Taken", "2024-05-01 14:00:07 by the camera's clock, 2024-05-01 12:00:07 UTC"),
        ("Camera", "Canon PowerShot"),
        ("GPS tag", "46.250000, -91.500000 (latitude and longitude of the camera)"),
    ]
    other = write_photo(tmp_path / "b.jpg", exif(main={BASE.Make: "DJI", BASE.Model: "FC330"})).read_bytes()
    assert dict(PhotoFile.of(other, Path("b.jpg")).facts)["Camera"] == "DJI FC330"


def test_what_a_file_does_not_tell_is_said_to_be_missing(tmp_path: Path) -> None:
    file = write_photo(tmp_path / "a.jpg")
    facts = dict(PhotoFile.of(file.read_bytes(), file).facts)
    assert {facts[name] for name in ("Taken", "Camera", "GPS tag")} == {"not told"}
