"""The files of a map: how each is recognised, and the source of its georeference."""

from __future__ import annotations

import itertools
import re
import sqlite3
import weakref
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError, InputError, OutputError
from lpn.core.files import printable
from lpn.core.lists import read_rows
from lpn.flight.maps import _gdal
from lpn.flight.maps.raster import Raster
from lpn.flight.maps.sheet import Sheet
from lpn.flight.maps.tiles import is_tile_set, pack_tiles, tiles_near

# Largest error, in pixels, of the affine transform that stands for ground control points.
_CONTROL_ERROR = 2.0
# Files of a folder that are taken as sheets.
_SUFFIXES = (".tif", ".tiff", ".jpg", ".jpeg", ".png", ".webp", ".jp2", ".mbtiles", ".img")
# Lists of pictures with their corners: Filename,Top_left_lat,Top_left_lon,Bottom_right_lat,Bottom_right_lon (wildnav), and
# mapname,LT_lat_map,LT_lon_map,RB_lat_map,RB_lon_map,region (UAV-VisLoc).
_LISTS = ("map.csv", "satellite_coordinates_range.csv", "satellite_ coordinates_range.csv")
# The columns, without signs and in lower case: the picture, then top, left, bottom, right.
_COLUMNS = (
    {"filename", "mapname", "name", "file"},
    {"topleftlat", "topleftlatitude", "ltlatmap"},
    {"topleftlon", "topleftlong", "topleftlng", "topleftlongitude", "ltlonmap"},
    {"bottomrightlat", "bottomrightlatitude", "rblatmap"},
    {"bottomrightlon", "bottomrightlong", "bottomrightlng", "bottomrightlongitude", "rblonmap"},
)


class NoPlaceError(DataError):
    """A picture has no georeference at all."""


Corners = tuple[float, float, float, float]


@dataclass(frozen=True)
class MapOptions:
    """Facts about a map's files that they do not state.

    Attributes:
        crs: coordinate reference system, such as EPSG:32632; it takes precedence over the CRS of the files.
        corners: latitude and longitude of the top-left, then of the bottom-right corner of a picture.
        bands: numbers, from 1, of the bands shown as red, green, and blue, or of one shown as grey.
        keep_borders: True if white and black borders belong to the picture.
    """

    crs: str | None = None
    corners: Corners | None = None
    bands: tuple[int, ...] | None = None
    keep_borders: bool = False


def files_of(paths: Sequence[Path], options: MapOptions) -> tuple[list[Path], list[str]]:
    """Return the rasters and tile folders in files and folders, and notes about files that are left out.

    A list of corners stands for the pictures that it names, and a folder without tiles for its rasters.

    Raises:
        DataError: if a file or folder is missing, or holds no map.
        InputError: if there is no file, or an option does not apply to the files.
    """
    if not paths:
        raise InputError("A map needs at least one file; found none.")
    files: list[Path] = []
    notes: list[str] = []
    for path in paths:
        if path.is_dir() and not is_tile_set(path):
            files += _files_in(path, options, notes)
        elif path.suffix.lower() == ".csv":
            files += _listed(path)
        elif path.exists():
            files.append(path)
        else:
            raise DataError(f"There is no file {printable(str(path))}; check the path.")
    if options.corners is not None and len(files) > 1:
        raise InputError(f"Corners belong to one picture, and {len(files)} files are given; give one.")
    return list(dict.fromkeys(files)), notes


