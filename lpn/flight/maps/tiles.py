"""Folders of picture tiles in Web Mercator, {z}/{x}/{y}.png, packed as an .mbtiles, which GDAL reads."""

from __future__ import annotations

import io
import itertools
import json
import math
import os
import re
import sqlite3
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
from PIL import Image

from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.datasets.integrity import list_errors, stream_error

# Half the side of the square that Web Mercator (EPSG:3857) shows, in metres of the projection.
_HALF = math.pi * 6_378_137.0
# Maximum of files and folders that are searched for a first tile, and of pixels along a side of the raster.
_MAX_ENTRIES, _MAX_PIXELS = 20_000, 1 << 30
# The deepest zoom that GDAL reads in an .mbtiles.
_ZOOM = 22
_TILE = re.compile(
    r"(?P<z>[12]?\d|30)/(?P<x>\d{1,9})/(?P<y>\d{1,9})(?:@2x)?(?:\.(?:png|jpe?g|webp|pbf|mvt))?(?:\.tile)?",
    re.IGNORECASE | re.ASCII,
)
# The beginnings of files that GDAL reads as tiles. Pillow would run Ghostscript for others.
_PICTURE = re.compile(rb"\x89PNG|\xff\xd8\xff|RIFF....WEBP", re.DOTALL)
# The kinds of pixels that GDAL takes as colours.
_MODES = ("RGB", "RGBA", "L", "LA", "P")
# gdal2tiles writes this file beside tiles that count rows from the south (TMS).
_TMS = "tilemapresource.xml"
_METADATA = ("metadata.json", "tilejson.json", "tile.json", "tiles.json")
# Web Mercator by its names in metadata.
_WEB_MERCATOR = ("mercator", "3857", "900913", "3785", "102100", "102113", "41001")


def is_tile_set(path: Path) -> bool:
    """Return whether a path is a folder of tiles."""
    return path.is_dir() and any(_TILE.fullmatch(name) for name, _ in itertools.islice(_walk(path), _MAX_ENTRIES))


def tiles_near(folder: Path) -> Path | None:
    """Return the folder of tiles inside or around a folder; None if there is none."""
    if folder.name.isdecimal() and is_tile_set(folder.absolute().parent):
        return folder.absolute().parent
    inside = [path for path in sorted(folder.iterdir()) if path.is_dir()][:50]
    return next((path for path in inside if is_tile_set(path)), None)


def pack_tiles(folder: Path, out: Path) -> tuple[Float64Array, list[str]]:
    """Write the deepest zoom of a folder of tiles as an .mbtiles, in which missing tiles have no data.

    The .mbtiles holds them as if they lay at a corner of the world, at a zoom that GDAL reads.

    Returns:
        The matrix, (2, 3), from column and row to coordinates of Web Mercator, and notes.

    Raises:
        DataError: if it holds no tiles, or the tiles are no pictures in Web Mercator.
        sqlite3.Error, OSError: if the file cannot be written.
    """
    from_south, notes = _declared(folder)
    zooms: dict[int, dict[tuple[int, int], Path]] = {}
    for name, file in _walk(folder):
        if match := _TILE.fullmatch(name):
            zoom, x, y = int(match["z"]), int(match["x"]), int(match["y"])
            place = x, y if from_south else (1 << zoom) - 1 - y
            # {y}@2x.png takes precedence over {y}.png.
            if place not in (tiles := zooms.setdefault(zoom, {})) or "@2x" in file.name:
                tiles[place] = file
    zoom = max(zooms)
    tiles = zooms[zoom]
    low, high = np.min([*tiles], 0), np.max([*tiles], 0)
    if low.min() < 0 or high.max() >= 1 << zoom:
        raise DataError(
            f"{printable(str(folder))} has tiles beyond {(1 << zoom) - 1} at zoom {zoom}; expected numbers of Web Mercator."
        )
    with ThreadPoolExecutor() as pool:
        checked = zip(tiles.values(), pool.map(_error, tiles.values()), strict=True)
        errors = {file: error for file, error in checked if error is not None}
    sound = {place: file for place, file in tiles.items() if file not in errors}
    sides = {max(_size(file)) for file in sound.values()}
    if not sides:
        raise DataError(
            f"The tiles of {printable(str(folder))} at zoom {zoom} are no PNG, JPEG, or WebP; expected pictures, so render "
            "vector tiles, or take tiles of an orthophoto."
        )
    side = max(sides)
    if (high - low + 1).max() * side > _MAX_PIXELS:
        raise DataError(
            f"The tiles of {printable(str(folder))} lie too far apart for one map; take out those of other places."
        )
    called = printable(folder.name)
    missing = 1 - len(sound) / float(np.prod(high - low + 1.0))
    gaps = f"; {missing:.0%} of its rectangle have no tile." if missing > 0 else "."
    notes.insert(0, f"{called} is shown at zoom {zoom}, the deepest of {len(zooms)}{gaps}")
    for z, other in zooms.items():
        at = np.array([*other])
        if (at < low >> zoom - z).any() or (at > high >> zoom - z).any():
            notes.append(f"Zoom {z} of {called} reaches further than zoom {zoom}; that part is not shown.")
    if errors:
        notes.append(
            f"The tiles of {called} that are no whole PNG, JPEG, or WebP, as failed downloads are, have no data: "
            f"{list_errors(errors, folder)}."
        )
    with closing(sqlite3.connect(out)) as database, database:
        database.execute("CREATE TABLE metadata (name TEXT, value TEXT)")
        database.execute(
            "CREATE TABLE tiles (zoom_level INTEGER, tile_column INTEGER, tile_row INTEGER, tile_data BLOB, "
            "PRIMARY KEY (zoom_level, tile_column, tile_row))"
        )
        # Clear tiles at two corners preserve the rectangle's size if no tile with data lies there.
        for place in {(*low.tolist(),), (*high.tolist(),), *sound}:
            data = _encoded(sound.get(place), side)
            database.execute("INSERT INTO tiles VALUES (?, ?, ?, ?)", (_ZOOM, *np.subtract(place, low).tolist(), data))
    newest = max(file.stat().st_mtime_ns for file in tiles.values())
    os.utime(out, ns=(newest, newest))
    pixel = 2 * _HALF / (side << zoom)
    west, north = low[0] * side * pixel - _HALF, (high[1] + 1) * side * pixel - _HALF
    return np.array([[pixel, 0, west], [0, -pixel, north]]), notes


