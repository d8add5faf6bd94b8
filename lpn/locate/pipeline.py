"""The three stages over a whole flight: retrieval, sequence, registration; resumable, and past frames that cannot be read."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from lpn.core import images
from lpn.core.arrays import BoolArray, Float64Array
from lpn.core.errors import DataError, InputError, PictureError
from lpn.core.files import cache_folder
from lpn.core.homography import apply_homography, middle_pixel
from lpn.flights import Flight, Frame, ground_width
from lpn.flights.cameras import rotation
from lpn.locate import continuity, measures
from lpn.locate.audit import TagAudit, audit_tags
from lpn.locate.corrections import Correction
from lpn.locate.ground import MAX_BLOCKS, MapFeatures
from lpn.locate.index_windows import IndexedWindows
from lpn.locate.matchers import Matcher, MatcherName, SiftMatcher, open_matcher
from lpn.locate.registration import (
    Expectation,
    Ground,
    Registration,
    Similarity,
    contested,
    pose,
    register,
    turn_between,
)
from lpn.locate.retrieval import MapRetrieval, frame_identity, heading_is_certain, retrieve
from lpn.locate.sequence import MotionModel, SequenceResult, emissions, fitted, fitted_frames, score_units, smooth
from lpn.locate.tracks import State, TrackPoint
from lpn.maps import Map
from lpn.models.base import Model
from lpn.retrieval import field_metrics

FORMAT = "lpn-locate/7"
STAGES = ("retrieval", "sequence", "registration")
# The stage of a track that has the places of corrected frames.
BY_HAND = "by hand"
Progress = Callable[[str, int, int], None]
# Ratios between the ground widths that are tried where none is known.
_WIDTHS = 1.9
# Frames whose registered widths correct the next one's, and those that stand for it where no height is known.
_RECENT = 7
_LATEST = 3
# Ground widths around a candidate that are searched.
_AROUND = 0.75
# Share of a photo's ground beyond what was searched, above which the search is repeated about the place found.
_BEYOND = 0.05
# Degrees from straight down up to which the camera's place is told, and 1-sigma errors of a gimbal's and an aircraft's tilt.
_MAX_TILT = 15.0
_TILT_ERROR, _AIRCRAFT_TILT_ERROR = 1.5, 5.0
# The map's own 1-sigma error unless it is given: pixels, and the least metres, as tags without ground control leave a map.
_MAP_PIXELS, _MAP_METRES = 3.0, 1.0
# How far a picture's middle may sway with the tilt, as a share of the ground width: 8 degrees at 70 degrees of view.
_SWAY = 0.1
_UNKNOWN = (math.nan, math.nan)
_TOP = 5
# A place is told by windows that overlap it, whose centres lie within this share of a side, and with this probability.
_OVERLAP = 0.75
_CONFIDENCE = 0.98
# Steps of known time between frames that can be read, from which a flight's motion is told.
_LEAST_STEPS = 10
# Standard deviation of a step, as a share of the distance between windows, below which it tells no direction.
_LEAST_STEP = 0.3
# Windows of a frame are kept whose centres lie so far apart, as a share of their side: overlapping ones show one place.
_APART = 0.5
# Seconds from one answer of a registration that goes on to the next.
_PARTIAL_INTERVAL = 3.0


@dataclass(frozen=True)
class LocateOptions:
    """How a flight is located.

    Attributes:
        sequence, register: whether these stages run; retrieval runs with a model. The sequence needs retrieval.
        matcher: of the registration; "auto" is XFeat where it is installed, and SIFT for the photos that XFeat does not place.
        prior: metres around each frame's tag that registration searches; None uses no tag.
        map_error: 1-sigma error of the map's places in metres, along each axis; None takes `default_map_error`.
        sizes: sides of windows in metres; None chooses them from the flight.
        overlap: of neighbouring windows, 0 to below 1.
        centre: whether descriptors are centred by view, and whitened.
        speed: of the motion model, metres a second; None takes the one at which the flight's scores are most probable.
        top: windows that are kept for each frame, of places apart.
    """

    sequence: bool = True
    register: bool = True
    matcher: MatcherName = "auto"
    prior: float | None = None
    map_error: float | None = None
    sizes: tuple[float, ...] | None = None
    overlap: float = 0.75
    centre: bool = True
    speed: float | None = None
    top: int = _TOP

    def __post_init__(self) -> None:
        if self.prior is not None and not 0 < self.prior < math.inf:
            raise InputError(f"The prior is {self.prior:g} m; expected metres above 0.")
        if self.map_error is not None and not 0 <= self.map_error < math.inf:
            raise InputError(f"The map's error is {self.map_error:g} m; expected 0 or more metres.")
        if self.speed is not None and not 0 < self.speed < math.inf:
            raise InputError(f"The speed is {self.speed:g} m/s; expected metres a second above 0.")
        if self.top < 1:
            raise InputError(f"{self.top} windows would be kept for each frame; expected 1 or more.")


class WindowRecord(msgspec.Struct, frozen=True):
    """A ranked window of a frame: its place and side in metres, score, heading, part cosines, and part contributions."""

    x: float
    y: float
    size: float
    score: float
    heading: float
    cosines: list[float]
    shares: list[float]


class StageRecord(msgspec.Struct, frozen=True):
    """One stage's answer for a frame.

    Attributes:
        state: "accepted" if the position may be used, "refused" if not, "not verified" if the stage cannot tell.
        sentence: what was found, or why it was refused.
        x, y: metres east and north in the map's frame: of the camera where `camera`, else of the picture's middle.
        camera: whether the position is the camera's, which needs a known tilt of 15 degrees at most.
        radius: 1-sigma radius in metres; None for the retrieval, which has none.
        heading: of the picture's top in degrees.
        turn: degrees from the heading that the flight tells to `heading`.
        width: metres of ground across the picture.
        inliers: matches that agree.
        homography: from pixels to metres, 9 numbers by rows.
    """

    state: State
    sentence: str
    x: float | None = None
    y: float | None = None
    camera: bool = False
    radius: float | None = None
    heading: float | None = None
    turn: float | None = None
    width: float | None = None
    inliers: int | None = None
    homography: list[float] | None = None

    @property
    def accepted(self) -> bool:
        """True if the position may be used."""
        return self.state == "accepted"

    def distance(self, place: Float64Array) -> float:
        """Return the metres from the position, which must be known, to a place (2,)."""
        assert self.x is not None
        assert self.y is not None
        return math.hypot(self.x - place[0], self.y - place[1])


@dataclass
class LocatedFrame:
    """A frame with the answers of the stages that ran.

    Attributes:
        frame: of the flight.
        tag: its position in metres of the map's frame, (2,); None without a tag.
        stages: answers by stage.
        windows: best windows of the retrieval.
        by_hand: where a person's correction lays the photo; None without one.
    """

    frame: Frame
    tag: Float64Array | None
    stages: dict[str, StageRecord] = field(default_factory=dict)
    windows: list[WindowRecord] = field(default_factory=list)
    by_hand: StageRecord | None = None

    def truth(self, camera: bool) -> Float64Array | None:
        """Return the place of the camera, or that of the picture's middle: by the correction, else the tag; (2,) or None."""
        if self.by_hand is None or (camera and not self.by_hand.camera):
            return self.tag
        if camera:
            return np.array([self.by_hand.x, self.by_hand.y])
        matrix = np.array(self.by_hand.homography).reshape(3, 3)
        return apply_homography(matrix, middle_pixel(self.frame.width, self.frame.height))

    def error(self, stage: str) -> float | None:
        """Return the metres from the truth to a stage's position; None without one of them."""
        answer = self.stages.get(stage)
        if answer is None or answer.x is None or answer.y is None or (truth := self.truth(answer.camera)) is None:
            return None
        return answer.distance(truth)

    @property
    def sentence(self) -> str:
        """Summarise in one line what the stages found."""
        sentences = [f"{name.capitalize()}: {answer.sentence}" for name, answer in self.stages.items()]
        return " ".join(
            sentences if self.by_hand is None else [*sentences, f"{BY_HAND.capitalize()}: {self.by_hand_sentence}"]
        )

    @property
    def by_hand_sentence(self) -> str:
        """Say what a correction changed; "" without one."""
        if self.by_hand is None:
            return ""
        apart = None if self.tag is None else self.by_hand.distance(self.tag)
        sentence = f"{self.by_hand.sentence}{_sentence('The tag lies', apart)}"
        answer, apart = self.stages.get("registration"), self.error("registration")
        if answer is not None and not answer.accepted:
            return f"{sentence} The registration is refused."
        return sentence + _sentence("The registration lies", apart)


