"""Sets of picture tiles on disk, as they are stored: folders in several layouts, and SQLite databases.

{z}/{x}/{y}.png, {y}@2x.png, .png.tile     web servers, gdal2tiles, QGIS, MOBAC, OsmAnd, osmdroid
z{z + 1}/{}/x{x}/{}/y{y}.png               the cache of SAS.Planet
{17 - z}/{}/{}/{}/{}.png                   GMapCatcher: x and y by 1024, and their rest
{z}_{x}_{y}.png, {quadkey}.png             downloaders
*.mbtiles                                  the table tiles, or the tables map and images
*.sqlitedb                                 BigPlanet, MOBAC, OsmAnd
"""

from __future__ import annotations

import json
import os
import re
import sqlite3
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Protocol

from lpn.core.errors import DataError
from lpn.core.files import printable

# The two numbers of a tile as they are stored, before it is known in which direction they count.
TileAddress = tuple[int, int]
# West, south, east, north in degrees.
Degrees = tuple[float, float, float, float]

MAX_ZOOM = 30
DATABASES = (".mbtiles", ".sqlitedb")
# Folders and files that are looked through for a first tile.
_MAX_ENTRIES = 20_000
# Bytes of a compressed tile after it is unpacked.
_MAX_TILE = 1 << 26
# Tiles whose places are listed.
_MAX_PLACES = 100_000
_VECTOR = ("pbf", "mvt")
_PICTURE = r"(?:@2x)?(?P<suffix>\.(?:png|jpe?g|webp|gif|bmp|pbf|mvt))?(?:\.tile)?"
_LAYOUTS = tuple(
    re.compile(pattern + _PICTURE, re.IGNORECASE | re.ASCII)
    for pattern in (
        r"(?P<z>\d{1,2})/(?P<x>\d{1,9})/(?P<y>\d{1,9})",
        r"z(?P<z1>\d{1,2})/\d+/x(?P<x>\d{1,9})/\d+/y(?P<y>\d{1,9})",
        r"(?P<from_17>\d{1,2})/(?P<kx>\d{1,4})/(?P<x>\d{1,4})/(?P<ky>\d{1,4})/(?P<y>\d{1,4})",
        r"(?P<z>\d{1,2})[-_](?P<x>\d{1,9})[-_](?P<y>\d{1,9})",
        r"[ahr]?(?P<quadkey>[0-3]{8,30})",
    )
)
# How the zoom follows from the number in a name.
_ZOOMS = (("z", 1, 0), ("z1", 1, -1), ("from_17", -1, 17))
_TILE = re.compile(r".*\d" + _PICTURE, re.IGNORECASE | re.ASCII)
# gdal2tiles writes this file beside tiles that count rows from the south (TMS).
_TMS = "tilemapresource.xml"
_METADATA = ("metadata.json", "tilejson.json", "tile.json", "tiles.json")
# Web Mercator by its names in tilemapresource.xml.
_WEB_MERCATOR = {"3857", "900913", "3785", "102100", "102113", "41001"}
# Tables of a database, and its expressions for zoom, column, row, and picture.
_SCHEMAS = (
    ("tiles", "zoom_level", "tile_column", "tile_row", "tile_data"),
    ("map JOIN images USING (tile_id)", "zoom_level", "tile_column", "tile_row", "tile_data"),
    ("tiles", "z", "x", "y", "image"),
)
# BigPlanet counts zooms from the finest.
_BIG_PLANET = "17 - z"


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
        ellipsoidal: the projection is World Mercator (EPSG:3395), not Web Mercator.
    """

    from_south: bool | None = None
    bounds: Degrees | None = None
    ellipsoidal: bool = False


class TileSet(Protocol):
    """Encoded tiles by zoom and place.

    Attributes:
        path: the folder or database.
        zooms: the zooms that have tiles.
        declared: what the set says of itself.
        from_south: whether rows count from the south where nothing else is known.
        named: columns and rows have names, so that they cannot be confused.
    """

    @property
    def path(self) -> Path: ...
    @property
    def zooms(self) -> dict[int, Extent]: ...
    @property
    def declared(self) -> Declared: ...
    @property
    def from_south(self) -> bool: ...
    @property
    def named(self) -> bool: ...

    def places(self, zoom: int) -> list[TileAddress]:
        """Return the places of the tiles of a zoom, of 100,000 at most."""
        ...

    def read(self, zoom: int, place: TileAddress) -> bytes | None:
        """Return an encoded tile; None where there is none, or an empty one.

        Raises:
            DataError: if it cannot be read.
        """
        ...

    def name(self, zoom: int, place: TileAddress) -> str:
        """Return the name of a tile, for messages."""
        ...

    def files(self) -> list[Path]:
        """Return the files that the tiles are read from."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...


