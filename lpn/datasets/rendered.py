"""How a rendered world is told from other folders, and whether its rendering has ended."""

from __future__ import annotations

from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable

PLAN = "world.json"
UNFINISHED = "unfinished.txt"
"""In a world's folder until the last of its pictures is there."""


def is_rendered(root: Path) -> bool:
    """Whether a folder is one that `lpn world` made; DataError while pictures of it are missing."""
    if not (root / PLAN).is_file():
        return False
    if (root / UNFINISHED).is_file():
        raise DataError(
            f"{printable(str(root))} is not rendered to its end; run lpn world again with the same settings, which goes on "
            "where it was stopped."
        )
    return True