@dataclass
class LocatedFlight:
    """A flight over a map, located.

    Attributes:
        flight, town: what was located, and where.
        frames: in the order of the flight.
        audit: of the tags against registered positions; None without registration.
        notes: sentences about the run.
        retrieval: scores of all windows; None without a model.
    """

    flight: Flight
    town: Map
    frames: list[LocatedFrame]
    audit: TagAudit | None
    notes: list[str]
    retrieval: MapRetrieval | None

    @property
    def stages(self) -> list[str]:
        """The stages that ran."""
        return [stage for stage in STAGES if any(stage in located.stages for located in self.frames)]

    def track(self) -> list[TrackPoint]:
        """Return the track's points, stage by stage; a correction takes the place of its frame's registration."""
        return [
            self._point(located, stage, answer)
            for stage in (*self.stages, BY_HAND)
            for located in self.frames
            if (answer := located.by_hand if stage == BY_HAND else located.stages.get(stage)) is not None
            and not (stage == "registration" and located.by_hand is not None)
        ]

    def _point(self, located: LocatedFrame, stage: str, answer: StageRecord) -> TrackPoint:
        latitude = longitude = None
        if answer.x is not None and answer.y is not None:
            latitude, longitude = (float(value) for value in self.town.frame.degrees([(answer.x, answer.y)])[0])
        return TrackPoint(
            located.frame.name,
            stage,
            answer.state,
            located.by_hand_sentence if stage == BY_HAND else answer.sentence,
            located.frame.time,
            latitude,
            longitude,
            answer.camera,
            answer.radius,
            answer.heading,
            located.error(stage),
        )

    def summaries(self, limit: float = 50.0) -> dict[str, measures.ErrorSummary]:
        """Return the errors of each stage against `LocatedFrame.truth`; frames without one are left out, refused positions do
        not count.

        Answers of the retrieval are ordered by their scores, those of the other stages by their radii.
        """
        known = [located for located in self.frames if located.truth(False) is not None]
        found = {}
        for stage in self.stages:
            answers = [located.stages.get(stage) for located in known]
            errors = [
                math.nan if answer is None or answer.state == "refused" or error is None else error
                for answer, error in zip(answers, (located.error(stage) for located in known), strict=True)
            ]
            radii = [math.nan if answer is None or answer.radius is None else answer.radius for answer in answers]
            scores = [located.windows[0].score if located.windows else math.nan for located in known]
            found[stage] = measures.summarise(errors, radii, limit, scores=scores if stage == "retrieval" else None)
        return found

    def field_measures(self) -> dict[str, float]:
        """Return Recall@K, SDM@K of GTA-UAV, Dis@K, and MA@m of the retrieval against `LocatedFrame.truth`.

        A window is a hit if it holds that place. Recall@5 apart is that of the windows that the registration searches: centres of
        two lie at least half of a side apart. A frame that cannot be read is a miss, and left out of Dis@K only. Empty without
        retrieval or such places.
        """
        if self.retrieval is None:
            return {}
        depth = min(10, len(self.retrieval.windows))
        rows: list[Float64Array] = []
        hits: list[BoolArray] = []
        apart: list[bool] = []
        for i, located in enumerate(self.frames):
            if (truth := located.truth(False)) is None:
                continue
            if i in self.retrieval.broken:
                rows.append(np.full(depth, np.inf))
                hits.append(np.zeros(depth, bool))
                apart.append(False)
                continue
            off = self.retrieval.places - truth
            holds = np.all(np.abs(off) <= self.retrieval.sizes[:, None] / 2, axis=1)
            order = self.retrieval.first(i, depth)
            rows.append(np.linalg.norm(off[order], axis=1))
            hits.append(holds[order])
            apart.append(bool(holds[self.retrieval.first(i, _TOP, _APART)].any()))
        if not rows:
            return {}
        distances = np.array(rows)
        read = distances[np.isfinite(distances).all(axis=1)]
        depths = [k for k in (1, 5, 10) if k <= distances.shape[1]]
        found = {f"recall@{k}": field_metrics.recall_at(hits, k) for k in depths}
        found[f"recall@{_TOP} apart"] = 100 * float(np.mean(apart))
        found |= {f"sdm@{k}": float(field_metrics.sdm_gta_uav(distances, k).mean()) for k in depths}
        if len(read):
            found |= {f"dis@{k}": float(field_metrics.distance_at(read, k).mean()) for k in depths}
        return found | {f"ma@{m}": field_metrics.accuracy_within(distances[:, 0], m) for m in (20, 50, 100)}


