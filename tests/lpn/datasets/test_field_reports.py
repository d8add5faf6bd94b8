"""Data sets as public reports describe them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from lpn.core.errors import DataError
from lpn.datasets import open_dataset
from tools.fixtures import layouts, small_worlds


def sizes(root: Path) -> dict[str, int]:
    return {name: len(pictures) for name, pictures in open_dataset(root).lists().items()}


def test_upper_case_endings_and_hidden_folders_are_read_as_others_are(tmp_path: Path) -> None:
    root = layouts.university_gaps(tmp_path / "places")
    before = sizes(root)
    for file in sorted(root.rglob("*.jpg")):
        file.rename(file.with_suffix(".JPG"))
    small_worlds.write(root / "train" / "drone" / ".ipynb_checkpoints" / "a.jpg", layouts.small(1))
    assert sizes(root) == before


def test_numbers_without_leading_zeros_are_places_by_their_value(tmp_path: Path) -> None:
    root = layouts.university_gaps(tmp_path / "places")
    for place in sorted((root / "train").glob("*/000?")):
        place.rename(place.with_name({"0000": "100", "0001": "2", "0002": "30"}[place.name]))
    for view in ("satellite", "drone"):
        assert [picture.label for picture in open_dataset(root).train(view)] == [100, 2, 30]


def test_further_lists_of_the_test_split_are_left_alone(tmp_path: Path) -> None:
    root = layouts.university_gaps(tmp_path / "places")
    before = sizes(root)
    shutil.copytree(root / "test" / "query_drone", root / "test" / "query_drone_one")
    assert sizes(root) == before


def test_a_tile_of_another_pyramid_among_those_of_uav_visloc_is_named(tmp_path: Path) -> None:
    root = layouts.gta(tmp_path / "visloc", degrees=True)
    small_worlds.write(root / "satellite" / "0_1.png", layouts.small(1))
    with pytest.raises(DataError, match=r"The tile 0_1\.png has no position in its name; expected four numbers"):
        open_dataset(root).positions()


@pytest.mark.parametrize("before", ["", ".\\", "./"])
@pytest.mark.parametrize("after", ["", " " * 150, "\t"])
def test_lists_with_paths_as_another_system_writes_them(tmp_path: Path, before: str, after: str) -> None:
    root = layouts.pairs(tmp_path / "mine", "satellite,drone\nimages/b.jpg,images/1.jpg\n")
    (root / "pairs.csv").write_text(f"satellite,drone\n{before}images/b.jpg{after},{before}images\\1.JPG{after}\n")
    assert sizes(root) == {"test/satellite": 1, "test/drone": 1}


def test_panoramas_and_tiles_of_cvact_in_folders_of_other_names_are_asked_for(tmp_path: Path) -> None:
    root = layouts.cvact(tmp_path / "cvact")
    (root / "satview_polish").rename(root / "satview_correct")
    with pytest.raises(DataError, match="expected their files in streetview and satview_polish"):
        open_dataset(root)
