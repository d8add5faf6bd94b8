"""UniV, the data set of Video2BEV (Ju et al. 2025): drone videos of University-1652's places at 30 and 45 degrees.

    <30|45>/<2fps|5fps|10fps>/train/drone/<place>/*         frames of one video, also 45/2 for 45/2fps
    <30|45>/<2fps|5fps|10fps>/test/gallery_drone/<place>/*
    45/2fps/train/{satellite,street,google}/<place>/*       for all angles and rates
    45/2fps/test/gallery_{satellite,street}/<place>/*
    .../test/query_{drone,satellite,street}/<place>/*       made by its organize_univ.py

A list that an angle and a rate do not have is that of 45/2fps. Where query_drone is not there, queries are the videos of the
places of query_satellite. Bird's-eye views (bev) are not read.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import first_few, linked_folder, printable
from lpn.datasets.base import Picture, sizes
from lpn.datasets.layouts.university import University

log = logging.getLogger(__name__)

_ANGLES = ("45", "30")
_RATE = re.compile(r"(2|5|10)(fps)?")


class UniV(University):
    """A folder of UniV with the videos of one angle and one rate; labels are those of University-1652.

    Args:
        root: the folder of the data set, or that of some videos, such as ROOT/45/2fps.
        split: such as "45/2fps"; by default the first of 45 degrees, and of those the lowest rate.
    """

    kind = "UniV"
    known_by = "45/2fps (UniV)"
    priority = 0
    published_sizes = sizes(
        train={"satellite": (701, 701), "drone": (None, 701), "street": (11_663, 701)},
        query={"drone": (None, 701), "satellite": (701, 701), "street": (2_579, 701)},
        gallery={"drone": (None, 951), "satellite": (951, 951), "street": (2_921, 793)},
    )

    def __init__(self, root: Path, split: str | None = None) -> None:
        if _is_rate(root.resolve()):
            path = root.resolve()
            root, split = path.parents[1], f"{path.parent.name}/{path.name}"
        super().__init__(root, split)
        self.videos = str(self.split)
        self._shared = next((one for one in _videos(root) if one.startswith("45/2")), self.videos)
        self.folders = (f"{self.videos}/train", f"{self.videos}/test")

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """Return whether there are folders of an angle and a rate, or the folder is one."""
        return bool(_videos(root)) or (root.resolve().parent.name in _ANGLES and _is_rate(root.resolve()))

    def why_no_task(self) -> str:
        return (
            f"has no {self.videos}/test/query_drone and no {self._shared}/test/query_satellite; its organize_univ.py makes them "
            "from the galleries, so run it first"
        )

    def pictures_in(self, name: str) -> list[Picture]:
        if name == "test/query_drone" and not self.folder_of(name).is_dir():
            queried = {picture.label for picture in self.pictures("test/query_satellite")}
            return [picture for picture in self.pictures("test/gallery_drone") if picture.label in queried]
        return super().pictures_in(name)

    def folder_of(self, name: str) -> Path:
        own = linked_folder(self.root / self.videos / name)
        return own if own.is_dir() or "drone" in name else linked_folder(self.root / self._shared / name)

    def has(self, role: str, view: str) -> bool:
        if (role, view) == ("query", "drone") and self.has("query", "satellite"):
            return self.has("gallery", "drone")
        return super().has(role, view)

    def _chosen(self, wanted: str | None) -> str:
        there = _videos(self.root)
        if not there or (wanted is not None and wanted not in there):
            raise DataError(
                f"{printable(self.root.name)} has no videos in {wanted}; expected one of {', '.join(there) or '45/2fps'}."
            )
        if wanted is None and len(there) > 1:
            others = first_few([str(self.root / one) for one in there[1:]], 5)
            text = "%s has %d lists of videos; this is %s, and others are %s."
            log.warning(text, printable(self.root.name), len(there), there[0], others)
        return wanted or there[0]


def _videos(root: Path) -> list[str]:
    """Return the folders of videos below UniV's, 45 degrees and low rates first."""
    return [
        f"{angle}/{rate.name}"
        for angle in _ANGLES
        if (root / angle).is_dir()
        for rate in sorted((root / angle).iterdir(), key=lambda rate: (len(rate.name), rate.name))
        if _is_rate(rate)
    ]


def _is_rate(folder: Path) -> bool:
    return _RATE.fullmatch(folder.name) is not None and any(
        (folder / split).is_dir() for split in ("train/drone", "test/gallery_drone")
    )
