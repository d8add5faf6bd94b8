"""The procedural world: its plan, its cameras, and, where the package bpy is there, its pictures."""

from __future__ import annotations

import hashlib
import importlib.util
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lpn.core.errors import InputError, OutputError
from lpn.core.formats import WORLD
from lpn.datasets import Picture, open_dataset
from lpn.datasets.geo import Position, Positions, camera, metres
from tools.world import cameras, photo
from tools.world.atlas import Atlas, Settings, make_atlas
from tools.world.build import build_world
from tools.world.canvas import Canvas
from tools.world.city import City
from tools.world.geometry import overlap, rectangle
from tools.world.jobs import check_folder
from tools.world.plan import SPACING, plan_city

rendering = pytest.mark.skipif(
    importlib.util.find_spec("bpy") is None, reason="needs Blender: pip install -e . 'bpy>=5.0,<5.1'"
)


@pytest.mark.slow
def test_a_seed_plans_one_world_of_the_size_asked_for(atlas: Atlas) -> None:
    again = make_atlas(atlas.settings)
    assert (again.world_json(), again.geo_csv()) == (atlas.world_json(), atlas.geo_csv())
    assert np.array_equal(again.city.stalls.chance, atlas.city.stalls.chance)
    assert again.city.architectures == atlas.city.architectures
    large = plan_city(0, 200)
    assert [target.number for target in large.targets] == list(range(1, 201))
    assert sum(target.twins > 0 for target in large.targets) >= 67
    with pytest.raises(InputError, match="2 buildings"):
        plan_city(0, 1)


def test_buildings_do_not_overlap(city: City) -> None:
    sizes = [city.architectures[b.architecture].size for b in city.buildings]
    boxes = [rectangle(b.x, b.y, *size, b.angle) for b, size in zip(city.buildings, sizes, strict=True)]
    middles = np.array([[b.x, b.y] for b in city.buildings])
    reach = np.hypot(*np.array(sizes).T) / 2
    near = np.linalg.norm(middles[:, None] - middles, axis=-1) <= reach[:, None] + reach
    pairs = np.argwhere(np.triu(near, 1))
    assert len(pairs) > len(boxes) / 2
    for i, j in pairs:
        assert not overlap(boxes[i], boxes[j]), (i, j)


def test_targets_lie_apart_in_a_district_of_their_split(city: City) -> None:
    assert [target.number for target in city.targets] == list(range(1, 25))
    assert Counter(target.split for target in city.targets) == {"train": 16, "test": 8}
    buildings = [city.buildings[target.building] for target in city.targets]
    assert [city.districts[b.district].split for b in buildings] == [target.split for target in city.targets]
    places = np.array([(b.x, b.y) for b in buildings])
    distance = np.linalg.norm(places[:, None] - places[None], axis=-1)
    assert distance[~np.eye(len(places), dtype=bool)].min() >= SPACING


def test_cameras_of_a_varied_world_differ() -> None:
    day = photo.drone_look(1, 0)
    light = np.full((32, 32, 3), 0.2, np.float32)
    rng = np.random.default_rng(0)
    pictures = [photo.develop(light, photo.any_camera(day, rng), rng) for _ in range(20)]
    assert np.ptp([picture.mean() for picture in pictures]) > 30
    assert np.ptp([picture.std(axis=(0, 1)).mean() for picture in pictures]) > 2


@pytest.mark.parametrize(("lean", "bearing"), [(0.0, 0.0), (6.0, 0.0), (5.0, 130.0)])
def test_a_tile_is_cut_where_it_lies(lean: float, bearing: float) -> None:
    sweep = cameras.SatelliteImage(10, 20, 3, 400, 800, lean, bearing)
    tile = cameras.Tile(50, -30, 2.0)
    corners = sweep.corners(tile)
    centre = sweep.project(np.array([[tile.x, tile.y, sweep.z]]))[0]
    assert corners.mean(axis=0) == pytest.approx(centre)
    assert corners[0] == pytest.approx(corners[3] - (0, 320), abs=14)  # 160 m up are 320 pixels
    assert corners[0][0] < corners[1][0]
    assert corners[0][1] < corners[3][1]


