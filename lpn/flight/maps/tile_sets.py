"""Folders of picture tiles in Web Mercator, as they are stored: {z}/{x}/{y}.png, {y}@2x.png, .png.tile."""

from __future__ import annotations

import itertools
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable

# The two numbers of a tile as they are stored, before it is known in which direction they count.
TileAddress = tuple[int, int]
# West, south, east, north in degrees.
Degrees = tuple[float, float, float, float]

MAX_ZOOM = 30
# Folders and files that are looked through for a first tile.
_MAX_ENTRIES = 20_000
# Tiles whose places are listed.
_MAX_PLACES = 100_000
_VECTOR = ("pbf", "mvt")
_TILE = re.compile(
    r"(?P<z>\d{1,2})/(?P<x>\d{1,9})/(?P<y>\d{1,9})(?:@2x)?(?:\.(?:png|jpe?g|webp|gif|bmp|pbf|mvt))?(?:\.tile)?",
    re.IGNORECASE | re.ASCII,
)
# gdal2tiles writes this file beside tiles that count rows from the south (TMS).
_TMS = "tilemapresource.xml"
_METADATA = ("metadata.json", "tilejson.json", "tile.json", "tiles.json")
# Web Mercator by its names in tilemapresource.xml.
_WEB_MERCATOR = {"3857", "900913", "3785", "102100", "102113", "41001"}


@dataclass(frozen=True)
class Extent:
    """The tiles of a zoom: smallest and largest of both numbers, and how many there are."""

    low: TileAddress
    high: TileAddress
    count: int


@dataclass(frozen=True)
class Declared:
    """The declarations of a set of tiles; None where it makes none.

    Attributes:
        from_south: rows count from the south (TMS).
        bounds: of the whole map.
    """

    from_south: bool | None = None
    bounds: Degrees | None = None


def is_tile_set(path: Path) -> bool:
    """Return whether a path is a folder of tiles."""
    return path.is_dir() and _holds_tiles(path)


def tiles_near(folder: Path) -> Path | None:
    """Return the folder of tiles that lies in a folder, or that a folder lies in; None if there is none."""
    if folder.name.isdecimal() and _holds_tiles(folder.absolute().parent):
        return folder.absolute().parent
    inside = [path for path in sorted(folder.iterdir()) if path.is_dir()][:50]
    return next((path for path in inside if _holds_tiles(path)), None)


