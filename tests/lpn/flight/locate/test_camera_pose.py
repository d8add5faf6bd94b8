"""The camera's pose: from exact matches, and from a drawn photo of a drawn relief."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lpn.core.arrays import Float64Array, UInt8Array
from lpn.core.homography import middle_pixel
from lpn.flight.files import Flight, Frame
from lpn.flight.files.cameras import rotation
from lpn.flight.files.lenses import Lens
from lpn.flight.locate.camera_pose import CameraPose, PoseMatches, solve_pose
from lpn.flight.locate.levelled import level
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.pipeline import locate
from lpn.flight.locate.tracks import full_track
from lpn.flight.maps import Map, open_map
from lpn.flight.maps.elevation import ElevationFile
from lpn.flight.maps.folder import build_map
from tests.lpn.flight.locate.scenery import CORNER, RESOLUTION, SIDE, land, write_map
from tests.lpn.flight.maps.small_maps import write_geotiff

SIZE, FOV = (640, 480), 71.6
# A wide lens without correction: pixels at the picture's corners lie 50 pixels too near to its middle.
LENS = Lens(0.5 / math.tan(math.radians(FOV) / 2), 0.5 / math.tan(math.radians(FOV) / 2), 0.0, 0.0, -0.2, 0.05)
PLACE = np.array([10.0, -20.0, 110.0])
# Of the matches, in pixels along each axis.
PIXEL_NOISE = 0.8


def rays(heading: float, pitch: float, roll: float, pixels: Float64Array) -> Float64Array:
    """Rays (N, 3), east, north, and up, of pixels of a photo."""
    focal = SIZE[0] / 2 / np.tan(np.radians(FOV) / 2)
    x, y = ((pixels - (np.array(SIZE) - 1) / 2) / focal).T
    body = np.stack([-y, x, np.ones(len(x))], axis=1)
    turned = body @ rotation(heading, pitch, roll).T
    return np.asarray(turned[:, [1, 0, 2]] * (1, 1, -1))


def matches(heading: float, pitch: float, roll: float, relief: float, false: int = 100) -> PoseMatches:
    """400 matches with noise, the first of them false, over ground of random heights up to `relief`."""
    rng = np.random.default_rng(3)
    pixels = rng.uniform(0, 1, (400, 2)) * (np.array(SIZE) - 1)
    along = rays(heading, pitch, roll, pixels)
    heights = rng.uniform(0, 1, 400) * relief
    points = PLACE + along * ((heights - PLACE[2]) / along[:, 2])[:, None]
    noisy = pixels + rng.normal(0, PIXEL_NOISE, pixels.shape)
    noisy[:false] = rng.uniform(0, 1, (false, 2)) * (np.array(SIZE) - 1)
    plane, _ = cv2.findHomography(noisy, points[:, :2], cv2.RANSAC, 2.0)
    return PoseMatches(noisy, points, SIZE, np.asarray(plane, np.float64), 8, PIXEL_NOISE)


def level_ground(places: Float64Array) -> Float64Array:
    return np.zeros(len(places))


@pytest.mark.parametrize(
    ("heading", "pitch", "roll"), [(30.0, -88.0, 1.0), (200.0, -45.0, -3.0)], ids=["nadir", "tilted"]
)
def test_a_pose_is_solved_within_its_own_errors(heading: float, pitch: float, roll: float) -> None:
    pose = solve_pose(matches(heading, pitch, roll, 15.0), FOV, level_ground)
    assert isinstance(pose, CameraPose), pose
    off = np.array([pose.east, pose.north, pose.altitude, pose.heading, pose.pitch, pose.roll])
    off -= [*PLACE, heading, pitch, roll]
    assert np.abs(off[:3]).max() < 0.5
    assert np.abs(off[3:]).max() < 0.25
    assert (np.abs(off) < 4 * pose.sigmas + 0.01).all()
    assert pose.height == pytest.approx(pose.altitude)
    assert pose.inliers > 270


def test_on_flat_ground_a_tilt_that_nothing_tells_has_to_be_proven() -> None:
    nadir, tilted = matches(30.0, -90.0, 0.0, 0.0), matches(30.0, -70.0, 0.0, 0.0)
    corners = np.array([(0, 0), (639, 0), (639, 479), (0, 479)], np.float32)
    turned = PLACE + rays(30.0, -90.0, 0.0, corners.astype(np.float64)) * PLACE[2]
    similarity = cv2.getPerspectiveTransform(corners, turned[:, :2].astype(np.float32))
    plain = replace(nadir, plane=np.asarray(similarity, np.float64), plane_parameters=4)
    answer = solve_pose(plain, FOV, None, proven=True)
    assert answer == "On flat ground the matches do not show how far the camera was tilted, so there is no pose."
    assert isinstance(solve_pose(tilted, FOV, None, proven=True), CameraPose)


FEW = replace(matches(30.0, -80.0, 0.0, 15.0), pixels=np.zeros((8, 2)), points=np.zeros((8, 3)))


@pytest.mark.parametrize(
    ("given", "fov", "flat", "reason"),
    [
        (matches(30.0, -80.0, 0.0, 15.0, false=395), FOV, False, ""),
        (FEW, FOV, False, "Too few matches have a height for a pose of the camera."),
        # With another field of view than the photo's, the plane explains flat ground, and the camera does not.
        (matches(200.0, -50.0, 0.0, 0.0), 30.0, True, "as on a plane"),
    ],
    ids=["by chance", "few", "as on a plane"],
)
def test_matches_without_a_pose(given: PoseMatches, fov: float, flat: bool, reason: str) -> None:
    answer = solve_pose(given, fov, None if flat else level_ground)
    assert isinstance(answer, str)
    assert reason in answer


def test_a_tilted_photo_is_levelled_and_one_that_an_aircraft_tells_is_not() -> None:
    frame = Frame("a", Path("a"), *SIZE, heading=0.0, heading_source="gimbal", pitch=-50.0, roll=0.0, fov=FOV)
    photo = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    photo[:, SIZE[0] // 2 :] = 255
    levelled = level(photo, frame)
    rows, columns = levelled.valid.shape
    # The middle stays, and the picture's left and right.
    assert levelled.picture[rows // 2, columns // 2 - 5].max() == 0
    assert levelled.picture[rows // 2, columns // 2 + 5].min() == 255
    assert 0.4 < levelled.valid.mean() < 0.95
    for other in (replace(frame, pitch=-85.0), replace(frame, heading_source="aircraft")):
        assert level(photo, other).picture is photo


def relief(x: Float64Array, y: Float64Array) -> Float64Array:
    """Hills of up to 20 m."""
    return np.asarray(210 + 10 * np.sin(x / 17 + 1) * np.cos(y / 23))


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Map:
    """The drawn map with hills."""
    folder = tmp_path_factory.mktemp("relief")
    plain = write_map(folder / "ortho.tif", land())
    plain.close()
    at = CORNER[0] + np.arange(0, SIDE * RESOLUTION, 2.0) + 1
    heights = relief(*np.meshgrid(at, -at)).astype(np.float32)
    matrix = (2, 0, 500_000 + CORNER[0], 0, -2, 5_200_000 + CORNER[1])
    write_geotiff(folder / "dsm.tif", heights[..., None], matrix=matrix)
    build_map([folder / "ortho.tif"], folder / "map", elevation=ElevationFile(folder / "dsm.tif"))
    return open_map(folder / "map")


def photographed(heading: float, pitch: float, place: Float64Array, lens: Lens | None = None) -> UInt8Array:
    """A photo of the drawn map over its hills: each ray is followed to the ground."""
    pixels = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=-1).reshape(-1, 2).astype(np.float64)
    if lens is not None:
        focal, (x, y) = lens.focal_x * SIZE[0], middle_pixel(*SIZE)
        camera = np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]])
        pixels = np.asarray(cv2.undistortPoints(pixels[:, None], camera, lens.coefficients, P=camera)[:, 0], np.float64)
    along = rays(heading, pitch, 0.0, pixels)
    ground = np.full(len(pixels), 210.0)
    for _ in range(15):
        points = place[:2] + along[:, :2] * ((ground - place[2]) / along[:, 2])[:, None]
        ground = relief(*points.T)
    column, row = (points[:, 0] - CORNER[0]) / RESOLUTION - 0.5, (CORNER[1] - points[:, 1]) / RESOLUTION - 0.5
    columns, rows = (values.reshape(SIZE[::-1]).astype(np.float32) for values in (column, row))
    return np.asarray(cv2.remap(land(), columns, rows, cv2.INTER_CUBIC), np.uint8)


@pytest.mark.parametrize(("pitch", "lens"), [(-86.0, None), (-55.0, None), (-84.0, LENS)])
def test_a_photo_of_hills_has_the_pose_that_it_was_taken_from(
    town: Map, tmp_path: Path, pitch: float, lens: Lens | None
) -> None:
    place, heading = np.array([5.0, -12.0, 290.0]), 25.0
    photo = tmp_path / "photos" / "a.png"
    photo.parent.mkdir()
    cv2.imwrite(str(photo), photographed(heading, pitch, place, lens)[..., ::-1])
    latitude, longitude = town.frame.degrees(place[None, :2])[0].tolist()
    frame = Frame(
        "a.png", photo, *SIZE, 0.0, latitude, longitude, 80.0, heading=heading + 3, heading_source="gimbal",
        pitch=pitch + 1, roll=0.0, fov=FOV, lens=lens,
    )  # fmt: skip
    located = locate(town, Flight("hills", (frame,)), None, LocateOptions(matcher="sift"))
    answer = located.frames[0].stages["registration"]
    assert answer.accepted, answer.sentence
    pose = answer.pose
    assert pose is not None, answer.sentence
    assert (answer.x, answer.y) == (pose.east, pose.north)
    assert "above the datum" in answer.sentence
    assert np.linalg.norm(np.array([pose.east, pose.north, pose.altitude]) - place) < 1.0
    assert pose.heading == pytest.approx(heading, abs=0.3)
    assert pose.pitch == pytest.approx(pitch, abs=0.5)
    assert pose.height == pytest.approx(place[2] - relief(*place[:2]), abs=1.0)
    point = full_track(located)[0]
    told = (point["pose_yaw_deg"], point["pose_altitude_m"], point["pose_sigma_up_m"])
    assert told == (pose.heading, pose.altitude, pose.sigmas[2])
