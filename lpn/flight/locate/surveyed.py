"""A flight's answers against surveyed positions, which a person has in a table (CSV).

    photo,easting,northing,epsg,point
    DJI_0012.JPG,612345.21,3338010.87,32614,camera

Latitude and longitude may stand in place of easting and northing; they are of WGS 84 where no CRS is told. `point` is what was
surveyed: "camera", or "ground" for the ground at the photo's middle.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any, Literal

import numpy as np

from lpn.core.arrays import BoolArray, Float64Array
from lpn.core.csv_cells import csv_bytes, mixed_separators, unescape
from lpn.core.errors import DataError, InputError
from lpn.core.files import first_few, printable, write_atomic
from lpn.core.lists import read_text, separated
from lpn.core.numbers import distance
from lpn.flight.files.logs import nearest_in_folders, path_parts
from lpn.flight.locate.belief import BestAnswer, best_answers
from lpn.flight.locate.camera_place import below_camera
from lpn.flight.locate.located import LocatedFlight, LocatedFrame, StageRecord
from lpn.flight.locate.measures import RIGHT_CALIBRATION
from lpn.flight.locate.tracks import TrackState
from lpn.flight.maps import LocalFrame, Map
from lpn.flight.maps.sources import parse_crs

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
# The CRS of degrees where no other one is told.
_WGS84 = "EPSG:4326"
# Names in one sentence at most.
_MOST_NAMES = 10
# Errors that differ by fewer metres are equal: their mean, and so their distances from it, are inexact.
_EQUAL = 1e-6
# Independent photos from which a mean is compared with its standard error.
_LEAST_FOR_BIAS = 5
# The multiple of the standard error that a mean of normal errors exceeds by chance once in 370 surveys (the 3 sigma of many
# photos), by degrees of freedom: quantiles of Student's t.
_BIAS = {4: 6.62, 5: 5.51, 6: 4.90, 8: 4.28, 10: 3.96, 15: 3.59, 25: 3.33, 50: 3.16, math.inf: 3.00}
_SYSTEMATIC = (
    "it is more than chance gives in 99.7 % of surveys of as many independent photos, so a systematic error is likely"
)
_CHANCE = "chance is not ruled out at 99.7 %"
_UNTOLD = f"there are too few independent photos to tell ({_LEAST_FOR_BIAS} are needed)"
_RESIDUAL_COLUMNS = (
    *("photo", "point", "answer_is", "stage", "state", "doubt"),
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
class MatchedSurvey:
    """Surveyed positions of a flight's photos.

    Attributes:
        by_frame: positions by the number of their frame in the flight.
        strangers: names in the table that are no photo of the flight.
    """

    by_frame: Mapping[int, Sequence[SurveyedPosition]]
    strangers: Sequence[str]


@dataclass(frozen=True)
class Residual:
    """An answer minus the surveyed position of its photo.

    Attributes:
        photo: the frame's name.
        point: what was surveyed.
        answered: what the answer is of, the camera or the ground at the photo's middle; another than `point` where the answer
            tells no more. None without an answer.
        stage, state: of the answer that counts, see `lpn.flight.locate.belief.best_answers`.
        doubt: the answers that contradict it.
        surveyed: metres in the map's frame.
        east, north: metres along the axes of the map's UTM zone, answer minus survey; NaN without an answer.
        radius: 1-sigma radius of the answer in metres, with the map's error; NaN if unknown.
    """

    photo: str
    point: SurveyedPoint
    answered: SurveyedPoint | None
    stage: str
    state: TrackState
    doubt: tuple[str, ...]
    surveyed: tuple[float, float]
    east: float = math.nan
    north: float = math.nan
    radius: float = math.nan

    @property
    def metres(self) -> float:
        """The distance in the plane."""
        return math.hypot(self.east, self.north)

    @property
    def radii(self) -> float:
        """The distance in radii; NaN without a radius, or where the answer is not of the surveyed point."""
        return self.metres / self.radius if self.answered == self.point and self.radius > 0 else math.nan

    @property
    def counts(self) -> bool:
        """True if the answer is accepted, contradicted or not."""
        return self.state in ("accepted", "contradicted")


@dataclass(frozen=True)
class AxisMean:
    """The mean of errors along one axis, in metres.

    Attributes:
        mean, sd: of the errors; the standard deviation is NaN for one error.
        independent: errors that do not depend on each other and tell as much.
    """

    mean: float
    sd: float
    independent: float

    @property
    def error(self) -> float:
        """The standard error of the mean; it means little unless `enough`."""
        return self.sd / math.sqrt(self.independent)

    @property
    def enough(self) -> bool:
        """True if there are enough independent errors to compare the mean with its standard error."""
        return self.independent >= _LEAST_FOR_BIAS

    @property
    def systematic(self) -> bool:
        """True if chance leaves so large a mean in less than 0.3 % of surveys."""
        return self.enough and abs(self.mean) > _most_by_chance(self.independent - 1) * self.error


@dataclass(frozen=True)
class SurveyedErrors:
    """Errors of a stage's accepted answers against surveyed positions of one point, in metres.

    Attributes:
        photos: with an accepted answer and a surveyed position.
        rmse_east, rmse_north, rmse: root mean squares along both axes and in the plane.
        bias_east, bias_north: means, answer minus survey.
        sd_east, sd_north: standard deviations about these means, of n - 1 photos; NaN for one photo.
        independent_east, independent_north: photos that err independently and tell as much as all of them, by the correlation of
            neighbours in the flight; the standard error of a mean is its standard deviation over the root of this number.
        median, ce90, ce95, largest: distances in the plane; `ce90` and `ce95` are the circular errors that hold 90 and 95 % of
            them.
        radii: photos whose answer has a radius and is of the surveyed point.
        within: of these, the share in percent within 1, 2, and 3 radii; empty without any. Right radii have
            `measures.RIGHT_CALIBRATION`.
    """

    photos: int
    rmse_east: float
    rmse_north: float
    rmse: float
    bias_east: float
    bias_north: float
    sd_east: float
    sd_north: float
    independent_east: float
    independent_north: float
    median: float
    ce90: float
    ce95: float
    largest: float
    radii: int
    within: dict[int, float]

    @property
    def means(self) -> dict[str, AxisMean]:
        """The mean along each axis, "east" and "north"."""
        return {
            "east": AxisMean(self.bias_east, self.sd_east, self.independent_east),
            "north": AxisMean(self.bias_north, self.sd_north, self.independent_north),
        }

    @property
    def counted_as(self) -> str:
        """Say as how many independent photos these count, as neighbours err alike; "" if each counts as one."""
        if min(self.independent_east, self.independent_north) > self.photos - 0.5:
            return ""
        east, north = (
            f"{number} independent {'ones' if number > 1 else 'one'} to the {axis}"
            for axis, mean in self.means.items()
            for number in [int(mean.independent)]
        )
        return f"Photos that follow each other err alike, so the {self.photos} count as {east} and {north}."

    @property
    def bias_sentence(self) -> str:
        """Say along which axes the mean is more than chance explains; "" of fewer photos than could tell."""
        if self.photos < _LEAST_FOR_BIAS:
            return ""
        means, verdicts = [], dict[str, list[str]]()
        for axis, one in self.means.items():
            means.append(f"{round(one.mean, 2) + 0.0:.2f} m {axis}" + (f" (± {one.error:.2f})" if one.enough else ""))
            verdict = _SYSTEMATIC if one.systematic else _CHANCE if one.enough else _UNTOLD
            verdicts.setdefault(verdict, []).append(axis)
        judged = "; ".join(f"to the {' and '.join(named)} {verdict}" for verdict, named in verdicts.items())
        known = ", with its standard error" if {*verdicts} - {_UNTOLD} else ""
        return f"The mean is {' and '.join(means)}{known}: {judged}. {self.counted_as}".rstrip()


def read_surveyed(file: Path, frame: LocalFrame, crs: str | None = None) -> list[SurveyedPosition]:
    """Read a table of surveyed positions.

    Args:
        frame: of the map; positions come in its metres.
        crs: coordinate reference system of the coordinates, such as EPSG:32614, where no column tells it.

    Raises:
        DataError: if the file cannot be read, or is no such table; the message names the line.
        InputError: if a CRS is none, does not fit the columns, is told twice, or is needed and missing.
    """
    name = printable(file.name)
    decimal_comma, rows = separated(read_text(file, name), name, strict=True)
    header = _header(next(rows, (0, []))[1], name)
    entries = [_entry(values, header, f"Line {line} of {name}", decimal_comma) for line, values in rows]
    if not entries:
        raise DataError(f"{name} has no position below its first line; add a line for each photo.")
    xy = _in_metres(entries, "latitude" in header, frame, crs, name)
    return [
        SurveyedPosition(entry.photo, x, y, entry.point) for entry, (x, y) in zip(entries, xy.tolist(), strict=True)
    ]


def match_surveyed(names: Sequence[str], surveyed: Sequence[SurveyedPosition], basemap: Map) -> MatchedSurvey:
    """Find the frames of surveyed positions by the photos' names, with or without folders and a suffix.

    Args:
        names: of the flight's frames, in its order.

    Raises:
        InputError: if no photo of the flight has a surveyed position, a name may be two photos, a photo has two positions of one
            point, or most positions lie farther off the map than its longer side.
    """
    frames = _Names(names)
    by_frame: dict[int, list[SurveyedPosition]] = {}
    strangers: list[str] = []
    for position in surveyed:
        number = frames.number(position.photo)
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
    off = np.array([basemap.metres_off(np.array([one.x, one.y])) for group in by_frame.values() for one in group])
    west, south, east, north = basemap.bounds
    if (middle := float(np.median(off))) > max(east - west, north - south):
        raise InputError(
            f"The surveyed positions lie {distance(middle)} from the map in the median; check their CRS, such as the UTM zone, "
            "and that map and survey are of one place."
        )
    return MatchedSurvey(by_frame, strangers)


def compare_surveyed(located: LocatedFlight, matched: MatchedSurvey) -> list[Residual]:
    """Return the answers that count minus the surveyed positions, in the flight's order."""
    return [
        _residual(frame, position, best, located.basemap.frame)
        for i, (frame, best) in enumerate(zip(located.frames, best_answers(located), strict=True))
        for position in matched.by_frame.get(i, ())
    ]


