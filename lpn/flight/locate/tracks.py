"""Tracks of a located flight: a row for each answer, and files of them as GeoJSON, KML, or CSV.

A row has values by the columns' names, see `_COLUMNS`, and docs/locate-a-flight.md explains them; an unknown value is missing. A
CSV has a column for each property of a GeoJSON's point. Empty columns are left out, except for those of `_ALWAYS`.
"""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from lpn.core.csv_cells import csv_bytes
from lpn.core.files import check_ending, json_bytes, portable, printable, write_atomic
from lpn.core.numbers import SIGMA, heading_figure
from lpn.drawing import theme
from lpn.flight.locate.located import BY_HAND, LocatedFlight, LocatedFrame, StageRecord
from lpn.flight.locate.verdict import judge

TrackRow = Mapping[str, Any]
SUFFIXES = (".geojson", ".kml", ".csv")
# A smaller time counts from the start of a video; it is not a UTC epoch.
_FIRST_EPOCH = 10**8
_KML = "http://www.opengis.net/kml/2.2"
# The columns in their order, with the number of their decimals; None for text.
_COLUMNS: dict[str, int | None] = {
    name: digits
    for digits, names in (
        (None, "frame stage state doubt point"),
        (7, "latitude longitude"),
        (None, "crs"),
        (2, "easting_m northing_m"),
        (None, "projected_crs"),
        (2, "radius_on_map_m radius_on_earth_m"),
        (None, "radius_confirmed_by_tags checked_beside_middle"),
        (2, "misfit_median_m misfit_max_m"),
        (1, "metres_from_tag"),
        (2, "east_from_tag_m north_from_tag_m"),
        (7, "tag_latitude tag_longitude"),
        (None, "time_utc"),
        (3, "seconds"),
        (1, "heading_deg"),
        (7, "pose_latitude pose_longitude"),
        (2, "pose_altitude_m pose_height_m"),
        (2, "pose_yaw_deg pose_pitch_deg pose_roll_deg pose_fov_deg"),
        (2, "pose_sigma_east_m pose_sigma_north_m pose_sigma_up_m"),
        (3, "pose_sigma_yaw_deg pose_sigma_pitch_deg pose_sigma_roll_deg"),
        (None, "reason note"),
    )
    for name in names.split()
}
_SIGMAS = [name for name in _COLUMNS if name.startswith("pose_sigma_")]
# The columns of every file.
_ALWAYS = ("frame", "stage", "state", "latitude", "longitude", "reason")


def full_track(flight: LocatedFlight) -> list[TrackRow]:
    """Return the rows of all stages, stage by stage; a correction replaces its frame's registration."""
    verdicts = [judge(located) for located in flight.frames]
    return [
        _row(flight, located, answer, verdict.columns_of(stage, answer))
        for stage in (*flight.stages, BY_HAND)
        for located, verdict in zip(flight.frames, verdicts, strict=True)
        if (answer := located.by_hand if stage == BY_HAND else located.stages.get(stage)) is not None
        and not (stage == "registration" and located.by_hand is not None)
    ]


def best_track(flight: LocatedFlight) -> list[TrackRow]:
    """Return the best answer's row of each frame, with the verdict's state and reason."""
    verdicts = [judge(located) for located in flight.frames]
    return [_row(flight, verdict.located, verdict.answer, verdict.columns) for verdict in verdicts]


def _row(flight: LocatedFlight, located: LocatedFrame, answer: StageRecord, told: Mapping[str, str]) -> TrackRow:
    """Return the row of an answer; `told` are the columns of its verdict."""
    frame, on_map, stage = located.frame, flight.basemap.frame, told["stage"]
    row: dict[str, Any] = {
        "frame": frame.name,
        **told,
        "heading_deg": answer.heading,
        "tag_latitude": frame.latitude,
        "tag_longitude": frame.longitude,
        "radius_on_map_m": answer.radius_on_map,
        "radius_on_earth_m": answer.radius if answer.on_earth else None,
    }
    if (place := answer.place) is not None:
        ((row["latitude"], row["longitude"]),) = on_map.degrees([place]).tolist()
        ((east, north),) = on_map.utm([place]).tolist()
        row |= {
            "point": "camera" if answer.camera else "ground",
            "crs": "EPSG:4326",
            "easting_m": east,
            "northing_m": north,
            "projected_crs": f"EPSG:{on_map.utm_zone}",
        }
        if located.tag is not None:
            tag = on_map.utm([located.tag])[0]
            row |= {"metres_from_tag": answer.distance(located.tag)}
            row |= {"east_from_tag_m": east - tag[0], "north_from_tag_m": north - tag[1]}
    if answer.radius is not None and answer.state != "refused" and stage in flight.radii_confirmed:
        row["radius_confirmed_by_tags"] = "yes" if flight.radii_confirmed[stage] else "no"
    if answer.agreement is not None:
        row |= {"misfit_median_m": answer.agreement.median, "misfit_max_m": answer.agreement.largest}
    if frame.time is not None and math.isfinite(frame.time) and frame.time >= _FIRST_EPOCH:
        moment = datetime.fromtimestamp(frame.time, UTC).isoformat(timespec="milliseconds")
        row["time_utc"] = moment.replace("+00:00", "Z")
    else:
        row["seconds"] = frame.time
    if (pose := answer.pose) is not None:
        ((row["pose_latitude"], row["pose_longitude"]),) = on_map.degrees([(pose.east, pose.north)]).tolist()
        row |= {
            "pose_altitude_m": None if pose.flat else pose.altitude,
            "pose_height_m": pose.height,
            "pose_yaw_deg": pose.heading,
            "pose_pitch_deg": pose.pitch,
            "pose_roll_deg": pose.roll,
            "pose_fov_deg": pose.fov,
            **dict(zip(_SIGMAS, pose.sigmas.tolist(), strict=True)),
        }
    return row


