"""A hidden Markov model over places and headings, by which the frames of a flight correct each other.

A state is a window of the map and a heading of the picture. The emission is a softmax of the scores at a temperature, mixed with
a floor for misleading scores. Forward-backward gives each frame's posterior (Rabiner, Proc. IEEE 77, 1989).

Speed, kind of motion, and temperature maximise the probability of the flight's scores. A window's scores are divided by its usual
score from frames of other places. So a window that resembles many frames, such as a ploughed field, proves little.

A drone may leave the map, so places beyond its edge are states, too. They have no window, so a frame has one emission for all of
them. A frame lies there if the flight's way leads there, and no window along it fits better than others. Leaving the map is rare.
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
# Tried speeds in metres a second, tried temperatures, and maximum of frames for these trials.
SPEEDS = (4.0, 6.0, 9.0, 13.0, 19.0, 28.0)
TEMPERATURES = (0.25, 0.33, 0.4, 0.5, 0.67, 1.0)
_FIRST_TEMPERATURE = 0.4
_FITTED = 100
# Share of a uniform distribution in the emissions.
_FLOOR = 1e-4
# Tried probability of steps along the headings, beside 0, and factor between the tried speeds along them.
ALONG, FINER = 0.9, 1.2
# Metres of a step of unknown time, one standard deviation.
_UNKNOWN_STEP = 60.0
# Deviation of a step along the headings as a share of its length, by wind and varying speed.
_ALONG_DEVIATION = 0.3
# Shares of a step's time along the heading before it; the rest is along the heading after it.
_LEGS = (0.0, 0.25, 0.5, 0.75, 1.0)
# Standard deviations in degrees between a picture's heading and the nearest tried one, and of the turns in a second.
_HEADING_DEVIATION, _TURN_RATE = 20.0, 1.0
# Probability that a heading is independent of the heading before.
_ANY_HEADING = 0.1
# Multiple of the usual seconds above which a step may be a pause, and the probability of a pause.
_LONG, _PAUSE = 3.0, 0.5
# Log odds of a place beyond the map against a window of mean share, for a frame on the ground of the last frame: one wrong
# window then suits both frames.
_ALIKE = 1.5
# Factor of the probability of a step off the map, and probability of a first frame beyond it.
_LEAVE, _BEGIN = 1e-3, 0.1
# Probability of a step outside the motion model, as between separate parts of a flight, or at a jump of the clock.
_JUMP = 1e-3
# Metres within which coordinates are equal: an index's names round them to about 1 cm.
_ONE_COORDINATE = 0.02
# Maximum of bytes of steps in memory: a flight uses each several times, and equal ones are shared.
_HELD_STEPS = 1 << 26


@dataclass(frozen=True)
class MotionModel:
    """The motion of the flight between frames.

    A step goes along the headings, or in any direction. Along the headings, it follows the heading before it for a part of
    the time, then the heading after it, if that is unique. A step of more than three times the usual seconds is a pause with
    probability 1/2: the drone hovers or lands, and goes on by one usual step.

    Attributes:
        speed: metres a second of a step along the headings, or one standard deviation of a step in any direction.
        spacing: metres added to the deviation of a step, because windows lie on a grid and pictures tilt.
        along: probability that a step goes along the headings, 0 .. 1.
        usual: seconds of a usual step; infinite if no step is a pause.
        aside: degrees clockwise from the heading to the direction of a step along it.
    """

    speed: float = 15.0
    spacing: float = 25.0
    along: float = 0.0
    usual: float = math.inf
    aside: float = 0.0

    def deviation(self, elapsed: npt.ArrayLike) -> Float64Array:
        """Return the standard deviation in metres of a step in any direction, by its seconds, NaN if unknown."""
        seconds = np.asarray(elapsed, np.float64)
        return np.where(np.isnan(seconds), _UNKNOWN_STEP, np.hypot(self.speed * seconds, self.spacing))

    def alike(self, elapsed: npt.ArrayLike, side: float) -> Float64Array:
        """Return the share of a window's `side`, in metres, that frames have in common after a step; 0 if its time is unknown."""
        return np.nan_to_num(np.clip(1 - self.speed * np.asarray(elapsed, np.float64) / side, 0, 1))

    def turns(self, elapsed: float, before: Float64Array, after: Float64Array) -> Float64Array:
        """Return the probability of each heading after a step, (K, M); each row sums to 1.

        Args:
            elapsed: seconds, NaN if unknown.
            before, after: headings in degrees, (K,) and (M,), NaN if unknown.
        """
        change = wrap_degrees(after - before[:, None])
        deviation = np.hypot(_HEADING_DEVIATION, _TURN_RATE * elapsed)
        if np.isnan(change).any() or np.isnan(deviation):
            return np.full(change.shape, 1 / len(after))
        likely = sum(np.exp(-((change + turn) ** 2) / (2 * deviation**2)) for turn in (-360, 0, 360))
        # If all headings are far from the one before, they are equally likely.
        likely = np.maximum(likely, 1e-12)
        shares = likely / likely.sum(axis=1, keepdims=True)
        return cast(Float64Array, (1 - _ANY_HEADING) * shares + _ANY_HEADING / len(after))


