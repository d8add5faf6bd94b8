"""The rows of a flight's track, their files, and the command's summary of it."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from xml.etree import ElementTree

import numpy as np
import pytest
from rich.console import Console

from lpn.core.errors import InputError, OutputError
from lpn.flight.commands.locate import print_summary
from lpn.flight.files import Flight, Frame
from lpn.flight.locate.agreement import MapAgreement
from lpn.flight.locate.located import LocatedFlight, LocatedFrame, StageRecord
from lpn.flight.locate.registered_stage import with_map_error
from lpn.flight.locate.tracks import TrackRow, best_track, full_track, write_track
from lpn.flight.maps import LocalFrame, Map

# A degree east of the middle of UTM zone 15, whose grid is turned by 0.7 degrees there.
ORIGIN = LocalFrame(46.8, -92.0)
BASEMAP = cast(Map, SimpleNamespace(frame=ORIGIN, name="town", elevation=None))


def flight(**frames: LocatedFrame) -> LocatedFlight:
    of_flight = Flight("monday", tuple(one.frame for one in frames.values()))
    return LocatedFlight(of_flight, BASEMAP, list(frames.values()), None, [], None)


def photo(name: str, tag: tuple[float, float] | None, **others: object) -> LocatedFrame:
    answer = StageRecord("accepted", "It agrees.", 0.0, 1000.0, radius=1.0, width=50.0, **others)  # type: ignore[arg-type]
    place = None if tag is None else np.array(tag)
    return LocatedFrame(Frame(name, Path(name), 80, 60), place, {"registration": answer})


NEAR, FAR, UNTAGGED = photo("a.jpg", (0.0, 999.0)), photo("b.jpg", (0.0, 0.0)), photo("c.jpg", None)
REFUSED = LocatedFrame(Frame("d.jpg", Path("d.jpg"), 80, 60), None, {"registration": StageRecord("refused", "No.")})


def test_differences_from_the_tag_are_along_the_grid_of_the_eastings() -> None:
    located = flight(a=photo("a.jpg", (0.0, 0.0)))
    (point,) = full_track(located)
    (there,) = ORIGIN.utm([(0.0, 0.0)])
    off = (point["easting_m"] - there[0], point["northing_m"] - there[1])
    assert (point["east_from_tag_m"], point["north_from_tag_m"]) == off
    assert point["east_from_tag_m"] == pytest.approx(-12.7, abs=0.3), "the grid is turned against the map's frame"
    assert point["metres_from_tag"] == 1000.0


def test_a_track_says_which_photos_were_checked_beside_their_middle() -> None:
    def compared(rows: int, east: float) -> MapAgreement:
        return MapAgreement([(0.1, 0.1, east, 0.0)] * rows, 8.0)

    agreements = {"a": compared(3, 0.5), "b": compared(2, 0.5), "c": compared(3, 5.0), "d": None}
    located = flight(**{name: photo(name, None, agreement=one) for name, one in agreements.items()}, e=REFUSED)
    for track in (full_track(located), best_track(located)):
        assert [point["checked_beside_middle"] for point in track] == ["yes", "no", "contradicted", "no", ""]


@pytest.mark.parametrize(
    ("frames", "prior", "told"),
    [
        ((NEAR, FAR, REFUSED), None, ["no", "no", ""]),
        ((NEAR, UNTAGGED), None, ["yes", "yes"]),
        ((UNTAGGED,), None, [""]),
        # Tags that the search used refute radii, and confirm none.
        ((NEAR,), 30.0, [""]),
        ((NEAR, FAR), 30.0, ["no", "no"]),
    ],
)
def test_a_track_says_if_the_tags_of_the_flight_confirm_its_radii(
    frames: tuple[LocatedFrame, ...], prior: float | None, told: list[str]
) -> None:
    located = replace(flight(**{one.frame.name: one for one in frames}), prior=prior)
    for track in (full_track(located), best_track(located)):
        assert [point.get("radius_confirmed_by_tags", "") for point in track] == told


@pytest.mark.parametrize(
    ("place_error", "told"),
    [
        (0.0, "on the map is ± 1.2 m (1 sigma along each axis), of which ± 0.8 m are assumed for the map."),
        (0.75, "on earth is ± 1.2 m (1 sigma along each axis), of which ± 0.8 m are the error of the map's place."),
    ],
)
def test_the_radii_of_camera_and_middle_have_the_error_of_the_map(place_error: float, told: str) -> None:
    answer = photo("a.jpg", None, camera=True, middle_radius=1.0).stages["registration"]
    found = with_map_error(answer, 0.75, place_error)
    assert (found.radius, found.middle_radius, found.map_error) == (1.25, 1.25, 0.75)
    assert found.sentence.endswith(f"The error of the camera's place {told}")


def test_the_percentiles_of_errors_are_bounds_and_so_rounded_up() -> None:
    photos = {f"{i}": photo(f"{i}.jpg", (0.0, 999.0 - 0.101 * i)) for i in range(21)}
    print_summary(flight(**photos), Console(file=(written := io.StringIO()), width=140))
    (row,) = (line for line in written.getvalue().splitlines() if "registration" in line and "│" in line)
    # Errors are 1 m and more, in steps of 0.101 m: 2.01 m, 2.818 m, and 2.919 m.
    assert [cell.strip() for cell in row.split("│")[3:6]] == ["2.0", "2.9", "3.0"]
    assert "p90 and p95 are bounds, and so rounded up" in written.getvalue()


def test_where_tags_lag_the_errors_without_the_lag_come_first() -> None:
    late = flight(a=photo("a.jpg", (0.0, 990.0)), b=photo("b.jpg", (0.0, 990.0)))
    late.tags_without_lag = np.array([(0.0, 998.0), (np.nan, np.nan)])
    print_summary(late, Console(file=(written := io.StringIO()), width=140))
    lines = [line for line in written.getvalue().splitlines() if "tags" in line]
    first, second = ([cell.strip() for cell in line.split("│")[1:4]] for line in lines[:2])
    assert first == ["registration, tags without their lag", "2", "2.0"]
    assert second == ["registration, tags unchanged", "2", "10.0"]


def test_without_a_truth_no_share_is_told() -> None:
    print_summary(flight(a=photo("a.jpg", None)), Console(file=(written := io.StringIO()), width=140))
    (row,) = (line for line in written.getvalue().splitlines() if "registration" in line)
    assert [cell.strip() for cell in row.split("│")[2:-1]] == ["1", *["-"] * 7]
    assert "the errors of the places are unknown" in written.getvalue()


def at(frame: str, latitude: float | None, longitude: float | None, **known: Any) -> TrackRow:
    told: dict[str, Any] = {"stage": "registration", "state": "accepted"}
    if latitude is not None:
        told |= {"point": "ground", "crs": "EPSG:4326"}
    return {"frame": frame, "latitude": latitude, "longitude": longitude, **told, **known}


GUESS = {"stage": "retrieval", "state": "not verified"}
POINTS = [
    at("a & <b>.jpg", 46.5, -91.25, point="camera", radius_on_map_m=1.5, radius_confirmed_by_tags="no"),
    at("c\x07.jpg", None, None, state="refused", reason="Only 4 of 90 matches agree."),
    at("d.jpg", 46.5001, -91.2501, radius_on_map_m=float("nan")),
    at("d.jpg", 46.6, -91.3, seconds=12.0, **GUESS),
    at("e.jpg", 46.6, -91.4, seconds=13.0, **GUESS),
]


def test_csv_and_geojson_have_the_same_columns_and_rows(tmp_path: Path) -> None:
    for suffix in (".csv", ".geojson"):
        write_track(tmp_path / f"track{suffix}", "monday", POINTS)
    rows = list(csv.DictReader((tmp_path / "track.csv").read_text("utf-8-sig").splitlines()))
    features = json.loads((tmp_path / "track.geojson").read_text())["features"]
    assert [one["geometry"] and one["geometry"]["coordinates"] for one in features[:2]] == [[-91.25, 46.5], None]
    assert (rows[0]["longitude"], rows[1]["latitude"]) == ("-91.25", "")
    expected = {
        "state": ["accepted", "refused", "accepted", "not verified", "not verified"],
        "point": ["camera", "", "ground", "ground", "ground"],
        "crs": ["EPSG:4326", "", *["EPSG:4326"] * 3],
        "radius_on_map_m": [1.5, None, None, None, None],
        "radius_confirmed_by_tags": ["no", "", "", "", ""],
        "reason": ["", "Only 4 of 90 matches agree.", "", "", ""],
    }
    for column, values in expected.items():
        assert [one["properties"][column] for one in features] == values
        assert [row[column] for row in rows] == ["" if value is None else str(value) for value in values]
    columns = {"latitude", "longitude", *features[0]["properties"]}
    assert rows[0].keys() == columns
    assert columns == {"latitude", "longitude", "frame", "stage", "seconds", *expected}, "others have no value"


def test_kml_lists_refused_frames_with_their_reason(tmp_path: Path) -> None:
    write_track(tmp_path / "track.kml", "monday", POINTS)
    space = {"k": "http://www.opengis.net/kml/2.2"}
    root = ElementTree.parse(tmp_path / "track.kml").getroot()
    marks = {mark.findtext("k:name", "", space): mark for mark in root.findall(".//k:Placemark", space)}
    refused = marks["c?.jpg (refused)"]
    assert refused.findtext("k:description", "", space) == "Only 4 of 90 matches agree."
    assert refused.find("k:Point", space) is None
    described = marks["a & <b>.jpg"].findtext("k:description", "", space)
    assert "The position is the camera." in described
    assert "not confirmed by the flight's GPS tags" in described
    assert "The position is the middle of the picture" in marks["d.jpg"].findtext("k:description", "", space)
    assert {"e.jpg (not verified)", "retrieval: track (not verified)"} <= marks.keys()
    assert marks["a & <b>.jpg"].findtext(".//k:coordinates", "", space) == "-91.25,46.5"
    assert marks["registration: track"].findtext(".//k:coordinates", "", space) == "-91.25,46.5 -91.2501,46.5001"


def test_figures_have_the_digits_of_their_columns(tmp_path: Path) -> None:
    point = at(
        "a.jpg", 46.123456789, 7.0, heading_deg=359.97, metres_from_tag=33.41, pose_pitch_deg=-88.004,
        easting_m=512345.678, pose_sigma_yaw_deg=0.12345,
    )  # fmt: skip
    write_track(tmp_path / "track.csv", "monday", [point])
    with (tmp_path / "track.csv").open(newline="", encoding="utf-8-sig") as file:
        (row,) = csv.DictReader(file)
    told = {"latitude": 46.1234568, "heading_deg": 0.0, "metres_from_tag": 33.4, "pose_pitch_deg": -88.0}
    told |= {"easting_m": 512345.68, "pose_sigma_yaw_deg": 0.123}
    assert {name: float(row[name]) for name in told} == told, "a heading is below 360"


def test_a_time_of_a_video_is_no_time_of_day() -> None:
    answer = StageRecord("refused", "No.")
    frames = [Frame(f"{i}.jpg", Path(f"{i}.jpg"), 8, 6, time) for i, time in enumerate((1.4e9 + 2.5, 12.0, None))]
    track = full_track(flight(**{one.name: LocatedFrame(one, None, {"registration": answer}) for one in frames}))
    told = [(one.get("time_utc"), one.get("seconds")) for one in track]
    assert told == [("2014-05-13T16:53:22.500Z", None), (None, 12.0), (None, None)]


def test_another_suffix_is_refused_and_nothing_is_left_behind(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"track\.shp; expected a name that ends in \.geojson, \.kml, or \.csv"):
        write_track(tmp_path / "track.shp", "monday", POINTS)
    (tmp_path / "file").touch()
    with pytest.raises(OutputError):
        write_track(tmp_path / "file" / "track.csv", "monday", POINTS)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
