"""Tracks of located frames as GeoJSON, GPX, KML, or CSV, each written whole or not at all.

A CSV has a column for each property of a GeoJSON's point, and latitude and longitude; docs/flights.md tells what they mean.
A column in which no point has a value is left out, but for the frame, its state, its place, and the reason.
"""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

from lpn.core.csv_cells import csv_bytes
from lpn.core.files import check_ending, json_bytes, portable, printable, write_atomic
from lpn.core.numbers import SIGMA, heading_figure
from lpn.drawing import theme

SUFFIXES = (".geojson", ".gpx", ".kml", ".csv")
# A time under this value is counted from the start of a video; it is not a UTC epoch.
_FIRST_EPOCH = 10**8
_GPX = "http://www.topografix.com/GPX/1/1"
_OURS = "urn:lpn-explorer:track"
_KML = "http://www.opengis.net/kml/2.2"
# The six degrees of a pose in the order of its covariance.
POSE_AXES = ("east", "north", "up", "yaw", "pitch", "roll")
# "not verified" is a position that nothing has checked against the picture: the best guess of the retrieval.
State = Literal["accepted", "refused", "not verified"]
# "contradicted" is an accepted position that lies too far from the frame's tag, or from its neighbours' answer, for their errors.
TrackState = State | Literal["contradicted"]


@dataclass(frozen=True)
class TrackPoint:
    """One stage's answer for one frame.

    Attributes:
        frame: name of the frame.
        stage: "retrieval", "sequence", "registration", or "by hand" for a person's correction.
        state: "accepted" if the position may be used, "contradicted" if the verdict of all stages doubts it, "refused" if it may
            not be used, "not verified" if the stage cannot tell.
        reason: in one short sentence why it was refused, or on what it rests.
        time: seconds, UTC epoch where known; None if unknown.
        latitude, longitude: WGS 84 degrees; None without a position.
        camera: whether they are the camera's; otherwise those of the picture's middle on the ground.
        radius: 1-sigma radius in metres on this map; None if unknown.
        radius_on_earth: the same with the error of the map's place on earth; None where the map does not tell it.
        radius_confirmed: "yes" if the GPS tags of the flight lie within three radii of this stage as often as they should,
            "no" if not; "" without a radius, or where no tag tells.
        heading: of the picture's top, degrees clockwise from north; None if unknown.
        metres_from_tag: metres from the position to the tag in the frame's file; None without one of them.
        east_from_tag, north_from_tag: position minus tag along the axes of the projected system.
        tag_latitude, tag_longitude: of that tag in degrees; None without one.
        doubt: the answers that contradict this one, "tag", stages, or "map": what the map has away from the photo's middle.
        note: further sentences.
        easting, northing, projection: metres in the projected system of an EPSG code; None without a position.
        misfit, largest_misfit: median and most of the metres from places away from the photo's middle to where the map has them;
            None where they were not compared, or too few tell.
        checked: "yes" if places beside a registered photo's middle lie where the map has them, "contradicted" if not, "no" if
            too few were found to tell; "" for other answers.
        pose_latitude, pose_longitude: of the camera by its pose, in degrees; None without one.
        altitude: of the camera by its pose, metres above the datum of the map's elevation; None without one.
        height: of the camera by its pose, metres above ground; None where that is unknown.
        yaw, pitch, roll: of the camera by its pose, in degrees; a pitch of -90 looks straight down, one below it beyond that.
        fov: horizontal field of view of the pose in degrees.
        sigma_east, sigma_north, sigma_up: 1-sigma errors of the pose in metres, without the map's own.
        sigma_yaw, sigma_pitch, sigma_roll: 1-sigma errors of the pose in degrees.
    """

    frame: str
    stage: str
    state: TrackState
    reason: str
    time: float | None = None
    latitude: float | None = None
    longitude: float | None = None
    camera: bool = False
    radius: float | None = None
    radius_on_earth: float | None = None
    heading: float | None = None
    metres_from_tag: float | None = None
    doubt: tuple[str, ...] = ()
    note: str = ""
    easting: float | None = None
    northing: float | None = None
    projection: int | None = None
    misfit: float | None = None
    largest_misfit: float | None = None
    east_from_tag: float | None = None
    north_from_tag: float | None = None
    tag_latitude: float | None = None
    tag_longitude: float | None = None
    checked: Literal["yes", "no", "contradicted", ""] = ""
    pose_latitude: float | None = None
    pose_longitude: float | None = None
    altitude: float | None = None
    height: float | None = None
    yaw: float | None = None
    pitch: float | None = None
    roll: float | None = None
    fov: float | None = None
    sigma_east: float | None = None
    sigma_north: float | None = None
    sigma_up: float | None = None
    sigma_yaw: float | None = None
    sigma_pitch: float | None = None
    sigma_roll: float | None = None
    radius_confirmed: Literal["yes", "no", ""] = ""


