"""Recognition of rendered worlds, whether their rendering has ended, and exact poses beside photos."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable

PLAN = "world.json"
FLIGHT_PLAN, TRUTH = "flight_world.json", "truth.csv"
# The exact poses of a flight of AnyVisLoc or OrthoLoC, beside the folder of its pictures.
POSES = "poses.csv"
POSE_COLUMNS = ("file", "latitude", "longitude", "altitude", "heading", "pitch", "roll")
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
    """The exact pose of a photo's camera: WGS 84 degrees, metres above the elevation's datum, and angles in degrees.

    Altitude and roll are NaN where a data set does not tell them.
    """

    latitude: float
    longitude: float
    altitude: float
    heading: float
    pitch: float
    roll: float


def true_poses(photos: Path) -> dict[str, TruePose]:
    """Return the exact poses of the photos in a folder of a rendered flight, or of one of AnyVisLoc or OrthoLoC, by their names.

    There are none for another folder.

    Raises:
        DataError: if the file of the poses is damaged.
    """
    rendered = is_rendered_flight(photos)
    file = photos.parent / (TRUTH if rendered else POSES)
    if not file.is_file():
        return {}
    names = ("latitude", "longitude", "z", "true_heading", "true_pitch", "true_roll") if rendered else POSE_COLUMNS[1:]
    try:
        with file.open(newline="", encoding="utf-8") as text:
            rows = csv.DictReader(text)
            if not rendered and tuple(rows.fieldnames or ()) != POSE_COLUMNS:
                return {}  # somebody's own file of this name
            return {row["file"]: TruePose(*(float(row[name]) for name in names)) for row in rows}
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        command = "the rendering" if rendered else "lpn flight"
        raise DataError(
            f"{printable(str(file))} has no exact poses; expected the file that {command} wrote, so delete it or bring it back."
        ) from error
