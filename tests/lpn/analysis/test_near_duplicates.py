"""Near-duplicates, against all pairs one by one."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from lpn.analysis.near_duplicates import near_duplicates


@pytest.mark.parametrize(("total", "weights"), [(9, None), (1100, [1.0, 0.0, 2.0])])
def test_the_nearest_pairs_of_different_places_come_first(total: int, weights: list[float] | None) -> None:
    rng = np.random.default_rng(0)
    gallery = rng.normal(size=(total, 3, 4)).astype(np.float32)
    gallery /= np.sqrt(3) * np.linalg.norm(gallery, axis=2, keepdims=True)
    labels = rng.integers(-1, total // 2, total)
    shares = np.full(3, 1 / 3) if weights is None else np.array(weights) / sum(weights)
    cosines = 3 * np.einsum("gnd,hnd,n->gh", gallery, gallery, shares)
    allowed = [
        (one, other)
        for one, other in itertools.combinations(range(total), 2)
        if labels[one] != labels[other] and min(labels[one], labels[other]) >= 0
    ]
    best = sorted(allowed, key=lambda pair: -cosines[pair])[:5]
    pairs = near_duplicates(gallery, labels, 5, weights)
    assert [pair.tiles for pair in pairs] == best
    assert [pair.cosine for pair in pairs] == pytest.approx([cosines[pair] for pair in best], abs=1e-6)


def test_a_copy_under_another_label_has_a_cosine_of_1() -> None:
    gallery = np.full((2, 4, 1), 0.5, np.float32)
    assert near_duplicates(gallery, np.array([1, 2]), 5)[0].cosine == pytest.approx(1.0)


def test_tiles_of_one_place_are_no_pair() -> None:
    assert near_duplicates(np.ones((3, 1, 1), np.float32), np.array([4, 4, -1]), 5) == []
