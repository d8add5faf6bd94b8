"""A hidden Markov model over places and headings, by which the frames of a flight correct each other.

A state is a window of the map and a heading of the picture. The emission is a softmax of the scores at a temperature, mixed with
a floor for misleading scores. Forward-backward gives each frame's posterior (Rabiner, Proc. IEEE 77, 1989).

Speed, kind of motion, and temperature maximise the probability of the flight's scores. A window's scores are divided by its usual
score from frames of other places, so that a window that resembles many frames, such as one of many ploughed fields, proves
little.

A drone may leave the map, so places beyond its edge are states, too. They have no window, so a frame has one emission for all of
them. A frame lies there if its windows on the way are no better than others, and the way leads there. Leaving the map is rare.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import NamedTuple, cast

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import BoolArray, Float64Array, Int64Array
from lpn.core.filled_cache import FilledCache
from lpn.core.numbers import wrap_degrees

# Returns scores or log emissions of a frame's windows at its headings, (N, K), for the frame's index in the flight.
OfFrame = Callable[[int], Float64Array]

# Frames of unit score that are added to the frames of other places in a window's mean square.
PRIOR_FRAMES = 30
# Tried speeds in metres a second, tried temperatures, and most frames for these trials.
SPEEDS = (4.0, 6.0, 9.0, 13.0, 19.0, 28.0)
TEMPERATURES = (0.25, 0.33, 0.4, 0.5, 0.67, 1.0)
_FIRST_TEMPERATURE = 0.4
_FITTED = 100
# Tried probability of steps along the headings, beside 0, and factor between the tried speeds along them.
ALONG, FINER = 0.9, 1.2
# Deviation of a step along the headings as a share of its length, by wind and varying speed.
_ALONG_DEVIATION = 0.3
# Shares of a step's time along the heading before it; the rest is along the heading after it.
_LEGS = (0.0, 0.25, 0.5, 0.75, 1.0)
# Standard deviation in degrees between a picture's heading and the nearest tried one.
_HEADING_DEVIATION = 20.0
# Probability that a heading is independent of the one before.
_ANY_HEADING = 0.1
# Multiple of the usual seconds above which a step may be a pause, and the probability of a pause.
_LONG, _PAUSE = 3.0, 0.5
# Log odds of a place beyond the map against a window of mean share if a frame shows the ground of the last one: a wrong window
# that suits the last frame also suits this one.
_ALIKE = 1.5
# Factor of the probability of a step off the map, and probability of a first frame beyond it.
_LEAVE, _BEGIN = 1e-3, 0.1
# Probability of a step outside the motion model, as between separate parts of a flight, or at a jump of the clock.
_JUMP = 1e-3
# Metres within which coordinates are equal: an index's names round them to about 1 cm.
_ONE_COORDINATE = 0.02
# Most bytes of steps in memory: each is used several times, and equal ones are shared.
_HELD_STEPS = 1 << 26


@dataclass(frozen=True)
class MotionModel:
    """The motion of the flight between frames.

    A step goes along the headings, or in any direction. Along the headings it follows the heading before it for a part of the
    time, and then the heading after it, if that is unique. A step of more than three times the usual seconds is a pause with
    probability 1/2: the drone hovers or lands, and goes on by one usual step.

    Attributes:
        speed: metres a second of a step along the headings, or one standard deviation of a step in any direction.
        spacing: metres added to the deviation of a step, because windows lie on a grid and pictures tilt.
        unknown: metres of a step whose time is unknown.
        along: probability that a step goes along the headings, 0 .. 1.
        turn_rate: degrees a second by which the heading changes, one standard deviation.
        usual: seconds of a usual step; infinite if no step is a pause.
        aside: degrees clockwise from the heading to the direction of a step along it.
    """

    speed: float = 15.0
    spacing: float = 25.0
    unknown: float = 60.0
    along: float = 0.0
    turn_rate: float = 1.0
    usual: float = math.inf
    aside: float = 0.0

    def steps(self, times: npt.ArrayLike) -> Float64Array:
        """Return the standard deviation in metres of each step in any direction, (T - 1,).

        Args:
            times: seconds, (T,), NaN where unknown.
        """
        elapsed = np.abs(np.diff(np.asarray(times, np.float64)))
        return np.where(np.isnan(elapsed), self.unknown, np.hypot(self.speed * elapsed, self.spacing))

    def alike(self, times: npt.ArrayLike, side: float) -> Float64Array:
        """Return the share of a window's side that each frame has in common with the last one, (T,); 0 where unknown.

        The first frame has the share of the second.

        Args:
            times: seconds, (T,), NaN where unknown.
            side: of a window in metres.
        """
        elapsed = np.abs(np.diff(np.asarray(times, np.float64)))
        elapsed = np.concatenate([elapsed[:1] if len(elapsed) else [math.nan], elapsed])
        return np.nan_to_num(np.clip(1 - self.speed * elapsed / side, 0, 1))

    def turns(self, elapsed: float, before: Float64Array, after: Float64Array) -> Float64Array:
        """Return the probability of each heading after a step, (K, M), in rows of 1.

        Args:
            elapsed: seconds, NaN if unknown.
            before, after: headings in degrees, (K,) and (M,), NaN if unknown.
        """
        change = wrap_degrees(after - before[:, None])
        deviation = np.hypot(_HEADING_DEVIATION, self.turn_rate * elapsed)
        if np.isnan(change).any() or np.isnan(deviation):
            return np.full(change.shape, 1 / len(after))
        likely = sum(np.exp(-((change + turn) ** 2) / (2 * deviation**2)) for turn in (-360, 0, 360))
        # Headings all far from the one before are equally likely.
        likely = np.maximum(likely, 1e-12)
        shares = likely / likely.sum(axis=1, keepdims=True)
        return cast(Float64Array, (1 - _ANY_HEADING) * shares + _ANY_HEADING / len(after))


@dataclass(frozen=True, eq=False)
class SequenceResult:
    """A flight as a track over the windows.

    Attributes:
        positions: mean of each frame's posterior near its likeliest window in metres, (T, 2) float64.
        radii: 1-sigma radius in metres of each posterior, all windows included, about that position, (T,) float64.
        likeliest: window of the greatest posterior, all headings together, (T,) int64.
        first: windows chosen by `keep` of `smooth` from each posterior, all headings together; of each frame (K,) int64.
        headings: the likeliest heading in that window in degrees, (T,) float64; NaN where unknown.
        nearby: posterior of all places near the position, (T,) float64.
        beyond: posterior of all places beyond the map that are not near the position, (T,) float64.
        own: window of each frame's best score, (T,) int64.
        moved: metres from that window to `positions`, (T,) float64.
    """

    positions: Float64Array
    radii: Float64Array
    likeliest: Int64Array
    first: list[Int64Array]
    headings: Float64Array
    nearby: Float64Array
    beyond: Float64Array
    own: Int64Array
    moved: Float64Array

    def point(self, frame: int) -> SequencePoint:
        """Return the position of a frame."""
        values = self.radii, self.headings, self.nearby, self.beyond
        return SequencePoint(self.positions[frame], *(float(of_frames[frame]) for of_frames in values))

    def sentence(self, frame: int) -> str:
        """A sentence on the distance from the frame's own answer, for accepted and refused places alike."""
        moved = self.moved[frame]
        if self.likeliest[frame] == self.own[frame]:
            return "The picture's own answer is the same place."
        return f"It was moved by {moved:.0f} m from the picture's own answer, outvoted by its neighbours."


