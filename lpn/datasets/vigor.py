"""VIGOR (Zhu et al. 2021): panoramas and tiles of four cities; a panorama lies in one tile's middle and in up to three others.

    <city>/panorama/<id>,<latitude>,<longitude>,.jpg       also ground/<city>/...
    <city>/satellite/satellite_<latitude>_<longitude>.png  also satellite/<city>/...
    splits/<city>/satellite_list.txt                       a tile a line; or splits__corrected, where there is no splits
    splits/<city>/same_area_balanced_{train,test}.txt      panorama, then four times: tile, and its offset in two numbers
    splits/<city>/pano_label_balanced.txt                  the same for the whole city

The same-area split trains and tests on panoramas of all cities. The cross-area split trains on NewYork and Seattle, and tests on
Chicago and SanFrancisco. The first of the four tiles is true, and the others are half-true (semi-positives). The gallery is every
tile of the test's cities.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from lpn.core.arrays import Int64Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.datasets import geo
from lpn.datasets.areas import AREAS, Area, choose_split
from lpn.datasets.base import LeftOut, ListedDataset, Picture, Size, Truth, read_lines, warn_left_out
from lpn.datasets.listed_paths import FilesBelow, fold, listed_path, name_of

CITIES = ("Chicago", "NewYork", "SanFrancisco", "Seattle")
_SPLITS = ("splits", "splits__corrected")
_CROSS = {"train": ("NewYork", "Seattle"), "test": ("Chicago", "SanFrancisco")}
_TILES = "satellite_list.txt"
# The paper states these numbers; the authors' repository states none, and the released lists were not at hand to count.
_FULL = {
    "same": {
        "train/street": Size(52_609),
        "test/query_street": Size(52_605),
        "test/gallery_satellite": Size(90_618, 90_618),
    },
    "cross": {
        "train/street": Size(51_520),
        "test/query_street": Size(53_694),
        "test/gallery_satellite": Size(46_563, 46_563),
    },
}
_COORDINATES = re.compile(r"(-?\d+\.\d+)[,_](-?\d+\.\d+),?\.\w+$")


class VIGOR(ListedDataset):
    """A folder of VIGOR in one of its areas; its only task is "street-to-satellite", and its groups are the cities.

    A panorama's label is the number of its true tile among all listed tiles.

    Args:
        area: "same" or "cross"; by default the one whose lists are there, the same area first.

    Raises:
        DataError: if a list is missing or malformed; the message names the file and the line.
    """

    kind = "VIGOR"
    panoramas = True
    group_name = "city"

    def __init__(self, root: Path, area: Area | None = None) -> None:
        splits = _splits(root)
        areas = [
            one for one in AREAS if any((splits / city / _list(one, "test")).is_file() for city in _cities(one, "test"))
        ]
        area = choose_split(root, areas, area, f"{splits.name}/<city>/{_list('same', 'test')}")
        files, left_out = FilesBelow(root), dict[str, LeftOut]()
        self._semi: list[list[str]] = []
        numbers: dict[str, int] = {}
        gallery: list[Picture] = []
        pictures: dict[str, list[Picture]] = {"train": [], "test": []}
        tiles_of = {city: _tiles(root, splits, city) for city in CITIES if (splits / city).is_dir()}
        for city, tiles in tiles_of.items():
            for file in tiles.values():
                numbers[file] = len(numbers)
                if city in _cities(area, "test"):
                    if (there := files.find(file)) is not None:
                        gallery.append(Picture(root / there, numbers[file], f"{city}/{Path(there).stem}"))
                    else:
                        left_out[file] = LeftOut(file, "is not there")
        for split in ("train", "test"):
            for city in _cities(area, split):
                name = f"{splits.name}/{city}/{_list(area, split)}"
                if not (root / name).is_file():
                    if split == "test" or (splits / city).is_dir():
                        left_out[name] = LeftOut(name, "is not there")
                    continue
                folder = _folder(root, city, "panorama", "ground")
                for panorama, listed in _panoramas(root / name, name, tiles_of[city]):
                    file = f"{folder}/{panorama}"
                    if (there := files.find(file)) is None:
                        left_out[file] = LeftOut(file, "is not there")
                        continue
                    title = f"{city}/{panorama.split(',')[0]}"
                    pictures[split].append(Picture(root / there, numbers[listed[0]], title, panorama=True, group=city))
                    if split == "test":
                        self._semi.append(listed[1:])
        self._order = {picture.label: position for position, picture in enumerate(gallery)}
        self._numbers = numbers
        used = {picture.label for picture in pictures["train"]}
        trained = [
            Picture(root / there, number, Path(there).stem)
            for file, number in numbers.items()
            if number in used and (there := files.find(file)) is not None
        ]
        super().__init__(
            root,
            {"street": pictures["train"], "satellite": trained},
            {"street": pictures["test"]},
            {"satellite": gallery},
            f"{splits.name}/<city>/{_list(area, 'test')} and the pictures that it names",
        )
        self.published_sizes = _FULL[area]
        self.left_out = list(left_out.values())
        warn_left_out(self.root.name, self.left_out, "files of its lists cannot be used", "they are left out")

    def tasks(self) -> list[str]:
        return ["street-to-satellite"] if self._queries["street"] and self._gallery["satellite"] else []

    def truth(self, task: str) -> list[Truth]:
        del task
        return [
            Truth(
                self._places([query.label]),
                np.zeros(0, np.int64),
                semi=self._places([self._numbers[tile] for tile in semi]),
            )
            for query, semi in zip(self._queries["street"], self._semi, strict=True)
        ]

    def positions(self) -> geo.Positions | None:
        """Return the positions in the names of panoramas and tiles."""
        pictures = [*self._queries["street"], *self._gallery["satellite"]]
        positions = {}
        for path, picture in zip(geo.names_below(self.root, pictures), pictures, strict=True):
            point = _COORDINATES.search(picture.path.name)
            if point is None or abs(float(point[1])) > 90 or abs(float(point[2])) > 180:
                raise DataError(
                    f"The picture {printable(picture.path.name)} has no latitude and longitude in its name; expected VIGOR's "
                    "names."
                )
            positions[path] = geo.Position(float(point[1]), float(point[2]))
        return geo.Positions(self.root, positions, "the pictures' names")

    def _places(self, tiles: Sequence[int]) -> Int64Array:
        return np.array(sorted(self._order[tile] for tile in dict.fromkeys(tiles) if tile in self._order), np.int64)


def is_vigor(root: Path) -> bool:
    """Return whether a folder is VIGOR's: by its splits, or by its cities."""
    if any((root / splits / city).is_dir() for splits in _SPLITS for city in CITIES):
        return True
    return any((root / city / "panorama").is_dir() or (root / "ground" / city).is_dir() for city in CITIES)