def summarise_surveyed(rows: Sequence[Residual]) -> dict[str, dict[SurveyedPoint, SurveyedErrors]]:
    """Summarise the residuals of accepted answers by their stage, and by what was surveyed."""
    known: dict[str, dict[SurveyedPoint, list[Residual]]] = {}
    for row in rows:
        if row.counts:
            known.setdefault(row.stage, {}).setdefault(row.point, []).append(row)
    return {stage: {point: _summary(chosen) for point, chosen in points.items()} for stage, points in known.items()}


def _summary(rows: Sequence[Residual]) -> SurveyedErrors:
    off = np.array([(row.east, row.north) for row in rows])
    return summarise_offsets(off, np.array([row.radii for row in rows if not math.isnan(row.radii)]))


def summarise_offsets(off: Float64Array, radii: Float64Array) -> SurveyedErrors:
    """Summarise errors in metres east and north, (N, 2), in the flight's order; N is at least 1.

    Args:
        radii: the lengths of some of them in radii, (M,).
    """
    metres = np.linalg.norm(off, axis=1)
    rmse_east, rmse_north = np.sqrt((off**2).mean(axis=0)).tolist()
    bias_east, bias_north = off.mean(axis=0).tolist()
    sd_east, sd_north = off.std(axis=0, ddof=1).tolist() if len(off) > 1 else (math.nan, math.nan)
    median, ce90, ce95 = np.quantile(metres, (0.5, 0.9, 0.95)).tolist()
    return SurveyedErrors(
        len(off),
        rmse_east,
        rmse_north,
        math.hypot(rmse_east, rmse_north),
        bias_east,
        bias_north,
        sd_east,
        sd_north,
        _independent(off[:, 0]),
        _independent(off[:, 1]),
        median,
        ce90,
        ce95,
        float(metres.max()),
        len(radii),
        {k: 100 * float((radii <= k).mean()) for k in RIGHT_CALIBRATION if len(radii)},
    )


