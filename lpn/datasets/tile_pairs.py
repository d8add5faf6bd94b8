"""GTA-UAV (Ji et al. 2024), and UAV-VisLoc in the form that GTA-UAV's programs give it: drone pictures with lists of true tiles.

    drone/images/*.png                                         other folders are possible: the lists name them
    satellite/<zoom>_<offset>_<x>_<y>.png                      GTA-UAV
    satellite/<map>_<zoom>_<x>_<y>.png                         UAV-VisLoc
    {cross,same}-area-drone2sate-{train,test}.json             one object for each drone picture

An object lists the tiles that overlap the picture's footprint by more than 0.39 (true) and by more than 0.14 (true and half-true
together), with these overlaps as weights. GTA-UAV's positions are metres of its map, UAV-VisLoc's latitude and longitude. The
gallery is every tile of the folder, all zooms together.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lpn.core.arrays import Float64Array, Int64Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.datasets import geo
from lpn.datasets.areas import AREAS, Area, choose_split
from lpn.datasets.base import LeftOut, ListedDataset, Picture, Size, Truth, files_below, warn_left_out
from lpn.datasets.listed_paths import FilesBelow, fold, listed_path, name_of

# Side of GTA-UAV's map in pixels, and metres of a pixel.
_MAP_PIXELS, _METRES = 24_576, 0.45
_TILE = 256
_LARGEST_LIST = 500_000_000
# UAV-VisLoc's maps: latitude and longitude of the top-left and of the bottom-right corner, height and width in pixels. Map 09, of
# several sheets, is not cut into tiles.
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
_TILES = "pair_{}_sate_img_list"
_WEIGHTS = "pair_{}_sate_weight_list"
_LOCATIONS = {"drone_loc_x_y": "GTA-UAV", "drone_loc_lat_lon": "UAV-VisLoc"}


@dataclass(frozen=True)
class _Pair:
    """One object of a list: the drone picture's file, its position, and the overlaps of its true tiles and of all its tiles."""

    file: str
    place: tuple[float, float]
    true: dict[str, float]
    listed: dict[str, float]
    tiles: str


