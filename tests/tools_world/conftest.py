"""A planned world, which no test changes."""

from __future__ import annotations

import pytest

from tools.world.atlas import Atlas, Settings, make_atlas
from tools.world.city import City


@pytest.fixture(scope="session")
def atlas() -> Atlas:
    return make_atlas(Settings(seed=5, buildings=24, views=4, pixels=48, tile_pixels=64, samples=1))


@pytest.fixture(scope="session")
def city(atlas: Atlas) -> City:
    return atlas.city