def check_suffix(path: Path) -> None:
    """Raise InputError unless a path has one of `SUFFIXES`."""
    check_ending(path, *SUFFIXES)


def write_track(path: Path, name: str, rows: Sequence[TrackRow]) -> None:
    """Write a track in the format of its suffix, with every frame of every stage.

    Args:
        name: of the flight.
        rows: in the order of time, stage by stage or frame by frame.

    Raises:
        InputError: for another suffix.
        OutputError: if the file cannot be written.
    """
    check_suffix(path)
    write_atomic(path, track_bytes(path.suffix.lower(), name, rows))


def track_bytes(suffix: str, name: str, rows: Sequence[TrackRow]) -> bytes:
    """Return a track as a file in the format of one of `SUFFIXES`, see `write_track`."""
    if suffix == ".kml":
        return _kml(name, rows)
    tidy = [{column: _cell(column, row.get(column)) for column in _COLUMNS} for row in rows]
    columns = [one for one in _COLUMNS if one in _ALWAYS or any(row[one] not in (None, "") for row in tidy)]
    if suffix == ".csv":
        return csv_bytes([columns, *([portable(row[column]) for column in columns] for row in tidy)])
    features = []
    for row in tidy:
        at = [row["longitude"], row["latitude"]]
        geometry = None if None in at else {"type": "Point", "coordinates": at}
        properties = {column: row[column] for column in columns if column not in ("latitude", "longitude")}
        features.append({"type": "Feature", "geometry": geometry, "properties": properties})
    return json_bytes({"type": "FeatureCollection", "name": name, "features": features})


def _cell(column: str, value: Any) -> str | float | None:
    """Return a value with the decimals of its column; "" or None if it is unknown."""
    digits = _COLUMNS[column]
    if digits is None:
        return "" if value is None else str(value)
    if value is None or not math.isfinite(value):
        return None
    return heading_figure(value) if column == "heading_deg" else round(float(value), digits)


def _kml(name: str, rows: Sequence[TrackRow]) -> bytes:
    """Return KML 2.2: a folder per stage with a line per state, and a placemark per frame, refused frames included."""

    def add(parent: ElementTree.Element, tag: str, text: str | None = None) -> ElementTree.Element:
        element = ElementTree.SubElement(parent, f"{{{_KML}}}{tag}")
        element.text = text
        return element

    def placemark(folder: ElementTree.Element, name: str, state: str) -> ElementTree.Element:
        mark = add(folder, "Placemark")
        add(mark, "name", name if state == "accepted" else f"{name} ({state})")
        return mark

    ElementTree.register_namespace("", _KML)
    root = ElementTree.Element(f"{{{_KML}}}kml")
    document = add(root, "Document")
    add(document, "name", printable(name))
    for stage in dict.fromkeys(row["stage"] for row in rows):
        folder, of_stage = add(document, "Folder"), [row for row in rows if row["stage"] == stage]
        add(folder, "name", stage)
        for state in dict.fromkeys(row["state"] for row in of_stage):
            places = [
                _coordinates(row) for row in of_stage if row["state"] == state and row.get("latitude") is not None
            ]
            if state != "refused" and len(places) > 1:
                line = placemark(folder, f"{stage}: track", state)
                style = add(add(line, "Style"), "LineStyle")
                red, green, blue = theme.COLOURS.get(stage.replace(" ", "-"), theme.COLOURS["tag"])
                add(style, "color", f"ff{blue:02x}{green:02x}{red:02x}")
                add(style, "width", "2")
                add(add(line, "LineString"), "coordinates", " ".join(places))
        for row in of_stage:
            mark = placemark(folder, printable(row["frame"]), row["state"])
            # Viewers render descriptions as HTML, and names as plain text.
            add(mark, "description", html.escape(printable(_described(row)), quote=False))
            if row.get("time_utc"):
                add(add(mark, "TimeStamp"), "when", row["time_utc"])
            if row.get("latitude") is not None:
                add(add(mark, "Point"), "coordinates", _coordinates(row))
    ElementTree.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'.encode()


def _described(row: TrackRow) -> str:
    """Return the reason, the note, the kind of place, and its radii."""
    told = [row.get("reason"), row.get("note")]
    if row.get("latitude") is not None:
        place = "the camera" if row.get("point") == "camera" else "the middle of the picture on the ground"
        told.append(f"The position is {place}.")
    unconfirmed = ", not confirmed by the flight's GPS tags" if row.get("radius_confirmed_by_tags") == "no" else ""
    for where, value in (("this map", row.get("radius_on_map_m")), ("earth", row.get("radius_on_earth_m"))):
        if value is not None and math.isfinite(value):
            told.append(f"The radius on {where} is {value:.1f} m ({SIGMA}){unconfirmed}.")
    return " ".join(filter(None, told))


def _coordinates(row: TrackRow) -> str:
    """Return longitude and latitude without an exponent, which KML's schema forbids."""
    return ",".join(f"{degrees:.7f}".rstrip("0").rstrip(".") for degrees in (row["longitude"], row["latitude"]))
