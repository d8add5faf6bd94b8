"""AnyVisLoc and OrthoLoC as maps and flights: what is read, against exact cameras, and what is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lpn.core.errors import DataError, InputError
from lpn.core.posed_samples import sample_folders
from lpn.datasets.rendered import true_poses
from lpn.doctor.sample_check import check_samples
from lpn.flights import FlightOptions, make_flight, open_flight
from lpn.locate.options import LocateOptions
from lpn.locate.pipeline import locate
from lpn.locate.pose_errors import pose_errors
from lpn.maps import Map, MapOptions, MapPlace, open_map
from lpn.maps.posed_scenes import build_scene
from tools.fixtures import posed_samples


def test_a_sample_of_ortholoc_is_located_at_its_exact_pose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "cache"))
    file = tmp_path / "test_inPlace" / "L01_R0001.npz"
    east, north, up = posed_samples.ortholoc(file)
    build_scene(file, tmp_path / "map", MapOptions())
    make_flight([file], tmp_path / "flight")
    basemap, flight = open_map(tmp_path / "map"), open_flight(tmp_path / "flight")
    (frame,) = flight.frames
    assert (frame.heading, frame.pitch, frame.height_above_takeoff) == (None, None, None)
    assert frame.fov == pytest.approx(2 * math.degrees(math.atan(100 / 180)))
    pose = true_poses(tmp_path / "flight" / "frames")["L01_R0001.png"]
    assert (pose.heading, pose.pitch, pose.roll, pose.altitude) == pytest.approx((40, -80, 3, up), abs=1e-4)
    assert basemap.frame.xy([pose.latitude], [pose.longitude])[0] - _corner(basemap) == pytest.approx(
        (east + 80, north - 80), abs=0.01
    )
    located = locate(basemap, flight, None, LocateOptions(matcher="sift"))
    errors = pose_errors(located)
    assert errors is not None
    assert errors.poses == 1
    assert not errors.flat
    assert errors.position[0] < 1.0
    assert errors.turn[0] < 0.5


@pytest.mark.parametrize(
    ("name", "first", "heights"), [("", (19.75, -9.75), 0.0), ("satellite_map.png", (19.5, -9.5), 1.5)]
)
def test_a_scene_of_anyvisloc_lies_where_its_reference_says(
    tmp_path: Path, name: str, first: tuple[float, float], heights: float
) -> None:
    scene = tmp_path / "Scene_01"
    places = posed_samples.anyvisloc(scene, 2)
    built = build_scene(scene / name, tmp_path / "map", MapOptions())
    assert built is not None
    flight = make_flight([scene], tmp_path / "flight")
    xy = built.frame.xy(*flight.degrees.T)
    assert xy - _corner(built) == pytest.approx(places[:, :2] - first, abs=0.01)
    assert built.heights(xy) == pytest.approx(heights)
    (frame, _) = flight.frames
    assert (frame.heading, frame.pitch, frame.roll, frame.flying_height) == pytest.approx((120, -75, 0, 60))
    assert math.isnan(true_poses(tmp_path / "flight" / "frames")["L01_0002.png"].altitude)


def _corner(basemap: Map) -> NDArray[np.float64]:
    """Return the north-west corner of a map in metres of its frame, (2,)."""
    return np.array([basemap.bounds[0], basemap.bounds[3]])


@pytest.mark.parametrize("kind", ["plain", "OpenGL", "north", "other"])
def test_a_matrix_counts_where_it_agrees_with_the_angles(tmp_path: Path, kind: str) -> None:
    posed_samples.anyvisloc(tmp_path / "Scene_01")
    file = tmp_path / "Scene_01" / "L01_0001.npz"
    arrays = dict(np.load(file))
    turn = arrays["pose_c2w"][:3, :3]
    south = np.diag([1.0, -1.0, 1.0])
    tilted = south @ posed_samples.world_to_camera(120.0, -75.0, 5.0).T
    arrays["pose_c2w"][:3, :3] = {
        "plain": tilted, "OpenGL": tilted @ np.diag([1.0, -1.0, -1.0]), "north": south @ tilted, "other": turn.T,
    }[kind]  # fmt: skip
    np.savez(file, **arrays)
    flight = make_flight([tmp_path / "Scene_01"], tmp_path / "flight")
    expected = None if kind == "other" else pytest.approx(5.0)
    assert flight.frames[0].roll == expected
    assert any("contradicts the angles" in note for note in flight.notes) == (kind == "other")


def test_a_broken_sample_is_left_out_and_named_and_the_doctor_finds_it(tmp_path: Path) -> None:
    scene = tmp_path / "Scene_01"
    posed_samples.anyvisloc(scene, 2)
    (scene / "L01_0001.npz").write_bytes((scene / "L01_0001.npz").read_bytes()[:2000])
    (scene / "satellite_dsm.npy").unlink()
    for quick in (True, False):
        (report,) = check_samples(sample_folders(tmp_path), quick)
        assert (report.layout, report.samples, len(report.problems)) == ("AnyVisLoc", 2, 2)
    flight = make_flight([scene], tmp_path / "flight")
    assert [frame.name for frame in flight.frames] == ["L01_0002"]
    assert "1 of 2 samples are left out" in flight.notes[-1]


def _pickled(arrays: dict[str, Any]) -> None:
    arrays["extrinsics"] = np.array([object()])


def _sheared(arrays: dict[str, Any]) -> None:
    arrays["extrinsics"][0, 0] += 0.2


def _without_focal(arrays: dict[str, Any]) -> None:
    arrays["intrinsics"] = np.eye(3)


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (_pickled, "cannot be read"),
        (_sheared, "holds no rotation"),
        (_without_focal, "focal lengths of 1 and 1 pixels"),
    ],
)
def test_a_harmed_sample_is_one_sentence(tmp_path: Path, harm: Callable[[dict[str, Any]], None], message: str) -> None:
    file = tmp_path / "L01_R0001.npz"
    posed_samples.ortholoc(file)
    arrays = dict(np.load(file))
    harm(arrays)
    np.savez(file, **arrays)
    with pytest.raises(DataError, match=message) as raised:
        make_flight([file], tmp_path / "flight")
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "flight").exists()


def _bent(arrays: dict[str, Any]) -> None:
    arrays["dsm"][40, 40, 0] += 3


def _scaled(arrays: dict[str, Any]) -> None:
    arrays["scale"] = np.array([2.0, 2.0])


@pytest.mark.parametrize(("harm", "message"), [(_bent, "on no regular grid"), (_scaled, "and the same scale")])
def test_a_harmed_map_leaves_no_folder(tmp_path: Path, harm: Callable[[dict[str, Any]], None], message: str) -> None:
    file = tmp_path / "L01_R0001.npz"
    posed_samples.ortholoc(file)
    arrays = dict(np.load(file))
    harm(arrays)
    np.savez(file, **arrays)
    with pytest.raises(DataError, match=message):
        build_scene(file, tmp_path / "map", MapOptions())
    assert not (tmp_path / "map").exists()


def _as_archive(file: Path) -> None:
    with file.open("wb") as opened:
        np.savez(opened, heights=np.zeros((4, 4)))


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (lambda file: np.save(file, np.zeros(9)), r"an array of the shape \(9,\) and the type float64"),
        (lambda file: np.save(file, np.full((4, 4), "a")), "and the type <U1"),
        (lambda file: np.save(file, np.zeros((0, 4))), r"of the shape \(0, 4\)"),
        (_as_archive, "cannot be read"),
        (lambda file: file.write_bytes(file.read_bytes()[:300]), "cannot be read"),
        (lambda file: file.write_bytes(file.read_bytes().replace(b"}", b" ", 1)), "cannot be read"),
        (lambda file: file.unlink(), "cannot be read"),
    ],
)
def test_damaged_heights_are_one_sentence(tmp_path: Path, harm: Callable[[Path], None], message: str) -> None:
    scene = tmp_path / "Scene_01"
    posed_samples.anyvisloc(scene)
    harm(scene / "aerial_dsm.npy")
    with pytest.raises(DataError, match=rf"aerial_dsm\.npy.*{message}.*download it again"):
        build_scene(scene, tmp_path / "map", MapOptions())
    assert not (tmp_path / "map").exists()
    (report,) = check_samples(sample_folders(tmp_path), quick=True)
    assert len(report.problems) == 1
    assert "aerial_dsm.npy" in report.problems[0]


def test_options_that_no_sample_uses_are_refused_and_others_are_honoured(tmp_path: Path) -> None:
    file, out = tmp_path / "L01_R0001.npz", tmp_path / "flight"
    posed_samples.ortholoc(file)
    for options in (FlightOptions(every=2.0), FlightOptions(every_metres=5.0), FlightOptions(gps_order="lat-lon")):
        with pytest.raises(
            InputError, match=r"OrthoLoC have neither videos nor subtitles.* so --(every|gps).*leave it out"
        ):
            make_flight([file], out, options)
    with pytest.raises(InputError, match="leave --bands and --keep-borders out"):
        build_scene(file, tmp_path / "map", MapOptions(bands=(1, 2, 3)))
    posed_samples.anyvisloc(tmp_path / "Scene_01")
    for path in (file, tmp_path / "Scene_01"):
        with pytest.raises(
            InputError, match="has its own place and heights; leave --crs, --corners, and --elevation out"
        ):
            build_scene(path, tmp_path / "map", MapOptions(crs="EPSG:4326"))
    assert build_scene(tmp_path / "Scene_01" / "aerial_map.png", tmp_path / "map", MapOptions(crs="EPSG:4326")) is None
    with pytest.raises(InputError, match="expected a day such as"):
        build_scene(file, tmp_path / "map", MapOptions(), place=MapPlace(photographed="soon"))
    assert not out.exists()
    assert not (tmp_path / "map").exists()
    flight = make_flight([file], out, FlightOptions(fov=60.0, pitch=-70.0))
    assert flight.frames[0].pitch == -70
    assert flight.frames[0].fov == pytest.approx(2 * math.degrees(math.atan(100 / 180)))
    assert flight.notes[-2:] == (
        "No file lacks the field of view, so --fov is not used.",
        "The pitch of 1 of 1 photos is the -70° given with --pitch.",
    )


def test_a_sample_named_twice_is_one_and_pictures_beside_samples_are_named(tmp_path: Path) -> None:
    scene = tmp_path / "Scene_01"
    posed_samples.anyvisloc(scene)
    (scene / "DJI_0001.JPG").write_bytes(b"")
    make_flight([scene, scene / "L01_0001.npz"], tmp_path / "flight")
    flight = open_flight(tmp_path / "flight")
    assert [frame.name for frame in flight.frames] == ["L01_0001"]
    assert "Pictures or videos beside the samples are left out: DJI_0001.JPG; make" in flight.notes[-1]


def test_samples_over_several_maps_are_no_flight(tmp_path: Path) -> None:
    for number in (1, 2):
        posed_samples.ortholoc(tmp_path / "set" / f"L01_R000{number}.npz")
    with pytest.raises(InputError, match="has a map of its own; give one"):
        make_flight([tmp_path / "set"], tmp_path / "flight")
    for number in (1, 2):
        posed_samples.anyvisloc(tmp_path / "scenes" / f"Scene_0{number}")
    with pytest.raises(InputError, match=r"2 scenes \(Scene_01, Scene_02\)"):
        make_flight([tmp_path / "scenes"], tmp_path / "flight")
    with pytest.raises(InputError, match=r"photo\.jpg holds no sample of AnyVisLoc"):
        make_flight([tmp_path / "scenes" / "Scene_01", tmp_path / "photo.jpg"], tmp_path / "flight")
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    with pytest.raises(DataError, match="no sample of AnyVisLoc or OrthoLoC"):
        make_flight([tmp_path / "other.npz"], tmp_path / "flight")
