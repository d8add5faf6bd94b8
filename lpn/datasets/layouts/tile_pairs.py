"""GTA-UAV (Ji et al. 2024), and UAV-VisLoc prepared by GTA-UAV's programs: drone pictures with lists of true tiles.

    drone/images/*.png                                         other folders are possible: the lists name them
    satellite/<zoom>_<offset>_<x>_<y>.png                      GTA-UAV
    satellite/<map>_<zoom>_<x>_<y>.png                         UAV-VisLoc
    {cross,same}-area-drone2sate-{train,test}.json             one object for each drone picture

An object lists the tiles that overlap the picture's footprint by more than 0.39 (true) and by more than 0.14 (true and half-true
together), with these overlaps as weights. GTA-UAV's positions are metres of its map, UAV-VisLoc's latitude and longitude. The
gallery is every tile of the folder, all zooms together.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.lists import read_json
from lpn.datasets import geo
from lpn.datasets.base import Dataset, Picture, PictureRow, PositionProtocol, Size, files_below
from lpn.datasets.listed_paths import fold, listed_path, name_of

# Side of GTA-UAV's map in pixels, and metres of a pixel.
_MAP_PIXELS, _METRES = 24_576, 0.45
_TILE = 256
_LARGEST_LIST = 500_000_000
# UAV-VisLoc's maps: latitude and longitude of the top-left and of the bottom-right corner, height and width in pixels. Map 09,
# which has several sheets, is not cut into tiles.
_MAPS = {
    "01": (29.774065, 115.970635, 29.702283, 115.996851, 26762, 9774),
    "02": (29.817376, 116.033769, 29.725402, 116.064566, 34291, 11482),
    "03": (32.355491, 119.805926, 32.29029, 119.900052, 24308, 35092),
    "04": (32.254036, 119.90598, 32.151018, 119.954509, 38408, 18093),
    "05": (24.666899, 102.340055, 24.650422, 102.365252, 6144, 9394),
    "06": (32.373177, 109.63516, 32.346944, 109.656837, 9780, 8082),
    "07": (40.340058, 115.791182, 40.339604, 115.79923, 170, 3000),
    "08": (30.947227, 120.136489, 30.903521, 120.252951, 16294, 43421),
    "10": (40.355093, 115.776356, 40.341475, 115.794041, 5077, 6593),
    "11": (38.852301, 101.013109, 38.807825, 101.092483, 16582, 29592),
}
_LIST = "{}-drone2sate-{}.json"
_TILES = "pair_{}_sate_img_list"
_WEIGHTS = "pair_{}_sate_weight_list"
_LOCATIONS: dict[str, PositionProtocol] = {"drone_loc_x_y": "GTA-UAV", "drone_loc_lat_lon": "UAV-VisLoc"}


class _Pair(NamedTuple):
    """One object of a list: the drone picture, its position, the folder of tiles, overlaps of the true and of all tiles."""

    file: str
    place: tuple[float, float]
    folder: str
    true: dict[str, float]
    listed: dict[str, float]


class TilePairs(Dataset):
    """A folder of GTA-UAV, or of UAV-VisLoc as GTA-UAV's programs prepare it, in one of its areas.

    A tile's label is its number. The label of a drone picture is the number of the tile with the greatest overlap. True tiles
    of test pictures are queries, too.
    """

    kind = "GTA-UAV"
    marks = tuple((_LIST.format(area, split),) for area in ("same-area", "cross-area") for split in ("train", "test"))
    splits: Mapping[str, Sequence[str]] = {area: (_LIST.format(area, "test"),) for area in ("same-area", "cross-area")}
    trapezoid = False
    expected = "the drone pictures and tiles that its lists name"

    def rows(self) -> Iterator[PictureRow]:
        listed, trained = (_LIST.format(self.split, split) for split in ("test", "train"))
        pairs, form = self._pairs(listed)
        train = self._pairs(trained)[0] if (self.root / trained).is_file() else []
        self.kind, self.measured_by = form, form
        if form == "GTA-UAV":
            self.published_sizes = {"test/gallery_satellite": Size(14_640)}
        else:
            self.title, self.positions_from = "UAV-VisLoc in GTA-UAV's layout", f"{listed} and the tiles' names"
        self._spots = {self.root / pair.file: pair.place for pair in pairs}
        below = files_below(self.root / pairs[0].folder)
        tiles = {fold(path.name): path.relative_to(self.root).as_posix() for path in below}
        numbers = {file: number for number, file in enumerate(tiles.values())}
        used = set()
        for row in self._flown("train/drone", train, tiles, numbers):
            used.add(row.label)
            yield row
        drones: dict[str | Path, list[str | Path]] = {file: [] for file in numbers}
        for row in self._flown("test/query_drone", pairs, tiles, numbers):
            yield from (row, replace(row, of="test/gallery_drone"))
            for tile in row.true or ():
                drones[tile].append(row.file)
        for file, number in numbers.items():
            row = PictureRow("test/gallery_satellite", file, number, Path(file).stem)
            yield row
            if number in used:
                yield replace(row, of="train/satellite")
            if drones[file]:
                yield replace(row, of="test/query_satellite", true=drones[file])

    def coordinates(self, pictures: Sequence[Picture]) -> Float64Array:
        """Return metres of the map (GTA-UAV), or latitude and longitude in degrees (UAV-VisLoc), (N, 2)."""
        return np.array([self._spot(picture) for picture in pictures], np.float64).reshape(-1, 2)

    def place(self, picture: Picture) -> geo.Position:
        return geo.Position(*self._spot(picture))

    def _spot(self, picture: Picture) -> tuple[float, float]:
        of_tile = _metres_of_tile if self.measured_by == "GTA-UAV" else _degrees_of_tile
        return self._spots.get(picture.path) or of_tile(picture.path)

    def _flown(
        self, of: str, pairs: Sequence[_Pair], tiles: dict[str, str], numbers: dict[str, int]
    ) -> Iterator[PictureRow]:
        """Yield the existing drone pictures with a true tile."""
        for pair in pairs:
            for name in pair.listed:
                if name not in tiles:
                    self.leave_out(f"{pair.folder}/{name}")
            overlaps: dict[str | Path, float] = {
                tiles[name]: weight for name, weight in (pair.listed | pair.true).items() if name in tiles
            }
            true = {tiles[name]: weight for name, weight in pair.true.items() if name in tiles}
            if self.files.find(pair.file) is None:
                self.leave_out(pair.file)
            elif true:
                best, semi = numbers[max(true, key=true.__getitem__)], [file for file in overlaps if file not in true]
                yield PictureRow(of, pair.file, best, Path(pair.file).stem, true=[*true], semi=semi, overlaps=overlaps)
            elif pair.true:
                self.leave_out(pair.file, "has none of its true tiles")

    def _pairs(self, name: str) -> tuple[list[_Pair], PositionProtocol]:
        """Return the pairs of a list, with paths of this machine, and the data set of the list, GTA-UAV or UAV-VisLoc."""
        entries = read_json(self.root / name, name, _LARGEST_LIST)
        first = entries[0] if isinstance(entries, list) and entries else None
        key = next((key for key in _LOCATIONS if isinstance(first, dict) and key in first), None)
        if key is None:
            raise DataError(
                f"{name} is not a list of objects with {' or '.join(_LOCATIONS)}; expected one for each drone picture, as in "
                "GTA-UAV."
            )
        pairs = [self._pair(entry, key, f"Object {number} of {name}") for number, entry in enumerate(entries, 1)]
        return pairs, _LOCATIONS[key]

    def _pair(self, entry: dict[str, Any], key: str, where: str) -> _Pair:
        try:
            east, north = map(float, _values(entry[key], key))
            true, listed = (_weighted(entry, kind) for kind in ("pos", "pos_semipos"))
            if not math.isfinite(east + north):
                raise ValueError(f"its position is {east}, {north}")
            names = f"{entry['drone_img_dir']}/{entry['drone_img_name']}", str(entry["sate_img_dir"])
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            reason = f"it has no {error.args[0]}" if isinstance(error, KeyError) else error
            raise DataError(
                f"{where} is malformed: {reason}; expected a picture, two finite numbers, and lists of tiles and weights, as in "
                "GTA-UAV."
            ) from error
        file, folder = (self.files.find(path) or path for path in (listed_path(text, where) for text in names))
        return _Pair(file, (east, north), folder, true, listed)


def _weighted(entry: dict[str, Any], kind: str) -> dict[str, float]:
    """Return the overlap of each tile; NaN for those without a weight."""
    key, of_weights = _TILES.format(kind), _WEIGHTS.format(kind)
    names, weights = _values(entry[key], key), entry.get(of_weights)
    weights = [math.nan] * len(names) if weights is None else _values(weights, of_weights)
    if len(names) != len(weights):
        raise ValueError(f"{len(names)} tiles and {len(weights)} weights")
    return {fold(name_of(str(name))): float(weight) for name, weight in zip(names, weights, strict=True)}


def _values(value: Any, key: str) -> list[Any]:
    if not isinstance(value, list):
        raise TypeError(f"{key} is no list")
    return value


def _metres_of_tile(file: Path) -> tuple[float, float]:
    """Return the centre of a GTA-UAV tile in metres right of and below the map's top-left corner."""
    zoom, offset, x, y = _numbers_in(file, 0, "4_0_6_13")
    side = _METRES * _MAP_PIXELS / 2**zoom
    return side * (x + 0.5 + offset / _TILE), side * (y + 0.5 + offset / _TILE)


def _degrees_of_tile(file: Path) -> tuple[float, float]:
    """Return latitude and longitude of the centre of a UAV-VisLoc tile."""
    _, zoom, x, y = _numbers_in(file, 1, "03_7_001_002")
    top, left, bottom, right, height, width = _MAPS[file.stem[:2]]
    shrink = 2 ** (math.ceil(math.log2(max(height, width) / _TILE)) - zoom)
    rows, columns = math.ceil(height / shrink), math.ceil(width / shrink)
    return top - (y + 0.5) * _TILE / rows * (top - bottom), left + (x + 0.5) * _TILE / columns * (right - left)


def _numbers_in(file: Path, zoom: int, example: str) -> tuple[int, ...]:
    """Return the four numbers of a tile's name; the number at position `zoom` is its zoom."""
    parts = file.stem.split("_")
    numbers = [int(part) for part in parts if part.isdecimal() and len(part) < 7]
    if len(parts) != 4 or len(numbers) != 4 or numbers[zoom] > 30 or (zoom and parts[0] not in _MAPS):
        raise DataError(
            f"The tile {printable(file.name)} has no position in its name; expected four numbers, such as {example}."
        )
    return tuple(numbers)