@dataclass(frozen=True, eq=False)
class ScoreUnits:
    """The units of the scores of frames and windows; see `score_units`.

    Attributes:
        means: of each frame, (T,).
        scales: factors of scores after the mean is subtracted, (T, N).
        compared: scores that count, (T, N).
        least: the value of the others, (T,).
    """

    means: Float64Array
    scales: Float64Array
    compared: BoolArray
    least: Float64Array

    def standardised(self, frame: int, scores: Float64Array) -> Float64Array:
        """Return scores of one frame, (N, K), in these units."""
        values = (scores - self.means[frame]) * self.scales[frame, :, None]
        return cast(Float64Array, np.where(self.compared[frame, :, None], values, self.least[frame]))


def score_units(
    scores: npt.ArrayLike, steps: Float64Array, side: float, compared: BoolArray | None = None
) -> ScoreUnits:
    """Return the units of scores, by the usual scores of each frame and window.

    Each frame's scores get mean 0 and variance 1, or become 0 if they are all equal. Each score is then divided by the root mean
    square of its window's scores from frames of other places and from 30 more frames of unit score.

    Args:
        scores: (T, N), at each window's best heading.
        steps: standard deviation of each step in metres, (T - 1,). Frames are of other places if the standard deviation of the
            motion between them exceeds `side`.
        side: of a window in metres.
        compared: scores that count, (T, N); the others get their frame's least score. None for all.
    """
    values = np.array(scores, np.float64)
    counted = np.ones(values.shape, bool) if compared is None else compared
    number = np.maximum(counted.sum(axis=1, keepdims=True), 1)
    means = values.sum(axis=1, keepdims=True, where=counted) / number
    values -= means
    deviation = np.sqrt((values**2).sum(axis=1, keepdims=True, where=counted) / number)
    varied = deviation > 1e-9
    scales = np.where(varied, 1 / np.where(varied, deviation, 1), 0)
    values = np.where(counted, values * scales, 0)
    squares, frames = (
        np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(of_frame, axis=0)])
        for of_frame in (values**2, (counted & varied).astype(np.float64))
    )
    variance = np.concatenate([[0.0], np.cumsum(np.square(steps))])
    near = np.searchsorted(variance, [variance - side**2, np.nextafter(variance + side**2, np.inf)], "left")
    first, last = np.minimum(near[0], np.arange(len(values))), np.maximum(near[1], np.arange(len(values)) + 1)
    mean_square = (squares[-1] - squares[last] + squares[first] + PRIOR_FRAMES) / (
        frames[-1] - frames[last] + frames[first] + PRIOR_FRAMES
    )
    units = np.sqrt(mean_square)
    least = np.min(values / units, axis=1, where=counted, initial=0.0)
    return ScoreUnits(means[:, 0], scales / units, counted, least)