def locate(
    town: Map,
    flight: Flight,
    model: Model | None = None,
    options: LocateOptions | None = None,
    on_progress: Progress | None = None,
    corrections: Mapping[str, Correction] | None = None,
    indexed: IndexedWindows | None = None,
) -> LocatedFlight:
    """Locate the frames of a flight.

    Registered frames are kept in the user's cache, so a run that was killed goes on where it stopped.

    Args:
        model: for the retrieval; without one, registration searches the whole map, or around the tags with a prior.
        on_progress: called with a stage, the frames (or windows) done, and their number.
        corrections: a person's, by the frame's name. They change no answer of a stage: they are the truth of errors and of the
            audit, and stand in the track in place of registrations.
        indexed: the map's windows, described by the model; without them, the windows that the options tell are described.

    Raises:
        InputError: if no stage is left, a prior is given beside a model, or the model lacks a view.
        DataError: if the flight has no frame.
    """
    options = options or LocateOptions()
    if not flight.frames:
        raise DataError(f"The flight {flight.name} has no frame; give one with pictures.")
    if model is not None and options.prior is not None:
        raise InputError(
            "With a model, registration searches where the model finds it, not around the tag; leave --prior or --model out."
        )
    if model is None and not options.register:
        raise InputError(
            "There is nothing to do without a model and without registration; give --model, or allow --register."
        )
    tags, notes = _tags(town, flight)
    frames = [
        LocatedFrame(frame, None if np.isnan(tag).any() else tag)
        for frame, tag in zip(flight.frames, tags, strict=True)
    ]
    notes += _correct(town, frames, corrections or {})
    if options.prior is not None:
        notes.append(
            f"Registration searched around the tags only (prior {options.prior:g} m), so errors against the tags say less than "
            "those of a search without a prior."
        )
    found = None
    if model is not None:
        found = retrieve(model, town, flight, options.sizes, options.overlap, options.centre, on_progress, indexed)
        notes += found.notes
        if found.broken:
            notes.append(
                f"{len(found.broken)} of {len(frames)} frames cannot be read; the retrieval's measures count them as misses, and "
                "Dis@K leaves them out."
            )
        _ranked(found, frames, options.top)
        if options.sequence:
            notes += _sequenced(found, flight, frames, options)
    located = LocatedFlight(flight, town, frames, None, notes, found)
    return registered(located, model, options, on_progress) if options.register else located


