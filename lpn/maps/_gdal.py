"""Rasterio, imported on first use, with GDAL's cache bounded."""

from __future__ import annotations

import logging
import os
import threading
import warnings
from functools import cache
from pathlib import Path
from typing import Any

from lpn.core.errors import DataError
from lpn.core.files import printable

# Megabytes of decoded blocks that GDAL keeps in a process; its own default is 5 % of the memory.
_CACHE_MEGABYTES = "192"
# `warnings.catch_warnings` changes the filters of all threads.
_opening = threading.Lock()


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

    return rasterio().errors.RasterioError, CPLE_BaseError, *others


def open_raster(path: Path) -> Any:
    """Open a raster file for reading.

    Raises:
        DataError: if it is missing, or no raster that GDAL reads.
    """
    library = rasterio()
    shown = printable(str(path))
    if not path.is_file():
        raise DataError(f"There is no file {shown}; check the path.")
    with _opening, warnings.catch_warnings():
        warnings.simplefilter("ignore", library.errors.NotGeoreferencedWarning)
        try:
            return library.open(path)
        except failures() as error:
            raise DataError(
                f"{shown} cannot be read as a map ({_reason(error, path)}); expected a GeoTIFF, a picture, or an "
                ".mbtiles of pictures."
            ) from error


def transform(source: Any, target: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """Transform coordinates (N,) between two CRS; longitude comes before latitude, and undefined results are inf or NaN."""
    import numpy as np

    library = rasterio()
    try:
        xs, ys = library.warp.transform(source, target, x, y)
    except failures():  # no operation between the two
        return np.full(len(x), np.inf), np.full(len(x), np.inf)
    return np.array(xs, np.float64), np.array(ys, np.float64)


def _reason(error: Exception, path: Path) -> str:
    text = printable(str(error)).replace(str(path), path.name)
    return text.removeprefix(f"'{path.name}' ").rstrip(".")[:200]
