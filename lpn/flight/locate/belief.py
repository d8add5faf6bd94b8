"""The answers of all stages for one frame in one verdict, and the frames whose answers contradict each other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from lpn.core.numbers import upper_bound
from lpn.flight.locate.camera_place import below_camera, told_tilt
from lpn.flight.locate.errors import Errors
from lpn.flight.locate.located import (
    BY_HAND,
    LocatedFlight,
    LocatedFrame,
    StageRecord,
    TrackState,
    checked_beside_middle,
)

# 1-sigma radius in metres of a tag by a consumer's receiver in the open.
TAG_RADIUS = 5.0
# Answers contradict each other beyond this multiple of their common 1-sigma radius.
SIGMAS = 3.0
# A camera of unknown tilt nearly always looks at most so many degrees away from straight down; beyond others nothing is told.
TILT, _MOST_TILT = 15.0, 85.0
# The summary of a registration, which goes on with what contradicts it.
PLACED = "Placed by its details"
# The answers that may contradict a place, in words.
AGAINST = {
    "tag": "its GPS tag disagrees",
    "map": "away from its middle it does not fit the map",
    "sequence": "its neighbours disagree",
}


@dataclass(frozen=True)
class Belief:
    """The verdict on one frame.

    Attributes:
        sign: True if its position may be believed, None if nothing has verified it or answers contradict each other, False if
            there is no position.
        headline: the verdict in some words.
        summary: the same without figures.
        reason: its grounds in a sentence.
        stage: the stage whose position counts; None without a position.
        corrected: True if a person has corrected that position, which settles every doubt.
    """

    sign: bool | None
    headline: str
    summary: str
    reason: str
    stage: str | None = None
    corrected: bool = False

    @property
    def contradicted(self) -> bool:
        """True if details place the photo, and something contradicts them."""
        return self.stage == "registration" and self.sign is None

    @property
    def in_doubt(self) -> bool:
        """True if the place is contradicted, and nobody has corrected it."""
        return self.contradicted and not self.corrected


@dataclass(frozen=True)
class BestAnswer:
    """The answer for one frame that counts.

    Attributes:
        stage: that gave it, or `BY_HAND`; the last stage that ran where there is no position.
        answer: its answer; a refused one without a position where no stage has one.
        state: "contradicted" for a registration that the verdict doubts, else the answer's own.
        doubt: the answers that contradict it: "tag", stages, or "map".
        verdict: of all stages; a correction by hand stands above it.
    """

    stage: str
    answer: StageRecord
    state: TrackState
    doubt: tuple[str, ...]
    verdict: Belief

    @property
    def usable(self) -> bool:
        """True if the position is accepted and nothing contradicts it, or the verdict believes it all the same."""
        return self.state == "accepted" and (not self.doubt or self.verdict.sign is True)

    @property
    def reason(self) -> str:
        """The verdict in one short sentence to filter by."""
        return f"{self.verdict.summary}."

    @property
    def checked(self) -> Literal["yes", "no", "contradicted", ""]:
        """If places beside a registered photo's middle lie where the map has them, see `TrackPoint.checked_beside_middle`."""
        if self.stage != "registration" or not self.answer.accepted:
            return ""
        return "contradicted" if "map" in self.doubt else checked_beside_middle(self.answer)


@dataclass(frozen=True)
class Disagreement:
    """Two answers for one frame that lie farther apart than their radii allow.

    Attributes:
        frame: position in the flight.
        one, other: stages, or "tag"; "map" is what the map has at places away from the photo's middle.
        metres: between them; the median of such places.
        allowed: metres that their radii allow.
    """

    frame: int
    one: str
    other: str
    metres: float
    allowed: float

    @property
    def figures(self) -> tuple[str, str]:
        """The metres, and those that are allowed, a bound and so rounded up; with digits enough to tell that they are more."""
        digits = next((n for n in (1, 2) if round(self.metres, n) - 10.0**-n >= self.allowed - 1e-6), 3)
        return f"{self.metres:.{digits}f}", upper_bound(self.allowed, digits)

    @property
    def sentence(self) -> str:
        """The finding in the field's words, as files have it."""
        metres, allowed = self.figures
        if self.other == "map":
            return (
                f"Away from its middle, the photo lies {metres} m off the map in the median; the radius on this "
                f"map ({self.allowed / SIGMAS:.1f} m) allows {allowed} m. Its middle may still be right."
            )
        return f"{self.one.capitalize()} and {self.other} lie {metres} m apart; their radii allow {allowed} m."


