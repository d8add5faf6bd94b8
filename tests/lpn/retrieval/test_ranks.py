from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from lpn.datasets import Truth
from lpn.retrieval import metrics, ranks


def plainly(
    queries: np.ndarray, gallery: np.ndarray, truth: list[Truth], factors: np.ndarray | None = None
) -> list[list[Any]]:
    """Ranks, nearest true and false tile, and precision of each query from a whole sort of scores in double precision."""
    found: list[list[Any]] = []
    for query, of in zip(queries.astype(np.float64), truth, strict=True):
        asked = query if factors is None else query * factors
        products = (gallery.astype(np.float64) * asked).sum(axis=1)
        order = [int(tile) for tile in np.argsort(-products, kind="stable") if tile not in of.junk]
        at = [rank for rank, tile in enumerate(order) if tile in of.good]
        false = [tile for tile in order if tile not in of.good]
        terms = [((i + 1) / (rank + 1) + (i / rank if rank else 1)) / 2 for i, rank in enumerate(at)]
        found.append([at[0] if at else -1, order[at[0]] if at else -1, false[0] if false else -1])
        found[-1] += [order[0] if order else -1, sum(terms) / len(terms) if terms else 0.0]
    return found


def same(found: metrics.Retrieval, expected: list[list[Any]]) -> None:
    columns = [np.array(column) for column in zip(*expected, strict=True)]
    for name, column in zip(("first", "true", "false", "best"), columns, strict=False):
        np.testing.assert_array_equal(getattr(found, name), column, name)
    np.testing.assert_allclose(found.precision, columns[4], atol=1e-14)


def truths(rng: np.random.Generator, queries: int, gallery: int, most: int) -> list[Truth]:
    """Lists of nothing, one, or several true matches, and junk."""
    made = []
    for _ in range(queries):
        drawn = rng.permutation(gallery)
        good, junk = int(rng.integers(0, most + 1)), int(rng.integers(0, 4))
        made.append(Truth(np.sort(drawn[:good]), np.sort(drawn[good : good + junk])))
    return made


