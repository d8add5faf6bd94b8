"""Recognition of rendered worlds, whether their rendering has ended, and exact poses beside photos."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable

PLAN = "world.json"
FLIGHT_PLAN, TRUTH = "flight_world.json", "truth.csv"
# Present in a world's folder until its last picture is rendered.
UNFINISHED = "unfinished.txt"


def is_rendered(root: Path) -> bool:
    """Return whether a folder is a rendered city; raises DataError while its pictures are incomplete."""
    if not (root / PLAN).is_file():
        return False
    if (root / UNFINISHED).is_file():
        raise DataError(
            f"{printable(str(root))} is not rendered to its end; give the command that renders it again, which goes on "
            "where it was stopped."
        )
    return True


def shows_rendered(root: Path) -> bool:
    """Return whether a folder of pictures or photos is rendered; see both functions."""
    return is_rendered(root) or is_rendered_flight(root)


def is_rendered_flight(photos: Path) -> bool:
    """Return whether a folder of photos is of a rendered flight; its plan lies beside the folder."""
    return (photos.parent / FLIGHT_PLAN).is_file()


@dataclass(frozen=True)
class TruePose:
    """The exact pose of a photo's camera: WGS 84 degrees, metres above the elevation's datum, and angles in degrees."""

    latitude: float
    longitude: float
    altitude: float
    heading: float
    pitch: float
    roll: float


def true_poses(photos: Path) -> dict[str, TruePose]:
    """Return the exact poses of the photos in a folder of a rendered flight, by their names.

    There are none for another folder.

    Raises:
        DataError: if the file of the poses is damaged.
    """
    file = photos.parent / TRUTH
    if not is_rendered_flight(photos) or not file.is_file():
        return {}
    names = ("latitude", "longitude", "z", "true_heading", "true_pitch", "true_roll")
    try:
        with file.open(newline="", encoding="utf-8") as text:
            return {row["file"]: TruePose(*(float(row[name]) for name in names)) for row in csv.DictReader(text)}
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise DataError(
            f"{printable(str(file))} has no exact poses; expected the file that the rendering wrote, so bring it back."
        ) from error
