"""Opening a map from any of its forms."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.flight.maps.folder import NAME, open_folder
from lpn.flight.maps.map import Map
from lpn.flight.maps.sources import MapOptions, files_of, open_sheet


def open_map(where: str | Path | Sequence[str | Path], options: MapOptions | None = None) -> Map:
    """Open a map.

    Args:
        where: a folder of `lpn map`; or what `lpn map` takes: a georeferenced raster, a list of corners, a folder of tiles or
            of rasters, or several of these, which are sheets of one map.
        options: what is known about the files beyond what they say.

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