def open_sheet(path: Path, options: MapOptions) -> Sheet:
    """Open a raster file with its georeference, or a folder of tiles.

    Raises:
        DataError: if it cannot be read, or its georeference is missing or impossible.
        InputError: if an option is malformed, or does not apply.
        OutputError: if tiles cannot be packed in the folder of temporary files.
    """
    if not is_tile_set(path):
        with _gdal.opened(path) as file:
            crs, matrix = _georeference(path, file, options)
        return Sheet(path.name, Raster(path, options.bands, options.keep_borders), crs, matrix)
    if options != MapOptions(keep_borders=options.keep_borders):
        raise InputError(f"{printable(str(path))} holds tiles in Web Mercator; leave CRS, corners, and bands out.")
    with ExitStack() as stack:
        try:
            packed = Path(stack.enter_context(TemporaryDirectory(ignore_cleanup_errors=True))) / f"{path.name}.mbtiles"
            matrix, notes = pack_tiles(path, packed)
        except (sqlite3.Error, OSError) as error:
            raise OutputError(
                f"The tiles of {printable(str(path))} cannot be packed ({printable(str(error))[:200]}); free space in the folder "
                "for temporary files, or name another one in TMPDIR."
            ) from error
        raster = Raster(packed, None, options.keep_borders, printable(path.name))
        weakref.finalize(raster, stack.pop_all().close)
    raster.notes[:0] = notes
    return Sheet(path.name, raster, _gdal.epsg(3857), matrix)


def _files_in(folder: Path, options: MapOptions, notes: list[str]) -> list[Path]:
    """Return the rasters of a folder's list of corners, else its georeferenced rasters; note the others."""
    for name in _LISTS:
        if (folder / name).is_file():
            return _listed(folder / name)
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES and path.is_file())
    if not files:
        if inner := tiles_near(folder) or next((file.parent for file in _deeper(folder)), None):
            raise DataError(
                f"{printable(str(folder))} is not the folder of the map itself; give {printable(str(inner))}."
            )
        inside = ", ".join(sorted(printable(path.name) for path in folder.iterdir())[:5]) or "nothing"
        raise DataError(
            f"{printable(str(folder))} holds {inside}; expected GeoTIFF files, pictures with world files, tiles "
            "{z}/{x}/{y}.png, or map.csv."
        )
    left_out: dict[Path, str] = {}
    for path in files if len(files) > 1 else ():
        with _gdal.opened(path) as file:
            try:
                _georeference(path, file, options)
            except NoPlaceError:
                left_out[path] = "has no georeference"
            else:
                if file.count == 1 and np.dtype(file.dtypes[0]).kind == "f":
                    left_out[path] = "holds heights, which --elevation takes"
    if len(left_out) == len(files):
        return files
    notes += [f"{printable(path.name)} is left out of the map: it {why}." for path, why in left_out.items()]
    return [path for path in files if path not in left_out]


def _deeper(folder: Path) -> Iterator[Path]:
    """Yield the GeoTIFFs in the subfolders where survey programs put them."""
    return itertools.chain(sorted(folder.glob("*orthophoto*/*.tif")), sorted(folder.glob("*/2_mosaic/*.tif")))


def _listed(path: Path) -> list[Path]:
    files = [path.parent / name for name in _read_list(path)]
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        raise DataError(
            f"{len(missing)} of {len(files)} pictures of {printable(str(path))} are not beside it, the first being "
            f"{printable(missing[0])}; add them, or give single pictures of the list instead."
        )
    return files


def _read_list(path: Path) -> dict[str, Corners]:
    """Read a list of pictures with their corners: latitude and longitude of the top left, then of the bottom right.

    Raises:
        DataError: if it is no such list; the message names the line.
    """
    file_name = printable(str(path))
    rows = read_rows(path, file_name)
    header = [re.sub("[^a-z]", "", name.lower()) for name in next(rows, (0, []))[1]]
    places = [next((i for i, name in enumerate(header) if name in names), None) for names in _COLUMNS]
    if None in places:
        raise DataError(
            f"The first line of {file_name} is {printable(','.join(header))[:200] or 'empty'}; expected "
            "Filename,Top_left_lat,Top_left_lon,Bottom_right_lat,Bottom_right_lon."
        )
    corners = {}
    for line, values in rows:
        try:
            name, top, left, bottom, right = (values[place].strip() for place in places if place is not None)
            corners[name] = (float(top), float(left), float(bottom), float(right))
        except (IndexError, ValueError):
            raise DataError(
                f"Line {line} of {file_name} is {printable(','.join(values))[:200]}; expected a file and four numbers."
            ) from None
    if not corners:
        raise DataError(f"{file_name} names no picture; expected a line for each.")
    return corners


