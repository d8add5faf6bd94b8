"""Data set folders in University-1652's layout: which pictures they hold, and of which place.

    train/{satellite,drone,street,google}/<id>/*.jpg|jpeg|png|webp
    test/{query,gallery}_{satellite,drone,street}/<id>/*.jpg|jpeg|png|webp

The label of a picture is its folder's integer name.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lpn.errors import DataError
from lpn.files import printable
from lpn.images import SUFFIXES


@dataclass(frozen=True)
class Picture:
    """A picture file.

    Attributes:
        path: the file.
        label: the place it shows, from its folder's integer name.
        name: how it is shown to people: the folder's name, and where a place has several, the file's ("0005/01" for
            0005/image-01.jpeg).
        box: the part of it that is meant, (left, top, right, bottom) in pixels, where a data set marks one (the queries
            of Oxford5k and Paris6k); else None.
    """

    path: Path
    label: int
    name: str
    box: tuple[float, float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class Truth:
    """What counts for one query where that is not decided by labels, as in Oxford5k and Paris6k.

    Attributes:
        good: gallery positions of its true matches, (P,).
        junk: gallery positions that are taken out of its ranking, (J,).
    """

    good: npt.NDArray[np.int64]
    junk: npt.NDArray[np.int64]


class Dataset:
    """A folder in University-1652's layout. Pictures are listed when asked for, in order of place and file name.

    Attributes:
        panoramas: whether street pictures show the full circle, north in the middle column.
    """

    panoramas = False

    panoramas: bool = False
    """Whether its street pictures go all the way around."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def train(self, folder: str) -> list[Picture]:
        """Pictures of train/<folder> (satellite, drone, street, or google), empty where the folder is absent."""
        return _pictures(self.root / "train" / folder)

    def queries(self, view: str) -> list[Picture]:
        """Pictures of test/query_<view>.

        Raises:
            DataError: when there are none.
        """
        return self._test("query", view)

    def gallery(self, view: str) -> list[Picture]:
        """Pictures of test/gallery_<view>.

        Raises:
            DataError: when there are none.
        """
        return self._test("gallery", view)

    def tasks(self) -> list[str]:
        """The retrieval tasks the test split offers, such as "drone-to-satellite", the usual ones first."""
        pairs = sorted(permutations(("drone", "satellite", "street"), 2), key=lambda pair: "satellite" not in pair)
        return [
            f"{query}-to-{gallery}"
            for query, gallery in pairs
            if (self.root / "test" / f"query_{query}").is_dir() and (self.root / "test" / f"gallery_{gallery}").is_dir()
        ]

    def truth(self, task: str) -> list[Truth] | None:  # noqa: ARG002
        """What counts for each query of a task, in their order; None where it is equality of labels."""
        return None

    def _test(self, role: str, view: str) -> list[Picture]:
        folder = self.root / "test" / f"{role}_{view}"
        pictures = _pictures(folder)
        if not pictures:
            found = "no pictures in it" if folder.is_dir() else "no such folder"
            raise DataError(
                f"{self.root.name} has {found} at test/{role}_{view}; expected test/{role}_{view}/<number>/*.jpg, "
                "as in University-1652."
            )
        return pictures


def open_dataset(root: str | Path) -> Dataset:
    """Open a data set folder.

    Raises:
        DataError: when there is no such folder, or it has neither a train nor a test folder.
    """
    root = Path(root)
    if not root.is_dir():
        raise DataError(f"There is no data set folder at {root}; check the path.")
    if not (root / "train").is_dir() and not (root / "test").is_dir():
        inside = ", ".join(sorted(p.name for p in root.iterdir())[:5]) or "nothing"
        raise DataError(f"{root} holds {inside}; expected the folders train and test, as in University-1652.")
    return Dataset(root)


def hidden(path: Path) -> bool:
    """Whether a file or folder is one that systems and editors keep for themselves (.ipynb_checkpoints, ._a.jpg)."""
    return path.name.startswith(".")


def _pictures(folder: Path) -> list[Picture]:
    pictures: list[Picture] = []
    places = sorted(p for p in folder.iterdir() if p.is_dir() and not hidden(p)) if folder.is_dir() else []
    for place in places:
        if not place.name.isdecimal():
            raise DataError(
                f"The folder {place.name} in {folder.parent.name}/{folder.name} is not a number; expected one folder per "
                "place, named by its number, so rename or remove it."
            )
        files = sorted(
            file for file in place.iterdir() if file.suffix.lower() in SUFFIXES and not hidden(file) and file.is_file()
        )
        for file in files:
            name = place.name if len(files) == 1 else f"{place.name}/{file.stem.removeprefix('image-')}"
            pictures.append(Picture(file, int(place.name), printable(name)))
    return pictures
