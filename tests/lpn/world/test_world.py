"""The procedural world: its plan, its cameras, and, where the package bpy is there, its pictures."""

from __future__ import annotations

import csv
import functools
import hashlib
import importlib.util
import itertools
import json
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from lpn.cli import main
from lpn.core.errors import InputError, OutputError
from lpn.datasets import Picture, open_dataset
from lpn.datasets.geo import Position, Positions, camera, metres
from lpn.world import atlas as atlases
from lpn.world import cameras, meshes, paint, photo
from lpn.world.atlas import SIGHT, Atlas, Settings, make_atlas
from lpn.world.build import RenderShare, Tally, build_world, check_folder
from lpn.world.canvas import Canvas
from lpn.world.city import City
from lpn.world.factors import FACTORS
from lpn.world.geometry import area, overlap, rectangle, segment_distance, within
from lpn.world.ground_level import GroundLevel
from lpn.world.plan import _BLOCKS, SPACING, _Style
from lpn.world.plan import plan_city as plan_city_anew
from lpn.world.surroundings import Obstacles
from lpn.world.variety import Materials, unbuilt

SETTINGS = Settings(seed=5, buildings=24, views=4, pixels=48, tile_pixels=64, samples=1)
WALKED = replace(SETTINGS, streets=3, panoramas=2)

rendering = pytest.mark.skipif(
    importlib.util.find_spec("bpy") is None, reason="needs Blender: pip install 'lpn-explorer[world]'"
)


# A plan takes seconds; the same seed plans the same world, which a test of its own checks without this cache.
plan_city = functools.cache(plan_city_anew)


@pytest.fixture(scope="module", autouse=True)
def _planned_once() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(atlases, "plan_city", plan_city)
        yield
    plan_city.cache_clear()


@pytest.fixture(scope="module")
def atlas() -> Atlas:
    return make_atlas(SETTINGS)


@pytest.fixture(scope="module")
def walked() -> Atlas:
    """The same world with pictures from the ground."""
    return make_atlas(WALKED)


@pytest.fixture(scope="module")
def city(atlas: Atlas) -> City:
    return atlas.city


@pytest.mark.parametrize(("seed", "buildings"), [(1, 24), pytest.param(2, 30, marks=pytest.mark.slow)])
def test_any_seed_gives_a_city_of_the_size_asked_for(seed: int, buildings: int) -> None:
    targets = plan_city(seed, buildings).targets
    assert [target.number for target in targets] == list(range(1, buildings + 1))
    assert {target.split for target in targets} == {"train", "test"}


