"""Tracks of a located flight: a point for each answer, and files of them as GeoJSON, KML, or CSV.

A CSV has a column for each property of a GeoJSON's point; docs/locate-a-flight.md explains them. Empty columns are left out,
except for those of `_ALWAYS`.
"""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from lpn.core.csv_cells import csv_bytes
from lpn.core.files import check_ending, json_bytes, portable, printable, write_atomic
from lpn.core.numbers import SIGMA, heading_figure
from lpn.drawing import theme
from lpn.flight.locate.belief import best_answers, disagreements, doubts
from lpn.flight.locate.camera_pose import CameraPose
from lpn.flight.locate.located import (
    BY_HAND,
    LocatedFlight,
    LocatedFrame,
    StageRecord,
    TrackState,
    checked_beside_middle,
)
from lpn.flight.maps import Map

SUFFIXES = (".geojson", ".kml", ".csv")
# A smaller time counts from the start of a video; it is not a UTC epoch.
_FIRST_EPOCH = 10**8
_KML = "http://www.opengis.net/kml/2.2"


@dataclass(frozen=True, kw_only=True)
class TrackPoint:
    """One answer for one frame; its fields are the columns of a file, in their order. None and "" are unknown.

    Attributes:
        frame: name of the frame.
        stage: "retrieval", "sequence", "registration", or "by hand" for a person's correction.
        state: "accepted" if the position may be used, "contradicted" if the verdict of all stages doubts it, "refused" if it may
            not be used, "not verified" if the stage cannot tell.
        doubt: the answers that contradict this one: "tag", stages, or "map" for the map away from the photo's middle.
        point: whether the position is the "camera", or the "ground" at the picture's middle.
        latitude, longitude: WGS 84 degrees.
        easting_m, northing_m, projected_crs: metres in a UTM zone.
        radius_on_map_m: 1-sigma radius on this map.
        radius_on_earth_m: the same with the error of the map's place on earth, if known.
        radius_confirmed_by_tags: "yes" if the flight's GPS tags lie within three radii of this stage as often as they should,
            "no" if not.
        checked_beside_middle: "yes" if the map agrees away from a registered photo's middle, "contradicted" if not, "no" if too
            few places were found to tell.
        misfit_median_m, misfit_max_m: offsets of places away from the photo's middle on the map.
        metres_from_tag, east_from_tag_m, north_from_tag_m: position minus the tag in the frame's file, the last two along the
            axes of the UTM zone.
        tag_latitude, tag_longitude: of that tag.
        time_utc: of the frame if it has a date; else `seconds` has its time.
        heading_deg: of the picture's top, clockwise from north.
        pose_latitude, pose_longitude: of the camera by its pose.
        pose_altitude_m: metres above the datum of the map's elevation.
        pose_height_m: metres above ground.
        pose_yaw_deg, pose_pitch_deg, pose_roll_deg: a pitch of -90 looks straight down, and a smaller one beyond that.
        pose_fov_deg: horizontal field of view.
        pose_sigma_east_m to pose_sigma_roll_deg: 1-sigma errors of the pose, without the map's own.
        reason: grounds of the refusal or acceptance in one short sentence.
        note: further sentences.
    """

    frame: str
    stage: str
    state: TrackState
    doubt: str = ""
    point: str = ""
    latitude: float | None = None
    longitude: float | None = None
    crs: str = ""
    easting_m: float | None = None
    northing_m: float | None = None
    projected_crs: str = ""
    radius_on_map_m: float | None = None
    radius_on_earth_m: float | None = None
    radius_confirmed_by_tags: str = ""
    checked_beside_middle: str = ""
    misfit_median_m: float | None = None
    misfit_max_m: float | None = None
    metres_from_tag: float | None = None
    east_from_tag_m: float | None = None
    north_from_tag_m: float | None = None
    tag_latitude: float | None = None
    tag_longitude: float | None = None
    time_utc: str = ""
    seconds: float | None = None
    heading_deg: float | None = None
    pose_latitude: float | None = None
    pose_longitude: float | None = None
    pose_altitude_m: float | None = None
    pose_height_m: float | None = None
    pose_yaw_deg: float | None = None
    pose_pitch_deg: float | None = None
    pose_roll_deg: float | None = None
    pose_fov_deg: float | None = None
    pose_sigma_east_m: float | None = None
    pose_sigma_north_m: float | None = None
    pose_sigma_up_m: float | None = None
    pose_sigma_yaw_deg: float | None = None
    pose_sigma_pitch_deg: float | None = None
    pose_sigma_roll_deg: float | None = None
    reason: str = ""
    note: str = ""