def emissions(
    scores: Float64Array,
    temperature: float = _FIRST_TEMPERATURE,
    floor: float = 1e-4,
    beyond: int = 0,
    alike: float = 0.0,
) -> Float64Array:
    """Return log emissions of one frame: log of (softmax of score / temperature + floor / (N K)), normalised.

    Places beyond the map follow the windows. Their share is 1 / (N K), times up to e^1.5 if the frame resembles the last one. A
    frame of equal scores, such as an unreadable photo, tells nothing.

    Args:
        scores: of windows at headings, (N, K).
        temperature: of the softmax, in units of the score, see `score_units`.
        floor: share of a uniform distribution, 0 .. 1.
        beyond: number of places beyond the map, B.
        alike: share of the ground in common with the last frame, 0 .. 1, see `MotionModel.alike`.

    Returns:
        (N + B, K) float64.
    """
    values = np.asarray(scores, np.float64)
    shares = np.exp((values - values.max()) / temperature)
    shares /= shares.sum()
    with np.errstate(divide="ignore"):
        logs = np.log((1 - floor) * shares + floor / values.size)
    more = _ALIKE * alike if np.ptp(values) > 0 else 0.0
    return np.concatenate([logs, np.full((beyond, values.shape[1]), more - math.log(values.size))])


def smooth(
    log_emissions: OfFrame,
    headings: Sequence[Float64Array],
    places: Float64Array,
    times: npt.ArrayLike,
    motion: MotionModel,
    near: float = math.inf,
    keep: Callable[[Float64Array], Int64Array] = lambda shares: np.array([shares.argmax()]),
    beyond: int = 0,
) -> SequenceResult:
    """Run forward-backward; memory is O(sqrt(T) N K).

    Args:
        log_emissions: of each frame, (N + B, K), see `emissions`.
        headings: of each frame in degrees, (K,); a single NaN if unknown.
        places: centres of the windows, then places beyond the map, in metres, (N + B, 2). Fewer distinct x and y take less time.
        times: seconds, (T,), NaN where unknown.
        near: metres around the likeliest window within which windows contribute to a frame's position, so that it does not lie
            between two places; also the radius of `SequenceResult.nearby`.
        keep: chooses the windows of `SequenceResult.first` by a posterior (N,); by default the likeliest one.
        beyond: number of places beyond the map, B, which are never a frame's position.
    """
    chain = _Chain(log_emissions, _Steps(headings, places, times, motion, beyond))
    frames, states = len(headings), len(places)
    windows = states - beyond
    positions, radii, nearby, outside, found_headings = (
        np.empty((frames, 2)),
        *(np.empty(frames) for _ in range(4)),
    )
    likeliest, own = np.empty(frames, np.int64), np.empty(frames, np.int64)
    first: list[Int64Array] = []
    behind = np.ones((states, len(headings[-1])))
    for t, forward in _backwards(lambda t, before: chain.forward(t, before)[0], frames):
        if t < frames - 1:
            behind = chain.step(t).pull(behind * chain.emission(t + 1)[0])
            behind /= behind.max()
        joint = forward * behind
        joint /= joint.sum()
        shares = joint[:windows].sum(axis=1)
        likeliest[t] = shares.argmax()
        first.append(keep(shares))
        point = _point(joint, places, headings[t], near, beyond)
        positions[t], radii[t], found_headings[t], nearby[t], outside[t] = point
        own[t] = log_emissions(t)[:windows].max(axis=1).argmax()
    return SequenceResult(
        positions,
        radii,
        likeliest,
        first[::-1],
        found_headings,
        nearby,
        outside,
        own,
        np.linalg.norm(positions - places[own], axis=1),
    )


