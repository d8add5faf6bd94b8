"""A flight's answers against surveyed positions, which a person has in a table (CSV).

    photo,easting,northing,epsg,point
    DJI_0012.JPG,612345.21,3338010.87,32614,camera

Latitude and longitude (WGS 84) may stand in place of easting, northing, and their EPSG code. `point` is what was surveyed:
"camera", or "ground" for the ground at the photo's middle.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.csv_cells import csv_bytes, decode_text, delimited, unescape
from lpn.core.errors import DataError, InputError
from lpn.core.files import first_few, printable, write_atomic
from lpn.locate.belief import beliefs, disagreements
from lpn.locate.camera_place import below_camera
from lpn.locate.located import BY_HAND, LocatedFlight, LocatedFrame, StageRecord
from lpn.locate.measures import RIGHT_CALIBRATION
from lpn.locate.tracks import State
from lpn.maps import LocalFrame
from lpn.maps.sources import parse_crs

SurveyedPoint = Literal["camera", "ground"]
# The names of the columns that are read, in the order in which they count.
COLUMNS = {
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

# Metres from which positions are those of another place, as in a wrong UTM zone.
_ELSEWHERE = 5000.0
_RESIDUAL_COLUMNS = (
    *("photo", "point", "answer_is", "stage", "state"),
    *("surveyed_easting_m", "surveyed_northing_m", "easting_m", "northing_m", "crs"),
    *("east_m", "north_m", "distance_m", "radius_m", "radii"),
)


@dataclass(frozen=True)
class SurveyedPosition:
    """A surveyed position of a photo: metres east and north in the map's frame, of its camera or of the ground at its middle."""

    photo: str
    x: float
    y: float
    point: SurveyedPoint


@dataclass(frozen=True)
class Residual:
    """An answer minus the surveyed position of its photo.

    Attributes:
        photo: the frame's name.
        point: what was surveyed.
        answered: what the answer is of, the camera or the ground at the photo's middle; another than `point` where the answer
            tells no more. None without an answer.
        stage, state: of the answer; a contradicted one is accepted, too.
        contradicted: whether other answers contradict it.
        surveyed: metres in the map's frame.
        east, north: metres along the axes of the map's UTM zone, answer minus survey; NaN without an answer.
        radius: 1-sigma radius of the answer in metres, with the map's error; NaN if unknown.
    """

    photo: str
    point: SurveyedPoint
    answered: SurveyedPoint | None
    stage: str
    state: State
    contradicted: bool
    surveyed: tuple[float, float]
    east: float = math.nan
    north: float = math.nan
    radius: float = math.nan

    @property
    def metres(self) -> float:
        """The distance in the plane."""
        return math.hypot(self.east, self.north)


@dataclass(frozen=True)
class SurveyedErrors:
    """Errors of a stage's accepted answers against surveyed positions, in metres.

    Attributes:
        photos: with an accepted answer and a surveyed position; a photo whose camera and ground were surveyed counts twice.
        rmse_east, rmse_north, rmse: root mean squares along both axes and in the plane.
        bias_east, bias_north: means, answer minus survey.
        median, ce90, largest: distances in the plane; `ce90` is the circular error that holds 90 % of them.
        within: share in percent within 1, 2, and 3 radii; empty without radii. Right radii have `measures.RIGHT_CALIBRATION`.
    """

    photos: int
    rmse_east: float
    rmse_north: float
    rmse: float
    bias_east: float
    bias_north: float
    median: float
    ce90: float
    largest: float
    within: dict[int, float]