def elapsed_seconds(times: npt.ArrayLike) -> Float64Array:
    """Return the seconds from the frame before to each frame, (T,), by their times; NaN where unknown, and for the first."""
    return np.abs(np.diff(np.asarray(times, np.float64), prepend=math.nan))


def score_units(
    scores: npt.ArrayLike, deviations: Float64Array, side: float, compared: BoolArray
) -> Callable[[int, Float64Array], Float64Array]:
    """Return a function that converts scores of a frame, (N, K), to units of the usual scores of the frame and of each window.

    Each frame's scores get mean 0 and variance 1, or become 0 if they are all equal. Each score is then divided by the root mean
    square of its window's scores from frames of other places and from 30 more frames of unit score.

    Args:
        scores: (T, N), at each window's best heading.
        deviations: of the step to each frame but the first, in metres, (T - 1,). Frames are of other places if the standard
            deviation of the motion between them exceeds `side`.
        side: of a window in metres.
        compared: scores that count, (T, N); the others get their frame's least score.
    """
    values = np.array(scores, np.float64)
    number = np.maximum(compared.sum(axis=1, keepdims=True), 1)
    means = values.sum(axis=1, keepdims=True, where=compared) / number
    values -= means
    deviation = np.sqrt((values**2).sum(axis=1, keepdims=True, where=compared) / number)
    varied = deviation > 1e-9
    scales = np.where(varied, 1 / np.where(varied, deviation, 1), 0)
    values = np.where(compared, values * scales, 0)
    squares, frames = (
        np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(of_frame, axis=0)])
        for of_frame in (values**2, (compared & varied).astype(np.float64))
    )
    variance = np.concatenate([[0.0], np.cumsum(np.square(deviations))])
    near = np.searchsorted(variance, [variance - side**2, np.nextafter(variance + side**2, np.inf)], "left")
    first, last = np.minimum(near[0], np.arange(len(values))), np.maximum(near[1], np.arange(len(values)) + 1)
    mean_square = (squares[-1] - squares[last] + squares[first] + PRIOR_FRAMES) / (
        frames[-1] - frames[last] + frames[first] + PRIOR_FRAMES
    )
    units = np.sqrt(mean_square)
    least, factors = np.min(values / units, axis=1, where=compared, initial=0.0), scales / units

    def standardised(frame: int, scores: Float64Array) -> Float64Array:
        in_units = (scores - means[frame]) * factors[frame, :, None]
        return cast(Float64Array, np.where(compared[frame, :, None], in_units, least[frame]))

    return standardised


def emissions(
    scores: Float64Array, temperature: float = _FIRST_TEMPERATURE, beyond: int = 0, alike: float = 0.0
) -> Float64Array:
    """Return log emissions of one frame: log of (softmax of score / temperature + floor / (N K)), normalised.

    Places beyond the map follow the windows. Their share is 1 / (N K), times up to e^1.5 if the frame resembles the last one. A
    frame of equal scores, such as an unreadable photo, is no evidence.

    Args:
        scores: of windows at headings, (N, K).
        temperature: of the softmax, in units of the score, see `score_units`.
        beyond: number of places beyond the map, B.
        alike: share of the ground in common with the last frame, 0 .. 1, see `MotionModel.alike`.

    Returns:
        (N + B, K) float64.
    """
    values = np.asarray(scores, np.float64)
    shares = np.exp((values - values.max()) / temperature)
    shares /= shares.sum()
    logs = np.log((1 - _FLOOR) * shares + _FLOOR / values.size)
    more = _ALIKE * alike if np.ptp(values) > 0 else 0.0
    return np.concatenate([logs, np.full((beyond, values.shape[1]), more - math.log(values.size))])