class SequencePoint(NamedTuple):
    """A frame's position in metres, (2,), its 1-sigma radius, heading, and the probabilities nearby and beyond the map.

    See `SequenceResult`.
    """

    position: Float64Array
    radius: float
    heading: float
    nearby: float
    beyond: float


def _point(
    joint: Float64Array, places: Float64Array, headings: Float64Array, near: float, beyond: int
) -> SequencePoint:
    """Return the position of a distribution (N + B, K) over windows, B places beyond the map, and headings."""
    shares, windows = joint.sum(axis=1), len(places) - beyond
    best = shares[:windows].argmax()
    kept = np.flatnonzero(((places[:windows] - places[best]) ** 2).sum(axis=1) <= near**2)
    position = shares[kept] @ places[kept] / shares[kept].sum()
    squared = ((places - position) ** 2).sum(axis=1)
    is_near = squared <= near**2
    return SequencePoint(
        position,
        float(np.sqrt(shares @ squared / 2)),
        float(headings[joint[best].argmax()]),
        float(shares[is_near].sum()),
        float(shares[windows:][~is_near[windows:]].sum()),
    )


class ForwardFilter:
    """The forward half of forward-backward, frame by frame, for a flight in progress.

    Args:
        places: centres of the windows, then places beyond the map, in metres, (N + B, 2).
        motion: of the flight.
        beyond: number of places beyond the map, B.

    Attributes:
        belief: probability of each place at each heading, (N + B, K), by all likelihoods so far; None before the first frame.
        headings: of the belief in degrees, (K,); a single NaN if unknown.
    """

    def __init__(self, places: Float64Array, motion: MotionModel, beyond: int = 0) -> None:
        self._places, self._motion, self._grid, self._beyond = places, motion, _Grid(places, beyond), beyond
        self.belief: Float64Array | None = None
        self.headings = np.array([math.nan])

    def predict(self, elapsed: float, headings: Float64Array) -> None:
        """Move the belief to the next frame.

        Args:
            elapsed: seconds since the frame before, NaN if unknown.
            headings: of the next frame, (K,); a single NaN if unknown.
        """
        if self.belief is None:
            self.belief = self._grid.start(len(headings))
        else:
            deviation = float(self._motion.steps([0.0, elapsed])[0])
            step = _Step(self._grid, self._motion, abs(elapsed), deviation, self.headings, headings)
            self.belief = step.push(self.belief)
        self.headings = headings

    def weigh(self, log_likelihoods: Float64Array) -> None:
        """Multiply the belief by likelihoods, whose logs are (N + B, K) or (N + B, 1), and normalise it."""
        assert self.belief is not None
        joint = self.belief * np.exp(log_likelihoods - log_likelihoods.max())
        self.belief = joint / joint.sum()

    def point(self, near: float) -> SequencePoint:
        """Return the drone's position; for `near` see `smooth`."""
        assert self.belief is not None
        return _point(self.belief, self._places, self.headings, near, self._beyond)


