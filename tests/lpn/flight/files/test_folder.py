"""The folder of a flight is read as it was written, and damaged ones are refused by the line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from lpn.core.errors import DataError, OutputError
from lpn.flight.files import Flight, Frame, make_flight, open_flight, write_flight
from tools.fixtures.photos import exif, write_photo

FRAME = Frame(
    "a, b.jpg", Path("photos/a, b.jpg"), 400, 300, 1714564800.1234567, 46.842607083333334, -91.99455988888889, 40.1, None, 198.3,
    45.0, "gimbal", -89.9, 0.0, 81.7,
)  # fmt: skip


def written(folder: Path) -> Path:
    frames = (replace(FRAME, file=folder / "photos" / "a.jpg"), Frame("b", folder / "photos" / "b.jpg", 1, 2))
    write_flight(Flight("monday", frames, ("Ein Hinweis: 5°.",), True), folder / "flight")
    return folder / "flight"


def test_a_flight_is_read_as_it_was_written(tmp_path: Path) -> None:
    flight = open_flight(written(tmp_path))
    assert flight.frames[0] == replace(FRAME, file=tmp_path / "photos" / "a.jpg")
    assert flight.frames[1] == Frame("b", tmp_path / "photos" / "b.jpg", 1, 2)
    assert (flight.name, flight.notes, flight.utc) == ("monday", ("Ein Hinweis: 5°.",), True)
    assert "../photos/a.jpg" in (tmp_path / "flight" / "flight.csv").read_text("utf-8")


@pytest.mark.parametrize(("name", "text"), [("flight.csv", "latitude,longitude,time\n1,2,3\n"), ("flight.json", "{}")])
def test_files_that_lpn_flight_did_not_write_are_not_replaced(tmp_path: Path, name: str, text: str) -> None:
    photo, own = write_photo(tmp_path / "a.jpg", exif(1.0, 2.0)), tmp_path / "flight"
    for _ in range(2):  # it replaces its own
        flight = make_flight([photo], own)
    (own / "flight.json").unlink()
    write_flight(flight, own)
    for folder in (tmp_path, own):  # alone, and beside our other file
        (folder / name).write_text(text)
        for attempt in (lambda out: make_flight([photo], out), lambda out: write_flight(flight, out)):
            with pytest.raises(OutputError, match=f"{name} was not written by lpn flight"):
                attempt(folder)
        assert (folder / name).read_text() == text
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["a.jpg", "flight", name])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("46.842607083333334", "146.8", r"Line 2 .*Expected `float` <= 90\.0 in `latitude`"),
        ("46.842607083333334", "", "Line 2 .*both or none of latitude and longitude"),
        ("81.7,", "81.7,1 2", r"Line 2 .* is not what lpn flight writes \(2 numbers where 9 are expected\)"),
        ("gimbal", "wind", "Line 2 .*Invalid enum value 'wind' in `heading_source`"),
        ("gimbal", "", "Line 2 .*both or none of heading and heading_source"),
        ("400", "0", "Line 2 .*Expected `int` >= 1 in `width`"),
        ("40.1", "nan", "Line 2 .*Expected `float` >= .* in `height_above_ground`"),
        ("name,file", "file,name", "The first line"),
        ("\nb,", "\n,", "Line 3 .*missing required field `name`"),
        ("\nb,", '\n"a, b.jpg",', "names a, b.jpg twice"),
        (",1,2,", ",1,", "Line 3 .* should have 16 values, and has 15"),
    ],
)
def test_a_damaged_table_is_refused_by_its_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    table = written(tmp_path) / "flight.csv"
    text = table.read_text("utf-8")
    assert old in text
    table.write_text(text.replace(old, new, 1), "utf-8")
    with pytest.raises(DataError, match=message):
        open_flight(tmp_path / "flight")


def test_folders_that_are_no_flight_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="There is no flight at"):
        open_flight(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"There is no photo in .*, or a folder that lpn flight wrote"):
        open_flight(tmp_path)
    (tmp_path / "a.mp4").touch()
    messages = {tmp_path: r"make a flight of its videos \(a\.mp4\)", tmp_path / "a.mp4": "is a file; exp"}
    for given, message in messages.items():
        with pytest.raises(DataError, match=rf"{message}.* with lpn flight {given} --out FLIGHT, and give FLIGHT\."):
            open_flight(given)
    header = written(tmp_path) / "flight.json"
    newer = header.read_text("utf-8").replace("lpn-flight/1", "lpn-flight/9")
    for text, message in ((newer, "later version"), ("{", "is not what lpn flight writes")):
        header.write_text(text, "utf-8")
        with pytest.raises(DataError, match=message):
            open_flight(tmp_path / "flight")
