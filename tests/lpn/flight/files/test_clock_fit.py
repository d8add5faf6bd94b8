"""Clocks that differ by a constant offset: estimated where the files determine it, and refused elsewhere."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from PIL import ExifTags

from lpn.flight.files import Flight, FlightOptions, make_flight
from tools.fixtures.photos import exif, write_photo

NOON = datetime(2024, 5, 1, 12, tzinfo=UTC).timestamp()
# A log of ten minutes that flies about in a way of which no part resembles another.
PATH = [(47.3 + i / 40_000 + (i % 97) / 9_000, 8.5 + i * i / 9_000_000) for i in range(600)]


def a_log(
    file: Path, column: str = "datetime(utc)", offset: float = 0.0, path: list[tuple[float, float]] = PATH
) -> Path:
    """Write a log of one row a second from noon, whose clock is ahead by an offset in seconds."""
    times = [datetime.fromtimestamp(NOON + i + offset, UTC) for i in range(len(path))]
    rows = [f"{time:%Y-%m-%d %H:%M:%S},{a},{b}\n" for time, (a, b) in zip(times, path, strict=True)]
    file.write_text(f"{column},latitude,longitude\n" + "".join(rows), "utf-8")
    return file


def photos(
    folder: Path, seconds: list[int], offset: float, places: list[tuple[float, float]] | None = None, utc: bool = False
) -> None:
    """Write photos of some seconds of the log, whose camera's clock is ahead of UTC by an offset."""
    for second in seconds:
        true, taken = (datetime.fromtimestamp(NOON + second + ahead, UTC) for ahead in (0, offset))
        stamp = {ExifTags.GPS.GPSDateStamp: f"{true:%Y:%m:%d}"}
        gps: dict[int, Any] = {**stamp, ExifTags.GPS.GPSTimeStamp: (true.hour, true.minute, true.second)}
        place = (None, None) if places is None else places[second]
        camera: dict[int, Any] = {ExifTags.Base.DateTimeOriginal: f"{taken:%Y:%m:%d %H:%M:%S}"}
        write_photo(folder / f"{second:03d}.jpg", exif(*place, camera=camera, gps=gps if utc else None))


def note_of(flight: Flight) -> str:
    return next(note for note in flight.notes if note.startswith("log."))


def is_at_its_seconds(flight: Flight) -> bool:
    return all(
        (frame.latitude, frame.longitude) == pytest.approx(PATH[int(frame.name[:3])], abs=2e-5)
        for frame in flight.frames
    )


@pytest.mark.parametrize(
    ("hours", "words"), [(2.0, "2 h behind"), (-5.0, "5 h ahead of"), (5.75, "5.75 h behind"), (0.0, None)]
)
def test_photos_in_local_time_fit_a_log_in_utc(tmp_path: Path, hours: float, words: str | None) -> None:
    photos(tmp_path / "photos", [20, 130, 420, 560], hours * 3600)
    flight = make_flight([tmp_path / "photos", a_log(tmp_path / "log.csv")], tmp_path / "flight")
    offset = "" if words is None else f", with a constant offset: the log's clock is {words} the photos'"
    said = f"log.csv gives the values of 4 of 4 photos, by their clock{offset}; they replace those in the files."
    assert note_of(flight) == said
    assert is_at_its_seconds(flight)
    # The offset also tells the photos' time in UTC.
    assert flight.utc
    assert flight.frames[0].time == NOON + 20


@pytest.mark.parametrize("column", ["datetime(local)", "datetime(utc)", "date"])
def test_a_log_in_local_time_fits_photos_in_utc_though_it_says_utc(tmp_path: Path, column: str) -> None:
    photos(tmp_path / "photos", [20, 130, 420], 0.0, utc=True)
    log = a_log(tmp_path / "log.csv", column, offset=7200.0)
    flight = make_flight([tmp_path / "photos", log], tmp_path / "flight")
    assert is_at_its_seconds(flight)
    assert "with a constant offset: the log's clock is 2 h ahead of the photos'" in note_of(flight)


