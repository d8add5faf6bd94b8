"""city.glb as the world writes it: where its ground, buildings, and trees lie."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from lpn.core.errors import InputError
from lpn.datasets.city_model import MAX_BYTES, NAME, city_model
from lpn.datasets.geo import Position
from tools.fixtures.glb_parts import Points, header, parts
from tools.world import model3d
from tools.world.atlas import Atlas, Settings, make_atlas
from tools.world.cameras import Site
from tools.world.city import City, Window
from tools.world.geometry import turned, within
from tools.world.glb import Primitive, glb


@pytest.fixture(scope="module")
def atlas() -> Atlas:
    return make_atlas(Settings(seed=5, buildings=24, views=4, pixels=48, tile_pixels=64, samples=1))


@pytest.fixture(scope="module")
def city(atlas: Atlas) -> City:
    return atlas.city


@pytest.fixture(scope="module")
def window(city: City) -> Window:
    """Around the first building for testing."""
    x, y = next((b.x, b.y) for b in (city.buildings[t.building] for t in city.targets if t.split == "test"))
    return x - 180, y - 200, x + 200, y + 180


@pytest.fixture(scope="module")
def data(atlas: Atlas, window: Window) -> bytes:
    return model3d.city_model(atlas.city, atlas.site, window)


@pytest.mark.slow
def test_the_model_is_small_whole_and_says_where_it_stands(atlas: Atlas, data: bytes, tmp_path: Path) -> None:
    assert 100_000 < len(data) <= MAX_BYTES
    (tmp_path / NAME).write_bytes(data)
    read = city_model(tmp_path)
    assert read is not None
    assert read.data == data
    assert read.origin == Position(atlas.site.latitude, atlas.site.longitude)


def test_buildings_stand_where_and_as_high_as_they_were_planned(city: City, window: Window, data: bytes) -> None:
    built = np.concatenate([places for name, places in parts(data).items() if name.startswith(("walls", "plain"))])
    west, south, east, north = window
    tested = 0
    for b in city.buildings:
        look = city.architectures[b.architecture]
        if not (west + 60 < b.x < east - 60 and south + 60 < b.y < north - 60) or max(look.size) < 25:
            continue
        tested += 1
        for part in look.parts:
            for corner in turned(np.array(part.outline), b.angle) + np.array([b.x, b.y]):
                assert np.linalg.norm(built[:, :2] - corner, axis=1).min() < 0.1
        inside = built[within(built[:, :2], _box(city.footprint(b)), -0.5)]
        top = city.height(b.x, b.y) + look.height
        assert np.abs(inside[:, 2] - top).min() < 0.1
        assert top - 0.1 < inside[:, 2].max() < top + 6  # items on the roof
    assert tested >= 3


def _box(ring: Points) -> Points:
    (west, south), (east, north) = ring.min(axis=0), ring.max(axis=0)
    return np.array([(west, south), (east, south), (east, north), (west, north)])


def test_the_ground_lies_at_its_height_and_fills_the_window(city: City, window: Window, data: bytes) -> None:
    ground = parts(data)["ground"]
    np.testing.assert_allclose(ground[:, 2], city.terrain(ground[:, :2]), atol=0.1)
    west, south, east, north = window
    np.testing.assert_allclose(ground[:, :2].min(axis=0), (west, south), atol=0.1)
    np.testing.assert_allclose(ground[:, :2].max(axis=0), (east, north), atol=0.1)


def test_what_the_explorer_s_map_covers_is_every_test_tile_and_no_other(atlas: Atlas) -> None:
    west, south, east, north = model3d.test_window(atlas)
    for target in atlas.city.targets:
        b = atlas.city.buildings[target.building]
        inside = west + 80 < b.x < east - 80 and south + 80 < b.y < north - 80
        assert inside == (target.split == "test")


def test_trees_have_roots_in_the_ground_and_their_height(city: City, window: Window, data: bytes) -> None:
    crowns = parts(data)["trees"].reshape(-1, 6, 3)  # lowest point, four around, top
    west, south, east, north = window
    trees = city.trees
    inside = (trees.x > west) & (trees.x < east) & (trees.y > south) & (trees.y < north)
    assert len(crowns) == inside.sum()
    places = np.stack([trees.x, trees.y], axis=1)[inside]
    np.testing.assert_allclose(crowns[:, 5, :2], places, atol=0.1)
    np.testing.assert_allclose(crowns[:, 5, 2], city.terrain(places) + trees.height[inside], atol=0.1)


def test_the_ground_is_painted_north_up_and_light_enough_to_see(city: City) -> None:
    river = city.terrain.river
    x, y = river.line[len(river.line) // 2].tolist()
    data = model3d.city_model(city, Site(), (x - 20, y - 60, x + 180, y + 60))
    scene = trimesh.load(io.BytesIO(data), file_type="glb")
    picture = np.asarray(scene.geometry["ground"].visual.material.baseColorTexture.convert("RGB")).astype(int)
    height, width = picture.shape[:2]
    assert width / height == pytest.approx(200 / 120, rel=0.02)
    water, land = picture[:, : width // 12].mean(axis=(0, 1)), picture[:, -width // 4 :].mean(axis=(0, 1))
    assert water[2] - water[0] > land[2] - land[0] + 10
    assert 70 < picture.mean() < 170
    assert {name for m in header(data)["materials"] for name in m["extensions"]} == {"KHR_materials_unlit"}


@pytest.mark.slow
def test_less_room_is_less_detail_and_too_little_is_said(atlas: Atlas, window: Window, data: bytes) -> None:
    limit = len(data) // 2
    smaller = model3d.city_model(atlas.city, atlas.site, window, limit)
    assert 0.6 * limit < len(smaller) <= limit
    assert sum(map(len, parts(smaller).values())) < sum(map(len, parts(data).values()))
    with pytest.raises(InputError, match=r"does not fit into 0\.0 MB"):
        model3d.city_model(atlas.city, atlas.site, window, 20_000)


def test_triangles_come_back_as_they_were_written() -> None:
    rng = np.random.default_rng(1)
    vertices = rng.uniform(-900, 700, (40, 3))
    colours = rng.integers(0, 256, (40, 3)).astype(np.uint8)
    one = Primitive("one", vertices, rng.integers(0, 40, (25, 3)), colours)
    other = replace(one, name="other", vertices=vertices + np.array([10, 20, 30]))
    scene = trimesh.load(io.BytesIO(glb([one, other], {})), file_type="glb", process=False)
    np.testing.assert_array_equal(scene.geometry["one"].faces, one.faces)
    np.testing.assert_array_equal(scene.geometry["one"].visual.vertex_attributes["color"][:, :3], colours)
    back = parts(glb([one, other], {}))
    np.testing.assert_allclose(back["other"], vertices + np.array([10, 20, 30]), atol=0.02)
