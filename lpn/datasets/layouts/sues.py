"""SUES-200 (Zhu et al. 2023): 200 places from four heights, raw or split for training and test.

    <name with "drone">/0001/{150,200,250,300}/*     raw: 50 frames each; indexs.yaml lists the places to train on
    satellite-view/0001/*
    Training/<height>/{drone,satellite}/0001/*       split: 120 places; also train/<height>/...
    Testing/<height>/query_{drone,satellite}/0001/*  80 places; also test/<height>/...
    Testing/<height>/gallery_{drone,satellite}/0001/*    all 200 places

The label of a picture is its place's number; the group of a drone picture is its height in metres. All heights share their
tiles.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.lists import read_text
from lpn.datasets.base import Dataset, PictureRow, sizes
from lpn.datasets.layouts.university import place_rows
from lpn.datasets.listed_paths import hidden_name

HEIGHTS = ("150", "200", "250", "300")
INDEX = "indexs.yaml"
_TILES = "satellite-view"
_SPLITS = {"train": ("Training", "train"), "test": ("Testing", "test")}


class SUES200(Dataset):
    """A folder of SUES-200, raw or split."""

    kind = "SUES-200"
    marks = (
        *((f"{folder}/{height}/",) for folders in _SPLITS.values() for folder in folders for height in HEIGHTS),
        *((f"{folders[0]}/",) for folders in _SPLITS.values()),
        (f"{_TILES}/", INDEX),
        (f"{_TILES}/", "*[dD][rR][oO][nN][eE]*/"),
    )
    group_name = "height"
    trained_distractors = True
    folders = ("",)
    expected = "Testing/<height>/{query,gallery}_{drone,satellite}/<place>"
    published_sizes = sizes(
        train={"drone": (24_000, 120), "satellite": (120, 120)},
        query={"drone": (16_000, 80), "satellite": (80, 80)},
        gallery={"drone": (40_000, 200), "satellite": (200, 200)},
    )

    def rows(self) -> Iterator[PictureRow]:
        drone = _drone_folder(self.root)
        if (self.root / _TILES).is_dir() and (drone is not None or (self.root / INDEX).is_file()):
            yield from _raw(self.root, drone)
            return
        yield from _split(self.root, "train", ["drone", "satellite"], "train/")
        test = [f"{role}_{view}" for role in ("query", "gallery") for view in ("drone", "satellite")]
        yield from _split(self.root, "test", test, "test/")


def _drone_folder(root: Path) -> Path | None:
    folders = (path for path in sorted(root.iterdir()) if "drone" in path.name.lower() and path.is_dir())
    return next((path for path in folders if not hidden_name(path.name)), None)


def _split(root: Path, split: str, names: list[str], before: str) -> Iterator[PictureRow]:
    """Yield the drone pictures of all heights, and the tiles of the first height with tiles."""
    top = next((root / name for name in _SPLITS[split] if (root / name).is_dir()), None)
    if top is None:
        return
    heights = [height for height in HEIGHTS if (top / height).is_dir()]
    wanted = [f"{height}/{name}" for height in heights for name in names]
    if missing := [name for name in wanted if not (top / name).is_dir()] or ([] if heights else [", ".join(HEIGHTS)]):
        at, _, folder = f"{top.name}/{missing[0]}".rpartition("/")
        raise DataError(
            f"{at} of {printable(root.name)} has no folder {folder}; expected {', '.join(names)} for each height, as in SUES-200."
        )
    for name in names:
        of_heights = ((height, list(place_rows(before + name, top / height / name))) for height in heights)
        if "drone" in name:
            yield from (_at(row, row.name, height) for height, rows in of_heights for row in rows)
        else:
            yield from next((rows for _, rows in of_heights if rows), [])


def _raw(root: Path, drone: Path | None) -> Iterator[PictureRow]:
    if drone is None or not (root / INDEX).is_file():
        missing = INDEX if drone is not None else 'a folder whose name contains "drone"'
        raise DataError(
            f"{printable(root.name)} has SUES-200's {_TILES} and not {missing}; expected the drone pictures, {_TILES}, and "
            f"{INDEX} of its repository, which names the places to train on."
        )
    trained = _trained(root / INDEX)
    rows = []
    for place in sorted(path for path in drone.iterdir() if path.name.isdecimal()):
        # The folder of a height is where other layouts have a place's folder.
        for row in place_rows("drone", place):
            file = Path(row.file)
            if file.parent.name in HEIGHTS:
                row = replace(row, label=int(place.name))
                rows.append(_at(row, f"{place.name}/{file.stem}", file.parent.name))
    for row in (*rows, *place_rows("satellite", root / _TILES)):
        yield replace(row, of=f"train/{row.of}" if row.label in trained else f"test/query_{row.of}")
        yield replace(row, of=f"test/gallery_{row.of}")


def _at(row: PictureRow, name: str, height: str) -> PictureRow:
    return replace(row, name=f"{name} {height} m", group=height)


def _trained(file: Path) -> set[int]:
    """Return the numbers below `index:` in the published list of training places."""
    numbers = {int(number) for number in re.findall(r"\b\d{1,4}\b", read_text(file, INDEX).partition("index")[2])}
    if not numbers:
        raise DataError(f"{INDEX} names no place; expected its key index with the numbers of the places to train on.")
    return numbers
