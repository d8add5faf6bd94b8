"""A locator of frames in the order of their arrival, by the stages of a whole flight: windows, sequence, registration, verdict.

The sequence of `lpn.flight.locate.sequence` runs forward only: a frame's answer depends on earlier frames. Frames in quick
succession show nearly the same ground. So a frame's scores are weighted by the distance flown since the last frame, as a share
of the distance between two windows. Descriptors are centred by the mean of the frames so far, once 20 are distinct. An
accepted registration is also evidence for the next frame's place. It is refused if the drone can hardly have flown there.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from lpn.core.arrays import BoolArray, Float32Array, Float64Array, UInt8Array
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.progress import Listener, listening
from lpn.core.views import View
from lpn.flight.files.base import Frame
from lpn.flight.files.cut import cut_size, cut_square
from lpn.flight.locate.ground import MapFeatures
from lpn.flight.locate.located import LocatedFrame, StageRecord
from lpn.flight.locate.map_evidence import ENOUGH, MapEvidence
from lpn.flight.locate.matchers import open_matchers
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.ranked_stages import OVERLAP, places_beyond, sequence_answer
from lpn.flight.locate.registered_stage import FlightPrior, PhotoSearch, register_photo, with_map_error
from lpn.flight.locate.retrieval import (
    ALIKE,
    MIN_DISTINCT,
    FrameViews,
    WindowGallery,
    described_windows,
    heading_is_certain,
    pyramid_sizes,
    size_notes,
    whitening_of,
    windows_of,
)
from lpn.flight.locate.sequence import ForwardFilter, MotionModel, SequencePoint, emissions, score_units
from lpn.flight.locate.turns import NEW_HEADING, other_turn
from lpn.flight.locate.verdict import map_misfit
from lpn.flight.maps import Map
from lpn.models.base import Model, normalise, whitened

# Maximum of compared windows, unless the user sets their sides: a frame taken on the ground would make millions.
_MOST_WINDOWS = 200_000
# Maxima of distinct frames for centring, of frames of other places whose scores are kept, and of frames that prove the map.
_KEPT, _SCORED, _PROVING = 320, 64, 100
# Maxima of registrations whose turns are kept, and of recent ones that set the usual turn; and the minimum that sets it.
_TURNED, _RECENT, _TURNS = 20, 7, 3
# Probability that a registration is false, such as one on an equal building.
_FALSE = 0.2
# Ratio of one side of windows to the next, where the first frame sets the side.
_GRID = 1.15
# A longer step in seconds is a jump of the clock.
_LONGEST_STEP = 3600.0
# The headings of a filter over places alone.
_NO_HEADING = np.array([math.nan])


class LiveLocator:
    """A locator of one frame after another; see the module. Its memory does not grow with the flight.

    Args:
        basemap: the map.
        model: ranks its windows.
        options: of locating; `LocateOptions.prior` is not used.
        on_progress: called while the map's windows are described, see `lpn.core.progress.listening`.
        say: receives sentences about the flight.
    """

    def __init__(
        self,
        basemap: Map,
        model: Model,
        options: LocateOptions | None = None,
        on_progress: Listener = lambda *_: None,
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        # A frame takes milliseconds; further threads would then spin for longer than they save.
        self.basemap, self.model = basemap, model.for_parallel_inference()
        self.options = options or LocateOptions()
        model.check_view("satellite")
        self._view: View = "drone" if "drone" in model.views else "satellite"
        self._on_progress, self._say = on_progress, say
        self._features = [MapFeatures(basemap, open_matchers(self.options.matcher)[0])] if self.options.register else []
        # The windows as they are compared, and their descriptors before centring, (N, n, D).
        self._gallery: WindowGallery | None = None
        self._raw = np.zeros((0, 0, 0), np.float32)
        self._kept: deque[Float32Array] = deque(maxlen=_KEPT)
        self._distinct, self._centred_at = 0, 0
        self._mean: Float32Array | None = None
        self._whitening: Float32Array | None = None
        # Frames of other places: time, best score of each window, and whether the score counts.
        self._scored: deque[tuple[float, Float64Array, BoolArray]] = deque(maxlen=_SCORED)
        self._time = math.nan
        self._prior = FlightPrior()
        # Turns of the last registrations, each with False if it was refused, and the time of the last registration.
        self._turns: deque[tuple[float, bool]] = deque(maxlen=_TURNED)
        self._registered_at = math.nan
        # True if the last registered place lies within a window's side of the map's border.
        self.near_border = False
        # Flags: the last frame was registered; the sentence on frames of other ground was sent.
        self._fresh = self._unfit_said = False

    def prepare(self, sizes: Sequence[float]) -> None:
        """Describe the map's windows of these sides in metres; the user's cache has the windows of earlier runs.

        Raises:
            InputError: if no window has data.
        """
        windows = windows_of(self.basemap, sizes, self.options.overlap)
        with listening(self._on_progress):
            self._raw = described_windows(self.model, self.basemap, windows)
        self._gallery = gallery = WindowGallery(windows, self.options.overlap, self._raw)
        self._motion = MotionModel(self.options.speed, gallery.step / 2)
        beyond = places_beyond(self.basemap, gallery)
        self._places, self._beyond = np.concatenate([gallery.places, beyond]), len(beyond)
        # The place by all evidence, and by registrations and motion alone.
        self._filter = ForwardFilter(self._places, self._motion, self._beyond)
        self._flown = ForwardFilter(gallery.places, self._motion)
        self._evidence = MapEvidence(self.basemap.bounds, side=gallery.side, kept=_PROVING)
        self._centre(gallery)
        noise = np.random.default_rng(0).integers(0, 255, (256, 256, 3), np.uint8)
        for kind in self._features:  # load a matcher's network, which takes seconds, before the first frame
            kind.matcher.features(noise, None, 16)

    def begin(self, frame: Frame) -> bool:
        """Describe the map's windows in the size of a first frame's ground; return False if this was done before."""
        if self._gallery is not None:
            return False
        # Sizes are rounded, so that the cache often has the windows of the next flight.
        sizes = [_GRID ** round(math.log(size, _GRID)) for size in pyramid_sizes(self.basemap, [frame])]
        if self.options.sizes is None:
            west, south, east, north = self.basemap.bounds
            step = min(sizes) * (1 - self.options.overlap)
            if (count := (east - west) * (north - south) / step**2) > _MOST_WINDOWS:
                raise InputError(
                    f"The first frame shows {min(sizes):.1f} m of ground, so the map has {count:,.0f} such windows, "
                    f"and at most {_MOST_WINDOWS:,} are compared; fly higher, or give sides with --size."
                )
        self.prepare(self.options.sizes or sizes)
        return True

    def locate(self, frame: Frame, photo: UInt8Array) -> LocatedFrame:
        """Locate the next frame.

        Args:
            frame: with heading, height, and time where known.
            photo: its picture, RGB (H, W, 3).
        """
        self.begin(frame)
        gallery = self._gallery
        assert gallery is not None
        tag = None
        if frame.latitude is not None and frame.longitude is not None:
            place = self.basemap.frame.xy([frame.latitude], [frame.longitude])[0]
            tag = place if np.isfinite(place).all() else None
        located = LocatedFrame(frame, tag)
        turns = self._told_turns()
        if frame.heading is not None and not heading_is_certain(frame) and len(turns) >= _TURNS:
            told = replace(frame, heading=(frame.heading + float(np.median(turns))) % 360.0, heading_source=None)
        else:
            told = frame
        views = FrameViews.of(told, gallery.levels)
        if not self._unfit_said and size_notes([frame], [views]):
            self._unfit_said = True
            self._say(
                f"Frames show squares of {cut_size(frame):.0f} m now and are compared with windows of {views.level:.0f} m, so "
                "their answers are poor; give the sides that the flight shows with --size."
            )
        described = self._described(gallery, views, photo)
        gallery = self._gallery  # centred again, perhaps
        assert gallery is not None
        scores = gallery.scores(views, described)
        self._weigh(gallery, views, scores, frame)
        located.stages["sequence"] = answer = self._sequence(gallery)
        if not answer.accepted:  # otherwise the registration searches there alone
            located.windows = gallery.best(views, described, scores, 2)
        if self.options.register:
            self._register(located, gallery, photo)
            located.stages["sequence"] = self._sequence(gallery)
        self._time = self._time if frame.time is None else frame.time
        return located

    def _described(self, gallery: WindowGallery, views: FrameViews, photo: UInt8Array) -> Float32Array:
        """Describe a frame at its headings, (H, n, D).

        A frame unlike the last kept frame is kept. Descriptors are centred again whenever the number of such frames has doubled.
        """
        pixels = max(self.model.input_size)
        squares = [cut_square(photo, heading, views.share, pixels) for heading in views.headings]
        prepared = np.stack([self.model.prepare(square, self._view) for square in squares])
        described = self.model.descriptors(prepared, self._view)
        if not self._kept or float(described[0].ravel() @ self._kept[-1].ravel()) < ALIKE:
            self._kept.append(described[0])
            self._distinct += 1
            if self._distinct >= max(MIN_DISTINCT, 2 * self._centred_at):
                self._centre(gallery)
        if self._mean is not None:
            described = normalise(whitened(described - self._mean, self._whitening))
        return described

    def _centre(self, gallery: WindowGallery) -> None:
        """Subtract the means of windows and frames, and whiten, if there are enough frames."""
        if self._distinct < MIN_DISTINCT:
            return
        self._centred_at = self._distinct
        frames, of_tiles = np.stack(self._kept), self._raw.mean(axis=0)
        self._mean = frames.mean(axis=0)
        self._whitening = whitening_of(self._raw - of_tiles, frames - self._mean)
        described = normalise(whitened(self._raw - of_tiles, self._whitening))
        self._gallery = replace(gallery, described=described)
        self._scored.clear()  # earlier scores are of other descriptors

    def _weigh(self, gallery: WindowGallery, views: FrameViews, scores: Float64Array, frame: Frame) -> None:
        """Move the belief to the frame, and weigh it with the frame's scores."""
        elapsed = (math.nan if frame.time is None else frame.time) - self._time
        if not math.isnan(elapsed) and not 0 <= elapsed <= _LONGEST_STEP:
            self._say(
                f"The clock of the pictures has jumped by {elapsed:.1f} s at {printable(frame.name)}; the time of this step "
                "counts as unknown."
            )
            elapsed = math.nan
        best = scores.max(axis=1)
        scored = [*self._scored, (math.nan if frame.time is None else frame.time, best, gallery.compared(views))]
        times, of_frames, compared = map(np.array, zip(*scored, strict=True))
        steps = self._motion.deviation(np.abs(np.diff(times)))
        units = score_units(of_frames, steps, gallery.side, compared)
        if not len(steps) or steps[-1] >= gallery.step:
            self._scored.append(scored[-1])
        known = frame.heading is not None
        values = units(len(scored) - 1, best[:, None] if known else scores)
        self._filter.predict(elapsed, np.array([frame.heading] if known else views.headings, np.float64))
        moved = self.options.speed * elapsed / gallery.step
        weight = 1.0 if math.isnan(moved) else min(1.0, moved)
        if weight > 0:
            alike = float(self._motion.alike(elapsed, gallery.side))
            self._filter.weigh(weight * emissions(values, beyond=self._beyond, alike=alike))

    def _sequence(self, gallery: WindowGallery) -> StageRecord:
        forward, near = self._filter, OVERLAP * gallery.side
        assert forward.belief is not None
        point = SequencePoint.of(forward.belief, self._places, forward.headings, near, self._beyond)
        return sequence_answer(point, gallery, self._evidence.log_odds >= ENOUGH)

    def _register(self, located: LocatedFrame, gallery: WindowGallery, photo: UInt8Array) -> None:
        """Register the photo near the prediction, and weigh the belief with its place."""
        frame, sure = located.frame, located.stages["sequence"].accepted
        side = 2 * self.options.speed if sure and self._fresh else gallery.side
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
            answer = self._continuous(gallery, located, answer)
        else:
            # Photos that fit nowhere show ground beyond the map; there, an equal building fits at the same turn again and again.
            self._turns = deque((one for one in self._turns if one[1]), _TURNED)
        located.stages["registration"] = answer
        self._fresh = counts and answer.accepted
        self._evidence.add(located, side)
        if self._fresh:
            self._filter.weigh(self._likely(gallery, located, answer, self._beyond))
            self._prior.add(frame, answer)
            (west, south, east, north), (x, y) = self.basemap.bounds, located.middle(answer)
            self.near_border = bool(min(x - west, east - x, y - south, north - y) <= gallery.side)

    def _continuous(self, gallery: WindowGallery, located: LocatedFrame, answer: StageRecord) -> StageRecord:
        """Refuse a registration at another turn than earlier ones, or at a place that the drone can hardly have reached."""
        if (degrees := self._other_turn(located.frame, answer)) is not None:
            return answer.refused("turned", degrees=degrees)
        time = math.nan if located.frame.time is None else located.frame.time
        self._flown.predict(abs(time - self._registered_at), _NO_HEADING)
        self._registered_at = time
        likely = self._likely(gallery, located, answer)
        belief = self._flown.belief
        assert belief is not None
        is_false = _FALSE / len(belief) > 0.5 * float((belief * np.exp(likely)).sum())
        # A false registration counts by half, so that several that agree elsewhere still move the belief.
        self._flown.weigh(likely / 2 if is_false else likely)
        return answer.refused("unreachable") if is_false else answer

    def _likely(
        self, gallery: WindowGallery, located: LocatedFrame, answer: StageRecord, beyond: int = 0
    ) -> Float64Array:
        """Return the log probability of a registration for each place of the drone, window or beyond the map, (N + B, 1)."""
        place = located.middle(answer)
        deviation = math.hypot(answer.radius or 0.0, gallery.step)
        near = np.exp(-((gallery.places - place) ** 2).sum(axis=1) / (2 * deviation**2))
        near = np.pad(near / max(float(near.sum()), 1e-300), (0, beyond))
        return np.asarray(np.log((1 - _FALSE) * near + _FALSE / len(gallery.places))[:, None])

    def _other_turn(self, frame: Frame, answer: StageRecord) -> float | None:
        """Return the degrees between a registration's turn and earlier ones if these show that its place is false."""
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
        # The turn fits earlier registrations, or enough registrations share it to count as a change of the headings.
        standing = usual if degrees is None else alike
        self._turns = deque([*((turn, True) for turn in standing), (answer.turn, True)], _TURNED)
        return None

    def _told_turns(self) -> list[float]:
        return [turn for turn, stands in self._turns if stands][-_RECENT:]
