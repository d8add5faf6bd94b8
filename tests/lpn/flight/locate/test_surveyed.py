"""A flight's answers against surveyed positions, with residuals written out."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import msgspec
import numpy as np
import pytest
from rich.console import Console

from lpn.core.errors import DataError, InputError
from lpn.flight.commands.locate import print_surveyed
from lpn.flight.files import Flight, Frame
from lpn.flight.locate.camera_pose import CameraPose
from lpn.flight.locate.located import LocatedFlight, LocatedFrame, StageRecord
from lpn.flight.locate.surveyed import (
    Residual,
    SurveyedPosition,
    compare_surveyed,
    match_surveyed,
    read_surveyed,
    summarise_surveyed,
    survey_remarks,
    write_residuals,
)
from lpn.flight.locate.tracks import best_track
from lpn.flight.maps import LocalFrame, Map

# On the middle of UTM zone 14, whose grid shortens metres by 0.04 %.
ORIGIN = LocalFrame(30.17, -99.0)


# Lays the middle of a photo of 80 x 60 pixels 1 m north of the origin.
LAID = [1.0, 0, -39.5, 0, -1, 30.5, 0, 0, 1]
# A map of 2 by 1 km about the origin.
BOUNDS = (-1000.0, -500.0, 1000.0, 500.0)
BASEMAP = cast(Map, SimpleNamespace(frame=ORIGIN, bounds=BOUNDS))
BASEMAP.metres_off = lambda point: Map.metres_off(BASEMAP, point)  # type: ignore[method-assign]


def flight(*frames: LocatedFrame) -> LocatedFlight:
    return LocatedFlight(Flight("monday", tuple(one.frame for one in frames)), BASEMAP, list(frames), None, [], None)


def compared(located: LocatedFlight, surveyed: Sequence[SurveyedPosition]) -> list[Residual]:
    return compare_surveyed(located, match_surveyed([one.frame.name for one in located.frames], surveyed, BASEMAP)[0])


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
        (("photo;lat;lon,height", "a;1;2,3"), r"separate all values by the same character"),
        (("photo,lat,lon",), r"no position below its first line"),
        (("photo,lat,lon", "a,95,2"), r"Line 2 of survey.csv has the latitude '95'; expected degrees from -90 to 90"),
        (("photo,lat,lon", "a,5"), r"Line 2 of survey.csv has 2 of the 3 values it needs"),
        (("photo,lat,lon,point", "a,5,6,roof"), r"has the point 'roof'; expected camera or ground"),
        (("photo,lat,lon", ",5,6"), r"has no photo"),
        (("photo,easting,northing", "a,5,6"), r"without their CRS; add a column epsg"),
        (("photo,easting,northing,epsg", "a,5,6,no"), r"There is no CRS 'no'"),
        (("photo,lat,lon", '"a,5,6'), r"Line 2 of survey.csv is not comma-separated values"),
        (("photo,lat,lon,note", 'a,5,6,"bad', "b,5,6,ok"), r"Line 2 of survey.csv is not comma-separated values"),
        (("photo,Lat,lon,x,y", "a,5,6,7,8"), r"has Lat,lon and x,y, and only one of the two can be the survey"),
        (("photo,lat,lon,epsg", "a,5,6,32614"), r"The CRS 32614 is not geographic, and survey.csv has latitudes"),
        (("photo,e,n,epsg", "a,5,6,4326"), r"The CRS 4326 is not projected, and survey.csv has eastings"),
        (("photo,lat,lon,epsg", "a,5,6,4978"), r"The CRS 4978 is not geographic"),
        (
            ("photo,e,n,epsg", "a,500000,3338000,32614", "b,9e9,9e9,32614", "c,9e9,9e9,32614"),
            r"The CRS of survey.csv cannot be brought to the map's plane for all positions",
        ),
        (("photo,e,n,epsg", "a,5,6,32614", "b,5,6,32615"), r"has the CRS 32614 \(Line 2 .*\) and 32615 \(Line 3 of"),
    ],
)
def test_a_bad_table_gets_one_sentence(tmp_path: Path, lines: tuple[str, ...], sentence: str) -> None:
    with pytest.raises((DataError, InputError), match=sentence):
        read_surveyed(written(tmp_path, *lines), ORIGIN)


def test_a_crs_that_is_told_twice_is_refused(tmp_path: Path) -> None:
    file = written(tmp_path, "photo,easting,northing,epsg", "a,5,6,32614")
    with pytest.raises(InputError, match="tells its CRS in a column; leave --crs out"):
        read_surveyed(file, ORIGIN, "EPSG:32615")


def test_degrees_of_another_datum_are_brought_to_the_maps(tmp_path: Path) -> None:
    old = read_surveyed(written(tmp_path, "photo,lat,lon,epsg", "a,30.17,-99,4267"), ORIGIN)
    (away,) = places(old)
    assert 20 < math.hypot(*away) < 60, "NAD27 lies some 40 m from WGS 84 there"
    file = written(tmp_path, "photo,lat,lon", "a,30.17,-99")
    assert read_surveyed(file, ORIGIN, "EPSG:4267") == old
    np.testing.assert_allclose(places(read_surveyed(file, ORIGIN)), [(0, 0)], atol=1e-6)


def test_errors_are_answer_minus_survey_and_refused_photos_do_not_count(tmp_path: Path) -> None:
    refused = StageRecord("refused", "Too few matches.")
    answers = {"a": accepted(3.0, 4.0, 2.0), "b": accepted(1.0, 0.0, 2.0), "c": refused, "d": accepted(0.0, 0.0)}
    located = flight(*(photo(f"{name}.jpg", answer) for name, answer in answers.items()))
    surveyed = [SurveyedPosition(name, 0.0, 0.0, "ground") for name in ("photos/A.JPG", "b", "c.jpg", "e.jpg", "e.jpg")]
    rows = compared(located, surveyed)
    errors = summarise_surveyed(rows)["registration"]["ground"]
    assert errors.photos == 2
    assert [errors.figures["bias_east"], errors.figures["bias_north"]] == pytest.approx([2.0, 2.0], rel=1e-3)
    assert errors.calibration == {1: 50.0, 2: 50.0, 3: 100.0}
    assert survey_remarks(rows, 4) == [
        "Photos without an accepted answer do not count: c.jpg.",
        "Photos of the flight without a surveyed position: 1.",
    ]
    stranger = "Surveyed photos that are not in the flight; check the names: e.jpg."
    assert match_surveyed([one.frame.name for one in located.frames], surveyed, BASEMAP)[1] == stranger
    write_residuals(tmp_path / "residuals.csv", rows, ORIGIN)
    with (tmp_path / "residuals.csv").open(newline="") as file:
        written_rows = list(csv.DictReader(file))
    assert [row["photo"] for row in written_rows] == ["a.jpg", "b.jpg", "c.jpg"]
    first = [float(written_rows[0][name]) for name in ("east_m", "north_m", "distance_m", "radius_m", "radii")]
    assert first == pytest.approx([3.0, 4.0, 5.0, 2.0, 2.5], rel=1e-3)
    assert (written_rows[2]["state"], written_rows[2]["distance_m"]) == ("refused", "")
    eastings = [float(written_rows[0][name]) for name in ("easting_m", "surveyed_easting_m")]
    assert eastings[0] - eastings[1] == pytest.approx(3, abs=0.01)


def test_a_camera_is_compared_with_the_pose_and_the_ground_with_the_middle() -> None:
    pose = CameraPose(
        7.0, 1.0, 50.0, 50.0, 0.0, -80.0, 0.0, 70.0, True, 90, np.diag([9.0, 9, 9, 1, 1, 1]).ravel().tolist()
    )
    laid = accepted(4.0, 1.0, 5.0, camera=True, homography=LAID, middle_radius=0.5)
    unknown = msgspec.structs.replace(laid, middle_radius=None)
    answers = {"a": accepted(2.0, 1.0, pose=pose, map_error=4.0), "b": accepted(2.0, 1.0), "c": laid, "d": unknown}
    located = flight(*(photo(name, answer) for name, answer in answers.items()))
    at = [("a", 6.0, 1.0, "camera"), ("a", 2.0, 0.0, "ground"), ("b", 0.0, 1.0, "camera")]
    at += [("c", 0.0, 0.0, "ground"), ("d", 0.0, 0.0, "ground")]
    rows = compared(located, [SurveyedPosition(*one) for one in at])
    assert [row.answered for row in rows] == ["camera", "ground", "ground", "ground", "ground"]
    figures = [(row.east, row.north, row.radius) for row in rows]
    expected = [(1, 0, 5), (0, 1, 1), (2, 0, 1), (0, 1, 0.5), (0, 1, math.nan)]
    np.testing.assert_allclose(figures, expected, atol=2e-3)
    points = summarise_surveyed(rows)["registration"]
    assert {point: (one.photos, one.calibration) for point, one in points.items()} == {
        "camera": (2, {1: 100.0, 2: 100.0, 3: 100.0}),
        "ground": (3, {1: 50.0, 2: 100.0, 3: 100.0}),
    }
    assert survey_remarks(rows, 4) == [
        "Surveyed positions of the camera that are compared with the ground at the photo's middle, as the answer tells no more: "
        "1. A tilted camera keeps the two apart, so the shares within radii leave them out."
    ]


def test_a_camera_without_a_pose_is_compared_with_the_place_below_it_where_the_tilt_is_told() -> None:
    tilted = Frame("a.jpg", Path("a.jpg"), 80, 60, height_above_ground=100.0, heading=90.0, pitch=-45.0)
    located = flight(LocatedFrame(tilted, None, {"registration": accepted(102.0, 1.0)}))
    surveyed = [SurveyedPosition("a.jpg", 0.0, 0.0, point) for point in ("camera", "ground")]
    below, middle = compared(located, surveyed)
    assert (below.answered, middle.answered) == ("camera", "ground")
    np.testing.assert_allclose([(row.east, row.north) for row in (below, middle)], [(2, 1), (102, 1)], rtol=1e-3)
    assert below.radius > middle.radius == 1.0, "the tilt's error is in the radius of the camera"


def test_without_an_accepted_answer_no_table_is_printed() -> None:
    located = flight(photo("a.jpg", StageRecord("refused", "Too few matches.")))
    rows = compared(located, [SurveyedPosition("a.jpg", 0.0, 0.0, point) for point in ("camera", "ground")])
    console = Console(file=(written := io.StringIO()), width=140)
    print_surveyed(summarise_surveyed(rows), survey_remarks(rows, 1), console)
    assert written.getvalue().splitlines() == [
        "No surveyed photo has an accepted answer, so there is nothing to compare.",
        "Photos without an accepted answer do not count: a.jpg.",
    ]


def test_state_and_doubt_are_those_of_the_best_track() -> None:
    far = accepted(60.0, 0.0)
    first, second, third = (photo(f"{name}.jpg", far) for name in "abc")
    first.tag = second.tag = third.tag = np.zeros(2)
    second.by_hand = accepted(0.0, 0.0, homography=LAID)
    third.stages = {"sequence": far}
    located = flight(first, second, third)
    surveyed = [SurveyedPosition(f"{name}.jpg", 0.0, 0.0, point) for name in "abc" for point in ("camera", "ground")]
    rows = compared(located, surveyed)
    of_best = [(point["stage"], point["state"], point["doubt"]) for point in best_track(located)]
    of_photos = [("registration", "contradicted", "tag"), ("by hand", "accepted", ""), ("sequence", "accepted", "tag")]
    assert of_best == of_photos
    assert [(row.stage, row.state, row.doubt) for row in rows[::2]] == of_best
    remarks = survey_remarks(rows, 3)
    assert remarks[0] == "Contradicted by other answers, and counted all the same: a.jpg, c.jpg."
    assert [remark[:26] for remark in remarks[1:]] == ["Surveyed positions of the "]


def test_names_are_found_by_path_then_folders_then_name_then_stem() -> None:
    names = ["1.JPG", "A/1.JPG", "B/1.JPG", "B/1.png", "2.JPG", "B/3.JPG", "IMG.4.jpg"]

    def number(name: str) -> int:
        (found,) = match_surveyed(names, [SurveyedPosition(name, 0.0, 0.0, "camera")], BASEMAP)[0]
        return found

    found = {"1.JPG": 0, "1.jpg": 0, "B/1.JPG": 2, "C:\\flights\\b\\1.jpg": 2, "A/1": 1, "photos/2.tif": 4, "3": 5}
    found["IMG.4"] = 6
    assert {name: number(name) for name in found} == found
    with pytest.raises(InputError, match=r"None of the 1 surveyed photos, the first being A/3\.JPG"):
        number("A/3.JPG")
    for name, either in (("B/1", "B/1.JPG or B/1.png"), ("1", "1.JPG or A/1.JPG")):
        with pytest.raises(InputError, match=rf"The surveyed photo {name} may be {either} of the flight"):
            number(name)


def test_positions_of_another_place_and_second_ones_are_refused() -> None:
    with pytest.raises(InputError, match=r"a\.jpg has two surveyed positions of its camera"):
        match_surveyed(["a.jpg"], [SurveyedPosition("a.jpg", 0.0, 0.0, "camera")] * 2, BASEMAP)
    with pytest.raises(InputError, match=r"lie 456 km from the map in the median; check their CRS"):
        match_surveyed(["a.jpg"], [SurveyedPosition("a.jpg", 457_000.0, 0.0, "ground")], BASEMAP)
