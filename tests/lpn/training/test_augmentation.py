from __future__ import annotations

import numpy as np
import pytest

from lpn.core import images
from lpn.core.views import View
from lpn.training.augmentation import augment
from lpn.training.recipe import Recipe
from tools.fixtures import small_worlds

STILL = Recipe(
    backbone="resnet18", size=small_worlds.SIZE, padding=0, flip="none", interpolation="cubic", satellite_rotation=0.0
)


def test_a_recipe_without_changes_leaves_the_picture_alone() -> None:
    same = augment(small_worlds.place(7), STILL, np.random.default_rng(1), 0.0, False, "drone")
    np.testing.assert_array_equal(same, small_worlds.place(7))


@pytest.mark.parametrize("view", ["drone", "street", "satellite"])
@pytest.mark.parametrize("name", ["season", "bands", "shadows", "occlusion", "blur", "noise", "compression", "weather"])
def test_all_views_of_a_place_are_seen_on_other_days_as_often_as_it_is_told(name: str, view: View) -> None:
    def touched(value: float) -> int:
        recipe = Recipe(**{**STILL.__dict__, name: value})
        place = small_worlds.place(7)
        made = (augment(place, recipe, np.random.default_rng(seed), 0.0, False, view) for seed in range(30))
        return sum(not np.array_equal(picture, place) for picture in made)

    if name == "noise":
        assert touched(12.0) == 30
    elif name == "weather" and view == "satellite":
        assert touched(1.0) == 0
    else:
        assert touched(1.0) > 25 > touched(0.5) > 4


@pytest.mark.parametrize("side", [64, 256])
@pytest.mark.parametrize(("ratio", "view", "other"), [(2.0, "drone", "satellite"), (0.5, "satellite", "drone")])
def test_pictures_that_show_more_ground_are_zoomed_to_the_ground_of_the_others(
    ratio: float, view: View, other: View, side: int
) -> None:
    picture = images.resize(small_worlds.place(7), side, side)
    recipe = Recipe(**{**STILL.__dict__, "size": 64, "ground_ratio": ratio})
    made = {one: augment(picture, recipe, np.random.default_rng(0), 0.0, False, one) for one in (view, other)}
    np.testing.assert_array_equal(made[other], images.resize(picture, 64, 64))
    # A test cuts the same ground out before it resizes, so only the interpolation differs.
    middle = images.resize(images.zoom(picture, 2.0), 64, 64).astype(int)
    assert np.abs(made[view] - middle).mean() < 3 < np.abs(made[other] - middle).mean()


@pytest.mark.parametrize("panorama", [True, False])
def test_a_padded_picture_is_cropped_at_whole_pixels_in_panoramas_too(panorama: bool) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (48, 96, 3), np.uint8)
    recipe = Recipe(**{**STILL.__dict__, "size": 48, "width": 96, "padding": 5})
    padded = np.pad(picture, ((5, 5), (5, 5), (0, 0)), mode="edge")
    windows = {padded[y : y + 48, x : x + 96].tobytes(): (y, x) for y in range(11) for x in range(11)}
    rng = np.random.default_rng(1)
    found = [augment(picture, recipe, rng, 0.0, False, "street", panorama) for _ in range(200)]
    places = [windows[crop.tobytes()] for crop in found]
    assert {y for y, _ in places} == {x for _, x in places} == set(range(11))


def test_a_turned_place_is_turned_alike_in_its_tile_and_its_panorama() -> None:
    still = Recipe(**{**STILL.__dict__, "size": 48, "width": 192, "polar": True, "black_corners": 0.0})
    tile = images.resize(small_worlds.place(7), 384, 384)
    panorama = images.polar(tile, 48, 192)
    rng = np.random.default_rng(0)

    def difference(angle: float, mirror: bool, other_angle: float, other_mirror: bool) -> float:
        unrolled = augment(tile, still, rng, angle, mirror, "satellite")
        rolled = augment(panorama, still, rng, other_angle, other_mirror, "street", panorama=True)
        return float(np.abs(unrolled.astype(int) - rolled)[4:].mean())

    for angle, mirror in ((0, False), (90, False), (45, False), (0, True), (30, True)):
        assert difference(angle, mirror, angle, mirror) < 8  # a mirrored polar picture is one column off
    assert difference(90, False, -90, False) > 12
    assert difference(0, True, 0, False) > 12
