"""The hidden Markov model against sums and maxima over all paths."""

from __future__ import annotations

import itertools
import tracemalloc

import numpy as np
import pytest

from lpn.core.errors import InputError
from lpn.locate.sequence import _JUMP, MotionModel, emissions, smooth

PLACES = np.array([[0.0, 0.0], [40.0, 10.0], [15.0, 60.0], [300.0, 20.0], [90.0, 90.0]])
STEPS = np.array([30.0, 55.0, 30.0])


def _transition(step: float) -> np.ndarray:
    squared = ((PLACES[:, None] - PLACES[None]) ** 2).sum(axis=2)
    kernel = np.where(squared <= (4 * step) ** 2, np.exp(-squared / (2 * step**2)), 0)
    return (1 - _JUMP) * kernel / kernel.sum(axis=1, keepdims=True) + _JUMP / len(PLACES)


def _brute(emitted: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Posteriors, the best path, and the log likelihood, from all paths."""
    frames, states = emitted.shape
    matrices = [_transition(step) for step in STEPS]
    posterior, best, total = np.zeros((frames, states)), (-np.inf, ()), 0.0
    for path in itertools.product(range(states), repeat=frames):
        value = np.log(1 / states) + emitted[0, path[0]]
        for t in range(1, frames):
            value += np.log(matrices[t - 1][path[t - 1], path[t]]) + emitted[t, path[t]]
        best = max(best, (value, path))
        total += np.exp(value)
        for t, state in enumerate(path):
            posterior[t, state] += np.exp(value)
    return posterior / total, np.array(best[1]), float(np.log(total))


@pytest.mark.parametrize("seed", range(4))
def test_posteriors_and_path_are_those_of_all_paths(seed: int) -> None:
    emitted = emissions(np.random.default_rng(seed).normal(size=(4, 5)), temperature=0.5, floor=0.01)
    posterior, path, total = _brute(emitted)
    found = smooth(emitted, PLACES, STEPS)
    np.testing.assert_allclose(found.positions, posterior @ PLACES, rtol=1e-9)
    np.testing.assert_array_equal(found.likeliest, posterior.argmax(axis=1))
    np.testing.assert_allclose(found.probabilities, posterior.max(axis=1), rtol=1e-9)
    np.testing.assert_array_equal(found.path, path)
    assert found.log_likelihood == pytest.approx(total, rel=1e-12)
    spread = posterior @ (PLACES**2).sum(axis=1) - ((posterior @ PLACES) ** 2).sum(axis=1)
    np.testing.assert_allclose(found.radii, np.sqrt(spread / 2), rtol=1e-6, atol=1e-6)


def test_a_position_does_not_lie_between_two_places() -> None:
    emitted = np.log(np.array([[0.5, 0.1, 1e-30, 0.4, 1e-30]]))
    found = smooth(emitted, PLACES, np.zeros(0), near=50.0)
    shares = np.exp(emitted[0]) / np.exp(emitted[0]).sum()
    expected = (shares[:2] @ PLACES[:2]) / shares[:2].sum()
    np.testing.assert_allclose(found.positions[0], expected)
    squared = shares @ ((PLACES - expected) ** 2).sum(axis=1)
    assert found.radii[0] == pytest.approx(np.sqrt(squared / 2))


def test_neighbours_outvote_a_frame_that_jumps() -> None:
    x = np.arange(0, 2000, 25.0)
    places = np.stack([x, np.zeros_like(x)], axis=1)
    truth = np.arange(5, 25)
    scores = np.zeros((20, len(x)))
    scores[np.arange(20), truth] = 0.3
    scores[9] = 0
    scores[9, 70], scores[9, truth[9]] = 0.32, 0.28
    found = smooth(emissions(scores), places, MotionModel(10, 20).steps(np.arange(20) * 2.0))
    assert found.own[9] == 70
    assert abs(found.likeliest[9] - truth[9]) <= 1
    assert found.moved[9] > 1000
    assert "outvoted by its neighbours" in found.sentence(9)
    assert found.sentence(3) == "The neighbours agree with the picture's own answer."


def test_emissions_are_distributions_with_a_floor_and_take_the_best_heading() -> None:
    scores = np.random.default_rng(1).normal(size=(3, 7, 4))
    logs = emissions(scores, temperature=0.01, floor=0.07)
    np.testing.assert_allclose(np.exp(logs).sum(axis=1), 1)
    assert np.exp(logs).min() >= 0.01 - 1e-12
    np.testing.assert_array_equal(logs.argmax(axis=1), scores.max(axis=2).argmax(axis=1))


def test_steps_follow_time_and_unknown_times() -> None:
    steps = MotionModel(10, 30, 60).steps([0, 4, np.nan, 10])
    np.testing.assert_allclose(steps, [50, 60, 60], rtol=0.05)


def test_wrong_numbers_are_refused() -> None:
    with pytest.raises(InputError, match="temperature is 0"):
        emissions(np.zeros((2, 3)), temperature=0)
    with pytest.raises(InputError, match="shape"):
        emissions(np.full((2, 3), np.nan))
    with pytest.raises(InputError, match="expected \\(3, 2\\) and 1"):
        smooth(np.zeros((2, 3)), np.zeros((3, 2)), np.zeros(2))
    with pytest.raises(InputError, match="motion model"):
        MotionModel(speed=0)


def test_transitions_together_hold_a_bounded_number_of_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    side = np.arange(40) * 25.0
    places = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    scores = np.random.default_rng(0).normal(0, 0.05, (9, len(places)))
    steps = np.array([60.0, 66.0, 72.6, 79.9, 60.0, 66.0, 72.6, 79.9])
    free = smooth(emissions(scores), places, steps)
    monkeypatch.setattr("lpn.locate.sequence._MAX_PAIRS", 200_000)
    monkeypatch.setattr("lpn.locate.sequence._BLOCK", 16)
    tracemalloc.start()
    found = smooth(emissions(scores), places, steps)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200_000 * 110
    assert np.median(np.linalg.norm(found.positions - free.positions, axis=1)) < 25


@pytest.mark.slow
def test_ten_thousand_windows_and_many_frames_fit() -> None:
    side = np.arange(100) * 25.0
    places = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    truth = np.stack([np.linspace(100, 2300, 60), np.linspace(200, 1900, 60)], axis=1)
    distance = np.linalg.norm(truth[:, None] - places[None], axis=2)
    scores = 0.4 * np.exp(-((distance / 40) ** 2)) + np.random.default_rng(0).normal(0, 0.05, distance.shape)
    found = smooth(emissions(scores), places, np.full(59, 60.0))
    assert np.median(np.linalg.norm(found.positions - truth, axis=1)) < 15