def registered(
    located: LocatedFlight,
    model: Model | None,
    options: LocateOptions | None = None,
    on_progress: Progress | None = None,
    on_partial: Callable[[LocatedFlight], None] | None = None,
) -> LocatedFlight:
    """Register the frames of a flight whose other stages are done, and audit its tags; `located` is not changed.

    Args:
        model, options: those that the flight was located with, so that answers of `locate` are found in the cache.
        on_progress: as for `locate`; an exception that it raises stops the run, and a later one goes on.
        on_partial: called every few seconds with the flight as far as it is registered; the tags are not audited yet.
    """
    options = replace(options or LocateOptions(), register=True)
    map_error = default_map_error(located.town) if options.map_error is None else options.map_error
    options = replace(options, map_error=map_error)
    frames = [replace(frame, stages=dict(frame.stages)) for frame in located.frames]
    published = time.monotonic()

    def report(stage: str, done: int, total: int) -> None:
        nonlocal published
        if on_progress is not None:
            on_progress(stage, done, total)
        if on_partial is not None and done < total and time.monotonic() - published >= _PARTIAL_INTERVAL:
            copies = [replace(frame, stages=dict(frame.stages)) for frame in frames]
            _refuse_jumps(copies[:done], map_error)
            on_partial(replace(located, frames=copies))
            published = time.monotonic()

    notes = _registered(located.town, located.flight, frames, options, model, located.retrieval, report)
    answers = [frame.by_hand or frame.stages["registration"] for frame in frames]
    places = np.array(
        [(a.x, a.y) if a.accepted and a.x is not None else (np.nan, np.nan) for a in answers], np.float64
    ).reshape(-1, 2)
    tags = np.array([_UNKNOWN if frame.tag is None else frame.tag for frame in frames])
    audit = audit_tags(located.flight.times, tags, places, any(a.accepted and not a.camera for a in answers))
    if any(answer.accepted and answer.radius is not None for answer in answers):
        notes.append(f"Radii of registrations hold {map_error:.1f} m for the error of the map itself.")
    return replace(located, frames=frames, audit=audit, notes=[*located.notes, *notes, *_turn_notes(frames)])


def default_map_error(town: Map) -> float:
    """Return the 1-sigma error in metres along each axis that a map's places count with: 3 pixels, and at least 1 m."""
    return max(_MAP_METRES, _MAP_PIXELS * town.resolution)


def _sentence(what: str, metres: float | None) -> str:
    return "" if metres is None else f" {what} {metres:.1f} m from there."


def _correct(town: Map, frames: list[LocatedFrame], corrections: Mapping[str, Correction]) -> list[str]:
    """Enter the corrections of frames, and return sentences about them."""
    left = dict(corrections)
    for located in frames:
        correction = left.get(located.frame.name)
        if correction is None or not np.isfinite(town.frame.xy(*correction.corners.T)).all():
            continue
        del left[located.frame.name]
        frame, size = located.frame, (located.frame.width, located.frame.height)
        matrix = correction.homography(town.frame, *size)
        centre, heading, width = pose(matrix, *size)
        turn = turn_between(frame.heading, heading)
        laid = Registration(
            True, "", BY_HAND, "homography", 0, 0, 0.0, matrix, centre, heading, width, turn, np.zeros((2, 2))
        )
        below = _camera_place(frame, size, laid)
        x, y = (centre if below is None else below[0]).tolist()
        located.by_hand = StageRecord(
            "accepted",
            f"A person laid the photo by hand. {laid.turn_sentence}".rstrip(),
            x,
            y,
            below is not None,
            heading=heading,
            turn=turn,
            width=width,
            homography=matrix.ravel().tolist(),
        )
    notes = []
    if count := sum(located.by_hand is not None for located in frames):
        notes.append(
            f"{count} of {len(frames)} frames are corrected by hand. Their positions are the corrections', and so is the truth "
            "of their errors; --no-corrections leaves them out."
        )
    if left:
        notes.append(
            f"Corrections of frames that this run does not have, or beyond what the map's frame holds, are left out: "
            f"{', '.join(sorted(left))}."
        )
    return notes


