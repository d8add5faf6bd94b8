"""VIGOR (Zhu et al. 2021): panoramas and tiles of four cities; a panorama is in the middle of one tile, and in up to 3 others.

    <city>/panorama/<id>,<latitude>,<longitude>,.jpg       also ground/<city>/...
    <city>/satellite/satellite_<latitude>_<longitude>.png  also satellite/<city>/...
    splits/<city>/satellite_list.txt                       one tile a line; splits__corrected if there is no splits
    splits/<city>/same_area_balanced_{train,test}.txt      panorama, then four times: tile, and its offset in two numbers
    splits/<city>/pano_label_balanced.txt                  as above, for the whole city

The same-area split trains and tests on panoramas of all cities. The cross-area split trains on NewYork and Seattle, and tests on
Chicago and SanFrancisco. The first of the four tiles is true, and the others are half-true (semi-positives). The gallery is every
tile of the test's cities.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.lists import numbered_lines
from lpn.datasets import geo
from lpn.datasets.base import Dataset, Picture, PictureRow, sizes
from lpn.datasets.listed_paths import fold, listed_path, name_of

CITIES = ("Chicago", "NewYork", "SanFrancisco", "Seattle")
_SPLITS = ("splits", "splits__corrected")
# The training cities, the test cities, and the lists of a city, by area.
_CITIES: dict[str, dict[str, tuple[str, ...]]] = {
    "same-area": {"train": CITIES, "test": CITIES},
    "cross-area": {"train": ("NewYork", "Seattle"), "test": ("Chicago", "SanFrancisco")},
}
_LISTS = {"same-area": "same_area_balanced_{}.txt", "cross-area": "pano_label_balanced.txt"}
_TILES = "satellite_list.txt"
_MARKS = (*(f"{splits}/{{}}/" for splits in _SPLITS), "{}/panorama/", "ground/{}/")
# The paper states these numbers. The authors' repository states none, and the released lists were not available for a count.
_FULL = {"same-area": (52_609, 52_605, 90_618), "cross-area": (51_520, 53_694, 46_563)}
_COORDINATES = re.compile(r"(-?\d+\.\d+)[,_](-?\d+\.\d+),?\.\w+$")


class VIGOR(Dataset):
    """A folder of VIGOR in one of its areas; its only task is "street-to-satellite", and its groups are the cities.

    A panorama's label is the number of its true tile among all listed tiles.
    """

    kind = "VIGOR"
    marks = tuple((path.format(city),) for city in CITIES for path in _MARKS)
    splits: Mapping[str, Sequence[str]] = {
        area: [f"{top}/{city}/{name.format('test')}" for top in _SPLITS for city in _CITIES[area]["test"]]
        for area, name in _LISTS.items()
    }
    panoramas = True
    group_name = "city"
    positions_from = "the pictures' names"
    expected = "the lists of each city in splits, and the pictures that they name"

    def rows(self) -> Iterator[PictureRow]:
        area, top = str(self.split), next(name for name in _SPLITS if (self.root / name).is_dir())
        train, test, gallery = _FULL[area]
        self.published_sizes = sizes(
            train={"street": (train, None)}, query={"street": (test, None)}, gallery={"satellite": (gallery, gallery)}
        )
        tiles_of = {city: self._tiles(top, city) for city in CITIES if (self.root / top / city).is_dir()}
        files = [file for tiles in tiles_of.values() for file in tiles.values()]
        numbers = {file: number for number, file in enumerate(dict.fromkeys(files))}
        for city in _CITIES[area]["test"]:
            for file in tiles_of.get(city, {}).values():
                yield PictureRow("test/gallery_satellite", file, numbers[file], f"{city}/{Path(file).stem}")
        used = set()
        for of, split in (("train/street", "train"), ("test/query_street", "test")):
            for city in _CITIES[area][split]:
                name = f"{top}/{city}/{_LISTS[area].format(split)}"
                if not (self.root / name).is_file():
                    if split == "test" or city in tiles_of:
                        self.leave_out(name)
                    continue
                folder = self._folder(city, "panorama", "ground")
                for panorama, (true, *semi) in _panoramas(self.root / name, name, tiles_of[city]):
                    file, title = f"{folder}/{panorama}", f"{city}/{panorama.split(',')[0]}"
                    if split == "train" and self.files.find(file) is not None:
                        used.add(true)
                    yield PictureRow(of, file, numbers[true], title, city, true=[true], semi=semi)
        for file, number in numbers.items():
            if file in used and self.files.find(file) is not None:
                yield PictureRow("train/satellite", file, number, Path(file).stem)

    def place(self, picture: Picture) -> geo.Position:
        name = picture.path.name
        if (point := _COORDINATES.search(name)) is None:
            raise DataError(
                f"The picture {printable(name)} has no latitude and longitude in its name, as VIGOR's have."
            )
        return geo.Position(float(point[1]), float(point[2]))

    def _folder(self, city: str, inner: str, outer: str) -> str:
        """Return the folder of a city's pictures, in either published form."""
        return f"{outer}/{city}" if (self.root / outer / city).is_dir() else f"{city}/{inner}"

    def _tiles(self, top: str, city: str) -> dict[str, str]:
        """Return the path of each tile of a city by the key of its name; see `fold`."""
        name, folder = f"{top}/{city}/{_TILES}", self._folder(city, "satellite", "satellite")
        tiles = (name_of(listed_path(line, where)) for where, line in numbered_lines(self.root / name, name))
        return {fold(tile): f"{folder}/{tile}" for tile in tiles}


def _panoramas(file: Path, name: str, tiles: Mapping[str, str]) -> Iterator[tuple[str, list[str]]]:
    """Yield each panorama's file name, and the paths of its tiles, the true one first."""
    for where, line in numbered_lines(file, name):
        values = line.split()
        if len(values) < 4 or len(values) % 3 != 1:
            expected = "a panorama, and a tile with two numbers up to four times"
            raise DataError(f"{where} has the wrong number of values, {len(values)}; expected {expected}.")
        listed = [name_of(tile) for tile in values[1::3]]
        if missing := [tile for tile in listed if fold(tile) not in tiles]:
            raise DataError(f"{where} names the tile {printable(missing[0])}, which is not in {_TILES} of its city.")
        yield name_of(listed_path(values[0], where)), [tiles[fold(tile)] for tile in listed]
