"""World-UAV, the data set of UAV-GeoLoc (Wu et al. 2025): flights over regions, each with tiles of its own.

    Index/{test,test_country,test_all}.txt                   regions to test on: terrain, city, mix; a path a line
    Index/{train,train_country,train_all}.txt                regions to train on
    <region>/DB/img/*.png                                    tiles
    <region>/query/height<h>_rot<r>/footage/height<h>_rot<r>_<key>.jpeg
    <region>/{positive,semi_positive}.json                   names of tiles by key; semi_positive.json may lack keys

Positives and semi-positives are both true, and a query is ranked among the tiles of its region alone. Queries are the flights at
100, 125, and 150 m that are turned by multiples of 45 degrees. The published recall is the mean over the regions.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lpn.core.arrays import Int64Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.images import SUFFIXES
from lpn.core.tables import Column, number_column
from lpn.datasets.areas import SCENES, Scenes, choose_split
from lpn.datasets.base import LeftOut, ListedDataset, Picture, Truth, hidden_name, read_lines, read_text, warn_left_out
from lpn.datasets.listed_paths import fold, listed_path, name_of

_SUFFIXES: dict[Scenes, str] = {"terrain": "", "city": "_country", "mix": "_all"}
# The released commands name the lists in both folders.
_INDEX = ("Index", "Index/Index")
_POSITIVE, _SEMI = "positive.json", "semi_positive.json"
_TILES = "DB/img"
_FLIGHT = re.compile(r"height(\d+)_rot(\d+)")
_HEIGHTS, _STEP = (100, 125, 150), 45


@dataclass(frozen=True)
class _Region:
    """One region: its path below the root, its tiles by their folded names, and the names of each key's true tiles."""

    path: str
    tiles: dict[str, str]
    true: dict[str, list[str]]


class WorldUAV(ListedDataset):
    """A folder of World-UAV in one of its splits, or the folder of one region; its only task is "drone-to-satellite".

    A tile's label is its number; a drone picture's is that of its first positive. `truth` holds the true tiles. Groups are the
    regions; in one region they are its flights, of which all are queries.

    Args:
        split: "terrain", "city", or "mix"; by default the first whose test list is there.

    Raises:
        DataError: if a list is missing or malformed, or there is nothing to test with.
    """

    kind = "World-UAV"
    group_name = "region"
    mean_of_groups = True

    def __init__(self, root: Path, split: Scenes | None = None) -> None:
        self._left_out: dict[str, LeftOut] = {}
        if _is_region(root) and split is None:
            self.group_name = "flight"
            regions, trained = [_region(root, "", self._left_out)], []
            where = f"query/height<h>_rot<r>/footage and {_POSITIVE}"
        else:
            there = [scenes for scenes in SCENES if _list(root, "test", scenes) is not None]
            split = choose_split(root, there, split, f"{_INDEX[0]}/test.txt")
            regions, trained = (self._regions(root, name, split) for name in ("test", "train"))
            where = f"the regions of {_INDEX[0]}/test{_SUFFIXES[split]}.txt"
        numbers: dict[str, int] = {}
        for region in (*regions, *trained):
            for tile in region.tiles.values():
                numbers.setdefault(tile, len(numbers))
        self._true: list[Int64Array] = []
        self._other: list[Int64Array] = []
        queries: list[Picture] = []
        gallery = [_tile(root, tile, numbers[tile]) for region in regions for tile in region.tiles.values()]
        place = {tile.label: position for position, tile in enumerate(gallery)}
        for region in regions:
            own = [place[numbers[tile]] for tile in region.tiles.values()]
            others = np.setdiff1d(np.arange(len(gallery)), own)
            for picture, true in self._pictures(root, region, numbers, test=True):
                queries.append(picture)
                self._true.append(np.array(sorted(place[number] for number in true), np.int64))
                self._other.append(others)
        photos = [picture for region in trained for picture, _ in self._pictures(root, region, numbers, test=False)]
        used = {picture.label for picture in photos}
        super().__init__(
            root,
            {
                "drone": photos,
                "satellite": [_tile(root, tile, number) for tile, number in numbers.items() if number in used],
            },
            {"drone": queries},
            {"satellite": gallery},
            where,
        )
        self.left_out = list(self._left_out.values())
        warn_left_out(self.root.name, self.left_out, "files of its lists cannot be used", "they are left out")

    def tasks(self) -> list[str]:
        return ["drone-to-satellite"] if self._queries["drone"] and self._gallery["satellite"] else []

    def why_no_task(self) -> str:
        return f"has no drone picture with a true tile; expected {self._expected}"

    def truth(self, task: str) -> list[Truth]:
        del task
        return [Truth(true, others) for true, others in zip(self._true, self._other, strict=True)]

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

    def _regions(self, root: Path, name: str, split: Scenes) -> list[_Region]:
        file = _list(root, name, split)
        if file is None:
            return []
        title = file.relative_to(root).as_posix()
        lines = [(number, line) for number, line in enumerate(read_lines(file, title), 1) if line.strip()]
        paths = dict.fromkeys(listed_path(line, f"Line {number} of {title}") for number, line in lines)
        if not paths:
            raise DataError(f"{title} of {printable(root.name)} names no region; expected the path of one a line.")
        regions = []
        for path in paths:
            if _is_region(root / path):
                regions.append(_region(root, path, self._left_out))
            else:
                missing = next(part for part in ("", _POSITIVE, _TILES) if not (root / path / part).exists())
                lost = f"{path}/{missing}".rstrip("/")
                self._left_out[lost] = LeftOut(lost, "is not there")
        return regions

    def _pictures(
        self, root: Path, region: _Region, numbers: dict[str, int], test: bool
    ) -> Iterator[tuple[Picture, list[int]]]:
        """Yield each drone picture of a region with the numbers of its true tiles, the first positive first."""
        whole = self.group_name == "flight"
        flights = _flights(root / region.path / "query")
        if not flights:
            lost = f"{region.path}/query".lstrip("/")
            self._left_out[lost] = LeftOut(lost, "has no flights")
        for flight in flights:
            height, rotation = map(int, flight.split("height")[1].split("_rot"))
            if test and not whole and (height not in _HEIGHTS or rotation % _STEP):
                continue
            folder = "/".join(part for part in (region.path, "query", flight, "footage") if part)
            files = {
                Path(name).stem.rpartition("_")[2]: name
                for name in _names(root / folder)
                if name.lower().endswith(SUFFIXES)
            }
            for key, true in region.true.items():
                if key not in files:
                    lost = f"{folder}/{flight}_{key}.jpeg"
                    self._left_out[lost] = LeftOut(lost, "is not there")
                elif true:
                    labels = [numbers[tile] for tile in dict.fromkeys(true)]
                    title = "/".join(part for part in (region.path, Path(files[key]).stem) if part)
                    group = flight if whole else region.path
                    yield Picture(root / folder / files[key], labels[0], printable(title), group=group), labels


