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
# Standard deviation of a tag along each axis in metres that is assumed at least: tags of a hovering drone scatter by as much.
_LEAST_SCATTER = 1.5
# Standard deviations between photos below which they are at one place.
_ONE_PLACE = 2.0
# Standard deviations between the ends of a leg, at least: of 60 tags of one place, two lie farther apart in 1 % of flights.
_LEG = 7.0
# The quantile of second differences that tells the scatter, as turns make the greater ones, and its value for a tag of standard
# deviation 1: a second difference has 6 times the variance of a tag.
_QUANTILE, _NORMAL = 0.25, 0.3186 * math.sqrt(6)
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
        legs: of the flight, in its order, those with such photos at 3 places at least that are longer than the tags scatter.
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


def _scatter(tags: Float64Array) -> float:
    """Return the standard deviation of tags, (N, 2), along each axis in metres; 0 for fewer than three.

    Each tag's distance from its neighbours' middle tells it. Only the part across the direction of flight counts, so changes of
    speed do not. Tags that drift slowly scatter more than this tells.
    """
    tags = tags[np.append(True, (np.diff(tags, axis=0) != 0).any(axis=1))]  # a repeated tag says nothing new
    if len(tags) < 3:
        return 0.0
    (east, north), bend = (tags[2:] - tags[:-2]).T, tags[2:] - 2 * tags[1:-1] + tags[:-2]
    across = np.abs(east * bend[:, 1] - north * bend[:, 0]) / np.maximum(np.hypot(east, north), 1e-9)
    return float(np.quantile(across, _QUANTILE)) / _NORMAL


def _legs(tags: Float64Array, off: Float64Array) -> list[Leg]:
    """Return the legs of a flight by its tags, (N, 2), with the means of `off`, (N, 2); both are NaN where not known.

    A leg is longer than the scatter of the tags explains.
    """
    known = np.flatnonzero(~np.isnan(tags[:, 0]))
    scatter = max(_scatter(tags[known]), _LEAST_SCATTER)
    # Photos of one place are one step of the flight, as are those of a repeated tag.
    places: list[list[int]] = []
    for frame in known.tolist():
        if places and float(np.hypot(*(tags[frame] - tags[places[-1][0]]))) < _ONE_PLACE * scatter:
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
        length = float(np.hypot(*(tags[photos[-1]] - tags[photos[0]])))
        if answered >= _FEW and length >= _LEG * scatter:
            azimuth = math.degrees(math.atan2(*direction)) % 360
            legs.append(Leg(photos[0], photos[-1], azimuth, *own.mean(axis=0).tolist()))
    return legs
