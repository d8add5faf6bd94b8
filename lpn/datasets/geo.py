"""Positions of pictures (`geo.csv` in a data set's folder), and distances on the ground.

    path,latitude,longitude[,altitude,heading[,tilt,fov[,width]]]
    test/gallery_satellite/0005/0005.jpg,30.30561,120.08023,,
    test/query_drone/0005/image-01.jpeg,30.30561,120.08023,121.5,90

`path` is relative to the folder, with forward slashes. Latitude and longitude are WGS 84 degrees of the ground point in the
middle of the picture, which for an oblique drone picture is not the camera's position. Altitude is the camera's height
above the ground in metres, and heading its direction in degrees clockwise from north. Tilt is its angle in degrees from the
horizon; -90, the default, is straight down. Fov is its horizontal field of view in degrees, and width the ground width of a tile
in metres. The columns from altitude on are optional and may be empty.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.core.lists import read_text, table
from lpn.core.numbers import wrap_degrees
from lpn.datasets.listed_paths import by_name, fold, plain_path

if TYPE_CHECKING:
    from lpn.datasets.base import Picture

NAME = "geo.csv"
# Equatorial radius and flattening of WGS 84, and the mean radius of the Earth; radii in metres.
_EQUATOR, _FLATTENING, _MEAN_RADIUS = 6_378_137.0, 1 / 298.257223563, 6_371_008.8
# Vincenty's iteration converges within a few steps, except for nearly antipodal points.
_STEPS = 60

_REQUIRED = ("path", "latitude", "longitude")
_LIMITS = {
    "latitude": (-90.0, 90.0),
    "longitude": (-180.0, 180.0),
    "altitude": (-1_000.0, 100_000.0),
    "heading": (-1e6, 1e6),
    "tilt": (-90.0, -5.0),
    "fov": (1.0, 170.0),
    "width": (0.1, 1e6),
}


@dataclass(frozen=True)
class Position:
    """The position of a picture on the Earth.

    Attributes:
        latitude, longitude: WGS 84 degrees of the ground point in the middle of the picture.
        altitude: of the camera above the ground in metres.
        heading: of the camera in degrees clockwise from north.
        tilt: of the camera in degrees from the horizon; -90 is straight down.
        fov: horizontal field of view in degrees.
        width: ground width in metres.
    """

    latitude: float
    longitude: float
    altitude: float | None = None
    heading: float | None = None
    tilt: float | None = None
    fov: float | None = None
    width: float | None = None


class Positions:
    """The positions of a data set's pictures.

    Args:
        root: the data set's folder.
        by_path: positions by path relative to `root`; by default, the contents of `geo.csv`.
        source: the file with the positions, for messages.

    Raises:
        DataError: if `geo.csv` is missing or malformed; the message names the line.
    """

    def __init__(self, root: Path, by_path: Mapping[str, Position] | None = None, source: str = NAME) -> None:
        self.source, self._root = source, root
        self._by_path = read_positions(read_text(root / NAME, NAME)) if by_path is None else by_path

    def of(self, pictures: Sequence[Picture]) -> list[Position]:
        """Return the position of each picture; DataError if one has none."""
        return self.below(names_below(self._root, pictures))

    def below(self, names: Sequence[str]) -> list[Position]:
        """Return the position of each path below the data set's folder; DataError if one has none."""
        known = self._by_path
        if any(name not in known for name in names):
            known = by_name(known, names, self.source)
        if missing := [name for name in names if name not in known]:
            raise DataError(
                f"{self.source} has no position for {len(missing)} of {len(names)} pictures, the first being {missing[0]}; "
                f"add a line for each, or take {self.source} away."
            )
        return [known[name] for name in names]

    def match(self, names: Sequence[str]) -> list[Position | None]:
        """Return the position of each path below a described folder; None for a path without a position.

        The folder may lie below the data set's folder. All paths get the prefix that fits most of them, and after a tie none.

        Raises:
            InputError: if two prefixes fit equally many names, at different positions.
        """
        # Paths are compared without case, unless two of them differ by case alone.
        folds = all(len(set(map(fold, paths))) == len(paths) for paths in (self._by_path, {*map(plain_path, names)}))
        key = fold if folds else str
        listed = {key(path): position for path, position in self._by_path.items()}
        keys = [key(plain_path(name)) for name in names]
        wanted, counts = set(keys), Counter[str]()
        for parts in (path.split("/") for path in listed):
            depths = (depth for depth in range(len(parts)) if "/".join(parts[depth:]) in wanted)
            counts.update("".join(f"{part}/" for part in parts[:depth]) for depth in depths)
        most = max(counts.values(), default=0)
        best, *others = sorted(folder for folder, count in counts.items() if count == most) or [""]

        def places(folder: str) -> list[tuple[float, float] | None]:
            there = (listed.get(folder + name) for name in keys)
            return [None if one is None else (one.latitude, one.longitude) for one in there]

        for other in others if best else ():
            if places(other) != places(best):
                raise InputError(
                    f"{self.source} in {self._root} has these names below {best} and {other} at different positions; give a file "
                    "of positions, or its folder as --data, that has only the described folder."
                )
        return [listed.get(best + name) for name in keys]


