"""How the photos of a flight were placed, and how accurate that is, by what the flight itself has measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath
from statistics import median

from lpn.core.files import printable
from lpn.core.numbers import upper_bound
from lpn.core.texts import listed
from lpn.drawing.words import capitalised, plain, say
from lpn.locate.belief import Belief
from lpn.locate.located import LocatedFlight, LocatedFrame
from lpn.locate.surveyed import SurveyedErrors
from lpn.locate.tag_errors import tag_errors
from lpn.maps.tag_placed import placing_sentence

# The stages whose answers are accepted, in the words for everybody and in the field's.
PLACED = {"registration": ("by their details", "by registration"), "sequence": ("by their neighbours", "by sequence")}
# The list of photos that could not be checked.
NOT_CHECKED = "Not checked"
# Names in one sentence at most.
_MOST_NAMES = 10
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
        verdicts: of the frames, see `lpn.locate.belief.beliefs`.
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
        verdicts: of the frames, see `lpn.locate.belief.beliefs`.
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


def describe_flight(flight: LocatedFlight, verdicts: Sequence[Belief], errors: SurveyedErrors | None) -> str:
    """Say how many photos are placed, only guessed, and refused, and how far the placed ones lie from their GPS tags.

    Photos in doubt are named, and others that could not be checked away from their middle are counted. A flight whose tags
    lie far off the map begins with that.

    A photo is placed where registration or sequence is accepted, and guessed where there is a most similar window alone.

    Args:
        verdicts: of the frames, see `lpn.locate.belief.beliefs`.
        errors: those of `placed_errors`.
    """
    frames = flight.frames
    counts = {stage: sum(verdict.stage == stage for verdict in verdicts) for stage in (*PLACED, "retrieval")}
    ways = [f"{counts[stage]:,} {of[0 if plain() else 1]}" for stage, of in PLACED.items() if counts[stage]]
    placed = counts["registration"] + counts["sequence"]
    guessed, refused = counts["retrieval"], len(frames) - placed - counts["retrieval"]
    pieces = [f"{placed:,} placed" + (f" ({', '.join(ways)})" if ways else "") + doubted_clause(verdicts)]
    if guessed:
        pieces.append(f"{guessed:,} only guessed {'by their look' if plain() else 'by retrieval'}")
    if refused:
        pieces.append(f"{refused:,} refused")
    over = "" if flight.elsewhere else " over this map"
    sentences = [other_map(flight)] if flight.elsewhere else []
    sentences.append(f"A drone took {len(frames):,} photos{over}: {', '.join(pieces)}.")
    pairs = list(zip(frames, verdicts, strict=True))
    if errors is not None:
        sentences.append(
            f"The placed ones lie {errors.median:.1f} m from their GPS tags in the median{share_within(errors)}, "
            "which is the error of both together."
        )
    stems = {PurePath(frame.frame.name).stem for frame in frames}
    short = len(stems) == len(frames)

    def names(of: Sequence[LocatedFrame]) -> str:
        told = [PurePath(one.frame.name).stem if short else one.frame.name for one in of[:_MOST_NAMES]]
        further = (
            [f"{len(of) - len(told):,} more in the list {capitalised(say('audit'))}"] if len(of) > len(told) else []
        )
        return listed([*map(printable, told), *further])

    doubted = [frame for frame, one in pairs if one.in_doubt]
    if doubted:
        sentences.append(
            f"In doubt {'is' if len(doubted) == 1 else 'are'} {names(doubted)}, contradicted by GPS tag, neighbours, or the map "
            "away from the photo's middle."
        )
    if unchecked := unchecked_frames(frames, verdicts):
        more = " more" if doubted else ""
        sentences.append(
            f"{len(unchecked):,}{more} could not be checked away from the middle, where too few places were found on the map; "
            f"the list {NOT_CHECKED} names {'them' if len(unchecked) > 1 else 'it'}."
        )
    return " ".join(sentences)


def doubted_clause(verdicts: Sequence[Belief]) -> str:
    """Say how many of some placed photos are in doubt, as a clause with a comma before; "" if none is."""
    doubted = sum(one.in_doubt for one in verdicts)
    return f", {doubted:,} of them in doubt" if doubted else ""


def unchecked_frames(frames: Sequence[LocatedFrame], verdicts: Sequence[Belief]) -> list[int]:
    """Return the numbers of the photos that their details place, undoubted and yet not checked away from their middle.

    Args:
        verdicts: of the frames, see `lpn.locate.belief.beliefs`.
    """
    pairs = enumerate(zip(frames, verdicts, strict=True))
    return [i for i, (frame, one) in pairs if one.stage == "registration" and one.sign and is_unchecked(frame)]


def is_unchecked(located: LocatedFrame) -> bool:
    """Return whether too few places away from the middle of a registered photo were found on the map to check it."""
    agreement = located.stages["registration"].agreement
    return agreement is not None and bool(agreement.unchecked)
