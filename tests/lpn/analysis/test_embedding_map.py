from __future__ import annotations

import importlib.util
import sys

import numpy as np
import pytest

from lpn.analysis.embedding_map import inside, pca, umap
from lpn.core.errors import InputError, MissingPackageError


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


def test_pca_of_a_sample_places_everything() -> None:
    queries, gallery = drawn(400), drawn(300, seed=1)
    queries[:200, 0, 0] += 30
    whole, part = pca(queries, gallery), pca(queries, gallery, sample=100)
    assert (part.queries.shape, part.tiles.shape) == ((400, 2), (300, 2))
    np.testing.assert_allclose(part.queries[:, 0], whole.queries[:, 0], atol=6)
    assert np.corrcoef(part.queries[:, 0], whole.queries[:, 0])[0, 1] > 0.99
    with pytest.raises(InputError, match="sample"):
        pca(queries, gallery, sample=1)


def test_pca_of_what_does_not_vary_is_one_point() -> None:
    same = np.ones((4, 1, 1), np.float32)
    found = pca(same, same)
    assert not found.queries.any()
    assert found.variance is not None
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
def test_umap_keeps_groups_together_and_repeats_itself() -> None:
    queries, gallery = drawn(40), drawn(40, seed=1)
    queries[:, 0] += 20
    gallery[:, 1] -= 20
    found = umap(queries, gallery, neighbours=5)
    apart = np.linalg.norm(found.queries.mean(axis=0) - found.tiles.mean(axis=0))
    assert apart > 2 * max(found.queries.std(), found.tiles.std())
    np.testing.assert_array_equal(umap(queries, gallery, neighbours=5).queries, found.queries)