def _encoded(file: Path | None, side: int) -> bytes:
    """Return a tile of some side in a format that GDAL reads, a clear one for None."""
    if file is None:
        picture = Image.new("RGBA", (side, side))
    else:
        with Image.open(file) as found:
            if found.size == (side, side) and found.mode in _MODES:
                return file.read_bytes()
            picture = found.convert("RGBA").resize((side, side))
    picture.save(data := io.BytesIO(), "PNG")
    return data.getvalue()


def _error(file: Path) -> str | None:
    """Return the error of a tile that GDAL would leave out; None if it is good."""
    try:
        data = file.read_bytes()
    except OSError as error:
        return f"cannot be read ({error.strerror or error})"
    return stream_error(io.BytesIO(data), decode=True) if _PICTURE.match(data) else "is no picture"


def _size(file: Path) -> tuple[int, int]:
    with Image.open(file) as picture:
        return picture.size


def _declared(folder: Path) -> tuple[bool, list[str]]:
    """Tell by tilemapresource.xml or a TileJSON whether rows count from the south, and return notes about it."""
    texts: list[str] = []
    scheme: str | None = None
    if (folder / _TMS).is_file():
        text, scheme = (folder / _TMS).read_bytes()[: 1 << 16].decode("utf-8", "replace"), "tms"
        texts = re.findall(r"<SRS>\s*([^<]+?)\s*</SRS>", text) or re.findall(r"profile\s*=\s*[\"']([^\"']+)", text)
    else:
        for name in _METADATA:
            with suppress(OSError, ValueError, RecursionError):
                values = json.loads((folder / name).read_bytes())
                if isinstance(values, dict):
                    texts = [str(values[key]) for key in ("crs", "srs", "profile") if values.get(key)]
                    scheme = str(values.get("scheme", "")).lower() or None
                    break
    if other := next((text for text in texts if not any(name in text.lower() for name in _WEB_MERCATOR)), None):
        raise DataError(
            f"The tiles of {printable(str(folder))} are in {printable(other)[:60]}; expected Web Mercator (EPSG:3857), so make "
            "them with that profile, or give the raster that they were made of."
        )
    if scheme in ("tms", "xyz"):
        return scheme == "tms", []
    return False, [
        f"{printable(folder.name)} does not say where its rows begin; they are counted from the north (XYZ). For rows from the "
        "south (TMS), add a tilemapresource.xml."
    ]


def _walk(folder: Path) -> Iterator[tuple[str, Path]]:
    """Yield the files of a folder in order, each after its path within the folder."""
    for root, folders, names in os.walk(folder):
        folders.sort()
        inside = Path(root)
        prefix = inside.relative_to(folder).as_posix()
        for name in sorted(names):
            yield (name if prefix == "." else f"{prefix}/{name}"), inside / name