def _tags(town: Map, flight: Flight) -> tuple[Float64Array, list[str]]:
    """Return positions of a flight in metres of the map's frame, (N, 2), NaN where none is of use, and sentences about them."""
    total = len(flight.frames)
    tags = town.frame.xy(*flight.degrees.T)
    given = ~np.isnan(flight.degrees).any(axis=1)
    if not np.isfinite(tags[given]).all():  # one position that the projection cannot place makes all of them NaN
        tags = np.concatenate([town.frame.xy([latitude], [longitude]) for latitude, longitude in flight.degrees])
    known = np.isfinite(tags).all(axis=1)
    tags[~known] = np.nan
    notes = []
    if missing := total - int(given.sum()):
        notes.append(f"{missing} of {total} frames have no position, so no error is known for them.")
    if not given.any():
        return tags, notes
    west, south, east, north = town.bounds
    margin = max(east - west, north - south)
    off = np.maximum(np.maximum([west, south] - tags[known], tags[known] - [east, north]), 0).max(axis=1)
    if (off > margin).all():
        middle = (town.frame.latitude, town.frame.longitude)
        nearest = field_metrics.great_circle(flight.degrees[given], np.array(middle)).min() / 1000
        notes.append(
            f"The flight is elsewhere than the map {town.name}: its nearest position is {nearest:.1f} km from the map's middle. "
            "The positions were left out; give the map of this flight, unless its positions are wrong."
        )
        return np.full_like(tags, np.nan), notes
    if outside := int((off > 0).sum()) + int((given & ~known).sum()):
        notes.append(f"{outside} of {total} frames have a position off the map.")
    return tags, notes


def _turn_notes(frames: list[LocatedFrame]) -> Iterator[str]:
    """Yield a sentence about pictures that are turned against their heading."""
    turned = [
        located.frame.name
        for located in frames
        if (answer := located.stages["registration"]).accepted and answer.turn is not None and abs(answer.turn) > 135
    ]
    if turned:
        one = len(turned) == 1
        yield (
            f"{len(turned)} picture{' is' if one else 's are'} turned by about 180 degrees against "
            f"{'its' if one else 'their'} heading: {', '.join(turned)}."
        )


def _ranked(found: MapRetrieval, frames: list[LocatedFrame], k: int) -> None:
    """Enter the answers of the retrieval."""
    for i, located in enumerate(frames):
        if i in found.broken:
            located.stages["retrieval"] = StageRecord("refused", found.broken[i])
            continue
        top = found.top(i, max(k, 2), _APART)
        located.windows = [
            WindowRecord(
                float(found.places[w, 0]),
                float(found.places[w, 1]),
                float(found.sizes[w]),
                float(top.scores[j]),
                float(top.headings[j]),
                [float(value) for value in top.cosines[j]],
                [float(value) for value in top.shares[j]],
            )
            for j, w in enumerate(top.indices[:k])
        ]
        best = located.windows[0]
        turned = "" if len(found.headings[i]) == 1 else f", turned to {best.heading:.0f} degrees"
        margin = _margin(found, i)
        others = (
            "no window lies apart from it"
            if margin is None
            else f"the margin to windows apart from it is {margin:.3f} d²"
        )
        located.stages["retrieval"] = StageRecord(
            "not verified",
            f"The best of {len(found.windows)} windows has the score {best.score:.3f}{turned}; {others}; not verified.",
            best.x,
            best.y,
            heading=best.heading,
        )


def _margin(found: MapRetrieval, frame: int) -> float | None:
    """Return d² of the best window that does not overlap the best one, minus d² of that; None without such a window."""
    scores = found.scores(frame)
    best = int(scores.argmax())
    apart = np.abs(found.places - found.places[best]).max(axis=1) >= (found.sizes + found.sizes[best]) / 2
    return float(2 * (scores[best] - scores[apart].max())) if apart.any() else None


def _smoothed(found: MapRetrieval, flight: Flight, speed: float | None) -> tuple[SequenceResult, MotionModel]:
    """Run the sequence over windows and headings; return it with its motion.

    A frame whose heading is told has this one as its state, as the drone flies along it, and each window counts with the best of
    the turns that are tried. Other frames have all headings that are tried.
    """
    best = np.stack([found.scores(i) for i in range(len(flight.frames))])
    told = [frame.heading for frame in flight.frames]
    headings = [
        np.array([heading] if heading is not None else [math.nan] if i in found.broken else found.headings[i])
        for i, heading in enumerate(told)
    ]
    side = float(np.median(found.sizes))
    step = max(side * (1 - found.overlap), 1.0)
    compared = np.isnan(found.levels)[:, None] | (found.sizes == found.levels[:, None])
    units = score_units(best, MotionModel(speed or MotionModel.speed, step).steps(flight.times), side, compared)

    def scores(i: int) -> Float64Array:
        return units.standardised(i, best[i][:, None] if len(headings[i]) == 1 else found.scores_by_heading(i))

    motion, temperature = fitted(scores, headings, found.places, flight.times, step, speed)
    near = _OVERLAP * side
    return smooth(
        lambda i: emissions(scores(i), temperature), headings, found.places, flight.times, motion, near
    ), motion


