"""The folder layout of University-1652 and of rendered worlds.

    train/{satellite,drone,street,google}/<id>/*     JPEG, PNG, WebP, BMP, GIF, TIFF
    test/{query,gallery}_{satellite,drone,street}/<id>/*

In the test split a text file may stand in place of a folder; it names another folder, whose pictures have this role, too.
The label of a picture is its folder's integer name.
"""

from __future__ import annotations

import os
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import linked_folder, printable
from lpn.core.images import SUFFIXES
from lpn.datasets.base import Dataset, LeftOut, Picture, Size, hidden_name, tasks_between, unread_below
from lpn.datasets.rendered import is_rendered

# The size of train/street is disputed: the publications' sum (50,218 training pictures) and the released folder differ.
FULL = {
    "train/satellite": Size(701, 701),
    "train/drone": Size(37_854, 701),
    "train/street": Size(None, 701),
    "train/google": Size(21_099),
    "test/query_drone": Size(37_855, 701),
    "test/query_satellite": Size(701, 701),
    "test/query_street": Size(2_579, 701),
    "test/gallery_drone": Size(51_355, 951),
    "test/gallery_satellite": Size(951, 951),
    "test/gallery_street": Size(2_921, 793),
}
_TRAIN = ("satellite", "drone", "street", "google")
_VIEWS = ("drone", "satellite", "street")


class University(Dataset):
    """A folder in University-1652's layout; `kind` is "world" if it was rendered.

    Pictures are listed on request, in order of place and file name.
    """

    kind = "University-1652"

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        if is_rendered(root):
            self.kind = "world"
        else:
            self.published_sizes = FULL

    def train(self, folder: str) -> list[Picture]:
        return self.pictures_in(f"train/{folder}")

    def queries(self, view: str) -> list[Picture]:
        return self._test("query", view)

    def gallery(self, view: str) -> list[Picture]:
        return self._test("gallery", view)

    def tasks(self) -> list[str]:
        there = {
            role: [view for view in _VIEWS if linked_folder(self.root / "test" / f"{role}_{view}").is_dir()]
            for role in ("query", "gallery")
        }
        return tasks_between(there["query"], there["gallery"])

    def why_no_task(self) -> str:
        test = self.root / "test"
        folders = sorted(path.name for path in test.iterdir() if path.is_dir()) if test.is_dir() else []
        lacks = f"only test/{' and test/'.join(map(printable, folders[:5]))}" if folders else "no pictures to test with"
        return (
            f"has {lacks}; expected queries of one view and a gallery of another, such as test/query_drone/<number>/* and "
            "test/gallery_satellite/<number>/*"
        )

    def lists(self) -> dict[str, list[Picture]]:
        names = [f"train/{name}" for name in _TRAIN]
        names += [f"test/{role}_{view}" for role in ("query", "gallery") for view in _VIEWS]
        lists = {name: self.pictures_in(name) for name in names}
        return {name: pictures for name, pictures in lists.items() if pictures}

    def pictures_in(self, folder: str) -> list[Picture]:
        """Return the pictures of a folder below the root, such as "test/query_drone"."""
        return place_pictures(linked_folder(self.root / folder))

    def unread(self) -> list[LeftOut]:
        return unread_below(self.root, ("train", "test"))

    def _test(self, role: str, view: str) -> list[Picture]:
        folder = self.root / "test" / f"{role}_{view}"
        pictures = self.pictures_in(f"test/{role}_{view}")
        if not pictures:
            lack = "no pictures in it" if folder.is_dir() else "no such folder"
            raise DataError(
                f"{self.root.name} has {lack} at test/{role}_{view}; expected test/{role}_{view}/<number>/*.jpg, "
                f"as in {'University-1652' if self.kind == 'world' else self.kind}."
            )
        return pictures


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
    """Return the sorted names of the folders or of the files in a folder."""
    with os.scandir(folder) as entries:
        return sorted(
            e.name for e in entries if not hidden_name(e.name) and (_is_folder(e) if folders else _is_picture(e))
        )


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # circular links
        return False


def _is_picture(entry: os.DirEntry[str]) -> bool:
    """Return whether an entry is a file or a broken link, which is later reported as unreadable."""
    try:
        return entry.is_file() or (entry.is_symlink() and not Path(entry.path).exists())
    except OSError:
        return True
