"""One verdict on each frame from the answers of all stages, and contradictions between these answers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lpn.core.numbers import upper_bound
from lpn.flight.locate.camera_place import below_camera, frame_tilt
from lpn.flight.locate.errors import Errors
from lpn.flight.locate.located import BY_HAND, STAGES, LocatedFrame, StageRecord, TrackState
from lpn.flight.locate.words import AGAINST, DECIDED

# 1-sigma radius in metres of a consumer receiver's tag under open sky.
TAG_RADIUS = 5.0
# Answers contradict each other beyond this multiple of their common 1-sigma radius.
SIGMAS = 3.0
# Degrees from straight down within which a camera of unknown tilt nearly always looks, and the largest tilt for which a shift
# is computed.
TILT, _MOST_TILT = 15.0, 85.0


@dataclass(frozen=True)
class Disagreement:
    """Two answers for one frame that lie farther apart than their radii allow.

    Attributes:
        one, other: stages, or "tag"; "map" stands for places on the map away from the photo's middle.
        metres: between them; for "map" the median of the places' offsets.
        allowed: metres that their radii allow.
    """

    one: str
    other: str
    metres: float
    allowed: float

    @property
    def sentence(self) -> str:
        """The finding with enough digits to show that the metres exceed the allowed ones, which are rounded up."""
        digits = next((n for n in (1, 2) if round(self.metres, n) - 10.0**-n >= self.allowed - 1e-6), 3)
        metres, allowed = f"{self.metres:.{digits}f}", upper_bound(self.allowed, digits)
        if self.other == "map":
            return (
                f"Away from its middle, the photo lies {metres} m off the map in the median; the radius on this "
                f"map ({self.allowed / SIGMAS:.1f} m) allows {allowed} m. Its middle may still be right."
            )
        return f"{self.one.capitalize()} and {self.other} lie {metres} m apart; their radii allow {allowed} m."


@dataclass(frozen=True, eq=False)
class FrameVerdict:
    """The verdict on one frame.

    Attributes:
        located: the frame with the answers of its stages.
        stage: the stage whose position counts, corrections by hand ignored; None without a position.
        answer: the best answer: the correction by hand, else the answer of `stage`, else a refused one without a position.
        sign: True if the position of `stage` may be believed, None if it is unverified or contradicted, False without one.
        summary: the verdict in a few words without figures.
        headline: the verdict in a few words.
        reason: its grounds.
        disagreements: the contradictions between the answers.
    """

    located: LocatedFrame
    stage: str | None
    answer: StageRecord
    sign: bool | None
    summary: str
    headline: str
    reason: str
    disagreements: Sequence[Disagreement]

    @property
    def contradicted(self) -> bool:
        """True if details place the photo and another answer contradicts them."""
        return self.stage == "registration" and self.sign is None

    @property
    def placed(self) -> StageRecord | None:
        """The answer of the details or the neighbours that place the photo; None if neither does."""
        return self.located.stages[self.stage] if self.stage in ("registration", "sequence") else None

    @property
    def state(self) -> TrackState:
        """ "contradicted" for a registration that the verdict doubts, else the best answer's state."""
        return "contradicted" if self.contradicted and self.located.by_hand is None else self.answer.state

    def doubts(self, stage: str | None) -> list[str]:
        """Return the answers that contradict a stage: "tag", stages, or "map"; none for a corrected frame."""
        pairs = [] if self.located.by_hand is not None else [(one.one, one.other) for one in self.disagreements]
        return [other if one == stage else one for one, other in pairs if stage in (one, other)]

    @property
    def doubt(self) -> list[str]:
        """The answers that contradict the one of `stage`."""
        return self.doubts(self.stage)

    @property
    def usable(self) -> bool:
        """True if the position is accepted, and either uncontradicted or still believed."""
        return self.state == "accepted" and (not self.doubt or self.sign is True)

    @property
    def columns(self) -> dict[str, str]:
        """The verdict in the columns of a track."""
        if self.located.by_hand is not None:
            return self.columns_of(BY_HAND, self.answer)
        stage = self.stage or next((one for one in reversed(STAGES) if one in self.located.stages), "")
        columns = self.columns_of(stage, self.answer)
        return columns | {"state": self.state, "reason": f"{self.summary}.", "note": self.reason}

    def columns_of(self, stage: str, answer: StageRecord) -> dict[str, str]:
        """Return a stage's own answer in the columns of a track."""
        doubt, checked = self.doubts(stage), ""
        if stage == "registration" and answer.accepted:
            is_checked = answer.agreement is not None and not answer.agreement.unchecked
            checked = "contradicted" if "map" in doubt else "yes" if is_checked else "no"
        reason, note = self.located.by_hand_reason if stage == BY_HAND else answer.reason_and_note
        return {
            "stage": stage,
            "state": answer.state,
            "doubt": ", ".join(doubt),
            "checked_beside_middle": checked,
            "reason": reason,
            "note": note,
        }


