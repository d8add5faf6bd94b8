from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from lpn.core.errors import InputError
from lpn.datasets import Truth
from lpn.retrieval import gallery_search, metrics
from tests.lpn.retrieval.test_ranks import plainly
from tools.fixtures import seeded

Case = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def case(seed: int, queries: int, classes: int, per_class: int, dim: int, noise: float, absent: int = 0) -> Case:
    """Descriptors scattered around one centre per class, drawn in the order the golden figures were."""
    rng = np.random.default_rng(seed)
    centres = rng.standard_normal((classes, dim)).astype(np.float32)
    labels = np.repeat(np.arange(classes), per_class)
    gallery = centres[labels] + noise * rng.standard_normal((len(labels), dim)).astype(np.float32)
    query_labels = rng.integers(0, classes + absent, queries)
    centre = np.where((query_labels < classes)[:, None], centres[np.minimum(query_labels, classes - 1)], 0)
    query = centre + noise * rng.standard_normal((queries, dim)).astype(np.float32)
    query /= np.linalg.norm(query, axis=1, keepdims=True)
    gallery /= np.linalg.norm(gallery, axis=1, keepdims=True)
    return query.astype(np.float32), query_labels, gallery.astype(np.float32), labels


def by_the_book(query: np.ndarray, query_labels: np.ndarray, gallery: np.ndarray, labels: np.ndarray) -> list[float]:
    """The figures from a whole sort of each query's scores."""
    truth = [Truth(np.flatnonzero(labels == label), np.flatnonzero(labels == -1)) for label in query_labels]
    first, *_, precision = map(np.array, zip(*plainly(query, gallery, truth), strict=True))
    depths = (0, 4, 9, round(0.01 * len(labels)))
    return [100 * float(value.mean()) for value in (*((first >= 0) & (first <= k) for k in depths), precision)]


KEYS = ("recall@1", "recall@5", "recall@10", "recall@1%", "ap")


@pytest.mark.parametrize("name", ["drone_to_satellite", "satellite_to_drone"])
def test_golden_figures_of_the_published_evaluation(name: str) -> None:
    golden: dict[str, Any] = json.loads((seeded.DATA / "metrics_golden.json").read_text())[name]
    found = metrics.evaluate(*case(*golden["args"]))
    for key, published in zip(KEYS, ("r1", "r5", "r10", "r_top1pct", "ap"), strict=True):
        assert found[key] == pytest.approx(golden[published], abs=1e-6)


@st.composite
def coarse(draw: st.DrawFn) -> Case:
    """Descriptors of one to three numbers, each -1, 0, or 1, and labels of few classes."""

    def drawn(dtype: type, shape: tuple[int, ...], least: int, most: int) -> np.ndarray:
        return draw(arrays.arrays(np.int64, shape, elements=st.integers(least, most))).astype(dtype)

    queries, tiles, classes, dim = (draw(st.integers(1, most)) for most in (12, 40, 5, 3))
    query, gallery = (drawn(np.float32, (rows, dim), -1, 1) for rows in (queries, tiles))
    return query, drawn(np.int64, (queries,), 0, classes), gallery, drawn(np.int64, (tiles,), -1, classes - 1)


@given(coarse())
def test_coarse_descriptors_full_of_ties_are_treated_by_the_book(made: Case) -> None:
    query, query_labels, gallery, labels = made
    found = metrics.evaluate(query, query_labels, gallery, labels)
    np.testing.assert_allclose(
        [found[key] for key in KEYS], by_the_book(query, query_labels, gallery, labels), atol=1e-9
    )


def test_parts_and_flat_descriptors_agree_and_ranks_tell_failures() -> None:
    query, query_labels, gallery, labels = case(9, 40, 30, 2, 16, 1.0, 5)
    flat = metrics.evaluate(query, query_labels, gallery, labels)
    assert metrics.evaluate(query.reshape(-1, 4, 4), query_labels, gallery.reshape(-1, 4, 4), labels) == flat
    ranks = metrics.retrieve(query, query_labels, gallery, labels).first
    assert 100 * float(np.mean(ranks == 0)) == pytest.approx(flat["recall@1"])
    assert set(ranks[query_labels >= 30]) == {-1}


def test_wrong_arrays_are_refused_in_words() -> None:
    query, query_labels, gallery, labels = case(1, 5, 5, 1, 8, 1.0)
    bad = query.copy()
    bad[2, 3] = np.nan
    for arguments, word in (
        ((bad, query_labels, gallery, labels), "not finite"),
        ((query[:, :4], query_labels, gallery, labels), "4 numbers"),
        ((query, query_labels[:3], gallery, labels), "one integer for each of 5"),
        ((query[:0], query_labels[:0], gallery, labels), "at least one row"),
        ((query, query_labels.astype(float), gallery, labels), "integer"),
        (([[1.0, 2.0], [3.0]], query_labels, gallery, labels), "unequal lengths"),
    ):
        with pytest.raises(InputError, match=word):
            metrics.evaluate(*arguments)


