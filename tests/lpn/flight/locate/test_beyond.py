"""Places beyond the edge of a map."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lpn.flight.locate.ranked_stages import places_beyond
from lpn.flight.locate.retrieval import WindowGallery
from lpn.flight.locate.sequence import merged_coordinates
from lpn.flight.maps import Window, open_map
from tests.lpn.flight.maps.small_maps import smooth, write_geotiff


def _gallery(places: np.ndarray, size: float, overlap: float) -> WindowGallery:
    windows = [Window(x, y, size) for x, y in places.tolist()]
    return WindowGallery(windows, overlap, np.zeros((len(windows), 1, 1), np.float32))


def test_places_beyond_lie_on_the_windows_grid_outside_the_map_and_over_its_holes(tmp_path: Path) -> None:
    picture = np.concatenate([smooth(160, 240), np.full((160, 240, 1), 255, np.uint8)], axis=2)
    picture[40:120, 80:160, 3] = 0
    town = open_map(write_geotiff(tmp_path / "town.tif", picture, alpha="YES"))
    side = (town.bounds[2] - town.bounds[0]) / 6
    windows = np.array([(one.x, one.y) for one in town.pyramid([side], 0.5)])
    beyond = places_beyond(town, _gallery(windows, side, 0.5))
    cells = np.rint((np.concatenate([windows, beyond]) - windows.min(axis=0)) / (side / 2)).astype(int)
    # 11 by 7 windows, and two steps more on each side, which is one side of a window.
    expected = {(x, y) for x in range(-2, 13) for y in range(-2, 9)}
    assert sorted(map(tuple, cells.tolist())) == sorted(expected)
    assert 0 < 77 - len(windows) < 20
    # Windows that are left out, as by an index, are on the map; beyond the edge nothing changes.
    few = windows[np.linalg.norm(windows - windows[0], axis=1) > side]
    assert len(few) < len(windows)
    again = places_beyond(town, _gallery(few, side, 0.5))
    assert set(map(tuple, again.round(3).tolist())) <= set(map(tuple, beyond.round(3).tolist()))


def _plain(side: float, size: float, step: float) -> tuple[Any, np.ndarray]:
    """Return a square map without holes, and the centres of its windows."""
    along = np.arange(size / 2, side - size / 2 + 1e-6, step)
    town = SimpleNamespace(bounds=(0.0, 0.0, side, side), valid_shares=lambda centres, _: np.ones(len(centres)))
    return town, np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("kept", [1.0, 0.1])
def test_places_beyond_lie_on_the_grid_of_windows_whose_coordinates_are_rounded(kept: float) -> None:
    rng = np.random.default_rng(0)
    town, exact = _plain(3000.0, 100.0, 25.0)
    windows = (exact + rng.uniform(-0.005, 0.005, exact.shape))[rng.random(len(exact)) < kept]
    beyond = places_beyond(town, _gallery(windows, 100.0, 0.75))
    steps = (beyond - 50) / 25
    np.testing.assert_allclose(steps, np.rint(steps), atol=0.001)
    assert [len(merged_coordinates(axis)[0]) for axis in np.concatenate([windows, beyond]).T] == [125, 125]


@pytest.mark.parametrize(("overlap", "steps"), [(0.5, 2), (0.6, 2), (0.75, 4), (0.8, 5), (0.9, 10)])
def test_places_beyond_are_at_most_a_side_away(overlap: float, steps: int) -> None:
    town, windows = _plain(500.0, 100.0, 100 * (1 - overlap))
    beyond = places_beyond(town, _gallery(windows, 100.0, overlap))
    count = round(len(windows) ** 0.5)
    assert len(beyond) == (count + 2 * steps) ** 2 - count**2
    lone = places_beyond(town, _gallery(windows[:1], 100.0, overlap))
    np.testing.assert_allclose(windows[0] - lone.min(axis=0), steps * 100 * (1 - overlap))


def test_places_beyond_of_each_size_have_its_own_step() -> None:
    (town, small), (_, large) = _plain(2000.0, 100.0, 25.0), _plain(2000.0, 200.0, 50.0)
    galleries = _gallery(small, 100.0, 0.75), _gallery(large, 200.0, 0.75)
    apart = [places_beyond(town, one) for one in galleries]
    assert [len(one) for one in apart] == [(77 + 8) ** 2 - 77**2, (37 + 8) ** 2 - 37**2]
    windows = [window for one in galleries for window in one.windows]
    both = places_beyond(town, WindowGallery(windows, 0.75, np.zeros((len(windows), 1, 1), np.float32)))
    np.testing.assert_array_equal(both, np.concatenate(apart))
