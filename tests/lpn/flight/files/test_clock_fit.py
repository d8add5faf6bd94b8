"""Clocks that differ by a constant offset: told where the files tell it, and refused where they do not."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from PIL import ExifTags

from lpn.flight.files import Flight, make_flight
from tools.fixtures.photos import exif, write_photo

NOON = datetime(2024, 5, 1, 12, tzinfo=UTC).timestamp()
# A log of ten minutes that flies about in a way of which no part resembles another.
PATH = [(47.3 + i / 40_000 + (i % 97) / 9_000, 8.5 + i * i / 9_000_000) for i in range(600)]


def a_log(
    file: Path, column: str = "datetime(utc)", offset: float = 0.0, path: list[tuple[float, float]] = PATH
) -> Path:
    """Write a log of one row a second from noon, whose clock is ahead by an offset in seconds."""
    rows = [
        f"{datetime.fromtimestamp(NOON + i + offset, UTC):%Y-%m-%d %H:%M:%S},{a},{b}\n" for i, (a, b) in enumerate(path)
    ]
    file.write_text(f"{column},latitude,longitude\n" + "".join(rows), "utf-8")
    return file


def photos(folder: Path, seconds: list[int], offset: float, positioned: bool = False, utc: bool = False) -> None:
    """Write photos of some seconds of the log, whose camera's clock is ahead of UTC by an offset."""
    for second in seconds:
        taken = datetime.fromtimestamp(NOON + second + offset, UTC)
        camera: dict[int, Any] = {ExifTags.Base.DateTimeOriginal: f"{taken:%Y:%m:%d %H:%M:%S}"}
        gps: dict[int, Any] = {}
        if utc:
            true = datetime.fromtimestamp(NOON + second, UTC)
            gps = {
                ExifTags.GPS.GPSDateStamp: f"{true:%Y:%m:%d}",
                ExifTags.GPS.GPSTimeStamp: (true.hour, true.minute, true.second),
            }
        place = PATH[second] if positioned else (None, None)
        write_photo(folder / f"{second:03d}.jpg", exif(*place, camera=camera, gps=gps))


def note_of(flight: Flight) -> str:
    return next(note for note in flight.notes if note.startswith("log."))


def is_at_its_seconds(flight: Flight) -> bool:
    return all(
        (frame.latitude, frame.longitude) == pytest.approx(PATH[int(frame.name[:3])], abs=2e-5)
        for frame in flight.frames
    )


@pytest.mark.parametrize(
    ("hours", "longitude", "named"),
    [(2.0, 8.5, "UTC+2"), (-5.0, -84.0, "UTC-5"), (5.75, 85.3, "UTC+5:45"), (0.0, 139.7, "UTC+0")],
)
def test_photos_in_local_time_fit_a_log_in_utc_at_the_zone_of_its_longitude(
    tmp_path: Path, hours: float, longitude: float, named: str
) -> None:
    photos(tmp_path / "photos", [20, 130, 420, 560], hours * 3600)
    log = a_log(tmp_path / "log.csv", path=[(a, b - 8.5 + longitude) for a, b in PATH])
    flight = make_flight([tmp_path / "photos", log], tmp_path / "flight")
    assert note_of(flight) == (
        f"log.csv gives the values of 4 of 4 photos, by their clock, with a constant offset: the photos' clock is {named}; they "
        "replace those in the files."
    )
    assert [frame.latitude for frame in flight.frames] == pytest.approx(
        [PATH[i][0] for i in (20, 130, 420, 560)], abs=1e-9
    )
    # The offset also tells the photos' time in UTC.
    assert flight.utc
    assert flight.frames[0].time == NOON + 20


@pytest.mark.parametrize("column", ["datetime(local)", "datetime(utc)", "date"])
def test_a_log_in_local_time_fits_photos_in_utc_though_it_says_utc(tmp_path: Path, column: str) -> None:
    photos(tmp_path / "photos", [20, 130, 420], 0.0, utc=True)
    log = a_log(tmp_path / "log.csv", column, offset=7200.0)
    flight = make_flight([tmp_path / "photos", log], tmp_path / "flight")
    assert is_at_its_seconds(flight)
    assert "with a constant offset: the log's clock is " in note_of(flight)
    assert note_of(flight).startswith("log.csv gives the values of 3 of 3 photos")