def _sequenced(found: MapRetrieval, flight: Flight, frames: list[LocatedFrame], options: LocateOptions) -> list[str]:
    """Enter the answers of the sequence; return sentences about it."""
    side = float(np.median(found.sizes))
    spacing = side * (1 - found.overlap)
    track, motion = _smoothed(found, flight, options.speed)
    for i, located in enumerate(frames):
        radius = float(np.hypot(track.radii[i], spacing / 2))
        state: State = "accepted"
        sentence = track.sentence(i)
        off = float(np.linalg.norm(found.places[track.path[i]] - track.positions[i]))
        if off > _OVERLAP * side:
            sentence += f" The most probable path of the whole flight passes {off:.0f} m from here."
        if i in found.broken:
            state, sentence = "refused", "The frame cannot be read; the position is a guess of its neighbours."
        elif radius > side:
            state = "refused"
            sentence = (
                f"The 1-sigma radius of {radius:.0f} m is larger than a window, whose side is {side:.0f} m. {sentence}"
            )
        elif track.nearby[i] < _CONFIDENCE:
            state = "refused"
            shown = math.floor(100 * track.nearby[i]) / 100  # never rounded up to what is needed
            sentence = (
                f"The frame lies within {_OVERLAP * side:.0f} m of this place with a probability of {shown:.2f}, and "
                f"{_CONFIDENCE:.2f} are needed. {sentence}"
            )
        x, y = (float(value) for value in track.positions[i])
        heading = None if math.isnan(track.headings[i]) else float(track.headings[i])
        located.stages["sequence"] = StageRecord(state, sentence, x, y, radius=radius, heading=heading)
    start, stop = fitted_frames(len(frames))
    read = np.array([i not in found.broken for i in range(start, stop)])
    seconds = np.diff(flight.times[start:stop])
    seconds = seconds[np.isfinite(seconds) & read[1:] & read[:-1]]
    if motion.along or len(seconds) < _LEAST_STEPS or motion.speed * np.median(seconds) < _LEAST_STEP * spacing:
        return []
    return [
        "The scores are more probable where the drone moves in any direction than where it flies along its headings: it flew "
        "sideways, its headings are wrong, or the map is of another place."
    ]


def _registered(
    town: Map,
    flight: Flight,
    frames: list[LocatedFrame],
    options: LocateOptions,
    model: Model | None,
    found: MapRetrieval | None,
    on_progress: Progress | None,
) -> list[str]:
    """Enter the answers of the registration, those of a killed run from its records; return sentences about them."""
    matchers = [open_matcher(options.matcher)]
    if options.matcher == "auto" and matchers[0].name != SiftMatcher.name:
        matchers.append(SiftMatcher())
    features = [MapFeatures(town, matcher) for matcher in matchers]
    # The limit of frames is not part of the key, as a frame's answer depends on those before it only.
    names = [matcher.name for matcher in matchers]
    searched = replace(options, top=_TOP, map_error=None)
    side = None if found is None else float(np.median(found.sizes))
    key = [FORMAT, town.digest(), names, asdict(searched), model and model.fingerprint, side]
    records = _Records(cache_folder() / "locate" / "registration" / _digest([*key, flight.name]))
    widths: list[float] = []
    ratios: list[float] = []
    trail = _digest(key)
    for i, located in enumerate(frames):
        # An answer depends on the frames before it, whose widths it takes over.
        trail = _digest([trail, frame_identity(located.frame), _plain(located.frame), _candidates(located, options)])
        answer = records.get(trail)
        if answer is None:
            answer = _register_frame(town, features, located, options, widths, ratios, found)
            records.append(trail, answer)
        located.stages["registration"] = _with_map_error(answer, options.map_error or 0.0)
        if answer.accepted and answer.width is not None:
            widths.append(answer.width)
            if (expected := ground_width(located.frame)) is not None:
                ratios.append(answer.width / expected)
        if on_progress is not None:
            on_progress("registration", i + 1, len(frames))
    return _refuse_jumps(frames, options.map_error or 0.0)


def _with_map_error(answer: StageRecord, map_error: float) -> StageRecord:
    """Add the map's error to an answer's radius, and tell the radius of an accepted one."""
    if answer.radius is None:
        return answer
    radius = math.hypot(answer.radius, map_error)
    sentence = answer.sentence
    if answer.accepted:
        sentence += f" The 1-sigma radius of the {'camera' if answer.camera else 'picture'}'s "
        sentence += f"{'place' if answer.camera else 'middle'} is {radius:.1f} m."
    return msgspec.structs.replace(answer, radius=radius, sentence=sentence)