def read_surveyed(file: Path, frame: LocalFrame, crs: str | None = None) -> list[SurveyedPosition]:
    """Read a table of surveyed positions.

    Args:
        frame: of the map; positions come in its metres.
        crs: coordinate reference system of eastings and northings, such as EPSG:32614, where no column tells it.

    Raises:
        DataError: if the file cannot be read, or is no such table; the message names the line.
        InputError: if a CRS is none, or is needed and missing.
    """
    name = printable(file.name)
    try:
        text = decode_text(file.read_bytes())
        decimal_comma, rows = delimited(text, strict=True)
        header = _header(next(rows, (0, []))[1], name)
        entries = [_entry(values, header, f"Line {line} of {name}", decimal_comma) for line, values in rows]
    except OSError as error:
        raise DataError(
            f"{printable(str(file))} cannot be read ({error.strerror or error}); check that it is there and readable."
        ) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{name} is not a text file of comma-separated values in UTF-8; save it as such.") from error
    if not entries:
        raise DataError(f"{name} has no position below its first line; add a line for each photo.")
    if "latitude" in header:
        xy = frame.xy(*np.array([entry.numbers for entry in entries]).T)
    else:
        xy = _projected(entries, frame, crs, name)
    for entry, place in zip(entries, xy, strict=True):
        if not np.isfinite(place).all():
            raise DataError(
                f"{entry.line} has a position that its CRS does not hold; check the coordinates and the CRS."
            )
    return [
        SurveyedPosition(entry.photo, x, y, entry.point) for entry, (x, y) in zip(entries, xy.tolist(), strict=True)
    ]


def compare_surveyed(located: LocatedFlight, surveyed: Sequence[SurveyedPosition]) -> tuple[list[Residual], list[str]]:
    """Compare the answers that count with surveyed positions, matched by the photos' names, with or without a suffix.

    Returns:
        A residual for each surveyed position whose photo is in the flight, in the flight's order, and sentences on what was left
        out, or compared with another point than the surveyed one.

    Raises:
        InputError: if no photo of the flight has a surveyed position, one has two of the same point, or all lie elsewhere.
    """
    by_photo, strangers = _by_photo(located, surveyed)
    contradictions = disagreements(located.frames)
    doubted = {one.frame for one in contradictions}
    rows = [
        _residual(frame, position, verdict.stage, i in doubted and verdict.sign is None, located.basemap.frame)
        for i, (frame, verdict) in enumerate(zip(located.frames, beliefs(located.frames, contradictions), strict=True))
        for position in by_photo.get(i, ())
    ]
    apart = [row.metres for row in rows if not math.isnan(row.metres)]
    if apart and (middle := float(np.median(apart))) > _ELSEWHERE:
        raise InputError(
            f"The surveyed positions lie {middle / 1000:,.0f} km from the answers in the median; check their CRS, such as the "
            "UTM zone."
        )
    return rows, _told(rows, strangers, len(located.frames) - len(by_photo))


def summarise_surveyed(rows: Sequence[Residual]) -> dict[str, SurveyedErrors]:
    """Summarise the residuals of accepted answers, stage by stage."""
    known: dict[str, list[Residual]] = {}
    for row in rows:
        if row.state == "accepted":
            known.setdefault(row.stage, []).append(row)
    return {stage: _summary(chosen) for stage, chosen in known.items()}


def _summary(rows: Sequence[Residual]) -> SurveyedErrors:
    off = np.array([(row.east, row.north) for row in rows])
    metres = np.linalg.norm(off, axis=1)
    radii = np.array([row.radius for row in rows])
    told = radii > 0
    rmse_east, rmse_north = np.sqrt((off**2).mean(axis=0)).tolist()
    bias_east, bias_north = off.mean(axis=0).tolist()
    return SurveyedErrors(
        len(rows),
        rmse_east,
        rmse_north,
        math.hypot(rmse_east, rmse_north),
        bias_east,
        bias_north,
        float(np.median(metres)),
        float(np.quantile(metres, 0.9)),
        float(metres.max()),
        {k: 100 * float((metres[told] <= k * radii[told]).mean()) for k in RIGHT_CALIBRATION if told.any()},
    )