# Columns that each file has; another one is left out where nothing is known.
_ALWAYS = ("frame", "stage", "state", "latitude", "longitude", "reason")
# The entries of a pose by their columns, and the digits behind the point.
_POSE_COLUMNS = {
    "pose_latitude": ("pose_latitude", 7),
    "pose_longitude": ("pose_longitude", 7),
    "altitude": ("pose_altitude_m", 2),
    "height": ("pose_height_m", 2),
    "yaw": ("pose_yaw_deg", 2),
    "pitch": ("pose_pitch_deg", 2),
    "roll": ("pose_roll_deg", 2),
    "fov": ("pose_fov_deg", 2),
    **{f"sigma_{axis}": (f"pose_sigma_{axis}_m", 2) for axis in POSE_AXES[:3]},
    **{f"sigma_{axis}": (f"pose_sigma_{axis}_deg", 3) for axis in POSE_AXES[3:]},
}


def check_suffix(path: Path) -> None:
    """Raise InputError unless the format of a track is known by its suffix."""
    check_ending(path, *SUFFIXES)


def write_track(path: Path, name: str, points: Sequence[TrackPoint]) -> None:
    """Write a track in the format of its suffix.

    GPX leaves refused positions out; the others have every frame of every stage. A stage's positions that are not verified are a
    line of their own in GPX and KML, whose name says so.

    Args:
        name: of the flight.
        points: in the order of time, stage by stage or frame by frame.

    Raises:
        InputError: for another suffix.
        OutputError: if the file cannot be written.
    """
    check_suffix(path)
    write_atomic(path, track_bytes(path.suffix.lower(), name, points))


def track_bytes(suffix: str, name: str, points: Sequence[TrackPoint]) -> bytes:
    """Return a track as a file in the format of one of `SUFFIXES`, see `write_track`."""
    if suffix == ".csv":
        return _csv(points)
    return {".geojson": _geojson, ".gpx": _gpx, ".kml": _kml}[suffix](name, points)


def _geojson(name: str, points: Sequence[TrackPoint]) -> bytes:
    """Return a FeatureCollection (RFC 7946) with a feature per frame and stage, all of the same properties."""
    features: list[dict[str, Any]] = []
    columns, rows = _table(points)
    for point, row in zip(points, rows, strict=True):
        properties = {name: row[name] for name in columns if name not in ("latitude", "longitude")}
        geometry = None if point.latitude is None else {"type": "Point", "coordinates": _position(point)}
        features.append({"type": "Feature", "geometry": geometry, "properties": properties})
    collection = {"type": "FeatureCollection", "name": name, "features": features}
    return json_bytes(collection)


