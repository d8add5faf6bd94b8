from __future__ import annotations

import numpy as np

from lpn.augment import augment
from lpn.images import Picture
from lpn.recipes import Recipe
from tests import worlds

STILL = Recipe(backbone="resnet18", size=worlds.SIZE, shift=0.0, satellite_rotation=0.0, flip="none")


def changed(recipe: Recipe, seed: int) -> Picture:
    return augment(worlds.place(7), recipe, np.random.default_rng(seed), 0.0, False, satellite=False)


def test_a_recipe_without_changes_leaves_the_picture_alone() -> None:
    np.testing.assert_array_equal(changed(STILL, 1), worlds.place(7))


def test_compression_leaves_its_traces_as_often_as_it_is_told() -> None:
    always = Recipe(**{**STILL.__dict__, "compression": 1.0})
    errors = [np.abs(changed(always, seed).astype(int) - worlds.place(7)).mean() for seed in range(12)]
    assert 0.1 < min(errors) < max(errors) < 25
    assert max(errors) > 1.2 * min(errors)  # qualities differ
    often = Recipe(**{**STILL.__dict__, "compression": 0.5})
    touched = sum(not np.array_equal(changed(often, seed), worlds.place(7)) for seed in range(40))
    assert 8 < touched < 32