def judge(located: LocatedFrame) -> FrameVerdict:
    """Return the verdict on a frame.

    A registration is believed unless its tag or the map away from its middle contradicts it, or, without a tag, the sequence.
    """
    against = disagreements(located)
    registration, sequence, retrieval = (located.stages.get(stage) for stage in reversed(STAGES))
    refusals = [one.sentence for one in (registration, sequence, retrieval) if one and one.state == "refused"]
    stage, sign, but, figure = None, None, "", ""
    if registration is not None and registration.accepted:
        stage, sign = "registration", True
        reason, tag = registration.sentence, located.tag
        reason += "" if tag is None else f" It lies {registration.distance(tag):.1f} m from its GPS tag."
        figure = f", ± {registration.radius or 0:.1f} m {on_what(registration)}"
        doubts = {one.other: one for one in against if one.one == "registration"}
        doubt = doubts.get("tag") or doubts.get("map") or doubts.get("sequence")
        if doubt is not None and (doubt.other != "sequence" or tag is None):
            sign, but, reason = None, f", but {AGAINST[doubt.other]}", doubt.sentence
        else:
            if doubt is not None:  # two of three agree
                reason += f" Its neighbours would place it {doubt.metres:.1f} m from here."
            if registration.agreement is not None and registration.agreement.unchecked:
                figure += ", at least its middle"
    elif sequence is not None and sequence.accepted:
        stage, figure = "sequence", f", ± {sequence.radius or 0:.0f} m on this map"
        reason = sequence.sentence if registration is None else registration.sentence
    elif retrieval is not None and retrieval.x is not None:
        stage, reason = "retrieval", [*refusals, retrieval.sentence][0]
    else:
        sign, reason = False, [*refusals, "No stage has an answer."][0]
    answer = located.by_hand or (StageRecord("refused", reason) if stage is None else located.stages[stage])
    words = DECIDED[stage]
    return FrameVerdict(located, stage, answer, sign, words + but, words + figure + but, reason, against)


def disagreements(located: LocatedFrame) -> list[Disagreement]:
    """Return the contradictions between accepted registration, accepted sequence, tag, and map.

    Two answers contradict each other if their distance exceeds three times the root of the sum of their squared 1-sigma radii. A
    tag's radius is 5 m. The map's error moves registration and sequence alike, so it counts only against the tag. A tag is
    compared with the place below the camera, see `below_camera`. If that is unknown, the shift by an unknown tilt is allowed in
    addition, see `_shift`. A registration contradicts the map if the median of its `MapAgreement` exceeds three times the radius
    on this map of the photo's middle.
    """
    pairs = []
    accepted = {
        stage: answer
        for stage in ("registration", "sequence")
        if (answer := located.stages.get(stage)) is not None and answer.accepted and answer.x is not None
    }
    if len(accepted) == 2:
        one, other = accepted.values()
        metres = one.distance(np.array([other.x, other.y]))
        tilt = _shift(located) if one.camera != other.camera else 0.0
        allowed = SIGMAS * math.hypot(one.own_radius, other.own_radius) + tilt
        pairs.append(Disagreement("registration", "sequence", metres, allowed))
    if located.tag is not None:
        pairs += [Disagreement(stage, "tag", *beside_tag(located, answer)) for stage, answer in accepted.items()]
    if (misfit := map_misfit(located.stages.get("registration"))) is not None:
        pairs.append(misfit)
    return [one for one in pairs if one.metres > one.allowed]


def beside_tag(located: LocatedFrame, answer: StageRecord) -> tuple[float, float]:
    """Return the metres from an answer to the frame's tag, and the allowed metres, see `disagreements`."""
    assert located.tag is not None
    below = below_camera(located.frame, answer)
    tilt = 0.0 if below.camera else _shift(located)
    return below.distance(located.tag), SIGMAS * math.hypot(below.radius or 0.0, TAG_RADIUS) + tilt


def map_misfit(answer: StageRecord | None) -> Disagreement | None:
    """Return the contradiction between a registration and the map away from the photo's middle; None without one."""
    if answer is None or not answer.accepted or answer.agreement is None or answer.middle_on_map is None:
        return None
    metres, allowed = answer.agreement.median, SIGMAS * answer.middle_on_map
    return None if metres is None or metres <= allowed else Disagreement("registration", "map", metres, allowed)


def placed_errors(frames: Sequence[LocatedFrame], verdicts: Sequence[FrameVerdict]) -> Errors | None:
    """Return the errors of the placed photos against the tags of `frames`, corrections ignored; None without any."""
    pairs = zip(frames, verdicts, strict=True)
    known = [(one.tag, answer) for one, verdict in pairs if one.tag is not None and (answer := verdict.placed)]
    rows = [(answer.x - tag[0], answer.y - tag[1], answer.radius) for tag, answer in known]
    return Errors.of(len(rows), rows) if rows else None


def on_what(answer: StageRecord) -> str:
    """Return the reference of an answer's radius: earth if the error of the map's place is known, else this map."""
    return "on earth" if answer.on_earth else "on this map"


def _shift(located: LocatedFrame) -> float:
    """Return the metres between the picture's middle and the place below the camera, by the frame's tilt, else 15 degrees."""
    answer = located.stages.get("registration")
    width = 0.0 if answer is None or answer.width is None else answer.width
    height = located.frame.flying_height or width / 2
    return height * math.tan(math.radians(min(max(TILT, frame_tilt(located.frame)), _MOST_TILT)))