def fitted_frames(count: int) -> tuple[int, int]:
    """Return the range of frames that a flight's motion is fitted to: the first, and the one after the last."""
    start = max(count - _FITTED, 0) // 2
    return start, min(start + _FITTED, count)


def fitted(
    scores: OfFrame,
    headings: Sequence[Float64Array],
    places: Float64Array,
    times: npt.ArrayLike,
    spacing: float,
    speed: float | None = None,
) -> tuple[MotionModel, float]:
    """Return the motion model and the temperature at which scores are most probable.

    The trials use the 100 frames in the middle of the flight. The first are speeds in any direction and along the headings, at
    the temperature 0.4. Then come half of the spacing, speeds beside the best one for a motion along the headings, and
    temperatures.

    Args:
        scores: of each frame, (N, K), see `ScoreUnits`.
        headings, places, times: see `smooth`; without places beyond the map.
        spacing: largest one of the motion model in metres.
        speed: metres a second, if known.
    """
    elapsed = np.abs(np.diff(np.asarray(times, np.float64)))
    elapsed = elapsed[elapsed > 0]
    usual = float(np.median(elapsed)) if len(elapsed) else math.inf
    headed = any(not np.isnan(of_frame).any() for of_frame in headings[slice(*fitted_frames(len(headings)))])
    likelihood = _likelihood(scores, headings, places, times)
    speeds = SPEEDS if speed is None else (speed,)
    motions = [
        MotionModel(one, spacing, along=along, usual=usual)
        for along in ((0.0, ALONG) if headed else (0.0,))
        for one in speeds
    ]
    likelihoods = {motion: likelihood(motion, _FIRST_TEMPERATURE) for motion in motions}
    motion = max(likelihoods, key=likelihoods.__getitem__)
    factors = (1 / FINER, 1.0, FINER) if motion.along and speed is None else (1.0,)
    finer = [
        replace(motion, speed=motion.speed * by, spacing=each) for by in factors for each in (spacing, spacing / 2)
    ]
    likelihoods |= {one: likelihood(one, _FIRST_TEMPERATURE) for one in finer if one not in likelihoods}
    motion = max(likelihoods, key=likelihoods.__getitem__)
    return motion, max(TEMPERATURES, key=lambda one: likelihood(motion, one))