def _corners_of(path: Path) -> tuple[Corners, str] | None:
    """Return the corners of a picture, and the list that has them, beside it or one folder up; None without a list."""
    for folder in (path.parent, path.parent / ".."):
        for name in _LISTS:
            if (folder / name).is_file() and (corners := _read_list(folder / name).get(path.name)):
                return corners, f"{printable(path.name)} in {name}"
    return None


# A code, its URN, a datum, or PROJ parameters.
_SAFE = re.compile(
    r"\w+:[\w+]+$|urn:ogc:def:crs:\w+:[\w.]*:\w+$|(WGS(84|72)|NAD(27|83))$|\+init=epsg:\d+$|(\+\w+=\S+\s+)*\+proj=",
    re.ASCII | re.IGNORECASE,
)


def parse_crs(text: str) -> Any:
    """Return the rasterio CRS of a text such as EPSG:32632, PROJ parameters, or WKT.

    Raises:
        InputError: if it is none.
        DataError: if it names a file by its path.
    """
    text = re.sub(
        r"^(?:EPSG:\s+|https?://www\.opengis\.net/def/crs/EPSG/[\w.]+/)?(\d+)$", r"EPSG:\1", text.strip(), flags=re.I
    )
    try:
        return _crs(text)
    except _gdal.failures(ValueError) as error:
        raise InputError(f"There is no CRS {printable(text)[:100]!r}; expected one such as EPSG:32632.") from error


def _crs(text: str, **options: bool) -> Any:
    """Return the rasterio CRS of a text; `from_user_input` alone would open a text that is a path or an address."""
    if _gdal.names_a_path(text):
        raise DataError(f"The CRS {printable(text)[:100]!r} names a file by its path; expected one such as EPSG:32632.")
    library = _gdal.rasterio()
    with library.Env():
        if _SAFE.match(text):
            return library.crs.CRS.from_user_input(text)
        return library.crs.CRS.from_wkt(text, **options)


def _georeference(path: Path, file: Any, options: MapOptions) -> tuple[Any, Float64Array]:
    if options.corners is not None and options.crs is not None:
        raise InputError("Corners are latitudes and longitudes; give --corners or --crs, not both.")
    matrix = None if options.corners is not None else _matrix(path, file)
    known = (options.corners, "--corners") if options.corners is not None else None
    if matrix is None and (known := known or _corners_of(path)) is not None:
        if (turn := file.tags().get("EXIF_Orientation", "1")) != "1":
            raise DataError(
                f"{printable(str(path))} is shown turned or mirrored (EXIF orientation {printable(turn)}), so that its corners "
                "are not certain; save it upright first."
            )
        return _from_corners(known[0], file.width, file.height, known[1])
    if matrix is None and file.rpcs is not None:
        raise DataError(
            f"{printable(str(path))} has its position as RPCs only; orthorectify it first, such as with gdalwarp -rpc."
        )
    if matrix is None:
        flown = (
            f" It has a GPS tag; lpn map --from-flight {printable(str(path.parent))} makes a map of a flight's photos."
        )
        raise NoPlaceError(
            f"{printable(str(path))} has no georeference: it is no GeoTIFF, and no world file lies beside it; add one, or give "
            "--corners with the latitude and longitude of its top-left and bottom-right corner."
            f"{flown if 'EXIF_GPSLatitude' in file.tags() else ''}"
        )
    if options.crs is not None:
        return parse_crs(options.crs), matrix
    crs = file.crs or file.gcps[1] or _projection_file(path)
    if not crs:
        raise DataError(
            f"{printable(str(path))} has coordinates but no coordinate reference system; add {path.stem}.prj, or give --crs, "
            "such as EPSG:32632 (UTM) or EPSG:4326 (degrees)."
        )
    if local := re.match(r'LOCAL_CS\[.*AUTHORITY\["EPSG","([0-9]+)"\]\]$', crs.to_wkt()):
        # Some programs write only the name and the code of a CRS.
        return parse_crs(local[1]), matrix
    return crs, matrix


