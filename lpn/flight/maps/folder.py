"""The folder of a map, with everything that is needed to read it.

    map.json            format, frame, and for each sheet its file, CRS, and transform
    coverage.png        share of each cell that is valid, 0 to 255
    sheets/01.tif       the sheet in its own CRS: a tiled GeoTIFF of RGB and alpha without loss, with overviews if it is large
    sheets/elevation.tif  heights of the map's ground in metres, in the CRS and at the resolution of the user's file

The folder is written under another name beside its final place, and renamed at the end.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import msgspec
import numpy as np

from lpn.core import formats
from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError, InputError, OutputError
from lpn.core.files import check_writable, first_few, printable, write_atomic
from lpn.core.numbers import SIGMA
from lpn.flight.maps import _gdal
from lpn.flight.maps.elevation import Elevation, ElevationFile, probes, write_elevation
from lpn.flight.maps.frame import LocalFrame
from lpn.flight.maps.map import Map, MapPlace
from lpn.flight.maps.raster import Raster
from lpn.flight.maps.sheet import Sheet
from lpn.flight.maps.sources import MapOptions, files_of, open_sheet, parse_crs

NAME = "map.json"
FORMAT = "lpn-map/2"
_COVERAGE = "coverage.png"
_SHEETS = "sheets"
_ELEVATION = "elevation.tif"
# Pixels that two processors copy in a minute.
_PIXELS_PER_MINUTE = 2.5e8


class SheetRecord(msgspec.Struct, frozen=True):
    """A sheet in map.json.

    Attributes:
        name: of the user's file.
        file: path of the pixels in the folder.
        crs: EPSG code or WKT.
        transform: from column and row to coordinates, row by row.
        notes: sentences about how the user's file is read.
    """

    name: str
    file: str
    crs: str
    transform: tuple[float, float, float, float, float, float]
    notes: list[str]


class ElevationRecord(msgspec.Struct, frozen=True):
    """The elevation in map.json: the name of the user's file, and sentences about how it is read."""

    name: str
    notes: list[str]


class MapRecord(msgspec.Struct, frozen=True):
    """The contents of map.json.

    Attributes:
        latitude, longitude: origin of the frame in degrees.
        sheets: at least one.
        elevation: of `sheets/elevation.tif`; None without one.
        place: facts about the place beyond its georeference.
        error, surveyed_error, notes: see `Map`.
    """

    format: str
    name: str
    latitude: float
    longitude: float
    sheets: list[SheetRecord]
    elevation: ElevationRecord | None = None
    place: MapPlace | None = None
    error: float | None = None
    surveyed_error: float | None = None
    notes: list[str] = []


def open_map(where: str | Path | Sequence[str | Path], options: MapOptions | None = None) -> Map:
    """Open a map.

    Args:
        where: a folder of `lpn map`, or its input: a georeferenced raster, a list of corners, a folder of tiles or of
            rasters, or several of these as sheets of one map.
        options: facts about the files that they do not state.

    Raises:
        DataError: if a file cannot be read, or has no or an impossible georeference.
        InputError: if an option is malformed, or does not apply.
        ModuleNotFoundError: if rasterio (the extra `maps`) is not installed.
    """
    options = options or MapOptions()
    paths = [Path(where)] if isinstance(where, str | Path) else [Path(path) for path in where]
    if whole := next((path for path in paths if (path / NAME).is_file()), None):
        if len(paths) > 1 or options != MapOptions():
            raise InputError(f"{printable(str(whole))} is a whole map of lpn map; open it alone and without options.")
        return open_folder(whole)
    return _opened(paths, options)


def build_map(
    paths: Sequence[Path],
    out: Path,
    options: MapOptions | None = None,
    on_progress: Callable[[str], None] = lambda _: None,
    elevation: ElevationFile | None = None,
    place: MapPlace | None = None,
    error: float | None = None,
    surveyed_error: float | None = None,
    notes: Sequence[str] = (),
) -> Map:
    """Write the folder of a map, and open it.

    Args:
        paths: see `lpn.flight.maps.open_map`.
        out: the folder, new or empty; it appears when all is written.
        options: facts about the files that they do not state.
        on_progress: called with a sentence before each long step.
        elevation: heights of the map's ground; they are copied into the folder, in metres.
        place, error, surveyed_error: see `Map`.
        notes: sentences about how the files were made; commands that read the map print them.

    Raises:
        DataError: if a file cannot be read, its georeference is missing or impossible, or heights cover less than half of the
            map.
        InputError: if an option is malformed, or does not apply.
        OutputError: if the folder is not empty, or cannot be written.
    """
    for path in paths:
        if not (path / NAME).is_file():
            continue
        with suppress(DataError):  # a map.json of another program
            names = [printable(sheet.name) for sheet in _read(path).sheets]
            raise InputError(
                f"{printable(str(path))} is a map that lpn map wrote; give the files that it was made of: {first_few(names, 10)}."
            )
    check_new(out, surveyed_error)
    whole = _opened(paths, options or MapOptions(), notes)
    if elevation is not None:
        elevation.box(whole.frame, whole.bounds)
    with _new_folder(out) as folder:
        (folder / _SHEETS).mkdir()
        sheets = []
        for number, sheet in enumerate(whole.sheets, 1):
            minutes = sheet.raster.width * sheet.raster.height / _PIXELS_PER_MINUTE
            about = f", which takes some {minutes:.0f} minutes" if minutes >= 2 else ""
            on_progress(f"Copying {printable(sheet.name)} into the map{about}.")
            sheets.append(_copied(sheet, folder, f"{_SHEETS}/{number:02d}.tif"))
        on_progress("Reading the map for pixels without data.")
        if not whole.coverage().any():
            raise DataError(f"{printable(whole.name)} has no valid pixel; expected a map.")
        heights = None
        if elevation is not None:
            on_progress(f"Copying the heights of {printable(elevation.path.name)}.")
            places_shown = probes(whole.bounds)
            shown = places_shown[whole.valid_shares(places_shown, whole.resolution) > 0]
            made = write_elevation(elevation, folder / _SHEETS / _ELEVATION, whole.frame, whole.bounds, shown)
            heights = ElevationRecord(made.name, made.notes)
        coverage = np.rint(whole.coverage() * 255).astype(np.uint8)
        write_atomic(folder / _COVERAGE, cv2.imencode(".png", coverage)[1].tobytes())
        record = MapRecord(
            FORMAT, whole.name, whole.frame.latitude, whole.frame.longitude, sheets, heights, place, error, surveyed_error,
            list(whole.own_notes),
        )  # fmt: skip
        write_atomic(folder / NAME, msgspec.json.format(msgspec.json.encode(record), indent=1) + b"\n")
        whole.close()
    return open_folder(out)