def names_below(root: Path, pictures: Sequence[Picture]) -> list[str]:
    """Return the path of each picture below a folder, with forward slashes."""
    start = f"{root.as_posix().rstrip('/')}/"
    return [picture.path.as_posix().removeprefix(start) for picture in pictures]


def positions(root: Path) -> Positions | None:
    """Read the positions of a data set's pictures; None without a `geo.csv`.

    Raises:
        DataError: if the file cannot be read.
    """
    return Positions(root) if (root / NAME).is_file() else None


def metres(a: Sequence[Position], b: Sequence[Position]) -> Float64Array:
    """Return the distance in metres of each pair of positions from `a` and `b`, see `geodesic`: (N,) float64."""
    return geodesic(degrees(a), degrees(b))


def geodesic(a: npt.ArrayLike, b: npt.ArrayLike) -> Float64Array:
    """Return the distance in metres on the WGS 84 ellipsoid between latitude and longitude in degrees (..., 2).

    The app, tables, and reports show this distance. It is Vincenty's inverse formula (1975), exact to less than a millimetre.
    It does not converge for nearly antipodal points; they get the distance on a sphere, exact to 0.6 %.
    """
    p, q = np.broadcast_arrays(np.radians(np.asarray(a, np.float64)), np.radians(np.asarray(b, np.float64)))
    east = q[..., 1] - p[..., 1]
    # Reduced latitudes.
    u, v = (np.arctan((1 - _FLATTENING) * np.tan(point[..., 0])) for point in (p, q))
    sin_u, cos_u, sin_v, cos_v = np.sin(u), np.cos(u), np.sin(v), np.cos(v)
    turn, before = east, np.full_like(east, np.inf)
    for _ in range(_STEPS):
        cross = np.hypot(cos_v * np.sin(turn), cos_u * sin_v - sin_u * cos_v * np.cos(turn))
        along = sin_u * sin_v + cos_u * cos_v * np.cos(turn)
        arc = np.arctan2(cross, along)
        sin_alpha = np.divide(cos_u * cos_v * np.sin(turn), cross, out=np.zeros_like(cross), where=cross > 0)
        cos2_alpha = 1 - sin_alpha**2
        # Along the equator, the middle's latitude has no effect.
        ratio = np.divide(2 * sin_u * sin_v, cos2_alpha, out=np.zeros_like(cross), where=cos2_alpha > 0)
        middle = np.where(cos2_alpha > 0, along - ratio, 0.0)
        c = _FLATTENING / 16 * cos2_alpha * (4 + _FLATTENING * (4 - 3 * cos2_alpha))
        series = arc + c * cross * (middle + c * along * (2 * middle**2 - 1))
        before, turn = turn, east + (1 - c) * _FLATTENING * sin_alpha * series
        if not (np.abs(turn - before) >= 1e-13).any():  # an unknown place, NaN, counts as converged
            break
    polar = _EQUATOR * (1 - _FLATTENING)
    square = cos2_alpha * (_EQUATOR**2 - polar**2) / polar**2
    scale = 1 + square / 16384 * (4096 + square * (-768 + square * (320 - 175 * square)))
    b_term = square / 1024 * (256 + square * (-128 + square * (74 - 47 * square)))
    last = b_term / 6 * middle * (4 * cross**2 - 3) * (4 * middle**2 - 3)
    shift = b_term * cross * (middle + b_term / 4 * (along * (2 * middle**2 - 1) - last))
    half = np.sin((q - p) / 2) ** 2
    chord = half[..., 0] + np.cos(p[..., 0]) * np.cos(q[..., 0]) * half[..., 1]
    sphere = 2 * _MEAN_RADIUS * np.arcsin(np.sqrt(np.minimum(chord, 1.0)))
    return cast(Float64Array, np.where(np.abs(turn - before) < 1e-9, polar * scale * (arc - shift), sphere))


