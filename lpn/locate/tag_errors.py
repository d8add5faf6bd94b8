"""The places of a flight's photos against their GPS tags: the distances, the mean shift, and the shift of each leg."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.locate.located import LocatedFrame, StageRecord, tag_positions
from lpn.locate.surveyed import SurveyedErrors, summarise_offsets

# Degrees from the direction of a leg within which the next photo belongs to it.
_TURN = 45.0
# Metres between photos below which they are at one place: GPS tags scatter by as much while a drone hovers.
_STRAYS = 3.0
# Photos of a leg whose mean is told, and places at which they were taken, at least.
_FEW = 3


@dataclass(frozen=True)
class Leg:
    """Photos of a flight that follow each other in one direction.

    Attributes:
        first, last: numbers of its frames, from 0.
        azimuth: direction of the flight, degrees clockwise from north, by the tags.
        east, north: mean of place minus tag, metres.
    """

    first: int
    last: int
    azimuth: float
    east: float
    north: float

    @property
    def metres(self) -> float:
        """The length of the mean."""
        return math.hypot(self.east, self.north)


@dataclass(frozen=True)
class TagOffsets:
    """Places minus tags.

    Attributes:
        offsets: of all photos that have both.
        legs: of the flight, those with 3 such photos at least, in its order.
    """

    offsets: SurveyedErrors
    legs: Sequence[Leg]


def tag_errors(frames: Sequence[LocatedFrame], answers: Sequence[StageRecord | None]) -> TagOffsets | None:
    """Return the errors of a flight's places against its GPS tags, whatever a person corrected; None if no photo has both.

    Args:
        frames: in the order of the flight.
        answers: the place of each frame; None where it does not count.
    """
    off = np.full((len(frames), 2), np.nan)
    for i, (located, answer) in enumerate(zip(frames, answers, strict=True)):
        if answer is not None and answer.x is not None and answer.y is not None and located.tag is not None:
            off[i] = answer.x - located.tag[0], answer.y - located.tag[1]
    known = off[~np.isnan(off[:, 0])]
    if not len(known):
        return None
    return TagOffsets(summarise_offsets(known, np.empty(0)), _legs(tag_positions(frames), off))


def _legs(tags: Float64Array, off: Float64Array) -> list[Leg]:
    """Return the legs of a flight by its tags, (N, 2), with the means of `off`, (N, 2); both are NaN where not known."""
    # Photos nearer to each other than a drone strays while it hovers are at one place, as are those of a repeated tag.
    places: list[list[int]] = []
    for frame in np.flatnonzero(~np.isnan(tags[:, 0])).tolist():
        if places and float(np.hypot(*(tags[frame] - tags[places[-1][0]]))) < _STRAYS:
            places[-1].append(frame)
        else:
            places.append([frame])
    if len(places) < _FEW:
        return []
    at = tags[[frames[0] for frames in places]]
    ahead = np.concatenate([at[1:], at[-1:]]) - np.concatenate([at[:1], at[:-1]])
    runs: list[tuple[list[list[int]], Float64Array]] = []
    for frames, step in zip(places, ahead, strict=True):
        unit = step / max(float(np.hypot(*step)), 1e-9)
        if runs and unit @ runs[-1][1] >= math.cos(math.radians(_TURN)) * np.hypot(*runs[-1][1]):
            runs[-1] = ([*runs[-1][0], frames], runs[-1][1] + unit)
        else:
            runs.append(([frames], unit))
    legs = []
    for run, direction in runs:
        photos = [frame for frames in run for frame in frames]
        own = off[photos]
        own = own[~np.isnan(own[:, 0])]
        answered = sum(bool(np.isfinite(off[frames, 0]).any()) for frames in run)
        if answered >= _FEW:
            azimuth = math.degrees(math.atan2(*direction)) % 360
            legs.append(Leg(photos[0], photos[-1], azimuth, *own.mean(axis=0).tolist()))
    return legs
