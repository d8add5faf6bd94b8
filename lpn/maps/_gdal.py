"""Rasterio, imported on first use, with GDAL's cache bounded."""

from __future__ import annotations

import logging
import os
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from lpn.core.errors import DataError
from lpn.core.files import first_few, printable

# Megabytes of decoded blocks that GDAL keeps in a process; its own default is 5 % of the memory.
_CACHE_MEGABYTES = "192"
# A hyperspectral camera has some hundred bands; a damaged header may say 65,535, which rasterio takes seconds to look at.
_MAX_BANDS = 4096
# `warnings.catch_warnings` changes the filters of all threads.
_opening = threading.Lock()

# Files that people give as maps and GDAL does not read here: suffixes, how the file begins, what it is, and what to do.
_OTHERS: tuple[tuple[tuple[str, ...], bytes, str, str], ...] = (
    ((), b"version https://git-lfs", "a Git LFS pointer, not the file itself", "fetch it with git lfs pull"),
    ((), b"<!DOCTYPE html", "a page of HTML, as a failed download leaves it", "download the file again"),
    ((), b"<html", "a page of HTML, as a failed download leaves it", "download the file again"),
    ((".ecw",), b"", "an ECW file, whose reader is not free", "convert it to GeoTIFF, such as with QGIS"),
    ((".sid",), b"msid", "a MrSID file, whose reader is not free", "convert it to GeoTIFF, such as with QGIS"),
    ((".pdf",), b"%PDF", "a PDF", "export the map as GeoTIFF"),
    ((".zip", ".7z", ".rar", ".gz", ".tgz", ".tar"), b"", "an archive", "unpack it first"),
    ((".pmtiles",), b"PMTiles", "a PMTiles archive", "convert it to .mbtiles, such as with pmtiles convert"),
    ((".las", ".laz", ".copc", ".ply", ".e57"), b"LASF", "a point cloud", "give the orthophoto"),
    ((".obj", ".fbx", ".glb", ".gltf", ".b3dm", ".osgb"), b"glTF", "a textured model", "give the orthophoto"),
    ((".qgz", ".qgs", ".psx", ".p4d", ".aprx"), b"", "a project", "export the map as GeoTIFF"),
    ((".shp", ".geojson", ".gpx", ".dxf", ".dwg"), b"", "a file of lines and points", "give a raster"),
    ((".kml", ".kmz"), b"", "a file of Google Earth without one picture on the ground", "export the map as GeoTIFF"),
    ((".tpk", ".tpkx", ".bundle"), b"", "a tile package of ArcGIS", "export the map as GeoTIFF"),
    (
        (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".srt"),
        b"",
        "a video or its subtitles",
        "make a flight of it with lpn flight",
    ),
    ((".pth", ".pt", ".ckpt", ".safetensors", ".onnx"), b"", "a file of a model", "give it with --model"),
    ((), b"PK\x03\x04", "a zip archive", "unpack it first"),
)


@cache
def rasterio() -> Any:
    """Import rasterio (the extra `maps`); GDAL_CACHEMAX in the environment takes precedence over our limit."""
    os.environ.setdefault("GDAL_CACHEMAX", _CACHE_MEGABYTES)
    import rasterio
    import rasterio.shutil
    import rasterio.warp

    # GDAL's messages would add to ours.
    logging.getLogger("rasterio").setLevel(logging.CRITICAL)
    return rasterio


@cache
def failures(*others: type[Exception]) -> tuple[type[Exception], ...]:
    """Return the classes of rasterio's errors, and others; GDAL's own do not derive from rasterio's public one."""
    from rasterio._err import CPLE_BaseError

    # Rasterio raises UnicodeDecodeError where GDAL's message quotes a damaged file.
    return rasterio().errors.RasterioError, CPLE_BaseError, UnicodeDecodeError, *others


def open_raster(path: Path) -> Any:
    """Open a raster file for reading.

    Raises:
        DataError: if it is missing, or no raster that GDAL reads.
    """
    library = rasterio()
    file_name = printable(str(path))
    if not path.is_file():
        raise DataError(f"There is no file {file_name}; check the path.")
    with _opening, warnings.catch_warnings():
        warnings.simplefilter("ignore", library.errors.NotGeoreferencedWarning)
        try:
            file = library.open(path)
        except failures() as error:
            if other := _other(path):
                raise DataError(f"{file_name} is {other[0]}; {other[1]}.") from error
            raise DataError(
                f"{file_name} cannot be read as a map ({_reason(error, path)}); expected a GeoTIFF, a picture, or an "
                ".mbtiles of pictures."
            ) from error
    if file.count > _MAX_BANDS:
        file.close()
        raise DataError(f"{file_name} would have {file.count} bands; it is damaged, so copy it again.")
    if not file.count:
        names = [printable(name.rpartition(":")[2]) for name in file.subdatasets]
        file.close()
        raise DataError(
            f"{file_name} holds {len(names)} rasters ({first_few(names, 3)}), and a map is one; export the right one as GeoTIFF."
            if names
            else f"{file_name} holds no raster; expected a GeoTIFF, a picture, or an .mbtiles of pictures."
        )
    return file


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open a raster file, and close it.

    Raises:
        DataError: as `open_raster`, and if GDAL refuses what is done with it.
    """
    with open_raster(path) as file:
        try:
            yield file
        except failures() as error:
            raise damaged(path, error) from error


def damaged(path: Path, error: Exception) -> DataError:
    """Return the error for a raster file that GDAL opens and then cannot read."""
    return DataError(
        f"{printable(str(path))} is damaged, incomplete, or changed while it was read ({_reason(error, path)}); copy it "
        "again, with the files that it refers to."
    )


def transform(source: Any, target: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """Transform coordinates (N,) between two CRS; longitude comes before latitude, and undefined results are inf or NaN."""
    import numpy as np

    library = rasterio()
    try:
        xs, ys = library.warp.transform(source, target, x, y)
    except failures():  # no operation between the two
        return np.full(len(x), np.inf), np.full(len(x), np.inf)
    return np.array(xs, np.float64), np.array(ys, np.float64)


def _other(path: Path) -> tuple[str, str] | None:
    """Return what a file is that is no raster, and what to do; None if that is not known."""
    try:
        with path.open("rb") as file:
            head = file.read(64)
    except OSError:
        return None
    if not head:
        return "empty", "copy or download it again"
    suffix = path.suffix.lower()
    return next(
        (
            (kind, remedy)
            for suffixes, magic, kind, remedy in _OTHERS
            if suffix in suffixes or (magic and head.lower().startswith(magic.lower()))
        ),
        None,
    )


def _reason(error: Exception, path: Path) -> str:
    while isinstance(error.__cause__, Exception):  # which says more than "Read failed"
        error = error.__cause__
    if isinstance(error, UnicodeDecodeError):
        return "damaged text"
    text = printable(str(error)).replace(str(path), path.name)
    return text.removeprefix(f"'{path.name}' ").rstrip(".")[:200]