def is_tile_set(path: Path) -> bool:
    """Return whether a path is a database of tiles by its name, or a folder in one of the layouts of tiles."""
    return path.suffix.lower() in DATABASES if path.is_file() else _layout_of(path) is not None


def open_tiles(path: Path) -> TileSet:
    """Open a folder or database of tiles.

    Raises:
        DataError: if it has no tiles, tiles that are no pictures, or tiles in another projection.
    """
    return DatabaseTiles(path) if path.is_file() else FolderTiles(path)


def tiles_near(folder: Path) -> Path | None:
    """Return the folder of tiles that lies in a folder, or that a folder lies in; None if there is none."""
    if _layout_of(folder.absolute().parent) is not None and folder.name.isdecimal():
        return folder.absolute().parent
    inside = [path for path in sorted(folder.iterdir()) if path.is_dir()][:50]
    return next((path for path in inside if _layout_of(path) is not None), None)


class FolderTiles:
    """Tiles that are files; see `TileSet`."""

    named = False

    def __init__(self, path: Path) -> None:
        self.path = path
        layout = _layout_of(path)
        self._files: dict[int, dict[TileAddress, Path]] = {}
        for relative, file in _files_of(path):
            if layout and (match := layout.fullmatch(relative)) and (address := _address(match)):
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
        self.from_south = bool(self.declared.from_south)

    def places(self, zoom: int) -> list[TileAddress]:
        """See `TileSet.places`."""
        return sorted(self._files[zoom])[:_MAX_PLACES]

    def read(self, zoom: int, place: TileAddress) -> bytes | None:
        """See `TileSet.read`."""
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
        """See `TileSet.name`."""
        return printable(str(self._files[zoom][place]))

    def files(self) -> list[Path]:
        """See `TileSet.files`."""
        return sorted(file for tiles in self._files.values() for file in tiles.values())

    def close(self) -> None:
        """See `TileSet.close`."""

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


class DatabaseTiles:
    """Tiles in an SQLite database, .mbtiles or .sqlitedb; see `TileSet`; thread safe."""

    named = True

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = Lock()
        # Without a log of changes beside it, SQLite need write no files there, which a read-only folder would refuse.
        log = path.with_name(f"{path.name}-wal")
        mode = "mode=ro" if log.exists() and log.stat().st_size else "immutable=1"
        self._connection = sqlite3.connect(
            f"{path.absolute().as_uri()}?{mode}", uri=True, check_same_thread=False, isolation_level=None
        )
        # Damaged text is no reason to give up the tiles.
        self._connection.text_factory = lambda data: data.decode("utf-8", "replace")
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        file_name = printable(str(self.path))
        if not self.path.stat().st_size:
            raise DataError(f"{file_name} is empty; copy or download it again.")
        # A file that is no database is refused by the first query, with a message of its own.
        tables = {str(name) for (name,) in self._rows("SELECT name FROM sqlite_master")}
        schema = next((schema for schema in _SCHEMAS if self._has(schema)), None)
        if schema is None:
            named = f" (its tables are {printable(', '.join(sorted(tables)))[:100]})" if tables else ""
            raise DataError(f"{file_name} has no table of tiles{named}; expected an .mbtiles of pictures.")
        self._table, self._z, self._x, self._y, self._data = schema
        self.from_south = self._z == "zoom_level"
        if self.from_south:
            self.declared = _declared(self.path, self._pairs("SELECT name, value FROM metadata"))
        else:
            info = self._record("SELECT * FROM info LIMIT 1")
            if str(info.get("tilenumbering", "BigPlanet")).lower() == "bigplanet":
                self._z = _BIG_PLANET
            self.from_south = str(info.get("inverted_y")) == "1"
            self.declared = Declared(ellipsoidal=str(info.get("ellipsoid")) == "1")
        self.zooms: dict[int, Extent] = {}
        x, y = self._x, self._y
        for row in self._rows(
            f"SELECT {self._z}, MIN({x}), MIN({y}), MAX({x}), MAX({y}), COUNT(*) FROM {self._table} GROUP BY 1 ORDER BY 1"
        ):
            numbers = [number for number in row if isinstance(number, int)]
            if len(numbers) != len(row):
                raise DataError(f"{file_name} has tiles whose zoom, column, or row is no whole number; make it again.")
            zoom, west, low, east, high, count = numbers
            if 0 <= zoom <= MAX_ZOOM:
                self.zooms[zoom] = Extent((west, low), (east, high), count)
        if not self.zooms:
            raise DataError(f"{file_name} holds no tiles; make it again.")

    def places(self, zoom: int) -> list[TileAddress]:
        """See `TileSet.places`."""
        question = f"SELECT {self._x}, {self._y} FROM {self._table} WHERE {self._z} = ? LIMIT {_MAX_PLACES}"
        return sorted((x, y) for x, y in self._rows(question, zoom) if isinstance(x, int) and isinstance(y, int))

    def read(self, zoom: int, place: TileAddress) -> bytes | None:
        """See `TileSet.read`."""
        condition = f"{self._z} = ? AND {self._x} = ? AND {self._y} = ?"
        rows = self._rows(f"SELECT {self._data} FROM {self._table} WHERE {condition} LIMIT 1", zoom, *place)
        data = rows[0][0] if rows else None
        if not isinstance(data, bytes):
            return None
        if data.startswith(b"\x1f\x8b"):
            with suppress(zlib.error):
                data = zlib.decompressobj(31).decompress(data, _MAX_TILE)
        return data or None

    def name(self, zoom: int, place: TileAddress) -> str:
        """See `TileSet.name`."""
        return f"{zoom}, {place[0]}, {place[1]} of {printable(str(self.path))}"

    def files(self) -> list[Path]:
        """See `TileSet.files`."""
        return [self.path]

    def close(self) -> None:
        """See `TileSet.close`."""
        self._connection.close()

    def _rows(self, question: str, *values: int) -> list[tuple[object, ...]]:
        try:
            with self._lock:
                return self._connection.execute(question, values).fetchall()
        except (sqlite3.Error, OverflowError, UnicodeDecodeError) as error:
            reason = "damaged names" if isinstance(error, ValueError) else printable(str(error))[:100]
            raise DataError(
                f"{printable(str(self.path))} cannot be read as a map ({reason}); expected an .mbtiles of pictures, so copy it "
                "again."
            ) from error

    def _has(self, schema: Sequence[str]) -> bool:
        with suppress(DataError):
            self._rows(f"SELECT {', '.join(schema[1:])} FROM {schema[0]} LIMIT 1")
            return True
        return False

    def _pairs(self, question: str) -> dict[str, object]:
        """Return a table of names and values; nothing if there is no such table."""
        with suppress(DataError):
            return {str(name).lower(): value for name, value in self._rows(question)}
        return {}

    def _record(self, question: str) -> dict[str, object]:
        """Return the first row of a table by the names of its columns; nothing if there is none."""
        with suppress(sqlite3.Error, UnicodeDecodeError), self._lock:
            cursor = self._connection.execute(question)
            row = cursor.fetchone()
            return dict(zip([column[0].lower() for column in cursor.description], row, strict=True)) if row else {}
        return {}


