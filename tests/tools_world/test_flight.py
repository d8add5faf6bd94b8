"""A rendered flight: its plan, the metadata of its files, its map, and how its building resumes; all without Blender."""

from __future__ import annotations

import io
import itertools
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from lpn.core.errors import OutputError
from lpn.datasets.rendered import FLIGHT_PLAN
from lpn.flight.files import Frame, footprint
from lpn.flight.files.photos import photo_of
from lpn.flight.files.sources import make_flight
from tools.fixtures import painting
from tools.world.__main__ import main
from tools.world.cameras import Pose, SatelliteImage, Site
from tools.world.city import City
from tools.world.flight import MAP, FlightSettings, build_flight
from tools.world.flight_files import MapGrid, photo_bytes
from tools.world.flight_plan import (
    FOV,
    HEIGHTS,
    MAP_SIDE,
    START,
    TAG_ERRORS,
    AerialPose,
    FlightPlan,
    gauss_markov,
    picture_middle,
    plan_flight,
)

SETTINGS = FlightSettings(seed=5, buildings=24, frames=10, width=64, samples=1, map_pixel=2.0)


@pytest.fixture(scope="module")
def plan(city: City) -> FlightPlan:
    return plan_flight(city, Site(), 150)


@pytest.fixture
def painted(monkeypatch: pytest.MonkeyPatch, city: City) -> None:
    """Paints pictures in place of Blender, and plans the city once."""
    monkeypatch.setitem(sys.modules, "tools.world.render", painting)
    monkeypatch.setattr("tools.world.flight.plan_city", lambda *_: city)


def test_a_lawnmower_is_flown_at_two_heights_and_a_free_path_between_them(plan: FlightPlan) -> None:
    heights = np.array([picture.pose.z - plan.ground for picture in plan.pictures])
    mown = np.array([picture.path == "lawnmower" for picture in plan.pictures])
    assert mown.sum() == 90
    assert heights[:45] == pytest.approx(HEIGHTS[0], abs=2)
    assert heights[45:90] == pytest.approx(HEIGHTS[1], abs=2)
    assert heights[90] == pytest.approx(HEIGHTS[1], abs=2)
    assert heights[-1] == pytest.approx(HEIGHTS[0], abs=2)
    places = np.array([(picture.pose.x, picture.pose.y) for picture in plan.pictures])
    legs = places[:90].reshape(6, 15, 2)
    ways = legs[:, -1] - legs[:, 0]
    assert np.linalg.norm(ways, axis=1) == pytest.approx(360, abs=4)
    turned = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    assert (turned[1:] * turned[:-1]).sum(axis=1) == pytest.approx(-1, abs=0.001)  # there and back
    free, times = plan.pictures[90:], np.array([picture.time for picture in plan.pictures])
    assert times[0] == START
    assert np.diff(times).min() > 0
    assert np.diff(times[90:]) == pytest.approx(1)
    steps = np.array([(b.pose.x - a.pose.x, b.pose.y - a.pose.y) for a, b in itertools.pairwise(free)])
    told = np.array([picture.tag.speed[:2] for picture in free[:-1]])
    assert np.abs(steps - told).max() < 1.5  # a curve's chord


@pytest.mark.parametrize("seed", range(8))
def test_all_pictures_show_ground_of_the_map(city: City, plan: FlightPlan, seed: int) -> None:
    made = plan_flight(replace(city, seed=seed), Site(), 150)
    assert (made == plan) == (seed == city.seed)
    for picture in made.pictures:
        pose = picture.pose
        frame = Frame("", Path(), 4, 3, heading=pose.heading, pitch=pose.pitch, roll=pose.roll, fov=pose.fov)
        corners = footprint(frame, pose.z - city.height(pose.x, pose.y))
        assert np.abs(corners + np.array([pose.x - made.x, pose.y - made.y])).max() < MAP_SIDE / 2 - 5
        assert -pose.axes()[2, 2] > np.cos(np.radians(14))


def test_the_axes_are_those_of_the_other_cameras_and_of_footprints() -> None:
    level = AerialPose(3, 4, 100, 200, -70, 0)
    assert level.axes() == pytest.approx(Pose(3, 4, 100, 200, -70, FOV).axes())
    pose = AerialPose(0, 0, 100, 35, -80, 6)
    right, up, forward = pose.axes()
    assert np.cross(right, up) == pytest.approx(-forward)
    half = np.tan(np.radians(FOV / 2))
    rays = np.array([forward + half * (u * right + 0.75 * v * up) for u, v in ((-1, 1), (1, 1), (1, -1), (-1, -1))])
    ground = rays[:, :2] * (100 / -rays[:, 2:])
    found = footprint(Frame("", Path(), 400, 300, heading=35, pitch=-80, roll=6, fov=FOV), 100)
    assert found == pytest.approx(ground)