def on_plane(places: Sequence[Position], origin: Position) -> Float64Array:
    """Return metres east and north of an origin, on the plane tangent to the WGS 84 ellipsoid there: (N, 2) float64.

    Within 50 km of the origin and below 45 degrees of latitude, distances are accurate to 1 %.
    """
    north, east = metres_per_degree(origin.latitude)
    latitude, longitude = degrees(places).T
    return np.stack([wrap_degrees(longitude - origin.longitude) * east, (latitude - origin.latitude) * north], axis=1)


def metres_per_degree(latitude: float) -> tuple[float, float]:
    """Return the lengths in metres of a degree of latitude and of longitude, at a latitude on the WGS 84 ellipsoid."""
    e2 = _FLATTENING * (2 - _FLATTENING)
    sine = np.sin(np.radians(latitude))
    north = _EQUATOR * (1 - e2) / (1 - e2 * sine**2) ** 1.5
    east = _EQUATOR / np.sqrt(1 - e2 * sine**2) * np.cos(np.radians(latitude))
    return float(np.radians(north)), float(np.radians(east))


def camera(place: Position, origin: Position) -> Float64Array | None:
    """Return the camera's position in metres east, north, and up from an origin, (3,); None without an altitude.

    An oblique camera is behind the ground point that it shows; height and tilt determine the distance.
    """
    if place.altitude is None:
        return None
    tilt = math.radians(-90.0 if place.tilt is None else place.tilt)
    heading = math.radians(place.heading or 0.0)
    away = 0.0 if math.cos(tilt) < 1e-6 else place.altitude / -math.tan(tilt)
    east, north = on_plane([place], origin)[0]
    return np.array([east - away * math.sin(heading), north - away * math.cos(heading), place.altitude])


def degrees(places: Sequence[Position]) -> Float64Array:
    """Return latitude and longitude of each position in degrees, (N, 2)."""
    return np.array([(place.latitude, place.longitude) for place in places], dtype=np.float64).reshape(-1, 2)


def read_positions(text: str) -> dict[str, Position]:
    """Parse the text of a `geo.csv` as positions by path.

    Raises:
        DataError: if the format is wrong; the message names the line.
    """

    def fits(header: list[str]) -> bool:
        return len(set(header)) == len(header) and {*_REQUIRED} <= {*header} <= {*_REQUIRED, *_LIMITS}

    expected = "path,latitude,longitude and, if known, altitude,heading,tilt,fov,width"
    positions: dict[str, Position] = {}
    for line, row in table(text, NAME, fits, expected, decimals=_LIMITS)[1]:
        path = plain_path(row.pop("path"))
        numbers = {name: _number(value, name, line) for name, value in row.items() if value or name in _REQUIRED}
        if not path:
            raise DataError(f"{line} has no path; expected the picture's path, relative to the folder.")
        if numbers["latitude"] == numbers["longitude"] == 0:
            raise DataError(f"{line} has the position 0, 0, which programs write if it is unknown; give the true one.")
        if path in positions:
            raise DataError(f"{line} gives {printable(path[:200])} a second position; keep one.")
        positions[path] = Position(**numbers)
    return positions


def _number(text: str, name: str, line: str) -> float:
    (low, high), value = _LIMITS[name], math.nan
    with suppress(ValueError):
        value = float(text)
    if low <= value <= high:
        return value
    shown, swapped = printable(text[:200]) or "empty", ""
    if name == "latitude" and 90 < abs(value) <= 180:
        swapped = "; it may be a longitude, so check that the two are not swapped"
    raise DataError(f"{line} has the {name} {shown!r}; expected a number from {low:g} to {high:g}{swapped}.")
