"""The folder layout of University-1652 and of rendered worlds.

    train/{satellite,drone,street,google}/<id>/*     JPEG, PNG, WebP, BMP, GIF, TIFF
    test/{query,gallery}_{satellite,drone,street}/<id>/*

In the test split a text file may stand in place of a folder; it names another folder, whose pictures have this role, too.
The label of a picture is its folder's integer name.
"""

from __future__ import annotations

import os
from itertools import combinations
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import linked_folder, printable
from lpn.core.images import SUFFIXES
from lpn.datasets.base import Dataset, Picture, sizes
from lpn.datasets.listed_paths import hidden_name
from lpn.datasets.rendered import PLAN, is_rendered

# The lists in the order in which they are shown.
LISTS = (
    *(f"train/{name}" for name in ("satellite", "drone", "street", "google")),
    *(f"test/{role}_{view}" for role in ("query", "gallery") for view in ("drone", "satellite", "street")),
)
_NUMBERED = [f"{name}/[0-9]*/" for name in LISTS if name.startswith("train/")]


class University(Dataset):
    """A folder in University-1652's layout; `kind` is "world" if it was rendered.

    The pictures of a list are read from its folder when they are asked for, in order of place and file name.
    """

    kind = "University-1652"
    marks = (
        (PLAN,),
        *((f"{name}/",) for name in LISTS if name.startswith("test/")),
        # Other layouts have a folder train with one set, too.
        *(("train/", *sets) for sets in combinations(_NUMBERED, 2)),
    )
    known_by = "train and test as in University-1652"
    parts = ("train", "test")
    priority = -1
    folders = ("train", "test")
    # The size of train/street is disputed: the publications' sum (50,218 training pictures) and the released folder differ.
    published_sizes = sizes(
        train={"satellite": (701, 701), "drone": (37_854, 701), "street": (None, 701), "google": (21_099, None)},
        query={"drone": (37_855, 701), "satellite": (701, 701), "street": (2_579, 701)},
        gallery={"drone": (51_355, 951), "satellite": (951, 951), "street": (2_921, 793)},
    )

    def __init__(self, root: Path, split: str | None = None) -> None:
        super().__init__(root, split)
        self._read: dict[str, list[Picture]] = {}
        if is_rendered(root):
            self.kind, self.title, self.published_sizes = "world", "a rendered world", {}

    def pictures(self, name: str) -> list[Picture]:
        if name in LISTS and name not in self._read:
            self._read[name] = self.pictures_in(name)
        return list(self._read.get(name, ()))

    def pictures_in(self, name: str) -> list[Picture]:
        """Read the pictures of one of the lists."""
        return place_pictures(self.folder_of(name))

    def folder_of(self, name: str) -> Path:
        """Return the folder of one of the lists; it may be named by a text file in its place."""
        return linked_folder(self.root / name)

    def lists(self) -> dict[str, list[Picture]]:
        return {name: pictures for name in LISTS if (pictures := self.pictures(name))}

    def has(self, role: str, view: str) -> bool:
        name = f"test/{role}_{view}"
        return name in LISTS and self.folder_of(name).is_dir()

    def lacking(self, role: str, view: str) -> str:
        name, like = f"test/{role}_{view}", "University-1652" if self.kind == "world" else self.kind
        lack = "no pictures in it" if self.folder_of(name).is_dir() else "no such folder"
        return f"has {lack} at {name}; expected {name}/<number>/*.jpg, as in {like}"

    def why_no_task(self) -> str:
        test = self.root / "test"
        folders = sorted(path.name for path in test.iterdir() if path.is_dir()) if test.is_dir() else []
        lacks = f"only test/{' and test/'.join(map(printable, folders[:5]))}" if folders else "no pictures to test with"
        return (
            f"has {lacks}; expected queries of one view and a gallery of another, such as test/query_drone/<number>/* and "
            "test/gallery_satellite/<number>/*"
        )


def place_pictures(folder: Path) -> list[Picture]:
    """Return the pictures of <folder>/<place>/*, in order of place and file name; none if there is no such folder.

    Raises:
        DataError: if a folder of a place is not a number.
    """
    pictures: list[Picture] = []
    for name in _names(folder, folders=True) if folder.is_dir() else []:
        place = folder / name
        if not name.isdecimal():
            raise DataError(
                f"The folder {name} in {folder.parent.name}/{folder.name} is not a number; expected one folder per "
                "place, named by its number, so rename or remove it."
            )
        label, files = int(name), [file for file in _names(place, folders=False) if file.lower().endswith(SUFFIXES)]
        for file in files:
            title = name if len(files) == 1 else f"{name}/{file.rpartition('.')[0].removeprefix('image-')}"
            pictures.append(Picture(place / file, label, printable(title)))
    return pictures


def _names(folder: Path, folders: bool) -> list[str]:
    """Return the sorted names of the folders in a folder, or of all else: a broken link is later reported as unreadable."""
    with os.scandir(folder) as entries:
        return sorted(entry.name for entry in entries if not hidden_name(entry.name) and _is_folder(entry) == folders)


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # circular links
        return False
