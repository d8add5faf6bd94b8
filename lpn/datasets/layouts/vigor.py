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
from collections.abc import Iterator, Mapping
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.lists import numbered_lines
from lpn.datasets import geo
from lpn.datasets.base import Dataset, Picture, PictureRow, sizes
from lpn.datasets.listed_paths import fold, listed_path, name_of

CITIES = ("Chicago", "NewYork", "SanFrancisco", "Seattle")
_SPLITS = ("splits", "splits__corrected")
# The cities to train on and to test on, and the lists of a city, by area.
_CITIES: dict[str, dict[str, tuple[str, ...]]] = {
    "same-area": {"train": CITIES, "test": CITIES},
    "cross-area": {"train": ("NewYork", "Seattle"), "test": ("Chicago", "SanFrancisco")},
}
_LISTS = {"same-area": "same_area_balanced_{}.txt", "cross-area": "pano_label_balanced.txt"}
_TILES = "satellite_list.txt"
_MARKS = (*(f"{splits}/{{}}/" for splits in _SPLITS), "{}/panorama/", "ground/{}/")
# The paper states these numbers; the authors' repository states none, and the released lists were not at hand to count.
_FULL = {"same-area": (52_609, 52_605, 90_618), "cross-area": (51_520, 53_694, 46_563)}
_COORDINATES = re.compile(r"(-?\d+\.\d+)[,_](-?\d+\.\d+),?\.\w+$")


class VIGOR(Dataset):
    """A folder of VIGOR in one of its areas; its only task is "street-to-satellite", and its groups are the cities.

    A panorama's label is the number of its true tile among all listed tiles.
    """

    kind = "VIGOR"
    marks = tuple((path.format(city),) for city in CITIES for path in _MARKS)
    known_by = "splits/Chicago (VIGOR)"
    parts = (*(city.lower() for city in CITIES), *_SPLITS, "satellite", "ground")
    splits = ("same-area", "cross-area")
    split_list = f"{_SPLITS[0]}/<city>/{_LISTS['same-area'].format('test')}"
    panoramas = True
    group_name = "city"
    positions_from = "the pictures' names"

    def splits_there(self) -> list[str]:
        splits = _splits(self.root)
        return [
            area
            for area in self.splits
            if any((splits / city / _LISTS[area].format("test")).is_file() for city in _CITIES[area]["test"])
        ]

    def rows(self) -> Iterator[PictureRow]:
        splits, area = _splits(self.root), str(self.split)
        train, test, gallery = _FULL[area]
        self.published_sizes = sizes(
            train={"street": (train, None)}, query={"street": (test, None)}, gallery={"satellite": (gallery, gallery)}
        )
        self.expected = f"{splits.name}/<city>/{_LISTS[area].format('test')} and the pictures that it names"
        tiles_of = {city: _tiles(self.root, splits, city) for city in CITIES if (splits / city).is_dir()}
        files = [file for tiles in tiles_of.values() for file in tiles.values()]
        numbers = {file: number for number, file in enumerate(dict.fromkeys(files))}
        for city in _CITIES[area]["test"]:
            for file in tiles_of.get(city, {}).values():
                yield PictureRow("test/gallery_satellite", file, numbers[file], f"{city}/{Path(file).stem}")
        used = set()
        for of, split in (("train/street", "train"), ("test/query_street", "test")):
            for city in _CITIES[area][split]:
                name = f"{splits.name}/{city}/{_LISTS[area].format(split)}"
                if not (self.root / name).is_file():
                    if split == "test" or (splits / city).is_dir():
                        self.leave_out(name)
                    continue
                folder = _folder(self.root, city, "panorama", "ground")
                for panorama, (true, *semi) in _panoramas(self.root / name, name, tiles_of[city]):
                    file, title = f"{folder}/{panorama}", f"{city}/{panorama.split(',')[0]}"
                    if split == "train" and self.files.find(file) is not None:
                        used.add(true)
                    yield PictureRow(of, file, numbers[true], title, city, true=[true], semi=semi)
        for file, number in numbers.items():
            if file in used and self.files.find(file) is not None:
                yield PictureRow("train/satellite", file, number, Path(file).stem)

    def place(self, picture: Picture) -> geo.Position:
        point = _COORDINATES.search(picture.path.name)
        if point is None or abs(float(point[1])) > 90 or abs(float(point[2])) > 180:
            raise DataError(
                f"The picture {printable(picture.path.name)} has no latitude and longitude in its name; expected VIGOR's "
                "names."
            )
        return geo.Position(float(point[1]), float(point[2]))


def _splits(root: Path) -> Path:
    folder = next((root / name for name in _SPLITS if (root / name).is_dir()), None)
    if folder is None:
        raise DataError(
            f"{printable(root.name)} has VIGOR's pictures and no folder {' or '.join(_SPLITS)}; expected its lists in one of "
            "them."
        )
    return folder


def _folder(root: Path, city: str, inner: str, outer: str) -> str:
    """Return the folder of a city's pictures below the root, in either of the two published forms."""
    return f"{outer}/{city}" if (root / outer / city).is_dir() else f"{city}/{inner}"


def _tiles(root: Path, splits: Path, city: str) -> dict[str, str]:
    """Return the path of each tile of a city by the key of its name; see `fold`."""
    name = f"{splits.name}/{city}/{_TILES}"
    folder = _folder(root, city, "satellite", "satellite")
    tiles = {}
    for where, line in numbered_lines(splits / city / _TILES, name):
        tile = name_of(listed_path(line, where))
        tiles[fold(tile)] = f"{folder}/{tile}"
    return tiles


def _panoramas(file: Path, name: str, tiles: Mapping[str, str]) -> Iterator[tuple[str, list[str]]]:
    """Yield each panorama's file name, and the paths of its tiles, the true one first."""
    for where, line in numbered_lines(file, name):
        values = line.split()
        if len(values) < 4 or len(values) % 3 != 1:
            raise DataError(
                f"{where} has {len(values)} values; expected a panorama, and a tile with two numbers up to four times."
            )
        listed = [name_of(tile) for tile in values[1::3]]
        if missing := [tile for tile in listed if fold(tile) not in tiles]:
            raise DataError(f"{where} names the tile {printable(missing[0])}, which is not in {_TILES} of its city.")
        yield name_of(listed_path(values[0], where)), [tiles[fold(tile)] for tile in listed]
