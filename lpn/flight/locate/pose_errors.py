"""Errors of poses against the exact ones of a rendered flight."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.numbers import upper_bound, wrap_degrees
from lpn.datasets.rendered import TRUTH, is_rendered_flight
from lpn.flight.files.cameras import rotation
from lpn.flight.locate.located import LocatedFlight

# Metres beyond three sigmas from which an error counts as one that the covariance should have told.
_TOLERANCE = 5.0


@dataclass(frozen=True)
class PoseErrors:
    """Errors of a flight's poses.

    Attributes:
        frames: photos whose exact pose is known.
        poses: of these, photos with an accepted pose.
        position: metres, (poses,): in space, or in the plane where the ground counts as flat.
        heading, pitch: degrees, (poses,), 0 or more.
        turn: degrees, (poses,): the angle of the rotation between both.
        beyond: poses whose position errs by more than three sigmas and 5 m.
        flat: whether positions are compared in the plane, because the ground counts as flat.
    """

    frames: int
    poses: int
    position: Float64Array
    heading: Float64Array
    pitch: Float64Array
    turn: Float64Array
    beyond: int
    flat: bool

    @property
    def sentence(self) -> str:
        """A line for the console."""
        share = f"Poses against the exact ones: {self.poses} of {self.frames} photos have one ({self.poses / self.frames:.0%})"
        if not self.poses:
            return f"{share}."
        kind = "position in the plane" if self.flat else "position"
        metres, most, nearly_all = np.quantile(self.position, (0.5, 0.9, 0.95))
        return (
            f"{share}; median errors: {kind} {metres:.2f} m (90 % within {upper_bound(most, 2)} m, 95 % within "
            f"{upper_bound(nearly_all, 2)} m), heading {np.median(self.heading):.2f} degrees, pitch "
            f"{np.median(self.pitch):.2f} degrees; {self.beyond} beyond 3 sigmas and "
            f"{_TOLERANCE:g} m."
        )


def pose_errors(located: LocatedFlight) -> PoseErrors | None:
    """Return the errors of a flight's poses; None unless exact ones lie beside its photos.

    Raises:
        DataError: if the exact poses cannot be read.
    """
    folders = {located_frame.frame.file.parent for located_frame in located.frames}
    truths: dict[str, _TruePose] = {}
    for folder in sorted(folders):
        truths |= _true_poses(folder)
    return _compared(located, truths) if any(frame.frame.file.name in truths for frame in located.frames) else None


def _compared(located: LocatedFlight, truths: Mapping[str, _TruePose]) -> PoseErrors:
    known = [frame for frame in located.frames if frame.frame.file.name in truths]
    flat = located.basemap.elevation is None
    rows, beyond = [], 0
    for frame in known:
        answer, truth = frame.stages.get("registration"), truths[frame.frame.file.name]
        if answer is None or not answer.accepted or (pose := answer.pose) is None:
            continue
        east, north = located.basemap.frame.xy([truth.latitude], [truth.longitude])[0].tolist()
        off = [pose.east - east, pose.north - north] + ([] if flat else [pose.altitude - truth.altitude])
        metres = math.hypot(*off)
        beyond += metres > 3 * math.hypot(*pose.sigmas[: len(off)].tolist()) + _TOLERANCE
        turn = rotation(pose.heading, pose.pitch, pose.roll).T @ rotation(truth.heading, truth.pitch, truth.roll)
        degrees = math.degrees(math.acos(float(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
        rows.append((metres, abs(wrap_degrees(pose.heading - truth.heading)), abs(pose.pitch - truth.pitch), degrees))
    position, heading, pitch, turns = np.array(rows, np.float64).reshape(-1, 4).T
    return PoseErrors(len(known), len(rows), position, heading, pitch, turns, beyond, flat)


class _TruePose(NamedTuple):
    """WGS 84 degrees, metres above the elevation's datum, and angles in degrees."""

    latitude: float
    longitude: float
    altitude: float
    heading: float
    pitch: float
    roll: float


def _true_poses(photos: Path) -> dict[str, _TruePose]:
    """Return the exact poses of the photos of a rendered flight, by their names; none for another folder."""
    file = photos.parent / TRUTH
    if not is_rendered_flight(photos) or not file.is_file():
        return {}
    names = ("latitude", "longitude", "z", "true_heading", "true_pitch", "true_roll")
    try:
        with file.open(newline="", encoding="utf-8") as text:
            return {row["file"]: _TruePose(*(float(row[name]) for name in names)) for row in csv.DictReader(text)}
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise DataError(
            f"{printable(str(file))} has no exact poses; expected the file that the rendering wrote, so bring it back."
        ) from error