def disagreements(frames: Sequence[LocatedFrame]) -> list[Disagreement]:
    """Return the contradictions between accepted registration, accepted sequence, tag, and map, frame by frame.

    Two answers contradict each other if they lie farther apart than three times the root of the sum of their squared 1-sigma
    radii. The map's error moves registration and sequence alike, so it counts against the tag alone, which has 5 m. A tag is
    compared with the place below the camera, see `below_camera`. An answer that is the picture's middle all the same is moved by
    an unknown tilt, see `_shift`, which is allowed in addition. A registration contradicts the map where the median of its
    `MapAgreement` is more than three times the radius on this map of the photo's middle.
    """
    pairs = []
    for i, located in enumerate(frames):
        accepted = {
            stage: answer
            for stage in ("registration", "sequence")
            if (answer := located.stages.get(stage)) is not None and answer.accepted and answer.x is not None
        }
        if len(accepted) == 2:
            one, other = accepted.values()
            metres = math.hypot(one.x - other.x, one.y - other.y)  # type: ignore[operator]
            allowed = SIGMAS * math.hypot(one.own_radius, other.own_radius) + _shift(located) * (
                one.camera != other.camera
            )
            pairs.append(Disagreement(i, "registration", "sequence", metres, allowed))
        if located.tag is not None:
            pairs += [Disagreement(i, stage, "tag", *beside_tag(located, answer)) for stage, answer in accepted.items()]
        if (misfit := map_misfit(located.stages.get("registration"), i)) is not None:
            pairs.append(misfit)
    return [one for one in pairs if one.metres > one.allowed]


def beside_tag(located: LocatedFrame, answer: StageRecord) -> tuple[float, float]:
    """Return the metres from an answer to the frame's tag, and those that they may lie apart, see `disagreements`."""
    assert located.tag is not None
    below = below_camera(located.frame, answer)
    tilt = 0.0 if below.camera else _shift(located)
    return below.distance(located.tag), SIGMAS * math.hypot(below.radius or 0.0, TAG_RADIUS) + tilt


def map_misfit(answer: StageRecord | None, frame: int = 0) -> Disagreement | None:
    """Return that places away from the middle of a registered photo lie elsewhere on the map; None if not, or if too few tell."""
    if answer is None or not answer.accepted or answer.agreement is None or answer.middle_on_map is None:
        return None
    metres, allowed = answer.agreement.median, SIGMAS * answer.middle_on_map
    return None if metres is None or metres <= allowed else Disagreement(frame, "registration", "map", metres, allowed)


def beliefs(frames: Sequence[LocatedFrame], contradictions: Sequence[Disagreement]) -> list[Belief]:
    """Return the verdict on each frame; `contradictions` are those of all frames."""
    of_frame = _by_frame(contradictions)
    return [belief(located, of_frame.get(i, ())) for i, located in enumerate(frames)]


@dataclass(frozen=True, eq=False)
class FlightVerdicts:
    """The verdicts on the frames of a flight.

    Attributes:
        contradictions: see `disagreements`.
        beliefs: the verdict on each frame.
    """

    contradictions: Sequence[Disagreement]
    beliefs: Sequence[Belief]

    @classmethod
    def of(cls, flight: LocatedFlight) -> FlightVerdicts:
        """Judge all frames of a flight."""
        contradictions = disagreements(flight.frames)
        return cls(contradictions, beliefs(flight.frames, contradictions))


def best_answers(flight: LocatedFlight) -> list[BestAnswer]:
    """Return the answer that counts for each frame: its correction by hand, or that of the stage that the verdict names."""
    of_frame = _by_frame(disagreements(flight.frames))
    last = flight.stages[-1] if flight.stages else ""
    return [best_answer(located, of_frame.get(i, ()), last) for i, located in enumerate(flight.frames)]


def best_answer(
    located: LocatedFrame, contradictions: Sequence[Disagreement] | None = None, last: str = ""
) -> BestAnswer:
    """Return the answer that counts for one frame, see `best_answers`.

    Args:
        contradictions: those of this frame; by default they are looked for.
        last: the last stage that ran, which is named where there is no position.
    """
    if contradictions is None:
        contradictions = disagreements([located])
    verdict = belief(located, contradictions)
    stage, answer = last, StageRecord("refused", verdict.reason)
    if located.by_hand is not None:
        stage, answer = BY_HAND, located.by_hand
    elif verdict.stage is not None:
        stage, answer = verdict.stage, located.stages[verdict.stage]
    is_doubted = stage == "registration" and answer.accepted and verdict.sign is None
    state: TrackState = "contradicted" if is_doubted else answer.state
    return BestAnswer(stage, answer, state, doubts(located, contradictions, stage), verdict)