class TilePairs(ListedDataset):
    """A folder of GTA-UAV, or of UAV-VisLoc as GTA-UAV's programs prepare it, in one of its areas.

    A tile's label is its number. A drone picture's label is that of the tile it overlaps most; `truth` holds the true matches.

    Args:
        area: "same" or "cross"; by default the one whose test list is there, the same area first.

    Raises:
        DataError: if a list is missing or malformed, or names a test picture twice, or two tiles have one name.
    """

    kind = "GTA-UAV"

    def __init__(self, root: Path, area: Area | None = None) -> None:
        area = choose_split(
            root, [one for one in AREAS if _list(root, one, "test").is_file()], area, _list(root, "same", "test").name
        )
        test, form = _read(_list(root, area, "test"))
        train = _read(_list(root, area, "train"))[0] if _list(root, area, "train").is_file() else []
        self.kind, self.measured_by = form, form
        there = FilesBelow(root)
        test = _here(there, test)
        train = _here(there, train)
        folders = {pair.tiles for pair in test}
        if len(folders) != 1:
            raise DataError(
                f"The test list of {printable(root.name)} names {len(folders)} folders of tiles; expected one."
            )
        listed = Counter(pair.file for pair in test)
        if repeated := next((file for file, times in listed.items() if times > 1), None):
            raise DataError(
                f"{_list(root, area, 'test').name} has {listed[repeated]} objects of {printable(repeated)}; expected one "
                "for each drone picture."
            )
        folder = folders.pop()
        below = [] if there.find(folder) is None else files_below(root / folder)
        files = [file.relative_to(root).as_posix() for file in below]
        if not files:
            raise DataError(
                f"{printable(root.name)} has no tiles in {folder}, which its lists name; unpack them there."
            )
        numbers: dict[str, int] = {}
        for number, file in enumerate(files):
            if (other := numbers.setdefault(fold(Path(file).name), number)) != number:
                raise DataError(
                    f"{printable(root.name)} has the tiles {printable(files[other])} and {printable(file)}, and its lists name "
                    "tiles by their file names alone; leave one of them out."
                )
        gallery = [Picture(root / file, number, Path(file).stem) for number, file in enumerate(files)]
        left_out: dict[str, LeftOut] = {}
        self._pairs: list[_Pair] = []
        lists: dict[str, list[Picture]] = {}
        for split, pairs in (("train", train), ("test", test)):
            lists[split] = []
            for pair in pairs:
                true = [name for name in pair.true if name in numbers]
                for name in pair.listed:
                    if name not in numbers:
                        left_out[name] = LeftOut(f"{folder}/{name}", "is not there")
                if there.find(pair.file) is None:
                    left_out[pair.file] = LeftOut(pair.file, "is not there")
                elif pair.true and not true:
                    left_out[pair.file] = LeftOut(pair.file, "has none of its true tiles")
                elif true:
                    best = max(true, key=lambda name: pair.true[name])
                    lists[split].append(Picture(root / pair.file, numbers[best], Path(pair.file).stem))
                    if split == "test":
                        self._pairs.append(pair)
        used = {picture.label for picture in lists["train"]}
        super().__init__(
            root,
            {"drone": lists["train"], "satellite": [tile for tile in gallery if tile.label in used]},
            {"drone": lists["test"]},
            {"satellite": gallery},
            f"{_list(root, area, 'test').name} with true tiles",
        )
        if form == "GTA-UAV":
            self.published_sizes = {"test/gallery_satellite": Size(14_640)}
        self._numbers, self._area = numbers, area
        self.left_out = list(left_out.values())
        warn_left_out(self.root.name, self.left_out, "files named in its lists cannot be used", "they are left out")

    def tasks(self) -> list[str]:
        return ["drone-to-satellite", "satellite-to-drone"] if self._pairs else []

    def queries(self, view: str) -> list[Picture]:
        if view != "satellite":
            return super().queries(view)
        tiles = super().gallery("satellite")
        return [tiles[tile] for tile in self._drones]

    def gallery(self, view: str) -> list[Picture]:
        return super().queries("drone") if view == "drone" else super().gallery(view)

    def truth(self, task: str) -> list[Truth]:
        if task == "satellite-to-drone":
            none = np.zeros(0, np.int64)
            return [Truth(np.array(drones, np.int64), none, trapezoid=False) for drones in self._drones.values()]
        return [self._truth(pair) for pair in self._pairs]

    def coordinates(self, pictures: Sequence[Picture]) -> Float64Array:
        """Return metres of the map (GTA-UAV), or latitude and longitude in degrees (UAV-VisLoc), (N, 2)."""
        place = _metres_of_tile if self.measured_by == "GTA-UAV" else _degrees_of_tile
        of_drone = {self.root / pair.file: pair.place for pair in self._pairs}
        degrees = [of_drone[picture.path] if picture.path in of_drone else place(picture.path) for picture in pictures]
        return np.array(degrees, np.float64).reshape(-1, 2)

    def positions(self) -> geo.Positions | None:
        """Return the positions of UAV-VisLoc's pictures; None for GTA-UAV, whose map is not of the Earth."""
        if self.measured_by == "GTA-UAV":
            return super().positions()
        pictures = [*super().queries("drone"), *super().gallery("satellite")]
        degrees = self.coordinates(pictures).tolist()
        places = [geo.Position(latitude, longitude) for latitude, longitude in degrees]
        return geo.Positions(
            self.root,
            dict(zip(geo.names_below(self.root, pictures), places, strict=True)),
            f"{_list(self.root, self._area, 'test').name} and the tiles' names",
        )

    def _truth(self, pair: _Pair) -> Truth:
        good = {self._numbers[name]: weight for name, weight in pair.true.items() if name in self._numbers}
        semi = {
            self._numbers[name]: weight
            for name, weight in pair.listed.items()
            if name in self._numbers and self._numbers[name] not in good
        }
        overlaps = [of[tile] for of in (good, semi) for tile in sorted(of)]
        return Truth(_sorted(good), np.zeros(0, np.int64), True, False, _sorted(semi), np.array(overlaps, np.float64))

    @cached_property
    def _drones(self) -> dict[int, list[int]]:
        """For each tile that is true for a test picture, the positions of these pictures, in the order of the tiles."""
        drones: dict[int, list[int]] = {}
        for position, pair in enumerate(self._pairs):
            for name in pair.true:
                if name in self._numbers:
                    drones.setdefault(self._numbers[name], []).append(position)
        return dict(sorted(drones.items()))


