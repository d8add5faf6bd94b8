"""How accurate the places of a flight are, by what the flight itself has measured."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from lpn.flight.locate.belief import Belief
from lpn.flight.locate.errors import Errors
from lpn.flight.locate.located import LocatedFlight, LocatedFrame, StageRecord


def _placed(flight: LocatedFlight, verdicts: Sequence[Belief]) -> Iterator[tuple[LocatedFrame, StageRecord]]:
    """Yield the frames whose place counts, by details or by neighbours, with that answer."""
    for located, verdict in zip(flight.frames, verdicts, strict=True):
        if verdict.stage in ("registration", "sequence"):
            yield located, located.stages[verdict.stage]


def radii_on_map(flight: LocatedFlight, verdicts: Sequence[Belief]) -> list[float]:
    """Return the 1-sigma radii of a flight's placed photos on this map in metres, of those that have one.

    Args:
        verdicts: of the frames, see `lpn.flight.locate.belief.beliefs`.
    """
    return [answer.radius_on_map for _, answer in _placed(flight, verdicts) if answer.radius_on_map is not None]


def placed_errors(flight: LocatedFlight, verdicts: Sequence[Belief]) -> Errors | None:
    """Return the errors of a flight's placed photos against their tags, whatever a person corrected; None without any.

    Args:
        verdicts: of the frames, see `lpn.flight.locate.belief.beliefs`.
    """
    rows = [
        (answer.x - located.tag[0], answer.y - located.tag[1], answer.radius)
        for located, answer in _placed(flight, verdicts)
        if located.tag is not None and answer.x is not None and answer.y is not None
    ]
    return Errors.of(len(rows), rows) if rows else None


def is_unchecked(located: LocatedFrame) -> bool:
    """Return whether too few places away from the middle of a registered photo were found on the map to check it."""
    agreement = located.stages["registration"].agreement
    return agreement is not None and bool(agreement.unchecked)
