"""The pictures of GeoText-1652 (Chu et al. 2024): University-1652's places, all views of a place in one folder.

    [images/]train/<place>/*
    [images/]test/query(701)/<place>/*
    [images/]test/gallery_no_train(250)/<place>/*    distractors
    test_951_version.json, test_24G_version.json     objects whose "image" is a path below images; texts are not read

The view of a picture is that of its name: drone_view, satellite_view, street_view; or, as in University-1652, image-<number> for
a drone and the place's number for a satellite. Every other picture of a place is a street picture.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.lists import read_json
from lpn.datasets.base import Dataset, PictureRow, sizes
from lpn.datasets.layouts.university import place_pictures
from lpn.datasets.listed_paths import FilesBelow, listed_path

_LISTS = ("test_951_version.json", "test_24G_version.json")
_QUERY, _DISTRACTORS = "test/query(701)", "test/gallery_no_train(250)"
_VIEWS = ("drone", "satellite", "street")
_DRONE = re.compile(r"image-\d+")


class GeoText(Dataset):
    """A folder of GeoText-1652; a picture's label is its place's number."""

    kind = "GeoText-1652"
    marks = (*((name,) for name in _LISTS), (f"images/{_QUERY}/",), (f"{_QUERY}/",))
    known_by = f"{_LISTS[0]} (GeoText-1652)"
    parts = ("images", "train", "test")
    expected = f"{_QUERY}/<place>/* of two views"
    unusable = "pictures of its lists"
    published_sizes = sizes(
        train={"drone": (37_854, 701), "satellite": (701, 701), "street": (11_663, 701)},
        query={"drone": (None, 701), "satellite": (701, 701)},
        gallery={"drone": (51_355, 951), "satellite": (951, 951), "street": (2_921, 793)},
    )

    def rows(self) -> Iterator[PictureRow]:
        top, name = _top(self.root), printable(self.root.name)
        inside = top.relative_to(self.root).as_posix()
        self.folders = [f"{inside}/{split}" for split in ("train", "test")]
        train, query, distractors = (place_pictures(top / folder) for folder in ("train", _QUERY, _DISTRACTORS))
        if not query:
            raise DataError(
                f"{name} has GeoText-1652's lists and no pictures in {_QUERY}; unpack the archives in images."
            )
        if both := {picture.label for picture in query} & {picture.label for picture in distractors}:
            raise DataError(
                f"{name} has the place {min(both):04d} in {_QUERY} and in {_DISTRACTORS}; expected different places, so unpack "
                "it again."
            )
        for of, pictures in (("train/", train), ("test/query_", query), ("test/gallery_", [*query, *distractors])):
            for view in _VIEWS:
                for picture in pictures:
                    if _view(picture.path) == view:
                        yield PictureRow(of + view, picture.path, picture.label, picture.name)
        there = FilesBelow(top)
        for path in _listed(self.root):
            if there.find(path) is None:
                self.leave_out(path)


def _top(root: Path) -> Path:
    images = root / "images"
    return images if any((images / split).is_dir() for split in ("train", "test")) else root


def _view(file: Path) -> str:
    named = next((view for view in _VIEWS if file.stem.startswith(f"{view}_view")), None)
    if named is not None:
        return named
    if _DRONE.fullmatch(file.stem):
        return "drone"
    return "satellite" if file.stem == file.parent.name else "street"


def _listed(root: Path) -> Iterator[str]:
    """Yield the paths of the pictures that the lists name."""
    for name in _LISTS:
        entries = read_json(root / name, name) if (root / name).is_file() else []
        if not isinstance(entries, list) or not all(
            isinstance(entry, dict) and isinstance(entry.get("image"), str) for entry in entries
        ):
            raise DataError(f'{name} is not a list of objects with an "image"; expected one for each picture.')
        for number, entry in enumerate(entries, 1):
            yield listed_path(entry["image"], f"Object {number} of {name}")
