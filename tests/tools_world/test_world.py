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
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from lpn.core.demo import DEMO
from lpn.core.errors import InputError, OutputError
from lpn.core.formats import WORLD
from lpn.datasets import Picture, open_dataset
from lpn.datasets.geo import Position, Positions, camera, metres
from tools.world import atlas as atlases
from tools.world import cameras, paint, photo
from tools.world.atlas import SIGHT, Atlas, Settings, make_atlas
from tools.world.build import RenderShare, Tally, build_world
from tools.world.canvas import Canvas
from tools.world.city import City
from tools.world.geometry import area, overlap, rectangle, within
from tools.world.jobs import check_folder
from tools.world.plan import SPACING
from tools.world.plan import plan_city as plan_city_anew
from tools.world.variety import FACTORS, Materials

SETTINGS = Settings(seed=5, buildings=24, views=4, pixels=48, tile_pixels=64, samples=1)

rendering = pytest.mark.skipif(
    importlib.util.find_spec("bpy") is None, reason="needs Blender: pip install -e . 'bpy>=5.0,<5.1'"
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
    varied = make_atlas(replace(SETTINGS, vary=("cameras", "poses", "materials")))
    assert varied.city.buildings == atlas.city.buildings
    assert [shot.paths for shot in varied.shots] == [shot.paths for shot in atlas.shots]
    for one, other in zip(varied.shots, atlas.shots, strict=True):
        assert (one.camera == other.camera) == (one.view == "satellite")
    assert varied.geo_csv() != atlas.geo_csv()


def test_cameras_of_a_varied_world_differ() -> None:
    day = photo.drone_look(1, 0)
    light = np.full((32, 32, 3), 0.2, np.float32)
    rng = np.random.default_rng(0)
    pictures = [photo.develop(light, photo.any_camera(day, rng), rng) for _ in range(20)]
    assert np.ptp([picture.mean() for picture in pictures]) > 30
    assert np.ptp([picture.std(axis=(0, 1)).mean() for picture in pictures]) > 2


def test_materials_change_the_pavements_of_a_day_and_neither_its_season_nor_the_camera() -> None:
    for look in (photo.drone_look, photo.satellite_look):
        plain = look(1, 3)
        season = replace(plain.season, pavement=Materials.draw(1, 3).pavement)
        for vary in (["materials"], FACTORS):
            assert look(1, 3, vary) == replace(plain, materials=True, season=season)
        assert look(1, 3, ["cameras", "poses"]) == plain


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


def test_pavements_of_a_district_have_its_colour(city: City) -> None:
    season = photo.DRONE.season
    west, north = city.buildings[city.targets[0].building].x - 120, city.buildings[city.targets[0].building].y + 120
    bare, _ = paint.ground(city, west, north, 240, 1.0, season)
    red, _ = paint.ground(city, west, north, 240, 1.0, replace(season, pavement=(1.5, 1.0, 1.0)))
    ratio = red / bare
    assert ratio[..., 0].max() == pytest.approx(1.5, rel=0.05)
    assert np.median(ratio[..., 1]) == pytest.approx(1, abs=1e-6)


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


@pytest.mark.slow
def test_cameras_and_sectors_are_those_of_edition_2(atlas: Atlas) -> None:
    numbers = [[*vars(shot.camera).values()] for shot in atlas.shots]
    numbers += [[s.x, s.y, s.reach, s.district, s.number] for s in atlas.sectors]
    found = hashlib.sha256(json.dumps([[round(v, 3) for v in row] for row in numbers]).encode()).hexdigest()
    assert found == "1ffcb4a061318f9b753dea56cab28c065ae79d573e285ad9550f405c87d26d9f"


@pytest.mark.parametrize("text", ["", "2", "3/2", "0/4", "a/b", "1/2/3"])
def test_a_part_is_i_of_k(text: str) -> None:
    with pytest.raises(InputError, match="i/k"):
        RenderShare.parse(text)


def test_without_blender_the_command_says_what_to_install(tmp_path: Path) -> None:
    script = (
        "import sys; sys.modules['bpy'] = None; from tools.world.__main__ import main; "
        f"sys.exit(main(['--out', {str(tmp_path / 'w')!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == "This needs the package bpy, which is not installed; pip install -e . 'bpy>=5.0,<5.1'.\n"
    assert not (tmp_path / "w").exists()


def _check(settings: Settings, folder: Path) -> None:
    check_folder(settings, folder / "world.json", "rendered world", WORLD)


def test_another_world_in_the_folder_is_left_alone(tmp_path: Path, atlas: Atlas) -> None:
    held = json.loads(atlas.world_json())
    for changed in ({**held, "edition": 0}, {**held, "settings": {}}, []):
        (tmp_path / "world.json").write_text(json.dumps(changed))
        with pytest.raises(OutputError, match="choose another folder"):
            _check(SETTINGS, tmp_path)
    (tmp_path / "world.json").write_bytes(atlas.world_json())
    _check(SETTINGS, tmp_path)


def test_a_world_of_other_settings_is_refused_and_its_own_may_be_left_at_their_defaults(
    tmp_path: Path, atlas: Atlas
) -> None:
    plan = json.loads(atlas.world_json())
    for change in ({"vary": ("cameras",)}, {"views": 5}):
        (tmp_path / "world.json").write_bytes(atlas.world_json())
        with pytest.raises(OutputError, match="other settings"):
            _check(replace(SETTINGS, **change), tmp_path)  # type: ignore[arg-type]
    del plan["settings"]["vary"]
    (tmp_path / "world.json").write_text(json.dumps(plan))
    _check(SETTINGS, tmp_path)
    varied = replace(SETTINGS, vary=("poses", "materials"))
    (tmp_path / "world.json").write_text(json.dumps({**plan, "settings": asdict(varied)}))
    _check(varied, tmp_path)
    (tmp_path / "world.json").write_text(json.dumps({**plan, "settings": {**plan["settings"], "streets": 4}}))
    with pytest.raises(OutputError, match="other settings"):
        _check(SETTINGS, tmp_path)


@pytest.mark.parametrize("named", ["format", "edition"])
def test_a_later_world_is_not_added_to(named: str, tmp_path: Path) -> None:
    plan = json.loads((DEMO / "world.json").read_bytes())
    settings = Settings(**plan["settings"])
    (tmp_path / "world.json").write_text(json.dumps(plan))
    _check(settings, tmp_path)
    later = {"format": "lpn-world/2", "edition": 99}
    message = {
        "format": r"world\.json was written by a later version of lpn",
        "edition": "by edition 99 .* install the newer version",
    }
    (tmp_path / "world.json").write_text(json.dumps({**plan, named: later[named]}))
    with pytest.raises(OutputError, match=message[named]):
        _check(settings, tmp_path)


def test_the_sentence_at_the_end_counts_every_kind_of_picture() -> None:
    tally = Tally(2, 10.0, 1, 30.0, 4, 8.0)
    assert tally.describe() == (
        "Made 4 drone pictures and 1 satellite sectors: 2.00 s a drone picture, 30 s a satellite sector, 5 s a scene."
    )
    assert Tally().describe() == "Every picture was there already."


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
        views = {"drone"} if factor == "poses" else {"drone", "satellite"}
        assert {view.rpartition("_")[2] for view in changed} == views


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
