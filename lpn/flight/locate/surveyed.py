"""A flight's answers against a person's table (CSV) of surveyed positions.

    photo,easting,northing,epsg,point
    DJI_0012.JPG,612345.21,3338010.87,32614,camera

Latitude and longitude may replace easting and northing; their default CRS is WGS 84. `point` is the surveyed point: "camera", or
"ground" for the ground at the photo's middle.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Literal, NamedTuple

import msgspec
import numpy as np

from lpn.core.csv_cells import csv_bytes, unescape
from lpn.core.errors import DataError, InputError
from lpn.core.files import first_few, printable, write_atomic
from lpn.core.lists import mixed_separators, read_text, separated
from lpn.core.numbers import distance
from lpn.flight.files.logs import path_parts
from lpn.flight.locate.camera_place import below_camera
from lpn.flight.locate.errors import Errors
from lpn.flight.locate.located import LocatedFlight, LocatedFrame, StageRecord
from lpn.flight.locate.verdict import judge
from lpn.flight.maps import LocalFrame, Map
from lpn.flight.maps.sources import parse_crs

SurveyedPoint = Literal["camera", "ground"]
# Accepted names of columns, best first.
_COLUMNS = {
    "photo": ("photo", "image", "frame", "file", "filename", "file_name", "name", "label"),
    "latitude": ("latitude", "lat"),
    "longitude": ("longitude", "lon", "lng", "long"),
    "easting": ("easting", "easting_m", "east", "e", "x"),
    "northing": ("northing", "northing_m", "north", "n", "y"),
    "crs": ("crs", "epsg", "projected_crs"),
    "point": ("point",),
}
_DEGREES, _METRES = ("latitude", "longitude"), ("easting", "northing")
_EXPECTED = "expected photo and latitude,longitude or easting,northing,epsg, and, if you like, point (camera or ground)"
# The default CRS of degrees.
_WGS84 = "EPSG:4326"
# Maximum of names in one sentence.
_MOST_NAMES = 10
_RESIDUAL_COLUMNS = (
    *("photo", "point", "answer_is", "stage", "state", "doubt"),
    *("surveyed_easting_m", "surveyed_northing_m", "easting_m", "northing_m", "crs"),
    *("east_m", "north_m", "distance_m", "radius_m", "radii"),
)


class SurveyedPosition(NamedTuple):
    """A surveyed position of a photo: metres east and north in the map's frame, of its camera or of the ground at its middle."""

    photo: str
    x: float
    y: float
    point: SurveyedPoint


# Surveyed positions by the number of their frame in the flight.
MatchedSurvey = Mapping[int, Sequence[SurveyedPosition]]


@dataclass(frozen=True)
class Residual:
    """An answer minus the surveyed position of its photo.

    Attributes:
        photo: the frame's name.
        point: the surveyed point.
        answered: the answer's point, the camera or the ground at the photo's middle; it differs from `point` if the answer has no
            such place. None without an answer.
        stage, state, doubt: of the best answer, as in a track.
        surveyed: metres in the map's frame.
        east, north: metres along the axes of the map's UTM zone, answer minus survey; NaN without an answer.
        radius: 1-sigma radius of the answer in metres, with the map's error; NaN if unknown.
    """

    photo: str
    point: SurveyedPoint
    answered: SurveyedPoint | None
    stage: str
    state: str
    doubt: str
    surveyed: tuple[float, float]
    east: float = math.nan
    north: float = math.nan
    radius: float = math.nan

    @property
    def counts(self) -> bool:
        """True if the answer is accepted, contradicted or not."""
        return self.state in ("accepted", "contradicted")