def _splits(root: Path) -> Path:
    folder = next((root / name for name in _SPLITS if (root / name).is_dir()), None)
    if folder is None:
        raise DataError(
            f"{printable(root.name)} has VIGOR's pictures and no folder {' or '.join(_SPLITS)}; expected its lists in one of "
            "them."
        )
    return folder


def _cities(area: Area, split: str) -> tuple[str, ...]:
    return CITIES if area == "same" else _CROSS[split]


def _list(area: Area, split: str) -> str:
    return f"same_area_balanced_{split}.txt" if area == "same" else "pano_label_balanced.txt"


def _folder(root: Path, city: str, inner: str, outer: str) -> str:
    """Return the folder of a city's pictures below the root, in either of the two published forms."""
    return f"{outer}/{city}" if (root / outer / city).is_dir() else f"{city}/{inner}"


def _tiles(root: Path, splits: Path, city: str) -> dict[str, str]:
    """Return the path of each tile of a city by the key of its name; see `fold`."""
    name = f"{splits.name}/{city}/{_TILES}"
    folder = _folder(root, city, "satellite", "satellite")
    tiles = {}
    for number, line in enumerate(read_lines(splits / city / _TILES, name), 1):
        if line.strip():
            tile = name_of(listed_path(line, f"Line {number} of {name}"))
            tiles[fold(tile)] = f"{folder}/{tile}"
    return tiles


def _panoramas(file: Path, name: str, tiles: Mapping[str, str]) -> list[tuple[str, list[str]]]:
    """Return each panorama's file name, and the paths of its tiles, the true one first."""
    panoramas = []
    for number, line in enumerate(read_lines(file, name), 1):
        values = line.split()
        if not values:
            continue
        where = f"Line {number} of {name}"
        if len(values) < 4 or len(values) % 3 != 1:
            raise DataError(
                f"{where} has {len(values)} values; expected a panorama, and a tile with two numbers up to four times."
            )
        listed = [name_of(tile) for tile in values[1::3]]
        missing = [tile for tile in listed if fold(tile) not in tiles]
        if missing:
            raise DataError(f"{where} names the tile {printable(missing[0])}, which is not in {_TILES} of its city.")
        panoramas.append((name_of(listed_path(values[0], where)), [tiles[fold(tile)] for tile in listed]))
    return panoramas
