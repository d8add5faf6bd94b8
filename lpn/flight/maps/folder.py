"""The folder of a map: map.json, the coverage, and copies or overviews of sheets that would be slow to read.

    map.json            format, frame, and for each sheet its file, CRS, transform, and treatment; names them when all are done
    coverage.png        share of each cell that is valid, 0 to 255
    sheets/01.ovr       overviews of a large sheet without any
    sheets/02.tif       a tiled copy, with overviews, of a large sheet whose file must be read from its beginning
    sheets/elevation.tif  heights of the map's ground in metres, in the CRS and at the resolution of the file that was given

Other sheets are read where they are: map.json names them relative to its own folder.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import cv2
import msgspec
import numpy as np

from lpn.core import formats
from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError, InputError, OutputError
from lpn.core.files import check_writable, printable, write_atomic
from lpn.core.numbers import SIGMA
from lpn.flight.maps import _gdal
from lpn.flight.maps.elevation import Elevation, ElevationFile, ElevationSource, probes, write_elevation
from lpn.flight.maps.frame import LocalFrame
from lpn.flight.maps.map import Map
from lpn.flight.maps.place import MapPlace, checked_place
from lpn.flight.maps.raster import GdalRaster, Treatment, is_jpeg
from lpn.flight.maps.sheet import Sheet
from lpn.flight.maps.sources import MapOptions, files_of, georeference, open_sheet, parse_crs, raster_sheet
from lpn.flight.maps.tile_sets import is_tile_set
from lpn.flight.maps.tiles import TileRaster
from lpn.flight.maps.trials import SinglePhotoTrials

NAME = "map.json"
FORMAT = "lpn-map/1"
_COVERAGE = "coverage.png"
_SHEETS = "sheets"
_ELEVATION = "elevation.tif"
# Files that a sentence names at most.
_MOST_NAMES = 10
# Files that GDAL may write beside a raster.
_ENDS = ("", ".ovr", ".aux.xml", ".msk", ".msk.ovr")
# Endings of a copy, of overviews, and of the VRT that overviews are made of.
_KINDS = (".tif", ".ovr", ".part.tif", ".part.vrt")
# Side above which a sheet gets overviews.
_LARGE = 2048
# Pixels above which a file that is not tiled is copied.
_MAX_UNTILED = 25_000_000
_TILED = {"TILED": "YES", "BLOCKXSIZE": "512", "BLOCKYSIZE": "512", "COMPRESS": "DEFLATE", "BIGTIFF": "IF_SAFER"}


class SheetRecord(msgspec.Struct, frozen=True):
    """A sheet in map.json.

    Attributes:
        name: of the file that was given.
        file: what is read, relative to the folder where that is possible.
        kind: a raster file, or a folder or database of tiles.
        crs: EPSG code or WKT.
        transform: from column and row to coordinates, row by row.
        width, height: in pixels.
        treatment: None for tiles without a border.
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
    """The elevation in map.json: the name of the file that was given, and sentences about how it is read."""

    name: str
    notes: list[str]


