"""A locator of frames in the order of their arrival: windows, sequence, registration, and verdict of a whole flight.

The sequence of `lpn.flight.locate.sequence` runs forward only: a frame's answer depends on earlier frames. Frames in quick
succession show nearly the same ground, so a frame's scores are weighted by the distance flown since the last frame, as a share
of the distance between two windows. Descriptors are centred by the mean of the frames so far, from 20 distinct ones on. An
accepted registration is also evidence for the next frame's place. It is refused if the drone can hardly have flown there.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lpn.core.arrays import BoolArray, Float32Array, Float64Array, UInt8Array
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.progress import Listener, listening
from lpn.core.views import View
from lpn.flight.files.base import Frame
from lpn.flight.files.cut import CUT, cut_size, cut_square
from lpn.flight.locate.beyond import places_beyond
from lpn.flight.locate.continuity import NEW_HEADING, other_turn
from lpn.flight.locate.ground import MapFeatures
from lpn.flight.locate.located import LocatedFrame, StageRecord
from lpn.flight.locate.map_evidence import ENOUGH, MapEvidence
from lpn.flight.locate.matchers import MatcherName, open_matchers
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.ranked_stages import OVERLAP, best_windows, sequence_answer
from lpn.flight.locate.registered_stage import FlightPrior, PhotoSearch, register_photo, with_map_error
from lpn.flight.locate.retrieval import (
    ALIKE,
    MIN_DISTINCT,
    MapRetrieval,
    described_windows,
    heading_is_certain,
    pyramid_sizes,
    tried_headings,
    whitening_of,
)
from lpn.flight.locate.sequence import ForwardFilter, MotionModel, emissions, score_units
from lpn.flight.locate.verdict import map_misfit
from lpn.flight.maps import Map, Window
from lpn.models.base import Model, normalise, whitened

# Most windows that are compared, unless the user sets their sides: a frame taken on the ground would make millions.
_MOST_WINDOWS = 200_000
# Most distinct frames for centring, most frames of other places whose scores are kept, and most frames that prove the map.
_KEPT, _SCORED, _PROVING = 320, 64, 100
# Most registrations whose turns are kept, the most recent ones that set the usual turn, and the fewest that set it.
_TURNED, _RECENT, _TURNS = 20, 7, 3
# Probability that a registration is false, such as one on an equal building.
_FALSE = 0.2
# Ratio of one side of windows to the next, where the first frame sets the side.
_GRID = 1.15
# A longer step in seconds is a jump of the clock.
_LONGEST_STEP = 3600.0
_STANDARD_SPEED = 10.0
_AGREE = "The frames so far agree on this place."
# The headings of a filter without any.
_NO_HEADING = np.array([math.nan])


@dataclass(frozen=True)
class LiveOptions:
    """Options of locating a flight while it flies.

    Attributes:
        register: whether frames are laid over the map.
        matcher: of the registration; "auto" is XFeat where it is installed.
        sizes: sides of windows in metres; None takes the ground of the first frame of known height and field of view.
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


@dataclass(frozen=True, eq=False)
class _Ground:
    """The windows of the map, their descriptors, (N, n, D), and the filters over them and over places beyond the map, (B, 2).

    Attributes:
        filter: by all evidence.
        flown: by registrations and motion alone.
    """

    windows: list[Window]
    raw: Float32Array
    places: Float64Array
    sizes: Float64Array
    beyond: Float64Array
    side: float
    step: float
    motion: MotionModel
    filter: ForwardFilter
    flown: ForwardFilter