class FolderTiles:
    """Encoded tiles by zoom and place.

    Attributes:
        path: the folder.
        zooms: the zooms that have tiles.
        declared: the declarations beside the tiles.

    Raises:
        DataError: if it has no tiles, tiles that are no pictures, or tiles in another projection.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._files: dict[int, dict[TileAddress, Path]] = {}
        for relative, file in _files_of(path):
            if (match := _TILE.fullmatch(relative)) and (address := _address(match)):
                zoom, place = address
                tiles = self._files.setdefault(zoom, {})
                # Where a tile is there twice, {y}@2x.png comes before {y}.png.
                if place not in tiles or "@2x" in file.name:
                    tiles[place] = file
        if not self._files:
            raise DataError(f"{printable(str(path))} holds no tiles {{z}}/{{x}}/{{y}}.png; check the path.")
        first = next(iter(self._files[max(self._files)].values()))
        if first.suffix.lower().strip(".") in _VECTOR:
            raise _vector_error(path)
        self.zooms = {zoom: _extent(list(tiles)) for zoom, tiles in sorted(self._files.items())}
        self.declared = self._read_declared()

    def places(self, zoom: int) -> list[TileAddress]:
        """Return the places of the tiles of a zoom, of 100,000 at most."""
        return sorted(self._files[zoom])[:_MAX_PLACES]

    def read(self, zoom: int, place: TileAddress) -> bytes | None:
        """Return an encoded tile; None where there is none, or an empty one.

        Raises:
            DataError: if it cannot be read.
        """
        file = self._files.get(zoom, {}).get(place)
        if file is None:
            return None
        try:
            return file.read_bytes() or None
        except OSError as error:
            raise DataError(
                f"The tile {printable(str(file))} cannot be read ({error.strerror or error}); check its permissions."
            ) from error

    def name(self, zoom: int, place: TileAddress) -> str:
        """Return the name of a tile, for messages."""
        return printable(str(self._files[zoom][place]))

    def files(self) -> list[Path]:
        """Return the files that the tiles are read from."""
        return sorted(file for tiles in self._files.values() for file in tiles.values())

    def _read_declared(self) -> Declared:
        """Read tilemapresource.xml, else a TileJSON, beside the tiles."""
        xml = self.path / _TMS
        if xml.is_file():
            text = xml.read_bytes()[: 1 << 16].decode("utf-8", "replace")
            reference = re.search(r"<SRS>\s*([^<]*?)\s*</SRS>", text)
            profile = re.search(r"profile\s*=\s*[\"']([^\"']*)", text)
            code = re.search(r"(\d+)\D*$", reference[1]) if reference else None
            if (code and code[1] not in _WEB_MERCATOR) or (profile and re.search("geodetic|raster", profile[1])):
                raise _projection_error(
                    self.path, reference[1] if reference else f"the profile {profile and profile[1]}"
                )
            return Declared(from_south=True)
        for name in _METADATA:
            with suppress(OSError, ValueError, RecursionError):
                values = json.loads((self.path / name).read_bytes())
                if isinstance(values, dict):
                    return _declared(self.path, {str(key): value for key, value in values.items()})
        return Declared()


def _declared(path: Path, values: Mapping[str, object]) -> Declared:
    """Return the declarations of a TileJSON, or of an .mbtiles whose tiles were unpacked.

    Raises:
        DataError: if the tiles are no pictures, or in another projection.
    """
    if str(values.get("format", "")).lower() in _VECTOR:
        raise _vector_error(path)
    for name in ("crs", "srs", "profile"):
        text = str(values.get(name) or "mercator").lower()
        if not ("mercator" in text or any(code in text for code in _WEB_MERCATOR)):
            raise _projection_error(path, f"the {name} {text}")
    scheme = str(values.get("scheme", "")).lower()
    bounds = values.get("bounds")
    parts = bounds.split(",") if isinstance(bounds, str) else bounds if isinstance(bounds, list) else []
    degrees: Degrees | None = None
    with suppress(TypeError, ValueError):
        west, south, east, north = (float(part) for part in parts)
        if -180 <= west < east <= 180 and -90 <= south < north <= 90:
            degrees = west, south, east, north
    return Declared({"tms": True, "xyz": False}.get(scheme), degrees)


def _holds_tiles(folder: Path) -> bool:
    """Return whether a folder has a tile among its first files."""
    files = itertools.islice(_files_of(folder), _MAX_ENTRIES)
    return any((match := _TILE.fullmatch(relative)) and _address(match) for relative, _ in files)


def _address(match: re.Match[str]) -> tuple[int, TileAddress] | None:
    """Return zoom and place of a tile by its name; None if there is no such zoom."""
    zoom = int(match["z"])
    return (zoom, (int(match["x"]), int(match["y"]))) if zoom <= MAX_ZOOM else None


def _files_of(folder: Path) -> Iterator[tuple[str, Path]]:
    """Walk through the files of a folder: their paths within it, and they themselves, in order."""
    for root, folders, names in os.walk(folder):
        folders.sort()
        inside = Path(root)
        prefix = inside.relative_to(folder).as_posix()
        for name in sorted(names):
            yield (name if prefix == "." else f"{prefix}/{name}"), inside / name


def _extent(places: Sequence[TileAddress]) -> Extent:
    xs, ys = zip(*places, strict=True)
    return Extent((min(xs), min(ys)), (max(xs), max(ys)), len(places))


def _vector_error(path: Path) -> DataError:
    return DataError(
        f"{printable(str(path))} holds vector tiles (pbf); expected pictures, so render it, or take tiles of an orthophoto."
    )


def _projection_error(path: Path, what: str) -> DataError:
    return DataError(
        f"The tiles of {printable(str(path))} are in {printable(what)[:60]}; expected Web Mercator (EPSG:3857), so make them "
        "with that profile, or give the raster that they were made of."
    )
