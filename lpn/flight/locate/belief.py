"""One verdict on each frame from the answers of all stages, and contradictions between these answers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from lpn.core.numbers import upper_bound
from lpn.flight.locate.camera_place import below_camera, frame_tilt
from lpn.flight.locate.errors import Errors
from lpn.flight.locate.located import (
    BY_HAND,
    LocatedFlight,
    LocatedFrame,
    StageRecord,
    TrackState,
    checked_beside_middle,
)

# 1-sigma radius in metres of a consumer receiver's tag under open sky.
TAG_RADIUS = 5.0
# Answers contradict each other beyond this multiple of their common 1-sigma radius.
SIGMAS = 3.0
# Degrees from straight down within which a camera of unknown tilt nearly always looks, and above which a known tilt tells
# nothing.
TILT, _MOST_TILT = 15.0, 85.0
# The summary of a registration; contradictions are appended.
PLACED = "Placed by its details"
# Possible contradictions of a place, in words.
AGAINST = {
    "tag": "its GPS tag disagrees",
    "map": "away from its middle it does not fit the map",
    "sequence": "its neighbours disagree",
}


@dataclass(frozen=True)
class Belief:
    """The verdict on one frame.

    Attributes:
        sign: True if its position may be believed, None if it is unverified or contradicted, False without a position.
        headline: the verdict in a few words.
        summary: the headline without figures.
        reason: its grounds in a sentence.
        stage: the stage of the position; None without a position.
        corrected: True if a person has corrected the position, which settles every doubt.
    """

    sign: bool | None
    headline: str
    summary: str
    reason: str
    stage: str | None = None
    corrected: bool = False

    @property
    def contradicted(self) -> bool:
        """True if details place the photo and another answer contradicts them."""
        return self.stage == "registration" and self.sign is None

    @property
    def in_doubt(self) -> bool:
        """True if the place is contradicted and not corrected."""
        return self.contradicted and not self.corrected


@dataclass(frozen=True)
class BestAnswer:
    """The best answer for one frame.

    Attributes:
        stage: its stage, or `BY_HAND`; the last stage that ran if there is no position.
        answer: of this stage; a refused one without a position if no stage has a position.
        state: "contradicted" for a registration that the verdict doubts, else the answer's state.
        doubt: the answers that contradict it: "tag", stages, or "map".
        verdict: of all stages; a correction by hand overrides it.
    """

    stage: str
    answer: StageRecord
    state: TrackState
    doubt: tuple[str, ...]
    verdict: Belief

    @property
    def usable(self) -> bool:
        """True if the position is accepted, and either uncontradicted or still believed by the verdict."""
        return self.state == "accepted" and (not self.doubt or self.verdict.sign is True)

    @property
    def reason(self) -> str:
        """The verdict in one short sentence to filter by."""
        return f"{self.verdict.summary}."

    @property
    def checked(self) -> Literal["yes", "no", "contradicted", ""]:
        """Agreement with the map away from a registered photo's middle, see `TrackPoint.checked_beside_middle`."""
        if self.stage != "registration" or not self.answer.accepted:
            return ""
        return "contradicted" if "map" in self.doubt else checked_beside_middle(self.answer)


@dataclass(frozen=True)
class Disagreement:
    """Two answers for one frame that lie farther apart than their radii allow.

    Attributes:
        frame: position in the flight.
        one, other: stages, or "tag"; "map" stands for places on the map away from the photo's middle.
        metres: between them; for "map" the median of the places' offsets.
        allowed: metres that their radii allow.
    """

    frame: int
    one: str
    other: str
    metres: float
    allowed: float

    @property
    def figures(self) -> tuple[str, str]:
        """The metres, and the allowed metres rounded up, with enough digits to show that the first are more."""
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

    Two answers contradict each other if their distance exceeds three times the root of the sum of their squared 1-sigma radii. A
    tag's radius is 5 m. The map's error moves registration and sequence alike, so it counts only against the tag. A tag is
    compared with the place below the camera, see `below_camera`. If that is unknown, the shift by an unknown tilt is allowed in
    addition, see `_shift`. A registration contradicts the map if the median of its `MapAgreement` exceeds three times the radius
    on this map of the photo's middle.
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
    """Return the metres from an answer to the frame's tag, and the allowed metres, see `disagreements`."""
    assert located.tag is not None
    below = below_camera(located.frame, answer)
    tilt = 0.0 if below.camera else _shift(located)
    return below.distance(located.tag), SIGMAS * math.hypot(below.radius or 0.0, TAG_RADIUS) + tilt


