"""One frame of a flight that goes on: its windows ranked, the forward half of the sequence, and registration near its prediction.

The model of `lpn.flight.locate.sequence` runs forward only: a frame's answer depends on frames before it. Differences from a
flight that is whole are these. Descriptors are centred by the mean of the frames so far, from 20 distinct ones on. Frames
that follow each other quickly show nearly the same ground, so that their scores count less: by the share of the distance
between two windows that the drone flies meanwhile. An accepted registration is evidence for the next frame's place, too.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np

from lpn.core.arrays import BoolArray, Float32Array, Float64Array, UInt8Array
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.numbers import SIGMA
from lpn.core.progress import Listener, listening
from lpn.core.views import View
from lpn.flight.files.base import Frame
from lpn.flight.files.cameras import ground_width
from lpn.flight.files.cut import CUT, cut_size, cut_square
from lpn.flight.locate.belief import map_misfit
from lpn.flight.locate.camera_place import below_camera
from lpn.flight.locate.continuity import NEW_HEADING, are_alike, other_turn
from lpn.flight.locate.ground import MapFeatures
from lpn.flight.locate.located import APART, LocatedFrame, StageRecord, State, WindowRecord
from lpn.flight.locate.map_proof import ONE_VIEW
from lpn.flight.locate.matchers import MatcherName, open_matcher
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.ranked_stages import AGREEING, CONFIDENCE, EVIDENCE, OVERLAP, chance_to_agree
from lpn.flight.locate.registered_stage import PhotoSearch, compared, register_photo, turned_away, with_map_error
from lpn.flight.locate.retrieval import (
    ALIKE,
    MIN_DISTINCT,
    described_windows,
    heading_is_certain,
    pyramid_sizes,
    tried_headings,
    whitening_of,
)
from lpn.flight.locate.sequence import PRIOR_FRAMES, ForwardFilter, MotionModel, emissions
from lpn.flight.maps import Map, Window
from lpn.models.base import Model, normalise, whitened

# Windows that are compared at most, unless their sides are given: a frame taken on the ground would make millions.
_MOST_WINDOWS = 200_000
# Distinct frames whose descriptors are kept to centre by, and the frames whose scores wait until the drone is elsewhere.
_KEPT, _PENDING = 320, 64
# Registrations whose widths and turns correct the next frame's, and those after which these corrections are believed.
_RECENT, _TURNS = 7, 3
# Registrations in a row that agree with each other, after which they count although they contradict those before.
_NEW_TRACK = 3
# Speeds of the motion model that a drone does not exceed.
_MOST_SPEEDS = 3.0
# Probability that an accepted registration is false, for the belief that it is weighed with.
_FALSE = 0.05
# Bounds of the log odds that the map is of this place: they may turn within some frames.
_ODDS = (-8.0, 12.0)
# Ratio of one side of windows to the next where the first frame tells it.
_GRID = 1.15
# A step of more seconds is a jump of the clock.
_LONGEST_STEP = 3600.0
# Scores of an aircraft's heading count before others, see `lpn.flight.locate.retrieval`.
_STANDARD_SPEED = 10.0
_NO_PROOF = "Nothing shows yet that the map is of this place: that takes registrations that agree with the sequence."


@dataclass(frozen=True)
class LiveOptions:
    """How a flight is located while it flies.

    Attributes:
        register: whether frames are laid over the map.
        matcher: of the registration; "auto" is XFeat where it is installed.
        sizes: sides of windows in metres; None takes the ground that the first frame of known height and field of view shows.
        overlap: of neighbouring windows, 0 to below 1.
        speed: of the motion model, metres a second, one standard deviation.
        centre: whether descriptors are centred by view and whitened, once there are enough frames.
        map_error: 1-sigma error of the map's places in metres; None takes `Map.default_error`.
    """

    register: bool = True
    matcher: MatcherName = "auto"
    sizes: tuple[float, ...] | None = None
    overlap: float = 0.75
    speed: float = _STANDARD_SPEED
    centre: bool = True
    map_error: float | None = None

    def __post_init__(self) -> None:
        LocateOptions(map_error=self.map_error, speed=self.speed)  # refuses what is out of range
        if not 0 <= self.overlap < 1:
            raise InputError(f"Windows overlap by {self.overlap:g}; expected 0 or more and below 1.")
        if self.sizes is not None and not all(0 < size < math.inf for size in self.sizes):
            raise InputError("Sides of windows must be metres above 0.")


@dataclass(eq=False)
class _Windows:
    """The windows of the map, their descriptors, (N, n, D), and the filter over them."""

    windows: list[Window]
    raw: Float32Array
    filter: ForwardFilter
    places: Float64Array
    sizes: Float64Array
    side: float
    step: float
    # Sums over the frames of other places of the squares of standardised scores, and their number, by window.
    squares: Float64Array = field(init=False)
    frames: Float64Array = field(init=False)

    def __post_init__(self) -> None:
        self.squares, self.frames = np.zeros(len(self.windows)), np.zeros(len(self.windows))


@dataclass(eq=False)
class _Track:
    """The findings of the frames so far, beside the belief; each list is bounded."""

    time: float | None = None
    odds: float = 0.0
    widths: list[float] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)
    turns: list[float] = field(default_factory=list)
    heading: float | None = None
    # The last accepted registration: place, radius, time; and those since that contradict it.
    last: tuple[float, float, float, float] | None = None
    apart: list[tuple[float, float, float, float]] = field(default_factory=list)
    # The turns, alike, of the registrations in a row that were refused for their turn.
    turned: list[float] = field(default_factory=list)
    # The middle of the photo that counted last as proof of the map.
    counted: Float64Array | None = None

    def add(self, name: str, value: float) -> None:
        """Append a value to one of the lists, which keep the last seven."""
        values: list[float] = getattr(self, name)
        values.append(value)
        del values[:-_RECENT]


class LiveLocator:
    """Locates one frame after another; see the module. Memory does not grow with the flight.

    Args:
        basemap: the map.
        model: ranks its windows.
        options: how.
        on_progress: called while the map's windows are described, once, see `lpn.core.progress.listening`.

    Attributes:
        notes: sentences since they were last taken, see `take_notes`.
    """

    def __init__(
        self, basemap: Map, model: Model, options: LiveOptions | None = None, on_progress: Listener = lambda *_: None
    ) -> None:
        # A frame is one pass of milliseconds, in which further threads save less time than they spin for afterwards.
        self.basemap, self.model = basemap, model.for_parallel_inference()
        self.options = options or LiveOptions()
        model.check_view("satellite")
        self._view: View = "drone" if "drone" in model.views else "satellite"
        self._pixels = max(model.input_size)
        self._on_progress = on_progress
        self._features = [MapFeatures(basemap, open_matcher(self.options.matcher))] if self.options.register else []
        self._map_error = basemap.total_error(self.options.map_error)
        self._ground: _Windows | None = None
        self._tiles = np.zeros((0, 0, 0), np.float32)
        self._kept: deque[Float32Array] = deque(maxlen=_KEPT)
        self._distinct, self._centred_at = 0, 0
        self._mean: Float32Array | None = None
        self._whitening: Float32Array | None = None
        self._pending: deque[tuple[float, Float64Array, BoolArray]] = deque(maxlen=_PENDING)
        self._variance = 0.0
        self._track = _Track()
        # The sequence is sure of a place; the last frame was registered; frames of other ground were spoken of.
        self._sure = self._fresh = self._unfit_said = False
        self._notes: list[str] = []

    def take_notes(self) -> list[str]:
        """Return the sentences since the last call."""
        notes, self._notes = self._notes, []
        return notes

    def prepare(self, sizes: Sequence[float]) -> None:
        """Describe the map's windows of some sides in metres, from the user's cache where they were described before.

        Raises:
            InputError: if no window has data.
        """
        windows = self.basemap.pyramid(sorted(sizes), self.options.overlap)
        if not windows:
            raise InputError(
                f"No window of {min(sizes):.0f} m fits on the map {self.basemap.name}; give smaller ones with --size."
            )
        with listening(self._on_progress):
            raw = described_windows(self.model, self.basemap, windows)
        places = np.array([(window.x, window.y) for window in windows])
        extents = np.array([window.size for window in windows])
        side = float(np.median(extents))
        step = max(side * (1 - self.options.overlap), 1.0)
        motion = MotionModel(self.options.speed, step / 2)
        self._ground = _Windows(windows, raw, ForwardFilter(places, motion), places, extents, side, step)
        self._centre()
        noise = np.random.default_rng(0).integers(0, 255, (256, 256, 3), np.uint8)
        for kind in self._features:  # loading a matcher's network takes seconds, which the first frame has not
            kind.matcher.features(noise, None, 16)

    def locate(self, frame: Frame, photo: UInt8Array) -> LocatedFrame:
        """Locate the next frame.

        Args:
            frame: with heading, height, and time as far as they are known.
            photo: its picture, RGB (H, W, 3).
        """
        ground = self._windows_for(frame)
        tag = None
        if frame.latitude is not None and frame.longitude is not None:
            place = self.basemap.frame.xy([frame.latitude], [frame.longitude])[0]
            tag = place if np.isfinite(place).all() else None
        located = LocatedFrame(frame, tag)
        elapsed = self._elapsed(frame)
        headings = self._headings(frame)
        scores, compared = self._scores(ground, frame, photo, headings)
        self._weigh(ground, scores, compared, elapsed, frame, headings)
        located.stages["sequence"] = answer = self._sequence(ground)
        self._sure = answer.accepted
        self._enter_windows(located, ground, scores, headings)
        if self.options.register:
            self._register(located, ground, photo, frame)
            located.stages["sequence"] = self._sequence(ground)
        if frame.time is not None:
            self._track.time = frame.time
        return located

    def begin(self, frame: Frame) -> bool:
        """Describe the map's windows in the size that a first frame shows; return whether they had to be described."""
        if self._ground is not None:
            return False
        # In few different sizes, so that the next flight finds its windows described.
        sizes = [_GRID ** round(math.log(size, _GRID)) for size in pyramid_sizes(self.basemap, [frame])]
        if self.options.sizes is None:
            west, south, east, north = self.basemap.bounds
            step = min(sizes) * (1 - self.options.overlap)
            if (count := (east - west) * (north - south) / step**2) > _MOST_WINDOWS:
                raise InputError(
                    f"The ground of {min(sizes):.1f} m that the first frame shows makes {count:,.0f} windows of the map, "
                    f"and {_MOST_WINDOWS:,} are compared at most; fly higher, or give sides with --size."
                )
        self.prepare(self.options.sizes or sizes)
        return True

    def _windows_for(self, frame: Frame) -> _Windows:
        """Return the windows, and say once if frames show other ground."""
        self.begin(frame)
        assert self._ground is not None
        cut = cut_size(frame)
        if cut is not None and not self._unfit_said:
            nearest = self._ground.sizes[np.abs(np.log(self._ground.sizes / cut)).argmin()]
            if abs(math.log(nearest / cut)) > math.log(1.5):
                self._unfit_said = True
                self._notes.append(
                    f"Frames show squares of {cut:.0f} m now and are compared with windows of {nearest:.0f} m, so their answers "
                    "are poor; give the sides that the flight shows with --size."
                )
        return self._ground

    def _elapsed(self, frame: Frame) -> float:
        """Return the seconds since the last frame; NaN if they are unknown, or the clock has jumped."""
        if frame.time is None or self._track.time is None:
            return math.nan
        elapsed = frame.time - self._track.time
        if 0 <= elapsed <= _LONGEST_STEP:
            return elapsed
        self._notes.append(
            f"The clock of the pictures has jumped by {elapsed:.1f} s at {printable(frame.name)}; the time of this step counts "
            "as unknown."
        )
        return math.nan

    def _headings(self, frame: Frame) -> list[float]:
        """Return the headings in degrees to try; one if it is certain, or registrations tell how the picture is turned."""
        turns = self._track.turns
        if frame.heading is not None and not heading_is_certain(frame) and len(turns) >= _TURNS:
            return [(frame.heading + float(np.median(turns))) % 360.0]
        return tried_headings(frame)

    def _scores(
        self, ground: _Windows, frame: Frame, photo: UInt8Array, headings: Sequence[float]
    ) -> tuple[Float64Array, BoolArray]:
        """Return the score of each window at each heading, (N, K), and which windows are of the frame's size, (N,)."""
        share = CUT * min(1.0, frame.height / frame.width)
        compared = np.ones(len(ground.windows), bool)
        if (cut := cut_size(frame)) is not None:
            level = ground.sizes[np.abs(np.log(ground.sizes / cut)).argmin()]
            share *= float(level) / cut
            compared = ground.sizes == level
        squares = [cut_square(photo, heading, share, self._pixels) for heading in headings]
        prepared = np.stack([self.model.prepare(square, self._view) for square in squares])
        described = self.model.descriptors(prepared, self._view)
        self._keep(described[0])
        if self._mean is not None:
            described = normalise(whitened(described - self._mean, self._whitening))
        flat = self._tiles.reshape(len(self._tiles), -1)
        return (flat @ described.reshape(len(described), -1).T).astype(np.float64), compared

    def _keep(self, described: Float32Array) -> None:
        """Keep the descriptor of a frame unlike the last one kept; centre anew each time there are twice as many."""
        last = self._kept[-1] if self._kept else None
        if last is not None and float(described.ravel() @ last.ravel()) >= ALIKE:
            return
        self._kept.append(described)
        self._distinct += 1
        if self.options.centre and self._distinct >= max(MIN_DISTINCT, 2 * self._centred_at):
            self._centre()

    def _centre(self) -> None:
        """Subtract the means of windows and of frames so far, and whiten, if there are enough frames."""
        assert self._ground is not None
        self._tiles = self._ground.raw
        if not self.options.centre or self._distinct < MIN_DISTINCT:
            return
        self._centred_at = self._distinct
        frames = np.stack(self._kept)
        self._mean = frames.mean(axis=0)
        of_tiles = self._tiles.mean(axis=0)
        self._whitening = whitening_of(self._tiles - of_tiles, frames - self._mean)
        self._tiles = normalise(whitened(self._tiles - of_tiles, self._whitening))
        # Scores change, and with them what each window usually gets.
        self._ground.squares[:], self._ground.frames[:] = 0, 0
        self._pending.clear()

    def _weigh(
        self,
        ground: _Windows,
        scores: Float64Array,
        compared: BoolArray,
        elapsed: float,
        frame: Frame,
        headings: Sequence[float],
    ) -> None:
        """Move the belief to the frame, and weigh it with the frame's scores."""
        known = frame.heading is not None
        best = scores.max(axis=1)
        values = scores if not known else best[:, None]
        mean, deviation = float(best[compared].mean()), float(best[compared].std())
        scale = 1 / deviation if deviation > 1e-9 else 0.0
        unit = np.sqrt((ground.squares + PRIOR_FRAMES) / (ground.frames + PRIOR_FRAMES))
        standardised = (values - mean) * scale / unit[:, None]
        least = float(standardised[compared].min())
        standardised = np.where(compared[:, None], standardised, least)
        moved = self.options.speed * elapsed
        self._count(ground, np.where(compared, (best - mean) * scale, 0.0) ** 2, compared, moved)
        of_state = np.array([frame.heading if known else 0.0]) if known else np.array(headings, np.float64)
        ground.filter.predict(elapsed, of_state.astype(np.float64))
        weight = 1.0 if math.isnan(moved) else min(1.0, moved / ground.step)
        if weight > 0:
            ground.filter.weigh(weight * emissions(standardised))

    def _count(self, ground: _Windows, squares: Float64Array, compared: BoolArray, moved: float) -> None:
        """Count the squares of scores of frames as soon as the drone is at another place."""
        self._variance += ground.side**2 if math.isnan(moved) else moved**2
        while self._pending and self._variance - self._pending[0][0] >= ground.side**2:
            _, of_frame, counted = self._pending.popleft()
            ground.squares += of_frame
            ground.frames += counted
        self._pending.append((self._variance, squares, compared))

    def _enter_windows(
        self, located: LocatedFrame, ground: _Windows, scores: Float64Array, headings: Sequence[float]
    ) -> None:
        """Enter the two best windows, unless the sequence is sure of a place: then the registration searches there alone."""
        if self._sure:
            return
        best = scores.max(axis=1)
        for i in np.argsort(-best)[:200].tolist():
            x, y = ground.places[i].tolist()
            if all(math.dist((x, y), (other.x, other.y)) >= APART * ground.side for other in located.windows):
                heading = headings[int(scores[i].argmax())]
                located.windows.append(WindowRecord(x, y, float(ground.sizes[i]), float(best[i]), heading, [], []))
            if len(located.windows) == 2:
                break

    def _sequence(self, ground: _Windows) -> StageRecord:
        """Return the answer of the sequence."""
        point = ground.filter.point(OVERLAP * ground.side)
        x, y = point.position.tolist()
        radius = math.hypot(point.radius, ground.step / 2)
        heading = None if math.isnan(point.heading) else point.heading
        state: State = "accepted"
        sentence = "The frames so far agree on this place."
        if radius > ground.side:
            state = "refused"
            sentence = (
                f"Its radius of {radius:.0f} m ({SIGMA}) is larger than a piece of the map, {ground.side:.0f} m wide."
            )
        elif point.nearby < CONFIDENCE:
            state = "refused"
            probability = math.floor(100 * point.nearby) / 100
            sentence = (
                f"The frame lies within {OVERLAP * ground.side:.0f} m of this place with a probability of {probability:.2f}, and "
                f"{CONFIDENCE:.2f} are needed."
            )
        elif self._track.odds < EVIDENCE:
            return StageRecord("refused", _NO_PROOF, x, y, radius=radius, heading=heading, unverified=True)
        return StageRecord(state, sentence, x, y, radius=radius, heading=heading)

    def _register(self, located: LocatedFrame, ground: _Windows, photo: UInt8Array, frame: Frame) -> None:
        """Lay the photo over the map near the prediction, and weigh the belief with where it lies."""
        track = self._track
        options = LocateOptions(matcher=self.options.matcher)
        side = 2 * self.options.speed if self._sure and self._fresh else ground.side
        search = PhotoSearch(
            self.basemap,
            self._features,
            located,
            located.frame.undistorted(photo),
            options,
            track.widths,
            track.ratios,
            side,
            track.heading,
            quick=len(track.ratios) >= _TURNS,
        )
        answer = with_map_error(
            register_photo(search), self._map_error, self.basemap.place_error(self.options.map_error)
        )
        answer = compared(self.basemap, answer, search.photo)
        # It is judged where it is told. A place that the map contradicts may be an equal building, and shows nothing.
        counts = answer.accepted and map_misfit(below_camera(frame, answer)) is None
        if not counts:
            # Photos that fit nowhere show ground beyond the map, where an equal building is turned alike time and again.
            track.turned.clear()
        if answer.accepted:
            answer = self._continuous(answer, frame, counts)
        located.stages["registration"] = answer
        self._fresh = counts and answer.accepted
        if not self._fresh or answer.homography is None:
            return
        middle = located.middle(answer)
        sequence = located.stages["sequence"]
        chance = chance_to_agree(
            np.array(located.likely_places()), ground.side, answer.width or ground.side, self.basemap.bounds
        )
        # A drone that hovers shows one view, which counts once.
        new = track.counted is None or (
            np.linalg.norm(middle - track.counted) > ONE_VIEW * (answer.width or ground.side)
        )
        if chance < AGREEING and new:
            track.counted = middle
            agrees = sequence.distance(middle) <= OVERLAP * ground.side
            track.odds += math.log(AGREEING / chance if agrees else (1 - AGREEING) / (1 - chance))
            track.odds = min(max(track.odds, _ODDS[0]), _ODDS[1])
        deviation = math.hypot(answer.radius or 0.0, ground.step)
        squared = ((ground.places - middle) ** 2).sum(axis=1) / (2 * deviation**2)
        near = np.exp(-squared)
        likely = (1 - _FALSE) * near / near.sum() + _FALSE / len(near) if near.sum() > 0 else np.ones(len(near))
        ground.filter.weigh(np.log(likely)[:, None])
        if answer.width is not None:
            track.add("widths", answer.width)
            if (expected := ground_width(frame)) is not None:
                track.add("ratios", answer.width / expected)
        if answer.turn is not None:
            track.add("turns", answer.turn)
        track.heading = answer.heading

    def _continuous(self, answer: StageRecord, frame: Frame, counts: bool) -> StageRecord:
        """Refuse a registration that is turned otherwise than those before, or that the drone cannot have flown to.

        Three in a row that agree with each other count again, and so do ten that are turned alike, with no photo among them that
        fits nowhere. One that does not count is judged by those before, and leaves no trace.
        """
        track = self._track
        if (turn := self._other_turn(answer, frame, counts)) is not None:
            return turned_away(answer, turn, "frames before")
        assert answer.x is not None
        assert answer.y is not None
        here = answer.x, answer.y, answer.own_radius, math.nan if frame.time is None else frame.time
        if track.last is None or self._reachable(track.last, here):
            if counts:
                track.last, track.apart = here, []
            return answer
        if counts:
            track.apart = [*[one for one in track.apart if self._reachable(one, here)][-_NEW_TRACK:], here]
        if len(track.apart) >= _NEW_TRACK:
            track.last, track.apart = here, []
            self._notes.append(
                f"{_NEW_TRACK} registrations in a row lie elsewhere than those before, which count no longer."
            )
            return answer
        return msgspec.structs.replace(
            answer,
            state="refused",
            sentence="The photo fits the map here, but the drone cannot have flown here since the last registered frame: it may "
            "be an equal building.",
        )

    def _other_turn(self, answer: StageRecord, frame: Frame, counts: bool) -> float | None:
        """Return the degrees between a registration's turn and those before, if these show that it is another place."""
        track = self._track
        if answer.turn is None or len(track.turns) < _TURNS or not heading_is_certain(frame):
            return None
        if (turned := other_turn(answer.turn, np.array(track.turns))) is None:
            track.turned.clear()
            return None
        if not counts:
            return turned
        if not are_alike(np.array([*track.turned, answer.turn])):
            track.turned.clear()
        track.turned.append(answer.turn)
        if len(track.turned) < NEW_HEADING:
            return turned
        track.turns, track.turned = track.turned[-_RECENT:-1], []
        self._notes.append(
            f"{NEW_HEADING} registrations in a row are turned otherwise than those before; the headings count as changed."
        )
        return None

    def _reachable(self, one: tuple[float, float, float, float], other: tuple[float, float, float, float]) -> bool:
        elapsed = abs(other[3] - one[3])
        if math.isnan(elapsed):
            return True
        allowed = _MOST_SPEEDS * self.options.speed * elapsed + 3 * math.hypot(one[2], other[2])
        return math.dist(one[:2], other[:2]) <= allowed

    @property
    def window_side(self) -> float | None:
        """The median side of the windows in metres; None before the first frame."""
        return None if self._ground is None else self._ground.side

    def near_border(self, metres: float) -> bool:
        """Return whether the last registered or likeliest place lies within some metres of the map's border."""
        if self._track.last is not None:
            x, y = self._track.last[:2]
        elif self._ground is not None and self._ground.filter.belief is not None:
            x, y = self._ground.filter.point(OVERLAP * self._ground.side).position.tolist()
        else:
            return False
        west, south, east, north = self.basemap.bounds
        return min(x - west, east - x, y - south, north - y) <= metres
