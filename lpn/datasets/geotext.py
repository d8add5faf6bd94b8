"""The pictures of GeoText-1652 (Chu et al. 2024): University-1652's places, all views of a place in one folder.

    [images/]train/<place>/*
    [images/]test/query(701)/<place>/*
    [images/]test/gallery_no_train(250)/<place>/*    distractors
    test_951_version.json, test_24G_version.json     objects whose "image" is a path below images; texts are not read

The view of a picture is that of its name: drone_view, satellite_view, street_view; or, as in University-1652, image-<number> for
a drone and the place's number for a satellite. Every other picture of a place is a street picture.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.datasets.base import LeftOut, ListedDataset, Picture, Size, read_text, unread_below, warn_left_out
from lpn.datasets.listed_paths import FilesBelow, listed_path
from lpn.datasets.university import place_pictures

_LISTS = ("test_951_version.json", "test_24G_version.json")
_QUERY, _DISTRACTORS = "test/query(701)", "test/gallery_no_train(250)"
_VIEWS = ("drone", "satellite", "street")
_DRONE = re.compile(r"image-\d+")
_FULL = {
    "train/drone": Size(37_854, 701),
    "train/satellite": Size(701, 701),
    "train/street": Size(11_663, 701),
    "test/query_drone": Size(None, 701),
    "test/query_satellite": Size(701, 701),
    "test/gallery_drone": Size(51_355, 951),
    "test/gallery_satellite": Size(951, 951),
    "test/gallery_street": Size(2_921, 793),
}


class GeoText(ListedDataset):
    """A folder of GeoText-1652; a picture's label is its place's number.

    Raises:
        DataError: if pictures or lists are missing or malformed, or a place is both a query's and a distractor.
    """

    kind = "GeoText-1652"

    def __init__(self, root: Path) -> None:
        self._top = top = _top(root)
        train, query, distractors = (_by_view(top / name) for name in ("train", _QUERY, _DISTRACTORS))
        if not any(query.values()):
            raise DataError(
                f"{printable(root.name)} has GeoText-1652's lists and no pictures in {_QUERY}; unpack the archives in images."
            )
        both = {p.label for of in query.values() for p in of} & {p.label for of in distractors.values() for p in of}
        if both:
            raise DataError(
                f"{printable(root.name)} has the place {min(both):04d} in {_QUERY} and in {_DISTRACTORS}; expected different "
                "places, so unpack it again."
            )
        gallery = {view: [*query[view], *distractors[view]] for view in _VIEWS}
        super().__init__(root, train, query, gallery, f"{_QUERY}/<place>/* of two views")
        self.published_sizes = _FULL
        self.left_out = _missing(root, top)
        warn_left_out(root.name, self.left_out, "pictures of its lists are missing", "they are left out")

    def unread(self) -> list[LeftOut]:
        inside = self._top.relative_to(self.root).as_posix()
        return unread_below(self.root, [f"{inside}/{split}" for split in ("train", "test")])


def is_geotext(root: Path) -> bool:
    """Return whether a folder is GeoText-1652's: by its lists of the test split, or by its folder of queries."""
    return any((root / name).is_file() for name in _LISTS) or (_top(root) / _QUERY).is_dir()


def _top(root: Path) -> Path:
    """Return the folder of train and test: images, or the data set's own."""
    images = root / "images"
    return images if any((images / split).is_dir() for split in ("train", "test")) else root


def _by_view(folder: Path) -> dict[str, list[Picture]]:
    pictures: dict[str, list[Picture]] = {view: [] for view in _VIEWS}
    for picture in place_pictures(folder):
        pictures[_view(picture.path)].append(picture)
    return pictures


def _view(file: Path) -> str:
    named = next((view for view in _VIEWS if file.stem.startswith(f"{view}_view")), None)
    if named is not None:
        return named
    if _DRONE.fullmatch(file.stem):
        return "drone"
    return "satellite" if file.stem == file.parent.name else "street"


def _missing(root: Path, top: Path) -> list[LeftOut]:
    """Return the pictures that the lists name and that are not there."""
    there, lost = FilesBelow(top), {}
    for name in _LISTS:
        if not (root / name).is_file():
            continue
        try:
            entries: Any = json.loads(read_text(root / name, name))
        except (ValueError, RecursionError) as error:
            raise DataError(f"{name} is not JSON; save it again, or unpack it again.") from error
        if not isinstance(entries, list) or not all(
            isinstance(entry, dict) and isinstance(entry.get("image"), str) for entry in entries
        ):
            raise DataError(f'{name} is not a list of objects with an "image"; expected one for each picture.')
        for number, entry in enumerate(entries, 1):
            path = listed_path(entry["image"], f"Object {number} of {name}")
            if there.find(path) is None:
                lost[path] = LeftOut(path, "is not there")
    return list(lost.values())