@pytest.mark.parametrize(
    ("length", "seconds", "placed"), [(7200, [20, 130, 300, 420], True), (1800, [20, 600, 1200, 1750], False)]
)
def test_positions_or_the_number_of_photos_within_the_log_decide(
    tmp_path: Path, length: int, seconds: list[int], placed: bool
) -> None:
    # The log holds the photos at several offsets, and passes their places, or holds most of them, at one.
    path = [(47.3 + i / 40_000, 8.5) for i in range(length)]
    photos(tmp_path / "photos", seconds, 3600.0, places=path if placed else None)
    flight = make_flight([tmp_path / "photos", a_log(tmp_path / "log.csv", path=path)], tmp_path / "flight")
    assert "the log's clock is 1 h behind the photos'" in note_of(flight)
    assert [frame.latitude for frame in flight.frames] == pytest.approx([path[i][0] for i in seconds], abs=2e-5)


def test_an_offset_that_is_no_zone_is_given_or_said(tmp_path: Path) -> None:
    # Photos and log overlap without an offset, 34 s apart.
    photos(tmp_path / "photos", [20, 130, 300, 420, 560], 34.0, places=PATH)
    files = [tmp_path / "photos", a_log(tmp_path / "log.csv", "date")]
    note = note_of(make_flight(files, tmp_path / "flight"))
    assert "by their clock, but its positions are " in note
    assert "so one of the clocks or positions is wrong; --clock-offset tells the offset" in note
    flight = make_flight(files, tmp_path / "told", FlightOptions(clock_offset=-34.0))
    assert "with the offset of -34 s given with --clock-offset" in note_of(flight)
    assert is_at_its_seconds(flight)


@pytest.mark.parametrize(
    ("offset", "length", "why"),
    [
        # The photos lie within five hours of log at several zones.
        (
            -3 * 3600.0,
            18_000,
            "at several offsets, and nothing decides between them; give one, in seconds, with --clock-offset: ",
        ),
        (30 * 86_400.0, 600, "at no offset of a time zone do the photos' times lie within it"),
    ],
)
def test_an_offset_that_nothing_tells_is_refused(tmp_path: Path, offset: float, length: int, why: str) -> None:
    photos(tmp_path / "photos", [20, 130], 0.0)
    path = [(47.3 + i / 400_000, 8.5) for i in range(length)]
    files = [tmp_path / "photos", a_log(tmp_path / "log.csv", offset=offset, path=path)]
    flight = make_flight(files, tmp_path / "flight")
    assert note_of(flight).startswith("log.csv fits none of the 2 photos by ")
    assert why in note_of(flight)
    assert all(frame.latitude is None for frame in flight.frames)


def test_clocks_of_one_kind_need_no_offset(tmp_path: Path) -> None:
    photos(tmp_path / "photos", [20, 130], 0.0, utc=True)
    path = [(47.3 + i / 400_000, 8.5) for i in range(7200)]
    flight = make_flight([tmp_path / "photos", a_log(tmp_path / "log.csv", path=path)], tmp_path / "flight")
    assert note_of(flight) == "log.csv gives the values of 2 of 2 photos, by UTC; they replace those in the files."


def test_photos_without_a_time_fit_no_log(tmp_path: Path) -> None:
    write_photo(tmp_path / "bare" / "a.jpg")
    flight = make_flight([tmp_path / "bare", a_log(tmp_path / "log.csv")], tmp_path / "flight")
    assert note_of(flight) == "log.csv fits none of the 1 photos by UTC, and was not used: the photos have no time."


def test_logs_of_two_batteries_fit_the_photos_of_both(tmp_path: Path) -> None:
    photos(tmp_path / "photos", [20, 60, 130, 420, 500, 560], 7200.0)
    rows = a_log(tmp_path / "log.csv").read_text().splitlines(keepends=True)
    (tmp_path / "log.1.csv").write_text("".join(rows[:201]))
    (tmp_path / "log.2.csv").write_text("".join([rows[0], *rows[401:]]))
    flight = make_flight([tmp_path / "photos", tmp_path / "log.1.csv", tmp_path / "log.2.csv"], tmp_path / "flight")
    assert is_at_its_seconds(flight)
    assert sum("gives the values of 3 of 6 photos" in note for note in flight.notes) == 2