def test_the_middle_of_a_picture_lies_on_the_terrain(city: City, plan: FlightPlan) -> None:
    pose = max((picture.pose for picture in plan.pictures), key=lambda pose: pose.pitch)
    x, y = picture_middle(city, pose)
    ray = np.array([x, y, city.height(x, y)]) - (pose.x, pose.y, pose.z)
    assert ray / np.linalg.norm(ray) == pytest.approx(pose.axes()[2], abs=1e-9)
    assert np.hypot(x - pose.x, y - pose.y) > 10


def test_tags_are_off_as_a_consumer_receiver_is(city: City) -> None:
    off, heights, headings = [], [], []
    for seed in range(12):
        for picture in plan_flight(replace(city, seed=seed), Site(), 150).pictures:
            x, y = Site().metres(picture.tag.latitude, picture.tag.longitude)
            off.append((x - picture.pose.x, y - picture.pose.y))
            heights.append(picture.tag.takeoff_height)
            headings.append((picture.tag.gimbal[0] - picture.pose.heading + 180) % 360 - 180)
    spread = np.sqrt(np.mean(np.square(off)))
    e = TAG_ERRORS
    lag = e.lag * 9 / np.sqrt(2)
    assert spread == pytest.approx(np.sqrt(e.offset**2 + e.drift**2 + e.noise**2 + lag**2), rel=0.25)
    assert np.std(headings) == pytest.approx(np.hypot(e.compass, e.yaw), rel=0.4)


def test_a_gauss_markov_process_has_its_deviation_and_forgets_in_its_time() -> None:
    values = gauss_markov(np.random.default_rng(0), np.arange(200_000) * 0.5, 2.0, 10.0)
    assert values.std() == pytest.approx(2.0, rel=0.02)
    assert np.corrcoef(values[:-20], values[20:])[0, 1] == pytest.approx(np.exp(-1), abs=0.02)
    assert gauss_markov(np.random.default_rng(0), np.zeros(0), 2.0, 10.0).shape == (0,)


@pytest.mark.parametrize("number", [0, 40, 100, 149])
def test_a_photo_tells_its_tag_within_the_roundings(plan: FlightPlan, number: int) -> None:
    picture = plan.pictures[number]
    data = photo_bytes(picture, np.full((48, 64, 3), 90, np.uint8))
    read = photo_of(data, Path(picture.name))
    with Image.open(io.BytesIO(data)) as opened:
        plain = io.BytesIO()
        opened.save(plain, "JPEG", exif=opened.getexif().tobytes(), xmp=b"")
    alone = photo_of(plain.getvalue(), Path("a.jpg")).frame  # of EXIF
    assert (alone.latitude, alone.longitude) == pytest.approx((picture.tag.latitude, picture.tag.longitude), abs=2e-8)
    assert alone.altitude == pytest.approx(picture.tag.altitude, abs=0.00051)
    assert (alone.height_above_takeoff, alone.fov) == (None, pytest.approx(FOV, abs=1e-5))
    assert read.oddities == ()
    frame, tag = read.frame, picture.tag
    assert (frame.latitude, frame.longitude) == pytest.approx((tag.latitude, tag.longitude), abs=0.51e-9)
    assert frame.height_above_takeoff == pytest.approx(tag.takeoff_height, abs=0.0051)
    assert frame.altitude == pytest.approx(tag.altitude, abs=0.0051)
    assert frame.heading_source == "gimbal"
    assert (frame.heading - tag.gimbal[0] + 180) % 360 - 180 == pytest.approx(0, abs=0.051)
    assert frame.pitch == pytest.approx(tag.gimbal[1], abs=0.051)
    assert frame.roll == 0
    assert frame.fov == pytest.approx(FOV, abs=1e-5)
    assert read.utc == pytest.approx(picture.time, abs=0.0011)
    assert read.local == pytest.approx(picture.time, abs=0.0011)