def alike(rng: np.random.Generator, queries: int, gallery: int, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors whose scores are exactly equal, 1e-8 apart, or apart, and none of which are sorted."""
    kinds = rng.standard_normal((max(gallery // 4, 1), length))
    tiles = kinds[rng.integers(0, len(kinds), gallery)]
    tiles = (tiles / np.linalg.norm(tiles, axis=1, keepdims=True)).astype(np.float32)
    moved = rng.random(gallery) < 0.4
    column = rng.integers(0, length, gallery)
    lines = np.arange(gallery)
    nudged = np.nextafter(tiles[lines, column], np.float32(1))
    tiles[lines, column] = np.where(moved, nudged, tiles[lines, column])
    asked = tiles[rng.integers(0, gallery, queries)] + 0.7 * rng.standard_normal((queries, length)) / np.sqrt(length)
    return (asked / np.linalg.norm(asked, axis=1, keepdims=True)).astype(np.float32), tiles


@pytest.mark.parametrize("length", [7, 1300, 9000])  # the last is longer than NumPy's buffer
@pytest.mark.parametrize("seed", range(6))
def test_equal_and_almost_equal_scores_are_ranked_as_in_double_precision(
    seed: int, length: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ranks, "_COLUMNS", 13)
    monkeypatch.setattr(ranks, "_BLOCK_BYTES", 4 * 60 * 7)
    rng = np.random.default_rng(seed)
    queries, tiles = alike(rng, 30, 60, length)
    truth = truths(rng, 30, 60, (1, 12)[seed % 2])
    same(metrics.retrieve(queries, None, tiles, None, truth), plainly(queries, tiles, truth))


@pytest.mark.parametrize(
    ("precision", "size"),
    [(np.float16, 1e-3), (np.float16, 1e4), *((np.float32, 10.0**k) for k in (-45, -36, -22, 12, 25, 37))]
    + [(np.float64, 10.0**k) for k in (-300, -60, -20, 60, 290)],
)
def test_any_size_and_precision_of_numbers_is_ranked_alike(precision: Any, size: float) -> None:
    rng = np.random.default_rng(1)
    queries, tiles = (side.astype(np.float64) for side in alike(rng, 20, 40, 24))
    truth = truths(rng, 20, 40, 5)
    for of_query, of_tile in ((size, 1.0), (1.0, size)):
        one, other = (queries * of_query).astype(precision), (tiles * of_tile).astype(precision)
        same(metrics.retrieve(one, None, other, None, truth), plainly(one, other, truth))


def test_doubles_that_single_precision_cannot_tell_apart_are_ranked() -> None:
    rng = np.random.default_rng(2)
    tile = rng.standard_normal(40)
    tiles = tile + 1e-12 * rng.standard_normal((30, 40))
    queries = tile + 0.1 * rng.standard_normal((10, 40))
    truth = truths(rng, 10, 30, 3)
    same(metrics.retrieve(queries, None, tiles, None, truth), plainly(queries, tiles, truth))


@pytest.mark.parametrize("apart", [0.0, 1e-7, 1e-3])
@pytest.mark.parametrize("most", [0, 20])
def test_a_network_that_has_collapsed_is_ranked_as_in_double_precision(
    apart: float, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    pairs: list[int] = []
    exact = ranks.Scores.exact
    monkeypatch.setattr(
        ranks.Scores, "exact", lambda self, of, tiles: pairs.append(len(tiles)) or exact(self, of, tiles)
    )
    monkeypatch.setattr(ranks, "_MOST_CLOSE", most)
    rng = np.random.default_rng(4)
    tile = rng.standard_normal(40)
    tiles = (tile + apart * rng.standard_normal((60, 40))).astype(np.float32)
    queries = (tile + 0.1 * rng.standard_normal((25, 40))).astype(np.float32)
    truth = truths(rng, 25, 60, 5)
    same(metrics.retrieve(queries, None, tiles, None, truth), plainly(queries, tiles, truth))
    # A crowded query is compared with each tile once; another one has few close tiles for each of its true ones.
    assert sum(pairs) <= 25 * (60 + 2 * most + 5)


@pytest.mark.parametrize("queries", [1, 3])
@pytest.mark.parametrize("good", [0, 1, 2, 54])
def test_a_few_queries_to_equal_tiles_are_ranked_in_gallery_order(queries: int, good: int) -> None:
    tiles, asked = np.full((2000, 16), 0.25, np.float32), np.full((queries, 16), 0.25, np.float32)
    truth = [Truth(np.arange(100, 100 + good), np.arange(50))] * queries
    same(metrics.retrieve(asked, None, tiles, None, truth), plainly(asked, tiles, truth))


def test_weighted_queries_are_ranked_by_what_they_are_weighted_to() -> None:
    rng = np.random.default_rng(3)
    queries, tiles = alike(rng, 25, 40, 32)
    factors = rng.uniform(0, 3, 32)
    truth = truths(rng, 25, 40, 4)
    found = metrics.retrieve(queries, None, tiles, None, truth, factors)
    same(found, plainly(queries, tiles, truth, factors))


@pytest.mark.parametrize("length", [5, 512, 2048, 20_000])
def test_no_product_is_off_by_more_than_is_said(length: int) -> None:
    rng = np.random.default_rng(length)
    queries, tiles = (np.abs(rng.standard_normal((count, length))).astype(np.float32) for count in (6, 9))
    held = ranks.Scores(queries, tiles, (metrics.norms(queries), metrics.norms(tiles)))
    exact = queries.astype(np.float64) @ tiles.T.astype(np.float64)
    for rows, block, errors in held.blocks():
        off = np.abs(block - exact[rows])
        assert (off <= errors[:, None]).all()
        # The bound is relative to the longest of the tiles.
        assert (errors < 1.1e-7 * 600 * exact[rows].max(axis=1) * 2).all()


def test_norms_are_bounds_and_tell_what_is_not_finite() -> None:
    rows = np.array([[3, 4], [1e-30, 0], [1e30, 1e30], [0, 0], [np.nan, 1], [np.inf, 0]], np.float32)
    found, true = metrics.norms(rows), np.array([5, 1e-30, np.sqrt(2) * 1e30, 0])
    assert (found[:4] >= true).all()
    assert (found[:4] <= 1.0011 * true).all()
    assert not np.isfinite(found[4:]).any()
