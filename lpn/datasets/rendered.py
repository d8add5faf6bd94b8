"""Recognition of rendered worlds and flights, and of unfinished ones."""

from __future__ import annotations

from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable

PLAN = "world.json"
FLIGHT_PLAN, TRUTH = "flight_world.json", "truth.csv"
# This file is in a world's folder until its last picture is rendered.
UNFINISHED = "unfinished.txt"


def is_rendered(root: Path) -> bool:
    """Return whether a folder is a rendered city; DataError while its pictures are incomplete."""
    if not (root / PLAN).is_file():
        return False
    if (root / UNFINISHED).is_file():
        raise DataError(
            f"{printable(str(root))} is not rendered to its end; give the command that renders it again, which goes on "
            "where it was stopped."
        )
    return True


def shows_rendered(root: Path) -> bool:
    """Return whether a folder belongs to a rendered city or to a rendered flight."""
    return is_rendered(root) or is_rendered_flight(root)


def is_rendered_flight(photos: Path) -> bool:
    """Return whether a folder of photos belongs to a rendered flight, whose plan lies beside it."""
    return (photos.parent / FLIGHT_PLAN).is_file()