@pytest.mark.slow
def test_the_same_seed_plans_the_same_world(atlas: Atlas, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(atlases, "plan_city", plan_city_anew)
    again = make_atlas(SETTINGS)
    assert again.city is not atlas.city
    assert again.world_json() == atlas.world_json()
    assert again.geo_csv() == atlas.geo_csv()
    assert np.array_equal(again.city.trees.x, atlas.city.trees.x)
    assert np.array_equal(again.city.stalls.chance, atlas.city.stalls.chance)
    assert again.city.architectures == atlas.city.architectures


def test_another_seed_plans_another_world(city: City) -> None:
    assert plan_city(1, 24).buildings != city.buildings


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


def test_every_target_has_its_id_and_lies_in_a_district_of_its_split(city: City) -> None:
    assert [target.number for target in city.targets] == list(range(1, 25))
    for target in city.targets:
        assert city.districts[city.buildings[target.building].district].split == target.split
    assert Counter(target.split for target in city.targets) == {"train": 16, "test": 8}


def test_the_river_keeps_the_ground_of_both_splits_apart(city: City) -> None:
    half = cameras.TILE / 2 * 1.05 + 5
    middle = city.terrain.river.line
    for target in city.targets:
        b = city.buildings[target.building]
        bank = np.interp([b.y - half, b.y, b.y + half], middle[:, 1], middle[:, 0])
        if target.split == "train":
            assert b.x + half < bank.min()
        else:
            assert b.x - half > bank.max()


def test_targets_keep_their_distance(city: City) -> None:
    places = np.array([[city.buildings[t.building].x, city.buildings[t.building].y] for t in city.targets])
    distance = np.linalg.norm(places[:, None] - places[None], axis=-1)
    assert distance[~np.eye(len(places), dtype=bool)].min() >= SPACING


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


@pytest.mark.slow
def test_a_large_world_has_the_size_asked_for_and_twins_of_a_third_of_its_targets() -> None:
    large = plan_city(0, 200)
    assert [target.number for target in large.targets] == list(range(1, 201))
    assert {target.split for target in large.targets} == {"train", "test"}
    assert sum(target.twins > 0 for target in large.targets) >= 67
    splits: dict[int, set[str]] = {}
    for target in large.targets:
        splits.setdefault(target.twins, set()).add(target.split)
    assert all(len(found) == 1 for group, found in splits.items() if group)


def test_footprints_have_their_buildings_area(city: City) -> None:
    for target in city.targets:
        look = city.architectures[city.buildings[target.building].architecture]
        assert area(look.ring) == pytest.approx(area(city.footprint(city.buildings[target.building])))
        assert area(look.ring) > 200


def test_the_ground_is_level_on_the_river(city: City) -> None:
    river = city.terrain.river
    assert city.terrain(river.line) == pytest.approx(river.level)
    land = city.terrain(np.array([[river.line[0, 0] - 500, 0.0], [river.line[0, 0] + 400, 30.0]]))
    assert (land > river.level + 1).all()


def test_a_plan_needs_two_buildings() -> None:
    with pytest.raises(InputError, match="2 buildings"):
        plan_city(0, 1)


def test_latitude_and_longitude_go_both_ways() -> None:
    site = cameras.Site()
    for x, y in ((0, 0), (1234.5, -987.6), (-3000, 2500)):
        assert site.metres(*site.degrees(x, y)) == pytest.approx((x, y), abs=1e-6)
    north, east = site.degrees(0, 1000), site.degrees(1000, 0)
    assert north[0] > site.latitude
    assert east[1] > site.longitude
    assert (north[0] - site.latitude) * 111.2 == pytest.approx(1, rel=0.01)


def test_every_drone_picture_has_its_building_at_the_centre() -> None:
    aim = (120.0, -40.0, 9.0)
    poses = cameras.drone_poses(aim, 12, np.random.default_rng(0))
    assert len(poses) == 12
    for pose in poses:
        assert pose.project(np.array([aim])) == pytest.approx(np.zeros((1, 2)), abs=1e-9)


def test_the_spiral_goes_down_in_three_rounds() -> None:
    poses = cameras.drone_poses((0.0, 0.0, 0.0), 55, np.random.default_rng(3))
    heights = [pose.z for pose in poses[:-1]]
    assert heights[0] == cameras.HIGHEST
    assert heights[-1] == pytest.approx(cameras.LOWEST)
    assert heights == sorted(heights, reverse=True)
    turned = np.unwrap(np.radians([pose.heading for pose in poses[:-1]]))
    assert np.degrees(turned[-1] - turned[0]) == pytest.approx(360 * cameras.ROUNDS, abs=15)
    assert poses[-1].tilt == -90


def test_poses_of_a_varied_world_look_at_the_building_from_anywhere_and_see_no_ground_that_is_not_there() -> None:
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
        assert np.allclose(pose.project(np.array([aim])), 0, atol=1e-6)
        right, up, forward = pose.axes()
        slope = np.tan(np.radians(pose.fov / 2))
        for across, down in itertools.product((-1, 1), repeat=2):
            ray = forward + slope * (across * right - down * up)
            ground = np.array([pose.x, pose.y]) + ray[:2] * (pose.z - aim[2]) / -ray[2]
            assert np.linalg.norm(ground - aim[:2]) < SIGHT
    assert poses == cameras.any_drone_poses(aim, 200, SIGHT, np.random.default_rng(1))


def test_a_world_of_varied_poses_has_the_same_plan_and_tiles(atlas: Atlas) -> None:
    varied = make_atlas(replace(SETTINGS, vary=("days", "cameras", "poses", "materials", "snow")))
    assert varied.city.buildings == atlas.city.buildings
    assert [shot.paths for shot in varied.shots] == [shot.paths for shot in atlas.shots]
    for one, other in zip(varied.shots, atlas.shots, strict=True):
        assert (one.camera == other.camera) == (one.view == "satellite")
    assert varied.geo_csv() != atlas.geo_csv()


def test_days_and_cameras_of_a_varied_world_differ() -> None:
    days = [photo.drone_look(1, district, ["days"]) for district in range(40)]
    assert len({day.season.leaves for day in days}) == 6
    assert min(day.sun[0] for day in days) < 30 < 60 < max(day.sun[0] for day in days)
    assert len({day.sun for day in days}) == 40
    assert photo.satellite_look(1, 3, ["days"]) != photo.drone_look(1, 3, ["days"])
    assert photo.drone_look(1, 3, ["days"]) == days[3]
    light = np.full((32, 32, 3), 0.2, np.float32)
    rng = np.random.default_rng(0)
    pictures = [photo.develop(light, photo.any_camera(days[0], rng), rng) for _ in range(20)]
    assert np.ptp([picture.mean() for picture in pictures]) > 30
    assert np.ptp([picture.std(axis=(0, 1)).mean() for picture in pictures]) > 2


def _of_factors(look: photo.Look) -> dict[str, Any]:
    """Return the properties of a day that each factor draws."""
    season = look.season
    return {
        "days": (look.sun, season.grass, season.dry, season.dryness),
        "materials": (look.materials, season.pavement),
        "traffic": look.cars,
        "construction": look.unbuilt,
        "snow": season.snow,
    }


def test_each_factor_changes_its_own_properties_of_a_day_and_neither_others_nor_the_camera() -> None:
    district = next(i for i in range(40) if photo.satellite_look(1, i, ["snow"]).season.snow)
    plain = photo.satellite_look(1, district)
    of_plain = _of_factors(plain)
    for factor in of_plain:
        varied = photo.satellite_look(1, district, [factor])
        found = _of_factors(varied)
        assert {name for name in found if found[name] != of_plain[name]} == {factor}
        camera = ("exposure", "balance", "contrast", "saturation", "haze", "blur", "noise", "traffic")
        assert all(getattr(varied, name) == getattr(plain, name) for name in camera)
        for other in FACTORS:
            assert _of_factors(photo.satellite_look(1, district, [factor, other]))[factor] == found[factor]
    assert photo.satellite_look(1, 3, ["cameras", "poses", "plan"]) == photo.satellite_look(1, 3)
    assert photo.drone_look(1, 3, ["construction"]) == photo.drone_look(1, 3)
    cars = [photo.drone_look(1, district, ["traffic"]).cars for district in range(40)]
    assert min(cars) < 0.2
    assert max(cars) > 1.8
    snow = [photo.drone_look(1, district, ["snow"]).season.snow for district in range(100)]
    assert 20 < np.count_nonzero(snow) < 55
    pavements = {
        look(1, 3, FACTORS).season.pavement for look in (photo.drone_look, photo.satellite_look, photo.street_look)
    }
    assert pavements == {Materials.draw(1, 3).pavement}
    assert _of_factors(photo.street_look(1, 3, FACTORS))["days"] == _of_factors(photo.street_look(1, 3))["days"]


def test_no_building_that_is_photographed_is_under_construction(city: City) -> None:
    missing = unbuilt(city, 0.5)
    photographed = {target.building for target in city.targets}
    assert 0.35 * len(city.buildings) < len(missing) < 0.6 * len(city.buildings)
    assert not missing & photographed
    assert set() == unbuilt(city, 0.0) < unbuilt(city, 0.1) < missing


def test_materials_change_the_colours_of_a_building_and_not_its_shape(city: City) -> None:
    one, other = Materials.draw(1, 3), Materials.draw(1, 4)
    tints = set()
    for number, architecture in enumerate(city.architectures):
        dressed = one.dress(architecture, number)
        assert dressed == one.dress(architecture, number)
        assert dressed.outline == architecture.outline
        for part, before in zip(dressed.parts, architecture.parts, strict=True):
            tints.add(part.cover_tint)
            assert (part.outline, part.eaves, part.roof) == (before.outline, before.eaves, before.roof)
            kept = {"tiles": one.tiles, "seams": one.flat, "seats": [before.cover_tint]}
            assert part.cover == before.cover or before.cover not in kept
            assert part.cover_tint in kept.get(before.cover, one.flat)
    assert len(tints) >= 7
    assert one.dress(city.architectures[0], 0) != other.dress(city.architectures[0], 0)


def test_snow_lies_on_roofs_and_ground_and_neither_on_streets_nor_on_water(city: City) -> None:
    season = photo.DRONE.season
    bank = city.terrain.river.line[len(city.terrain.river.line) // 2]
    west, north = bank[0] - 180, bank[1] + 120
    bare, _ = paint.ground(city, west, north, 240, 1.0, season)
    some, _ = paint.ground(city, west, north, 240, 1.0, replace(season, snow=0.4))
    full, water = paint.ground(city, west, north, 240, 1.0, replace(season, snow=1.0))
    white = (full.min(axis=-1) > 0.6).mean()
    assert white > 0.4
    assert 0 < (some.min(axis=-1) > 0.6).mean() < white
    assert (bare.min(axis=-1) > 0.6).mean() < 0.05
    assert (water == 1).mean() > 0.1
    assert np.array_equal(full[water == 1], bare[water == 1])
    cleared = 0
    for street in city.streets:
        at = ((street.line[len(street.line) // 2] - (west, north)) * (1, -1)).astype(int)
        if (at >= 0).all() and (at < 240).all():
            cleared += 1
            assert np.array_equal(full[at[1], at[0]], bare[at[1], at[0]])
    assert cleared > 0
    # Whatever faces up is white on a building, with what stands on its roof, but glass is not.
    made = [meshes.building(architecture) for architecture in city.architectures]
    shape = next(mesh for mesh in made if {"plain", "glass"} < set(mesh.materials))
    before = list(shape.tints)
    meshes.whiten(shape, 1.0, paint.SNOW)
    white_ones = {i for i, tint in enumerate(shape.tints) if tint == pytest.approx(paint.SNOW)}
    assert {"plain"} < {shape.materials[i] for i in white_ones}
    for i, (material, tint, was) in enumerate(zip(shape.materials, shape.tints, before, strict=True)):
        assert material.startswith("roof") <= (i in white_ones)
        assert i in white_ones or tint == was
        assert i not in white_ones or material.startswith(("roof", "plain"))


def test_pavements_of_a_district_have_its_colour(city: City) -> None:
    season = photo.DRONE.season
    west, north = city.buildings[city.targets[0].building].x - 120, city.buildings[city.targets[0].building].y + 120
    bare, _ = paint.ground(city, west, north, 240, 1.0, season)
    red, _ = paint.ground(city, west, north, 240, 1.0, replace(season, pavement=(1.5, 1.0, 1.0)))
    ratio = red / bare
    assert ratio[..., 0].max() == pytest.approx(1.5, rel=0.05)
    assert np.median(ratio[..., 1]) == pytest.approx(1, abs=1e-6)


@pytest.mark.slow
def test_a_city_of_a_varied_plan_has_its_own_streets_and_sizes_of_blocks(city: City) -> None:
    varied = plan_city(SETTINGS.seed, SETTINGS.buildings, True)
    assert len(varied.targets) == SETTINGS.buildings
    assert _Style.draw(SETTINGS.seed) == _Style.draw(SETTINGS.seed) != _Style()
    sizes = [[area(block.polygon) for block in plan.blocks] for plan in (city, varied)]
    assert min(sizes[1]) > 0
    assert np.median(sizes[1]) != pytest.approx(np.median(sizes[0]), rel=0.02)
    style = _Style.draw(SETTINGS.seed)
    lengths = [style.blocks("housing", 1, column, 0)[0] / _BLOCKS["housing"][0] for column in range(60)]
    assert 1 / 1.4 <= min(lengths) < 0.8
    assert 1.25 < max(lengths) <= 1.4
    assert _Style().blocks("housing", 1, 3, 0) == _BLOCKS["housing"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 9))
def test_cities_of_varied_plans_hold_what_is_asked_for(seed: int) -> None:
    varied = plan_city(seed, 60, varied=True)
    assert len(varied.targets) == 60
    assert all(area(block.polygon) > 0 for block in varied.blocks)


def test_what_lies_ahead_of_the_drone_is_higher_in_the_picture() -> None:
    pose = cameras.Pose(0, 0, 100, 90, -50, 41)  # looks east
    ahead, right = pose.project(np.array([[100.0, 0, 0], [84.0, -20, 0]]))
    assert ahead[1] < 0
    assert right[0] > 0


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


def test_a_tile_misses_its_building_a_little() -> None:
    tiles = [cameras.tile_around(0, 0, np.random.default_rng(i)) for i in range(50)]
    off = [float(np.hypot(tile.x, tile.y)) for tile in tiles]
    assert 0 < max(off) < 7.1
    assert max(abs(tile.heading) for tile in tiles) <= 2.5


def test_neighbouring_windows_have_the_same_grain() -> None:
    one, other = Canvas(0, 0, 64, 64, 0.25), Canvas(32, 0, 64, 64, 0.25)
    rows = slice(0, 256)
    assert np.array_equal(one.field(2, rows, slice(128, 256)), other.field(2, rows, slice(0, 128)))


def test_files_say_where_every_picture_was_taken(atlas: Atlas) -> None:
    world = json.loads(atlas.world_json())
    rows = list(csv.reader(atlas.geo_csv().decode().splitlines()))
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


def test_every_picture_belongs_to_one_sector(atlas: Atlas) -> None:
    shots = atlas.shots
    assert len({path for shot in shots for path in shot.paths}) == sum(len(shot.paths) for shot in shots)
    assert Counter(shot.target for shot in shots) == dict.fromkeys(range(1, 25), 5)


def _cameras(atlas: Atlas, view: str) -> list[tuple[int, Any]]:
    return [(shot.target, shot.camera) for shot in atlas.shots if shot.view == view]


@pytest.mark.slow
def test_pictures_from_the_ground_leave_all_others_as_they_were(atlas: Atlas, walked: Atlas) -> None:
    others = [shot for shot in walked.shots if shot.view == "drone" or shot.paths[0].startswith(("train/s", "test/"))]
    assert [shot for shot in others if shot.view != "street"] == atlas.shots
    # Cameras and sectors, as main's edition 2 planned them.
    numbers = [[*vars(shot.camera).values()] for shot in atlas.shots]
    numbers += [[s.x, s.y, s.reach, s.district, s.number] for s in atlas.sectors]
    found = hashlib.sha256(json.dumps([[round(v, 3) for v in row] for row in numbers]).encode()).hexdigest()
    assert found == "1ffcb4a061318f9b753dea56cab28c065ae79d573e285ad9550f405c87d26d9f"


@pytest.mark.slow
def test_more_pictures_from_the_ground_keep_those_there_are(walked: Atlas) -> None:
    more = {shot.paths: shot for shot in make_atlas(replace(SETTINGS, streets=5, panoramas=3)).shots}
    assert {shot.paths for shot in walked.shots} < set(more)
    assert all(more[shot.paths] == shot for shot in walked.shots)


def test_people_stand_in_the_open(walked: Atlas) -> None:
    city = walked.city
    rings = [city.footprint(building).astype(np.float32) for building in city.buildings]
    pools = [p.polygon.astype(np.float32) for p in city.patches if p.surface in ("water", "pool")]
    trees = np.stack([city.trees.x, city.trees.y], axis=1)
    taken = [pose for view in ("street", "panorama") for _, pose in _cameras(walked, view)]
    assert len(taken) == 24 * (3 + 2)
    for pose in taken:
        here = (pose.x, pose.y)
        assert min(-cv2.pointPolygonTest(ring, here, True) for ring in rings) > 1
        assert all(cv2.pointPolygonTest(ring, here, False) < 0 for ring in pools)
        assert city.terrain.bank(np.array(here)) > 3
        assert 1.7 <= pose.z - city.height(*here) <= 2.5
        assert np.linalg.norm(trees - here, axis=1).min() > 0.5
        for a, b in city.hedges:
            if np.abs((a + b) / 2 - here).max() < 60:
                assert segment_distance(np.array([here]), a, b)[0] > 1


def test_a_street_picture_looks_at_its_building(walked: Atlas) -> None:
    targets = {target.number: target for target in walked.city.targets}
    for number, pose in _cameras(walked, "street"):
        building = walked.city.buildings[targets[number].building]
        ring = walked.city.footprint(building).astype(np.float32)
        assert 9 <= -cv2.pointPolygonTest(ring, (pose.x, pose.y), True) <= 45.1
        ahead = np.radians(pose.heading)
        way = np.arange(9, 150)[:, None] * (np.sin(ahead), np.cos(ahead)) + (pose.x, pose.y)
        assert any(cv2.pointPolygonTest(ring, (float(x), float(y)), True) > -2 for x, y in way)
        assert 0 <= pose.tilt <= 20
        assert 60 <= pose.fov <= 75


@pytest.mark.slow
def test_most_street_pictures_show_most_of_a_wall(walked: Atlas) -> None:
    outdoors = GroundLevel(walked.city)
    around = functools.cache(lambda number: outdoors.around(walked.city.targets[number - 1]))
    shares = []
    for number, pose in _cameras(walked, "street"):
        stands = around(number)
        shares.append(stands.seen[np.argmin(np.hypot(*(stands.places - (pose.x, pose.y)).T))])
    assert np.median(shares) > 0.7


def test_what_stands_between_hides_a_wall() -> None:
    line = np.array([[0.0, 0.0]]), np.array([[40.0, 0.0]]), np.array([8.0])
    nothing = {"numbers": np.arange(0), "bodies": np.zeros((0, 6)), "trees": np.zeros((0, 5)),
               "hedges": np.zeros((0, 2, 2)), "vehicles": np.zeros((0, 5)), "tall": np.zeros(0, bool), "water": ()}  # fmt: skip

    def clear(**things: Any) -> bool:
        return bool(Obstacles(**{**nothing, **things}).clear(*line, own=7)[0])

    house, tree = np.array([[20.0, 0, 4, 4, 0.3, 9]]), np.array([[20.0, 1, 3, 1, 12]])
    hedge = np.array([[[2.0, -2], [2, 2]]])
    assert clear()
    assert not clear(numbers=np.array([3]), bodies=house)
    assert clear(numbers=np.array([7]), bodies=house)  # the building itself
    assert clear(numbers=np.array([3]), bodies=house + np.array([0, 20, 0, 0, 0, 0]))
    assert not clear(trees=tree)
    assert clear(trees=tree + np.array([0, 0, 0, 8, 8]))  # below its crown
    assert not clear(hedges=hedge)
    assert clear(hedges=hedge + np.array([20, 0]))  # over it


def test_a_panorama_has_north_in_the_middle_and_a_tile_around_it(walked: Atlas) -> None:
    camera = cameras.Panorama(10, 20, 2)
    around = camera.project(np.array([[10.0, 120, 2], [110, 20, 2], [-90, 20, 2], [10, 21, 2 + 1]]))
    assert around[:, 0] == pytest.approx([0, 0.5, -0.5, 0])
    assert around[3, 1] < around[0, 1]  # 45 degrees up
    assert camera.size(256) == (616, 112)  # half of CVUSA's
    tiles = {shot.paths[0]: shot.camera for shot in walked.shots if shot.view == "satellite"}
    places = []
    for shot in walked.shots:
        if shot.view == "panorama":
            tile = tiles[shot.paths[0].replace("streetview/panos", "bingmap/19")]
            assert (tile.x, tile.y) == (shot.camera.x, shot.camera.y)
            assert isinstance(tile, cameras.Tile)
            assert (tile.heading, tile.size) == (0, cameras.TILE)
            places.append([tile.x, tile.y])
    middle = np.interp(np.array(places)[:, 1], *walked.city.terrain.river.line.T[::-1])
    assert (np.abs(np.array(places)[:, 0] - middle) > cameras.TILE / 2).all()  # no tile of both splits
    apart = np.linalg.norm(np.array(places)[:, None] - np.array(places), axis=-1)
    assert apart[~np.eye(len(places), dtype=bool)].min() > 1


def test_a_reader_of_cvusa_finds_pairs_of_both_splits(walked: Atlas, tmp_path: Path) -> None:
    files = walked.cvusa_files()
    assert set(files) == {"cvusa/geo.csv", "cvusa/splits/train-19zl.csv", "cvusa/splits/val-19zl.csv"}
    splits = {building["id"]: building["split"] for building in json.loads(walked.world_json())["buildings"]}
    pictures = {path for shot in walked.shots for path in shot.paths}
    found: dict[str, set[int]] = {}
    for split, name in (("train", "train"), ("test", "val")):
        lines = files[f"cvusa/splits/{name}-19zl.csv"].decode().splitlines(keepends=True)
        for line in lines:
            tile, panorama, rest = line.split(",")  # as published readers do, whose last value keeps the line's end
            assert rest == "\n"
            assert {f"cvusa/{tile}", f"cvusa/{panorama}"} <= pictures
            assert Path(tile).parent.as_posix() == "bingmap/19"
            assert Path(panorama).parent.as_posix() == "streetview/panos"
            number = int(tile.split("/")[-1].split(".")[0])
            assert number == int(Path(panorama).stem)
            assert splits[number // 100] == split
            found.setdefault(split, set()).add(number)
    assert len(found["train"]) == 16 * 2
    assert len(found["test"]) == 8 * 2
    assert not found["train"] & found["test"]
    (tmp_path / "geo.csv").write_bytes(files["cvusa/geo.csv"])
    shown = [shot for shot in walked.shots if shot.view == "panorama"]
    places = Positions(tmp_path).of([Picture(tmp_path / shot.paths[0].removeprefix("cvusa/"), 0, "") for shot in shown])
    for shot, place in zip(shown, places, strict=True):
        at = walked.site.metres(place.latitude, place.longitude)
        assert at == pytest.approx((shot.camera.x, shot.camera.y), abs=0.05)


def test_files_name_the_pictures_from_the_ground(walked: Atlas, tmp_path: Path) -> None:
    pictures = json.loads(walked.world_json())["pictures"]
    assert Counter(p["view"] for p in pictures) == {
        "drone": 16 * 4 + 8 * 4 * 2, "street": 16 * 3 + 8 * 3 * 2, "panorama": 24 * 2, "satellite": 16 + 8 * 2 + 24 * 2
    }  # fmt: skip
    (tmp_path / "geo.csv").write_bytes(walked.geo_csv())
    streets = [p for p in pictures if p["view"] == "street"]
    assert any(p["path"] == "test/gallery_street/0020/image-03.jpg" for p in streets)
    for place in Positions(tmp_path).of([Picture(tmp_path / p["path"], p["id"], "") for p in streets]):
        assert place.heading is not None
        assert place.altitude is None


@pytest.mark.parametrize("text", ["", "2", "3/2", "0/4", "a/b", "1/2/3"])
def test_a_part_is_i_of_k(text: str) -> None:
    with pytest.raises(InputError, match="i/k"):
        RenderShare.parse(text)


def test_without_blender_the_command_says_what_to_install(tmp_path: Path) -> None:
    script = (
        "import sys; sys.modules['bpy'] = None; from lpn.cli.main import main; "
        f"sys.exit(main(['world', '--out', {str(tmp_path / 'w')!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert (
        done.stderr == "lpn: This needs the package bpy, which is not installed; pip install 'lpn-explorer[world]'.\n"
    )
    assert not (tmp_path / "w").exists()


def test_the_command_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main.main(["--help"]) == 0
    assert "world" in capsys.readouterr().out


def test_another_world_in_the_folder_is_left_alone(tmp_path: Path, atlas: Atlas) -> None:
    held = json.loads(atlas.world_json())
    for changed in ({**held, "edition": 0}, {**held, "settings": {}}, []):
        (tmp_path / "world.json").write_text(json.dumps(changed))
        with pytest.raises(OutputError, match="choose another folder"):
            check_folder(SETTINGS, tmp_path)
    (tmp_path / "world.json").write_bytes(atlas.world_json())
    check_folder(SETTINGS, tmp_path)


def test_a_world_can_be_added_to_but_not_taken_from(tmp_path: Path, atlas: Atlas, walked: Atlas) -> None:
    (tmp_path / "world.json").write_bytes(atlas.world_json())
    check_folder(SETTINGS, tmp_path)
    check_folder(WALKED, tmp_path)
    with pytest.raises(OutputError, match="other settings"):
        check_folder(replace(WALKED, views=5), tmp_path)
    with pytest.raises(OutputError, match="other settings"):
        check_folder(replace(SETTINGS, vary=("days",)), tmp_path)
    snowy = replace(SETTINGS, vary=("snow", "plan"))
    (tmp_path / "world.json").write_bytes(make_atlas(snowy).world_json())
    check_folder(snowy, tmp_path)
    (tmp_path / "world.json").write_bytes(walked.world_json())
    check_folder(replace(WALKED, streets=4), tmp_path)
    with pytest.raises(OutputError, match="3 streets and 2 panoramas of each place; ask for as many or more"):
        check_folder(SETTINGS, tmp_path)
    with pytest.raises(OutputError, match="2 panoramas of each place"):
        check_folder(replace(WALKED, panoramas=1), tmp_path)


def test_the_sentence_at_the_end_counts_every_kind_of_picture() -> None:
    tally = Tally(2, 10.0, 1, 30.0, 0, 0.0, 4, 8.0, 2, 3.0)
    assert tally.describe() == (
        "Made 4 street pictures, 2 panoramas, and 1 satellite sectors: 2.00 s a street picture, 1.50 s a panorama, "
        "30 s a satellite sector, 5 s a scene."
    )
    assert Tally().describe() == "Every picture was there already."


@rendering
def test_a_world_that_is_there_gets_pictures_from_the_ground(tmp_path: Path) -> None:
    small = Settings(seed=2, buildings=2, views=1, pixels=40, tile_pixels=48, samples=1)
    build_world(small, tmp_path)
    kept = {file: _digest(file) for file in tmp_path.rglob("*.jpg")}
    tally = build_world(replace(small, streets=1, panoramas=1), tmp_path)
    assert (tally.frames, tally.streets, tally.panoramas) == (0, 2, 2)
    assert {file: _digest(file) for file in kept} == kept
    assert len(open_dataset(tmp_path).queries("street")) == 1
    assert len(list(tmp_path.glob("cvusa/bingmap/19/*.jpg"))) == 2
    panorama = cv2.imread(str(next(tmp_path.glob("cvusa/streetview/panos/*.jpg"))))
    assert panorama.shape == (18, 99, 3)


@rendering
def test_a_small_world_is_rendered_resumed_and_repeated(tmp_path: Path) -> None:
    small = Settings(seed=2, buildings=2, views=2, pixels=40, tile_pixels=48, samples=1)
    first, second = tmp_path / "first", tmp_path / "second"
    build_world(small, first)
    assert len(open_dataset(first).train("satellite")) == 1
    assert len(open_dataset(first).queries("drone")) == 2
    kept = {file: _digest(file) for file in first.rglob("*.jpg")}
    lost = sorted(kept)[0]
    lost.unlink()
    tally = build_world(small, first)
    assert tally.frames + tally.sweeps == 1
    assert {file: _digest(file) for file in kept} == kept
    for part in ("1/2", "2/2"):
        build_world(small, second, RenderShare.parse(part))
    assert [_digest(second / file.relative_to(first)) for file in kept] == list(kept.values())
    with pytest.raises(OutputError, match="other settings"):
        build_world(Settings(3, 2, 2, 40, 48, 1), first)


@pytest.mark.slow
@rendering
def test_each_factor_changes_pictures(tmp_path: Path) -> None:
    small = Settings(seed=2, buildings=2, views=1, pixels=40, tile_pixels=48, samples=1)
    build_world(small, tmp_path / "plain")
    plain = {file.relative_to(tmp_path / "plain"): _digest(file) for file in (tmp_path / "plain").rglob("*.jpg")}
    for factor in FACTORS:
        build_world(replace(small, vary=(factor,)), tmp_path / factor)
        changed = {
            file.parent.parent.name for file, digest in plain.items() if _digest(tmp_path / factor / file) != digest
        }
        views = {"poses": {"drone"}, "construction": {"satellite"}}.get(factor, {"drone", "satellite"})
        seen = {view.rpartition("_")[2] for view in changed}
        assert seen == views if factor != "snow" else seen <= views


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