def heading_evidence(
    scores: OfFrame,
    headings: Sequence[Float64Array],
    places: Float64Array,
    times: npt.ArrayLike,
    motion: MotionModel,
    temperature: float,
) -> float:
    """Return the log odds of steps along the headings against the likeliest of steps backwards and at right angles.

    Over a map of another place, scores do not depend on the direction of flight, so one direction is seldom much more probable
    than the others. The frames of `fitted_frames` are used.

    Args:
        scores, headings, places, times: see `fitted`.
        motion, temperature: results of `fitted`. The log odds are 0 if steps go in any direction.
    """
    if not motion.along:
        return 0.0
    likelihood = _likelihood(scores, headings, places, times)
    aside = max(likelihood(replace(motion, aside=turn), temperature) for turn in (90.0, 180.0, 270.0))
    return likelihood(motion, temperature) - aside


def _likelihood(
    scores: OfFrame, headings: Sequence[Float64Array], places: Float64Array, times: npt.ArrayLike
) -> Callable[[MotionModel, float], float]:
    start, stop = fitted_frames(len(headings))
    chosen = [scores(t) for t in range(start, stop)]
    seconds = np.asarray(times, np.float64)[start:stop]

    @lru_cache(1)  # the temperatures of one motion are compared in a row
    def steps(motion: MotionModel) -> _Steps:
        return _Steps(headings[start:stop], places, seconds, motion)

    @cache
    def likelihood(motion: MotionModel, temperature: float) -> float:
        chain = _Chain(lambda t: emissions(chosen[t], temperature), steps(motion))
        total, forward = 0.0, None
        for t in range(stop - start):
            forward, gained = chain.forward(t, forward)
            total += gained
        return total

    return likelihood


class _Steps:
    """The steps between the frames of a flight, equal ones computed once; `headings` are of each frame in degrees, (K,)."""

    def __init__(
        self,
        headings: Sequence[Float64Array],
        places: Float64Array,
        times: npt.ArrayLike,
        motion: MotionModel,
        beyond: int = 0,
    ) -> None:
        seconds = np.asarray(times, np.float64)
        self.headings, self._motion = headings, motion
        self._elapsed, self._deviations = np.abs(np.diff(seconds)), motion.steps(seconds)
        self._grid = _Grid(places, beyond)
        self._held = FilledCache[_Step](_HELD_STEPS, lambda step: step.nbytes)

    def start(self, headings: int) -> Float64Array:
        return self._grid.start(headings)

    def __getitem__(self, t: int) -> _Step:
        before, after = self.headings[t : t + 2]
        elapsed, deviation = float(self._elapsed[t]), float(self._deviations[t])
        return self._held.get(
            (elapsed, deviation, before.tobytes(), after.tobytes()),
            lambda: _Step(self._grid, self._motion, elapsed, deviation, before, after),
        )


class _Chain:
    """The hidden Markov model of a flight: its emissions, and the steps between its frames."""

    def __init__(self, log_emissions: OfFrame, steps: _Steps) -> None:
        self._log_emissions, self._steps = log_emissions, steps

    def step(self, t: int) -> _Step:
        return self._steps[t]

    def emission(self, t: int) -> tuple[Float64Array, float]:
        """Return a frame's emissions over the greatest one, (N, K), and the log of that."""
        logs = self._log_emissions(t)
        peak = float(logs.max())
        return np.exp(logs - peak), peak

    def forward(self, t: int, before: Float64Array | None) -> tuple[Float64Array, float]:
        """Return a frame's distribution (N, K) given the scores up to it, from the one `before`, and its log likelihood."""
        emitted, peak = self.emission(t)
        prior = self._steps.start(emitted.shape[1]) if before is None else self.step(t - 1).push(before)
        joint = prior * emitted
        mass = float(joint.sum())
        return joint / mass, math.log(mass) + peak


def _backwards(
    ahead: Callable[[int, Float64Array | None], Float64Array], frames: int
) -> Iterator[tuple[int, Float64Array]]:
    """Yield each frame and its value from the last to the first; `ahead` computes a value from the one before.

    Only every sqrt(T)-th value is stored; the others are computed again.
    """
    stride = math.isqrt(frames - 1) + 1
    kept: list[Float64Array] = []
    value = None
    for t in range(frames):
        value = ahead(t, value)
        if t % stride == 0:
            kept.append(value)
    for start in reversed(range(0, frames, stride)):
        block = [kept.pop()]
        for t in range(start + 1, min(start + stride, frames)):
            block.append(ahead(t, block[-1]))
        while block:
            yield start + len(block) - 1, block.pop()


