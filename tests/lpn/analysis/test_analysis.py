from __future__ import annotations

import importlib.util
import itertools
import sys
from dataclasses import replace

import numpy as np
import pytest

from lpn import retrieval
from lpn.analysis import embedding_map
from lpn.analysis.comparison import effect_on
from lpn.analysis.embedding_map import inside, pca, umap
from lpn.analysis.near_duplicates import near_duplicates
from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError, MissingPackageError
from lpn.datasets import Truth
from lpn.models.base import normalise
from lpn.retrieval import metrics, ranks, scoring
from tools.fixtures.tasks import descriptor_task


def drawn(count: int, n: int = 3, size: int = 5, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (rng.standard_normal((count, n, size)) * np.linspace(0.5, 3, n * size).reshape(n, size)).astype(np.float32)


@pytest.mark.parametrize(("q", "g"), [(5, 4), (60, 40)])
def test_pca_is_the_svd_of_both_sides_together(q: int, g: int) -> None:
    queries, gallery = drawn(q), drawn(g, seed=1) + 1
    found = pca(queries, gallery)
    both = np.concatenate([queries, gallery]).reshape(q + g, -1).astype(np.float64)
    left, values, right = np.linalg.svd(both - both.mean(axis=0), full_matrices=False)
    signs = np.sign(right[np.arange(2), np.abs(right[:2]).argmax(axis=1)])
    np.testing.assert_allclose(
        np.concatenate([found.queries, found.tiles]), left[:, :2] * values[:2] * signs, atol=1e-8
    )
    np.testing.assert_allclose(found.variance, (values**2 / (values**2).sum())[:2], atol=1e-9)


def test_pca_of_a_sample_places_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    queries, gallery = drawn(400), drawn(300, seed=1)
    queries[:200, 0, 0] += 30
    whole = pca(queries, gallery)
    monkeypatch.setattr(embedding_map, "SAMPLE", 100)
    part = pca(queries, gallery)
    assert (part.queries.shape, part.tiles.shape) == ((400, 2), (300, 2))
    np.testing.assert_allclose(part.queries[:, 0], whole.queries[:, 0], atol=6)
    assert np.corrcoef(part.queries[:, 0], whole.queries[:, 0])[0, 1] > 0.99


def test_pca_of_what_does_not_vary_is_one_point() -> None:
    same = np.ones((4, 1, 1), np.float32)
    found = pca(same, same)
    assert not found.queries.any()
    assert not found.variance.any()
    line = np.arange(6, dtype=np.float32).reshape(6, 1, 1)
    one = pca(line, line)
    np.testing.assert_allclose(one.queries[:, 0], np.arange(6) - 2.5)
    assert not one.queries[:, 1].any()


def test_points_inside_a_rectangle() -> None:
    points = np.array([[0, 0], [1, 1], [2, 2], [1, 3], [np.nan, 1]])
    assert inside(points, np.array([[2.5, 2.5], [0.5, 2.5], [0.5, 0.5], [2.5, 0.5]])).tolist() == [1, 2]
    assert inside(points, np.array([[5, 5], [6, 5], [6, 6]])).tolist() == []


def test_umap_is_asked_for_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "umap", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'lpn-explorer\[train\]'"):
        umap(drawn(20), drawn(20))
    with pytest.raises(InputError, match="is 15 with 10 pictures"):
        umap(drawn(5), drawn(5))


@pytest.mark.skipif(importlib.util.find_spec("umap") is None, reason="the extra train is not installed")
@pytest.mark.filterwarnings("default")
def test_umap_keeps_groups_together_and_repeats_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")  # compiling takes longer than so few pictures
    queries, gallery = drawn(12), drawn(12, seed=1)
    queries[:, 0] += 20
    gallery[:, 1] -= 20
    found = umap(queries, gallery, neighbours=5)
    apart = np.linalg.norm(found.queries.mean(axis=0) - found.tiles.mean(axis=0))
    assert apart > 2 * max(found.queries.std(), found.tiles.std())
    np.testing.assert_array_equal(umap(queries, gallery, neighbours=5).queries, found.queries)


@pytest.mark.parametrize(("total", "weights"), [(9, None), (70, [1.0, 0.0, 2.0])])
def test_the_nearest_pairs_of_different_places_come_first(
    total: int, weights: list[float] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lpn.analysis.near_duplicates._BLOCK", 32)
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


def described(seed: int, count: int) -> Float32Array:
    return normalise(np.random.default_rng(seed).standard_normal((count, 3, 16)).astype(np.float32))


@pytest.mark.parametrize("listed", [False, True])
def test_the_effect_on_a_data_set_is_that_of_each_query_ranked(listed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ranks, "_BLOCK_BYTES", 4 * 30 * 4)  # several blocks
    rng = np.random.default_rng(3)
    gallery = described(4, 30)
    labels, of_query = rng.integers(-1, 12, 30), rng.integers(0, 12, 25)
    mates = [np.flatnonzero(labels == label) for label in of_query]
    query = normalise(np.stack([gallery[m[0] if len(m) else 0] for m in mates]) + 3 * described(5, 25))
    truth = [Truth(m, np.flatnonzero(labels == metrics.JUNK)) for m in mates] if listed else None
    before, after = [2, 0.1, 0.4], [0.1, 2, 0.5]
    task = replace(descriptor_task(query, gallery, of_query, labels, truth), weights=before)
    found = effect_on(task, after)
    hits = []
    for weights in (before, after):
        tops = [
            retrieval.rank(
                scoring.part_cosines(q, gallery), scoring.part_weights(3, weights), labels, int(label)
            ).match(0)
            for q, label in zip(query, of_query, strict=True)
        ]
        hits.append(np.array([top.true for top in tops]))
    assert (found.before, found.after) == pytest.approx(tuple(100 * h.mean() for h in hits))
    np.testing.assert_array_equal(found.gained, np.flatnonzero(hits[1] & ~hits[0]))
    np.testing.assert_array_equal(found.lost, np.flatnonzero(hits[0] & ~hits[1]))
    assert len(found.gained) > 0
    assert len(found.lost) > 0
    assert found.helps == (found.after > found.before)
    if truth is not None:
        blind = replace(truth[0], good=truth[0].good[:0], known=False)
        graded = effect_on(replace(task, truth=[blind, *truth[1:]]), after)
        assert graded.queries == 24
        assert (graded.before, graded.after) == pytest.approx(tuple(100 * h[1:].mean() for h in hits))
