"""Tracks read back from their files."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from xml.etree import ElementTree

import pytest

from lpn.core.errors import InputError, OutputError
from lpn.flight.files import Flight, Frame
from lpn.flight.locate.located import LocatedFlight, LocatedFrame, StageRecord
from lpn.flight.locate.tracks import TrackRow, full_track, write_track
from lpn.flight.maps import LocalFrame, Map


def at(frame: str, latitude: float | None, longitude: float | None, **known: Any) -> TrackRow:
    told: dict[str, Any] = {"stage": "registration", "state": "accepted"}
    if latitude is not None:
        told |= {"point": "ground", "crs": "EPSG:4326"}
    return {"frame": frame, "latitude": latitude, "longitude": longitude, **told, **known}


GUESS = {"stage": "retrieval", "state": "not verified"}
POINTS = [
    at("a & <b>.jpg", 46.5, -91.25, point="camera", radius_on_map_m=1.5, time_utc="2014-05-13T16:53:20.000Z"),
    at("c\x07.jpg", None, None, state="refused", reason="Only 4 of 90 matches agree."),
    at("d.jpg", 46.5001, -91.2501, radius_on_map_m=float("nan")),
    at("d.jpg", 46.6, -91.3, seconds=12.0, **GUESS),
    at("e.jpg", 46.6, -91.4, seconds=13.0, **GUESS),
]


def test_geojson_has_a_feature_a_frame_and_stage_and_nothing_else(tmp_path: Path) -> None:
    write_track(tmp_path / "track.geojson", "monday", POINTS)
    found = json.loads((tmp_path / "track.geojson").read_text())
    assert found["type"] == "FeatureCollection"
    points = found["features"]
    assert len({tuple(point["properties"]) for point in points}) == 1, "all features have the same properties"
    states = ["accepted", "refused", "accepted", "not verified", "not verified"]
    assert [point["properties"]["state"] for point in points] == states
    assert [point["properties"]["point"] for point in points] == ["camera", "", "ground", "ground", "ground"]
    assert {point["properties"]["crs"] for point in points} == {"EPSG:4326", ""}
    assert "easting_m" not in points[0]["properties"], "no point has one"
    assert points[0]["geometry"] == {"type": "Point", "coordinates": [-91.25, 46.5]}
    assert points[0]["properties"]["radius_on_map_m"] == 1.5
    assert points[1]["geometry"] is None
    assert points[1]["properties"]["reason"].startswith("Only 4")
    assert points[2]["properties"]["radius_on_map_m"] is None


def test_kml_lists_refused_frames_with_their_reason(tmp_path: Path) -> None:
    write_track(tmp_path / "track.kml", "monday", POINTS)
    space = {"k": "http://www.opengis.net/kml/2.2"}
    root = ElementTree.parse(tmp_path / "track.kml").getroot()
    marks = {mark.findtext("k:name", "", space): mark for mark in root.findall(".//k:Placemark", space)}
    refused = marks["c?.jpg (refused)"]
    assert refused.findtext("k:description", "", space) == "Only 4 of 90 matches agree."
    assert refused.find("k:Point", space) is None
    assert "The position is the camera." in marks["a & <b>.jpg"].findtext("k:description", "", space)
    assert "The position is the middle of the picture" in marks["d.jpg"].findtext("k:description", "", space)
    assert {"e.jpg (not verified)", "retrieval: track (not verified)"} <= marks.keys()
    assert marks["a & <b>.jpg"].findtext(".//k:coordinates", "", space) == "-91.25,46.5"
    assert marks["registration: track"].findtext(".//k:coordinates", "", space) == "-91.25,46.5 -91.2501,46.5001"


def test_each_format_says_that_the_tags_do_not_confirm_a_radius(tmp_path: Path) -> None:
    points = [{**POINTS[0], "radius_confirmed_by_tags": "no"}, POINTS[2]]
    for suffix in (".csv", ".geojson", ".kml"):
        write_track(tmp_path / f"track{suffix}", "monday", points)
    rows = list(csv.DictReader((tmp_path / "track.csv").read_text("utf-8-sig").splitlines()))
    assert [row["radius_confirmed_by_tags"] for row in rows] == ["no", ""]
    features = json.loads((tmp_path / "track.geojson").read_text())["features"]
    assert [one["properties"]["radius_confirmed_by_tags"] for one in features] == ["no", ""]
    assert (tmp_path / "track.kml").read_text().count("not confirmed by the flight's GPS tags") == 1


def test_csv_is_empty_where_nothing_is_known(tmp_path: Path) -> None:
    write_track(tmp_path / "track.csv", "monday", POINTS)
    with (tmp_path / "track.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["state"] for row in rows] == ["accepted", "refused", "accepted", "not verified", "not verified"]
    assert [row["point"] for row in rows] == ["camera", "", "ground", "ground", "ground"]
    assert "pose_pitch_deg" not in rows[0], "no frame has a pose"
    assert not {"misfit_median_m", "easting_m", "note", "doubt"} & rows[0].keys()
    assert rows[1]["latitude"] == ""
    assert float(rows[0]["longitude"]) == -91.25
    assert rows[2]["radius_on_map_m"] == ""


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
    located = [LocatedFrame(frame, None, {"registration": answer}) for frame in frames]
    basemap = cast(Map, SimpleNamespace(frame=LocalFrame(46.8, -92.0)))
    track = full_track(LocatedFlight(Flight("monday", tuple(frames)), basemap, located, None, [], None))
    assert [(one.get("time_utc"), one.get("seconds")) for one in track] == [
        ("2014-05-13T16:53:22.500Z", None),
        (None, 12.0),
        (None, None),
    ]


def test_another_suffix_is_refused_and_nothing_is_left_behind(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"track\.shp; expected a name that ends in \.geojson, \.kml, or \.csv"):
        write_track(tmp_path / "track.shp", "monday", POINTS)
    (tmp_path / "file").touch()
    with pytest.raises(OutputError):
        write_track(tmp_path / "file" / "track.csv", "monday", POINTS)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