class MapRecord(msgspec.Struct, frozen=True):
    """The contents of map.json.

    Attributes:
        latitude, longitude: origin of the frame in degrees.
        sheets: none until all are done.
        written: names of files in `sheets/` that `lpn map` wrote, or may have written; it replaces and deletes no others.
        elevation: of `sheets/elevation.tif`; None without one.
        place: what is known about the place beyond its georeference.
        trials: of single photos on the map; None without.
        error, surveyed_error: see `Map`.
    """

    format: str
    name: str
    latitude: float
    longitude: float
    sheets: list[SheetRecord]
    written: list[str]
    elevation: ElevationRecord | None = None
    place: MapPlace | None = None
    trials: SinglePhotoTrials | None = None
    error: float | None = None
    surveyed_error: float | None = None


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
        out: new or empty folder, or one of an earlier map, which is replaced. No file that `lpn map` did not write is changed.
        options: what is known about the files beyond what they say.
        on_progress: called with a sentence before each long step.
        elevation: heights of the map's ground; they are copied into the folder, in metres.
        place: what is known about the map's place.

    Raises:
        DataError: if a file cannot be read, or has no or an impossible georeference, or heights have an unknown or impossible
            unit, or are those of another place; nothing is written. If the elevation covers less than half of what the map shows,
            the folder is left as by a run that was killed.
        InputError: if an option or the place is malformed, or does not apply, or a file lies in the map's folder; nothing is
            written.
        OutputError: if the folder holds other files where those of the map go, or cannot be written.
    """
    options = options or MapOptions()
    place = None if place is None else checked_place(place)
    _check_unwritten(paths)
    files = files_of(paths, options)
    earlier = _written_before(out)
    heights = None if elevation is None else ElevationSource(elevation)
    _check_inputs([*files, *([] if elevation is None else [elevation.path])], out)
    return _build(files, out, options, earlier, on_progress, (), heights, place)


def _check_unwritten(paths: Sequence[Path]) -> None:
    for path in paths:
        if not (path / NAME).is_file():
            continue
        with suppress(DataError):  # a map.json of another program
            # A copy lies in the folder, and its original is known by name alone.
            sheets = [
                printable(one.name if one.file.startswith(f"{_SHEETS}/") else one.file) for one in _read(path).sheets
            ]
            further = [f"{len(sheets) - _MOST_NAMES:,} more"] if len(sheets) > _MOST_NAMES else []
            raise InputError(
                f"{printable(str(path))} is a map that lpn map wrote; give the files that it was made of: "
                f"{', '.join([*sheets[:_MOST_NAMES], *further])}."
            )


def write_own_map(
    file: Path,
    out: Path,
    notes: Sequence[str],
    on_progress: Callable[[str], None] = lambda _: None,
    heights: ElevationSource | None = None,
    place: MapPlace | None = None,
    error: float | None = None,
) -> Map:
    """Write the folder of a map whose one sheet lies in the folder itself, and return the map.

    Args:
        file: a GeoTIFF with transparency in `out`, a folder that holds nothing else.
        notes: sentences about how the sheet was made, which commands that read the map print.
        heights: of the map's ground; they are copied into the folder.
        place: what is known about the map's place; it is checked.
        error: see `Map`.

    Raises:
        DataError: if the file cannot be read, or has no valid pixel, or the heights cover less than half of what it shows.
        OutputError: if the folder cannot be written.
    """
    place = None if place is None else checked_place(place)
    return _build([file], out, MapOptions(keep_borders=True), set(), on_progress, notes, heights, place, error)


def _build(
    files: Sequence[Path],
    out: Path,
    options: MapOptions,
    earlier: set[str],
    on_progress: Callable[[str], None],
    notes: Sequence[str] = (),
    heights: ElevationSource | None = None,
    map_place: MapPlace | None = None,
    error: float | None = None,
) -> Map:
    """Write the folder of a map whose place is checked; `earlier` are the names in `sheets/` that it may replace."""
    places = [None if is_tile_set(file) else georeference(file, options) for file in files]
    _check_places(files, places, options, heights)
    targets = [out / _SHEETS / f"{number:02d}" for number in range(1, len(files) + 1)]
    planned = {
        name for target, place in zip(targets, places, strict=True) if place is not None for name in _names(target)
    }
    if heights is not None:
        planned |= {_ELEVATION, Path(_ELEVATION).with_suffix(".part.tif").name}
    _check_sheets(out, planned - earlier)
    check_writable(out / NAME)
    # A run that is killed leaves this record, by which the next one knows the folder, and what it may replace there.
    _write(out, MapRecord(FORMAT, files[0].stem, 0.0, 0.0, [], sorted(earlier | planned)))
    sheets, kept = [], set()
    for file, place, target in zip(files, places, targets, strict=True):
        if place is None:
            sheets.append(open_sheet(file, options))
            continue
        path, overviews = _prepared(file, target, on_progress)
        kept |= {
            f"{own.name}{end}" for own in (path, overviews) if own and own.parent == target.parent for end in _ENDS
        }
        sheets.append(raster_sheet(file, path, *place, options, overviews=overviews))
        sheets[-1].raster.notes += notes
    if heights is not None:
        kept.add(_ELEVATION)
    for name in (earlier | planned) - kept:
        (out / _SHEETS / name).unlink(missing_ok=True)
    whole = Map(files[0].stem, sheets, place=map_place, error=error)
    on_progress("Looking where the map has data.")
    if not whole.coverage().any():
        raise DataError(f"{printable(whole.name)} has no valid pixel; expected a map.")
    elevation = None
    if heights is not None:
        on_progress(f"Copying the heights of {printable(heights.path.name)}.")
        places_shown = probes(whole.bounds)
        shown = places_shown[whole.valid_shares(places_shown, whole.resolution) > 0]
        written_heights = write_elevation(heights, out / _SHEETS / _ELEVATION, whole.frame, whole.bounds, shown)
        elevation = ElevationRecord(written_heights.name, written_heights.notes)
        whole.elevation = written_heights
    coverage = np.rint(whole.coverage() * 255).astype(np.uint8)
    write_atomic(out / _COVERAGE, cv2.imencode(".png", coverage)[1].tobytes())
    records = [_record(sheet, out) for sheet in whole.sheets]
    written = sorted(name for name in kept if (out / _SHEETS / name).exists())
    frame = whole.frame
    _write(
        out,
        MapRecord(
            FORMAT, whole.name, frame.latitude, frame.longitude, records, written, elevation, map_place, error=error
        ),
    )
    return whole


def open_folder(folder: Path) -> Map:
    """Open the folder of a map.

    Raises:
        DataError: if map.json is damaged, or a sheet is missing or has changed.
    """
    record, file_name = _read(folder), printable(str(folder / NAME))
    sheets = [_opened(folder, sheet) for sheet in record.sheets]
    if not sheets:
        raise DataError(f"{file_name} names no sheet; write it again with lpn map.")
    coverage = cv2.imdecode(np.fromfile(folder / _COVERAGE, np.uint8), cv2.IMREAD_GRAYSCALE) if _has(folder) else None
    frame = LocalFrame(record.latitude, record.longitude)
    shares = None if coverage is None else (coverage / 255).astype(np.float32)
    try:
        place = checked_place(record.place or MapPlace())
    except InputError as error:
        raise DataError(f"{file_name} is damaged: {error}") from error
    if record.trials is not None and not record.trials.possible:
        raise DataError(f"{file_name} is damaged: its trials accepted more photos than were tried.")
    elevation = _opened_elevation(folder, record.elevation)
    return Map(record.name, sheets, frame, shares, elevation, place, record.trials, record.error, record.surveyed_error)


def add_trials(folder: Path, trials: SinglePhotoTrials) -> None:
    """Write the counts of trials into map.json, in place of those of earlier ones.

    Raises:
        DataError: if map.json is damaged.
    """
    _write(folder, msgspec.structs.replace(_read(folder), trials=trials))


def checked_error(metres: float) -> float:
    """Return a surveyed error of a map in metres, see `Map`.

    Raises:
        InputError: if it is not a number above 0.
    """
    if not 0 < metres < math.inf:
        raise InputError(f"The map's error is {metres:g} m; expected more than 0, {SIGMA}.")
    return metres


def add_surveyed_error(folder: Path, metres: float) -> Map:
    """Write the surveyed error of a map into map.json, in place of an earlier one, and open the map.

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
    except OSError as error:
        raise DataError(f"{file_name} cannot be read ({error.strerror or error}); check its permissions.") from error
    except (ValueError, RecursionError) as error:
        raise DataError(
            f"{file_name} is damaged, or no map; write the map again with lpn map, in a new folder."
        ) from error
    placed = abs(record.latitude) <= 90 and abs(record.longitude) <= 180
    surveyed = record.surveyed_error
    possible = 0 <= (record.error or 0.0) < math.inf and (surveyed is None or 0 < surveyed < math.inf)
    if not placed or not possible:
        raise DataError(f"{file_name} is damaged; write the map again with lpn map, in a new folder.")
    return record


