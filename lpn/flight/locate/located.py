"""The answers of the stages for each frame of a flight, their errors, and their track."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import msgspec
import numpy as np

from lpn.core.arrays import BoolArray, Float64Array
from lpn.core.homography import apply_homography, middle_pixel
from lpn.datasets.rendered import is_rendered_flight
from lpn.flight.files import Flight, Frame
from lpn.flight.locate.agreement import MapAgreement, MatchedDetails
from lpn.flight.locate.audit import UNKNOWN, TagAudit, audit_tags, corrected_tags
from lpn.flight.locate.camera_pose import CameraPose
from lpn.flight.locate.errors import CONFIRMED_SHARE, Errors
from lpn.flight.locate.retrieval import MapRetrieval, WindowRecord
from lpn.flight.locate.words import Code, Reason
from lpn.flight.maps import Map
from lpn.retrieval import field_metrics

STAGES = ("retrieval", "sequence", "registration")
# The stage of corrected frames in a track.
BY_HAND = "by hand"
# "not verified" is the best guess of the retrieval, which no check against the picture has confirmed.
State = Literal["accepted", "refused", "not verified"]
# "contradicted" is an accepted position too far from the frame's tag, or its neighbours' answer, for their errors.
TrackState = State | Literal["contradicted"]
# The truth by which a photo's ranking is graded.
Judge = Literal["its GPS tag", "its GPS tag without its lag", "its details"]


class StageRecord(msgspec.Struct, frozen=True, omit_defaults=True):
    """One stage's answer for a frame.

    Attributes:
        state: "accepted" if the position may be used, "refused" if not, "not verified" if the stage cannot tell.
        finding: the stage's finding in words; with `code`, a description of the refused place.
        x, y: metres east and north in the map's frame: of the camera if `camera`, else of the picture's middle.
        camera: whether the position is the camera's, which needs a pose or a known tilt of at most 15 degrees (60 in live
            flights).
        radius: 1-sigma radius in metres; None for the retrieval.
        heading: of the picture's top in degrees.
        turn: `heading` minus the heading in the flight's files, in degrees.
        width: metres of ground across the picture.
        inliers: number of matches that agree.
        homography: from pixels to metres, 9 numbers by rows.
        pose: of the camera; None if the matches do not determine it.
        map_error: 1-sigma error of the map in metres, included in the radius; it moves all places on the map alike.
        place_error: the part of `map_error` that is the error of the map's place on earth; 0 if unknown.
        agreement: of places away from the photo's middle with the map; None before the comparison.
        middle_radius: 1-sigma radius in metres of the ground at the photo's middle, map's error included, if the position is the
            camera's; None if unknown.
        details: the `inliers` of a registration, with a sample of them; None for other answers.
        code: the reason of a refusal, see `lpn.flight.locate.words`; "" if `finding` has it.
        numbers: the figures in the words of that reason.
        alone: whether the photo's details suffice without a flight, see `lpn.flight.locate.registration.proven`.
    """

    state: State
    finding: str = msgspec.field(name="sentence")
    x: float | None = None
    y: float | None = None
    camera: bool = False
    radius: float | None = None
    heading: float | None = None
    turn: float | None = None
    width: float | None = None
    inliers: int | None = None
    homography: list[float] | None = None
    pose: CameraPose | None = None
    map_error: float = 0.0
    place_error: float = 0.0
    agreement: MapAgreement | None = None
    middle_radius: float | None = None
    details: MatchedDetails | None = None
    code: Code = ""
    numbers: Mapping[str, float] = msgspec.field(default_factory=dict)
    alone: bool = False

    @property
    def sentence(self) -> str:
        """The finding, or the reason of the refusal."""
        return " ".join(filter(None, self.reason_and_note))

    @property
    def reason_and_note(self) -> tuple[str, str]:
        """The sentence in two parts: a short reason, and the rest."""
        if self.code == "unread":
            return self.finding, ""
        if why := Reason(self.code, self.numbers).sentence:
            return why, self.finding
        first, end, rest = self.finding.partition(". ")
        return (f"{first}.", rest) if end else (self.finding, "")

    @property
    def unverified(self) -> bool:
        """True if the only reason of its refusal is the lack of evidence that the map is of this place."""
        return self.code in ("unproven", "few")

    def refused(self, code: Code, **numbers: float) -> StageRecord:
        """Return a refused copy of the answer."""
        return msgspec.structs.replace(self, state="refused", code=code, numbers=numbers)

    @property
    def on_earth(self) -> bool:
        """True if the radius includes the known error of the map's place on earth."""
        return self.place_error > 0

    @property
    def radius_on_map(self) -> float | None:
        """The radius in metres without the error of the map's place on earth; None without a radius."""
        return None if self.radius is None else math.sqrt(max(self.radius**2 - self.place_error**2, 0.0))

    @property
    def middle_on_map(self) -> float | None:
        """`radius_on_map` of the ground at the photo's middle, which does not depend on the tilt."""
        radius = self.radius if self.middle_radius is None else self.middle_radius
        return None if radius is None else math.sqrt(max(radius**2 - self.place_error**2, 0.0))

    @property
    def own_radius(self) -> float:
        """The radius in metres without the map's error, which cancels between places on one map; 0 without a radius."""
        return math.sqrt(max((self.radius or 0.0) ** 2 - self.map_error**2, 0.0))

    @property
    def accepted(self) -> bool:
        """True if the position may be used."""
        return self.state == "accepted"

    @property
    def by_pose(self) -> bool:
        """True if the position and its radius come from the pose."""
        return self.pose is not None and self.camera and (self.x, self.y) == (self.pose.east, self.pose.north)

    @property
    def place(self) -> Float64Array | None:
        """The position in metres of the map's frame, (2,); None without one."""
        return None if self.x is None or self.y is None else np.array([self.x, self.y])

    @property
    def matrix(self) -> Float64Array | None:
        """The homography of an accepted answer, (3, 3); None without one."""
        return np.array(self.homography).reshape(3, 3) if self.accepted and self.homography is not None else None

    def distance(self, place: Float64Array) -> float:
        """Return the metres from the known position to a place (2,)."""
        assert self.place is not None
        return math.dist(self.place, place)