def merged_coordinates(values: Float64Array) -> tuple[Float64Array, Int64Array]:
    """Return the distinct coordinates of values (N,) in ascending order, (M,), and each value's index among them, (N,).

    Coordinates less than 2 cm apart are merged into their mean.
    """
    order = np.argsort(values, kind="stable")
    group = np.empty(len(values), np.int64)
    group[order] = np.cumsum(np.diff(values[order], prepend=values.min()) > _ONE_COORDINATE)
    return np.bincount(group, values) / np.bincount(group), group


class _Grid:
    """Places as cells of a grid of their merged x and y; the last `beyond` of them are beyond the map.

    Attributes:
        axes: the merged coordinates along x and y, (X,) and (Y,).
        columns, rows: of each place, (N,).
        is_beyond: whether each place is beyond the map, (N,).
        bands: rows and columns that together contain all places beyond the map, (R,) and (C,).
    """

    def __init__(self, places: Float64Array, beyond: int = 0) -> None:
        (x, self.columns), (y, self.rows) = map(merged_coordinates, places.T)
        self.axes = x, y
        self._cells = self.rows * len(x) + self.columns
        self.is_beyond = np.arange(len(places)) >= len(places) - beyond
        out = np.zeros((len(y), len(x)), bool)
        out[self.rows[self.is_beyond], self.columns[self.is_beyond]] = True
        in_row = out & (out.mean(axis=1)[:, None] >= out.mean(axis=0))
        self.bands = np.flatnonzero(in_row.any(axis=1)), np.flatnonzero((out & ~in_row).any(axis=0))

    def start(self, headings: int) -> Float64Array:
        count, out = len(self.is_beyond), int(self.is_beyond.sum())
        share = _BEGIN if out else 0.0
        each = np.where(self.is_beyond, share / max(out, 1), (1 - share) / (count - out)) / headings
        return np.repeat(each[:, None], headings, axis=1)

    def image(self, values: Float64Array) -> Float64Array:
        """Return the sums of values (N, K) in each cell, (K, Y, X)."""
        x, y = self.axes
        sums = [np.bincount(self._cells, of_heading, len(x) * len(y)) for of_heading in values.T]
        return np.array(sums, np.float64).reshape(-1, len(y), len(x))

    def values(self, image: Float64Array) -> Float64Array:
        return image[:, self.rows, self.columns].T


