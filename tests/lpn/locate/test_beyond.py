"""Places beyond the edge of a map."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lpn.locate.beyond import places_beyond
from lpn.maps import open_map
from tests.lpn.maps.small_maps import smooth, write_geotiff


def test_places_beyond_lie_on_the_windows_grid_outside_the_map_and_over_its_holes(tmp_path: Path) -> None:
    picture = np.concatenate([smooth(160, 240), np.full((160, 240, 1), 255, np.uint8)], axis=2)
    picture[40:120, 80:160, 3] = 0
    town = open_map(write_geotiff(tmp_path / "town.tif", picture, alpha="YES"))
    side = (town.bounds[2] - town.bounds[0]) / 6
    windows = np.array([(one.x, one.y) for one in town.pyramid([side], 0.5)])
    beyond = places_beyond(town, windows, np.full(len(windows), side), 0.5)
    cells = np.rint((np.concatenate([windows, beyond]) - windows.min(axis=0)) / (side / 2)).astype(int)
    # 11 by 7 windows, and two steps more on each side, which is one side of a window.
    expected = {(x, y) for x in range(-2, 13) for y in range(-2, 9)}
    assert sorted(map(tuple, cells.tolist())) == sorted(expected)
    assert 0 < 77 - len(windows) < 20
    # Windows that are left out, as by an index, are on the map; beyond the edge nothing changes.
    few = windows[np.linalg.norm(windows - windows[0], axis=1) > side]
    assert len(few) < len(windows)
    again = places_beyond(town, few, np.full(len(few), side), 0.5)
    assert set(map(tuple, again.round(3).tolist())) <= set(map(tuple, beyond.round(3).tolist()))