def _declared(path: Path, values: Mapping[str, object]) -> Declared:
    """Return what the names and values of an .mbtiles or a TileJSON say.

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


def _layout_of(folder: Path) -> re.Pattern[str] | None:
    """Return the layout of a folder of tiles by its first file that could be one; None if it is in no layout."""
    for count, (relative, file) in enumerate(_files_of(folder)):
        if count > _MAX_ENTRIES:
            break
        if not _TILE.fullmatch(file.name):
            continue
        matches = ((layout, layout.fullmatch(relative)) for layout in _LAYOUTS)
        layout = next((layout for layout, match in matches if match and _address(match)), None)
        if layout is None:
            continue
        if "/" not in relative:
            # One picture in the folder that is no tile, or has a world file, makes all of them sheets.
            names = [
                other.name for other in folder.iterdir() if _is_picture(other.name) or other.suffix.lower()[-1:] == "w"
            ]
            return layout if all((match := layout.fullmatch(name)) and _address(match) for name in names) else None
        return layout
    return None


def _is_picture(name: str) -> bool:
    match = re.fullmatch(r".*?" + _PICTURE, name, re.IGNORECASE)
    return match is not None and match["suffix"] is not None


def _address(match: re.Match[str]) -> tuple[int, TileAddress] | None:
    """Return zoom and place of a tile by its name; None if there are no such numbers."""
    groups = match.groupdict()
    if digits := groups.get("quadkey"):
        zoom = len(digits)
        x, y = (int("".join(str(int(digit) >> bit & 1) for digit in digits), 2) for bit in (0, 1))
    else:
        zoom = next(int(groups[name]) * sign + zero for name, sign, zero in _ZOOMS if groups.get(name))
        x, y = (int(groups[name]) + 1024 * int(groups.get(f"k{name}") or 0) for name in ("x", "y"))
    if not 0 <= zoom <= MAX_ZOOM:
        return None
    # A name without folders must be a tile's beyond doubt.
    plain = "/" not in match.string
    return None if plain and (max(x, y) >= 1 << zoom or not match["suffix"]) else (zoom, (x, y))


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
