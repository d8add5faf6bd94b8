"""All access to GDAL: rasterio, imported on first use, with few drivers, no network, and a bounded cache."""

from __future__ import annotations

import logging
import os
import re
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lpn.core.errors import DataError
from lpn.core.files import first_few, printable

if TYPE_CHECKING:
    from lpn.core.arrays import Float64Array

# Formats that surveys deliver. VRT, WMS, KML, NITF, and netCDF are left out: they open files that their contents name. HFA does,
# too, and `_flaw` checks it.
_DRIVERS = [
    *("GTiff", "JPEG", "PNG", "WEBP", "JP2OpenJPEG", "GPKG", "HFA", "BMP", "GIF", "ENVI"),
    *("MBTiles", "AAIGrid", "EHdr", "DTED", "SRTMHGT", "USGSDEM"),
]
# PROJ parameters that open files, and a path in them. A bare name is a file of PROJ's folders; a CRS name has blanks around "/".
_GRIDS = re.compile(r'grids\s*=(?!@null(?:["\s]|$))|(?:file|model|init)\s*=|PROJ4_GRIDS|PARAMETERFILE', re.IGNORECASE)
_PATH = re.compile(r"(?<! )[/\\]|[/\\](?! )")
# GDAL takes a name with one of these for the address of another file, or for a list of files.
_OTHER_FILE = re.compile(r"\?|<(?:VRT|GDAL|WCS|WM[ST]|TileMap|Services|Capabilities)", re.IGNORECASE)
# Variables set before take precedence. GDAL_CACHEMAX is in megabytes; GDAL's default is 5 % of the memory. The others
# keep GDAL from servers, from code in a VRT, and from databases (GeoPackage, MBTiles) that open other files as tables.
_ENVIRONMENT = {
    "GDAL_CACHEMAX": "192",
    "GDAL_SKIP": "WMS,WCS,WMTS,HTTP,EEDA,EEDAI,PLMOSAIC,DAAS,STACTA,STACIT",
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "none",
    "GDAL_VRT_ENABLE_PYTHON": "NO",
    "OGR_SQLITE_STATIC_VIRTUAL_OGR": "NO",
    "PROJ_NETWORK": "OFF",
}
# A hyperspectral camera has some hundred bands. A damaged header may name 65,535, and rasterio takes seconds to list these.
_MAX_BANDS = 4096
# Pixels a minute, measured while overviews of an empty file of three bands were built, and the maximum of minutes for a file.
_PIXELS_PER_MINUTE, _MOST_MINUTES = 1.3e9, 10
# `warnings.catch_warnings` changes the filters of all threads, so one thread at a time uses it.
_opening = threading.Lock()

# Remedies for files that are no maps, by their endings.
_REMEDIES = {
    (".mp4", ".mov", ".mkv", ".avi", ".srt"): "make a flight of it with lpn flight",
    (".pth", ".pt", ".ckpt", ".safetensors", ".onnx"): "give a model with --model",
    (".las", ".laz", ".ply", ".e57"): "give the orthophoto and not the point cloud",
    (".kml", ".kmz"): "give the picture in it, with --corners",
}
_CONVERT = "expected a GeoTIFF, a picture, or an .mbtiles of pictures, so convert, unpack, or copy it again"


@cache
def rasterio() -> Any:
    """Import rasterio (the extra `maps`)."""
    for name, value in _ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    import rasterio
    import rasterio.shutil
    import rasterio.vrt
    import rasterio.warp

    # GDAL's messages would repeat the errors of this package.
    logging.getLogger("rasterio").setLevel(logging.CRITICAL)
    return rasterio


@cache
def failures(*others: type[Exception]) -> tuple[type[Exception], ...]:
    """Return rasterio's error classes, and others; errors of GDAL do not derive from the public class."""
    from rasterio._err import CPLE_BaseError

    # Rasterio raises UnicodeDecodeError where GDAL's message quotes a damaged file.
    return rasterio().errors.RasterioError, CPLE_BaseError, UnicodeDecodeError, *others


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open a raster file of a user for reading, by the drivers of the list, and close it.

    Raises:
        DataError: if it is missing, has a format that is not read here, or takes pixels from another folder; also if GDAL fails
            while the file is open.
    """
    name = printable(str(path))
    if not path.is_file():
        raise DataError(f"There is no file {name}; check the path.")
    # GDAL opens these files with any of its drivers.
    for beside in named(path.parent, [f"{path.name}{end}".lower() for end in (".ovr", ".msk", ".aux")]):
        if not beside.is_file() or _head(beside).lstrip().startswith(b"<"):
            raise DataError(f"{printable(str(beside))} holds no overviews and no mask; delete it, or make it again.")
    with quietly():
        try:
            # GDAL never takes an absolute path for an address or another name.
            file = rasterio().io.DatasetReader(str(path.absolute()), driver=_DRIVERS)
            flaw = _flaw(file, path)
        except failures() as error:
            remedies = (remedy for endings, remedy in _REMEDIES.items() if path.suffix.lower() in endings)
            raise DataError(
                f"{name} {_begins(path)}cannot be read as a map ({_reason(error, path)}); {next(remedies, _CONVERT)}."
            ) from error
    with file:
        if flaw:
            raise DataError(f"{name} {flaw}")
        try:
            yield file
        except failures() as error:
            raise damaged(path, error) from error


@contextmanager
def quietly() -> Iterator[None]:
    """Open files without rasterio's warning that one has no georeference."""
    library = rasterio()
    with _opening, warnings.catch_warnings(), library.Env():
        warnings.simplefilter("ignore", library.errors.NotGeoreferencedWarning)
        yield


