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
from lpn.datasets.base import LeftOut, Picture, Size, tasks_between, unread_below
from lpn.datasets.university import University, place_pictures

log = logging.getLogger(__name__)

_ANGLES = ("45", "30")
_RATE = re.compile(r"(2|5|10)(fps)?")
_VIEWS = ("drone", "satellite", "street")
_FULL = {
    "train/satellite": Size(701, 701),
    "train/drone": Size(None, 701),
    "train/street": Size(11_663, 701),
    "test/query_drone": Size(None, 701),
    "test/query_satellite": Size(701, 701),
    "test/query_street": Size(2_579, 701),
    "test/gallery_drone": Size(None, 951),
    "test/gallery_satellite": Size(951, 951),
    "test/gallery_street": Size(2_921, 793),
}


class UniV(University):
    """A folder of UniV with the videos of one angle and one rate; labels are those of University-1652.

    Args:
        videos: such as "45/2fps"; by default the first of 45 degrees, and of those the lowest rate.

    Raises:
        DataError: if these videos are not there.
    """

    kind = "UniV"

    def __init__(self, root: Path, videos: str | None = None) -> None:
        there = _videos(root)
        if videos is None and len(there) > 1:
            others = first_few([str(root / one) for one in there[1:]], 5)
            log.warning(
                "%s has %d lists of videos; this is %s, and others are %s.",
                printable(root.name),
                len(there),
                there[0],
                others,
            )
        if not there or (videos is not None and videos not in there):
            raise DataError(
                f"{printable(root.name)} has no videos in {videos}; expected one of {', '.join(there) or '45/2fps'}."
            )
        super().__init__(root)
        self.videos = videos or there[0]
        self._shared = next((one for one in there if one.startswith("45/2")), self.videos)
        self.published_sizes = _FULL

    def tasks(self) -> list[str]:
        there = {role: [view for view in _VIEWS if self._has(f"test/{role}_{view}")] for role in ("query", "gallery")}
        return tasks_between(there["query"], there["gallery"])

    def why_no_task(self) -> str:
        return (
            f"has no {self.videos}/test/query_drone and no {self._shared}/test/query_satellite; its organize_univ.py makes them "
            "from the galleries, so run it first"
        )

    def pictures_in(self, folder: str) -> list[Picture]:
        if folder == "test/query_drone" and not self._folder(folder).is_dir():
            queried = {picture.label for picture in self.pictures_in("test/query_satellite")}
            return [picture for picture in self.pictures_in("test/gallery_drone") if picture.label in queried]
        return place_pictures(self._folder(folder))

    def unread(self) -> list[LeftOut]:
        return unread_below(self.root, (f"{self.videos}/train", f"{self.videos}/test"))

    def _folder(self, folder: str) -> Path:
        own = linked_folder(self.root / self.videos / folder)
        return own if own.is_dir() or "drone" in folder else linked_folder(self.root / self._shared / folder)

    def _has(self, folder: str) -> bool:
        if folder == "test/query_drone" and self._has("test/query_satellite"):
            return self._folder("test/gallery_drone").is_dir()
        return self._folder(folder).is_dir()


def is_univ(root: Path) -> bool:
    """Return whether a folder is UniV's: by its folders of an angle and a rate."""
    return bool(_videos(root))


def is_univ_videos(root: Path) -> bool:
    """Return whether a folder holds the videos of one angle and one rate of UniV."""
    path = root.resolve()
    return path.parent.name in _ANGLES and _is_rate(path)


def open_univ_videos(root: Path) -> UniV:
    """Open the videos of one angle and one rate."""
    path = root.resolve()
    return UniV(path.parent.parent, f"{path.parent.name}/{path.name}")


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
