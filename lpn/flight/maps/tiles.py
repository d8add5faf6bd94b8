"""Folders of picture tiles in Web Mercator, {z}/{x}/{y}.png, as one raster of their deepest zoom."""

from __future__ import annotations

import itertools
import json
import math
import os
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.flight.maps import _gdal, vrt
from lpn.flight.maps.vrt import RasterSource, source_xml

# Half the side of the square that Web Mercator (EPSG:3857) shows, in its own metres.
_HALF = math.pi * 6_378_137.0
# Most files and folders that are searched for a first tile, and most pixels along a side of the raster.
_MAX_ENTRIES, _MAX_PIXELS = 20_000, 1 << 30
_VECTOR = (".pbf", ".mvt")
_TILE = re.compile(
    r"(?P<z>[12]?\d|30)/(?P<x>\d{1,9})/(?P<y>\d{1,9})(?:@2x)?(?:\.(?:png|jpe?g|webp|gif|bmp|pbf|mvt))?(?:\.tile)?",
    re.IGNORECASE | re.ASCII,
)
# Formats by their names in Pillow and GDAL alike. The list keeps Pillow from running Ghostscript for a tile in PostScript.
_FORMATS = ("PNG", "JPEG", "WEBP", "GIF", "BMP")
# GDAL opens files with these endings beside a tile; `_gdal` checks each.
_BESIDE = (".ovr", ".msk", ".aux", ".aux.xml")
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


def open_tiles(folder: Path, overviews: Path | None = None) -> tuple[RasterSource, bytes, Any, Float64Array]:
    """Return the deepest zoom of a folder of tiles as a source of RGB and alpha; missing tiles have no data.

    Args:
        overviews: a separate file of its overviews, if there is one.

    Returns:
        The source, its VRT, its CRS, and the matrix, (2, 3), from column and row to coordinates.

    Raises:
        DataError: if it holds no tiles, or the tiles are no pictures in Web Mercator.
    """
    from_south, notes = _declared(folder)
    zooms: dict[int, dict[tuple[int, int], Path]] = {}
    for name, file in _walk(folder):
        if match := _TILE.fullmatch(name):
            zoom, x, y = int(match["z"]), int(match["x"]), int(match["y"])
            place = x, (1 << zoom) - 1 - y if from_south else y
            # {y}@2x.png takes precedence over {y}.png.
            if place not in (tiles := zooms.setdefault(zoom, {})) or "@2x" in file.name:
                tiles[place] = file
    if not zooms:
        raise DataError(f"{printable(str(folder))} holds no tiles {{z}}/{{x}}/{{y}}.png; check the path.")
    zoom = max(zooms)
    tiles = zooms[zoom]
    (west, north), (east, south) = np.min([*tiles], 0).tolist(), np.max([*tiles], 0).tolist()
    if min(west, north) < 0 or max(east, south) >= 1 << zoom:
        raise DataError(
            f"{printable(str(folder))} has tiles up to {east}, {south} at zoom {zoom}; expected numbers below {1 << zoom}."
        )
    pictures, broken = _pictures(folder, tiles)
    side = Counter(width for _, width, _, _ in pictures.values()).most_common(1)[0][0]
    size = (east - west + 1) * side, (south - north + 1) * side
    if max(size) > _MAX_PIXELS:
        raise DataError(
            f"The tiles of {printable(str(folder))} lie too far apart for one map; take out those of other places."
        )
    called = printable(folder.name)
    missing = 1 - len(pictures) * side * side / (size[0] * size[1])
    gaps = f"; {missing:.0%} of its rectangle have no tile." if missing > 0 else "."
    notes.insert(0, f"{called} is shown at zoom {zoom}, the deepest of {len(zooms)}{gaps}")
    if broken:
        notes.append(f"Some tiles of {called} are text, as a failed download leaves them; they have no data.")
    corners = np.array([(west, north), (east, south)])
    ends = {
        z: np.array([np.min([*other], 0), np.max([*other], 0)]) - (corners >> zoom - z) for z, other in zooms.items()
    }
    if further := [z for z, (low, high) in ends.items() if (low < 0).any() or (high > 0).any()]:
        notes.append(f"Zoom {max(further)} of {called} reaches further than zoom {zoom}; that part is not shown.")
    bands: list[list[str]] = [[], [], [], []]
    for (x, y), (file, width, mode, driver) in pictures.items():
        box = (x - west) * float(side), (y - north) * float(side), float(side), float(side)
        name = _gdal.vrt_name(str(file.absolute()), driver)
        for band, (number, inner) in zip(bands, _sources(mode), strict=True):
            band.append(source_xml(name, number, (width, width), box, inner, "nearest" if mode == "P" else "average"))
    xml = vrt.rgba_xml(size, bands)
    memory = _gdal.in_memory(xml if overviews is None else _gdal.with_overviews(xml, overviews))
    used = sorted([file for file, *_ in pictures.values()] + ([] if overviews is None else [overviews]))
    source = RasterSource(
        folder, memory.name, lambda: _gdal.open_vrt(memory.name), lambda: used, notes, overviews, memory
    )
    pixel = 2 * _HALF / (side << zoom)
    matrix = np.array([[pixel, 0, west * side * pixel - _HALF], [0, -pixel, _HALF - north * side * pixel]])
    return source, xml, _gdal.rasterio().crs.CRS.from_epsg(3857), matrix


def _pictures(
    folder: Path, tiles: dict[tuple[int, int], Path]
) -> tuple[dict[tuple[int, int], tuple[Path, int, str, str]], bool]:
    """Return file, side, mode, and GDAL driver of each tile that is not empty or text, and whether some tile is text."""
    beside = {name.lower() for name, _ in _walk(folder) if name.lower().endswith(_BESIDE)}
    pictures, broken = {}, False
    for place, file in tiles.items():
        if file.suffix.lower() in _VECTOR:
            raise DataError(
                f"{printable(str(folder))} holds vector tiles (pbf); expected pictures, so render it, or take tiles of an "
                "orthophoto."
            )
        try:
            with file.open("rb") as opened:
                head = opened.read(64)
                if not head or head.lstrip().startswith((b"<", b"{")):
                    broken |= bool(head)
                    continue
                with Image.open(opened, formats=_FORMATS) as image:
                    width, height, mode, driver = *image.size, image.mode, str(image.format)
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise DataError(
                f"The tile {printable(str(file))} cannot be read as a picture; delete it, or make it again."
            ) from error
        if width != height or mode not in ("RGB", "RGBA", "L", "LA", "P"):
            raise DataError(
                f"The tile {printable(str(file))} has {width} x {height} pixels of the kind {mode}; expected a square in RGB or "
                "grey, or with a palette."
            )
        if beside and any(f"{file.relative_to(folder).as_posix()}{end}".lower() in beside for end in _BESIDE):
            with _gdal.opened(file):
                pass
        pictures[place] = file, width, mode, driver
    if not pictures:
        raise DataError(f"All tiles of {printable(str(folder))} at its deepest zoom are empty; make them again.")
    return pictures, broken


def _sources(mode: str) -> list[tuple[int, str]]:
    """Return the band of a tile and the inner part of its source for red, green, blue, and alpha."""
    if mode == "P":
        return [(1, vrt.palette(entry)) for entry in (1, 2, 3, 4)]
    colours = (1, 2, 3) if mode.startswith("RGB") else (1, 1, 1)
    alpha = (len(mode), vrt.SOME) if mode.endswith("A") else (1, vrt.OPAQUE)
    return [*((number, "") for number in colours), alpha]


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