def test_neighbouring_windows_have_the_same_grain() -> None:
    one, other = Canvas(0, 0, 64, 64, 0.25), Canvas(32, 0, 64, 64, 0.25)
    rows = slice(0, 256)
    assert np.array_equal(one.field(2, rows, slice(128, 256)), other.field(2, rows, slice(0, 128)))


def test_positions_are_those_of_the_buildings_and_poses_those_of_the_cameras(atlas: Atlas, tmp_path: Path) -> None:
    (tmp_path / "geo.csv").write_bytes(atlas.geo_csv())
    world = json.loads(atlas.world_json())
    pictures = [p for p in world["pictures"] if p["path"].startswith("test/query_")]
    found = Positions(tmp_path).of([Picture(tmp_path / p["path"], p["id"], "") for p in pictures])
    origin = Position(world["site"]["latitude"], world["site"]["longitude"])
    buildings = {b["id"]: b for b in world["buildings"]}
    for picture, place in zip(pictures, found, strict=True):
        building = buildings[picture["id"]]
        if picture["view"] == "satellite":
            assert place.width == 160
            continue
        here = Position(building["latitude"], building["longitude"])
        assert metres([place], [here])[0] < 0.1
        stands = camera(place, origin)
        assert stands[:2] == pytest.approx((picture["x"], picture["y"]), abs=4)  # a sphere for an ellipsoid
        assert stands[2] == pytest.approx(picture["z"], abs=40)


@pytest.mark.parametrize(
    ("vary", "digest"),
    [
        ((), "3cec703ddeebd757b7e67050d34dbddf3ff5f5dab564960fa4459a906ea1a498"),
        pytest.param(
            ("poses",), "7d346b4795f6716d3aa71448e35ae610fd443f58e1b935e6fba8518e98ad2435", marks=pytest.mark.slow
        ),
    ],
)
def test_places_cameras_and_sectors_are_those_of_edition_2(
    atlas: Atlas, vary: tuple[cameras.Factor, ...], digest: str
) -> None:
    made = make_atlas(replace(atlas.settings, vary=vary)) if vary else atlas
    sectors = [[round(v, 3) for v in (s.x, s.y, s.reach, s.district, s.number)] for s in made.sectors]
    plan = made.world_json() + made.geo_csv() + json.dumps(sectors).encode()
    assert hashlib.sha256(plan).hexdigest() == digest


def test_a_folder_of_other_pictures_is_left_alone(tmp_path: Path, atlas: Atlas) -> None:
    file, plan = tmp_path / "world.json", json.loads(atlas.world_json())
    check_folder(atlas.settings, file, WORLD)
    file.write_bytes(atlas.world_json())
    check_folder(atlas.settings, file, WORLD)
    plain = {name: value for name, value in plan["settings"].items() if name != "vary"}
    file.write_text(json.dumps({**plan, "settings": plain}))
    check_folder(atlas.settings, file, WORLD)
    settings = [{}, {**plan["settings"], "views": 5}]
    others = ({"edition": 3}, {"format": "lpn-world/2"}, *({"settings": one} for one in settings))
    for text in ("[]", "{", *(json.dumps({**plan, **other}) for other in others)):
        file.write_text(text)
        with pytest.raises(OutputError, match=r"made otherwise, by .* delete that folder, or choose another"):
            check_folder(atlas.settings, file, WORLD)


@pytest.mark.slow
@rendering
def test_a_small_world_is_rendered_and_resumed(tmp_path: Path) -> None:
    small = Settings(seed=2, buildings=2, views=2, pixels=40, tile_pixels=48, samples=1)
    assert build_world(small, tmp_path / "plain") == 6
    assert len(open_dataset(tmp_path / "plain").train("satellite")) == 1
    assert len(open_dataset(tmp_path / "plain").queries("drone")) == 2
    kept = {file: _digest(file) for file in (tmp_path / "plain").rglob("*.jpg")}
    min(kept).unlink()
    assert build_world(small, tmp_path / "plain") == 1
    assert {file: _digest(file) for file in kept} == kept
    for factor, views in (("cameras", {"drone", "satellite"}), ("poses", {"drone"})):
        out = tmp_path / factor
        build_world(replace(small, vary=(factor,)), out)  # type: ignore[arg-type]
        changed = [file for file in kept if _digest(out / file.relative_to(tmp_path / "plain")) != kept[file]]
        assert {file.parts[-3].rpartition("_")[2] for file in changed} == views


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