def _independent(errors: Float64Array) -> float:
    """Return how many errors that do not depend on each other tell as much of the mean as these, (n,), in the flight's order.

    With a correlation r of neighbours these are n (1 - r) / (1 + r) (Bayley and Hammersley, 1946); r below 0 counts as 0. About
    their own mean n errors show r too low by (1 + 4 r) / n (Kendall, 1954), which is added.
    """
    off, n = errors - errors.mean(), len(errors)
    if np.ptp(errors) < _EQUAL:
        return float(n)
    shown = float((off[1:] * off[:-1]).sum()) / float((off**2).sum())
    alike = min(max(shown + (1 + 4 * shown) / n, 0.0), 1.0)
    return max(n * (1 - alike) / (1 + alike), 1.0)


def _most_by_chance(freedom: float) -> float:
    """Return the multiple of the standard error within which chance leaves a mean, by degrees of freedom from 4 on."""
    return float(np.interp(-1 / freedom, [-1 / known for known in _BIAS], list(_BIAS.values())))


def write_residuals(file: Path, rows: Sequence[Residual], frame: LocalFrame) -> None:
    """Write residuals as CSV, whole or not at all; positions are in the UTM zone of the map, differences are answer minus survey.

    Raises:
        OutputError: if the file cannot be written.
    """
    cells: list[list[object]] = []
    for row in rows:
        easting, northing = frame.utm([row.surveyed])[0].tolist()
        places = (easting, northing, easting + row.east, northing + row.north)
        figures = [*places, f"EPSG:{frame.utm_zone}", row.east, row.north, row.metres, row.radius, row.radii]
        told = [value if isinstance(value, str) else _rounded(value) for value in figures]
        doubt = ", ".join(row.doubt)
        cells.append([row.photo, row.point, row.answered or "", row.stage, row.state, doubt, *told])
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
    pairs = [pair for pair in (_DEGREES, _METRES) if {*pair} <= {*header}]
    if len(pairs) > 1:
        both = " and ".join(",".join(names[header[key]].strip() for key in pair) for pair in pairs)
        raise DataError(
            f"The first line of {file} has {printable(both)[:200]}, and only one of the two can be the survey; take the other "
            "one away."
        )
    if "photo" not in header or not pairs:
        found = printable(",".join(names))[:200] or "empty"
        raise DataError(f"The first line of {file} is {found}; {_EXPECTED}.{mixed_separators(found)}")
    other = _METRES if pairs[0] is _DEGREES else _DEGREES
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