class SequencePoint(NamedTuple):
    """A frame's place by a distribution over windows, places beyond the map, and headings.

    Attributes:
        position: mean of the distribution near the likeliest window in metres, (2,).
        radius: 1-sigma radius in metres of the whole distribution about that position.
        heading: the likeliest heading in that window in degrees; NaN if unknown.
        nearby: probability of all places near the position.
        beyond: probability of all places beyond the map that are not near the position.
    """

    position: Float64Array
    radius: float
    heading: float
    nearby: float
    beyond: float

    @classmethod
    def of(
        cls, joint: Float64Array, places: Float64Array, headings: Float64Array, near: float, beyond: int = 0
    ) -> SequencePoint:
        """Return the place by a distribution, (N + B, K).

        Args:
            places: centres of the windows, then B places beyond the map, in metres, (N + B, 2).
            headings: in degrees, (K,).
            near: metres around the likeliest window within which windows contribute to the position, so that it does not lie
                between two places; also the radius of `nearby`.
            beyond: number of places beyond the map, B, which are never the position.
        """
        shares, windows = joint.sum(axis=1), len(places) - beyond
        best = shares[:windows].argmax()
        kept = np.flatnonzero(((places[:windows] - places[best]) ** 2).sum(axis=1) <= near**2)
        position = shares[kept] @ places[kept] / shares[kept].sum()
        squared = ((places - position) ** 2).sum(axis=1)
        is_near = squared <= near**2
        return cls(
            position,
            float(np.sqrt(shares @ squared / 2)),
            float(headings[joint[best].argmax()]),
            float(shares[is_near].sum()),
            float(shares[windows:][~is_near[windows:]].sum()),
        )


class ForwardFilter:
    """A belief over places and headings, which goes from frame to frame: the forward half of forward-backward.

    Args:
        places: centres of the windows, then places beyond the map, in metres, (N + B, 2). Fewer distinct x and y take less time.
        motion: of the flight.
        beyond: number of places beyond the map, B.
        held: maximum of bytes of steps in memory, for equal steps that follow.

    Attributes:
        belief: probability of each place at each heading, (N + B, K), by all likelihoods so far; None before the first frame.
        headings: of the belief in degrees, (K,); a single NaN if unknown.
    """

    def __init__(self, places: Float64Array, motion: MotionModel, beyond: int = 0, held: int = 0) -> None:
        self._motion, self._grid = motion, _Grid(places, beyond)
        self._held = FilledCache[_Step](held, lambda step: step.nbytes)
        self.belief: Float64Array | None = None
        self.headings = np.array([math.nan])

    def step(self, elapsed: float, before: Float64Array, after: Float64Array) -> _Step:
        """Return the step of some seconds, NaN if unknown, from headings before it to headings after it."""
        key = elapsed, before.tobytes(), after.tobytes()
        return self._held.get(key, lambda: _Step(self._grid, self._motion, elapsed, before, after))

    def predict(self, elapsed: float, headings: Float64Array) -> None:
        """Move the belief to the next frame and its headings, (K,), after some seconds, NaN if unknown."""
        if self.belief is None:
            self.belief = self._grid.start(len(headings))
        else:
            self.belief = self.step(elapsed, self.headings, headings).push(self.belief)
        self.headings = headings

    def weigh(self, log_likelihoods: Float64Array) -> float:
        """Multiply the belief by likelihoods, whose logs are (N + B, K) or (N + B, 1); return the log of their mean."""
        assert self.belief is not None
        peak = float(log_likelihoods.max())
        joint = self.belief * np.exp(log_likelihoods - peak)
        mass = float(joint.sum())
        self.belief = joint / mass
        return math.log(mass) + peak


def posteriors(
    log_emissions: OfFrame,
    headings: Sequence[Float64Array],
    places: Float64Array,
    times: npt.ArrayLike,
    motion: MotionModel,
    beyond: int = 0,
) -> Iterator[tuple[int, Float64Array]]:
    """Run forward-backward, and yield each frame and its posterior (N + B, K), from the last frame to the first.

    Every sqrt(T)-th forward distribution is stored, and the others are computed again, so memory is O(sqrt(T) N K).

    Args:
        log_emissions: of each frame, (N + B, K), see `emissions`.
        headings: of each frame in degrees, (K,); a single NaN if unknown.
        places, motion, beyond: see `ForwardFilter`.
        times: seconds, (T,), NaN where unknown.
    """
    forward, elapsed, frames = ForwardFilter(places, motion, beyond, _HELD_STEPS), elapsed_seconds(times), len(headings)

    def advanced(t: int) -> Float64Array:
        forward.predict(float(elapsed[t]), headings[t])
        forward.weigh(log_emissions(t))
        assert forward.belief is not None
        return forward.belief

    stride = math.isqrt(frames - 1) + 1
    stored = [belief for t in range(frames) for belief in [advanced(t)] if t % stride == 0]
    behind = np.ones((len(places), len(headings[-1])))
    for start in reversed(range(0, frames, stride)):
        forward.belief, forward.headings = stored[-1], headings[start]
        block = [stored.pop(), *(advanced(t) for t in range(start + 1, min(start + stride, frames)))]
        for t in reversed(range(start, start + len(block))):
            if t < frames - 1:
                logs = log_emissions(t + 1)
                step = forward.step(float(elapsed[t + 1]), headings[t], headings[t + 1])
                behind = step.pull(behind * np.exp(logs - logs.max()))
                behind /= behind.max()
            joint = block.pop() * behind
            yield t, joint / joint.sum()


