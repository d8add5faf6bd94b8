"""The folder layout of University-1652 and of rendered worlds.

    train/{satellite,drone,street,google}/<id>/*     JPEG, PNG, WebP, BMP, GIF, TIFF
    test/{query,gallery}_{satellite,drone,street}/<id>/*

In the test split, a text file in place of a folder names another folder whose pictures also have this role. The label of a
picture is its folder's integer name.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import linked_folder
from lpn.core.images import SUFFIXES
from lpn.datasets.base import Dataset, PictureRow, sizes
from lpn.datasets.listed_paths import hidden_name
from lpn.datasets.rendered import PLAN, is_rendered

# The lists in the order of display.
LISTS = (
    *(f"train/{name}" for name in ("satellite", "drone", "street", "google")),
    *(f"test/{role}_{view}" for role in ("query", "gallery") for view in ("drone", "satellite", "street")),
)
_NUMBERED = [f"{name}/[0-9]*/" for name in LISTS if name.startswith("train/")]


class University(Dataset):
    """A folder in University-1652's layout; `kind` is "world" if it was rendered."""

    kind = "University-1652"
    marks = (
        (PLAN,),
        *((f"{name}/",) for name in LISTS if name.startswith("test/")),
        # A folder `train` with only one of these lists may belong to another layout.
        *(("train/", *sets) for sets in combinations(_NUMBERED, 2)),
    )
    priority = -1
    folders = ("train", "test")
    expected = "test/query_drone/<number>/*.jpg and test/gallery_satellite/<number>/*.jpg"
    # The size of train/street is disputed: the publications' sum (50,218 training pictures) and the released folder differ.
    published_sizes = sizes(
        train={"satellite": (701, 701), "drone": (37_854, 701), "street": (None, 701), "google": (21_099, None)},
        query={"drone": (37_855, 701), "satellite": (701, 701), "street": (2_579, 701)},
        gallery={"drone": (51_355, 951), "satellite": (951, 951), "street": (2_921, 793)},
    )

    def rows(self) -> Iterator[PictureRow]:
        if is_rendered(self.root):
            self.kind, self.title, self.published_sizes = "world", "a rendered world", {}
        for name in LISTS:
            yield from place_rows(name, self.folder_of(name))

    def folder_of(self, name: str) -> Path:
        """Return the folder of one of the lists; a text file in its place may name it."""
        return linked_folder(self.root / name)


def place_rows(of: str, folder: Path) -> Iterator[PictureRow]:
    """Yield the pictures of <folder>/<place>/*, by place and file name; none without the folder.

    Raises:
        DataError: if the folder of a place is not named by a number.
    """
    for name in _names(folder, folders=True) if folder.is_dir() else []:
        place = folder / name
        if not name.isdecimal():
            raise DataError(
                f"The folder {name} in {folder.parent.name}/{folder.name} is not a number; expected one folder per "
                "place, named by its number, so rename or remove it."
            )
        files = [file for file in _names(place, folders=False) if file.lower().endswith(SUFFIXES)]
        for file in files:
            title = name if len(files) == 1 else f"{name}/{file.rpartition('.')[0].removeprefix('image-')}"
            yield PictureRow(of, place / file, int(name), title)


def _names(folder: Path, folders: bool) -> list[str]:
    """Return the sorted names of the folders in a folder, or of everything else, broken links included."""
    with os.scandir(folder) as entries:
        return sorted(entry.name for entry in entries if not hidden_name(entry.name) and _is_folder(entry) == folders)


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # circular links
        return False
