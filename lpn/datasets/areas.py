"""Data sets with two test splits: places of the areas to train on (same area), or of other ones (cross area).

`--data ROOT/same-area` and `--data ROOT/cross-area` name the split of the data set in ROOT.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from lpn.core.errors import DataError
from lpn.core.files import printable

log = logging.getLogger(__name__)

Area = Literal["same", "cross"]
AREAS: tuple[Area, ...] = ("same", "cross")


def split_area(root: Path) -> tuple[Path, Area | None]:
    """Return a data set's folder and the area that its path names, None for a path of a folder."""
    area = next((area for area in AREAS if root.name == f"{area}-area"), None)
    return (root, None) if area is None or root.exists() else (root.parent, area)


def choose_area(root: Path, there: Sequence[Area], wanted: Area | None, missing: str) -> Area:
    """Return the wanted area, or by default the first that is there.

    Args:
        missing: the file that an area needs, for the error.

    Raises:
        DataError: if it is not there.
    """
    if not there or (wanted is not None and wanted not in there):
        has = " and ".join(f"{area}-area" for area in there) or "none"
        raise DataError(
            f"{printable(root.name)} has the lists of {has}; expected {f'{wanted}-area' if wanted else missing}, so unpack it "
            "there."
        )
    if wanted is None and len(there) > 1:
        log.warning(
            "%s has two splits; this is %s-area, and %s/%s-area the other.",
            printable(root.name),
            *(there[0], root, there[1]),
        )
    return wanted or there[0]