def _opened(paths: Sequence[Path], options: MapOptions, notes: Sequence[str] = ()) -> Map:
    files, left_out = files_of(paths, options)
    return Map(files[0].stem, [open_sheet(file, options) for file in files], notes=[*left_out, *notes])


def _copied(sheet: Sheet, folder: Path, name: str) -> SheetRecord:
    """Copy the pixels of a sheet to a file of a map's folder, and read the sheet from there."""
    source, code = sheet.raster, sheet.crs.to_epsg()
    try:
        source.copy(folder / name, sheet.crs, sheet.matrix)
    except _gdal.failures(OSError) as error:
        raise OutputError(
            f"{printable(sheet.name)} cannot be copied into the map ({printable(str(error))[:200]}); free space for it, or check "
            "the file."
        ) from error
    source.close()
    sheet.raster = Raster(folder / name, decided=True)
    a, b, c, d, e, f = sheet.matrix.ravel().tolist()
    crs = f"EPSG:{code}" if code else sheet.crs.to_wkt()
    return SheetRecord(sheet.name, name, crs, (a, b, c, d, e, f), source.notes)


@contextmanager
def _new_folder(out: Path) -> Iterator[Path]:
    """Yield a folder beside `out` that is renamed to `out` at the end, and deleted if anything fails."""
    name = out.resolve().name
    with TemporaryDirectory(prefix=f".{name}-", dir=out.parent) as folder:
        part = Path(folder) / name
        part.mkdir()
        yield part
        try:
            if out.is_dir():
                out.rmdir()
            os.replace(part, out)
        except OSError as error:
            raise OutputError(
                f"{printable(str(out))} cannot be written ({error.strerror}); choose another folder for the map."
            ) from error


def check_new(out: Path, surveyed_error: float | None) -> None:
    """Check the folder and the error of a new map before long work, and make the folders above it.

    Raises:
        InputError: if the error is no number above 0.
        OutputError: if the folder cannot be written, or is anything but an empty one.
    """
    if surveyed_error is not None and not 0 < surveyed_error < math.inf:
        raise InputError(f"The map's error is {surveyed_error:g} m; expected more than 0, {SIGMA}.")
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise OutputError(
            f"{printable(str(out))} is there already; choose another folder for the map, or delete that one."
        )
    check_writable(out.with_name(f".{out.resolve().name}"))


def open_folder(folder: Path) -> Map:
    """Open the folder of a map.

    Raises:
        DataError: if map.json is damaged, or a sheet is missing or has changed.
    """
    record = _read(folder)
    sheets = []
    for sheet in record.sheets:
        raster = Raster(_there(folder, sheet.file), decided=True)
        raster.notes = list(sheet.notes)
        matrix: Float64Array = np.array(sheet.transform).reshape(2, 3)
        sheets.append(Sheet(sheet.name, raster, parse_crs(sheet.crs), matrix))
    frame, shares, path = LocalFrame(record.latitude, record.longitude), None, folder / _COVERAGE
    if path.is_file() and path.stat().st_size:
        coverage = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE)
        shares = None if coverage is None else (coverage / 255).astype(np.float32)
    elevation = None
    if record.elevation is not None:
        elevation = Elevation(
            _there(folder, f"{_SHEETS}/{_ELEVATION}"), record.elevation.name, list(record.elevation.notes)
        )
    return Map(
        record.name, sheets, frame, shares, elevation, record.place, record.error, record.surveyed_error, record.notes
    )


def _read(folder: Path) -> MapRecord:
    path = folder / NAME
    file_name = printable(str(path))
    try:
        record = formats.decode_json(path.read_bytes(), MapRecord, file_name, FORMAT, DataError)
        placed = abs(record.latitude) <= 90 and abs(record.longitude) <= 180
        surveyed = record.surveyed_error
        if (
            not record.sheets
            or not placed
            or not 0 <= (record.error or 0.0) < math.inf
            or not (surveyed is None or 0 < surveyed < math.inf)
        ):
            raise ValueError
    except OSError as error:
        raise DataError(f"{file_name} cannot be read ({error.strerror or error}); check its permissions.") from error
    except (ValueError, RecursionError, InputError) as error:
        raise DataError(
            f"{file_name} is damaged, of an older version, or no map; write the map again with lpn map, in a new folder."
        ) from error
    return record


def _there(folder: Path, name: str) -> Path:
    """Return the path of a map's file; DataError if it is missing."""
    if not (path := folder / name).exists():
        raise DataError(
            f"The map {printable(str(folder))} needs {printable(str(path))}, which is not there; bring it back, or write the map "
            "again with lpn map."
        )
    return path