def is_world_uav(root: Path) -> bool:
    """Return whether a folder is World-UAV's, or that of one of its regions."""
    return _is_region(root) or any(_list(root, "test", split) is not None for split in SCENES)


def _is_region(folder: Path) -> bool:
    return (folder / _POSITIVE).is_file() and (folder / _TILES).is_dir()


def _list(root: Path, name: str, split: Scenes) -> Path | None:
    files = (root / folder / f"{name}{_SUFFIXES[split]}.txt" for folder in _INDEX)
    return next((file for file in files if file.is_file()), None)


def _tile(root: Path, path: str, number: int) -> Picture:
    return Picture(root / path, number, printable(path.replace(f"{_TILES}/", "").rpartition(".")[0]))


def _region(root: Path, path: str, left_out: dict[str, LeftOut]) -> _Region:
    """Read a region; tiles that its lists name and that are not there are left out."""
    folder = f"{path}/{_TILES}".lstrip("/")
    tiles = {fold(name): f"{folder}/{name}" for name in _names(root / folder) if name.lower().endswith(SUFFIXES)}
    if not tiles:
        left_out[folder] = LeftOut(folder, "has no tiles")
    positive, semi = (_lists(root, f"{path}/{name}".lstrip("/")) for name in (_POSITIVE, _SEMI))
    true: dict[str, list[str]] = {}
    for key, names in positive.items():
        true[key] = []
        for name in (*names, *semi.get(key, ())):
            if (tile := tiles.get(fold(name_of(name)))) is not None:
                true[key].append(tile)
            else:
                left_out[f"{folder}/{name}"] = LeftOut(f"{folder}/{printable(name)}", "is not there")
        if not true[key] and tiles:
            place = f"{path} {key}".strip()
            left_out[place] = LeftOut(place, "has none of its true tiles")
    return _Region(path, tiles, true)


def _lists(root: Path, name: str) -> dict[str, list[str]]:
    """Return the names of tiles by key; a file that is not there has none."""
    if not (root / name).is_file():
        return {}
    try:
        lists: Any = json.loads(read_text(root / name, name))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{printable(name)} is not JSON; save it again, or unpack it again.") from error
    if not isinstance(lists, dict) or not all(
        isinstance(names, list) and all(isinstance(tile, str) for tile in names) for names in lists.values()
    ):
        raise DataError(
            f"{printable(name)} is not an object of lists; expected names of tiles by the numbers of frames."
        )
    return lists


def _flights(folder: Path) -> list[str]:
    """Return the names of the flights' folders, by height and rotation."""
    flights = [(flight, name) for name in _names(folder) if (flight := _FLIGHT.fullmatch(name)) is not None]
    return [name for flight, name in sorted(flights, key=lambda named: tuple(map(int, named[0].groups())))]


def _names(folder: Path) -> list[str]:
    try:
        return sorted(entry.name for entry in folder.iterdir() if not hidden_name(entry.name))
    except OSError:
        return []
