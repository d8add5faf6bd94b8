"""Data sets in their published layouts, read as lists of pictures with places, tasks, and true matches.

It imports `core` only. `open_dataset` recognises University-1652 (and rendered worlds), UniV, GeoText-1652,
SUES-200, DenseUAV, GTA-UAV, UAV-VisLoc in GTA-UAV's form, World-UAV, VIGOR, CVUSA, CVACT, Oxford5k, Paris6k, your own pairs with
a `pairs.csv`, and a plain folder of pictures; docs/data.md shows each layout.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import cast

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.datasets import cvact, cvusa, landmarks, levels, pairs
from lpn.datasets.areas import SCENES, Area, named_split, split_name
from lpn.datasets.base import (
    Dataset,
    LeftOut,
    Picture,
    Size,
    Truth,
    files_below,
    hidden,
    labels_of,
    unread_below,
    warn_left_out,
)
from lpn.datasets.cvact import CVACT
from lpn.datasets.cvusa import CVUSA
from lpn.datasets.denseuav import DenseUAV, is_denseuav
from lpn.datasets.folder import Folder
from lpn.datasets.geotext import GeoText, is_geotext
from lpn.datasets.landmarks import Landmarks
from lpn.datasets.pairs import PairsCSV
from lpn.datasets.rendered import is_rendered
from lpn.datasets.sues import SUES200, is_sues
from lpn.datasets.tile_pairs import TilePairs, is_tile_pairs
from lpn.datasets.univ import UniV, is_univ, is_univ_videos, open_univ_videos
from lpn.datasets.university import University
from lpn.datasets.vigor import VIGOR, is_vigor
from lpn.datasets.world_uav import WorldUAV, is_world_uav

__all__ = [
    "CVACT",
    "CVUSA",
    "SUES200",
    "VIGOR",
    "Dataset",
    "DenseUAV",
    "Folder",
    "GeoText",
    "Landmarks",
    "LeftOut",
    "PairsCSV",
    "Picture",
    "Size",
    "TilePairs",
    "Truth",
    "UniV",
    "University",
    "WorldUAV",
    "files_below",
    "hidden",
    "labels_of",
    "open_dataset",
    "unread_below",
    "warn_left_out",
]

_LAYOUTS = (
    "train and test as in University-1652, splits/*-19zl.csv (CVUSA), ACT_data.mat (CVACT), Testing/150 or satellite-view "
    "(SUES-200), Dense_GPS_ALL.txt (DenseUAV), *-area-drone2sate-test.json (GTA-UAV, UAV-VisLoc), splits/Chicago (VIGOR), "
    "Index/test.txt (World-UAV), 45/2fps (UniV), test_951_version.json (GeoText-1652), "
    "*_query.txt (Oxford5k, Paris6k), pairs.csv, or pictures"
)


def open_dataset(root: str | Path) -> Dataset:
    """Recognise the layout of a data set's folder and open it.

    Args:
        root: the folder; of a data set with several test splits also one of them, such as ROOT/cross-area or ROOT/city.

    Raises:
        DataError: if the folder does not exist, its layout is unknown, or one of its lists is damaged.
    """
    given = Path(root)
    root, split = named_split(given)
    if not root.is_dir():
        raise levels.no_folder(root)
    is_rendered(root)  # raises for an unfinished world
    marked = _marked(root)
    if split in SCENES:
        if marked is not WorldUAV:
            raise levels.no_folder(given)
        marked = partial(WorldUAV, split=split)
    elif split is not None:
        if marked not in (TilePairs, VIGOR):
            raise DataError(
                f"{root} has no {split_name(split)} split, which GTA-UAV, UAV-VisLoc, and VIGOR have; give --data {root}."
            )
        marked = partial(marked, area=cast(Area, split))
    if marked is not None:
        return marked(root)
    whole, pictures = levels.above(root, _marked), levels.holds_pictures(root)
    if whole is not None and not pictures:
        raise levels.part_of(root, whole)
    if (error := levels.below(root, _marked) or levels.misplaced(root)) is not None:
        raise error
    if queries := landmarks.query_files(root):
        return Landmarks(root, queries)
    if files := files_below(root):
        return Folder(root, files, whole)
    if (error := levels.files_alone(root)) is not None:
        raise error
    inside = ", ".join(sorted(printable(child.name) for child in root.iterdir())[:5]) or "nothing"
    raise DataError(f"{root} holds {inside}; expected {_LAYOUTS}.")


def _marked(root: Path) -> Callable[..., Dataset] | None:
    """Recognise the layout by files or folders near the root."""
    if (root / pairs.NAME).is_file():
        return PairsCSV
    if cvusa.split_file(root, "train").is_file() or cvusa.split_file(root, "val").is_file():
        return CVUSA
    if (root / cvact.NAME).is_file():
        return CVACT
    for recognised, layout in (
        (is_tile_pairs, TilePairs),
        (is_vigor, VIGOR),
        (is_world_uav, WorldUAV),
        (is_univ, UniV),
        (is_univ_videos, open_univ_videos),
        (is_geotext, GeoText),
        (is_denseuav, DenseUAV),
        (is_sues, SUES200),
    ):
        if recognised(root):
            return layout
    if (root / "train").is_dir() or (root / "test").is_dir():
        return University
    return None