def _in_metres(entries: Sequence[_Entry], degrees: bool, frame: LocalFrame, crs: str | None, file: str) -> Float64Array:
    """Return coordinates, each in its own CRS, in the map's metres, (N, 2)."""
    xy = np.empty((len(entries), 2))
    if crs and any(entry.crs for entry in entries):
        raise InputError(f"{file} tells its CRS in a column; leave --crs out, or take the column away.")
    # Spreadsheets write a whole number as 32614.0, too.
    told = [(crs or entry.crs or (_WGS84 if degrees else "")).removesuffix(".0") for entry in entries]
    for text in dict.fromkeys(told):
        if not text:
            raise InputError(
                f"{file} has eastings and northings without their CRS; add a column epsg, or give it, such as --crs EPSG:32614."
            )
        system = parse_crs(text)
        _check_kind(text, system, degrees, file)
        chosen = [i for i, one in enumerate(told) if one == text]
        # A geographic CRS has its longitude first here.
        numbers = np.array([entries[i].numbers for i in chosen])[:, :: -1 if degrees else 1]
        placed = frame.from_crs(system, numbers)
        if not np.isfinite(placed).all():  # one position that the projection cannot place makes all of them NaN
            placed = np.concatenate([frame.from_crs(system, [row]) for row in numbers])
            _refuse_unplaced([entries[i].line for i in chosen], np.isfinite(placed[:, 0]), text)
        xy[chosen] = placed
    return xy


def _check_kind(text: str, crs: Any, degrees: bool, file: str) -> None:
    """Raise InputError unless a CRS is geographic for degrees, or projected for metres."""
    if crs.is_geographic if degrees else crs.is_projected:
        return
    columns, kind, such = (
        ("latitudes and longitudes", "geographic", _WGS84)
        if degrees
        else ("eastings and northings", "projected", "EPSG:32614")
    )
    raise InputError(
        f"The CRS {printable(text)[:100]} is not {kind}, and {file} has {columns}; expected one such as {such}."
    )


def _refuse_unplaced(lines: Sequence[str], placed: BoolArray, crs: str) -> None:
    """Raise DataError about the lines whose position has no place on the map's plane."""
    if not placed.any():
        raise InputError(
            f"The CRS {printable(crs)[:100]} cannot be brought to the map's plane for any position; check the CRS."
        )
    failed = [line for line, known in zip(lines, placed, strict=True) if not known]
    raise DataError(
        f"{first_few(failed, _MOST_NAMES)}: the CRS {printable(crs)[:100]} has no such position; check the coordinates."
    )