# The columns of every file.
_ALWAYS = ("frame", "stage", "state", "latitude", "longitude", "reason")
# Decimals of columns, where not two.
_DIGITS = {
    **dict.fromkeys(("latitude", "longitude", "tag_latitude", "tag_longitude", "pose_latitude", "pose_longitude"), 7),
    **dict.fromkeys(("seconds", "pose_sigma_yaw_deg", "pose_sigma_pitch_deg", "pose_sigma_roll_deg"), 3),
    "metres_from_tag": 1,
}
_SIGMAS = ("east_m", "north_m", "up_m", "yaw_deg", "pitch_deg", "roll_deg")


def full_track(flight: LocatedFlight) -> list[TrackPoint]:
    """Return the points of all stages, stage by stage; a correction replaces its frame's registration."""
    against = disagreements(flight.frames)
    return [
        _point(flight, located, stage, answer, doubt=doubts(located, [one for one in against if one.frame == i], stage))
        for stage in (*flight.stages, BY_HAND)
        for i, located in enumerate(flight.frames)
        if (answer := located.by_hand if stage == BY_HAND else located.stages.get(stage)) is not None
        and not (stage == "registration" and located.by_hand is not None)
    ]


def best_track(flight: LocatedFlight) -> list[TrackPoint]:
    """Return the best answer's point of each frame, with the verdict's state and reason."""
    points = []
    for located, best in zip(flight.frames, best_answers(flight), strict=True):
        told: dict[str, Any] = {}
        if best.stage != BY_HAND:
            told = {"state": best.state, "reason": best.reason, "note": best.verdict.reason}
        points.append(_point(flight, located, best.stage, best.answer, doubt=best.doubt, **told))
    return points


def _point(
    flight: LocatedFlight,
    located: LocatedFrame,
    stage: str,
    answer: StageRecord,
    doubt: tuple[str, ...],
    **told: Any,
) -> TrackPoint:
    frame, basemap = located.frame, flight.basemap
    values: dict[str, Any] = {"tag_latitude": frame.latitude, "tag_longitude": frame.longitude}
    if answer.x is not None and answer.y is not None:
        at = [(answer.x, answer.y)]
        ((values["latitude"], values["longitude"]),) = basemap.frame.degrees(at).tolist()
        ((east, north),) = basemap.frame.utm(at).tolist()
        values |= {"point": "camera" if answer.camera else "ground", "crs": "EPSG:4326", "easting_m": east}
        values |= {"northing_m": north, "projected_crs": f"EPSG:{basemap.frame.utm_zone}"}
        if located.tag is not None:
            tag = basemap.frame.utm([located.tag])[0]
            values |= {"metres_from_tag": answer.distance(located.tag)}
            values |= {"east_from_tag_m": east - tag[0], "north_from_tag_m": north - tag[1]}
    if answer.radius is not None and answer.state != "refused" and stage in flight.radii_confirmed:
        values["radius_confirmed_by_tags"] = "yes" if flight.radii_confirmed[stage] else "no"
    if answer.agreement is not None:
        values |= {"misfit_median_m": answer.agreement.median, "misfit_max_m": answer.agreement.largest}
    if "map" in doubt:
        values["checked_beside_middle"] = "contradicted"
    elif stage == "registration" and answer.accepted:
        values["checked_beside_middle"] = checked_beside_middle(answer)
    moment = _moment(frame.time)
    told_by = StageRecord(answer.state, located.by_hand_sentence) if stage == BY_HAND else answer
    reason, note = told_by.reason_and_note
    values |= {
        "radius_on_map_m": answer.radius_on_map,
        "radius_on_earth_m": answer.radius if answer.on_earth else None,
        "time_utc": moment or "",
        "seconds": None if moment else frame.time,
        "heading_deg": answer.heading,
        **_of_pose(answer.pose, basemap),
        "state": answer.state,
        "reason": reason,
        "note": note,
    }
    return TrackPoint(frame=frame.name, stage=stage, doubt=", ".join(doubt), **values | told)


def _of_pose(pose: CameraPose | None, basemap: Map) -> dict[str, Any]:
    if pose is None:
        return {}
    latitude, longitude = basemap.frame.degrees([(pose.east, pose.north)])[0].tolist()
    return {
        "pose_latitude": latitude,
        "pose_longitude": longitude,
        "pose_altitude_m": None if pose.flat else pose.altitude,
        "pose_height_m": pose.height,
        "pose_yaw_deg": pose.heading,
        "pose_pitch_deg": pose.pitch,
        "pose_roll_deg": pose.roll,
        "pose_fov_deg": pose.fov,
        **{f"pose_sigma_{name}": sigma for name, sigma in zip(_SIGMAS, pose.sigmas.tolist(), strict=True)},
    }