def test_two_local_clocks_that_differ_by_an_hour_fit(tmp_path: Path) -> None:
    photos(tmp_path / "photos", [20, 130, 420], 3600.0)
    flight = make_flight([tmp_path / "photos", a_log(tmp_path / "log.csv", "date", offset=7200.0)], tmp_path / "flight")
    assert is_at_its_seconds(flight)
    assert "the log's clock is 1 h ahead of the photos'" in note_of(flight)


@pytest.mark.parametrize(
    ("offset", "words"), [(7234.0, "7234 s behind"), (-86_400.0 * 400 - 77.0, "34560077 s ahead of")]
)
def test_positions_of_the_photos_tell_an_offset_that_is_no_zone(tmp_path: Path, offset: float, words: str) -> None:
    photos(tmp_path / "photos", [20, 130, 300, 420, 560], offset, positioned=True)
    flight = make_flight([tmp_path / "photos", a_log(tmp_path / "log.csv")], tmp_path / "flight")
    assert (
        f"with a constant offset that the photos' own positions imply: the log's clock is {words} the photos'"
        in note_of(flight)
    )
    assert is_at_its_seconds(flight)
    assert flight.frames[0].time == pytest.approx(NOON + 20, abs=1.0)


def test_a_clock_that_fits_but_disagrees_with_the_photos_positions_is_mended_or_said(tmp_path: Path) -> None:
    # Photos and log overlap without an offset, 34 s apart.
    photos(tmp_path / "photos", [20, 130, 300, 420, 560], 34.0, positioned=True)
    flight = make_flight([tmp_path / "photos", a_log(tmp_path / "log.csv", "date")], tmp_path / "flight")
    assert "the log's clock is 34 s behind the photos'" in note_of(flight)
    assert is_at_its_seconds(flight)
    # Positions of another place prove nothing, and the doubt is said.
    log = a_log(tmp_path / "log.csv", "date", path=[(a + 0.1, b) for a, b in PATH])
    flight = make_flight([tmp_path / "photos", log], tmp_path / "flight")
    assert "by their clock, but its positions are 11" in note_of(flight)
    assert "so one of the clocks or positions is wrong" in note_of(flight)


def test_an_offset_that_nothing_tells_is_refused(tmp_path: Path) -> None:
    photos(tmp_path / "photos", [20, 130], 0.0)
    # Five hours of log: the photos lie within it at several zones.
    long = [(47.3 + i / 400_000, 8.5) for i in range(18_000)]
    flight = make_flight(
        [tmp_path / "photos", a_log(tmp_path / "log.csv", offset=-3 * 3600.0, path=long)], tmp_path / "flight"
    )
    assert note_of(flight).startswith("log.csv fits none of the 2 photos by ")
    assert "at several offsets, and nothing decides between them: UTC" in note_of(flight)
    assert all(frame.latitude is None for frame in flight.frames)
    # Another day: no zone fits.
    flight = make_flight([tmp_path / "photos", a_log(tmp_path / "log.csv", offset=30 * 86_400.0)], tmp_path / "other")
    assert "at no offset of a time zone do the photos' times lie within it" in note_of(flight)
    write_photo(tmp_path / "bare" / "a.jpg")
    flight = make_flight([tmp_path / "bare", tmp_path / "log.csv"], tmp_path / "bare flight")
    assert note_of(flight) == "log.csv fits none of the 1 photos by UTC, and was not used: the photos have no time."


def test_logs_of_two_batteries_fit_the_photos_of_both(tmp_path: Path) -> None:
    photos(tmp_path / "photos", [20, 60, 130, 420, 500, 560], 7200.0)
    rows = a_log(tmp_path / "log.csv").read_text().splitlines(keepends=True)
    (tmp_path / "log.1.csv").write_text("".join(rows[:201]))
    (tmp_path / "log.2.csv").write_text("".join([rows[0], *rows[401:]]))
    flight = make_flight([tmp_path / "photos", tmp_path / "log.1.csv", tmp_path / "log.2.csv"], tmp_path / "flight")
    assert is_at_its_seconds(flight)
    assert sum("gives the values of 3 of 6 photos" in note for note in flight.notes) == 2
