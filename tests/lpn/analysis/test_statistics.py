"""Statistics against sums written out, SciPy, and published examples."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import binomtest, permutation_test, t, ttest_ind

from lpn.analysis.statistics import half_interval, holm, intervals, randomization_test, welch_test

# Differences of the heights of Darwin's 15 pairs of Zea mays, in eighths of an inch (Fisher 1935, section 21).
DARWIN = np.array([49, -67, 8, 16, 6, 23, 28, 41, 14, 29, 56, 24, 75, 60, -48], float)


def test_intervals_draw_places_with_all_their_queries() -> None:
    rng = np.random.default_rng(5)
    labels = np.array([7, 7, 7, 2, 2, 9, 4, 4, 4, 4])
    values = (rng.random((2, 10)) < 0.5).astype(float)
    found = intervals(values, labels, seed=3, resamples=200)
    draws = np.random.default_rng(3)
    places = [2, 4, 7, 9]
    means = []
    for _ in range(200):
        chosen = [places[i] for i in draws.integers(4, size=4)]
        rows = [row for place in chosen for row in np.flatnonzero(labels == place)]
        means.append(values[:, rows].mean(axis=1))
    for estimate, row, of_row in zip(found, values, np.array(means).T, strict=True):
        assert estimate.value == pytest.approx(100 * row.mean())
        assert (estimate.low, estimate.high) == pytest.approx(tuple(100 * np.quantile(of_row, (0.025, 0.975))))


def test_the_randomization_test_is_fishers_of_darwins_plants() -> None:
    # Fisher counts 863 of 32,768 arrangements in one tail.
    assert randomization_test(DARWIN[None], np.arange(15), seed=0) == [2 * 863 / 2**15]


def test_the_randomization_test_is_scipys_over_places() -> None:
    rng = np.random.default_rng(1)
    labels = rng.integers(0, 9, 40)
    first, second = rng.random((2, 40))
    sums = [[values[labels == place].sum() for place in range(9)] for values in (first, second)]
    expected = permutation_test(
        sums,
        lambda a, b, axis: np.sum(a - b, axis=axis),
        permutation_type="samples",
        vectorized=True,
        n_resamples=np.inf,
    )
    found = randomization_test(np.stack([first - second, second - first]), labels, seed=0)
    assert found == pytest.approx([expected.pvalue, expected.pvalue])


@pytest.mark.parametrize(("b", "c"), [(0, 0), (0, 1), (3, 3), (5, 1), (10, 4), (24, 4), (20, 6), (400, 350)])
def test_hits_of_one_query_a_place_have_the_binomial_test_of_mcnemar(b: int, c: int) -> None:
    differences = np.repeat([1.0, -1.0, 0.0], [b, c, 50])
    (p,) = randomization_test(differences[None], np.arange(b + c + 50), seed=3)
    expected = 1.0 if b + c == 0 else binomtest(min(b, c), b + c, 0.5).pvalue
    # Three standard deviations of a share of 100,000 swaps, where not all are counted.
    assert p == pytest.approx(expected, abs=1e-12 if b + c <= 16 else 3 * math.sqrt(expected / 1e5) + 2e-5)


def test_many_queries_of_one_place_are_no_further_evidence() -> None:
    rng = np.random.default_rng(2)
    differences = rng.normal(0.1, 1, 30)
    once = randomization_test(differences[None], np.arange(30), seed=0)
    assert randomization_test(np.repeat(differences, 20)[None], np.repeat(np.arange(30), 20), seed=0) == once
    (as_if_independent,) = randomization_test(np.repeat(differences, 20)[None], np.arange(600), seed=0)
    assert as_if_independent < once[0]


def test_places_without_a_difference_alter_no_p() -> None:
    differences = np.random.default_rng(6).normal(0.2, 1, (2, 30))
    among_others = np.zeros((2, 300))
    among_others[:, ::10] = differences
    alone = randomization_test(differences, np.arange(30), seed=1)
    assert randomization_test(among_others, np.arange(300), seed=1) == alone
    assert randomization_test(np.zeros((1, 300)), np.arange(300), seed=1) == [1.0]


def test_holm_adjusts_as_the_definition_says() -> None:
    # Sorted: 4 x 0.005, 3 x 0.01, 2 x 0.03, and 1 x 0.04, which is raised to the one before it.
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.7]) == [1.0, 1.0]
    assert holm([None, 0.02, None, 0.01]) == [None, 0.02, None, 0.02]
    assert holm([]) == []


@pytest.mark.parametrize(("first", "second"), [(2, 2), (2, 5), (3, 3), (5, 10)])
def test_welchs_test_is_scipys(first: int, second: int) -> None:
    rng = np.random.default_rng(first + second)
    for shift in (0.0, 1.0, 8.0):
        groups = rng.normal(70, 1, first), rng.normal(70 + shift, 3, second)
        expected = ttest_ind(*groups, equal_var=False).pvalue
        assert welch_test(*groups) == pytest.approx(expected, rel=1e-4)
        interval = ttest_ind(*groups, equal_var=False).confidence_interval(0.95)
        assert half_interval(*groups) == pytest.approx((interval.high - interval.low) / 2, rel=1e-5)
        alone = t.ppf(0.975, first - 1) * groups[0].std(ddof=1) / math.sqrt(first)
        assert half_interval(groups[0]) == pytest.approx(alone, rel=1e-5)


def test_welchs_test_takes_several_runs_with_a_spread() -> None:
    assert welch_test(np.array([70.0]), np.array([71.0, 72.0])) is None
    assert welch_test(np.array([70.0, 70.0]), np.array([71.0, 71.0])) is None
    assert welch_test(np.array([70.0, 70.0 + 1e-13]), np.array([71.0, 71.0])) is None
