"""CVUSA (Workman et al. 2015, split of Zhai et al. 2017): pairs of a panorama and the tile centred on its camera.

    splits/train-19zl.csv, splits/val-19zl.csv    bingmap/19/0000001.jpg,streetview/panos/0000001.jpg,<annotation>

The third column is optional. The label of a pair is the number in both file names.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.datasets.base import LeftOut, ListedDataset, Picture, Size, read_rows, warn_left_out
from lpn.datasets.listed_paths import FilesBelow, listed_path

CvusaSplit = Literal["train", "val"]

FULL = {
    "train/satellite": Size(35_532, 35_532),
    "train/street": Size(35_532, 35_532),
    "test/satellite": Size(8_884, 8_884),
    "test/street": Size(8_884, 8_884),
}
_NUMBER = re.compile(r"\d{1,15}$")


def split_file(root: Path, split: CvusaSplit) -> Path:
    """Return the file that lists the pairs of a split."""
    return root / "splits" / f"{split}-19zl.csv"


class CVUSA(ListedDataset):
    """A folder in CVUSA's layout. Incomplete pairs are left out and logged once.

    Raises:
        DataError: if a line of the splits is not a pair of paths below the folder, or no pair is complete.
    """

    kind = "CVUSA"
    panoramas = True

    def __init__(self, root: Path) -> None:
        listed: dict[CvusaSplit, list[tuple[str, str]]] = {"train": _read(root, "train"), "val": _read(root, "val")}
        labels = _labels(listed["train"] + listed["val"])
        left_out: list[LeftOut] = []
        files = FilesBelow(root).resolve(file for pairs in listed.values() for pair in pairs for file in pair)
        pictures: dict[CvusaSplit, dict[str, list[Picture]]] = {}
        for split, pairs in listed.items():
            of_split: dict[str, list[Picture]] = {"satellite": [], "street": []}
            for pair in pairs:
                missing = [file for file in pair if file not in files]
                left_out += [LeftOut(file, "is not there") for file in missing]
                if not missing:
                    for view, file in zip(of_split, pair, strict=True):
                        name = printable(Path(file).stem)
                        of_split[view].append(
                            Picture(root / files[file], labels[pair], name, panorama=view == "street")
                        )
            pictures[split] = of_split
        if not any(pictures[split]["street"] for split in pictures):
            raise DataError(
                f"{root.name} lists {len(listed['train']) + len(listed['val'])} pairs in splits, but has none of them whole; "
                "expected their files in bingmap/19 and streetview/panos."
            )
        super().__init__(
            root, pictures["train"], pictures["val"], pictures["val"], "a split of CVUSA, splits/val-19zl.csv"
        )
        self.left_out = left_out
        self.published_sizes = FULL
        warn_left_out(self.root.name, self.left_out, "files named in splits cannot be used", "their pairs are left out")


def _read(root: Path, split: CvusaSplit) -> list[tuple[str, str]]:
    file = split_file(root, split)
    if not file.is_file():
        return []
    name = f"splits/{file.name}"
    pairs: list[tuple[str, str]] = []
    for line, values in read_rows(file, name):
        if len(values) not in (2, 3):
            raise DataError(
                f"Line {line} of {name} has {len(values)} values; expected a tile, a panorama, and perhaps an annotation."
            )
        where = f"Line {line} of {name}"
        pairs.append((listed_path(values[0], where), listed_path(values[1], where)))
    if len(set(pairs)) < len(pairs):
        raise DataError(f"{name} lists a pair twice; keep one line of each.")
    return pairs


def _labels(pairs: list[tuple[str, str]]) -> dict[tuple[str, str], int]:
    """Return each pair's number in its file names, or its position if these numbers are not unique."""
    numbers = [[_NUMBER.search(Path(file).stem) for file in pair] for pair in pairs]
    named = [int(a[0]) for a, b in numbers if a and b and int(a[0]) == int(b[0])]
    ordered = named if len(set(named)) == len(pairs) else range(len(pairs))
    return dict(zip(pairs, ordered, strict=True))
