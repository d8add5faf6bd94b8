"""The procedural world: its plan, its cameras, and, where the package bpy is there, its pictures."""

from __future__ import annotations

import csv
import hashlib
import importlib.util
import itertools
import json
from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lpn.core.errors import InputError, OutputError
from lpn.core.formats import WORLD
from lpn.datasets import Picture, open_dataset
from lpn.datasets.geo import Position, Positions, camera, metres
from tools.world import cameras, photo
from tools.world.atlas import SIGHT, Atlas, Settings, make_atlas
from tools.world.build import build_world
from tools.world.canvas import Canvas
from tools.world.city import City
from tools.world.geometry import overlap, rectangle, within
from tools.world.jobs import check_folder
from tools.world.plan import SPACING, plan_city

SETTINGS = Settings(seed=5, buildings=24, views=4, pixels=48, tile_pixels=64, samples=1)

rendering = pytest.mark.skipif(
    importlib.util.find_spec("bpy") is None, reason="needs Blender: pip install -e . 'bpy>=5.0,<5.1'"
)


@pytest.fixture(scope="module")
def atlas() -> Atlas:
    return make_atlas(SETTINGS)


@pytest.fixture(scope="module")
def city(atlas: Atlas) -> City:
    return atlas.city


@pytest.mark.slow
def test_a_seed_plans_one_world_of_the_size_asked_for(atlas: Atlas) -> None:
    again = make_atlas(SETTINGS)
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


def test_buildings_stand_in_a_block_of_their_district(city: City) -> None:
    blocks = defaultdict(list)
    for block in city.blocks:
        blocks[block.district].append((block.polygon.mean(axis=0), block.polygon))
    for building in city.buildings:
        here = np.array([building.x, building.y])
        nearest = sorted(blocks[building.district], key=lambda block: float(np.abs(block[0] - here).sum()))
        ring = city.footprint(building)
        assert any(within(ring, polygon, -0.01).all() for _, polygon in nearest)


def test_targets_lie_apart_in_a_district_of_their_split(city: City) -> None:
    assert [target.number for target in city.targets] == list(range(1, 25))
    assert Counter(target.split for target in city.targets) == {"train": 16, "test": 8}
    buildings = [city.buildings[target.building] for target in city.targets]
    assert [city.districts[b.district].split for b in buildings] == [target.split for target in city.targets]
    places = np.array([(b.x, b.y) for b in buildings])
    distance = np.linalg.norm(places[:, None] - places[None], axis=-1)
    assert distance[~np.eye(len(places), dtype=bool)].min() >= SPACING


def test_the_river_keeps_the_ground_of_both_splits_apart(city: City) -> None:
    assert city.terrain(city.terrain.river.line) == pytest.approx(city.terrain.river.level)
    half = cameras.TILE / 2 * 1.05 + 5
    middle = city.terrain.river.line
    for target in city.targets:
        b = city.buildings[target.building]
        bank = np.interp([b.y - half, b.y, b.y + half], middle[:, 1], middle[:, 0])
        if target.split == "train":
            assert b.x + half < bank.min()
        else:
            assert b.x - half > bank.max()


def test_twins_share_one_architecture_and_nobody_else_does(city: City) -> None:
    looks = {target.number: city.buildings[target.building].architecture for target in city.targets}
    groups: dict[int, list[int]] = {}
    for target in city.targets:
        groups.setdefault(target.twins, []).append(target.number)
    alone = groups.pop(0, [])
    for members in groups.values():
        assert len(members) > 1
        assert len({looks[number] for number in members}) == 1
        assert not {looks[n] for n in members} & {looks[n] for n in set(looks) - set(members)}
    assert len({looks[number] for number in alone}) == len(alone)
    assert all(a != b for a, b in itertools.combinations([city.architectures[looks[n]] for n in alone], 2))


def off_centre(pose: cameras.Pose, aim: tuple[float, float, float]) -> float:
    """The sine of the angle between a camera's axis and a point."""
    ray = np.array(aim) - (pose.x, pose.y, pose.z)
    return float(np.linalg.norm(np.cross(ray / np.linalg.norm(ray), pose.axes()[2])))


