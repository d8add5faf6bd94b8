"""The hidden Markov model against sums and maxima over all paths."""

from __future__ import annotations

import itertools
import math
import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from lpn.flight.locate.sequence import (
    _ANY_HEADING,
    _BEGIN,
    _JUMP,
    _LEAVE,
    _LEGS,
    ALONG,
    FINER,
    SPEEDS,
    TEMPERATURES,
    MotionModel,
    OfFrame,
    SequencePoint,
    elapsed_seconds,
    emissions,
    fitted,
    merged_coordinates,
    posteriors,
    score_units,
)

PLACES = np.array([[0.0, 0.0], [40.0, 10.0], [15.0, 60.0], [300.0, 20.0], [90.0, 90.0]])
TIMES = np.array([0.0, 3.0, 9.0, 12.0])
ANY = [np.array([np.nan])] * 4
TOLD = [np.array([heading]) for heading in (10.0, 80.0, 260.0, 90.0)]
MIXED = [np.array([30.0]), np.array([0.0, 120.0, 240.0]), np.array([5.0, 185.0]), np.array([90.0])]
FLIGHTS = [ANY, TOLD, MIXED]
MOTION = MotionModel(9.0, 15.0, along=0.7)
# The second step, of 6 seconds, may be a pause.
PAUSED = replace(MOTION, usual=1.9, aside=90.0)


def _density(off: np.ndarray, deviation: float) -> np.ndarray:
    return np.exp(-(off**2).sum(axis=-1) / (2 * deviation**2)) / (2 * np.pi * deviation**2)


def _direction(heading: float) -> np.ndarray:
    return np.array([np.sin(np.radians(heading)), np.cos(np.radians(heading))])


def _transition(
    motion: MotionModel, elapsed: float, before: np.ndarray, after: np.ndarray, beyond: int = 0
) -> np.ndarray:
    """Return the probability of each state after a step, (5 K, 5 M); the last places are beyond the map."""
    off = PLACES[None] - PLACES[:, None]
    any_way = _density(off, float(motion.deviation(elapsed)))
    matrix = np.zeros((5, len(before), 5, len(after)))
    for k, one in enumerate(before):
        kernel = any_way.copy()
        if motion.along and not np.isnan([one, elapsed]).any():
            lone = len(after) == 1 and not np.isnan(after[0])
            first, last = _direction(one + motion.aside), _direction(after[0] + motion.aside)
            ways = [share * first + (1 - share) * last for share in _LEGS] if lone else []
            deviation = float(np.hypot(motion.spacing, 0.3 * motion.speed * elapsed))
            along = np.mean(
                [_density(off - motion.speed * elapsed * way, deviation) for way in ways or [first]], axis=0
            )
            kernel = motion.along * along + (1 - motion.along) * any_way
        if elapsed > 3 * motion.usual:
            kernel = (kernel + _density(off, float(np.hypot(motion.speed * motion.usual, motion.spacing)))) / 2
        turns = np.full(len(after), 1 / len(after))
        if not np.isnan([one, elapsed, *after]).any():
            deviation = float(np.hypot(20, elapsed))
            change = np.abs((after - one + 180) % 360 - 180)
            likely = sum(np.exp(-((change + turn) ** 2) / (2 * deviation**2)) for turn in (-360, 0, 360))
            turns = (1 - _ANY_HEADING) * likely / likely.sum() + _ANY_HEADING / len(after)
        kernel[: 5 - beyond, 5 - beyond :] *= _LEAVE
        step = kernel / kernel.sum(axis=1, keepdims=True)
        matrix[:, k] = (1 - _JUMP) * step[:, :, None] * turns + _JUMP / (5 * len(after))
    return matrix.reshape(5 * len(before), -1)