def lists(seed: int, queries: int, gallery: int) -> list[Truth]:
    """True matches and junk of each query, some with neither."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(queries):
        shuffled = rng.permutation(gallery)
        good, junk = rng.integers(0, 6), rng.integers(0, 5)
        made.append(Truth(np.sort(shuffled[:good]), np.sort(shuffled[good : good + junk])))
    return made


def test_queries_of_unknown_truth_do_not_count() -> None:
    rng = np.random.default_rng(3)
    query, gallery = (rng.standard_normal((count, 8)).astype(np.float32) for count in (12, 40))
    truth = lists(3, 12, 40)
    unknown = Truth(np.zeros(0, np.int64), truth[0].junk, known=False)
    graded = metrics.evaluate(query[1:], None, gallery, None, truth[1:])
    assert metrics.evaluate(query, None, gallery, None, [unknown, *truth[1:]]) == graded
    assert graded["queries"] == 11
    missed = metrics.evaluate(query, None, gallery, None, [replace(unknown, known=True), *truth[1:]])
    assert missed["queries"] == 12
    none = metrics.evaluate(query[:1], None, gallery, None, [unknown])
    assert none["queries"] == 0
    assert np.isnan([none["recall@1"], none["ap"]]).all()


def test_the_best_match_is_the_first_of_equals_and_never_junk() -> None:
    gallery = np.array([[0, 1], [1, 0], [1, 0], [9, 9]], np.float32)
    found = metrics.retrieve(np.eye(2, dtype=np.float32), np.array([1, 0]), gallery, np.array([0, 1, 2, -1]))
    assert found.best.tolist() == [1, 0]
    nothing = metrics.retrieve(gallery, np.zeros(4, int), gallery, np.full(4, -1))
    assert nothing.best.tolist() == [-1] * 4
    assert nothing.metrics()["recall@10"] == 0


@pytest.mark.parametrize(
    ("truth", "said"),
    [
        ([], "0 lists"),
        ([Truth(np.array([2]), np.array([5]))], "expected 0 to 4"),
        ([Truth(np.array([-1]), np.array([0]))], "expected 0 to 4"),
        ([Truth(np.array([2, 3]), np.array([3]))], "twice"),
    ],
)
def test_lists_that_do_not_fit_are_refused(truth: list[Truth], said: str) -> None:
    query, _, gallery, _ = case(1, 1, 5, 1, 8, 1.0)
    with pytest.raises(InputError, match=said):
        metrics.evaluate(query, None, gallery, None, truth)


@pytest.mark.parametrize("factors", [None, np.array([1.0, 0.0, 2.0, 1.0])])
def test_the_gap_is_that_of_the_first_two_tiles_whatever_they_show(factors: np.ndarray | None) -> None:
    rng = np.random.default_rng(4)
    queries, tiles = (rng.standard_normal((count, 4)).astype(np.float32) for count in (9, 6))
    truth = lists(4, 9, 6)
    found = metrics.retrieve(queries, None, tiles, None, truth, factors)
    scores = (queries if factors is None else queries * factors) @ tiles.T
    for query, of in enumerate(truth):
        ordered = np.sort(np.delete(scores[query], of.junk))
        assert found.gap[query] == pytest.approx(2 * (ordered[-1] - ordered[-2]), abs=1e-5)
    one = metrics.retrieve(queries, np.zeros(9, int), tiles, np.array([0, -1, -1, -1, -1, -1]))
    assert np.isnan(one.gap).all(), "there is no second tile"
    assert np.isnan(metrics.retrieve(queries, np.zeros(9, int), tiles[:1], np.array([0])).gap).all()


@pytest.mark.parametrize("ties", [False, True])
def test_a_query_of_a_region_is_ranked_as_if_all_tiles_elsewhere_were_junk(ties: bool) -> None:
    rng = np.random.default_rng(5)
    query, gallery = (rng.standard_normal((count, 4, 8)).astype(np.float32) for count in (30, 600))
    if ties:
        gallery[100:500] = gallery[0]
    regions = [np.arange(150), np.arange(150, 420), None, np.arange(420, 600)]
    within, listed = [], []
    for i in range(30):
        region = regions[i // 9]
        own = np.arange(600) if region is None else region
        good, junk = np.split(np.sort(rng.choice(own, 7, replace=False)), [3])
        others = np.setdiff1d(np.arange(600), own)
        within.append(Truth(good, junk, among=region))
        listed.append(Truth(good, np.sort([*junk, *others])))
        np.testing.assert_array_equal(np.flatnonzero(within[-1].unranked(600)), listed[-1].junk)
        cosines, weights = np.einsum("gnd,nd->gn", gallery, query[i]), np.full(4, 0.25)
        orders = [gallery_search.rank(cosines, weights, truth=of[-1]).order for of in (within, listed)]
        np.testing.assert_array_equal(*orders)
    found, expected = (metrics.retrieve(query, None, gallery, None, truth) for truth in (within, listed))
    for name in ("first", "true", "false", "precision", "gap"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    with pytest.raises(InputError, match="expected 0 to 599"):
        metrics.retrieve(query, None, gallery, None, [replace(within[0], among=np.array([600])), *within[1:]])
