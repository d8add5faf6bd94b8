"""Data sets with several splits, of which a path names one: `--data ROOT/cross-area`, `--data ROOT/city`.

GTA-UAV, UAV-VisLoc, and VIGOR test on places of the areas to train on (same area), or of other ones (cross area). World-UAV
tests on terrain, on cities, or on both.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, TypeVar

from lpn.core.errors import DataError
from lpn.core.files import first_few, printable

log = logging.getLogger(__name__)

Area = Literal["same", "cross"]
Scenes = Literal["terrain", "city", "mix"]
AREAS: tuple[Area, ...] = ("same", "cross")
SCENES: tuple[Scenes, ...] = ("terrain", "city", "mix")
_Split = TypeVar("_Split", Area, Scenes)


def split_name(split: str) -> str:
    """Return the last part of the path that names a split."""
    return f"{split}-area" if split in AREAS else split


def named_split(root: Path) -> tuple[Path, str | None]:
    """Return a data set's folder and the split that its path names, None for a path of a folder."""
    split = next((split for split in (*AREAS, *SCENES) if root.name == split_name(split)), None)
    return (root, None) if split is None or root.exists() else (root.parent, split)


def choose_split(root: Path, there: Sequence[_Split], wanted: _Split | None, missing: str) -> _Split:
    """Return the wanted split, or by default the first that is there.

    Args:
        missing: the file that a split needs, for the error.

    Raises:
        DataError: if it is not there.
    """
    if not there or (wanted is not None and wanted not in there):
        has = " and ".join(map(split_name, there)) or "none"
        raise DataError(
            f"{printable(root.name)} has the lists of {has}; expected {split_name(wanted) if wanted else missing}, so unpack it "
            "there."
        )
    if wanted is None and len(there) > 1:
        log.warning(
            "%s has %s splits; this is %s, and %s the other%s.",
            printable(root.name),
            {2: "two", 3: "three"}[len(there)],
            split_name(there[0]),
            first_few([str(root / split_name(split)) for split in there[1:]], 2),
            "s" if len(there) > 2 else "",
        )
    return wanted or there[0]