def _begins(path: Path) -> str:
    """Say that a file is empty, or quote its first words, such as those of a web page or a Git LFS pointer."""
    try:
        head = " ".join(_head(path).decode("ascii").split())
    except (OSError, UnicodeDecodeError):
        return ""
    if not head.isprintable():  # of a picture or an archive
        return ""
    return f"begins with {head!r} and " if head else "is empty and "


def named(folder: Path, names: Sequence[str]) -> list[Path]:
    """Return the entries of a folder with these names (in lower case) in any case, in the order of the names."""
    found = [path for path in folder.iterdir() if path.name.lower() in names]
    return sorted(found, key=lambda path: names.index(path.name.lower()))


def _flaw(file: Any, path: Path) -> str | None:
    """Return the fault and the remedy of an open raster that is no map; None if it has none."""
    if file.count > _MAX_BANDS:
        return f"would have {file.count} bands; it is damaged, so copy it again."
    if not file.count:
        names = [printable(name.rpartition(":")[2]) for name in file.subdatasets]
        return f"holds {len(names)} rasters ({first_few(names, 3)}); a map has one, so export the right one as GeoTIFF."
    if file.driver == "MBTiles" and file.tags().get("scheme", "").lower() == "xyz":
        return "counts rows from the north (scheme xyz); expected from the south, so make it anew, such as with QGIS."
    if file.tags(ns="OVERVIEWS"):
        return "names a file of its overviews; make a copy without that file, such as with gdal_translate."
    systems = [crs for crs in (file.crs, file.gcps[1]) if crs]
    if any(names_a_path(crs.to_wkt(version=version)) for version in (None, "WKT2_2019") for crs in systems):
        return "has a CRS that names a file by its path; give it another one, such as with gdal_edit -a_srs EPSG:32632."
    folder = os.path.normpath(path.absolute().parent)
    # A file of ERDAS Imagine may store its pixels elsewhere.
    if other := next((name for name in file.files if not Path(os.path.normpath(name)).is_relative_to(folder)), None):
        return f"takes pixels from another folder ({printable(other)}); make one file of it with gdal_translate."
    return None


def names_a_path(crs: str) -> bool:
    """Return whether the text of a CRS makes PROJ open a path or an address."""
    return bool(_GRIDS.search(crs) and _PATH.search(crs))


def open_vrt(xml: str) -> Any:
    """Open a VRT from its text."""
    with quietly():
        return rasterio().MemoryFile(xml.encode(), ext=".vrt").open(driver="VRT")


def vrt_name(path: Path, driver: str) -> str:
    """Return a name for a file in a VRT that makes GDAL use one driver; GDAL would try all of them.

    Raises:
        DataError: if a VRT cannot contain the path.
    """
    if _OTHER_FILE.search(str(path.absolute())):
        raise DataError(
            f"{printable(str(path))} has ? or < in its path, by which GDAL would open another file; rename it."
        )
    return f"vrt://{path.absolute()}?if={driver}"


def check_work(file: Any, path: Path) -> None:
    """Refuse a raster if reading all pixels of its coarsest overview would take too long."""
    minutes = file.width * file.height / max([1, *file.overviews(1)]) ** 2 / _PIXELS_PER_MINUTE
    if minutes > _MOST_MINUTES:
        raise DataError(
            f"{printable(str(path))} has {file.width} x {file.height} pixels, and a first look at it would take "
            f"{minutes:.0f} minutes or more; cut it to the ground that you need (gdal_translate -projwin), or give it coarser "
            "overviews (gdaladdo)."
        )


def damaged(path: Path, error: Exception) -> DataError:
    """Return the error for a raster file that GDAL opens but cannot read."""
    return DataError(
        f"{printable(str(path))} is damaged, incomplete, or changed while it was read ({_reason(error, path)}); copy it "
        "again, with the files that it refers to."
    )


def epsg(code: int) -> Any:
    """Return the CRS of an EPSG code."""
    return rasterio().crs.CRS.from_epsg(code)


def transform(source: Any, target: Any, points: Float64Array) -> Float64Array:
    """Transform points, (N, 2), between two CRS; longitude comes before latitude, and undefined results are inf or NaN."""
    import numpy as np

    try:
        return np.stack(rasterio().warp.transform(source, target, *points.T), axis=1).astype(np.float64)
    except failures():  # no operation between the two
        return np.full(points.shape, np.inf)


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(60)


def _reason(error: Exception, path: Path) -> str:
    while isinstance(error.__cause__, Exception):  # the cause says more than "Read failed"
        error = error.__cause__
    if isinstance(error, UnicodeDecodeError):
        return "damaged text"
    text = printable(str(error)).replace(str(path.absolute()), path.name)
    return text.removeprefix(f"'{path.name}' ").rstrip(".")[:200]