def read_surveyed(file: Path, frame: LocalFrame, crs: str | None = None) -> list[SurveyedPosition]:
    """Read a table of surveyed positions.

    Args:
        frame: of the map, for the returned metres.
        crs: coordinate reference system of the coordinates, such as EPSG:32614, if no column names it.

    Raises:
        DataError: if the file cannot be read, or is no such table; the message names the line.
        InputError: if a CRS is invalid, does not fit the columns, is given twice, or is missing.
    """
    name = printable(file.name)
    decimal_comma, rows = separated(read_text(file, name), name, strict=True)
    header = _header(next(rows, (0, []))[1], name)
    degrees = "latitude" in header
    photos, points, numbers, systems = list[str](), list[SurveyedPoint](), list[list[float]](), dict[str, str]()
    lines = []
    for number, values in rows:
        line = f"Line {number} of {name}"
        if len(values) <= max(header.values()):
            raise DataError(f"{line} has {len(values)} of the {max(header.values()) + 1} values it needs; complete it.")
        cells = {key: unescape(values[column].strip()) for key, column in header.items()}
        point = cells.get("point", "").lower() or "camera"
        if not cells["photo"]:
            raise DataError(f"{line} has no photo; expected its file name.")
        if point not in ("camera", "ground"):
            raise DataError(f"{line} has the point {printable(point)[:100]!r}; expected camera or ground.")
        # `LocalFrame.from_crs` takes longitude before latitude. Spreadsheets may write EPSG codes as 32614.0.
        keys = _DEGREES[::-1] if degrees else _METRES
        numbers.append([_number(cells[key], key, line, decimal_comma) for key in keys])
        systems.setdefault(cells.get("crs", "").removesuffix(".0"), line)
        photos.append(cells["photo"])
        points.append("ground" if point == "ground" else "camera")
        lines.append(line)
    if not photos:
        raise DataError(f"{name} has no position below its first line; add a line for each photo.")
    placed = frame.from_crs(_system(systems, crs, degrees, name), np.array(numbers))
    if not np.isfinite(placed).all():
        raise DataError(
            f"The CRS of {name} cannot be brought to the map's plane for all positions, from {lines[0]} on; check CRS and "
            "coordinates."
        )
    return [SurveyedPosition(*row) for row in zip(photos, *placed.T.tolist(), points, strict=True)]


def _system(told: Mapping[str, str], crs: str | None, degrees: bool, file: str) -> object:
    """Return the CRS of a table; `told` maps each CRS in its column to its first line."""
    if crs and set(told) != {""}:
        raise InputError(f"{file} tells its CRS in a column; leave --crs out, or take the column away.")
    if len(told) > 1:
        both = " and ".join(f"{printable(one)[:100] or 'none'} ({line})" for one, line in list(told.items())[:2])
        raise DataError(f"{file} has the CRS {both}; expected one for the whole table.")
    text = crs or next(iter(told)) or (_WGS84 if degrees else "")
    if not text:
        raise InputError(
            f"{file} has eastings and northings without their CRS; add a column epsg, or give it, such as --crs EPSG:32614."
        )
    system = parse_crs(text)
    if not (system.is_geographic if degrees else system.is_projected):
        columns, kind, such = ("eastings and northings", "projected", "EPSG:32614")
        if degrees:
            columns, kind, such = ("latitudes and longitudes", "geographic", _WGS84)
        raise InputError(
            f"The CRS {printable(text)[:100]} is not {kind}, and {file} has {columns}; expected one such as {such}."
        )
    return system


def _header(names: Sequence[str], file: str) -> dict[str, int]:
    given = {name.strip().lower(): i for i, name in reversed(list(enumerate(names)))}
    header = {
        key: next(given[one] for one in known if one in given) for key, known in _COLUMNS.items() if {*known} & {*given}
    }
    pairs = [pair for pair in (_DEGREES, _METRES) if {*pair} <= {*header}]
    if len(pairs) > 1:
        both = " and ".join(",".join(names[header[key]].strip() for key in pair) for pair in pairs)
        raise DataError(
            f"The first line of {file} has {printable(both)[:200]}, and only one of the two can be the survey; take the other "
            "one away."
        )
    if "photo" not in header or not pairs:
        found = printable(",".join(names))[:200] or "empty"
        raise DataError(f"The first line of {file} is {found}; {_EXPECTED}.{mixed_separators(names)}")
    other = _METRES if pairs[0] is _DEGREES else _DEGREES
    return {key: column for key, column in header.items() if key not in other}


