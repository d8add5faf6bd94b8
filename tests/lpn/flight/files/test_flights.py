"""Checks across the frames of a flight, the command `lpn flight`, and the three real flights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lpn.cli import main
from lpn.core.errors import DataError
from lpn.flight.files import Frame, make_flight, open_flight
from lpn.flight.files.base import local_metres
from lpn.flight.files.quality import flight_notes, with_courses
from lpn.flight.locate.tracks import write_track
from tests.conftest import Refused
from tools.fixtures.photos import dji_xmp, exif, write_photo
from tools.fixtures.videos import srt, write_video


def line(metres: list[tuple[float, float]], seconds: float = 2.0) -> list[Frame]:
    """Frames at metres east and north of 47°N 8°E, some seconds apart."""
    return [
        Frame(f"{i}.jpg", Path(f"{i}.jpg"), 4, 3, i * seconds, 47 + north / 111_170, 8 + east / 76_060)
        for i, (east, north) in enumerate(metres)
    ]


def test_the_course_is_the_heading_where_nothing_else_is() -> None:
    frames = line([(0, 0), (0, 20), (0, 40), (20, 40), (40, 40), (40.5, 40.2), (41, 40)])
    made, notes = with_courses(frames)
    courses = [None if frame.heading is None else round(frame.heading) for frame in made]
    # The third frame is a turn; at the end the drone hovers, and its last step came from the west.
    assert courses[:5] == [0, 0, None, 90, 90]
    assert {frame.heading_source for frame in made if frame.heading is not None} == {"course"}
    assert "got the course over ground" in notes[0]
    known = [replace(frame, heading=7.0, heading_source="gimbal") for frame in frames]
    assert with_courses(known) == (known, [])
    for other in (line([(0, 0), (1, 0), (0, 1)]), line([(0, 0), (0, 20), (0, 40)], seconds=60.0)):
        assert with_courses(other)[0][1].heading is None


def test_metres_are_measured_across_the_date_line() -> None:
    places = np.array([(0.0, 179.999), (0.0, -179.999)])
    assert local_metres(places)[1, 0] == pytest.approx(222.6, abs=0.1)


def test_jumps_and_missing_positions_are_noted() -> None:
    steady = [(0.0, 10.0 * i) for i in range(12)]
    frames = line(steady)
    assert not flight_notes(frames)
    nowhere = [replace(frame, latitude=None, longitude=None) for frame in frames]
    timeless = [replace(frame, time=None) for frame in line([*steady[:6], (5000.0, 60.0)])]
    jumping = line([*steady[:6], (5000.0, 60.0), *steady[7:]])
    for odd, note in (
        (jumping, "The GPS tags jump 2 times, first by 5000 m after 5.jpg; tags about a"),
        (timeless, "The GPS tags jump once, first by 5000 m after 5.jpg"),
        ([*frames[::2], *nowhere[1::2]], "6 of 12 photos have no GPS tag: 1.jpg, 3.jpg, 5.jpg, and 3 more."),
        (nowhere, "None of the 12 photos has a GPS tag. They can be placed without one"),
    ):
        (found,) = flight_notes(odd)
        assert found.startswith(note)


def test_the_command_prints_what_is_known(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for i in range(3):
        packet = dji_xmp(RelativeAltitude=40 + i, GimbalYawDegree=45, GimbalPitchDegree=-90, GimbalRollDegree=0)
        write_photo(tmp_path / "DJI" / f"{i}.JPG", exif(47 + i / 1000, 8.0), packet)
    (tmp_path / "DJI" / "notes.txt").write_text("x")
    files = [str(file) for file in sorted((tmp_path / "DJI").iterdir())]
    assert main.main(["flight", *files, "--out", str(tmp_path / "monday"), "--fov", "70"]) == 0
    printed = capsys.readouterr().out
    assert "monday: 3 photos" in printed
    assert "height above take-off      3 of 3  40.0 to 42.0 m, median 41.0 m" in printed
    assert "heading                    3 of 3  3 gimbal" in printed
    assert "field of view              3 of 3  70.0°" in printed
    assert "height above ground        0 of 3\n" in printed
    assert "- Left out, because their kind is not supported: notes.txt." in printed
    assert len(open_flight(tmp_path / "monday").frames) == 3


@pytest.mark.parametrize("suffix", [".csv", ".geojson", ".gpx"])
def test_a_track_that_lpn_locate_wrote_is_no_log(tmp_path: Path, suffix: str) -> None:
    write_photo(tmp_path / "photos" / "a.jpg", exif(47.0, 8.0))
    point = {"frame": "a.jpg", "stage": "registration", "state": "accepted", "latitude": 47.0, "longitude": 8.0}
    track = tmp_path / f"track{suffix}"
    if suffix == ".gpx":  # of earlier versions
        track.write_text('<?xml version="1.0"?>\n<gpx version="1.1" creator="lpn locate"></gpx>')
    else:
        write_track(track, "monday", [point])
    with pytest.raises(DataError, match=rf"^track\{suffix} is a track of lpn locate: .* give the photos, with the"):
        make_flight([tmp_path / "photos", track], tmp_path / "monday")
    assert not (tmp_path / "monday").exists()


def test_maps_of_a_survey_program_are_no_photos(tmp_path: Path) -> None:
    write_photo(tmp_path / "odm" / "images" / "a.jpg", exif(47.0, 8.0))
    folder = tmp_path / "odm" / "odm_orthophoto"
    folder.mkdir()
    options = {"odm_orthophoto.tif": {"tiffinfo": {33550: (0.05, 0.05, 0.0)}}, "odm_orthophoto.png": {}, "b.tif": {}}
    for name, given in options.items():
        Image.new("RGB", (40, 30)).save(folder / name, **given)
    write_photo(folder / "mosaic.jpg").with_suffix(".jgw").write_text("0.05\n0\n0\n-0.05\n500000\n5300000\n")
    for flight in (open_flight(tmp_path / "odm"), make_flight([tmp_path / "odm"], tmp_path / "flight")):
        assert [frame.name for frame in flight.frames] == ["a.jpg", "b.tif"]
        named = "mosaic.jpg, odm_orthophoto.png, odm_orthophoto.tif"
        assert f"Left out, because they are maps, not photos: {named}." in flight.notes
    with pytest.raises(DataError, match=r"no photo and no video \(mosaic\.jpg is a map, which lpn map takes\)"):
        make_flight([folder / "mosaic.jpg"], tmp_path / "other")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "There are no files; give photos"),
        (["nowhere.jpg"], "There is no nowhere.jpg"),
        (["photo.jpg", "--every", "0"], "--every is 0; expected a number from 0.04"),
        (["photo.jpg", "--pitch", "100"], "--pitch is 100; expected a number from -180 to 90"),
        (["photo.jpg", "--every", "2"], "; leave --every out"),
        (["photo.jpg", "--every-metres", "5"], "; leave --every-metres out"),
        (["photo.jpg", "--fov", "200"], "--fov is 200"),
        (["a.SRT"], "There is no video for 1 .SRT file"),
        (["a.txt"], "There is no photo and no video (a.txt is neither)"),
        (["photo.jpg", "a.mp4"], "Photos (1) and videos (1) have different clocks"),
        (["photo.jpg", "photo.jpg"], "photo.jpg is given twice"),
        (["a.mp4", "b/A.mp4"], "Two videos are named a;"),
    ],
)
def test_wrong_files_are_refused_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused, arguments: list[str], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    write_photo(tmp_path / "photo.jpg")
    (tmp_path / "b").mkdir()
    for name in ("a.SRT", "a.txt", "a.mp4", "b/A.mp4"):
        (tmp_path / name).write_text("x")
    assert message in refused("flight", *arguments, "--out", "out")
    assert not (tmp_path / "out").exists()


def test_without_the_extra_video_the_note_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from lpn.flight.files import sources

    video = write_video(tmp_path / "a.mp4", 0.5)
    monkeypatch.setattr(sources, "find_spec", lambda _: None)
    flight = make_flight([video], tmp_path / "flight")
    assert any("pip install 'lpn-explorer[maps]'" in note for note in flight.notes)
    (tmp_path / "a.SRT").write_text(srt(["[latitude: 1.0] [longitude: 2.0] [rel_alt: 3.0 abs_alt: 4.0]"]))
    assert make_flight([video], tmp_path / "flight").frames[0].latitude == 1.0