def is_tile_pairs(root: Path) -> bool:
    """Return whether a folder has one of GTA-UAV's lists."""
    return any(_list(root, area, split).is_file() for area in AREAS for split in ("train", "test"))


def _list(root: Path, area: Area, split: str) -> Path:
    return root / f"{area}-area-drone2sate-{split}.json"


def _read(file: Path) -> tuple[list[_Pair], Any]:
    """Return the pairs of a list, and whether they are GTA-UAV's or UAV-VisLoc's."""
    try:
        if file.stat().st_size > _LARGEST_LIST:
            raise DataError(
                f"{file.name} has more than {_LARGEST_LIST // 1_000_000} MB; expected a list of drone pictures."
            )
        entries = json.loads(file.read_bytes())
    except OSError as error:
        raise DataError(
            f"{file.name} cannot be read ({error.strerror or error}); check that it is readable."
        ) from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{file.name} is not JSON; save it again, or unpack it again.") from error
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise DataError(f"{file.name} is not a list of objects; expected one for each drone picture, as in GTA-UAV.")
    key = next((key for key in _LOCATIONS if key in entries[0]), None)
    if key is None:
        raise DataError(
            f"The first object of {file.name} has neither {' nor '.join(_LOCATIONS)}; expected one of them."
        )
    return [_pair(entry, key, f"Object {i + 1} of {file.name}") for i, entry in enumerate(entries)], _LOCATIONS[key]


def _pair(entry: dict[str, Any], key: str, where: str) -> _Pair:
    needed = (
        "drone_img_dir",
        "drone_img_name",
        key,
        "sate_img_dir",
        _TILES.format("pos"),
        _TILES.format("pos_semipos"),
    )
    missing = [name for name in needed if name not in entry]
    if missing:
        raise DataError(f"{where} has no {', '.join(missing)}; expected the keys of GTA-UAV's lists.")
    try:
        first, second = (float(value) for value in _values(entry[key], key))
        true, listed = (_weighted(entry, kind) for kind in ("pos", "pos_semipos"))
    except (TypeError, ValueError) as error:
        raise DataError(
            f"{where} is malformed: {error}; expected two numbers, and lists of tiles and weights."
        ) from error
    if not (math.isfinite(first) and math.isfinite(second)):
        raise DataError(f"{where} has the position {first}, {second}; expected two finite numbers.")
    file = listed_path(f"{entry['drone_img_dir']}/{entry['drone_img_name']}", where)
    return _Pair(file, (first, second), true, listed, listed_path(str(entry["sate_img_dir"]), where))


def _here(there: FilesBelow, pairs: list[_Pair]) -> list[_Pair]:
    """Resolve the paths of the pairs to files and folders on this machine."""
    resolved = there.resolve(path for pair in pairs for path in (pair.file, pair.tiles))
    return [
        replace(pair, file=resolved.get(pair.file, pair.file), tiles=resolved.get(pair.tiles, pair.tiles))
        for pair in pairs
    ]


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
    name = file.stem.split("_")[0]
    if name not in _MAPS:
        raise DataError(
            f"The tile {printable(file.name)} is of map {printable(name)}; expected one of {', '.join(_MAPS)}."
        )
    top, left, bottom, right, height, width = _MAPS[name]
    shrink = 2 ** (math.ceil(math.log2(max(height, width) / _TILE)) - zoom)
    rows, columns = math.ceil(height / shrink), math.ceil(width / shrink)
    return top - (y + 0.5) * _TILE / rows * (top - bottom), left + (x + 0.5) * _TILE / columns * (right - left)


def _numbers_in(file: Path, zoom: int, example: str) -> tuple[int, ...]:
    """Return the four numbers of a tile's name, of which the one at position `zoom` is a zoom."""
    parts = file.stem.split("_")
    if len(parts) != 4 or not all(part.isdecimal() and len(part) < 7 for part in parts) or int(parts[zoom]) > 30:
        raise DataError(
            f"The tile {printable(file.name)} has no position in its name; expected four numbers, such as {example}."
        )
    return tuple(map(int, parts))


def _sorted(tiles: dict[int, float]) -> Int64Array:
    return np.array(sorted(tiles), np.int64)
