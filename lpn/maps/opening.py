"""Opening a map from any of its forms."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lpn.core.errors import InputError
from lpn.maps.map import Map
from lpn.maps.sources import MapOptions, raster_sheet


def open_map(where: str | Path | Sequence[str | Path], options: MapOptions | None = None) -> Map:
    """Open a map.

    Args:
        where: a georeferenced raster, or several that are sheets of one map.
        options: what is known about the files beyond what they say.

    Raises:
        DataError: if a file cannot be read, or has no or an impossible georeference.
        InputError: if an option is malformed or does not apply.
        ModuleNotFoundError: if rasterio (the extra `maps`) is not installed.
    """
    options = options or MapOptions()
    paths = [Path(where)] if isinstance(where, str | Path) else [Path(path) for path in where]
    if not paths:
        raise InputError("A map needs at least one file; found none.")
    if options.corners is not None and len(paths) > 1:
        raise InputError(f"Corners belong to one picture, and {len(paths)} files are given; give one.")
    return Map(paths[0].stem, [raster_sheet(path, options) for path in paths])
