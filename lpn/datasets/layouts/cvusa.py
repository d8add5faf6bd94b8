"""CVUSA (Workman et al. 2015, split of Zhai et al. 2017): pairs of a panorama and the tile centred on its camera.

    splits/train-19zl.csv, splits/val-19zl.csv    bingmap/19/0000001.jpg,streetview/panos/0000001.jpg,<annotation>

The third column is optional. The label of a pair is the number in both file names.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.lists import read_rows
from lpn.datasets.base import Dataset, PictureRow, sizes
from lpn.datasets.listed_paths import listed_path

_SPLITS = {"train": "splits/train-19zl.csv", "test": "splits/val-19zl.csv"}
_NUMBER = re.compile(r"\d{1,15}$")


class CVUSA(Dataset):
    """A folder in CVUSA's layout. Incomplete pairs are left out."""

    kind = "CVUSA"
    marks = tuple((name,) for name in _SPLITS.values())
    expected = "the files of splits/val-19zl.csv in bingmap/19 and streetview/panos"
    panoramas = True
    published_sizes = sizes(
        train={"satellite": (35_532, 35_532), "street": (35_532, 35_532)},
        test={"satellite": (8_884, 8_884), "street": (8_884, 8_884)},
    )

    def rows(self) -> Iterator[PictureRow]:
        listed = {split: _read(self.root / name, name) for split, name in _SPLITS.items()}
        labels = _labels([pair for pairs in listed.values() for pair in pairs])
        for split, of_split in listed.items():
            for pair in of_split:
                tile, panorama = (
                    PictureRow(f"{split}/{view}", file, labels[pair], Path(file).stem)
                    for view, file in zip(("satellite", "street"), pair, strict=True)
                )
                yield from self.together(tile, panorama)


def _read(file: Path, name: str) -> list[tuple[str, str]]:
    """Return the pairs of a split; none if its list is missing."""
    pairs: list[tuple[str, str]] = []
    for line, values in read_rows(file, name) if file.is_file() else ():
        where = f"Line {line} of {name}"
        if len(values) not in (2, 3):
            raise DataError(
                f"{where} has the wrong number of values, {len(values)}; expected a tile, a panorama, and perhaps an annotation."
            )
        pairs.append((listed_path(values[0], where), listed_path(values[1], where)))
    return pairs


def _labels(pairs: list[tuple[str, str]]) -> dict[tuple[str, str], int]:
    """Return each pair's number in its file names, or its position if these numbers are not unique."""
    numbers = [[_NUMBER.search(Path(file).stem) for file in pair] for pair in pairs]
    named = [int(a[0]) for a, b in numbers if a and b and int(a[0]) == int(b[0])]
    ordered = named if len(set(named)) == len(pairs) else range(len(pairs))
    return dict(zip(pairs, ordered, strict=True))