def _brute(
    emitted: Sequence[np.ndarray],
    headings: Sequence[np.ndarray],
    times: np.ndarray = TIMES,
    motion: MotionModel = MOTION,
    beyond: int = 0,
) -> tuple[list[np.ndarray], float]:
    """Posteriors (5, K) and the log likelihood, from all paths."""
    frames = len(emitted)
    steps = zip(np.diff(times).tolist(), headings, headings[1:], strict=False)
    matrices = [_transition(motion, elapsed, before, after, beyond) for elapsed, before, after in steps]
    flat = [one.ravel() for one in emitted]
    posterior = [np.zeros(one.size) for one in emitted]
    begin = [_BEGIN / 2, 0.9 / 3] if beyond else [0.0, 1 / 5]
    start = np.repeat(np.where(np.arange(5) < 5 - beyond, begin[1], begin[0]), len(headings[0])) / len(headings[0])
    total = 0.0
    for path in itertools.product(*(range(one.size) for one in emitted)):
        value = np.log(start[path[0]]) + flat[0][path[0]]
        for t in range(1, frames):
            value += np.log(matrices[t - 1][path[t - 1], path[t]]) + flat[t][path[t]]
        total += np.exp(value)
        for t, state in enumerate(path):
            posterior[t][state] += np.exp(value)
    shares = [one.reshape(own.shape) / total for one, own in zip(posterior, emitted, strict=True)]
    return shares, float(np.log(total))