def test_the_maps_pixels_lie_where_the_plan_has_them(tmp_path: Path) -> None:
    pytest.importorskip("rasterio")
    from lpn.flight.maps import Window, open_map

    site, x, y = Site(), 640.0, -380.0
    grid = MapGrid(site, x, y, 200.0, 0.5)
    assert grid.crs.to_epsg() == 32625
    sweep = SatelliteImage(x, y, 5.0, 240.0, 480, 0.0, 0.0)
    spots = np.array([(x, y), (x - 82, y + 79), (x + 81.3, y - 77.7)])
    at = np.stack(np.meshgrid(np.arange(480) + 0.5, np.arange(480) + 0.5), axis=-1)
    light = np.full((480, 480, 3), 0.1, np.float32)  # black at the border would have no data
    for pixel in sweep.project(np.column_stack([spots, np.full(3, 5.0)])):
        light += 0.9 * np.exp(-((at - pixel) ** 2).sum(axis=-1) / 2 / 2.0**2)[..., None]
    file = tmp_path / "map.tif"
    shown = (grid.cut(light.astype(np.float32), sweep, cv2.INTER_CUBIC) * 250).astype(np.uint8)
    file.write_bytes(grid.geotiff(shown))
    town = open_map(file)
    for spot in spots:
        place = town.frame.xy(*site.degrees(*spot))[0]
        picture, valid = town.read(Window(*place, size=20.0), 80)
        assert valid.all()
        weight = picture[..., 1].astype(float)
        weight[weight < 60] = 0
        middle = [(weight * (index + 0.5)).sum() / weight.sum() for index in np.indices(weight.shape)]
        assert middle == pytest.approx([40, 40], abs=0.6)  # pixels of 0.25 m


@pytest.mark.usefixtures("painted")
def test_the_files_of_a_flight_are_read_as_one(city: City, tmp_path: Path) -> None:
    pytest.importorskip("rasterio")
    assert build_flight(SETTINGS, tmp_path / "made") == 12
    plan = plan_flight(city, Site(), 10)
    flight = make_flight([tmp_path / "made/photos"], tmp_path / "photos")
    assert [frame.name for frame in flight.frames] == [picture.name for picture in plan.pictures]
    assert flight.utc
    assert flight.notes == ()
    assert (flight.frames[0].width, flight.frames[0].height) == (64, 48)
    exact = make_flight([tmp_path / "made/photos", tmp_path / "made/truth.csv"], tmp_path / "exact")
    for before, frame, picture in zip(flight.frames, exact.frames, plan.pictures, strict=True):
        place = Site().degrees(picture.pose.x, picture.pose.y)
        assert (frame.latitude, frame.longitude) == pytest.approx(place, abs=0.51e-9)
        assert replace(frame, latitude=before.latitude, longitude=before.longitude) == before


@pytest.mark.usefixtures("painted")
def test_an_interrupted_flight_goes_on_and_ends_the_same(tmp_path: Path) -> None:
    pytest.importorskip("rasterio")
    out = tmp_path / "made"
    build_flight(SETTINGS, out)
    whole = {file.relative_to(out): file.read_bytes() for file in out.rglob("*") if file.is_file()}
    assert "unfinished.txt" not in {str(name) for name in whole}
    for name in ("photos/LPN_0003.JPG", "photos/LPN_0009.JPG", MAP):
        (out / name).unlink()
    assert build_flight(SETTINGS, out) == 3
    assert {file.relative_to(out): file.read_bytes() for file in out.rglob("*") if file.is_file()} == whole
    assert build_flight(SETTINGS, out) == 0


@pytest.mark.usefixtures("painted")
def test_another_flight_or_a_world_in_the_folder_is_left_alone(tmp_path: Path) -> None:
    pytest.importorskip("rasterio")
    (tmp_path / "world").mkdir()
    (tmp_path / "world/world.json").write_text("{}")
    with pytest.raises(OutputError, match="holds a world; choose another folder"):
        build_flight(SETTINGS, tmp_path / "world")
    (tmp_path / FLIGHT_PLAN).write_text("[")
    with pytest.raises(OutputError, match="delete that folder, or choose another one"):
        build_flight(SETTINGS, tmp_path)
    assert {file.name for file in tmp_path.iterdir()} == {FLIGHT_PLAN, "world"}


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--flight", "--tile-pixels", "64"], "A flight takes no --tile-pixels; leave it out."),
        (["--map-pixel", "1"], "A world without --flight takes no --map-pixel; leave it out."),
        (["--flight", "--frames", "1"], "The setting frames is 1; expected 2 to 5000."),
        (["--flight", "--width", "66"], "--width is 66; expected a multiple of 4, as pictures are 4:3."),
        (["--flight"], "This needs the package bpy, which is not installed; pip install -e . 'bpy>=5.0,<5.1'."),
        ([], "This needs the package bpy, which is not installed; pip install -e . 'bpy>=5.0,<5.1'."),
    ],
)
def test_what_the_command_cannot_do_is_said(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    sentence: str,
) -> None:
    pytest.importorskip("rasterio")
    monkeypatch.setitem(sys.modules, "bpy", None)
    monkeypatch.delitem(sys.modules, "tools.world.render", raising=False)
    assert main([*options, "--out", str(tmp_path / "w")]) == 2
    assert capsys.readouterr().err.strip() == sentence
    assert not (tmp_path / "w").exists()
