from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lpn.core import images
from lpn.core.errors import InputError, PictureError
from lpn.datasets import open_dataset
from lpn.descriptors.transforms import UNCHANGED, Change
from tools.fixtures import small_worlds


def test_a_shift_pads_one_side_with_black_and_crops_the_other() -> None:
    picture = small_worlds.place(1)
    right, down = Change(shift=10).move(picture), Change(down=10).move(picture)
    np.testing.assert_array_equal(right[:, 10:], picture[:, :-10])
    np.testing.assert_array_equal(down[10:], picture[:-10])
    assert not right[:, :10].any()
    assert not down[:10].any()
    both = Change(shift=-4, down=-10).move(picture)
    np.testing.assert_array_equal(both[:-10, :-4], picture[10:, 4:])
    assert not both[-10:].any()
    assert not both[:, -4:].any()


def test_a_shift_is_shown_at_any_resolution_by_as_much_of_its_sides() -> None:
    picture = small_worlds.place(1)
    shown = Change(shift=16, down=-8).show(picture, (32, 64))
    np.testing.assert_array_equal(shown, images.shift(picture, 24, -24))


def test_a_shift_of_everything_is_refused() -> None:
    with pytest.raises(InputError, match="96 wide"):
        Change(shift=small_worlds.SIZE).move(small_worlds.place(1))
    with pytest.raises(InputError, match="96 high"):
        Change(down=-small_worlds.SIZE).move(small_worlds.place(1))


@pytest.mark.parametrize("shape", [(96, 96), (61, 40)])
def test_zooming_keeps_the_centre_and_shrinking_the_canvas(shape: tuple[int, int]) -> None:
    height, width = shape
    picture = images.resize(small_worlds.place(2), height, width)
    magnified = Change(scale=2).apply(picture)
    top, left = round(height / 4), round(width / 4)
    np.testing.assert_array_equal(magnified, picture[top : height - top, left : width - left])
    assert Change(scale=16).apply(picture[:3, :3]).shape == (1, 1, 3)
    small = Change(scale=0.5).apply(picture)
    assert small.shape == picture.shape
    inside = small.any(axis=2)
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    assert rows[0] == height - 1 - rows[-1]
    assert columns[0] == width - 1 - columns[-1]
    assert abs(len(rows) - height / 2) <= 1
    assert abs(len(columns) - width / 2) <= 1


def test_turning_comes_before_zooming_and_nothing_changes_nothing() -> None:
    picture = small_worlds.place(3)
    assert not UNCHANGED
    assert UNCHANGED.apply(picture) is picture
    assert UNCHANGED.move(picture) is picture
    assert UNCHANGED.describe() == ""
    assert Change(down=-3)
    assert Change(down=-3).describe() == "shifted 3 px up"
    change = Change(30, 5, 0.8)
    assert change.describe() == "turned 30°, scaled by 0.8, shifted 5 px to the right"
    np.testing.assert_array_equal(change.apply(picture), images.zoom(images.rotate(picture, 30), 0.8))


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"rotate": float("nan")}, "rotation is nan"),
        ({"shift": 1.5}, "shift is 1.5"),
        ({"down": 0.5}, "shift is 0.5"),
        ({"shift": float("inf")}, "shift is inf"),
        ({"scale": 0}, "scale is 0"),
        ({"scale": float("inf")}, "scale is inf"),
        ({"scale": float("nan")}, "scale is nan"),
    ],
)
def test_changes_that_mean_nothing_are_refused(values: dict[str, float], said: str) -> None:
    with pytest.raises(InputError, match=said):
        Change(**values)


def test_a_box_is_rounded_cut_at_the_borders_and_must_hold_something() -> None:
    picture = small_worlds.place(4)
    np.testing.assert_array_equal(images.crop(picture, (10.4, 20.6, 300, 50)), picture[21:50, 10:])
    np.testing.assert_array_equal(images.crop(picture, (-5, -5, 3, 4)), picture[:4, :3])
    for box in ((5.0, 5.0, 5.0, 9.0), (-9.0, 0.0, -2.0, 5.0), (200.0, 0.0, 300.0, 5.0)):
        with pytest.raises(PictureError, match="no pixel of query 7"):
            images.crop(picture, box, "query 7")


def test_a_panorama_is_turned_by_moving_its_columns_around(tmp_path: Path) -> None:
    dataset = open_dataset(small_worlds.make_cvusa(tmp_path / "pairs", 3))
    street, tile = dataset.queries("street")[0], dataset.gallery("satellite")[0]
    assert (street.panorama, tile.panorama) == (True, False)
    picture = images.load_picture(street.path)
    quarter = Change(rotate=90).for_picture(street)
    turned = quarter.apply(picture)
    # The east, three quarters across, is now the north, in the middle; no corner is black.
    width = picture.shape[1]
    np.testing.assert_array_equal(turned[:, width // 2], picture[:, 3 * width // 4])
    np.testing.assert_array_equal(Change(rotate=-90).for_picture(street).apply(turned), picture)
    assert quarter.describe() == "turned 90° (columns moved around)"
    assert Change(rotate=90).for_picture(tile) == Change(rotate=90)
    assert Change().for_picture(street) == Change()