def _opened_elevation(folder: Path, record: ElevationRecord | None) -> Elevation | None:
    if record is None:
        return None
    path = folder / _SHEETS / _ELEVATION
    if not path.is_file():
        raise DataError(
            f"The map {printable(str(folder))} needs {printable(str(path))}, its elevation, which is not there; bring it back, "
            "or write the map again with lpn map."
        )
    return Elevation(path, record.name, list(record.notes))


def _has(folder: Path) -> bool:
    path = folder / _COVERAGE
    return path.is_file() and path.stat().st_size > 0


def _record(sheet: Sheet, out: Path) -> SheetRecord:
    overviews = getattr(sheet.raster, "overviews", None)
    code = sheet.crs.to_epsg()
    a, b, c, d, e, f = sheet.matrix.ravel().tolist()
    raster = sheet.raster
    return SheetRecord(
        sheet.name,
        _relative(sheet.raster.path, out),
        "tiles" if isinstance(raster, TileRaster) else "raster",
        f"EPSG:{code}" if code else sheet.crs.to_wkt(),
        (a, b, c, d, e, f),
        raster.width,
        raster.height,
        raster.treatment,
        raster.notes,
        overviews and _relative(overviews, out),
    )


def _relative(path: Path, out: Path) -> str:
    try:
        return Path(os.path.relpath(path.resolve(), out.resolve())).as_posix()
    except ValueError:  # another drive
        return str(path.resolve())


