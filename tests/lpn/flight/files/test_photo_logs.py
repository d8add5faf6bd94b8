"""Photos that a log names: one row for each, by name and folder, or none and a note."""

from __future__ import annotations

from pathlib import Path

import pytest

from lpn.flight.files import make_flight
from tools.fixtures.photos import exif, write_photo

TWO = ("100MEDIA/DJI_0001.JPG", "101MEDIA/DJI_0001.JPG")
NOT_TOLD = "so none of them has its values; write their folders in it."


@pytest.mark.parametrize(
    ("name", "rows", "latitudes", "note"),
    [
        ("log.csv", "file,lat,lon\nD:\\DCIM\\101MEDIA\\DJI_0001.JPG,47.2,8\nD:\\DCIM\\100MEDIA\\DJI_0001.JPG,47.1,8\n",
         (47.1, 47.2), ""),
        # A row of one folder does not match a photo in another.
        ("log.csv", "file,lat,lon\n100MEDIA/DJI_0001.JPG,47.1,8\n", (47.1, None), ""),
        ("log.csv", "file,lat,lon\nDJI_0001.JPG,47.1,8\nDJI_0002.JPG,47.3,8\n", (None, None), NOT_TOLD),
        ("log.csv", "file,lat,lon\nDJI_0001,47.1,8\n", (None, None), NOT_TOLD),
        ("geo.txt", "EPSG:4326\nDJI_0001.JPG 8.1 47.1 500\n", (None, None), NOT_TOLD),
        ("track.gpx", '<gpx version="1.1"><wpt lat="47.1" lon="8.1"><name>DJI_0001.JPG</name></wpt></gpx>', (None, None),
         NOT_TOLD),
    ],
)  # fmt: skip
def test_photos_of_one_name_never_share_a_row(
    tmp_path: Path, name: str, rows: str, latitudes: tuple[float | None, float | None], note: str
) -> None:
    for file in TWO:
        write_photo(tmp_path / file)
    (tmp_path / name).write_text(rows)
    flight = make_flight([tmp_path, tmp_path / name], tmp_path / "flight")
    assert {frame.name: frame.latitude for frame in flight.frames} == dict(zip(TWO, latitudes, strict=True))
    said = [one for one in flight.notes if "photos are called" in one]
    assert [one for one in said if all(file in one for file in TWO) and one.endswith(note)] == said
    assert bool(said) == bool(note)


@pytest.mark.parametrize(
    ("tags", "latitudes"),
    [
        ((47.10001, 47.2), (47.1, 47.2)),
        ((47.10001, 47.10002), (47.10001, 47.10002)),
        ((47.10001, None), (47.10001, None)),
    ],
)
def test_the_photos_own_positions_decide_between_two_of_one_name(
    tmp_path: Path, tags: tuple[float, float | None], latitudes: tuple[float, float | None]
) -> None:
    for file, tag in zip(TWO, tags, strict=True):
        write_photo(tmp_path / file, None if tag is None else exif(tag, 8.0))
    (tmp_path / "log.csv").write_text("file,lat,lon\nDJI_0001.JPG,47.1,8\n")
    flight = make_flight([tmp_path, tmp_path / "log.csv"], tmp_path / "flight")
    assert [frame.latitude for frame in flight.frames] == [
        None if at is None else pytest.approx(at) for at in latitudes
    ]
    assert any(note.endswith(NOT_TOLD) for note in flight.notes) == (latitudes[0] != 47.1)


@pytest.mark.parametrize(("positioned", "latitude"), [(True, 47.3), (False, 47.4)])
def test_a_picture_listed_twice_is_said_and_never_silently_the_last(
    tmp_path: Path, positioned: bool, latitude: float
) -> None:
    photo = write_photo(tmp_path / "a.jpg", exif(47.30001, 8.5) if positioned else None)
    log = tmp_path / "log.csv"
    log.write_text("filename,lat,lon\na.jpg,47.4,8.5\na.jpg,47.3,8.5\na.jpg,47.4,8.6\n")
    flight = make_flight([photo, log], tmp_path / "flight")
    assert flight.frames[0].latitude == latitude
    said = "1 of 1 photos are listed more than once in log.csv with different values, such as a.jpg in lines 2 and 3 and 4;"
    assert any(note.startswith(said) for note in flight.notes)
    # The same values twice are no oddity.
    log.write_text("filename,lat,lon\na.jpg,47.4,8.5\na.jpg,47.4,8.5\n")
    assert not any("more than once" in note for note in make_flight([photo, log], tmp_path / "flight").notes)


@pytest.mark.parametrize(("place", "doubted"), [("47.301,8.5", False), ("8.5,47.3", True)])
def test_positions_far_from_the_photos_own_are_doubted(tmp_path: Path, place: str, doubted: bool) -> None:
    photo = write_photo(tmp_path / "a.jpg", exif(47.3, 8.5))
    (tmp_path / "log.csv").write_text(f"filename,lat,lon\na.jpg,{place}\n")
    notes = make_flight([photo, tmp_path / "log.csv"], tmp_path / "flight").notes
    assert (
        any("km from the photos' own in the median; check that it is of this flight" in note for note in notes)
        == doubted
    )
