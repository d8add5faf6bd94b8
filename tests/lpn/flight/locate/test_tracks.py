"""Tracks read back from their files."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest

from lpn.core.errors import InputError, OutputError
from lpn.flight.locate.tracks import TrackPoint, write_track

POINTS = [
    TrackPoint("a & <b>.jpg", "registration", "accepted", "", 1.4e9, 46.5, -91.25, True, 1.5, None, 40.0, 2.0),
    TrackPoint("c\x07.jpg", "registration", "refused", "Only 4 of 90 matches agree.", 1.4e9 + 2.5),
    TrackPoint("d.jpg", "registration", "accepted", "", 1.4e9 + 5, 46.5001, -91.2501, False, float("nan")),
    TrackPoint("d.jpg", "retrieval", "not verified", "", 12.0, 46.6, -91.3),
    TrackPoint("e.jpg", "retrieval", "not verified", "", 13.0, 46.6, -91.4),
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


def test_gpx_has_accepted_positions_by_stage(tmp_path: Path) -> None:
    write_track(tmp_path / "track.gpx", "monday", POINTS)
    space = {"g": "http://www.topografix.com/GPX/1/1", "lpn": "urn:lpn-explorer:track"}
    root = ElementTree.parse(tmp_path / "track.gpx").getroot()
    tracks = {track.findtext("g:name", "", space): track for track in root.findall("g:trk", space)}
    assert list(tracks) == ["monday: registration", "monday: retrieval (not verified)"]
    first, second = tracks["monday: registration"].findall(".//g:trkpt", space)
    assert (first.get("lat"), first.get("lon")) == ("46.5", "-91.25")
    assert first.findtext("g:name", "", space) == "a & <b>.jpg"
    assert first.findtext("g:time", "", space) == "2014-05-13T16:53:20.000Z"
    assert first.findtext(".//lpn:radius", "", space) == "1.50"
    assert second.find(".//lpn:radius", space) is None
    assert [point.findtext(".//lpn:camera", "", space) for point in (first, second)] == ["true", "false"]
    guess = tracks["monday: retrieval (not verified)"]
    assert guess.findtext(".//lpn:state", "", space) == "not verified"
    # 12 seconds since the start of a video are no time of day.
    assert guess.find(".//g:time", space) is None


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
    points = [replace(POINTS[0], radius_confirmed="no"), POINTS[2]]
    for suffix in (".csv", ".geojson", ".gpx", ".kml"):
        write_track(tmp_path / f"track{suffix}", "monday", points)
    rows = list(csv.DictReader((tmp_path / "track.csv").read_text("utf-8-sig").splitlines()))
    assert [row["radius_confirmed_by_tags"] for row in rows] == ["no", ""]
    features = json.loads((tmp_path / "track.geojson").read_text())["features"]
    assert [one["properties"]["radius_confirmed_by_tags"] for one in features] == ["no", ""]
    told = (
        ElementTree.parse(tmp_path / "track.gpx")
        .getroot()
        .findall(".//{urn:lpn-explorer:track}radius_confirmed_by_tags")
    )
    assert [one.text for one in told] == ["no"]
    assert (tmp_path / "track.kml").read_text().count("not confirmed by the flight's GPS tags") == 1


def test_csv_is_empty_where_nothing_is_known(tmp_path: Path) -> None:
    write_track(tmp_path / "track.csv", "monday", POINTS)
    with (tmp_path / "track.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["state"] for row in rows] == ["accepted", "refused", "accepted", "not verified", "not verified"]
    assert [row["point"] for row in rows] == ["camera", "", "ground", "ground", "ground"]
    assert [row["time_utc"] for row in rows[:2]] == ["2014-05-13T16:53:20.000Z", "2014-05-13T16:53:22.500Z"]
    assert [row["seconds"] for row in rows] == ["", "", "", "12.0", "13.0"], "seconds of a video are no time of day"
    assert "pose_pitch_deg" not in rows[0], "no frame has a pose"
    assert not {"misfit_median_m", "easting_m", "note", "doubt"} & rows[0].keys()
    assert rows[1]["latitude"] == ""
    assert float(rows[0]["longitude"]) == -91.25
    assert rows[2]["radius_on_map_m"] == ""


def test_a_doubt_stands_in_state_and_column_and_degrees_have_seven_decimals(tmp_path: Path) -> None:
    point = TrackPoint(
        "a.jpg", "registration", "contradicted", "", None, 46.123456789, 7.0, radius=1.024,
        radius_on_earth=6.14, heading=359.97, metres_from_tag=33.41, doubt=("tag", "sequence"), pitch=-88.0,
        note="Further sentences.", easting=512345.678, northing=5112345.6, projection=32632, misfit=6.249, largest_misfit=10.391,
        checked="contradicted",
    )  # fmt: skip
    write_track(tmp_path / "track.csv", "monday", [point])
    with (tmp_path / "track.csv").open(newline="", encoding="utf-8-sig") as file:
        (row,) = csv.DictReader(file)
    figures = ("radius_on_map_m", "radius_on_earth_m", "metres_from_tag", "heading_deg", "pose_pitch_deg")
    assert (row["state"], row["doubt"], row["latitude"]) == ("contradicted", "tag, sequence", "46.1234568")
    assert (row["easting_m"], row["northing_m"], row["projected_crs"]) == ("512345.68", "5112345.6", "EPSG:32632")
    assert row["checked_beside_middle"] == "contradicted"
    assert (row["misfit_median_m"], row["misfit_max_m"], row["note"]) == ("6.25", "10.39", "Further sentences.")
    assert [float(row[name]) for name in figures] == [1.02, 6.14, 33.4, 0.0, -88.0], "a heading is below 360"


def test_another_suffix_is_refused_and_nothing_is_left_behind(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"track\.shp; expected a name that ends in \.geojson, \.gpx, \.kml, or \.csv"):
        write_track(tmp_path / "track.shp", "monday", POINTS)
    (tmp_path / "file").touch()
    with pytest.raises(OutputError):
        write_track(tmp_path / "file" / "track.csv", "monday", POINTS)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
