"""Measures against sums written out, and against values that the released evaluation code gave."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lpn.core.errors import InputError
from lpn.locate import measures

# One query of each kind with the positions that the released evaluations were run on, and their answers.
DENSEUAV_QUERY = (30.320951, 120.3807414)
DENSEUAV_TOP = (30.3206409, 120.3807237)


def test_summary_counts_frames_without_an_answer() -> None:
    errors = np.array([3.0, 7.0, np.nan, 60.0, 20.0, np.nan, 4.0, 11.0])
    found = measures.summarise(errors, [1, 2, 3, 9, 4, 5, 1, 2], limit=50)
    assert (found.frames, found.answered) == (8, 6)
    assert found.median == 9.0
    assert found.p90 == pytest.approx(40.0)
    assert found.within == {5: 25.0, 10: 37.5, 25: 62.5, 50: 62.5, 100: 75.0}
    assert found.coverage_at_zero == 62.5


@pytest.mark.parametrize("seed", range(5))
def test_coverage_at_zero_is_the_longest_prefix_without_a_false_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    errors, radii = rng.uniform(0, 70, 30), rng.integers(1, 12, 30).astype(float)
    best = 0
    for limit in sorted(set(radii)):
        taken = errors[radii <= limit]
        if (taken <= 50).all():
            best = max(best, len(taken))
    assert measures.accepted_before_false(errors, radii, 50.0) == best


@pytest.mark.parametrize("k", [1, 3, 8])
def test_sdm_and_dis_are_their_sums(k: int) -> None:
    distances = np.random.default_rng(k).uniform(0, 900, (6, 8))
    for row, sdm, mean in zip(
        distances, measures.sdm_at(distances, k, 0.001), measures.distance_at(distances, k), strict=True
    ):
        upper = sum((k - i) * math.exp(-0.001 * row[i]) for i in range(k))
        assert sdm == pytest.approx(upper / sum(k - i for i in range(k)))
        assert mean == pytest.approx(sum(row[:k]) / k)


def test_denseuav_weights_are_one_minus_the_rank_over_k() -> None:
    degrees = np.random.default_rng(0).uniform(0, 1e-3, (4, 5))
    weights = 1 - np.arange(5) / 5
    expected = (weights * np.exp(-5000 * degrees)).sum(axis=1) / weights.sum()
    np.testing.assert_allclose(measures.sdm_at(degrees, 5, measures.DENSEUAV_DECAY), expected)


def test_distances_of_denseuav_are_in_single_precision_and_on_a_sphere() -> None:
    degrees = measures.degree_distances(DENSEUAV_QUERY, DENSEUAV_TOP)
    assert degrees == np.sqrt(np.sum((np.float32(DENSEUAV_QUERY) - np.float32(DENSEUAV_TOP)) ** 2))
    lat1, lon1, lat2, lon2 = map(math.radians, (*DENSEUAV_QUERY, *DENSEUAV_TOP))
    cosine = math.sin(lat1) * math.sin(lat2) + math.cos(lat1) * math.cos(lat2) * math.cos(lon2 - lon1)
    assert measures.great_circle(DENSEUAV_QUERY, DENSEUAV_TOP) == pytest.approx(6378137 * math.acos(cosine), rel=1e-3)


def test_recall_and_accuracy_within_metres() -> None:
    hits = np.array([[0, 1, 0], [1, 0, 0], [0, 0, 0], [0, 0, 1]], bool)
    assert [measures.recall_at(hits, k) for k in (1, 2, 3)] == [25, 50, 75]
    assert measures.accuracy_within([19.9, 20.0, 3.0, 50.0], 20) == 50


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(InputError, match="K is 4"):
        measures.sdm_at(np.zeros((2, 3)), 4, 1.0)
    with pytest.raises(InputError, match="one number a frame"):
        measures.summarise(np.zeros(3), np.zeros(4))
