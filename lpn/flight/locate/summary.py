"""How the photos of a flight were placed, and how accurate that is, by what the flight itself has measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from lpn.core.numbers import upper_bound
from lpn.flight.locate.belief import Belief
from lpn.flight.locate.located import LocatedFlight, LocatedFrame
from lpn.flight.locate.surveyed import SurveyedErrors
from lpn.flight.locate.tag_errors import tag_errors
from lpn.flight.maps.place import placing_sentence

# The stages whose answers are accepted, in the words for everybody and in the field's.
PLACED = {"registration": ("by their details", "by registration"), "sequence": ("by their neighbours", "by sequence")}
# Distances from which their 95th percentile is told, at least.
_FEWEST = 5


@dataclass(frozen=True)
class FlightAccuracy:
    """The errors of a flight's places, as far as flight and map tell them.

    Attributes:
        photos: placed ones, whose stage tells a radius.
        radius: median of their 1-sigma radii in metres; on earth if there is a `place_error`, which then counts for all of them,
            else on this map.
        details: median of the radii in metres that the scatter of the details alone gives, without the map's error; None where
            no photo is registered, or the map's error is not known.
        map_error: 1-sigma error in metres that counts for the map's own places; None where it is not known.
        place_error: the part of it that the map tells of its place on earth; None if it does not, or radii do not hold it.
        map_source: sentence of the map about the GPS tags that its georeference comes from; "" if it comes from elsewhere.
    """

    photos: int
    radius: float
    details: float | None
    map_error: float | None
    place_error: float | None
    map_source: str


def flight_accuracy(flight: LocatedFlight, verdicts: Sequence[Belief]) -> FlightAccuracy | None:
    """Return how accurate the places of a flight are; None if no placed photo has a radius.

    Args:
        verdicts: of the frames, see `lpn.flight.locate.belief.beliefs`.
    """
    radii, details = [], []
    place_error = flight.place_error or None
    for located, verdict in zip(flight.frames, verdicts, strict=True):
        if verdict.stage not in PLACED or (radius := located.stages[verdict.stage].radius) is None:
            continue
        # The radius of a sequence is one on the map.
        radii.append(math.hypot(radius, place_error or 0.0) if verdict.stage == "sequence" else radius)
        if verdict.stage == "registration" and flight.map_error is not None:
            details.append(math.sqrt(max(radius**2 - flight.map_error**2, 0.0)))
    if not radii:
        return None
    return FlightAccuracy(
        len(radii),
        median(radii),
        median(details) if details else None,
        flight.map_error,
        place_error,
        placing_sentence(flight.basemap.notes),
    )


def placed_errors(flight: LocatedFlight, verdicts: Sequence[Belief]) -> SurveyedErrors | None:
    """Return the errors of a flight's placed photos against their tags; None if no placed photo has one.

    Args:
        verdicts: of the frames, see `lpn.flight.locate.belief.beliefs`.
    """
    pairs = zip(flight.frames, verdicts, strict=True)
    return tag_errors(flight.frames, [one.stages[told.stage] if told.stage in PLACED else None for one, told in pairs])


def share_within(errors: SurveyedErrors) -> str:
    """Return the metres within which 95 % of the distances lie, in words with a comma before; "" of few distances."""
    return f", 95 % of them within {upper_bound(errors.ce95)} m" if errors.photos >= _FEWEST else ""


def other_map(flight: LocatedFlight) -> str:
    """Say that the map is probably not of the flight's place, as all tags lie far off it, and what to do; else ""."""
    if not flight.elsewhere:
        return ""
    advice = "Give the map of the tags' place unless the tags are wrong."
    return f"{flight.elsewhere}, so the map is probably of another place. {advice}"


def unchecked_frames(frames: Sequence[LocatedFrame], verdicts: Sequence[Belief]) -> list[int]:
    """Return the numbers of the photos that their details place, undoubted and yet not checked away from their middle.

    Args:
        verdicts: of the frames, see `lpn.flight.locate.belief.beliefs`.
    """
    pairs = enumerate(zip(frames, verdicts, strict=True))
    return [i for i, (frame, one) in pairs if one.stage == "registration" and one.sign and is_unchecked(frame)]


def is_unchecked(located: LocatedFrame) -> bool:
    """Return whether too few places away from the middle of a registered photo were found on the map to check it."""
    agreement = located.stages["registration"].agreement
    return agreement is not None and bool(agreement.unchecked)
