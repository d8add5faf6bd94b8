"""A hidden Markov model over places: the frames of a flight correct each other.

A state is a window of the map. The motion model is a Gaussian step from frame to frame, the emission a softmax of the scores at
a temperature, mixed with a floor for frames whose scores mislead. Forward-backward gives each frame's posterior, Viterbi the most
probable path (Rabiner, Proceedings of the IEEE 77, 1989).
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import Float64Array, Int64Array
from lpn.core.errors import InputError

# Steps beyond this many standard deviations have the floor of the motion model alone.
_REACH = 4.0
# Rows of a transition matrix that are computed at once.
_BLOCK = 256
# Pairs of windows that all transitions in memory hold together, at 20 bytes each.
_MAX_PAIRS = 10**7
# Steps are rounded to powers of this, so that frames share a few transitions.
_STEP_FACTOR = 1.1
# Probability that a step is not of the motion model: a gap in the flight, or a jump of the clock.
_JUMP = 1e-6


@dataclass(frozen=True)
class MotionModel:
    """How far the flight moves between frames.

    Attributes:
        speed: metres a second, one standard deviation.
        spacing: metres added to the step, for the windows lie on a grid and pictures tilt.
        unknown: metres of a step whose time is unknown.
    """

    speed: float = 15.0
    spacing: float = 25.0
    unknown: float = 60.0

    def __post_init__(self) -> None:
        if not (self.speed > 0 and self.spacing > 0 and self.unknown > 0):
            raise InputError(
                f"The motion model has speed {self.speed:g}, spacing {self.spacing:g}, and step {self.unknown:g}; expected "
                "numbers above 0."
            )

    def steps(self, times: npt.ArrayLike) -> Float64Array:
        """Return the standard deviation in metres of each step, (T - 1,), between frames at times (T,), NaN where unknown."""
        elapsed = np.abs(np.diff(np.asarray(times, np.float64)))
        steps = np.where(np.isnan(elapsed), self.unknown, np.hypot(self.speed * elapsed, self.spacing))
        return cast(Float64Array, _STEP_FACTOR ** np.round(np.log(steps) / np.log(_STEP_FACTOR)))


@dataclass(frozen=True, eq=False)
class SequenceResult:
    """A flight as a track over the states.

    Attributes:
        positions: mean of each frame's posterior near its likeliest state in metres, (T, 2) float64.
        radii: 1-sigma radius in metres of each posterior, all states included, about that position, (T,) float64.
        likeliest: state of the greatest posterior, (T,) int64.
        probabilities: that posterior, (T,) float64.
        path: Viterbi's states, (T,) int64.
        own: state of each frame's best score, (T,) int64.
        moved: metres from that state to `positions`, (T,) float64.
        log_likelihood: log of the probability of the scores.
    """

    positions: Float64Array
    radii: Float64Array
    likeliest: Int64Array
    probabilities: Float64Array
    path: Int64Array
    own: Int64Array
    moved: Float64Array
    log_likelihood: float

    def sentence(self, frame: int) -> str:
        """Say how far the neighbours moved a frame."""
        moved = self.moved[frame]
        if self.likeliest[frame] == self.own[frame]:
            return "The neighbours agree with the picture's own answer."
        return f"It was moved by {moved:.0f} m from the picture's own answer, outvoted by its neighbours."


def emissions(scores: npt.ArrayLike, temperature: float = 0.05, floor: float = 1e-4) -> Float64Array:
    """Return log emissions of scores: log of (softmax of score / temperature + floor / N), normalised.

    Args:
        scores: (T, N), or (T, N, headings): the best heading of each window counts.
        temperature: of the softmax, in units of the score.
        floor: share of a uniform distribution, 0 .. 1.

    Returns:
        (T, N) float64.

    Raises:
        InputError: if a number is out of range or not finite.
    """
    values = np.asarray(scores, np.float64)
    if values.ndim == 3:
        values = values.max(axis=2)
    if values.ndim != 2 or 0 in values.shape or not np.isfinite(values).all():
        raise InputError(
            f"The scores have the shape {values.shape}; expected finite numbers of shape (frames, windows)."
        )
    if not (temperature > 0 and 0 <= floor < 1):
        raise InputError(
            f"The temperature is {temperature:g} and the floor {floor:g}; expected a temperature above 0 and a floor of 0 "
            "or more and below 1."
        )
    values = values / temperature
    values -= values.max(axis=1, keepdims=True)
    shares = np.exp(values)
    shares /= shares.sum(axis=1, keepdims=True)
    with np.errstate(divide="ignore"):
        return cast(Float64Array, np.log((1 - floor) * shares + floor / values.shape[1]))


def smooth(
    log_emissions: Float64Array, places: Float64Array, steps: Float64Array, near: float = math.inf
) -> SequenceResult:
    """Run forward-backward and Viterbi.

    Transitions are sparse: steps of more than four standard deviations count as jumps. So do shorter ones where more than
    10^7 pairs of windows would be near enough. Memory is O(frames x windows + pairs).

    Args:
        log_emissions: (T, N), see `emissions`.
        places: centres of the windows in metres, (N, 2).
        steps: standard deviation of each step in metres, (T - 1,), see `MotionModel.steps`.
        near: metres around the likeliest state within which states count for a frame's position, so that it does not lie between
            two places.

    Raises:
        InputError: if the shapes do not fit.
    """
    frames, states = log_emissions.shape
    if places.shape != (states, 2) or steps.shape != (frames - 1,):
        raise InputError(
            f"There are {frames} frames and {states} windows, but places of shape {places.shape} and {steps.shape[0]} steps; "
            f"expected ({states}, 2) and {frames - 1}."
        )
    order = np.argsort(places[:, 0], kind="stable")
    sorted_places, emitted = places[order], log_emissions[:, order]
    transition_of = _Transitions(sorted_places)
    forward = np.empty((frames, states))
    scores = np.empty((frames, states))
    total = 0.0
    for t in range(frames):
        if t == 0:
            prior = np.full(states, 1.0 / states)
            scores[0] = -np.log(states) + emitted[0]
        else:
            transition = transition_of(float(steps[t - 1]))
            prior = transition.push(forward[t - 1])
            scores[t] = transition.best(scores[t - 1]) + emitted[t]
        peak = emitted[t].max()
        joint = prior * np.exp(emitted[t] - peak)
        mass = joint.sum()
        total += float(np.log(mass) + peak)
        forward[t] = joint / mass
    posterior = forward  # overwritten from the end, when the forward values are no longer needed
    behind = np.ones(states)
    for t in range(frames - 2, -1, -1):
        message = behind * np.exp(emitted[t + 1] - emitted[t + 1].max())
        behind = transition_of(float(steps[t])).pull(message)
        behind /= behind.max()
        posterior[t] = forward[t] * behind
        posterior[t] /= posterior[t].sum()
    path = np.empty(frames, np.int64)
    path[-1] = scores[-1].argmax()
    for t in range(frames - 1, 0, -1):
        path[t - 1] = transition_of(float(steps[t - 1])).source(scores[t - 1], int(path[t]))
    likeliest = posterior.argmax(axis=1)
    positions = np.stack(
        [
            _local_mean(shares, sorted_places, sorted_places[i], near)
            for shares, i in zip(posterior, likeliest, strict=True)
        ]
    )
    # The mean square distance of the whole posterior, other places included.
    second = posterior @ (sorted_places**2).sum(axis=1) - 2 * (positions * (posterior @ sorted_places)).sum(axis=1)
    radii = np.sqrt(np.maximum(second + (positions**2).sum(axis=1), 0) / 2)
    own = log_emissions.argmax(axis=1)
    return SequenceResult(
        positions,
        radii,
        order[likeliest],
        posterior[np.arange(frames), likeliest],
        order[path],
        own,
        np.linalg.norm(positions - places[own], axis=1),
        total,
    )


def _local_mean(shares: Float64Array, places: Float64Array, middle: Float64Array, near: float) -> Float64Array:
    """Return the mean of places (N, 2) within a distance of one of them, weighted by shares (N,)."""
    kept = ((places - middle) ** 2).sum(axis=1) <= near**2
    return cast(Float64Array, shares[kept] @ places[kept] / shares[kept].sum())


class _Transitions:
    """Transitions by step (LRU), of at most `_MAX_PAIRS` pairs together: most cameras trigger at one interval."""

    def __init__(self, places: Float64Array) -> None:
        self._places = places
        self._kept: OrderedDict[float, _Transition] = OrderedDict()

    def __call__(self, step: float) -> _Transition:
        if step not in self._kept:
            coming = min(_pairs_within(self._places, _REACH * step), _MAX_PAIRS)
            while self._kept and self.pairs + coming > _MAX_PAIRS:
                self._kept.popitem(last=False)
            self._kept[step] = _Transition(self._places, step)
        self._kept.move_to_end(step)
        return self._kept[step]

    @property
    def pairs(self) -> int:
        return sum(transition.pairs for transition in self._kept.values())


class _Transition:
    """The transition of one step: a sparse symmetric kernel, normalised by source, and a small probability of any jump.

    Attributes:
        pairs: of windows near enough.
    """

    def __init__(self, places: Float64Array, step: float) -> None:
        reach = _REACH * step
        if (dense := _pairs_within(places, reach)) > _MAX_PAIRS:
            reach *= float(np.sqrt(_MAX_PAIRS / dense))
        x = places[:, 0]
        columns, kernel, counts = [], [], []
        for start in range(0, len(x), _BLOCK):
            stop = min(start + _BLOCK, len(x))
            low, high = np.searchsorted(x, (x[start] - reach, x[stop - 1] + reach), "left")
            high = min(high + 1, len(x))
            off = places[start:stop, None] - places[None, low:high]
            squared = (off**2).sum(axis=2)
            near = squared <= reach**2
            columns.append((np.nonzero(near)[1] + low).astype(np.int32))
            kernel.append(np.exp(-squared[near] / (2 * step**2)))
            counts.append(near.sum(axis=1))
        self._columns = np.concatenate(columns)
        del columns
        # Entry (target, source): the kernel is symmetric, and its normalisation is that of the source.
        self._kernel = np.concatenate(kernel)
        del kernel
        rows = np.concatenate(counts)
        self._starts = np.concatenate([[0], np.cumsum(rows)[:-1]])
        self._scale = np.add.reduceat(self._kernel, self._starts) / (1 - _JUMP)
        self._ways = self._kernel / self._scale[self._columns]
        self._ways += _JUMP / len(x)
        np.log(self._ways, out=self._ways)
        self.pairs = len(self._columns)

    def push(self, weights: Float64Array) -> Float64Array:
        """Return the distribution (N,) after the step."""
        return cast(Float64Array, self._summed(weights / self._scale) + _JUMP * weights.mean())

    def pull(self, message: Float64Array) -> Float64Array:
        """Return the expectation (N,) of a message over the step's targets."""
        return cast(Float64Array, self._summed(message) / self._scale + _JUMP * message.mean())

    def _summed(self, values: Float64Array) -> Float64Array:
        near = values[self._columns]
        near *= self._kernel
        return cast(Float64Array, np.add.reduceat(near, self._starts))

    def best(self, scores: Float64Array) -> Float64Array:
        """Return the log probability (N,) of the best way to each target."""
        near = scores[self._columns]
        near += self._ways
        ways = np.maximum.reduceat(near, self._starts)
        return cast(Float64Array, np.maximum(ways, scores.max() + np.log(_JUMP / len(scores))))

    def source(self, scores: Float64Array, target: int) -> int:
        """Return the source of the best way to one target."""
        start = self._starts[target]
        stop = self._starts[target + 1] if target + 1 < len(self._starts) else len(self._columns)
        ways = self._ways[start:stop] + scores[self._columns[start:stop]]
        near, jump = int(ways.argmax()), int(scores.argmax())
        return jump if scores[jump] + np.log(_JUMP / len(scores)) > ways[near] else int(self._columns[start + near])


def _pairs_within(places: Float64Array, reach: float) -> float:
    """Estimate how many pairs of places lie within a distance, from a sample."""
    sample = places[np.linspace(0, len(places) - 1, min(len(places), 100)).astype(np.int64)]
    off = sample[:, None] - places[None]
    return float(((off**2).sum(axis=2) <= reach**2).mean() * len(places) ** 2)
