from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog, minimize

from lpn import retrieval
from lpn.core.arrays import Float32Array
from lpn.explain import counterfactual
from lpn.models.base import normalise
from lpn.retrieval import Ranking, metrics, scoring


def random_case(seed: int) -> tuple[Ranking, np.ndarray]:
    """A ranking with one to three true tiles, sometimes with junk, equal tiles, or few different cosines; and its labels."""
    rng = np.random.default_rng(seed)
    n, tiles = int(rng.integers(1, 13)), int(rng.integers(2, 40))
    cosines = rng.uniform(0, 1, (tiles, n))
    if seed % 4 == 1:
        cosines = rng.integers(0, 4, (tiles, n)) / 4
    if seed % 4 == 2:
        cosines = 0.7 + 0.01 * rng.standard_normal((tiles, n))
    if seed % 4 == 3:
        cosines[1] = cosines[0]
    labels = np.full(tiles, 5)
    labels[rng.choice(tiles, min(int(rng.integers(1, 4)), tiles - 1), replace=False)] = 7
    if seed % 5 == 0:
        labels[np.flatnonzero(labels == 5)[0]] = metrics.JUNK
    weights = scoring.part_weights(n, rng.uniform(0, 1, n) * (rng.random(n) < 0.8) + 0.01)
    return retrieval.rank(cosines.astype(np.float32), weights, labels, 7), labels


def described(seed: int, count: int, n: int) -> Float32Array:
    return normalise(np.random.default_rng(seed).standard_normal((count, n, 16)).astype(np.float32))


def test_the_parts_of_a_margin_sum_to_the_difference_of_scores_and_distances() -> None:
    query, gallery = described(1, 1, 4)[0], described(2, 30, 4)
    ranking = retrieval.rank(scoring.part_cosines(query, gallery), scoring.part_weights(4, [2, 1, 0, 0.5]))
    for a, b in ((3, 8), (8, 3)):
        found = ranking.gains(a, b)
        one, other = ranking.find(a), ranking.find(b)
        assert found.shape == (4,)
        assert found.sum() == pytest.approx(other.distance2 - one.distance2, abs=1e-6)
        np.testing.assert_allclose(found, other.contributions - one.contributions, atol=1e-6)
        assert found[2] == 0


@given(st.integers(0, 10_000))
def test_without_and_alone_are_the_ranks_of_those_weights(seed: int) -> None:
    ranking, labels = random_case(seed)
    found = counterfactual.ranks_without_parts(ranking)
    n = len(ranking.weights)
    for part, standing in enumerate((*found.without, *found.alone)):
        left = np.where(np.arange(n) == part, 0, ranking.weights) if part < n else np.eye(n)[part - n]
        if standing is None:
            assert not left.any()
            continue
        direct = retrieval.rank(ranking.cosines, scoring.part_weights(n, left), labels, 7)
        truth = direct.positive()
        assert standing == truth.rank
    now = ranking.positive()
    assert found.now == now.rank


def test_the_smallest_change_is_what_a_general_solver_finds() -> None:
    told = {"none": 0, "found": 0}
    for seed in range(150):
        ranking, labels = random_case(seed)
        found = counterfactual.smallest_change(ranking)
        best = _by_scipy(ranking, labels)
        now = ranking.positive()
        if now is not None and now.rank == 1:
            np.testing.assert_array_equal(found, ranking.weights)
            continue
        assert (found is None) == (best is None), seed
        told["none" if found is None else "found"] += 1
        if found is not None:
            assert _distance(ranking, found) == pytest.approx(best, abs=1e-6)
            assert found.sum() == pytest.approx(1, abs=1e-6)
            assert (found >= 0).all()
            assert retrieval.rank(ranking.cosines, found, labels, 7).match(0).true
    assert min(told.values()) > 20


def _distance(ranking: Ranking, found: Float32Array) -> float:
    return float(np.linalg.norm(found - ranking.weights))


def _by_scipy(ranking: Ranking, labels: np.ndarray) -> float | None:
    n = len(ranking.weights)
    now = ranking.weights.astype(float) / ranking.weights.sum(dtype=float)
    cosines, found = ranking.cosines.astype(float), []
    for index in np.flatnonzero(labels == 7):
        ahead = cosines[index] - cosines[labels == 5]
        lead, one = np.full(len(ahead), counterfactual.MIN_SCORE_LEAD), np.ones(n)
        inside = linprog(np.zeros(n), A_ub=-ahead, b_ub=-lead, A_eq=one[None], b_eq=[1], bounds=[(0, 1)] * n)
        if inside.status != 0:
            continue
        rules = [
            {"type": "eq", "fun": lambda w: w.sum() - 1, "jac": lambda w: np.ones(len(w))},
            {
                "type": "ineq",
                "fun": lambda w, a=ahead: a @ w - counterfactual.MIN_SCORE_LEAD,
                "jac": lambda _, a=ahead: a,
            },
        ]
        solved = minimize(
            lambda w: ((w - now) ** 2).sum() / 2,
            inside.x,
            jac=lambda w: w - now,
            method="SLSQP",
            bounds=[(0, 1)] * n,
            constraints=rules,
            options={"maxiter": 500, "ftol": 1e-14},
        )
        assert solved.status == 0
        found.append(float(np.linalg.norm(solved.x - now)))
    return min(found, default=None)


def test_a_chosen_tile_can_be_put_first_and_an_unknown_truth_cannot() -> None:
    cosines = [[0.9, 0.1], [0.8, 0.7], [0.1, 0.8]]
    ranking = retrieval.rank(np.array(cosines, np.float32), scoring.part_weights(2))
    assert counterfactual.smallest_change(ranking) is None
    assert counterfactual.ranks_without_parts(ranking) is None
    found = counterfactual.smallest_change(ranking, tile=2)
    assert found is not None
    assert retrieval.rank(ranking.cosines, found).order[0] == 2
    standings = counterfactual.ranks_without_parts(ranking, tile=0)
    assert standings.without == (3, 1)


def test_a_part_that_sees_nothing_of_the_query_ranks_nothing() -> None:
    cosines = np.array([[0.0, 0.2, 0.0], [0.0, 0.9, 0.0], [0.0, 0.5, 0.0]], np.float32)
    lengths = np.array([0.0, 3.0, 0.0], np.float32)
    labels = np.array([0, 1, 2])
    ranking = retrieval.rank(cosines, scoring.part_weights(3), labels, 0, lengths=lengths)
    found = counterfactual.ranks_without_parts(ranking)
    assert found.without[1] is None
    assert (found.alone[0], found.alone[2]) == (None, None)
    assert found.alone[1] == 3
