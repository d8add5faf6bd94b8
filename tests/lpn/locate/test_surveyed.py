"""A flight's answers against surveyed positions, with residuals written out."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from lpn.core.errors import DataError, InputError
from lpn.flights import Frame
from lpn.locate.camera_pose import CameraPose
from lpn.locate.located import LocatedFlight, LocatedFrame, StageRecord
from lpn.locate.surveyed import (
    SurveyedPosition,
    compare_surveyed,
    read_surveyed,
    summarise_surveyed,
    write_residuals,
)
from lpn.maps import LocalFrame

# On the middle of UTM zone 14, whose grid shortens metres by 0.04 %.
ORIGIN = LocalFrame(30.17, -99.0)


def flight(*frames: LocatedFrame) -> LocatedFlight:
    return cast(LocatedFlight, SimpleNamespace(frames=list(frames), basemap=SimpleNamespace(frame=ORIGIN)))


def photo(name: str, answer: StageRecord | None) -> LocatedFrame:
    frame = Frame(name, Path(name), 80, 60)
    return LocatedFrame(frame, None, {} if answer is None else {"registration": answer})


def accepted(x: float, y: float, radius: float = 1.0, **others: object) -> StageRecord:
    return StageRecord("accepted", "It agrees.", x, y, radius=radius, **others)  # type: ignore[arg-type]


def written(tmp_path: Path, *lines: str) -> Path:
    file = tmp_path / "survey.csv"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file


def places(positions: Sequence[SurveyedPosition]) -> list[list[float]]:
    return [[position.x, position.y] for position in positions]


def test_positions_are_read_in_degrees_and_in_any_system_in_metres(tmp_path: Path) -> None:
    at = [(12.5, -40.25), (-300.0, 77.0)]
    degrees, utm = ORIGIN.degrees(at), ORIGIN.utm(at)
    lines = [f"{name},{a:.9f},{b:.9f}" for name, (a, b) in zip("ab", degrees.tolist(), strict=True)]
    found = read_surveyed(written(tmp_path, "Photo,Lat,Lon", *lines), ORIGIN)
    np.testing.assert_allclose(places(found), at, atol=1e-3)
    assert [(one.photo, one.point) for one in found] == [("a", "camera"), ("b", "camera")]
    lines = [f"{name}\t{a:.4f}\t{b:.4f}\t32614.0\tground" for name, (a, b) in zip("ab", utm.tolist(), strict=True)]
    found = read_surveyed(written(tmp_path, "image\teasting_m\tnorthing_m\tepsg\tpoint", *lines), ORIGIN)
    np.testing.assert_allclose(places(found), at, atol=1e-3)
    assert [one.point for one in found] == ["ground", "ground"]
    lines = [line.rsplit("\t", 2)[0].replace("\t", ";").replace(".", ",") for line in lines]
    found = read_surveyed(written(tmp_path, "sep=;", "file;E;N", *lines), ORIGIN, "EPSG:32614")
    np.testing.assert_allclose(places(found), at, atol=1e-3)


@pytest.mark.parametrize(
    ("lines", "sentence"),
    [
        (("photo,height", "a,1"), r"first line of survey.csv is photo,height; expected photo and latitude"),
        (("photo;lat;lon", "a;1;2"), r"put the line sep=; above it"),
        (("photo,lat,lon",), r"no position below its first line"),
        (("photo,lat,lon", "a,95,2"), r"Line 2 of survey.csv has the latitude '95'; expected degrees from -90 to 90"),
        (("photo,lat,lon", "a,5"), r"Line 2 of survey.csv has 2 values, and its columns need 3"),
        (("photo,lat,lon,point", "a,5,6,roof"), r"has the point 'roof'; expected camera or ground"),
        (("photo,lat,lon", ",5,6"), r"has no photo"),
        (("photo,easting,northing", "a,5,6"), r"without their CRS; add a column epsg"),
        (("photo,easting,northing,epsg", "a,5,6,no"), r"There is no CRS 'no'"),
        (("photo,lat,lon", '"a,5,6'), r"not a text file of comma-separated values"),
    ],
)
def test_a_bad_table_gets_one_sentence(tmp_path: Path, lines: tuple[str, ...], sentence: str) -> None:
    with pytest.raises((DataError, InputError), match=sentence):
        read_surveyed(written(tmp_path, *lines), ORIGIN)


def test_a_missing_table_gets_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read"):
        read_surveyed(tmp_path / "none.csv", ORIGIN)


def test_errors_are_answer_minus_survey_and_refused_photos_do_not_count(tmp_path: Path) -> None:
    located = flight(
        photo("a.jpg", accepted(3.0, 4.0, 2.0)),
        photo("b.jpg", accepted(1.0, 0.0, 2.0)),
        photo("c.jpg", StageRecord("refused", "Too few matches.")),
        photo("d.jpg", accepted(0.0, 0.0)),
    )
    surveyed = [SurveyedPosition(name, 0.0, 0.0, "ground") for name in ("photos/A.JPG", "b", "c.jpg", "e.jpg")]
    rows, told = compare_surveyed(located, surveyed)
    errors = summarise_surveyed(rows)["registration"]
    assert errors.photos == 2
    figures = (
        errors.bias_east,
        errors.bias_north,
        errors.rmse_east,
        errors.rmse_north,
        errors.rmse,
        errors.median,
        errors.ce90,
        errors.largest,
    )
    np.testing.assert_allclose(figures, (2, 2, math.sqrt(5), math.sqrt(8), math.sqrt(13), 3.0, 4.6, 5.0), rtol=1e-3)
    assert errors.within == {1: 50.0, 2: 50.0, 3: 100.0}
    assert told == [
        "1 surveyed photos are not in the flight, so check their names: e.jpg.",
        "No answer is accepted for 1 surveyed photos: c.jpg.",
        "1 photos of the flight have no surveyed position.",
    ]
    write_residuals(tmp_path / "residuals.csv", rows, ORIGIN)
    with (tmp_path / "residuals.csv").open(newline="") as file:
        written_rows = list(csv.DictReader(file))
    assert [row["photo"] for row in written_rows] == ["a.jpg", "b.jpg", "c.jpg"]
    first = [float(written_rows[0][name]) for name in ("east_m", "north_m", "distance_m", "radius_m", "radii")]
    assert first == pytest.approx([3.0, 4.0, 5.0, 2.0, 2.5], rel=1e-3)
    assert (written_rows[2]["state"], written_rows[2]["distance_m"]) == ("refused", "")
    assert float(written_rows[0]["easting_m"]) - float(written_rows[0]["surveyed_easting_m"]) == pytest.approx(
        3, abs=0.01
    )


def test_a_camera_is_compared_with_the_pose_and_the_ground_with_the_middle() -> None:
    pose = CameraPose(
        7.0, 1.0, 50.0, 50.0, 0.0, -80.0, 0.0, 70.0, "told", True, 90, np.diag([9.0, 9, 9, 1, 1, 1]).ravel().tolist()
    )
    located = flight(
        photo("a.jpg", accepted(2.0, 1.0, pose=pose, map_error=4.0)),
        photo("b.jpg", accepted(2.0, 1.0)),
    )
    surveyed = [
        SurveyedPosition("a.jpg", 6.0, 1.0, "camera"),
        SurveyedPosition("a.jpg", 2.0, 0.0, "ground"),
        SurveyedPosition("b.jpg", 0.0, 1.0, "camera"),
    ]
    rows, told = compare_surveyed(located, surveyed)
    assert [row.answered for row in rows] == ["camera", "ground", "ground"]
    figures = [(row.east, row.north, row.radius) for row in rows]
    np.testing.assert_allclose(figures, [(1, 0, 5), (0, 1, 1), (2, 0, 1)], atol=2e-3)
    assert told == [
        "1 surveyed positions of the camera are compared with the ground at the photo's middle, as the answer tells no more; a "
        "tilted camera keeps the two apart."
    ]


def test_photos_of_another_flight_and_second_positions_are_refused() -> None:
    located = flight(photo("a.jpg", accepted(0.0, 0.0)))
    with pytest.raises(InputError, match=r"None of the 1 surveyed photos, the first being z\.jpg, is in the flight"):
        compare_surveyed(located, [SurveyedPosition("z.jpg", 0.0, 0.0, "camera")])
    with pytest.raises(InputError, match=r"a\.jpg has two surveyed positions of its camera"):
        compare_surveyed(located, [SurveyedPosition("a.jpg", 0.0, 0.0, "camera")] * 2)
    with pytest.raises(InputError, match=r"lie 457 km from the answers in the median; check their CRS"):
        compare_surveyed(located, [SurveyedPosition("a.jpg", 457_000.0, 0.0, "ground")])


def test_a_crs_that_is_told_twice_is_refused(tmp_path: Path) -> None:
    file = written(tmp_path, "photo,easting,northing,epsg", "a,5,6,32614")
    with pytest.raises(InputError, match="tells its CRS in a column; leave --crs out"):
        read_surveyed(file, ORIGIN, "EPSG:32615")
