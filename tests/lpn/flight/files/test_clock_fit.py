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
        (FOUR, {}, {"ahead": 30 * 24 * HOUR}, "at no offset of a time zone do the photos' times lie within it"),
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
        assert note_of(flight).startswith("log.csv fits none of the 4 photos by ")
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
    assert note_of(flight) == "log.csv fits none of the 1 photos by UTC, and was not used: the photos have no time."


def test_logs_of_two_batteries_fit_the_photos_of_both(tmp_path: Path) -> None:
    photos(tmp_path / "photos", [20, 60, 130, 420, 500, 560], 2 * HOUR)
    rows = a_log(tmp_path / "log.csv").read_text().splitlines(keepends=True)
    (tmp_path / "log.1.csv").write_text("".join(rows[:201]))
    (tmp_path / "log.2.csv").write_text("".join([rows[0], *rows[401:]]))
    flight = make_flight([tmp_path / "photos", tmp_path / "log.1.csv", tmp_path / "log.2.csv"], tmp_path / "flight")
    assert is_on(flight, PATH)
    assert sum("gives the values of 3 of 6 photos" in note for note in flight.notes) == 2
