"""Errors of poses against the exact poses of a rendered flight."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.numbers import upper_bound, wrap_degrees
from lpn.datasets.rendered import TRUTH, is_rendered_flight
from lpn.flight.locate.errors import Errors
from lpn.flight.locate.located import LocatedFlight

_COLUMNS = ("latitude", "longitude", "z", "true_heading", "true_pitch")


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of a flight's poses.

    Attributes:
        places: of the camera in the plane.
        others: absolute errors of height in metres, and of heading and pitch in degrees, (N, 3); NaN for a height over flat
            ground.
    """

    places: Errors
    others: Float64Array

    @property
    def sentence(self) -> str:
        """A line for the console."""
        places = self.places
        share = f"Poses against the exact ones: {places.photos} of {places.known} photos have one"
        if not places.photos:
            return f"{share}."
        height, heading, pitch = np.median(self.others, axis=0)
        return (
            f"{share}; median errors: place {places.median:.2f} m (90 % within {upper_bound(places.ce90, 2)} m, 95 % within "
            f"{upper_bound(places.ce95, 2)} m)"
            + ("" if np.isnan(height) else f", height {height:.2f} m")
            + f", heading {heading:.2f} degrees, pitch {pitch:.2f} degrees."
        )


def pose_errors(located: LocatedFlight) -> PoseErrors | None:
    """Return the errors of a flight's poses; None unless exact poses lie beside its photos.

    Raises:
        DataError: if the exact poses cannot be read.
    """
    truths: dict[str, list[float]] = {}
    for folder in sorted({one.frame.file.parent for one in located.frames}):
        truths |= _true_poses(folder)
    known = [one for one in located.frames if one.frame.file.name in truths]
    if not known:
        return None
    flat = located.basemap.elevation is None
    places, others = [], []
    for one in known:
        answer, truth = one.stages.get("registration"), truths[one.frame.file.name]
        if answer is None or not answer.accepted or (pose := answer.pose) is None:
            continue
        east, north = located.basemap.frame.xy([truth[0]], [truth[1]])[0].tolist()
        places.append((pose.east - east, pose.north - north, math.hypot(pose.radius, answer.map_error)))
        up = np.nan if flat else abs(pose.altitude - truth[2])
        others.append((up, abs(wrap_degrees(pose.heading - truth[3])), abs(pose.pitch - truth[4])))
    return PoseErrors(Errors.of(len(known), places), np.array(others, np.float64).reshape(-1, 3))


def _true_poses(photos: Path) -> dict[str, list[float]]:
    """Return `_COLUMNS` of a rendered flight's photos by their names; empty for another folder."""
    file = photos.parent / TRUTH
    if not is_rendered_flight(photos) or not file.is_file():
        return {}
    try:
        with file.open(newline="", encoding="utf-8") as text:
            return {row["file"]: [float(row[name]) for name in _COLUMNS] for row in csv.DictReader(text)}
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise DataError(
            f"{printable(str(file))} has no exact poses; expected the file that the rendering wrote, so bring it back."
        ) from error
