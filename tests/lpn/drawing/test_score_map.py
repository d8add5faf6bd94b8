from __future__ import annotations

import numpy as np
import pytest

from lpn.drawing.score_map import score_map


def test_every_window_paints_the_ground_half_way_to_its_neighbours() -> None:
    x, y = np.meshgrid([5.0, 15.0, 25.0], [40.0, 30.0])
    places = np.column_stack([x.ravel(), y.ravel()])
    # Coordinates of a row differ by rounding, and a window is missing.
    places[:3, 1] += (0.0, 1e-9, -1e-9)
    drawn = score_map(places[:5], np.full(5, 40.0), np.arange(5.0))
    assert drawn is not None
    assert drawn.bounds == pytest.approx((0.0, 25.0, 30.0, 45.0), abs=1e-6)
    np.testing.assert_array_equal(drawn.cells, [[0, 1, 2], [3, 4, np.nan]])
    assert (drawn.low, drawn.high) == (0.0, 4.0)


def test_the_highest_score_counts_where_windows_of_several_sizes_lie() -> None:
    places = np.array([(10.0, 10.0), (30.0, 10.0), (20.0, 10.0)])
    drawn = score_map(places, np.array([20.0, 20.0, 40.0]), np.array([0.1, 0.9, 0.5]))
    assert drawn is not None
    west, south, east, north = drawn.bounds
    assert (west, south, east, north) == pytest.approx((0.0, -10.0, 40.0, 30.0))

    def at(x: float, y: float) -> float:
        rows, columns = drawn.cells.shape
        return float(drawn.cells[int((north - y) / (north - south) * rows), int((x - west) / (east - west) * columns)])

    assert at(5, 10) == 0.5
    assert at(35, 10) == 0.9
    assert at(35, 28) == 0.5


def test_a_lone_window_covers_its_side() -> None:
    drawn = score_map(np.array([(1.0, 2.0)]), np.array([6.0]), np.array([0.3]))
    assert drawn is not None
    assert drawn.bounds == pytest.approx((-2.0, -1.0, 4.0, 5.0))
    np.testing.assert_array_equal(drawn.cells, [[0.3]])


def test_no_window_paints_nothing() -> None:
    assert score_map(np.zeros((0, 2)), np.zeros(0), np.zeros(0)) is None
