"""Tests of the uses of the ground in a tile."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lpn.core.errors import DataError
from lpn.datasets.ground_use import ground_uses, named_uses

NORTH_ROAD = np.array([list("rrrr"), *(list("gggg") for _ in range(3))])


def test_uses_are_those_of_the_picture_as_it_is_zoomed() -> None:
    top = np.zeros((8, 8), bool)
    top[0] = True
    assert named_uses(NORTH_ROAD, top) == ["a road"]
    assert named_uses(NORTH_ROAD, top, zoom=2.0) == ["grass"], "the middle alone is described"
    assert named_uses(NORTH_ROAD, top, zoom=0.5) == [], "it lies beyond the tile"
    assert named_uses(np.full((4, 4), "."), top) == []


def test_a_file_of_uses_is_read_or_its_line_is_named(tmp_path: Path) -> None:
    assert ground_uses(tmp_path) == {}
    file = tmp_path / "ground.csv"
    file.write_text("path,uses\na/1.jpg,br gt\n")
    assert ground_uses(tmp_path)["a/1.jpg"].tolist() == [["b", "r"], ["g", "t"]]
    for bad in ("a/1.jpg,br g", "a/1.jpg,bx gt", "a/1.jpg"):
        file.write_text(f"path,uses\n{bad}\n")
        with pytest.raises(DataError, match=r"Line 2 of ground.csv"):
            ground_uses(tmp_path)
    file.write_text("name\n")
    with pytest.raises(DataError, match=r"The first line of ground.csv is name; expected path,uses"):
        ground_uses(tmp_path)