def _gpx(name: str, points: Sequence[TrackPoint]) -> bytes:
    """Return GPX 1.1: a track per stage and state. The radius is an extension, because GPX has no accuracy in metres."""
    ElementTree.register_namespace("", _GPX)
    ElementTree.register_namespace("lpn", _OURS)
    root = ElementTree.Element(f"{{{_GPX}}}gpx", {"version": "1.1", "creator": "lpn locate"})
    for (stage, state), chosen in _lines(points).items():
        track = ElementTree.SubElement(root, f"{{{_GPX}}}trk")
        ElementTree.SubElement(track, f"{{{_GPX}}}name").text = printable(f"{name}: {stage}") + _remark(state)
        segment = ElementTree.SubElement(track, f"{{{_GPX}}}trkseg")
        for point in chosen:
            longitude, latitude = _position(point)
            place = {"lat": _decimal(latitude), "lon": _decimal(longitude)}
            entry = ElementTree.SubElement(segment, f"{{{_GPX}}}trkpt", place)
            if (moment := _moment(point.time)) is not None:
                ElementTree.SubElement(entry, f"{{{_GPX}}}time").text = moment
            ElementTree.SubElement(entry, f"{{{_GPX}}}name").text = printable(point.frame)
            ElementTree.SubElement(entry, f"{{{_GPX}}}desc").text = printable(_told(point))
            extensions = ElementTree.SubElement(entry, f"{{{_GPX}}}extensions")
            ElementTree.SubElement(extensions, f"{{{_OURS}}}state").text = state
            ElementTree.SubElement(extensions, f"{{{_OURS}}}camera").text = str(point.camera).lower()
            for key, value in (("radius", point.radius), ("radius_on_earth", point.radius_on_earth)):
                if value is not None and math.isfinite(value):
                    ElementTree.SubElement(extensions, f"{{{_OURS}}}{key}").text = f"{value:.2f}"
            if point.radius_confirmed:
                ElementTree.SubElement(extensions, f"{{{_OURS}}}radius_confirmed_by_tags").text = point.radius_confirmed
    return _xml(root)


def _kml(name: str, points: Sequence[TrackPoint]) -> bytes:
    """Return KML 2.2: a folder per stage with its lines, and a placemark per frame, refused frames included.

    A description is HTML, which viewers run, so that its text is escaped as HTML, too. A name is plain text.
    """
    ElementTree.register_namespace("", _KML)
    root = ElementTree.Element(f"{{{_KML}}}kml")
    document = ElementTree.SubElement(root, f"{{{_KML}}}Document")
    ElementTree.SubElement(document, f"{{{_KML}}}name").text = printable(name)
    lines = _lines(points)
    for stage in dict.fromkeys(point.stage for point in points):
        folder = ElementTree.SubElement(document, f"{{{_KML}}}Folder")
        ElementTree.SubElement(folder, f"{{{_KML}}}name").text = stage
        for (_, state), chosen in ((key, line) for key, line in lines.items() if key[0] == stage and len(line) > 1):
            line = ElementTree.SubElement(folder, f"{{{_KML}}}Placemark")
            ElementTree.SubElement(line, f"{{{_KML}}}name").text = f"{stage}: track" + _remark(state)
            style = ElementTree.SubElement(ElementTree.SubElement(line, f"{{{_KML}}}Style"), f"{{{_KML}}}LineStyle")
            ElementTree.SubElement(style, f"{{{_KML}}}color").text = _kml_colour(stage)
            ElementTree.SubElement(style, f"{{{_KML}}}width").text = "2"
            string = ElementTree.SubElement(line, f"{{{_KML}}}LineString")
            ElementTree.SubElement(string, f"{{{_KML}}}coordinates").text = " ".join(map(_coordinates, chosen))
        for point in points:
            if point.stage != stage:
                continue
            mark = ElementTree.SubElement(folder, f"{{{_KML}}}Placemark")
            ElementTree.SubElement(mark, f"{{{_KML}}}name").text = printable(point.frame) + _remark(point.state)
            radius, unconfirmed = "", _unconfirmed(point)
            for where, value in (("this map", point.radius), ("earth", point.radius_on_earth)):
                if value is not None and math.isfinite(value):
                    radius += f" The radius on {where} is {value:.1f} m ({SIGMA}){unconfirmed}."
            description = html.escape(printable(_told(point) + _figures(point) + radius).strip(), quote=False)
            ElementTree.SubElement(mark, f"{{{_KML}}}description").text = description
            if (moment := _moment(point.time)) is not None:
                stamp = ElementTree.SubElement(mark, f"{{{_KML}}}TimeStamp")
                ElementTree.SubElement(stamp, f"{{{_KML}}}when").text = moment
            if point.latitude is not None:
                place = ElementTree.SubElement(mark, f"{{{_KML}}}Point")
                ElementTree.SubElement(place, f"{{{_KML}}}coordinates").text = _coordinates(point)
    return _xml(root)


def _csv(points: Sequence[TrackPoint]) -> bytes:
    """Return a table with a row per frame and stage; unknown values are empty."""
    columns, rows = _table(points)
    return csv_bytes([columns, *([portable(row[name]) for name in columns] for row in rows)])


