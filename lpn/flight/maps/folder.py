"""The folder of a map: map.json, the coverage, and copies or overviews of sheets that are slow to read.

    map.json            format, frame, and for each sheet its file, CRS, transform, and treatment
    coverage.png        share of each cell that is valid, 0 to 255
    sheets/01.ovr       overviews of a large sheet without any
    sheets/02.tif       a tiled copy, with overviews, of a large sheet that can only be read from its beginning
    sheets/elevation.tif  heights of the map's ground in metres, in the CRS and at the resolution of the user's file

Other sheets are read in place: map.json names them relative to its own folder. The folder is written under another name beside
its final place, and renamed at the end.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import cv2
import msgspec
import numpy as np

from lpn.core import formats
from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError, InputError, OutputError
from lpn.core.files import check_writable, first_few, printable, write_atomic
from lpn.core.numbers import SIGMA
from lpn.flight.maps import _gdal
from lpn.flight.maps.elevation import Elevation, ElevationFile, ElevationSource, probes, write_elevation
from lpn.flight.maps.frame import LocalFrame
from lpn.flight.maps.map import Map
from lpn.flight.maps.place import MapPlace, checked_place
from lpn.flight.maps.raster import Raster, Treatment, is_jpeg
from lpn.flight.maps.sheet import Sheet
from lpn.flight.maps.sources import MapOptions, files_of, open_sheet, parse_crs
from lpn.flight.maps.tiles import is_tile_set, open_tiles
from lpn.flight.maps.vrt import RasterSource

NAME = "map.json"
FORMAT = "lpn-map/1"
_COVERAGE = "coverage.png"
_SHEETS = "sheets"
_ELEVATION = "elevation.tif"
# Side above which a sheet gets overviews.
_LARGE = 2048
# Pixels above which a file that is not tiled is copied.
_MAX_UNTILED = 25_000_000
_TILED = {"TILED": "YES", "BLOCKXSIZE": "512", "BLOCKYSIZE": "512", "COMPRESS": "DEFLATE", "BIGTIFF": "IF_SAFER"}


class SheetRecord(msgspec.Struct, frozen=True):
    """A sheet in map.json.

    Attributes:
        name: of the user's file.
        file: path of the pixels, relative to the folder where possible.
        kind: a raster file, or a folder or database of tiles.
        crs: EPSG code or WKT.
        transform: from column and row to coordinates, row by row.
        width, height: in pixels.
        treatment: how its bands are shown; None decides it again.
        notes: sentences about how it is read.
        overviews: the file that holds them, if `file` does not.
    """

    name: str
    file: str
    kind: Literal["raster", "tiles"]
    crs: str
    transform: tuple[float, float, float, float, float, float]
    width: int
    height: int
    treatment: Treatment | None
    notes: list[str]
    overviews: str | None = None


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
    for path in paths:
        if (path / NAME).is_file():
            if len(paths) > 1 or options != MapOptions():
                raise InputError(
                    f"{printable(str(path))} is a whole map of lpn map; open it alone and without options."
                )
            return open_folder(path)
    files, notes = files_of(paths, options)
    return Map(files[0].stem, [open_sheet(file, options) for file in files], notes=notes)


def build_map(
    paths: Sequence[Path],
    out: Path,
    options: MapOptions | None = None,
    on_progress: Callable[[str], None] = lambda _: None,
    elevation: ElevationFile | None = None,
    place: MapPlace | None = None,
) -> Map:
    """Write the folder of a map, and return the map.

    Args:
        paths: see `lpn.flight.maps.open_map`.
        out: the folder, new or empty; it appears when all is written.
        options: facts about the files that they do not state.
        on_progress: called with a sentence before each long step.
        elevation: heights of the map's ground; they are copied into the folder, in metres.
        place: facts about the map's place.

    Raises:
        DataError: if a file cannot be read, its georeference is missing or impossible, the unit of heights is unknown or
            impossible, or heights cover less than half of the map.
        InputError: if an option or the place is malformed, or does not apply.
        OutputError: if the folder is not empty, or cannot be written.
    """
    options = options or MapOptions()
    place = None if place is None else checked_place(place)
    _check_unwritten(paths)
    files, notes = files_of(paths, options)
    heights = None if elevation is None else ElevationSource(elevation)
    quick = replace(options, keep_borders=True)
    whole = Map(files[0].stem, [open_sheet(file, quick, Treatment((1,))) for file in files])
    whole.close()
    if heights is not None:
        heights.box(whole.frame, whole.bounds)
    with new_folder(out) as folder:
        sheets = []
        for number, file in enumerate(files, 1):
            copy, overviews = _prepared(file, folder / _SHEETS / f"{number:02d}", on_progress)
            sheets.append(open_sheet(file, options, copy=copy, overviews=overviews))
        _write_whole(Map(files[0].stem, sheets, place=place, notes=notes), folder, out, on_progress, heights)
    return open_folder(out)


def write_own_map(
    file: Path,
    folder: Path,
    notes: Sequence[str],
    on_progress: Callable[[str], None] = lambda _: None,
    heights: ElevationSource | None = None,
    place: MapPlace | None = None,
    error: float | None = None,
) -> Map:
    """Write the folder of a map whose one sheet lies in the folder itself, and return the map.

    Args:
        file: a GeoTIFF with transparency in `folder`, which holds nothing else.
        notes: sentences about how the sheet was made; commands that read the map print them.
        heights: of the map's ground; they are copied into the folder.
        place: facts about the map's place; they are checked.
        error: see `Map`.

    Raises:
        DataError: if the file cannot be read, or has no valid pixel, or the heights cover less than half of what it shows.
        OutputError: if the folder cannot be written.
    """
    place = None if place is None else checked_place(place)
    copy, overviews = _prepared(file, folder / _SHEETS / "01", on_progress)
    sheet = open_sheet(file, MapOptions(keep_borders=True), copy=copy, overviews=overviews)
    sheet.raster.notes += notes
    whole = Map(file.stem, [sheet], place=place, error=error)
    _write_whole(whole, folder, folder, on_progress, heights)
    return whole


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """Yield a folder beside `out` that is renamed to `out` at the end, and deleted if anything fails.

    Raises:
        OutputError: if there is anything at `out` but an empty folder, or it cannot be written.
    """
    check_new(out)
    name = out.resolve().name
    check_writable(out.with_name(f".{name}"))
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


def check_new(out: Path) -> None:
    """Raise OutputError if there is anything at `out` but an empty folder."""
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise OutputError(
            f"{printable(str(out))} is there already; choose another folder for the map, or delete that one."
        )


def _check_unwritten(paths: Sequence[Path]) -> None:
    for path in paths:
        if not (path / NAME).is_file():
            continue
        with suppress(DataError):  # a map.json of another program
            names = [printable(sheet.name) for sheet in _read(path).sheets]
            raise InputError(
                f"{printable(str(path))} is a map that lpn map wrote; give the files that it was made of: {first_few(names, 10)}."
            )


def _write_whole(
    whole: Map, folder: Path, out: Path, on_progress: Callable[[str], None], heights: ElevationSource | None
) -> None:
    """Write coverage, heights, and map.json into a folder that will be renamed to `out`, and close the map."""
    on_progress("Looking where the map has data.")
    if not whole.coverage().any():
        raise DataError(f"{printable(whole.name)} has no valid pixel; expected a map.")
    elevation = None
    if heights is not None:
        on_progress(f"Copying the heights of {printable(heights.path.name)}.")
        places_shown = probes(whole.bounds)
        shown = places_shown[whole.valid_shares(places_shown, whole.resolution) > 0]
        whole.elevation = write_elevation(heights, folder / _SHEETS / _ELEVATION, whole.frame, whole.bounds, shown)
        elevation = ElevationRecord(whole.elevation.name, whole.elevation.notes)
    coverage = np.rint(whole.coverage() * 255).astype(np.uint8)
    write_atomic(folder / _COVERAGE, cv2.imencode(".png", coverage)[1].tobytes())
    frame, sheets = whole.frame, [_record(sheet, folder, out) for sheet in whole.sheets]
    record = MapRecord(
        FORMAT, whole.name, frame.latitude, frame.longitude, sheets, elevation, whole.place, whole.error,
        notes=list(whole.own_notes),
    )  # fmt: skip
    _write(folder, record)
    whole.close()


def open_folder(folder: Path) -> Map:
    """Open the folder of a map.

    Raises:
        DataError: if map.json is damaged, or a sheet is missing or has changed.
    """
    record, file_name = _read(folder), printable(str(folder / NAME))
    sheets = [_opened(folder, sheet) for sheet in record.sheets]
    if not sheets:
        raise DataError(f"{file_name} names no sheet; write it again with lpn map.")
    frame, shares, path = LocalFrame(record.latitude, record.longitude), None, folder / _COVERAGE
    if path.is_file() and path.stat().st_size:
        coverage = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE)
        shares = None if coverage is None else (coverage / 255).astype(np.float32)
    try:
        place = checked_place(record.place or MapPlace())
    except InputError as error:
        raise DataError(f"{file_name} is damaged: {error}") from error
    elevation = None
    if record.elevation is not None:
        elevation = Elevation(
            _there(folder, f"{_SHEETS}/{_ELEVATION}"), record.elevation.name, list(record.elevation.notes)
        )
    return Map(record.name, sheets, frame, shares, elevation, place, record.error, record.surveyed_error, record.notes)


def checked_error(metres: float) -> float:
    """Check a surveyed error of a map in metres, see `Map`, and return it.

    Raises:
        InputError: if it is not a number above 0.
    """
    if not 0 < metres < math.inf:
        raise InputError(f"The map's error is {metres:g} m; expected more than 0, {SIGMA}.")
    return metres


def add_surveyed_error(folder: Path, metres: float) -> Map:
    """Replace the surveyed error of a map in map.json, and open the map.

    Raises:
        InputError: see `checked_error`.
        DataError: if map.json is damaged.
    """
    _write(folder, msgspec.structs.replace(_read(folder), surveyed_error=checked_error(metres)))
    return open_folder(folder)


def _read(folder: Path) -> MapRecord:
    path = folder / NAME
    file_name = printable(str(path))
    try:
        record = formats.decode_json(path.read_bytes(), MapRecord, file_name, FORMAT, DataError)
        placed = abs(record.latitude) <= 90 and abs(record.longitude) <= 180
        surveyed = record.surveyed_error
        if not placed or not 0 <= (record.error or 0.0) < math.inf or not (surveyed is None or 0 < surveyed < math.inf):
            raise ValueError
    except OSError as error:
        raise DataError(f"{file_name} cannot be read ({error.strerror or error}); check its permissions.") from error
    except (ValueError, RecursionError) as error:
        raise DataError(
            f"{file_name} is damaged, or no map; write the map again with lpn map, in a new folder."
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


def _record(sheet: Sheet, folder: Path, out: Path) -> SheetRecord:
    raster, code = sheet.raster, sheet.crs.to_epsg()
    a, b, c, d, e, f = sheet.matrix.ravel().tolist()
    overviews = raster.source.overviews
    return SheetRecord(
        sheet.name,
        _relative(raster.path, folder, out),
        "tiles" if raster.path.is_dir() else "raster",
        f"EPSG:{code}" if code else sheet.crs.to_wkt(),
        (a, b, c, d, e, f),
        raster.width,
        raster.height,
        raster.treatment,
        raster.notes,
        None if overviews is None else _relative(overviews, folder, out),
    )


def _relative(path: Path, folder: Path, out: Path) -> str:
    """Return a path relative to the map's folder, which is now `folder` and will be `out`."""
    whole = path.resolve()
    try:
        base = folder if whole.is_relative_to(folder.resolve()) else out
        return Path(os.path.relpath(whole, base.resolve())).as_posix()
    except ValueError:  # another drive
        return str(whole)


