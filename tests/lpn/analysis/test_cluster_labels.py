import numpy as np
import pytest

from lpn.analysis.cluster_labels import cluster_labels, clusters_of


def groups() -> tuple[np.ndarray, np.ndarray]:
    """Three groups of 40 points far from each other, and the group of each; the last point has no place."""
    rng = np.random.default_rng(3)
    middles = np.array([(0.0, 0.0), (50.0, 0.0), (0.0, 50.0)])
    which = np.repeat(np.arange(3), 40)
    points = middles[which] + rng.normal(size=(120, 2))
    points[-1] = np.nan
    return points, which


def test_a_cluster_is_named_by_the_column_that_tells_it_apart() -> None:
    points, which = groups()
    districts = [(name, which == i) for i, name in enumerate(("dock", "wood", "mill"))]
    dusk = np.arange(120) % 4 == 0
    columns = {"light": [("day", ~dusk), ("dusk", dusk)], "district": districts}
    labels = cluster_labels(points, columns, most=3)
    assert {(label.column, label.value, label.queries) for label in labels} == {
        ("district", "dock", 40),
        ("district", "wood", 40),
        ("district", "mill", 39),
    }
    for label in labels:
        assert label.share == 1
        assert label.overall == pytest.approx((39 if label.value == "mill" else 40) / 119)
        members = points[which == ("dock", "wood", "mill").index(label.value)]
        np.testing.assert_allclose(label.middle, np.nanmedian(members, axis=0))


def test_nothing_is_named_that_no_column_tells_apart() -> None:
    points, which = groups()
    assert cluster_labels(points, {}) == []
    assert cluster_labels(points, {"city": [("Calm", np.ones(120, bool))]}) == []
    even = np.arange(120) % 2 == 0
    shares = cluster_labels(points[:-1], {"side": [("left", even[:-1]), ("right", ~even[:-1])]}, most=3)
    assert all(label.share > label.overall for label in shares)
    assert cluster_labels(points[:20], {"district": [("a", which[:20] == 0), ("b", which[:20] > 0)]}) == []


def test_clusters_are_the_same_each_time() -> None:
    points, which = groups()
    first = clusters_of(points, 3)
    assert first[-1] == -1
    assert (clusters_of(points, 3) == first).all()
    assert all(len(set(first[:-1][which[:-1] == group].tolist())) == 1 for group in range(3))
