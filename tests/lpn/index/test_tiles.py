"""The positions of tiles that are added to an index."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from lpn.core.errors import DataError
from lpn.datasets import open_dataset
from lpn.index import tiles
from tools.fixtures import layouts, small_worlds


@pytest.mark.parametrize("make", [layouts.denseuav, layouts.vigor, partial(layouts.gta, degrees=True)])
def test_positions_of_a_data_set_are_those_that_it_tells_itself(make: Callable[[Path], Path], tmp_path: Path) -> None:
    dataset = open_dataset(make(tmp_path / "data"))
    gallery, known = dataset.gallery("satellite"), dataset.positions()
    expected = [(place.latitude, place.longitude) for place in known.of(gallery)]
    assert np.ptp(expected, axis=0).max() > 0
    described = os.path.commonpath([tile.path.parent.parent for tile in gallery])
    names = [tile.path.relative_to(described).as_posix() for tile in gallery]
    np.testing.assert_array_equal(tiles._positions(dataset.root, names), expected)


def test_a_folder_without_positions_is_told_in_a_sentence(tmp_path: Path) -> None:
    small_worlds.write(tmp_path / "plain" / "a.png", small_worlds.place(1))
    (tmp_path / "empty").mkdir()
    for folder, reason in (("plain", ""), ("empty", r" \(.+\)")):
        with pytest.raises(
            DataError, match=rf"{folder} has no geo.csv, and its lists have no positions{reason}; leave --data out"
        ):
            tiles._positions(tmp_path / folder, ["a.png"])