def _refuse_jumps(frames: list[LocatedFrame], map_error: float) -> list[str]:
    """Refuse registrations that the drone cannot have flown to and back from, unless they are many; return sentences about it.

    Cameras and pictures' middles are two tracks. The map's error moves neighbours alike, so it is taken out of their radii.
    """
    notes = []
    for of_camera in (True, False):
        timed = [
            (located, answer)
            for located in frames
            if (answer := located.stages["registration"]).accepted
            and answer.camera == of_camera
            and answer.radius is not None
            and located.frame.time is not None
        ]
        times = np.array([located.frame.time for located, _ in timed], np.float64)
        places = np.array([(answer.x, answer.y) for _, answer in timed], np.float64).reshape(-1, 2)
        sway = 0.0 if of_camera else _SWAY
        own = np.array([answer.radius for _, answer in timed], np.float64)
        widths = np.array([answer.width or 0.0 for _, answer in timed])
        radii = np.sqrt(np.maximum(own**2 - map_error**2, 0) + (sway * widths) ** 2)
        tags = np.array([_UNKNOWN if located.tag is None else located.tag for located, _ in timed]).reshape(-1, 2)
        if (speeds := continuity.top_speeds(times, places, tags)) is None:
            continue
        jumps = np.flatnonzero(continuity.jumps(times, places, radii, speeds))
        if len(jumps) > continuity.MOST * len(timed):
            notes.append(
                f"{len(jumps)} of {len(timed)} registrations lie where the drone would have had to be faster than it flies to "
                "get there and back. These are too many to tell which of all are wrong, so none of them was refused; check "
                "the track."
            )
            continue
        for i in jumps:
            located, answer = timed[i]
            sentence = (
                f"The photo fits the map here, but the drone flies up to {speeds[i - 1 : i + 1].max():.0f} m/s and would have "
                "had to be faster to get here and back: it may be an equal building."
            )
            located.stages["registration"] = msgspec.structs.replace(answer, state="refused", sentence=sentence)
    return notes


def _candidates(located: LocatedFrame, options: LocateOptions) -> list[list[float]] | None:
    """Return places (K, 2) about which a frame is searched; None for the whole map."""
    if (answer := located.stages.get("sequence")) is not None and answer.x is not None and answer.y is not None:
        return [[answer.x, answer.y]] + [[window.x, window.y] for window in located.windows[:2]]
    if located.windows:
        return [[window.x, window.y] for window in located.windows]
    if options.prior is not None and located.tag is not None:
        return [[float(located.tag[0]), float(located.tag[1])]]
    return None


def _register_frame(
    town: Map,
    features: Sequence[MapFeatures],
    located: LocatedFrame,
    options: LocateOptions,
    widths: list[float],
    ratios: list[float],
    found: MapRetrieval | None,
) -> StageRecord:
    """Register one frame, and describe the answer in a sentence."""
    frame = located.frame
    try:
        photo = images.load_picture(frame.file)
    except PictureError as error:
        return StageRecord("refused", str(error))
    places = _candidates(located, options)
    if options.prior is not None and located.tag is None and found is None:
        return StageRecord(
            "refused", "The frame has no position to search around; leave --prior out to search the whole map."
        )
    centres = None if places is None else np.array(places)
    known_width = ground_width(frame)
    if known_width is not None and ratios:
        known_width *= float(np.median(ratios[-_RECENT:]))
    best: Registration | None = None
    searched = 0.0
    for again in (False, True):
        best = None
        searches: dict[float, dict[str, tuple[Matcher, Ground]]] = {}
        rivals: list[Similarity] = []
        for kind, (width, known) in product(features, list(_tried_widths(town, known_width, widths))):
            reach = _AROUND * width + (options.prior or 0.0 if found is None else 0.5 * float(np.median(found.sizes)))
            ground = kind.around(centres, reach, width)
            if ground is None:
                return StageRecord(
                    "refused",
                    f"More than {MAX_BLOCKS} blocks of {town.name} would have to be searched for this photo; give --model, or "
                    "--prior with the metres around the tag.",
                )
            expected = Expectation(width if known else None, frame.heading, heading_is_certain(frame))
            answer = register(kind.matcher, photo, ground, expected, [width], town.bounds)
            alike = searches.setdefault(width, {})
            alike[answer.matcher] = kind.matcher, ground
            # A search that finds one of several equal places must not undo that an earlier one found more.
            if answer.accepted and rivals:
                answer = contested(answer, photo, list(alike.values()), rivals)
            rivals += answer.places
            if best is None or (answer.accepted, answer.support) > (best.accepted, best.support):
                best, searched = answer, reach
            if answer.accepted:
                break
        assert best is not None
        if again or found is None or centres is None or not _reaches_out(best, photo.shape[1::-1], centres, searched):
            break
        # A wrong place at the border of what was searched has no rival, as the true one beyond was not seen.
        assert best.centre is not None
        centres = best.centre[None]
    assert best is not None
    return _record(frame, photo.shape[1::-1], best, searched if found is None and centres is not None else None)


def _reaches_out(answer: Registration, size: tuple[int, int], centres: Float64Array, reach: float) -> bool:
    """Return whether an accepted photo of this size lies beyond squares of side 2 `reach` about points (K, 2)."""
    if not answer.accepted:
        return False
    pixels = np.stack(np.meshgrid(*(np.linspace(0, side - 1, 9) for side in size)), axis=-1).reshape(-1, 2)
    off = np.abs(answer.to_metres(pixels)[:, None] - centres).max(axis=2).min(axis=1)
    return bool((off > reach).mean() > _BEYOND)


