"""World-UAV, the data set of UAV-GeoLoc (Wu et al. 2025): flights over regions, each with tiles of its own.

    Index/{test,test_country,test_all}.txt                   regions to test on: terrain, city, mix; a path a line
    Index/{train,train_country,train_all}.txt                regions to train on
    <region>/DB/img/*.png                                    tiles
    <region>/query/height<h>_rot<r>/footage/height<h>_rot<r>_<key>.jpeg
    <region>/{positive,semi_positive}.json                   names of tiles by key; semi_positive.json may lack keys

Positives and semi-positives are both true, and a query is ranked among the tiles of its region alone. Queries are flights at
100, 125, and 150 m, at turns by multiples of 45 degrees. The published recall is the mean over the regions.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import cast

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.images import SUFFIXES
from lpn.core.lists import numbered_lines, read_json
from lpn.core.tables import Column, number_column
from lpn.datasets.base import Dataset, Picture, PictureRow
from lpn.datasets.listed_paths import fold, listed_path, name_of

_SUFFIXES = {"terrain": "", "city": "_country", "mix": "_all"}
# The released commands name the lists in both folders.
_INDEX = ("Index", "Index/Index")
_POSITIVE, _SEMI = "positive.json", "semi_positive.json"
_TILES = "DB/img"
_FLIGHT = re.compile(r"height(\d+)_rot(\d+)")
_HEIGHTS, _STEP = (100, 125, 150), 45


class WorldUAV(Dataset):
    """A folder of World-UAV in one of its splits, or the folder of one region; its only task is "drone-to-satellite".

    A tile's label is its number; a drone picture has the label of its first positive. Groups are the regions. If the folder is
    one region, groups are its flights, and all of them are queries.
    """

    kind = "World-UAV"
    marks = (
        (_POSITIVE, f"{_TILES}/"),
        *((f"{folder}/test{suffix}.txt",) for folder in _INDEX for suffix in ("", "_country", "_all")),
    )
    splits: Mapping[str, Sequence[str]] = {
        name: [f"{folder}/test{suffix}.txt" for folder in _INDEX] for name, suffix in _SUFFIXES.items()
    }
    group_name = "region"
    mean_of_groups = True
    expected = f"query/height<h>_rot<r>/footage and {_POSITIVE} of each region"

    def splits_there(self) -> list[str] | None:
        return None if _is_region(self.root) else super().splits_there()

    def rows(self) -> Iterator[PictureRow]:
        if self.split is None:
            self.group_name, regions, trained = "flight", [""], list[str]()
        else:
            regions, trained = self._regions("test", self.split), self._regions("train", self.split)
        tiles_of = {region: self._tiles(region) for region in dict.fromkeys((*regions, *trained))}
        files = [file for tiles in tiles_of.values() for file in tiles.values()]
        numbers = {file: number for number, file in enumerate(files)}
        used = set()
        for region in regions:
            for file in tiles_of[region].values():
                yield PictureRow("test/gallery_satellite", file, numbers[file], _tile_name(file), region=region)
            yield from self._flown("test/query_drone", region, tiles_of[region], numbers)
        for region in trained:
            for row in self._flown("train/drone", region, tiles_of[region], numbers):
                used.add(row.label)
                yield row
        for file, number in numbers.items():
            if number in used:
                yield PictureRow("train/satellite", file, number, _tile_name(file))

    def columns(self, queries: Sequence[Picture]) -> list[Column]:
        flights = [_FLIGHT.match(picture.path.stem) for picture in queries]
        if not all(flights):
            return super().columns(queries)
        numbers = [tuple(map(float, flight.groups())) for flight in flights if flight is not None]
        return [
            *super().columns(queries),
            number_column("height", [height for height, _ in numbers], "m"),
            number_column("rotation", [rotation for _, rotation in numbers], "°"),
        ]

    def _regions(self, name: str, split: str) -> list[str]:
        """Return the paths of the existing regions of a list."""
        lists = (f"{folder}/{name}{_SUFFIXES[split]}.txt" for folder in _INDEX)
        title = next((name for name in lists if (self.root / name).is_file()), None)
        if title is None:
            return []
        paths = dict.fromkeys(listed_path(line, where) for where, line in numbered_lines(self.root / title, title))
        needed = {path: (path, f"{path}/{_POSITIVE}", f"{path}/{_TILES}") for path in paths}
        missing = {path: [part for part in parts if not (self.root / part).exists()] for path, parts in needed.items()}
        for parts in filter(None, missing.values()):
            self.leave_out(parts[0])
        return [path for path, parts in missing.items() if not parts]

    def _pictures_in(self, folder: str) -> list[str]:
        return [name for name in self.files.names(folder) if name.lower().endswith(SUFFIXES)]

    def _tiles(self, region: str) -> dict[str, str]:
        """Return the paths of a region's tiles by their folded names."""
        folder = f"{region}/{_TILES}".lstrip("/")
        return {fold(name): f"{folder}/{name}" for name in self._pictures_in(folder)}

    def _flown(self, of: str, region: str, tiles: dict[str, str], numbers: dict[str, int]) -> Iterator[PictureRow]:
        """Yield the drone pictures of a region, with labels by their first positive."""
        true, query = self._true(region, tiles), f"{region}/query".lstrip("/")
        flights = [flight for flight in map(_FLIGHT.fullmatch, self.files.names(query)) if flight]
        if not flights:
            self.leave_out(query, "has no flights")
        for height, rotation, flight in sorted((int(found[1]), int(found[2]), found[0]) for found in flights):
            if of == "test/query_drone" and self.split and (height not in _HEIGHTS or rotation % _STEP):
                continue
            folder = f"{query}/{flight}/footage"
            files = {Path(name).stem.rpartition("_")[2]: name for name in self._pictures_in(folder)}
            for key, of_key in true.items():
                if key not in files:
                    self.leave_out(f"{folder}/{flight}_{key}.jpeg")
                elif of_key:
                    name, group = f"{region}/{Path(files[key]).stem}".lstrip("/"), region if self.split else flight
                    file, label = f"{folder}/{files[key]}", numbers[of_key[0]]
                    yield PictureRow(of, file, label, name, group, true=of_key, region=region)

    def _true(self, region: str, tiles: dict[str, str]) -> dict[str, list[str]]:
        """Return the existing true tiles of each key of a region, positives first."""
        positive, semi = (self._names_by_key(f"{region}/{name}".lstrip("/")) for name in (_POSITIVE, _SEMI))
        true: dict[str, list[str]] = {}
        for key, names in positive.items():
            true[key] = []
            for name in dict.fromkeys((*names, *semi.get(key, ()))):
                if (tile := tiles.get(fold(name_of(name)))) is not None:
                    true[key].append(tile)
                else:
                    self.leave_out(f"{region}/{_TILES}/{printable(name)}".lstrip("/"))
            if not true[key]:
                self.leave_out(f"{region} {key}".strip(), "has none of its true tiles")
        return true

    def _names_by_key(self, name: str) -> dict[str, list[str]]:
        """Return the names of tiles by key; none for a missing file."""
        lists = read_json(self.root / name, name) if (self.root / name).is_file() else {}
        values = [*lists.values()] if isinstance(lists, dict) else [None]
        if not all(isinstance(names, list) and all(isinstance(tile, str) for tile in names) for names in values):
            raise DataError(
                f"{printable(name)} is not an object of lists; expected names of tiles by the numbers of frames."
            )
        return cast(dict[str, list[str]], lists)


def _is_region(folder: Path) -> bool:
    return (folder / _POSITIVE).is_file() and (folder / _TILES).is_dir()


def _tile_name(path: str) -> str:
    return path.replace(f"{_TILES}/", "").rpartition(".")[0]