def _opened(folder: Path, record: SheetRecord) -> Sheet:
    path = folder / record.file
    file_name = printable(str(path))
    if not path.exists():
        raise DataError(
            f"The map {printable(str(folder))} needs {file_name}, which is not there; bring it back, or write the map "
            "again with lpn map."
        )
    raster = (
        TileRaster(path, record.treatment, keep_borders=True)
        if record.kind == "tiles"
        else GdalRaster(
            path, record.treatment, overviews=None if record.overviews is None else folder / record.overviews
        )
    )
    if (raster.width, raster.height) != (record.width, record.height):
        raise DataError(
            f"{file_name} has {raster.width} x {raster.height} pixels, and {NAME} says {record.width} x {record.height}; "
            "it changed, so write the map again with lpn map."
        )
    raster.notes = list(record.notes)
    matrix: Float64Array = np.array(record.transform).reshape(2, 3)
    return Sheet(record.name, raster, parse_crs(record.crs), matrix)


def _write(out: Path, record: MapRecord) -> None:
    write_atomic(out / NAME, msgspec.json.format(msgspec.json.encode(record), indent=1) + b"\n")


def _names(target: Path) -> set[str]:
    """Return the names of all files that a sheet's overviews or copy may leave in `sheets/`, also after a kill."""
    return {f"{target.name}{kind}{end}" for kind in _KINDS for end in _ENDS}


def _check_inputs(files: Sequence[Path], out: Path) -> None:
    """Raise InputError if a file lies in the map's folder, whose sheets are replaced."""
    folder = out.resolve()
    if inside := next((file for file in files if file.resolve().is_relative_to(folder)), None):
        raise InputError(
            f"{printable(str(inside))} lies in {printable(str(out))}, the folder that the map is written to; choose another "
            "folder for the map."
        )