def _matrix(path: Path, file: Any) -> Float64Array | None:
    """Return the transform of a raster from its tags, its world file, or its control points; None without any."""
    if not file.transform.is_identity:
        return np.array(file.transform[:6], np.float64).reshape(2, 3)
    points = file.gcps[0]
    if len(points) >= 3:
        cells = np.array([(point.col, point.row, 1.0) for point in points])
        matrix = np.linalg.lstsq(cells, np.array([(point.x, point.y) for point in points]), rcond=None)[0].T
        inverse = np.linalg.pinv(matrix[:, :2])
        off = (np.array([(point.x, point.y) for point in points]) - cells @ matrix.T) @ inverse.T
        if np.abs(off).max() > _CONTROL_ERROR:
            raise DataError(
                f"The control points of {printable(str(path))} lie up to {np.abs(off).max():.0f} pixels off a plane; warp the "
                "file first, such as with gdalwarp."
            )
        return np.asarray(matrix, np.float64)
    suffixes = [f".{path.suffix[1:2]}{path.suffix[-1:]}w", f"{path.suffix}w", ".wld"]
    world = _beside(path, suffixes)
    return None if world is None else _world_file(world)


def _world_file(path: Path) -> Float64Array:
    """Read a world file: the steps of x and y per column and per row, and the centre of the first pixel."""
    try:
        numbers = [float(text.replace(",", ".")) for text in _text(path).split()]
        if len(numbers) != 6 or not np.isfinite(numbers).all():
            raise ValueError
    except (OSError, ValueError) as error:
        raise DataError(f"{printable(str(path))} is no world file; expected six numbers, one a line.") from error
    a, d, b, e, x, y = numbers
    return np.array([[a, b, x - (a + b) / 2], [d, e, y - (d + e) / 2]])


def _projection_file(path: Path) -> Any:
    file = _beside(path, [".prj"])
    if file is None:
        return None
    try:
        return _crs(_text(file).strip(), morph_from_esri_dialect=True)
    except _gdal.failures(OSError, ValueError) as error:
        raise DataError(
            f"{printable(str(file))} holds no coordinate reference system that can be read; give --crs."
        ) from error


def _text(path: Path) -> str:
    """Return the text of a small file in UTF-8 or, with a byte order mark, in UTF-16."""
    data = path.read_bytes()
    return data.decode("utf-16" if data.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig")


def _beside(path: Path, suffixes: Sequence[str]) -> Path | None:
    """Return the file beside another with the same stem and one of these suffixes, case ignored."""
    return next(iter(_gdal.named(path.parent, [(path.stem + suffix).lower() for suffix in suffixes])), None)


def _from_corners(corners: Sequence[float], width: int, height: int, what: str) -> tuple[Any, Float64Array]:
    top, left, bottom, right = corners
    on_earth = all(map(np.isfinite, corners)) and max(abs(top), abs(bottom)) <= 90 and max(abs(left), abs(right)) <= 180
    east = right + 360 if left > right + 180 else right  # across the antimeridian
    if not (on_earth and top > bottom and left < east):
        where = "are not top left and bottom right" if on_earth else "lie outside the world"
        raise DataError(
            f"The corners {top:g}, {left:g} and {bottom:g}, {right:g} of {what} {where}; expected latitude, then longitude, of "
            "the top-left corner, and of the bottom-right one south and east of it."
        )
    matrix = np.array([[(east - left) / width, 0, left], [0, (bottom - top) / height, top]])
    return _gdal.epsg(4326), matrix
