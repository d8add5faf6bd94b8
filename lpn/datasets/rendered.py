"""Recognition of rendered worlds, and whether their rendering has ended."""

from __future__ import annotations

from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable

PLAN = "world.json"
FLIGHT_PLAN = "flight_world.json"
# Present in a world's folder until its last picture is rendered.
UNFINISHED = "unfinished.txt"


def is_rendered(root: Path) -> bool:
    """Return whether `lpn world` made a folder; raises DataError while its pictures are incomplete."""
    if not (root / PLAN).is_file():
        return False
    if (root / UNFINISHED).is_file():
        raise DataError(
            f"{printable(str(root))} is not rendered to its end; run lpn world again with the same settings, which goes on "
            "where it was stopped."
        )
    return True


def shows_rendered(root: Path) -> bool:
    """Return whether `lpn world` made a folder of pictures or photos; see both functions."""
    return is_rendered(root) or is_rendered_flight(root)


def is_rendered_flight(photos: Path) -> bool:
    """Return whether `lpn world --flight` made a folder of photos; its plan lies beside the folder."""
    return (photos.parent / FLIGHT_PLAN).is_file()