def fitted(
    scores: OfFrame, headings: Sequence[Float64Array], places: Float64Array, times: npt.ArrayLike, spacing: float
) -> tuple[MotionModel, float, float]:
    """Return the motion model and the temperature at which scores are most probable, and the evidence of the headings.

    The trials use the 100 frames in the middle of the flight. The first are speeds in any direction and along the headings, at
    the temperature 0.4. Then come half of the spacing, speeds near the best speed along the headings, and temperatures.

    The evidence is the log odds of steps along the headings against the likeliest of steps backwards and at right angles; 0 if
    steps go in any direction. Over a map of another place, scores do not depend on the direction of flight, so one direction is
    seldom much more probable than the others.

    Args:
        scores: of each frame, (N, K), see `score_units`.
        headings, places, times: see `posteriors`; without places beyond the map.
        spacing: largest spacing of the motion model in metres.
    """
    start = max(len(headings) - _FITTED, 0) // 2
    chosen = range(start, min(start + _FITTED, len(headings)))
    of_frames, elapsed = [scores(t) for t in chosen], elapsed_seconds(times)

    @lru_cache(1)  # the temperatures of one motion are compared in a row
    def forward(motion: MotionModel) -> ForwardFilter:
        return ForwardFilter(places, motion, held=_HELD_STEPS)

    @cache
    def likelihood(motion: MotionModel, temperature: float) -> float:
        belief, total = forward(motion), 0.0
        belief.belief = None
        for t, of_frame in zip(chosen, of_frames, strict=True):
            belief.predict(float(elapsed[t]), headings[t])
            total += belief.weigh(emissions(of_frame, temperature))
        return total

    known = elapsed[elapsed > 0]
    usual = float(np.median(known)) if len(known) else math.inf
    headed = any(not np.isnan(headings[t]).any() for t in chosen)
    tried = [MotionModel(one, spacing, along, usual) for along in (0.0, ALONG)[: 1 + headed] for one in SPEEDS]
    motion = max(tried, key=lambda one: likelihood(one, _FIRST_TEMPERATURE))
    factors = (1 / FINER, 1.0, FINER) if motion.along else (1.0,)
    tried += [
        replace(motion, speed=motion.speed * by, spacing=each) for by in factors for each in (spacing, spacing / 2)
    ]
    motion = max(tried, key=lambda one: likelihood(one, _FIRST_TEMPERATURE))
    temperature = max(TEMPERATURES, key=lambda one: likelihood(motion, one))
    if not motion.along:
        return motion, temperature, 0.0
    aside = max(likelihood(replace(motion, aside=turn), temperature) for turn in (90.0, 180.0, 270.0))
    return motion, temperature, likelihood(motion, temperature) - aside


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

    Its kernel is a mixture of Gaussians of the way between two places, for each heading before the step, normalised per source.
    Steps from a window to a place beyond the map are less probable by a factor. A Gaussian is a product of Gaussians along x
    and y, so sums over all pairs of places are products of matrices.
    """

    def __init__(
        self,
        grid: _Grid,
        motion: MotionModel,
        elapsed: float,
        before: Float64Array,
        after: Float64Array,
    ) -> None:
        self._grid, self._turns = grid, motion.turns(elapsed, before, after)
        deviation = float(motion.deviation(elapsed))
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
        """Return the distribution (N, M) after the step from the distribution before it, (N, K)."""
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
        """Compute `_blurred` for an image that is 0 except beyond the map, in few rows and columns."""
        (x, y), (rows, columns) = self._kernels(back), self._grid.bands
        beside = image[:, None, :, columns]
        beside[..., rows, :] = 0
        along_rows = y[..., rows] @ (image[:, None, rows] @ x)
        return cast(Float64Array, (along_rows + y @ beside @ x[..., columns, :]).sum(axis=1))

    def _kernels(self, back: bool) -> tuple[Float64Array, Float64Array]:
        """Return the factors of an image from the right and from the left."""
        return (self._x, self._y.swapaxes(-1, -2)) if back else (self._x.swapaxes(-1, -2), self._y)


def _legs(before: Float64Array, after: Float64Array) -> Float64Array:
    """Return steps of unit speed and time, (K, legs, 2), along headings before and, if unique, after, (K,) and (M,)."""
    shares = np.array(_LEGS if len(after) == 1 and not np.isnan(after[0]) else (1.0,))[:, None]
    first, last = (
        np.stack([np.sin(angles), np.cos(angles)], axis=-1) for angles in map(np.radians, (before, after[:1]))
    )
    return cast(Float64Array, shares * first[:, None] + (1 - shares) * np.nan_to_num(last))