def map_misfit(answer: StageRecord | None, frame: int = 0) -> Disagreement | None:
    """Return the contradiction between a registration and the map away from the photo's middle; None without one."""
    if answer is None or not answer.accepted or answer.agreement is None or answer.middle_on_map is None:
        return None
    metres, allowed = answer.agreement.median, SIGMAS * answer.middle_on_map
    return None if metres is None or metres <= allowed else Disagreement(frame, "registration", "map", metres, allowed)


def beliefs(frames: Sequence[LocatedFrame], contradictions: Sequence[Disagreement]) -> list[Belief]:
    """Return the verdict on each frame, given the contradictions of all frames."""
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
    """Return the best answer for each frame: its correction by hand, else the answer of the verdict's stage."""
    of_frame = _by_frame(disagreements(flight.frames))
    last = flight.stages[-1] if flight.stages else ""
    return [best_answer(located, of_frame.get(i, ()), last) for i, located in enumerate(flight.frames)]


def best_answer(
    located: LocatedFrame, contradictions: Sequence[Disagreement] | None = None, last: str = ""
) -> BestAnswer:
    """Return the best answer for one frame, see `best_answers`.

    Args:
        contradictions: of this frame; by default they are computed.
        last: the last stage that ran, which is named without a position.
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
    """Return the names of the answers that contradict a stage's; none for a corrected frame."""
    if located.by_hand is not None:
        return ()
    pairs = [(one.one, one.other) for one in contradictions]
    return tuple(other if one == stage else one for one, other in pairs if stage in (one, other))


def belief(located: LocatedFrame, contradictions: Sequence[Disagreement] | None = None) -> Belief:
    """Return the verdict on a frame.

    A registration is believed unless its tag or the map away from its middle contradicts it, or, without a tag, the sequence.

    Args:
        contradictions: of this frame; by default they are computed.
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
    """Yield the frames that details or neighbours place, with that answer."""
    for located, verdict in zip(flight.frames, verdicts, strict=True):
        if verdict.stage in ("registration", "sequence"):
            yield located, located.stages[verdict.stage]


def radii_on_map(flight: LocatedFlight, verdicts: Sequence[Belief]) -> list[float]:
    """Return the known 1-sigma radii on this map in metres of a flight's placed photos.

    Args:
        verdicts: of the frames, see `beliefs`.
    """
    return [answer.radius_on_map for _, answer in _placed(flight, verdicts) if answer.radius_on_map is not None]


def placed_errors(flight: LocatedFlight, verdicts: Sequence[Belief]) -> Errors | None:
    """Return the errors of a flight's placed photos against their tags, corrections ignored; None without any.

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
    """Tell whether too few places of a registered photo were found on the map to check it away from its middle."""
    agreement = located.stages["registration"].agreement
    return agreement is not None and bool(agreement.unchecked)


def on_what(answer: StageRecord) -> str:
    """Return the reference of an answer's radius: earth if the map's own error is known, else this map."""
    return "on earth" if answer.on_earth else "on this map"


def _first_refusal(*answers: StageRecord | None) -> str:
    return next((answer.sentence for answer in answers if answer is not None and answer.state == "refused"), "")


def _shift(located: LocatedFrame) -> float:
    """Return the metres between the picture's middle and the place below the camera, by the frame's tilt, else 15 degrees.

    The height is the flight's, else half of the picture's width on the ground.
    """
    answer = located.stages.get("registration")
    width = 0.0 if answer is None or answer.width is None else answer.width
    height = located.frame.flying_height or width / 2
    return height * math.tan(math.radians(min(max(TILT, frame_tilt(located.frame)), _MOST_TILT)))