def _number(text: str, key: str, line: str, decimal_comma: bool) -> float:
    try:
        value = float(text.replace(",", ".", 1) if decimal_comma else text)
    except ValueError:
        value = math.nan
    most = {"latitude": 90.0, "longitude": 180.0}.get(key, math.inf)
    if not (math.isfinite(value) and abs(value) <= most):
        limits = f"degrees from {-most:g} to {most:g}" if math.isfinite(most) else "metres"
        raise DataError(f"{line} has the {key} {printable(text)[:100]!r}; expected {limits}.")
    return value


def match_surveyed(
    names: Sequence[str], surveyed: Sequence[SurveyedPosition], basemap: Map
) -> tuple[MatchedSurvey, str]:
    """Match surveyed positions with frames by the photos' names, with or without folders and a suffix.

    Args:
        names: of the flight's frames, in its order.

    Returns:
        The positions, and a sentence on photos that are not in the flight; "" if all are.

    Raises:
        InputError: if no photo of the flight has a surveyed position, a name fits two photos, a photo has two positions of one
            point, or most positions lie farther off the map than its longer side.
    """
    by_stem: dict[str, set[int]] = {}
    for i, name in enumerate(names):
        by_stem.setdefault(PurePath(path_parts(name)[-1]).stem, set()).add(i)
    by_frame: dict[int, list[SurveyedPosition]] = {}
    strangers: list[str] = []
    for position in surveyed:
        number = _frame_of(position.photo, names, by_stem)
        if number is None:
            strangers.append(position.photo)
            continue
        others = by_frame.setdefault(number, [])
        if any(other.point == position.point for other in others):
            raise InputError(
                f"The photo {printable(position.photo)[:100]} has two surveyed positions of its {position.point}; keep one."
            )
        others.append(position)
    if not by_frame:
        raise InputError(
            f"None of the {len(surveyed)} surveyed photos, the first being {printable(surveyed[0].photo)[:100]}, is in the "
            f"flight, whose first photo is {printable(names[0])}; expected the photos' file names."
        )
    off = [basemap.metres_off(np.array([one.x, one.y])) for group in by_frame.values() for one in group]
    west, south, east, north = basemap.bounds
    if (middle := float(np.median(off))) > max(east - west, north - south):
        raise InputError(
            f"The surveyed positions lie {distance(middle)} from the map in the median; check their CRS, such as the UTM zone, "
            "and that map and survey are of one place."
        )
    listed = f"Surveyed photos that are not in the flight; check the names: {_listed(strangers)}."
    return by_frame, listed if strangers else ""


def _frame_of(path: str, names: Sequence[str], by_stem: Mapping[str, set[int]]) -> int | None:
    """Return the index of the frame that a table names; None unless one path's folders end with all folders of the other."""
    wanted = path_parts(path)
    ranked: dict[int, tuple[bool, bool, bool, int]] = {}
    for i in by_stem.get(PurePath(wanted[-1]).stem, set()) | by_stem.get(wanted[-1], set()):
        parts = path_parts(names[i])
        least = min(len(parts), len(wanted))
        if parts[-least:-1] == wanted[-least:-1]:
            ranked[i] = path.replace("\\", "/") == names[i], parts == wanted, parts[-1] == wanted[-1], least
    best = sorted(i for i in ranked if ranked[i] == max(ranked.values()))
    if len(best) > 1:
        either = " or ".join(printable(names[i]) for i in best[:2])
        raise InputError(
            f"The surveyed photo {printable(path)[:100]} may be {either} of the flight; write the name as the flight has it."
        )
    return best[0] if best else None


