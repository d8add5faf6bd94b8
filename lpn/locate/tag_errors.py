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
# Metres between the neighbours of a photo below which it has no direction: the drone hovers.
_STANDS = 1.0
# Photos of a leg whose mean is told, at least.
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
    """Places minus tags, or minus the corrections by hand where there are some.

    Attributes:
        offsets: of all photos that have both.
        p95: metres within which 95 % of the distances lie (`numpy.quantile`).
        legs: of the flight, those with 3 such photos at least, in its order.
    """

    offsets: SurveyedErrors
    p95: float
    legs: Sequence[Leg]


def tag_errors(frames: Sequence[LocatedFrame], answers: Sequence[StageRecord | None]) -> TagOffsets | None:
    """Return the errors of a flight's places against `LocatedFrame.truth`; None if no photo has both.

    Args:
        frames: in the order of the flight.
        answers: the place of each frame; None where it does not count.
    """
    off = np.full((len(frames), 2), np.nan)
    for i, (located, answer) in enumerate(zip(frames, answers, strict=True)):
        if answer is None or answer.x is None or answer.y is None:
            continue
        if (truth := located.truth(answer.camera)) is not None:
            off[i] = answer.x - truth[0], answer.y - truth[1]
    known = off[~np.isnan(off[:, 0])]
    if not len(known):
        return None
    return TagOffsets(
        summarise_offsets(known, np.empty(0)),
        float(np.quantile(np.linalg.norm(known, axis=1), 0.95)),
        _legs(tag_positions(frames), off),
    )


def _legs(tags: Float64Array, off: Float64Array) -> list[Leg]:
    """Return the legs of a flight by its tags, (N, 2), with the means of `off`, (N, 2); both are NaN where not known."""
    known = np.flatnonzero(~np.isnan(tags[:, 0]))
    if len(known) < _FEW:
        return []
    at = tags[known]
    ahead = np.concatenate([at[1:], at[-1:]]) - np.concatenate([at[:1], at[:-1]])
    runs: list[tuple[list[int], Float64Array]] = []
    goes_on = False
    for frame, step in zip(known.tolist(), ahead, strict=True):
        length = float(np.hypot(*step))
        if length < _STANDS:
            goes_on = False
            continue
        unit = step / length
        if goes_on and unit @ runs[-1][1] >= math.cos(math.radians(_TURN)) * np.hypot(*runs[-1][1]):
            runs[-1] = ([*runs[-1][0], frame], runs[-1][1] + unit)
        else:
            runs.append(([frame], unit))
        goes_on = True
    legs = []
    for photos, direction in runs:
        own = off[photos]
        own = own[~np.isnan(own[:, 0])]
        if len(own) >= _FEW:
            azimuth = math.degrees(math.atan2(*direction)) % 360
            legs.append(Leg(photos[0], photos[-1], azimuth, *own.mean(axis=0).tolist()))
    return legs