class _Names:
    """The names of a flight's frames, found by what a table calls them."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._whole = {name: i for i, name in enumerate(names)}
        self._parts = [path_parts(name) for name in names]
        self._by_name: dict[str, list[int]] = {}
        self._by_stem: dict[str, list[int]] = {}
        for i, parts in enumerate(self._parts):
            self._by_name.setdefault(parts[-1], []).append(i)
            self._by_stem.setdefault(PurePath(parts[-1]).stem, []).append(i)

    def number(self, path: str) -> int | None:
        """Return the number of a frame: of its whole path, else its name, else its name without suffix, by the most folders.

        A frame of another folder is none; a flight names the folders of its photos only where names repeat.
        """
        if (number := self._whole.get(path.replace("\\", "/"))) is not None:
            return number
        parts = path_parts(path)
        near = (
            self._by_name.get(parts[-1])
            or self._by_stem.get(parts[-1])
            or self._by_stem.get(PurePath(parts[-1]).stem, [])
        )
        near = [i for i in near if self._parts[i][-2:-1] in (parts[-2:-1], ()) or len(parts) == 1]
        near = [i for i in near if self._parts[i] == parts] or [
            near[k] for k in nearest_in_folders(parts, [self._parts[i] for i in near])
        ]
        if len(near) > 1:
            either = " or ".join(printable(self._names[i]) for i in near[:2])
            raise InputError(
                f"The surveyed photo {printable(path)[:100]} may be {either} of the flight; write the name as the flight has it."
            )
        return near[0] if near else None


def _residual(located: LocatedFrame, position: SurveyedPosition, best: BestAnswer, frame: LocalFrame) -> Residual:
    at = (position.x, position.y)
    unanswered = Residual(located.frame.name, position.point, None, best.stage, best.state, best.doubt, at)
    if best.answer.x is None:
        return unanswered
    x, y, radius, point = _place(located, best.answer, position.point)
    there, here = frame.utm([at, (x, y)]).tolist()
    return replace(
        unanswered,
        answered=point,
        east=here[0] - there[0],
        north=here[1] - there[1],
        radius=math.nan if radius is None else radius,
    )


def _place(
    located: LocatedFrame, answer: StageRecord, point: SurveyedPoint
) -> tuple[float, float, float | None, SurveyedPoint]:
    """Return an answer's place, its radius, and what it is of: the wanted point where the answer tells it."""
    if point == "ground" and answer.camera and answer.homography is not None:
        x, y = located.middle(answer).tolist()
        return x, y, answer.middle_radius, "ground"
    if point == "camera" and not answer.camera:
        if answer.pose is not None:
            return answer.pose.east, answer.pose.north, math.hypot(answer.pose.radius, answer.map_error), "camera"
        answer = below_camera(located.frame, answer)
    assert answer.x is not None
    assert answer.y is not None
    return answer.x, answer.y, answer.radius, "camera" if answer.camera else "ground"


def survey_remarks(rows: Sequence[Residual], photos: int) -> list[str]:
    """Return sentences on photos that do not count, are contradicted, or are not compared with the surveyed point.

    Args:
        photos: of the flight.
    """
    sentences = []
    if missing := _names_of(row for row in rows if not row.counts):
        sentences.append(
            f"No answer is accepted for {_photos(missing)}, which {'does' if len(missing) == 1 else 'do'} not count: "
            f"{_listed(missing)}."
        )
    if doubted := _names_of(row for row in rows if row.counts and row.doubt):
        sentences.append(f"Contradicted by other answers, and counted all the same: {_listed(doubted)}.")
    for point, other in (("camera", "ground at the photo's middle"), ("ground", "camera")):
        moved = sum(row.counts and row.point == point != row.answered for row in rows)
        if moved:
            sentences.append(
                f"{moved} surveyed position{'s' * (moved > 1)} of the {point} {'are' if moved > 1 else 'is'} compared with the "
                f"{other}, as the answer tells no more; a tilted camera keeps the two apart, so the shares within radii leave "
                f"{'them' if moved > 1 else 'it'} out."
            )
    if without := photos - len(_names_of(rows)):
        has = "photos of the flight have" if without > 1 else "photo of the flight has"
        sentences.append(f"{without} {has} no surveyed position.")
    return sentences


def strangers_sentence(matched: MatchedSurvey) -> str:
    """Name the surveyed photos that are not in the flight; "" if all are."""
    names = list(dict.fromkeys(matched.strangers))
    if not names:
        return ""
    return f"{_photos(names)} {'is' if len(names) == 1 else 'are'} not in the flight, so check the names: {_listed(names)}."


def _names_of(rows: Iterable[Residual]) -> list[str]:
    """Return the photos of rows, each once."""
    return list(dict.fromkeys(row.photo for row in rows))


def _photos(names: Sequence[str]) -> str:
    return f"{len(names)} surveyed photo{'s' * (len(names) > 1)}"


def _listed(names: Sequence[str]) -> str:
    return printable(first_few(list(names), _MOST_NAMES))