class LiveLocator:
    """A locator of one frame after another; see the module. Its memory does not grow with the flight.

    Args:
        basemap: the map.
        model: ranks its windows.
        options: see `LiveOptions`.
        on_progress: called while the map's windows are described, see `lpn.core.progress.listening`.
    """

    def __init__(
        self, basemap: Map, model: Model, options: LiveOptions | None = None, on_progress: Listener = lambda *_: None
    ) -> None:
        # A frame takes milliseconds; further threads would then spin for longer than they save.
        self.basemap, self.model = basemap, model.for_parallel_inference()
        self.options = options or LiveOptions()
        model.check_view("satellite")
        self._view: View = "drone" if "drone" in model.views else "satellite"
        self._pixels = max(model.input_size)
        self._on_progress = on_progress
        first = open_matchers(self.options.matcher)[0]
        self._features = [MapFeatures(basemap, first)] if self.options.register else []
        self._ground: _Ground | None = None
        self._tiles = np.zeros((0, 0, 0), np.float32)
        self._kept: deque[Float32Array] = deque(maxlen=_KEPT)
        self._distinct, self._centred_at = 0, 0
        self._mean: Float32Array | None = None
        self._whitening: Float32Array | None = None
        # Frames of other places: time, best score of each window, and whether the score counts.
        self._scored: deque[tuple[float, Float64Array, BoolArray]] = deque(maxlen=_SCORED)
        self._time: float | None = None
        self._evidence = MapEvidence(basemap.bounds)
        self._prior = FlightPrior()
        # Turns of the last registrations with whether they stand; then time and place of the last one.
        self._turns: deque[tuple[float, bool]] = deque(maxlen=_TURNED)
        self._registered_at: float | None = None
        self._place: Float64Array | None = None
        # Flags: the last frame was registered; the user was told of frames of other ground.
        self._fresh = self._unfit_said = False
        self._notes: list[str] = []

    def take_notes(self) -> list[str]:
        """Return the sentences since the last call."""
        notes, self._notes = self._notes, []
        return notes

    def prepare(self, sizes: Sequence[float]) -> None:
        """Describe the map's windows of these sides in metres; the user's cache has those of earlier runs.

        Raises:
            InputError: if no window has data.
        """
        overlap = self.options.overlap
        windows = self.basemap.pyramid(sorted(sizes), overlap)
        if not windows:
            raise InputError(
                f"No window of {min(sizes):.0f} m fits on the map {self.basemap.name}; give smaller ones with --size."
            )
        with listening(self._on_progress):
            raw = described_windows(self.model, self.basemap, windows)
        places = np.array([(window.x, window.y) for window in windows])
        extents = np.array([window.size for window in windows])
        side = float(np.median(extents))
        step = max(side * (1 - overlap), 1.0)
        motion = MotionModel(self.options.speed, step / 2)
        beyond = places_beyond(self.basemap, places, extents, overlap)
        everywhere = np.concatenate([places, beyond])
        whole, flown = ForwardFilter(everywhere, motion, len(beyond)), ForwardFilter(places, motion)
        self._ground = _Ground(windows, raw, places, extents, beyond, side, step, motion, whole, flown)
        self._evidence = MapEvidence(self.basemap.bounds, side=side, kept=_PROVING)
        self._centre()
        noise = np.random.default_rng(0).integers(0, 255, (256, 256, 3), np.uint8)
        for kind in self._features:  # load a matcher's network, which takes seconds, before the first frame
            kind.matcher.features(noise, None, 16)

    def locate(self, frame: Frame, photo: UInt8Array) -> LocatedFrame:
        """Locate the next frame.

        Args:
            frame: with heading, height, and time where known.
            photo: its picture, RGB (H, W, 3).
        """
        ground = self._windows_for(frame)
        tag = None
        if frame.latitude is not None and frame.longitude is not None:
            place = self.basemap.frame.xy([frame.latitude], [frame.longitude])[0]
            tag = place if np.isfinite(place).all() else None
        located = LocatedFrame(frame, tag)
        ranked = self._ranked(ground, frame, photo)
        self._weigh(ground, ranked, frame)
        located.stages["sequence"] = answer = self._sequence(ground)
        if not answer.accepted:  # otherwise the registration searches there alone
            located.windows = best_windows(ranked, 0, 2)
        if self.options.register:
            self._register(located, ground, photo)
            located.stages["sequence"] = self._sequence(ground)
        if frame.time is not None:
            self._time = frame.time
        return located

    def begin(self, frame: Frame) -> bool:
        """Describe the map's windows in the size of a first frame's ground; return False if this was done before."""
        if self._ground is not None:
            return False
        # Sizes are rounded, so that the cache often has the windows of the next flight.
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

    def _windows_for(self, frame: Frame) -> _Ground:
        """Return the windows; tell the user once if frames show ground of another size."""
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
        """Return the seconds since the last frame; NaN if unknown, or if the clock has jumped."""
        if frame.time is None or self._time is None:
            return math.nan
        elapsed = frame.time - self._time
        if 0 <= elapsed <= _LONGEST_STEP:
            return elapsed
        self._notes.append(
            f"The clock of the pictures has jumped by {elapsed:.1f} s at {printable(frame.name)}; the time of this step counts "
            "as unknown."
        )
        return math.nan

    def _headings(self, frame: Frame) -> list[float]:
        """Return the headings in degrees to try: one if it is certain or registrations tell the turn, else several."""
        turns = self._told_turns()
        if frame.heading is not None and not heading_is_certain(frame) and len(turns) >= _TURNS:
            return [(frame.heading + float(np.median(turns))) % 360.0]
        return tried_headings(frame)

    def _ranked(self, ground: _Ground, frame: Frame, photo: UInt8Array) -> MapRetrieval:
        """Describe a frame, and return its scores of the windows."""
        share, level = CUT * min(1.0, frame.height / frame.width), math.nan
        if (cut := cut_size(frame)) is not None:
            level = float(ground.sizes[np.abs(np.log(ground.sizes / cut)).argmin()])
            share *= level / cut
        headings = self._headings(frame)
        squares = [cut_square(photo, heading, share, self._pixels) for heading in headings]
        prepared = np.stack([self.model.prepare(square, self._view) for square in squares])
        described = self.model.descriptors(prepared, self._view)
        self._keep(described[0])
        if self._mean is not None:
            described = normalise(whitened(described - self._mean, self._whitening))
        return MapRetrieval(
            ground.windows,
            ground.places,
            ground.sizes,
            self._tiles,
            [described],
            [headings],
            np.array([level]),
            np.array([share]),
            self._pixels,
            {},
            {},
            by_aircraft=frozenset({0} if frame.heading_source == "aircraft" else ()),
            overlap=self.options.overlap,
        )

    def _keep(self, described: Float32Array) -> None:
        """Keep the descriptor of a frame unlike the last kept one; centre again whenever their number has doubled."""
        last = self._kept[-1] if self._kept else None
        if last is not None and float(described.ravel() @ last.ravel()) >= ALIKE:
            return
        self._kept.append(described)
        self._distinct += 1
        if self.options.centre and self._distinct >= max(MIN_DISTINCT, 2 * self._centred_at):
            self._centre()

    def _centre(self) -> None:
        """Subtract the means of windows and frames, and whiten, if there are enough frames."""
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
        self._scored.clear()  # earlier scores are of other descriptors

    def _weigh(self, ground: _Ground, ranked: MapRetrieval, frame: Frame) -> None:
        """Move the belief to the frame, and weigh it with the frame's scores."""
        elapsed, time = self._elapsed(frame), math.nan if frame.time is None else frame.time
        best, level = ranked.scores(0), float(ranked.levels[0])
        compared = np.ones(len(best), bool) if math.isnan(level) else ground.sizes == level
        scored = [*self._scored, (time, best, compared)]
        steps = ground.motion.steps([one for one, *_ in scored])
        units = score_units(
            np.stack([one for _, one, _ in scored]), steps, ground.side, np.stack([one for *_, one in scored])
        )
        if not len(steps) or steps[-1] >= ground.step:
            self._scored.append(scored[-1])
        known = frame.heading is not None
        values = units.standardised(len(scored) - 1, best[:, None] if known else ranked.scores_by_heading(0))
        headings = np.array([frame.heading] if known else ranked.headings[0], np.float64)
        ground.filter.predict(elapsed, headings)
        moved = self.options.speed * elapsed / ground.step
        weight = 1.0 if math.isnan(moved) else min(1.0, moved)
        if weight > 0:
            alike = float(ground.motion.alike([0.0, elapsed], ground.side)[1])
            ground.filter.weigh(weight * emissions(values, beyond=len(ground.beyond), alike=alike))

    def _sequence(self, ground: _Ground) -> StageRecord:
        point = ground.filter.point(OVERLAP * ground.side)
        return sequence_answer(point, ground.side, ground.step, self._evidence.log_odds >= ENOUGH, _AGREE)

    def _register(self, located: LocatedFrame, ground: _Ground, photo: UInt8Array) -> None:
        """Register the photo near the prediction, and weigh the belief with its place."""
        frame, sure = located.frame, located.stages["sequence"].accepted
        side = 2 * self.options.speed if sure and self._fresh else ground.side
        search = PhotoSearch(
            self.basemap,
            self._features,
            located,
            frame.undistorted(photo),
            LocateOptions(matcher=self.options.matcher),
            self._prior,
            side,
            quick=len(self._prior.ratios) >= _TURNS,
        )
        map_error = self.options.map_error
        answer = with_map_error(
            register_photo(search), self.basemap.total_error(map_error), self.basemap.place_error(map_error)
        )
        # A place that the map contradicts may be an equal building, and proves nothing.
        if counts := answer.accepted and map_misfit(answer) is None:
            answer = self._continuous(ground, located, answer)
        else:
            # Photos that fit nowhere show ground beyond the map; there, an equal building fits at the same turn again and again.
            self._turns = deque((one for one in self._turns if one[1]), _TURNED)
        located.stages["registration"] = answer
        self._fresh = counts and answer.accepted
        self._evidence.add(located, side)
        if self._fresh:
            ground.filter.weigh(self._likely(ground, located, answer, len(ground.beyond)))
            self._prior.add(frame, answer)
            self._place = located.middle(answer)

    def _continuous(self, ground: _Ground, located: LocatedFrame, answer: StageRecord) -> StageRecord:
        """Refuse a registration at another turn than earlier ones, or at a place that the drone can hardly have reached."""
        if (degrees := self._other_turn(located.frame, answer)) is not None:
            return answer.refused("turned", degrees=degrees)
        time, before = located.frame.time, self._registered_at
        ground.flown.predict(math.nan if time is None or before is None else time - before, _NO_HEADING)
        self._registered_at = time
        likely = self._likely(ground, located, answer)
        belief = ground.flown.belief
        assert belief is not None
        is_false = _FALSE / len(belief) > 0.5 * float((belief * np.exp(likely)).sum())
        # A false registration counts by half, so that several that agree elsewhere still move the belief.
        ground.flown.weigh(likely / 2 if is_false else likely)
        return answer.refused("unreachable") if is_false else answer

    def _likely(self, ground: _Ground, located: LocatedFrame, answer: StageRecord, beyond: int = 0) -> Float64Array:
        """Return the log probability of a registration for each place of the drone, window or beyond the map, (N + B, 1)."""
        place = located.middle(answer)
        deviation = math.hypot(answer.radius or 0.0, ground.step)
        near = np.exp(-((ground.places - place) ** 2).sum(axis=1) / (2 * deviation**2))
        near = np.pad(near / max(float(near.sum()), 1e-300), (0, beyond))
        return np.asarray(np.log((1 - _FALSE) * near + _FALSE / len(ground.places))[:, None])

    def _other_turn(self, frame: Frame, answer: StageRecord) -> float | None:
        """Return the degrees between a registration's turn and earlier ones if these show that it is another place."""
        if answer.turn is None:
            return None
        usual, refused = self._told_turns(), [turn for turn, stands in self._turns if not stands]
        degrees = None
        if heading_is_certain(frame) and len(usual) >= _TURNS:
            degrees = other_turn(answer.turn, np.array(usual))
        alike = [turn for turn in refused if other_turn(turn, np.array([answer.turn])) is None]
        if degrees is not None and len(alike) + 1 < NEW_HEADING:
            kept = [*((turn, True) for turn in usual), *((turn, False) for turn in alike), (answer.turn, False)]
            self._turns = deque(kept, _TURNED)
            return degrees
        # Its turn is that of earlier registrations, or enough registrations share it that the headings count as changed.
        standing = usual if degrees is None else alike
        self._turns = deque([*((turn, True) for turn in standing), (answer.turn, True)], _TURNED)
        return None

    def _told_turns(self) -> list[float]:
        return [turn for turn, stands in self._turns if stands][-_RECENT:]

    @property
    def near_border(self) -> bool:
        """True if the last registered place lies within a window's side of the map's border."""
        if self._ground is None or self._place is None:
            return False
        west, south, east, north = self.basemap.bounds
        x, y = self._place.tolist()
        return bool(min(x - west, east - x, y - south, north - y) <= self._ground.side)