class _Step:
    """The transition from one frame to the next.

    Its kernel is a mixture of Gaussians of the way between two places, for each heading before the step, normalised by source.
    Steps from a window to a place beyond the map are less probable by a factor. A Gaussian is a product of one along x and one
    along y, so sums over all pairs of places are products of matrices.
    """

    def __init__(
        self,
        grid: _Grid,
        motion: MotionModel,
        elapsed: float,
        deviation: float,
        before: Float64Array,
        after: Float64Array,
    ) -> None:
        self._grid, self._turns = grid, motion.turns(elapsed, before, after)
        self._count = len(after)
        means, deviations, weights = np.zeros((1, 1, 2)), np.array([deviation]), np.ones(1)
        if motion.along and not np.isnan(elapsed) and not np.isnan(before).any():
            drifts = motion.speed * elapsed * _legs(before + motion.aside, after + motion.aside)
            along = np.hypot(motion.spacing, _ALONG_DEVIATION * motion.speed * elapsed)
            means = np.concatenate([np.zeros((len(before), 1, 2)), drifts], axis=1)
            legs = drifts.shape[1]
            deviations = np.array([deviation] + [along] * legs)
            weights = np.array([1 - motion.along] + [motion.along / legs] * legs)
        if elapsed > _LONG * motion.usual:
            means = np.concatenate([means, np.zeros((len(means), 1, 2))], axis=1)
            deviations = np.append(deviations, np.hypot(motion.spacing, motion.speed * motion.usual))
            weights = np.append((1 - _PAUSE) * weights, _PAUSE)
        self._x, self._y = (
            np.exp(-((axis[:, None] - axis - means[..., d, None, None]) ** 2) / (2 * deviations[:, None, None] ** 2))
            for d, axis in enumerate(grid.axes)
        )
        self._y *= (weights / deviations**2)[:, None, None]
        self._scale = self._back(np.ones((len(grid.is_beyond), 1))) / (1 - _JUMP)

    @property
    def nbytes(self) -> int:
        return sum(array.nbytes for array in (self._x, self._y, self._scale, self._turns))

    def push(self, weights: Float64Array) -> Float64Array:
        """Return the distribution (N, M) after the step from the one before it, (N, K)."""
        scaled, out = weights / self._scale, self._grid.is_beyond[:, None]
        after = self._grid.values(self._blurred(self._grid.image(np.where(out, 0, scaled))))
        if out.any():
            stayed = self._grid.values(self._blurred_beyond(self._grid.image(np.where(out, scaled, 0))))
            after = np.where(out, _LEAVE, 1) * after + stayed
        after = after @ self._turns
        return cast(Float64Array, after + _JUMP * weights.sum() / after.size)

    def pull(self, message: Float64Array) -> Float64Array:
        """Return the expectation (N, K) of a message (N, M) over the step's targets."""
        return cast(Float64Array, self._back(message @ self._turns.T) / self._scale + _JUMP * message.mean())

    def _back(self, values: Float64Array) -> Float64Array:
        """Return the unnormalised sums (N, K) over the step's targets of their values, (N, K) or (N, 1)."""
        out = self._grid.is_beyond[:, None]
        before = self._grid.values(self._blurred(self._grid.image(np.where(out, 0, values)), back=True))
        if out.any():
            left = self._grid.values(self._blurred_beyond(self._grid.image(np.where(out, values, 0)), back=True))
            before += np.where(out, 1, _LEAVE) * left
        return before

    def _blurred(self, image: Float64Array, back: bool = False) -> Float64Array:
        """Return the sums (K, Y, X) of an image (K, Y, X) over sources, or, if `back`, over targets."""
        x, y = self._kernels(back)
        return cast(Float64Array, (y @ image[:, None] @ x).sum(axis=1))

    def _blurred_beyond(self, image: Float64Array, back: bool = False) -> Float64Array:
        """Compute `_blurred` for an image that is 0 except beyond the map, which is few rows and columns."""
        (x, y), (rows, columns) = self._kernels(back), self._grid.bands
        beside = image[:, None, :, columns]
        beside[..., rows, :] = 0
        along_rows = y[..., rows] @ (image[:, None, rows] @ x)
        return cast(Float64Array, (along_rows + y @ beside @ x[..., columns, :]).sum(axis=1))

    def _kernels(self, back: bool) -> tuple[Float64Array, Float64Array]:
        """Return the factors of an image from the right and from the left."""
        return (self._x, self._y.swapaxes(-1, -2)) if back else (self._x.swapaxes(-1, -2), self._y)


def _legs(before: Float64Array, after: Float64Array) -> Float64Array:
    """Return steps of unit speed and time, (K, legs, 2), along headings before and after in degrees, (K,) and (M,).

    With M above 1, or NaN after the step, all steps go along the headings before them.
    """
    shares = np.array(_LEGS if len(after) == 1 and not np.isnan(after[0]) else (1.0,))[:, None]
    first, last = (
        np.stack([np.sin(angles), np.cos(angles)], axis=-1) for angles in map(np.radians, (before, after[:1]))
    )
    return cast(Float64Array, shares * first[:, None] + (1 - shares) * np.nan_to_num(last))