def _written_before(out: Path) -> set[str]:
    """Return the names in `sheets/` that `lpn map` wrote earlier.

    Raises:
        OutputError: if there is something at `out` that is neither an empty folder nor one of a map.
    """
    folder_name = printable(str(out))
    if out.exists() and not out.is_dir():
        raise OutputError(f"{folder_name} is a file; choose another place for the map.")
    if not out.exists():
        return set()
    if (out / NAME).exists():
        try:
            record = formats.decode_json(
                (out / NAME).read_bytes(), MapRecord, f"{folder_name}/{NAME}", FORMAT, OutputError
            )
        except (OSError, ValueError, RecursionError) as error:
            raise OutputError(
                f"{folder_name} holds a {NAME} that lpn map did not write; choose another folder for the map."
            ) from error
        # A name with a folder in it could lead elsewhere.
        return {name for name in record.written if Path(name).name == name and name != ".."}
    if other := min((path.name for path in out.iterdir()), default=None):
        raise OutputError(
            f"{folder_name} holds other files, such as {printable(other)}, and no {NAME}; choose another folder for the map."
        )
    return set()


def _check_sheets(out: Path, names: set[str]) -> None:
    """Raise OutputError if one of these names in `sheets/` is taken by a file that `lpn map` did not write."""
    if taken := next((name for name in sorted(names) if (out / _SHEETS / name).exists()), None):
        raise OutputError(
            f"{printable(str(out / _SHEETS / taken))} was not written by lpn map and would be replaced; move it, or choose "
            "another folder for the map."
        )


def _check_places(
    files: Sequence[Path],
    places: Sequence[tuple[Any, Float64Array] | None],
    options: MapOptions,
    heights: ElevationSource | None,
) -> None:
    """Refuse what cannot be a map before any long work: bands and treatments are left open."""
    quick = replace(options, keep_borders=True)
    sheets = [
        open_sheet(file, quick) if place is None else raster_sheet(file, file, *place, options, Treatment((1,)))
        for file, place in zip(files, places, strict=True)
    ]
    whole = Map(files[0].stem, sheets)
    whole.close()
    if heights is not None:
        heights.box(whole.frame, whole.bounds)


def _prepared(source: Path, target: Path, on_progress: Callable[[str], None]) -> tuple[Path, Path | None]:
    """Return the file to read a sheet from, the source or a tiled copy of it, and the file of its overviews if it has none."""
    with _gdal.opened(source) as file:
        width, height = int(file.width), int(file.height)
        tiled = file.block_shapes[0][1] < width or len(file.overviews(1)) > 0
        has_overviews = bool(file.overviews(1)) or max(width, height) <= _LARGE
        paletted = file.colorinterp[0].name == "palette"
        # A copy would lose the alpha of a palette, and hide that JPEG changed an alpha band.
        clear = paletted and any(colour[3] < 255 for colour in file.colormap(1).values())
        bound = clear or (is_jpeg(file) and "alpha" in [meaning.name for meaning in file.colorinterp])
    copied = not tiled and not bound and width * height > _MAX_UNTILED
    if has_overviews and not copied:
        return source, None
    library = _gdal.rasterio()
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_suffix(".part.tif" if copied else ".part.vrt")
    whole = target.with_suffix(".tif" if copied else ".ovr")
    try:
        with library.Env(), _gdal.open_raster(source) as file:
            if copied:
                on_progress(f"Copying {printable(source.name)} into tiles: its own file is slow to read in windows.")
                library.shutil.copy(file, str(part), driver="GTiff", **_TILED)
            else:
                part.write_bytes(_gdal.vrt_of(file))
            minutes = width * height / _gdal.PIXELS_PER_MINUTE
            about = f", which takes about {minutes:.0f} minutes" if minutes >= 2 else ""
            on_progress(f"Making overviews of {printable(source.name)}{about}.")
            _gdal.build_overviews(part, "GTiff" if copied else "VRT", "nearest" if paletted else "average")
    except _gdal.failures(OSError) as error:
        raise OutputError(
            f"{printable(str(whole))} cannot be written ({printable(str(error))[:200]}); free space, or check "
            f"{printable(source.name)}."
        ) from error
    if copied:
        part.replace(whole)
        return whole, None
    made = Path(f"{part}.ovr")
    if not made.exists():  # too small for any
        return source, None
    made.replace(whole)
    return source, whole