def _by_frame(contradictions: Sequence[Disagreement]) -> dict[int, list[Disagreement]]:
    of_frame: dict[int, list[Disagreement]] = {}
    for one in contradictions:
        of_frame.setdefault(one.frame, []).append(one)
    return of_frame


def doubts(located: LocatedFrame, contradictions: Sequence[Disagreement], stage: str) -> tuple[str, ...]:
    """Return the answers for a frame that contradict a stage's, given its contradictions; a correction settles it."""
    if located.by_hand is not None:
        return ()
    pairs = [(one.one, one.other) for one in contradictions]
    return tuple(other if one == stage else one for one, other in pairs if stage in (one, other))


def belief(located: LocatedFrame, contradictions: Sequence[Disagreement] | None = None) -> Belief:
    """Return the verdict on a frame.

    A registration is believed unless its tag contradicts it, the map away from its middle does, or, without a tag, the sequence.

    Args:
        contradictions: those of this frame; by default they are looked for.
    """
    if contradictions is None:
        contradictions = disagreements([located])
    registration, sequence, retrieval = (located.stages.get(s) for s in ("registration", "sequence", "retrieval"))
    why = "" if registration is None else registration.sentence
    if registration is not None and registration.accepted:
        summary = PLACED
        headline = f"{summary}, ± {registration.radius or 0:.1f} m {on_what(registration)}"
        error = located.error("registration")
        beside = "" if error is None else f" It lies {error:.1f} m from its GPS tag."
        against = {one.other: one for one in contradictions if one.one == "registration"}
        doubt = against.get("tag") or against.get("map") or against.get("sequence")
        if doubt is None:
            return Belief(True, headline, summary, why + beside, "registration")
        if doubt.other == "sequence" and located.tag is not None:  # two of three agree
            beside += f" Its neighbours would place it {doubt.metres:.1f} m from here."
            return Belief(True, headline, summary, why + beside, "registration")
        but = f", but {AGAINST[doubt.other]}"
        corrected = located.by_hand is not None
        return Belief(None, headline + but, summary + but, doubt.sentence, "registration", corrected)
    if sequence is not None and sequence.accepted:
        summary = "Placed by its neighbours only"
        return Belief(
            None,
            f"{summary}, ± {sequence.radius or 0:.0f} m on this map",
            summary,
            why or sequence.sentence,
            "sequence",
        )
    if retrieval is not None and retrieval.x is not None:
        refused = _first_refusal(registration, sequence)
        guess = "Not placed, a best guess only"
        return Belief(None, guess, guess, refused or retrieval.sentence, "retrieval")
    why = _first_refusal(registration, sequence, retrieval) or "No stage has an answer."
    return Belief(False, "Not located", "Not located", why)


def _placed(flight: LocatedFlight, verdicts: Sequence[Belief]) -> Iterator[tuple[LocatedFrame, StageRecord]]:
    """Yield the frames whose place counts, by details or by neighbours, with that answer."""
    for located, verdict in zip(flight.frames, verdicts, strict=True):
        if verdict.stage in ("registration", "sequence"):
            yield located, located.stages[verdict.stage]


def radii_on_map(flight: LocatedFlight, verdicts: Sequence[Belief]) -> list[float]:
    """Return the 1-sigma radii of a flight's placed photos on this map in metres, of those that have one.

    Args:
        verdicts: of the frames, see `beliefs`.
    """
    return [answer.radius_on_map for _, answer in _placed(flight, verdicts) if answer.radius_on_map is not None]


def placed_errors(flight: LocatedFlight, verdicts: Sequence[Belief]) -> Errors | None:
    """Return the errors of a flight's placed photos against their tags, whatever a person corrected; None without any.

    Args:
        verdicts: of the frames, see `beliefs`.
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


def on_what(answer: StageRecord) -> str:
    """Return what the radius of an answer refers to: this map, or earth, where the map tells the error of its place."""
    return "on earth" if answer.on_earth else "on this map"


def _first_refusal(*answers: StageRecord | None) -> str:
    return next((answer.sentence for answer in answers if answer is not None and answer.state == "refused"), "")


def _shift(located: LocatedFrame) -> float:
    """Return the metres by which a tilt may move the picture's middle from below the camera: the told one, or an unknown one.

    An unknown one is 15 degrees. The height is that of the flight, else half of the picture's width on the ground.
    """
    answer = located.stages.get("registration")
    width = 0.0 if answer is None or answer.width is None else answer.width
    height = located.frame.flying_height or width / 2
    return height * math.tan(math.radians(min(max(TILT, told_tilt(located.frame)), _MOST_TILT)))
