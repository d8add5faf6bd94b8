"""UniV, the data set of Video2BEV (Ju et al. 2025): drone videos of University-1652's places at 30 and 45 degrees.

    <30|45>/<2fps|5fps|10fps>/train/drone/<place>/*         frames of one video, also 45/2 for 45/2fps
    <30|45>/<2fps|5fps|10fps>/test/gallery_drone/<place>/*
    45/2fps/train/{satellite,street,google}/<place>/*       for all angles and rates
    45/2fps/test/gallery_{satellite,street}/<place>/*
    .../test/query_{drone,satellite,street}/<place>/*       made by its organize_univ.py

A list that is missing for an angle and a rate is taken from 45/2fps. Without query_drone, the queries are the gallery's videos
of the places in query_satellite. Bird's-eye views (bev) are not read.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from lpn.core.files import linked_folder
from lpn.datasets.base import PictureRow, sizes
from lpn.datasets.layouts.university import University

_ANGLES = ("45", "30")
_RATE = re.compile(r"(2|5|10)(fps)?")


class UniV(University):
    """A folder of UniV with the videos of one angle and one rate; labels are those of University-1652.

    Args:
        root: the folder of the data set, or of some of its videos, such as ROOT/45/2fps.
        split: such as "45/2fps"; by default the lowest rate of 45 degrees, if it exists.
    """

    kind = "UniV"
    expected = "test/query_drone or 45/2fps/test/query_satellite, which its organize_univ.py makes from the galleries"
    priority = 0
    published_sizes = sizes(
        train={"satellite": (701, 701), "drone": (None, 701), "street": (11_663, 701)},
        query={"drone": (None, 701), "satellite": (701, 701), "street": (2_579, 701)},
        gallery={"drone": (None, 951), "satellite": (951, 951), "street": (2_921, 793)},
    )

    def __init__(self, root: Path, split: str | None = None) -> None:
        whole = root.resolve()
        if _is_rate(whole):
            root, split = whole.parents[1], f"{whole.parent.name}/{whole.name}"
        super().__init__(root, split)

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """Return whether the folder has folders of an angle and a rate, or is one of them."""
        return bool(_videos(root)) or (root.resolve().parent.name in _ANGLES and _is_rate(root.resolve()))

    def splits_there(self) -> list[str]:
        return _videos(self.root)

    def rows(self) -> Iterator[PictureRow]:
        self._shared = next((one for one in _videos(self.root) if one.startswith("45/2")), self.split)
        self.folders = (f"{self.split}/train", f"{self.split}/test")
        rows = list(super().rows())
        if not any(row.of == "test/query_drone" for row in rows):
            queried = {row.label for row in rows if row.of == "test/query_satellite"}
            videos = (row for row in rows if row.of == "test/gallery_drone" and row.label in queried)
            yield from (replace(row, of="test/query_drone") for row in videos)
        yield from rows

    def folder_of(self, name: str) -> Path:
        own = linked_folder(self.root / str(self.split) / name)
        return own if own.is_dir() or "drone" in name else linked_folder(self.root / str(self._shared) / name)


def _videos(root: Path) -> list[str]:
    """Return the folders of videos below a folder of UniV, 45 degrees and low rates first."""
    return [
        f"{angle}/{rate.name}"
        for angle in _ANGLES
        if (root / angle).is_dir()
        for rate in sorted((root / angle).iterdir(), key=lambda rate: (len(rate.name), rate.name))
        if _is_rate(rate)
    ]


def _is_rate(folder: Path) -> bool:
    splits = ("train/drone", "test/gallery_drone")
    return _RATE.fullmatch(folder.name) is not None and any((folder / split).is_dir() for split in splits)