@dataclass
class LocatedFrame:
    """A frame with the answers of the stages that ran.

    Attributes:
        frame: of the flight.
        tag: its tag in metres of the map's frame, (2,); None without one.
        stages: answers by stage.
        windows: best windows of the retrieval.
        by_hand: the photo's place by a person's correction; None without one.
    """

    frame: Frame
    tag: Float64Array | None
    stages: dict[str, StageRecord] = field(default_factory=dict)
    windows: list[WindowRecord] = field(default_factory=list)
    by_hand: StageRecord | None = None

    def truth(self, camera: bool) -> Float64Array | None:
        """Return the true place of the camera or the picture's middle, (2,): the correction, else the tag, else None."""
        if self.by_hand is None or (camera and not self.by_hand.camera):
            return self.tag
        return self.by_hand.place if camera else self.middle(self.by_hand)

    def searched_places(self, around_tag: bool) -> Float64Array | None:
        """Return the places (K, 2) about which the registration searches; None for the whole map.

        They are the sequence's answer and the two best windows, else all windows.

        Args:
            around_tag: whether to search about the tag if no earlier stage has a place.
        """
        windows = [(window.x, window.y) for window in self.windows]
        answer = self.stages.get("sequence")
        if answer is not None and answer.x is not None and answer.y is not None:
            return np.array([(answer.x, answer.y), *windows[:2]])
        if windows:
            return np.array(windows)
        return self.tag[None] if around_tag and self.tag is not None else None

    def middle(self, answer: StageRecord) -> Float64Array:
        """Return the ground at the picture's middle, (2,), by the homography of an answer."""
        matrix = np.array(answer.homography).reshape(3, 3)
        return apply_homography(matrix, middle_pixel(self.frame.width, self.frame.height))

    def error(self, of: str | StageRecord) -> float | None:
        """Return the metres from the truth to the position of an answer, or of a stage; None without one of them."""
        answer = self.stages.get(of) if isinstance(of, str) else of
        off = None if answer is None else self.offset(answer)
        return None if off is None else math.hypot(*off)

    def offset(self, answer: StageRecord) -> tuple[float, float] | None:
        """Return the metres east and north from the truth to an answer's position; None without one of them."""
        truth = self.truth(answer.camera)
        if answer.x is None or answer.y is None or truth is None:
            return None
        return answer.x - float(truth[0]), answer.y - float(truth[1])

    @property
    def laid(self) -> Float64Array | None:
        """The homography of the correction by hand, else of an accepted registration, (3, 3); None without both."""
        answer = self.by_hand or self.stages.get("registration")
        return None if answer is None else answer.matrix

    @property
    def sentence(self) -> str:
        """Summarise the findings of the stages in one line."""
        sentences = [f"{name.capitalize()}: {answer.sentence}" for name, answer in self.stages.items()]
        by_hand = [] if self.by_hand is None else [f"{BY_HAND.capitalize()}:", *self.by_hand_reason]
        return " ".join(filter(None, [*sentences, *by_hand]))

    @property
    def by_hand_reason(self) -> tuple[str, str]:
        """The reason of a correction by hand, and a note on the distance to the answers; empty without a correction."""
        if self.by_hand is None:
            return "", ""
        reason, note = self.by_hand.reason_and_note
        answer, error = self.stages.get("registration"), self.error("registration")
        if self.tag is not None:
            note += f" The GPS tag lies {self.by_hand.distance(self.tag):.1f} m from there."
        if answer is not None and not answer.accepted:
            note += " The registration is refused."
        elif error is not None:
            note += f" The registration lies {error:.1f} m from there."
        return reason, note.strip()