def _opened(folder: Path, record: SheetRecord) -> Sheet:
    path = _there(folder, record.file)
    overviews = None if record.overviews is None else folder / record.overviews
    source = open_tiles(path, overviews)[0] if record.kind == "tiles" else RasterSource.of_file(path, overviews)
    raster = Raster(source, record.treatment, keep_borders=True)
    if (raster.width, raster.height) != (record.width, record.height):
        raise DataError(
            f"{printable(str(path))} has {raster.width} x {raster.height} pixels, and {NAME} says {record.width} x "
            f"{record.height}; it changed, so write the map again with lpn map."
        )
    raster.notes = list(record.notes)
    matrix: Float64Array = np.array(record.transform).reshape(2, 3)
    return Sheet(record.name, raster, parse_crs(record.crs), matrix)


def _write(out: Path, record: MapRecord) -> None:
    write_atomic(out / NAME, msgspec.json.format(msgspec.json.encode(record), indent=1) + b"\n")


def _prepared(file: Path, target: Path, on_progress: Callable[[str], None]) -> tuple[Path | None, Path | None]:
    """Write a tiled copy of a sheet, or overviews, if it is slow to read; return the copy and the overviews, or None."""
    if is_tile_set(file):
        source, xml, _, _ = open_tiles(file)
        with source.open() as opened:
            width, height = int(opened.width), int(opened.height)
        copied = paletted = has_overviews = False
    else:
        with _gdal.opened(file) as opened:
            width, height = int(opened.width), int(opened.height)
            tiled = opened.block_shapes[0][1] < width or len(opened.overviews(1)) > 0
            has_overviews = len(opened.overviews(1)) > 0
            paletted = opened.colorinterp[0].name == "palette"
            # A copy would lose a palette's alpha, and hide that JPEG changed an alpha band.
            clear = paletted and any(colour[3] < 255 for colour in opened.colormap(1).values())
            bound = clear or (is_jpeg(opened) and "alpha" in [meaning.name for meaning in opened.colorinterp])
            copied = not tiled and not bound and width * height > _MAX_UNTILED
            xml = _gdal.vrt_of(opened)
    if not copied and (has_overviews or max(width, height) <= _LARGE):
        return None, None
    called = printable(file.name)
    target.parent.mkdir(parents=True, exist_ok=True)
    copy, made = target.with_suffix(".tif"), target.with_suffix(".vrt")
    library = _gdal.rasterio()
    try:
        if copied:
            on_progress(f"Copying {called} into tiles: its own file is slow to read in windows.")
            with library.Env(), _gdal.open_raster(file) as opened:
                library.shutil.copy(opened, str(copy), driver="GTiff", **_TILED)
        else:
            made.write_bytes(xml)
        minutes = width * height / _gdal.PIXELS_PER_MINUTE
        about = f", which takes about {minutes:.0f} minutes" if minutes >= 2 else ""
        on_progress(f"Making overviews of {called}{about}.")
        method = "nearest" if paletted else "average"
        _gdal.build_overviews(copy if copied else made, "GTiff" if copied else "VRT", method)
    except _gdal.failures(OSError) as error:
        raise OutputError(
            f"{printable(target.name)} of the map cannot be written ({printable(str(error))[:200]}); free space for it."
        ) from error
    if copied:
        return copy, None
    made.unlink()
    written = Path(f"{made}.ovr")
    # A small sheet gets no overviews.
    return None, written.replace(target.with_suffix(".ovr")) if written.exists() else None