def write_residuals(file: Path, rows: Sequence[Residual], frame: LocalFrame) -> None:
    """Write residuals as CSV, whole or not at all; positions are in the UTM zone of the map, differences are answer minus survey.

    Raises:
        OutputError: if the file cannot be written.
    """
    cells: list[list[object]] = []
    for row in rows:
        easting, northing = frame.utm([row.surveyed])[0].tolist()
        places = (easting, northing, easting + row.east, northing + row.north)
        figures = [*places, f"EPSG:{frame.utm_zone}", row.east, row.north, row.metres, row.radius]
        figures.append(row.metres / row.radius if row.radius > 0 else math.nan)
        state = "contradicted" if row.contradicted else row.state
        told = [value if isinstance(value, str) else _rounded(value) for value in figures]
        cells.append([row.photo, row.point, row.answered or "", row.stage, state, *told])
    write_atomic(file, csv_bytes([_RESIDUAL_COLUMNS, *cells]))


def _rounded(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None


@dataclass(frozen=True)
class _Entry:
    line: str
    photo: str
    numbers: tuple[float, float]
    crs: str
    point: SurveyedPoint


def _header(names: Sequence[str], file: str) -> dict[str, int]:
    """Return the column of each known name."""
    given = {name.strip().lower(): i for i, name in reversed(list(enumerate(names)))}
    header = {
        key: next(given[one] for one in known if one in given) for key, known in COLUMNS.items() if {*known} & {*given}
    }
    pair = next((pair for pair in (_DEGREES, _METRES) if {*pair} <= {*header}), None)
    if "photo" not in header or pair is None:
        found = printable(",".join(names))[:200] or "empty"
        semicolons = " Where semicolons separate values, put the line sep=; above it." if ";" in found else ""
        raise DataError(f"The first line of {file} is {found}; {_EXPECTED}.{semicolons}")
    other = _METRES if pair is _DEGREES else _DEGREES
    return {key: column for key, column in header.items() if key not in other}


def _entry(values: Sequence[str], header: Mapping[str, int], line: str, decimal_comma: bool) -> _Entry:
    if len(values) <= max(header.values()):
        raise DataError(
            f"{line} has {len(values)} values, and its columns need {max(header.values()) + 1}; complete it."
        )
    cells = {key: unescape(values[column].strip()) for key, column in header.items()}
    if not cells["photo"]:
        raise DataError(f"{line} has no photo; expected its file name.")
    keys = _DEGREES if "latitude" in header else _METRES
    first, second = (_number(cells[key], key, line, decimal_comma) for key in keys)
    point = cells.get("point", "").lower() or "camera"
    if point not in ("camera", "ground"):
        raise DataError(f"{line} has the point {printable(point)[:100]!r}; expected camera or ground.")
    return _Entry(
        line, cells["photo"], (first, second), cells.get("crs", ""), "ground" if point == "ground" else "camera"
    )


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


def _projected(entries: Sequence[_Entry], frame: LocalFrame, crs: str | None, file: str) -> Float64Array:
    """Return eastings and northings, each in its own CRS, in the map's metres."""
    xy = np.empty((len(entries), 2))
    if crs and any(entry.crs for entry in entries):
        raise InputError(f"{file} tells its CRS in a column; leave --crs out, or take the column away.")
    # Spreadsheets write a whole number as 32614.0, too.
    told = [(crs or entry.crs).removesuffix(".0") for entry in entries]
    for text in dict.fromkeys(told):
        if not text:
            raise InputError(
                f"{file} has eastings and northings without their CRS; add a column epsg, or give it, such as --crs EPSG:32614."
            )
        chosen = [i for i, one in enumerate(told) if one == text]
        xy[chosen] = frame.from_crs(parse_crs(text), np.array([entries[i].numbers for i in chosen]))
    return xy


def _by_photo(
    located: LocatedFlight, surveyed: Sequence[SurveyedPosition]
) -> tuple[dict[int, list[SurveyedPosition]], list[str]]:
    """Return the surveyed positions of each frame by its number, and the names of photos that are not in the flight."""
    numbers: dict[str, int] = {}
    for i, frame in reversed(list(enumerate(located.frames))):
        numbers |= {Path(frame.frame.name).stem.lower(): i, frame.frame.name.lower(): i}
    by_photo: dict[int, list[SurveyedPosition]] = {}
    strangers: list[str] = []
    for position in surveyed:
        name = Path(position.photo.replace("\\", "/")).name.lower()
        number = numbers.get(name, numbers.get(Path(name).stem))
        if number is None:
            strangers.append(position.photo)
            continue
        others = by_photo.setdefault(number, [])
        if any(other.point == position.point for other in others):
            raise InputError(
                f"The photo {printable(position.photo)[:100]} has two surveyed positions of its {position.point}; keep one."
            )
        others.append(position)
    if not by_photo:
        raise InputError(
            f"None of the {len(surveyed)} surveyed photos, the first being {printable(surveyed[0].photo)[:100]}, is in the "
            f"flight, whose first photo is {printable(located.frames[0].frame.name)}; expected the photos' file names."
        )
    return by_photo, strangers


def _residual(
    located: LocatedFrame, position: SurveyedPosition, stage: str | None, contradicted: bool, frame: LocalFrame
) -> Residual:
    at = (position.x, position.y)
    name = located.frame.name
    if stage is None and located.by_hand is None:
        return Residual(name, position.point, None, "", "refused", False, at)
    answer = located.by_hand if stage is None or located.by_hand is not None else located.stages[stage]
    assert answer is not None
    x, y, radius, point = _place(located, answer, position.point)
    there, here = frame.utm([at, (x, y)]).tolist()
    return Residual(
        name,
        position.point,
        point,
        BY_HAND if answer is located.by_hand else stage or "",
        answer.state,
        contradicted,
        at,
        here[0] - there[0],
        here[1] - there[1],
        math.nan if radius is None else radius,
    )


def _place(
    located: LocatedFrame, answer: StageRecord, point: SurveyedPoint
) -> tuple[float, float, float | None, SurveyedPoint]:
    """Return an answer's place, its radius, and what it is of: the wanted point where the answer tells it."""
    if point == "ground" and answer.camera and answer.homography is not None:
        x, y = located.middle(answer).tolist()
        return x, y, answer.radius, "ground"
    if point == "camera" and not answer.camera:
        if answer.pose is not None:
            return answer.pose.east, answer.pose.north, math.hypot(answer.pose.radius, answer.map_error), "camera"
        answer = below_camera(located.frame, answer)
    assert answer.x is not None
    assert answer.y is not None
    return answer.x, answer.y, answer.radius, "camera" if answer.camera else "ground"


def _told(rows: Sequence[Residual], strangers: Sequence[str], without: int) -> list[str]:
    """Return sentences on photos that were not compared, or not with the surveyed point."""
    sentences = []
    if strangers:
        names = printable(first_few(strangers, 10))
        sentences.append(f"{len(strangers)} surveyed photos are not in the flight, so check their names: {names}.")
    if missing := [row.photo for row in rows if row.state != "accepted"]:
        sentences.append(
            f"No answer is accepted for {len(missing)} surveyed photos: {printable(first_few(missing, 10))}."
        )
    if doubted := [row.photo for row in rows if row.contradicted]:
        sentences.append(f"Contradicted, and counted all the same: {printable(first_few(doubted, 10))}.")
    for point, other in (("camera", "ground at the photo's middle"), ("ground", "camera")):
        moved = sum(row.state == "accepted" and row.point == point != row.answered for row in rows)
        if moved:
            sentences.append(
                f"{moved} surveyed positions of the {point} are compared with the {other}, as the answer tells no more; a "
                "tilted camera keeps the two apart."
            )
    if without:
        sentences.append(f"{without} photos of the flight have no surveyed position.")
    return sentences
