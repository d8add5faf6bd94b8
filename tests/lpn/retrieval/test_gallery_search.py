from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from lpn import retrieval
from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError
from lpn.datasets import Truth
from lpn.models.base import normalise
from lpn.retrieval import scoring


def descriptors(seed: int, count: int, n: int) -> Float32Array:
    return normalise(np.random.default_rng(seed).standard_normal((count, n, 32)).astype(np.float32))


@pytest.mark.parametrize("n", [1, 2, 4, 8])
def test_contributions_sum_to_the_squared_distance(n: int) -> None:
    query, gallery = descriptors(1, 1, n)[0], descriptors(2, 50, n)
    cosines = scoring.part_cosines(query, gallery)
    shares = scoring.contributions(cosines, scoring.part_weights(n))
    distance2 = ((gallery - query).reshape(50, -1).astype(float) ** 2).sum(1)
    np.testing.assert_allclose(shares.sum(1), distance2, atol=1e-6)
    for part in range(n):
        np.testing.assert_allclose(shares[:, part], ((gallery - query)[:, part] ** 2).sum(1), atol=1e-6)


def test_any_weights_are_one_inner_product_with_the_rescaled_query() -> None:
    query, gallery = descriptors(1, 1, 4)[0], descriptors(2, 50, 4)
    weights = scoring.part_weights(4, [2, 1, 0, 0.5])
    ranking = retrieval.rank(scoring.part_cosines(query, gallery), weights)
    scores = np.einsum("gnd,nd->g", gallery, weights[:, None] * 4 * query)
    np.testing.assert_allclose(ranking.scores, scores, atol=1e-6)
    match = ranking.match(0)
    assert match.contributions.sum() == pytest.approx(match.distance2, abs=1e-6)
    assert match.contributions[2] == 0
    assert match.index == int(np.argmax(scores))


def test_ranking_finds_truth_gaps_and_positions() -> None:
    query, gallery = descriptors(1, 1, 4)[0], descriptors(2, 30, 4)
    labels = np.arange(30) // 3
    ranking = retrieval.rank(scoring.part_cosines(query, gallery), scoring.part_weights(4), labels, 7)
    top = ranking.top(30)
    assert [m.rank for m in top] == list(range(1, 31))
    distances = [m.distance2 for m in top]
    assert distances == sorted(distances)
    for match, following in pairwise(top):
        assert match.gap == pytest.approx(following.distance2 - match.distance2, abs=1e-6)
        shown = f"{float(f'{match.distance2:.3f}') + match.shown_gap:.3f}"
        assert shown == f"{following.distance2:.3f}", "the figures beside each other add up"
    assert top[-1].gap is None
    truth = ranking.positive()
    assert truth.rank == min(m.rank for m in top if m.true)
    assert labels[truth.index] == 7
    assert ranking.find(truth.index).rank == truth.rank
    assert retrieval.rank(ranking.cosines, ranking.weights, labels, 99).positive() is None
    assert retrieval.rank(ranking.cosines, ranking.weights).match(0).true is None


def test_weights_that_say_nothing_are_refused() -> None:
    for values in ([0, 0, 0, 0], [1, 1], [1, -1, 1, 1], [1, float("nan"), 1, 1]):
        with pytest.raises(InputError, match="expected 4 numbers"):
            scoring.part_weights(4, values)


def test_activation_is_a_scaled_channel_sum() -> None:
    total = np.random.default_rng(0).random((5, 6)).astype(np.float32)
    heat = scoring.activation(total)
    assert (heat.min(), heat.max()) == (0, 1)
    assert heat.argmax() == total.argmax()
    assert (scoring.activation(np.ones((5, 6), np.float32)) == 0).all()


def test_junk_is_not_ranked() -> None:
    query, gallery = descriptors(1, 1, 4)[0], descriptors(2, 30, 4)
    cosines, weights = scoring.part_cosines(query, gallery), scoring.part_weights(4)
    labels = np.arange(30) // 3
    labels[:4] = -1
    by_label = retrieval.rank(cosines, weights, labels, 7)
    truth = Truth(np.array([21, 22, 23]), np.arange(4))
    by_list = retrieval.rank(cosines, weights, labels, None, truth)
    whole = retrieval.rank(cosines, weights)
    for ranking in (by_label, by_list):
        assert ranking.order.tolist() == [index for index in whole.order if index >= 4]
        assert not ranking.holds(2)
        assert ranking.holds(5)
        found = ranking.positive()
        assert found.index in truth.good