def tag_positions(frames: Iterable[LocatedFrame]) -> Float64Array:
    """Return the frames' tags in metres, (N, 2); NaN rows for frames without one."""
    return np.array([UNKNOWN if frame.tag is None else frame.tag for frame in frames], np.float64).reshape(-1, 2)


@dataclass(eq=False)
class LocatedFlight:
    """A flight over a map, located.

    Attributes:
        flight, basemap: the flight, and its map.
        frames: in the order of the flight.
        audit: of the tags against registered positions; None without registration.
        notes: sentences about the run.
        retrieval: scores of all windows; None without a model.
        tags_without_lag: tags in metres without the audit's constant lag, (N, 2), NaN where unknown; None without a lag.
        map_error: 1-sigma error of the map in metres along each axis in the radii of registrations; None without registrations.
        place_error: the part of `map_error` that is the error of the map's place on earth, see `Map.place_error`.
        tags_away: metres from the map's edge to the nearest tag if all tags lie far off the map and were left out, else None.
        shipped: registrations that ship with the flight, by the frame's name, see `lpn.flight.locate.shipped`.
        prior: metres about each tag that registration searched; None if the search used no tag.
    """

    flight: Flight
    basemap: Map
    frames: list[LocatedFrame]
    audit: TagAudit | None
    notes: list[str]
    retrieval: MapRetrieval | None
    shipped: Mapping[str, StageRecord] = field(default_factory=dict)
    tags_without_lag: Float64Array | None = None
    map_error: float | None = None
    place_error: float = 0.0
    tags_away: float | None = None
    prior: float | None = None

    @property
    def stages(self) -> list[str]:
        """The stages that ran."""
        return [stage for stage in STAGES if any(stage in located.stages for located in self.frames)]

    @cached_property
    def rendered(self) -> bool:
        """True if its photos are of a rendered world, whose coordinates are of no real place."""
        return bool(self.frames) and is_rendered_flight(self.frames[0].frame.file.parent)

    @cached_property
    def late_tags(self) -> TagAudit | None:
        """The audit of the tags against shipped registrations; None unless these show a constant lag."""
        answers = [self.shipped.get(located.frame.name) for located in self.frames]
        places = np.array([UNKNOWN if a is None or not a.accepted or a.x is None else (a.x, a.y) for a in answers])
        audit = audit_tags(self.flight.times, tag_positions(self.frames), places.astype(np.float64), middles=True)
        return audit if audit.has_lag else None

    def judge_of(self, frame: int) -> Judge:
        """Return the truth by which a photo's ranking is graded, see `photographed`."""
        if self.late_tags is None:
            return "its GPS tag"
        return "its GPS tag without its lag" if self._shipped_middle(self.frames[frame]) is None else "its details"

    @cached_property
    def photographed(self) -> list[Float64Array | None]:
        """The place of each photo's middle, (2,), by which its ranking is graded; None where unknown.

        It is the tag, unless the tags are late (`late_tags`). Then it is the shipped registration, or without one the tag without
        the lag.
        """
        if (audit := self.late_tags) is None:
            return [located.tag for located in self.frames]
        moved = _known(corrected_tags(self.flight.times, tag_positions(self.frames), audit.lag))
        middles = map(self._shipped_middle, self.frames)
        return [tag if middle is None else middle for tag, middle in zip(moved, middles, strict=True)]

    def _shipped_middle(self, located: LocatedFrame) -> Float64Array | None:
        answer = self.shipped.get(located.frame.name)
        return None if answer is None or answer.matrix is None else located.middle(answer)

    def without_lag(self) -> LocatedFlight:
        """Return the flight with the tags of `tags_without_lag`; the flight itself without these."""
        if self.tags_without_lag is None:
            return self
        pairs = zip(self.frames, _known(self.tags_without_lag), strict=True)
        return replace(self, frames=[replace(located, tag=tag) for located, tag in pairs], tags_without_lag=None)

    def errors(self) -> dict[str, Errors]:
        """Return the errors of each stage against `LocatedFrame.truth`; refused positions do not count."""
        known = [located for located in self.frames if located.truth(False) is not None]
        return {
            stage: Errors.of(
                len(known),
                [
                    (*off, answer.radius)
                    for located in known
                    if (answer := located.stages.get(stage)) is not None and answer.state != "refused"
                    if (off := located.offset(answer)) is not None
                ],
            )
            for stage in self.stages
        }

    @cached_property
    def radii_confirmed(self) -> dict[str, bool]:
        """Whether tags confirm the radii of each stage: at least 90 % of the errors are within three radii.

        A search with a prior finds nothing far from the tags, so tags can refute its radii, but not confirm them.
        """
        checked = {stage: one.calibration for stage, one in self.errors().items() if one.calibration}
        confirmed = {stage: shares[3] >= CONFIRMED_SHARE for stage, shares in checked.items()}
        return confirmed if self.prior is None else {stage: False for stage, held in confirmed.items() if not held}

    def field_measures(self) -> dict[str, float]:
        """Return Recall@K, SDM@K of GTA-UAV, Dis@K, and MA@m of the retrieval against `LocatedFrame.truth`.

        A window is a hit if it holds the true place. An unreadable frame is a miss, and left out of Dis@K only. Empty without
        retrieval or truths.
        """
        if self.retrieval is None:
            return {}
        gallery = self.retrieval.gallery
        depth = min(10, len(gallery.windows))
        rows: list[Float64Array] = []
        hits: list[BoolArray] = []
        for i, located in enumerate(self.frames):
            if (truth := located.truth(False)) is None:
                continue
            off = np.full(gallery.places.shape, np.inf)
            if i not in self.retrieval.broken:
                off = gallery.places - truth
            holds = np.all(np.abs(off) <= gallery.sizes[:, None] / 2, axis=1)
            order = self.retrieval.first(i, depth)
            rows.append(np.linalg.norm(off[order], axis=1))
            hits.append(holds[order])
        if not rows:
            return {}
        distances = np.array(rows)
        read = distances[np.isfinite(distances).all(axis=1)]
        depths = [k for k in (1, 5, 10) if k <= depth]
        figures = {f"recall@{k}": field_metrics.recall_at(hits, k) for k in depths}
        for k in depths:
            figures[f"sdm@{k}"] = float(field_metrics.sdm(distances, k, field_metrics.GTA_UAV_DECAY).mean())
        for k in depths if len(read) else ():
            figures[f"dis@{k}"] = float(field_metrics.distance_at(read, k).mean())
        return figures | {f"ma@{m}": field_metrics.accuracy_within(distances[:, 0], m) for m in (20, 50, 100)}


def _known(places: Float64Array) -> list[Float64Array | None]:
    """Return the rows of places (N, 2); None for rows with NaN."""
    return [None if np.isnan(place).any() else place for place in places]