def _tried_widths(town: Map, known_width: float | None, widths: list[float]) -> Iterator[tuple[float, bool]]:
    """Yield ground widths to try, and whether each is known: that of the height, that of the frames before, or a range."""
    if known_width is not None:
        yield known_width, True
        # The height may be that above take-off, and the correction by the frames before may be wrong.
        yield known_width, False
        return
    if widths:  # a flight that climbs or sinks moves away from it, so it is no more than a start
        yield float(np.median(widths[-_LATEST:])), False
    largest = 0.8 * min(town.bounds[2] - town.bounds[0], town.bounds[3] - town.bounds[1])
    width = min(largest, 400.0)
    for _ in range(4):
        yield width / 1.3, False
        width /= _WIDTHS


def _record(frame: Frame, size: tuple[int, int], found: Registration, reach: float | None) -> StageRecord:
    """Return the record of a registration; `reach` is half the side of the square about the tag that was searched, if one was."""
    how = ""
    if reach is not None:
        how = f" The search used the tag: it saw the map in a square of {2 * reach:.0f} m about it."
    if found.centre is None or found.homography is None:
        return StageRecord("refused", found.reason + how)
    place, radius = found.centre, found.radius
    if (below := _camera_place(frame, size, found)) is not None:
        place, radius = below
    sentence = found.reason
    if found.accepted:
        sentence = (
            f"{found.inliers} matches of {found.matcher} agree on a {found.model}. {found.turn_sentence}".rstrip()
        )
    return StageRecord(
        "accepted" if found.accepted else "refused",
        sentence + how,
        float(place[0]),
        float(place[1]),
        below is not None,
        radius,
        found.heading,
        found.turn,
        found.width,
        found.inliers,
        [float(value) for value in found.homography.ravel()],
    )


def _camera_place(frame: Frame, size: tuple[int, int], found: Registration) -> tuple[Float64Array, float] | None:
    """Return the place below the camera in metres, (2,), and its 1-sigma radius.

    Matches that lie evenly over the photo bound its middle best. A linear model's variance at (x, y) is 1 + 12 (x / w)^2 +
    12 (y / h)^2 times that at the middle of w x h pixels. A tilt that is told wrongly moves the place by the height times its
    tangent: 1.5 degrees of a gimbal, 5 of an aircraft, which banks while the photo's record waits.

    Returns:
        None if the tilt is unknown or above `_MAX_TILT`, or the model bends too much on the way from the middle.
    """
    nadir = nadir_pixel(frame, size)
    if nadir is None or found.radius is None or found.width is None or found.homography is None:
        return None
    down = float(rotation(0.0, frame.pitch or 0.0, frame.roll or 0.0)[2, 2])
    if down < math.cos(math.radians(_MAX_TILT)):
        return None
    middle = middle_pixel(*size)
    moved = np.array(nadir) - middle
    if found.turned:  # the file was turned after it was taken
        moved = -moved
    depth, there = (float(found.homography[2] @ (*pixel, 1.0)) for pixel in (middle, middle + moved))
    if not 0.5 < there / depth < 2:
        return None
    height = down * found.width / 2 / math.tan(math.radians(frame.fov or 0.0) / 2)
    spread = found.radius * math.sqrt(1 + 12 * float(((moved / size) ** 2).sum()))
    error = _AIRCRAFT_TILT_ERROR if frame.heading_source == "aircraft" else _TILT_ERROR
    radius = math.hypot(spread, height * math.tan(math.radians(error)))
    return found.to_metres((middle + moved)[None])[0], radius


def nadir_pixel(frame: Frame, size: tuple[int, int]) -> tuple[float, float] | None:
    """Return the pixel (column, row) of the point below the camera, which may lie outside of the picture.

    Args:
        size: width and height of the picture in pixels.

    Returns:
        None if pitch, roll, or field of view is unknown, or the camera looks less than 30 degrees down.
    """
    if frame.pitch is None or frame.roll is None or frame.fov is None:
        return None
    top, right, axis = rotation(0.0, frame.pitch, frame.roll)[2]
    if axis < 0.5:
        return None
    focal = size[0] / 2 / math.tan(math.radians(frame.fov) / 2)
    return (size[0] - 1) / 2 + focal * right / axis, (size[1] - 1) / 2 - focal * top / axis


class _Records:
    """Answers of frames in a file of lines, appended one by one; a line that a kill cut short is left out."""

    def __init__(self, file: Path) -> None:
        self._file = file.with_suffix(".jsonl")
        self._found: dict[str, StageRecord] = {}
        try:
            lines = self._file.read_bytes().splitlines()
        except OSError:
            return
        for line in lines:
            try:
                trail, answer = msgspec.json.decode(line, type=tuple[str, StageRecord])
            except (msgspec.MsgspecError, ValueError):
                continue
            self._found[trail] = answer

    def get(self, trail: str) -> StageRecord | None:
        return self._found.get(trail)

    def append(self, trail: str, answer: StageRecord) -> None:
        self._file.parent.mkdir(parents=True, exist_ok=True)
        with self._file.open("ab") as file:
            # A line that was cut short must not swallow this one.
            file.write(b"\n" + msgspec.json.encode((trail, answer)) + b"\n")


def _plain(frame: Frame) -> dict[str, Any]:
    return {key: value for key, value in asdict(frame).items() if key != "file"}


def _digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:24]