def check_suffix(path: Path) -> None:
    """Raise InputError unless a path has one of `SUFFIXES`."""
    check_ending(path, *SUFFIXES)


def write_track(path: Path, name: str, points: Sequence[TrackPoint]) -> None:
    """Write a track in the format of its suffix, with every frame of every stage.

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
    if suffix == ".kml":
        return _kml(name, points)
    rows = [_rounded(point) for point in points]
    known = {name for row in rows for name, value in row.items() if value not in (None, "")}
    columns = [one.name for one in fields(TrackPoint) if one.name in known or one.name in _ALWAYS]
    if suffix == ".csv":
        return csv_bytes([columns, *([portable(row[name]) for name in columns] for row in rows)])
    features = []
    for row in rows:
        at = [row["longitude"], row["latitude"]]
        geometry = None if None in at else {"type": "Point", "coordinates": at}
        properties = {name: row[name] for name in columns if name not in ("latitude", "longitude")}
        features.append({"type": "Feature", "geometry": geometry, "properties": properties})
    return json_bytes({"type": "FeatureCollection", "name": name, "features": features})


def _rounded(point: TrackPoint) -> dict[str, Any]:
    row = asdict(point)
    for name, value in row.items():
        if isinstance(value, float):
            row[name] = round(value, _DIGITS.get(name, 2)) if math.isfinite(value) else None
    return row | {"heading_deg": heading_figure(point.heading_deg)}


def _kml(name: str, points: Sequence[TrackPoint]) -> bytes:
    """Return KML 2.2: a folder per stage with its lines, and a placemark per frame, refused frames included.

    Unverified positions have a separate, named line. Viewers render descriptions as HTML, so their text is also escaped as HTML.
    Names are plain text.
    """

    def add(parent: ElementTree.Element, tag: str, text: str | None = None) -> ElementTree.Element:
        element = ElementTree.SubElement(parent, f"{{{_KML}}}{tag}")
        element.text = text
        return element

    ElementTree.register_namespace("", _KML)
    root = ElementTree.Element(f"{{{_KML}}}kml")
    document = add(root, "Document")
    add(document, "name", printable(name))
    for stage in dict.fromkeys(point.stage for point in points):
        folder, of_stage = add(document, "Folder"), [point for point in points if point.stage == stage]
        add(folder, "name", stage)
        lines: dict[TrackState, list[TrackPoint]] = {}
        for point in of_stage:
            if point.state != "refused" and point.latitude is not None:
                lines.setdefault(point.state, []).append(point)
        for state, chosen in lines.items():
            if len(chosen) > 1:
                line = add(folder, "Placemark")
                add(line, "name", f"{stage}: track" + _remark(state))
                style = add(add(line, "Style"), "LineStyle")
                red, green, blue = theme.COLOURS.get(stage.replace(" ", "-"), theme.COLOURS["tag"])
                add(style, "color", f"ff{blue:02x}{green:02x}{red:02x}")
                add(style, "width", "2")
                add(add(line, "LineString"), "coordinates", " ".join(map(_coordinates, chosen)))
        for point in of_stage:
            mark = add(folder, "Placemark")
            add(mark, "name", printable(point.frame) + _remark(point.state))
            add(mark, "description", html.escape(printable(_described(point)), quote=False))
            if point.time_utc:
                add(add(mark, "TimeStamp"), "when", point.time_utc)
            if point.latitude is not None:
                add(add(mark, "Point"), "coordinates", _coordinates(point))
    ElementTree.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'.encode()


def _described(point: TrackPoint) -> str:
    """Return the reason, the note, the kind of place, and its radii."""
    told = [point.reason, point.note]
    if point.latitude is not None:
        place = "the camera" if point.point == "camera" else "the middle of the picture on the ground"
        told.append(f"The position is {place}.")
    unconfirmed = ", not confirmed by the flight's GPS tags" if point.radius_confirmed_by_tags == "no" else ""
    for where, value in (("this map", point.radius_on_map_m), ("earth", point.radius_on_earth_m)):
        if value is not None and math.isfinite(value):
            told.append(f"The radius on {where} is {value:.1f} m ({SIGMA}){unconfirmed}.")
    return " ".join(filter(None, told))


def _remark(state: TrackState) -> str:
    return "" if state == "accepted" else f" ({state})"


def _coordinates(point: TrackPoint) -> str:
    """Return longitude and latitude without an exponent, which KML's schema forbids."""
    assert point.longitude is not None
    assert point.latitude is not None
    return ",".join(f"{degrees:.7f}".rstrip("0").rstrip(".") for degrees in (point.longitude, point.latitude))


def _moment(time: float | None) -> str | None:
    if time is None or not math.isfinite(time) or time < _FIRST_EPOCH:
        return None
    return datetime.fromtimestamp(time, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
