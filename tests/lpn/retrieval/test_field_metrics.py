"""The field's metrics against values of the released evaluation codes."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from lpn.core.errors import InputError
from lpn.datasets import Truth, geo
from lpn.retrieval import field_metrics, metrics
from lpn.retrieval.ranks import average_precision
from tools.fixtures import seeded


@pytest.fixture(scope="module")
def golden() -> dict[str, Any]:
    """Scores, labels, and positions, with the released codes' results."""
    return dict(json.loads((seeded.DATA / "metrics_field.json").read_text()))


def as_descriptors(scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors whose inner products are these scores (Q, G)."""
    return np.eye(len(scores)), scores.T


def ranked(golden: dict[str, Any], k: int, drop_junk: bool) -> np.ndarray:
    junk = np.array(golden["gallery_label"]) == -1
    return field_metrics.nearest(*as_descriptors(np.array(golden["scores"])), k, junk if drop_junk else None)


@pytest.mark.parametrize("k", [1, 3, 5, 10])
def test_sdm_of_denseuav(golden: dict[str, Any], k: int) -> None:
    tiles = np.array(golden["gallery_lat_lon"])[ranked(golden, 10, drop_junk=True)]
    degrees = field_metrics.degree_distances(np.array(golden["query_lat_lon"])[:, None], tiles)
    found = field_metrics.sdm(degrees, k, field_metrics.DENSEUAV_DECAY)
    np.testing.assert_allclose(found, golden["denseuav"]["sdm"][str(k)]["per_query"], atol=1e-7)


def test_accuracy_within_metres_of_denseuav(golden: dict[str, Any]) -> None:
    tiles = np.array(golden["gallery_lat_lon"])[ranked(golden, 1, drop_junk=True)[:, 0]]
    top = field_metrics.great_circle(golden["query_lat_lon"], tiles)
    np.testing.assert_allclose(top, golden["denseuav"]["top1_distance_m"], atol=1e-6)
    for metres, share in golden["denseuav"]["ma"].items():
        assert field_metrics.accuracy_within(top, float(metres)) == pytest.approx(100 * share)
    assert field_metrics.accuracy_within([19.9, 20.0, 3.0, 50.0], 20) == 50


@pytest.mark.parametrize("name", ["gta", "visloc"])
def test_sdm_and_dis_of_game4loc(golden: dict[str, Any], name: str) -> None:
    order = ranked(golden, 5, drop_junk=False)
    if name == "gta":
        tiles = np.array(golden["gallery_xy_m"])[order]
        metres = np.linalg.norm(np.array(golden["query_xy_m"])[:, None] - tiles, axis=2)
    else:
        metres = geo.geodesic(np.array(golden["query_lat_lon"])[:, None], np.array(golden["gallery_lat_lon"])[order])
    for i, k in enumerate((1, 3, 5)):
        sdm, distance = field_metrics.sdm(metres, k, field_metrics.GTA_UAV_DECAY), field_metrics.distance_at(metres, k)
        np.testing.assert_allclose(sdm, np.array(golden[name]["sdm_per_query"])[:, i], rtol=1e-9)
        np.testing.assert_allclose(distance, np.array(golden[name]["dis_per_query"])[:, i], rtol=1e-9)


def test_lists_of_true_tiles_without_the_trapezoid(golden: dict[str, Any]) -> None:
    query, gallery = as_descriptors(np.array(golden["scores"]))
    none = np.zeros(0, np.int64)
    truth = [Truth(np.array(good, np.int64), none, trapezoid=False) for good in golden["positives"]]
    found = metrics.retrieve(query, None, gallery, None, truth)
    expected = golden["game4loc_list"]
    answered = found.first >= 0
    np.testing.assert_allclose(found.precision[answered], expected["ap_per_query_with_match"])
    assert found.precision[answered].mean() == pytest.approx(expected["ap"])
    for k, share in expected["recall"].items():
        assert found.recall(int(k)) == pytest.approx(100 * share)
    order = np.argsort(-np.array(golden["scores"]), axis=1, kind="stable")
    hits = np.array([np.isin(row, good) for row, good in zip(order, golden["positives"], strict=True)])
    assert [field_metrics.recall_at(hits, k) for k in (1, 5, 10)] == [found.recall(k) for k in (1, 5, 10)]


def test_average_precision_without_the_trapezoid_is_the_mean_precision() -> None:
    rng = np.random.default_rng(0)
    query, gallery = rng.standard_normal((8, 6)), rng.integers(-1, 2, (40, 6)).astype(float)
    none = np.zeros(0, np.int64)
    lists = [rng.choice(40, rng.integers(1, 6), replace=False) for _ in range(8)]
    truth = [Truth(np.sort(good), none, trapezoid=i % 2 == 0) for i, good in enumerate(lists)]
    found = metrics.retrieve(query, None, gallery, None, truth)
    for i, good in enumerate(lists):
        order = np.argsort(-(gallery @ query[i]), kind="stable")
        ranks = np.flatnonzero(np.isin(order, good))
        assert found.precision[i] == pytest.approx(average_precision(ranks, i % 2 == 0))


@pytest.mark.parametrize("name", ["trapezoid", "trapezoid_without_distractors"])
def test_the_galleries_of_the_published_codes(golden: dict[str, Any], name: str) -> None:
    query, gallery = as_descriptors(np.array(golden["scores"]))
    labels = np.array(golden["gallery_label"])
    if name != "trapezoid":
        labels = metrics.without_distractors(labels, np.array(golden["query_label"]))
    found = metrics.evaluate(query, golden["query_label"], gallery, labels)
    assert found["ap"] == pytest.approx(100 * golden[name]["ap"])
    for k, share in golden[name]["recall"].items():
        assert found[f"recall@{k}"] == pytest.approx(100 * share)
    assert found["gallery"] == len(labels)


@pytest.mark.parametrize("k", [1, 4, 30])
def test_nearest_is_the_head_of_the_sorted_gallery(k: int) -> None:
    rng = np.random.default_rng(k)
    query, gallery = rng.integers(-1, 2, (12, 4)).astype(np.float32), rng.integers(-1, 2, (25, 4)).astype(np.float32)
    junk = rng.random(25) < 0.3
    kept = np.flatnonzero(~junk)
    expected = np.array([kept[np.argsort(-(gallery[kept] @ one), kind="stable")[:k]] for one in query])
    np.testing.assert_array_equal(field_metrics.nearest(query, gallery, k, junk), expected)
    with pytest.raises(InputError, match="0 gallery pictures are not junk"):
        field_metrics.nearest(query, gallery, k, np.ones(25, bool))