def compare_surveyed(located: LocatedFlight, matched: MatchedSurvey) -> list[Residual]:
    """Return the best answers minus the surveyed positions, in the flight's order."""
    rows = []
    for i, frame in enumerate(located.frames):
        best = judge(frame)
        for _, *at, point in matched.get(i, ()):
            row = Residual(
                frame.frame.name, point, None, best.columns["stage"], best.state, best.columns["doubt"], (at[0], at[1])
            )
            if best.answer.place is not None:
                answer = _at_point(frame, best.answer, point)
                assert answer.place is not None
                east, north = np.subtract(*located.basemap.frame.utm([answer.place.tolist(), at])).tolist()
                radius = math.nan if answer.radius is None else answer.radius
                answered: SurveyedPoint = "camera" if answer.camera else "ground"
                row = replace(row, answered=answered, east=east, north=north, radius=radius)
            rows.append(row)
    return rows


def _at_point(located: LocatedFrame, answer: StageRecord, point: SurveyedPoint) -> StageRecord:
    """Return an answer moved to the wanted point, or unchanged if it has no such place."""
    if point == "ground" and answer.camera and answer.homography is not None:
        x, y = located.middle(answer).tolist()
        return msgspec.structs.replace(answer, x=x, y=y, radius=answer.middle_radius, camera=False)
    if point == "camera" and not answer.camera:
        if (pose := answer.pose) is None:
            return below_camera(located.frame, answer)
        radius = math.hypot(pose.radius, answer.map_error)
        return msgspec.structs.replace(answer, x=pose.east, y=pose.north, radius=radius, camera=True)
    return answer


def summarise_surveyed(rows: Sequence[Residual]) -> dict[str, dict[SurveyedPoint, Errors]]:
    """Return the errors of accepted answers by stage and surveyed point."""
    errors: dict[str, dict[SurveyedPoint, Errors]] = {}
    for stage, point in dict.fromkeys((row.stage, row.point) for row in rows if row.counts):
        chosen = [row for row in rows if row.counts and (row.stage, row.point) == (stage, point)]
        offsets = [(row.east, row.north, row.radius if row.answered == point else math.nan) for row in chosen]
        errors.setdefault(stage, {})[point] = Errors.of(len(chosen), offsets)
    return errors


def write_residuals(file: Path, rows: Sequence[Residual], frame: LocalFrame) -> None:
    """Write residuals as CSV, whole or not at all: positions in the map's UTM zone, and answer minus survey.

    Raises:
        OutputError: if the file cannot be written.
    """
    cells: list[list[object]] = []
    for row in rows:
        easting, northing = frame.utm([row.surveyed])[0].tolist()
        metres = math.hypot(row.east, row.north)
        radii = metres / row.radius if row.answered == row.point and row.radius > 0 else math.nan
        places = (easting, northing, easting + row.east, northing + row.north)
        told = [row.photo, row.point, row.answered or "", row.stage, row.state, row.doubt, *map(_rounded, places)]
        figures = map(_rounded, (row.east, row.north, metres, row.radius, radii))
        cells.append([*told, f"EPSG:{frame.utm_zone}", *figures])
    write_atomic(file, csv_bytes([_RESIDUAL_COLUMNS, *cells]))


def _rounded(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None


def survey_remarks(rows: Sequence[Residual], photos: int) -> list[str]:
    """Return sentences on photos that do not count, are contradicted, or are compared at another point.

    Args:
        photos: number of the flight's photos.
    """
    sentences = []
    if missing := [row.photo for row in rows if not row.counts]:
        sentences.append(f"Photos without an accepted answer do not count: {_listed(missing)}.")
    if doubted := [row.photo for row in rows if row.counts and row.doubt]:
        sentences.append(f"Contradicted by other answers, and counted all the same: {_listed(doubted)}.")
    for point, other in (("camera", "ground at the photo's middle"), ("ground", "camera")):
        if moved := sum(row.counts and row.point == point != row.answered for row in rows):
            sentences.append(
                f"Surveyed positions of the {point} that are compared with the {other}, as the answer tells no more: {moved}. A "
                "tilted camera keeps the two apart, so the shares within radii leave them out."
            )
    if without := photos - len({row.photo for row in rows}):
        sentences.append(f"Photos of the flight without a surveyed position: {without}.")
    return sentences


def _listed(names: Iterable[str]) -> str:
    return printable(first_few(list(dict.fromkeys(names)), _MOST_NAMES))