def _random(seed: int, headings: Sequence[np.ndarray], scale: float = 1.0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [scale * rng.normal(size=(5, len(own))) for own in headings]


class Track(NamedTuple):
    """A `SequencePoint` of each frame, in arrays, with the likeliest windows and the posteriors of windows."""

    position: np.ndarray
    radius: np.ndarray
    heading: np.ndarray
    nearby: np.ndarray
    beyond: np.ndarray
    likeliest: np.ndarray
    posteriors: np.ndarray


def _smoothed(
    log_emissions: OfFrame,
    headings: Sequence[np.ndarray],
    places: np.ndarray,
    times: np.ndarray,
    motion: MotionModel,
    near: float = math.inf,
    beyond: int = 0,
) -> Track:
    found = []
    for t, joint in posteriors(log_emissions, headings, places, times, motion, beyond):
        shares = joint.sum(axis=1)
        point = SequencePoint.of(joint, places, headings[t], near, beyond)
        found.append((t, *point, shares[: len(places) - beyond].argmax(), shares))
    assert [one[0] for one in found] == list(reversed(range(len(headings))))
    return Track(*(np.array(values) for values in list(zip(*reversed(found), strict=True))[1:]))


@pytest.mark.parametrize("headings", FLIGHTS)
@pytest.mark.parametrize("motion", [MOTION, PAUSED])
def test_posteriors_are_those_of_all_paths(motion: MotionModel, headings: list[np.ndarray]) -> None:
    emitted = [emissions(one, 0.5) for one in _random(0, headings)]
    shares, _ = _brute(emitted, headings, TIMES, motion)
    posterior = np.array([one.sum(axis=1) for one in shares])
    found = _smoothed(emitted.__getitem__, headings, PLACES, TIMES, motion)
    np.testing.assert_allclose(found.posteriors, posterior, rtol=1e-9)
    np.testing.assert_allclose(found.position, posterior @ PLACES, rtol=1e-9)
    best = [own[one[i].argmax()] for own, one, i in zip(headings, shares, found.likeliest, strict=True)]
    np.testing.assert_array_equal(found.heading, best)
    at_one = _smoothed(emitted.__getitem__, headings, PLACES, TIMES, motion, near=1e-6)
    np.testing.assert_allclose(at_one.nearby, posterior.max(axis=1), rtol=1e-9)
    np.testing.assert_allclose(found.nearby, 1)
    spread = posterior @ (PLACES**2).sum(axis=1) - ((posterior @ PLACES) ** 2).sum(axis=1)
    np.testing.assert_allclose(found.radius, np.sqrt(spread / 2), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("headings", FLIGHTS)
def test_places_beyond_the_map_are_states_of_all_paths_and_no_positions(headings: list[np.ndarray]) -> None:
    emitted = [emissions(one[:3], 0.5, 2, 0.8) for one in _random(4, headings)]
    for one in emitted:
        np.testing.assert_allclose(np.exp(one[3:]) * 3 * one.shape[1], np.exp(1.5 * 0.8))
        assert np.exp(one[:3]).sum() == pytest.approx(1)
    shares, _ = _brute(emitted, headings, TIMES, PAUSED, 2)
    posterior = np.array([one.sum(axis=1) for one in shares])
    found = _smoothed(emitted.__getitem__, headings, PLACES, TIMES, PAUSED, 50.0, beyond=2)
    np.testing.assert_array_equal(found.likeliest, posterior[:, :3].argmax(axis=1))
    far = np.linalg.norm(PLACES - found.position[:, None], axis=2) > 50
    np.testing.assert_allclose(found.beyond, (posterior * far)[:, 3:].sum(axis=1), rtol=1e-9)
    np.testing.assert_allclose(found.nearby, (posterior * ~far).sum(axis=1), rtol=1e-9)
    assert found.beyond.max() > 0.01


def test_frames_without_evidence_do_not_speak_for_leaving_the_map() -> None:
    np.testing.assert_allclose(np.exp(emissions(np.zeros((3, 2)), 0.5, 2, 0.8)), 1 / 6)
    # The drone flies along the map's edge at x = 0, and 25 photos on the way cannot be read.
    side = 25.0 * np.arange(12)
    places = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    far = np.stack(np.meshgrid(25.0 * np.arange(-8, 0), side), axis=-1).reshape(-1, 2)
    scores = 4 * np.exp(-((places - np.linspace((0, 0), (0, 240), 35)[:, None]) ** 2).sum(axis=2) / 800)
    scores[5:30] = 0
    logs = [emissions(one[:, None], 0.4, beyond=len(far), alike=0.9) for one in scores]
    states, motion = np.concatenate([places, far]), MotionModel(2.5, 12.5, along=ALONG)
    found = _smoothed(logs.__getitem__, [np.zeros(1)] * 35, states, 4.0 * np.arange(35), motion, 75.0, beyond=len(far))
    assert found.beyond.max() < 0.1


def test_steps_of_unknown_time_go_anywhere_and_turn_anywhere() -> None:
    headings = [MIXED[1], MIXED[2]]
    times = np.array([0.0, np.nan])
    emitted = [emissions(one) for one in _random(5, headings)]
    shares, _ = _brute(emitted, headings, times)
    found = _smoothed(emitted.__getitem__, headings, PLACES, times, MOTION, near=1e-6)
    np.testing.assert_allclose(found.nearby, [one.sum(axis=1).max() for one in shares], rtol=1e-9)


def test_coordinates_that_names_rounded_to_a_centimetre_are_one() -> None:
    side = np.arange(-20, 20) * 17.5
    places = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    off = np.random.default_rng(0).uniform(-0.006, 0.006, places.shape)
    for values, own in zip((places + off).T, places.T, strict=True):
        merged, numbers = merged_coordinates(values)
        assert len(merged) == 40
        np.testing.assert_allclose(merged[numbers], own, atol=0.006)


def test_a_position_does_not_lie_between_two_places() -> None:
    emitted = np.log(np.array([[0.5, 0.1, 1e-30, 0.4, 1e-30]])).T
    found = _smoothed(lambda _: emitted, ANY[:1], PLACES, np.zeros(1), MOTION, near=50.0)
    shares = np.exp(emitted[:, 0]) / np.exp(emitted).sum()
    expected = (shares[:2] @ PLACES[:2]) / shares[:2].sum()
    np.testing.assert_allclose(found.position[0], expected)
    squared = shares @ ((PLACES - expected) ** 2).sum(axis=1)
    assert found.radius[0] == pytest.approx(np.sqrt(squared / 2))
    assert found.nearby[0] == pytest.approx(shares[:2].sum())


def test_scores_are_in_units_of_their_frame_and_window() -> None:
    rng = np.random.default_rng(2)
    scores, compared = rng.normal(size=(7, 6)), rng.uniform(size=(7, 6)) < 0.8
    compared[:, 0], scores[4] = True, 0.3
    steps = np.array([30.0, 20.0, 90.0, 10.0, 10.0, 40.0])
    expected, units = np.zeros((7, 6)), np.zeros((7, 6))
    for t in range(7):
        own = scores[t, compared[t]]
        if t != 4:
            expected[t, compared[t]] = (own - own.mean()) / own.std()
            units[t] = own.std()
    squares = expected**2
    for t, w in itertools.product(range(7), range(6)):
        others = [s for s in range(7) if (steps[min(s, t) : max(s, t)] ** 2).sum() > 40.0**2]
        told = [squares[s, w] for s in others if compared[s, w] and s != 4]
        unit = np.sqrt((sum(told) + 30) / (len(told) + 30))
        expected[t, w] /= unit
        units[t, w] *= unit
    for t in range(7):
        expected[t, ~compared[t]] = expected[t, compared[t]].min()
    standardised = score_units(scores, steps, 40.0, compared)
    values = [standardised(t, np.stack([scores[t], scores[t] - 0.1], axis=1)) for t in range(7)]
    np.testing.assert_allclose([one[:, 0] for one in values], expected, atol=1e-12)
    lower = np.divide(0.1, units, out=np.zeros((7, 6)), where=compared & (units > 0))
    np.testing.assert_allclose([one[:, 1] for one in values], expected - lower, atol=1e-12)


@pytest.mark.parametrize("headings", [ANY, TOLD])
def test_motion_and_temperature_are_the_most_probable_of_all_paths(headings: list[np.ndarray]) -> None:
    chosen = set()
    for seed in range(3):
        scores = _random(seed, headings, 2)

        def likelihood(motion: MotionModel, temperature: float, scores: list[np.ndarray] = scores) -> float:
            return _brute([emissions(one, temperature) for one in scores], headings, TIMES, motion)[1]

        ways = (0.0, ALONG) if headings is TOLD else (0.0,)
        motions = [MotionModel(speed, 20.0, along, 3.0) for along in ways for speed in SPEEDS]
        motion = max(motions, key=lambda one: likelihood(one, 0.4))
        factors = (1 / FINER, 1.0, FINER) if motion.along else (1.0,)
        finer = [replace(motion, speed=motion.speed * by, spacing=each) for by in factors for each in (20.0, 10.0)]
        motion = max(finer, key=lambda one: likelihood(one, 0.4))
        temperature = max(TEMPERATURES, key=lambda one: likelihood(motion, one))
        found = fitted(scores.__getitem__, headings, PLACES, TIMES, 20.0)
        assert found[0].speed == pytest.approx(motion.speed)
        assert (found[0].along, found[0].spacing, found[1]) == (motion.along, motion.spacing, temperature)
        chosen.add((motion.speed, motion.along, temperature))
    assert len(chosen) > 1


def _land(
    rng: np.random.Generator, mapped: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[np.ndarray], np.ndarray]:
    """Fly a lawnmower's pattern over windows 25 m apart: scores, truth, times, headings, and places.

    Args:
        mapped: the place that the windows show, 0 for that of the flight.
    """
    side = np.arange(20) * 25.0
    places = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    legs = np.linspace(40, 440, 5)
    corners = np.array([(x, y) for i, y in enumerate(legs) for x in ((20, 460), (460, 20))[i % 2]])
    flown = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.sort(rng.choice(np.linspace(0, flown[-1] - 1, 48), 40, replace=False))
    truth = np.stack([np.interp(at, flown, corners[:, k]) for k in (0, 1)], axis=1)
    ways = np.diff(corners, axis=0)[np.searchsorted(flown, at, "right") - 1]
    headings = [np.array([one]) for one in np.degrees(np.arctan2(*ways.T)) % 360]
    looks = np.exp(-((places[:, None] - places) ** 2).sum(axis=2) / (2 * 30**2)) @ rng.normal(size=(len(places), 30))
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    near = np.linalg.norm(truth[:, None] - places, axis=2).argmin(axis=1)
    seen = looks[near] + rng.normal(size=(len(near), 30)) / 4
    if mapped:
        turned = np.linalg.qr(np.random.default_rng(mapped).normal(size=(30, 30)))[0]
        looks = np.random.default_rng(mapped).permutation(looks.T).T @ turned
    return seen @ looks.T, truth, at / 2.5, headings, places


def _standardised(values: np.ndarray) -> np.ndarray:
    return np.asarray((values - values.mean(axis=1, keepdims=True)) / values.std(axis=1, keepdims=True))


def test_a_flight_that_leaves_the_map_is_followed_beyond_its_edge() -> None:
    motion = MotionModel(2.5, 12.5, along=ALONG)
    false, kept = np.zeros(2, int), np.zeros(2, int)
    for seed in (2, 3, 4):
        values, truth, times, headings, places = _land(np.random.default_rng(seed))
        shown, off = places[:, 0] < 240, truth[:, 0] > 315  # the drone flies to and fro over 475 m
        scores, alike = _standardised(values[:, shown]), motion.alike(elapsed_seconds(times), 100.0)
        for i, beyond in enumerate((places[:0], places[~shown])):
            of_frames = zip(scores[..., None], alike, strict=True)
            logs = [emissions(one, 0.33, beyond=len(beyond), alike=own) for one, own in of_frames]
            states = np.concatenate([places[shown], beyond])
            found = _smoothed(logs.__getitem__, headings, states, times, motion, 75.0, beyond=len(beyond))
            false[i] += (off & (found.nearby > 0.98)).sum()
            kept[i] += (~off & (found.nearby > 0.98)).sum()
            assert np.linalg.norm(found.position - truth, axis=1)[~off & (found.nearby > 0.98)].max() < 75
    assert false[0] > 10
    assert false[1] == 0
    assert kept[1] > 0.8 * kept[0]


def test_steps_and_common_ground_follow_times_and_unknown_ones() -> None:
    elapsed = elapsed_seconds([0.0, 2.0, 12.0, np.nan])
    np.testing.assert_array_equal(elapsed, [np.nan, 2, 10, np.nan])
    np.testing.assert_allclose(MotionModel(10.0).alike(elapsed, 80.0), [0, 0.75, 0, 0])
    np.testing.assert_allclose(MotionModel(10, 30).deviation(elapsed_seconds([0, 4, np.nan, 10])[1:]), [50, 60, 60])


def test_the_direction_of_flight_tells_the_flights_map_from_one_of_another_place() -> None:
    found = []
    for mapped in range(5):
        values, _, times, headings, places = _land(np.random.default_rng(7), mapped)
        scores = _standardised(values)
        found.append(fitted(lambda t, s=scores: s[t][:, None], headings, places, times, 25.0)[2])
    assert found[0] > 10
    assert max(found[1:]) < 4


def test_emissions_are_a_distribution_with_a_floor() -> None:
    scores = np.random.default_rng(1).normal(size=(7, 4))
    logs = emissions(scores, temperature=0.01)
    assert np.exp(logs).sum() == pytest.approx(1)
    assert np.exp(logs).min() == pytest.approx(1e-4 / 28)
    assert logs.argmax() == scores.argmax()


def test_memory_grows_with_the_root_of_the_frames() -> None:
    side = np.arange(40) * 25.0
    places = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    turns = np.arange(8) * 45.0
    emitted = emissions(np.random.default_rng(0).normal(size=(1600, 8)))
    tracemalloc.start()
    for _, joint in posteriors(lambda _: emitted, [turns] * 64, places, np.arange(64.0), MotionModel(5.0, 25.0)):
        assert joint.shape == (1600, 8)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # All frames at once would take 64 values.
    assert peak < 50 * emitted.nbytes
