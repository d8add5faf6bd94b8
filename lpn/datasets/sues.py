"""SUES-200 (Zhu et al. 2023): 200 places from four heights, raw or split for training and test.

    <name with "drone">/0001/{150,200,250,300}/*     raw: 50 frames each; indexs.yaml lists the places to train on
    satellite-view/0001/*
    Training/<height>/{drone,satellite}/0001/*       split: 120 places; also train/<height>/...
    Testing/<height>/query_{drone,satellite}/0001/*  80 places; also test/<height>/...
    Testing/<height>/gallery_{drone,satellite}/0001/*    all 200 places

The label of a picture is its place's number, and the group of a drone picture its height in metres. Tiles are the same at all
heights.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.datasets.base import LeftOut, ListedDataset, Picture, Size, hidden, read_lines, unread_below
from lpn.datasets.university import place_pictures

HEIGHTS = ("150", "200", "250", "300")
INDEX = "indexs.yaml"
_TILES = "satellite-view"
_SPLITS = {"train": ("Training", "train"), "test": ("Testing", "test")}
_FULL = {
    "train/drone": Size(24_000, 120),
    "train/satellite": Size(120, 120),
    "test/query_drone": Size(16_000, 80),
    "test/query_satellite": Size(80, 80),
    "test/gallery_drone": Size(40_000, 200),
    "test/gallery_satellite": Size(200, 200),
}
_Lists = dict[str, list[Picture]]


class SUES200(ListedDataset):
    """A folder of SUES-200, raw or split.

    Raises:
        DataError: if a part of the layout is missing; the message names it.
    """

    kind = "SUES-200"
    group_name = "height"
    trained_distractors = True

    def __init__(self, root: Path) -> None:
        lists = _raw(root) if is_raw(root) else _split(root)
        train, queries, gallery = lists
        super().__init__(root, train, queries, gallery, "Testing/<height>/{query,gallery}_{drone,satellite}/<place>")
        self.published_sizes = _FULL

    def unread(self) -> list[LeftOut]:
        return unread_below(self.root)


def is_sues(root: Path) -> bool:
    """Return whether a folder is SUES-200's, raw or split."""
    folders = [root / name for names in _SPLITS.values() for name in names]
    split = any((folder / height).is_dir() for folder in folders for height in HEIGHTS)
    return split or is_raw(root) or any((root / names[0]).is_dir() for names in _SPLITS.values())


def is_raw(root: Path) -> bool:
    """Return whether a folder is SUES-200's raw form, or what is left of it."""
    drone = _drone_folder(root)
    return (root / _TILES).is_dir() and (drone is not None or (root / INDEX).is_file())


def _drone_folder(root: Path) -> Path | None:
    folders = sorted(
        path for path in root.iterdir() if "drone" in path.name.lower() and path.is_dir() and not hidden(path)
    )
    return folders[0] if folders else None


def _split(root: Path) -> tuple[_Lists, _Lists, _Lists]:
    train = _of_heights(root, "train", "drone", "satellite")
    queries = _of_heights(root, "test", "query_drone", "query_satellite")
    gallery = _of_heights(root, "test", "gallery_drone", "gallery_satellite")
    return train, queries, gallery


def _of_heights(root: Path, split: str, drone: str, satellite: str) -> _Lists:
    """Return the drone pictures of all heights, and the tiles of the first height that has some."""
    pictures: _Lists = {"drone": [], "satellite": []}
    top = next((root / name for name in _SPLITS[split] if (root / name).is_dir()), None)
    if top is None:
        return pictures
    heights = [height for height in HEIGHTS if (top / height).is_dir()]
    if not heights:
        raise DataError(
            f"{top.name} of {printable(root.name)} has no folder {', '.join(HEIGHTS)}; expected one for each height of SUES-200."
        )
    for height in heights:
        missing = [name for name in (drone, satellite) if not (top / height / name).is_dir()]
        if missing:
            raise DataError(
                f"{top.name}/{height} of {printable(root.name)} has no folder {' and no folder '.join(missing)}; expected "
                f"{drone} and {satellite} for each height, as in SUES-200."
            )
        pictures["drone"] += _at(place_pictures(top / height / drone), height)
        pictures["satellite"] = pictures["satellite"] or place_pictures(top / height / satellite)
    return pictures


def _raw(root: Path) -> tuple[_Lists, _Lists, _Lists]:
    drone = _drone_folder(root)
    if drone is None or not (root / INDEX).is_file():
        missing = INDEX if drone is not None else 'a folder whose name contains "drone"'
        raise DataError(
            f"{printable(root.name)} has SUES-200's {_TILES} and not {missing}; expected the drone pictures, {_TILES}, and "
            f"{INDEX} of its repository, which names the places to train on."
        )
    trained = _trained(root / INDEX)
    tiles, photos = place_pictures(root / _TILES), []
    for place in sorted(path for path in drone.iterdir() if path.is_dir() and not hidden(path)):
        if not place.name.isdecimal():
            raise DataError(
                f"The folder {printable(place.name)} in {printable(drone.name)} is not a number; expected one folder per place."
            )
        # The folder of a height stands where that of a place does elsewhere.
        photos += [
            replace(picture, label=int(place.name), name=f"{place.name}/{picture.path.stem} {height} m", group=height)
            for picture in place_pictures(place)
            if (height := picture.path.parent.name) in HEIGHTS
        ]
    everything = {"drone": photos, "satellite": tiles}
    train = {view: _chosen(pictures, trained, True) for view, pictures in everything.items()}
    return train, {view: _chosen(pictures, trained, False) for view, pictures in everything.items()}, everything


def _trained(file: Path) -> set[int]:
    """Return the numbers below `index:` in the published list of places to train on."""
    text = "\n".join(read_lines(file, INDEX))
    _, _, listed = text.partition("index")
    numbers = {int(number) for number in re.findall(r"\b\d{1,4}\b", listed)}
    if not numbers:
        raise DataError(f"{INDEX} names no place; expected its key index with the numbers of the places to train on.")
    return numbers


def _chosen(pictures: list[Picture], places: Collection[int], among: bool) -> list[Picture]:
    return [picture for picture in pictures if (picture.label in places) == among]


def _at(pictures: list[Picture], height: str) -> list[Picture]:
    return [replace(picture, name=f"{picture.name} {height} m", group=height) for picture in pictures]