def test_the_spiral_goes_down_in_three_rounds() -> None:
    aim = (0.0, 0.0, 0.0)
    poses = cameras.drone_poses(aim, 55, np.random.default_rng(3))
    assert max(off_centre(pose, aim) for pose in poses) < 1e-9
    heights = [pose.z for pose in poses[:-1]]
    assert heights[0] == cameras.HIGHEST
    assert heights[-1] == pytest.approx(cameras.LOWEST)
    assert heights == sorted(heights, reverse=True)
    turned = np.unwrap(np.radians([pose.heading for pose in poses[:-1]]))
    assert np.degrees(turned[-1] - turned[0]) == pytest.approx(360 * cameras.ROUNDS, abs=15)
    assert poses[-1].tilt == -90


def test_varied_poses_look_at_the_building_and_see_ground_that_is_there(atlas: Atlas) -> None:
    varied = make_atlas(replace(SETTINGS, vary=("poses",)))
    for one, other in zip(varied.shots, atlas.shots, strict=True):
        assert (one.camera == other.camera) == (one.view == "satellite")
    aim = (30.0, -80.0, 12.0)
    poses = cameras.any_drone_poses(aim, 200, SIGHT, np.random.default_rng(1))
    heights, tilts, lenses = np.array([(pose.z - aim[2], -pose.tilt, pose.fov) for pose in poses]).T
    shown = 2 * heights / np.sin(np.radians(tilts)) * np.tan(np.radians(lenses / 2)) / cameras.TILE
    assert 60 <= heights.min() < 80
    assert 300 < heights.max() <= 400
    assert 40 <= tilts.min() < 45
    assert 85 < tilts.max() <= 90
    assert 0.6 <= shown.min() < 0.8
    assert 1.8 < shown.max() <= 2.2
    for pose in poses:
        assert off_centre(pose, aim) < 1e-6
        right, up, forward = pose.axes()
        slope = np.tan(np.radians(pose.fov / 2))
        for across, down in itertools.product((-1, 1), repeat=2):
            ray = forward + slope * (across * right - down * up)
            ground = np.array([pose.x, pose.y]) + ray[:2] * (pose.z - aim[2]) / -ray[2]
            assert np.linalg.norm(ground - aim[:2]) < SIGHT


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


def test_files_say_where_every_picture_was_taken(atlas: Atlas) -> None:
    world = json.loads(atlas.world_json())
    rows = list(csv.reader(atlas.geo_csv().decode().splitlines()))
    assert Counter(shot.target for shot in atlas.shots) == dict.fromkeys(range(1, 25), 5)
    assert rows[0][:5] == ["path", "latitude", "longitude", "altitude", "heading"]
    assert {row[0] for row in rows[1:]} == {picture["path"] for picture in world["pictures"]}
    assert len(rows) - 1 == 16 * 5 + 8 * 5 * 2  # test pictures are query and gallery
    for building in world["buildings"]:
        x, y = atlas.site.metres(building["latitude"], building["longitude"])
        assert (x, y) == pytest.approx((building["x"], building["y"]), abs=0.02)
        assert len(building["footprint"]) >= 4


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
        assert stands is not None
        assert stands[:2] == pytest.approx((picture["x"], picture["y"]), abs=4)  # a sphere for an ellipsoid
        assert stands[2] == pytest.approx(picture["z"], abs=40)


@pytest.mark.slow
def test_cameras_and_sectors_are_those_of_edition_2(atlas: Atlas) -> None:
    numbers = [[*vars(shot.camera).values()] for shot in atlas.shots]
    numbers += [[s.x, s.y, s.reach, s.district, s.number] for s in atlas.sectors]
    found = hashlib.sha256(json.dumps([[round(v, 3) for v in row] for row in numbers]).encode()).hexdigest()
    assert found == "1ffcb4a061318f9b753dea56cab28c065ae79d573e285ad9550f405c87d26d9f"


def test_a_folder_of_other_pictures_is_left_alone(tmp_path: Path, atlas: Atlas) -> None:
    file, plan = tmp_path / "world.json", json.loads(atlas.world_json())
    check_folder(SETTINGS, file, WORLD)
    file.write_bytes(atlas.world_json())
    check_folder(SETTINGS, file, WORLD)
    file.write_text(
        json.dumps({**plan, "settings": {name: plan["settings"][name] for name in plan["settings"] if name != "vary"}})
    )
    check_folder(SETTINGS, file, WORLD)
    others = (
        {"edition": 3},
        {"format": "lpn-world/2"},
        {"settings": {}},
        {"settings": {**plan["settings"], "views": 5}},
    )
    for text in ("[]", "{", *(json.dumps({**plan, **other}) for other in others)):
        file.write_text(text)
        with pytest.raises(OutputError, match=r"made otherwise, by .* delete that folder, or choose another"):
            check_folder(SETTINGS, file, WORLD)


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