def _table(points: Sequence[TrackPoint]) -> tuple[list[str], list[dict[str, Any]]]:
    """Return the columns of some points, without those in which nothing is known, and the rows with all columns."""
    rows = [_row(point) for point in points]
    known = {name for row in rows for name, value in row.items() if value not in (None, "")}
    return [name for name in _row(TrackPoint("", "", "refused", "")) if name in known or name in _ALWAYS], rows


def _unconfirmed(point: TrackPoint) -> str:
    return ", not confirmed by the flight's GPS tags" if point.radius_confirmed == "no" else ""


def _told(point: TrackPoint) -> str:
    """Return reason and note in one text."""
    return " ".join(filter(None, (point.reason, point.note)))


def _row(point: TrackPoint) -> dict[str, Any]:
    """Return a point by the columns of the files."""
    known = point.latitude is not None
    longitude, latitude = _position(point) if known else (None, None)
    moment = _moment(point.time)
    return {
        "frame": point.frame,
        "stage": point.stage,
        "state": point.state,
        "doubt": ", ".join(point.doubt),
        "point": ("camera" if point.camera else "ground") if known else "",
        "latitude": latitude,
        "longitude": longitude,
        "crs": "EPSG:4326" if known else "",
        "easting_m": _rounded(point.easting, 2),
        "northing_m": _rounded(point.northing, 2),
        "projected_crs": "" if point.projection is None else f"EPSG:{point.projection}",
        "radius_on_map_m": _rounded(point.radius, 2),
        "radius_on_earth_m": _rounded(point.radius_on_earth, 2),
        "radius_confirmed_by_tags": point.radius_confirmed,
        "checked_beside_middle": point.checked,
        "misfit_median_m": _rounded(point.misfit, 2),
        "misfit_max_m": _rounded(point.largest_misfit, 2),
        "metres_from_tag": _rounded(point.metres_from_tag, 1),
        "east_from_tag_m": _rounded(point.east_from_tag, 2),
        "north_from_tag_m": _rounded(point.north_from_tag, 2),
        "tag_latitude": _rounded(point.tag_latitude, 7),
        "tag_longitude": _rounded(point.tag_longitude, 7),
        "time_utc": moment or "",
        "seconds": None if moment else _rounded(point.time, 3),
        "heading_deg": heading_figure(point.heading),
        **{column: _rounded(getattr(point, name), digits) for name, (column, digits) in _POSE_COLUMNS.items()},
        "reason": point.reason,
        "note": point.note,
    }


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, digits)


def _lines(points: Sequence[TrackPoint]) -> dict[tuple[str, TrackState], list[TrackPoint]]:
    """Return the points with a position that was not refused, by stage and state."""
    lines: dict[tuple[str, TrackState], list[TrackPoint]] = {}
    for point in points:
        if point.state != "refused" and point.latitude is not None:
            lines.setdefault((point.stage, point.state), []).append(point)
    return lines


def _remark(state: TrackState) -> str:
    return "" if state == "accepted" else f" ({state})"


def _kml_colour(stage: str) -> str:
    """Return the colour of a stage's line as KML has it, aabbggrr."""
    red, green, blue = theme.COLOURS.get(stage.replace(" ", "-"), theme.COLOURS["tag"])
    return f"ff{blue:02x}{green:02x}{red:02x}"


def _figures(point: TrackPoint) -> str:
    """Return a sentence that says which place the position is."""
    if point.latitude is None:
        return ""
    return f" The position is {'the camera' if point.camera else 'the middle of the picture on the ground'}."


def _position(point: TrackPoint) -> tuple[float, float]:
    assert point.longitude is not None
    assert point.latitude is not None
    return round(point.longitude, 7), round(point.latitude, 7)


def _coordinates(point: TrackPoint) -> str:
    longitude, latitude = _position(point)
    return f"{_decimal(longitude)},{_decimal(latitude)}"


def _decimal(degrees: float) -> str:
    """Return degrees without an exponent, which the schemas of GPX and KML do not allow."""
    return f"{degrees:.7f}".rstrip("0").rstrip(".")


def _moment(time: float | None) -> str | None:
    if time is None or not math.isfinite(time) or time < _FIRST_EPOCH:
        return None
    return datetime.fromtimestamp(time, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _xml(root: ElementTree.Element) -> bytes:
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'.encode()
