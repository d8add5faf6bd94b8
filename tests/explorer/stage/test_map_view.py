"""The map on the stage, drawn into a stand-in of viser's scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace as replace_record

from explorer.compute.background_jobs import BackgroundJob
from explorer.opening import open_model
from explorer.session_state import SessionState
from explorer.stage.camera import MAP_CENTRE
from explorer.stage.lettering import Lettering
from explorer.stage.map_view import Eye, GalleryMap
from explorer.workspace import StateAnalyser, Workspace
from lpn.drawing import theme
from lpn.flights import Frame
from lpn.library.analyser import OwnPicture
from lpn.locate.camera_pose import CameraPose
from lpn.locate.located import LocatedFrame, StageRecord
from lpn.locate.own_photo import OwnPhoto
from lpn.maps import LocalFrame
from tools.fixtures import small_worlds

TASK = "drone-to-satellite"


class Scene:
    lines: SimpleNamespace
    flight: SimpleNamespace
    frame: SimpleNamespace
    click: Any

    def __init__(self) -> None:
        self.tiles: list[SimpleNamespace] = []
        self.sign: list[SimpleNamespace] = []

    def add_image(self, name: str, *_: Any, **__: Any) -> SimpleNamespace:
        image = SimpleNamespace(visible=True, on_click=lambda _: None)
        if name.startswith("/map/tile") and name != "/map/tile":
            self.tiles.append(image)
        elif name in ("/map/query", "/map/caption", "/map/tile"):
            self.sign.append(image)
        return image

    def add_line_segments(self, name: str, *_: Any, **__: Any) -> SimpleNamespace:
        drawn = SimpleNamespace(visible=True)
        setattr(self, name.removeprefix("/map/"), drawn)
        return drawn

    def add_label(self, *_: Any, **__: Any) -> SimpleNamespace:
        self.here = SimpleNamespace(visible=True)
        return self.here

    def add_camera_frustum(self, *_: Any, **__: Any) -> SimpleNamespace:
        self.camera = SimpleNamespace(visible=True, on_click=lambda function: setattr(self, "click", function))
        return self.camera


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory, model_file: Path) -> Workspace:
    root = tmp_path_factory.mktemp("map") / "places"
    opened = open_model(small_worlds.map_dataset(small_worlds.make_dataset(root, train=1, test=6)), model_file)
    opened.mosaic(opened.tasks[TASK])  # the stand-ins of maps below have no pictures to draw it from
    return opened


def test_the_light_of_a_city_is_sent_with_the_city(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    geometry = workspace.tasks[TASK].geometry
    assert geometry is not None
    monkeypatch.setattr(workspace, "city", SimpleNamespace(data=b"", origin=geometry.origin, top=20.0))
    lights: list[str] = []
    scene: Any = Scene()
    scene.configure_environment_map = lights.append
    scene.add_glb = lambda *_, **__: SimpleNamespace(visible=True)
    shown = GalleryMap(SimpleNamespace(scene=scene), workspace, 6, lambda *_: None)  # type: ignore[arg-type]
    sent = []
    for city in (False, True, True):
        analysis = StateAnalyser(workspace).analyse(SessionState(TASK, 4, map=True, city=city), 6)
        shown.show(analysis, Lettering(24, 100.0))
        sent.append(list(lights))
    assert sent == [[], ["city"], ["city"]]


@pytest.mark.parametrize(("far", "lines"), [(0.0, 5), (1.0, 0)])
def test_the_tag_of_one_s_own_picture_is_marked_and_joined_with_the_tile_if_it_is_near(
    workspace: Workspace, far: float, lines: int
) -> None:
    task = workspace.tasks[TASK]
    assert task.geometry is not None
    place = task.geometry.tiles[2]
    picture = workspace.load_picture(task.queries[0])
    own = OwnPicture("own.jpg", picture, (place.latitude + far, place.longitude))
    scene = Scene()
    gallery_map = GalleryMap(SimpleNamespace(scene=scene), workspace, 6, lambda *_: None)  # type: ignore[arg-type]
    state = SessionState(TASK, 4, upload=own, map=True)
    gallery_map.show(StateAnalyser(workspace).analyse(state, 6), Lettering(24, 100.0))
    assert scene.lines.visible is (lines > 0)
    if lines:
        assert scene.lines.points.shape == (lines, 2, 3)
        middle = scene.lines.points[:4].mean(axis=(0, 1))
        np.testing.assert_allclose(scene.lines.points[4, 0], middle, atol=1e-5)


@pytest.mark.parametrize(("graded", "colour"), [(True, theme.TRUE_COLOUR), (False, theme.UNKNOWN_COLOUR)])
def test_the_frame_of_the_positive_has_the_colour_of_its_grade(
    workspace: Workspace, graded: bool, colour: theme.Colour
) -> None:
    analysis = StateAnalyser(workspace).analyse(SessionState(TASK, 4, map=True), 6)
    assert analysis.positive is not None
    if not graded:
        analysis = replace(analysis, positive=replace(analysis.positive, true=None))
    scene = Scene()
    gallery_map = GalleryMap(SimpleNamespace(scene=scene), workspace, 6, lambda *_: None)  # type: ignore[arg-type]
    gallery_map.show(analysis, Lettering(24, 100.0))
    assert {tuple(end) for end in scene.lines.colors[:4].reshape(-1, 3).tolist()} == {colour}


def test_the_ground_shows_a_tile_as_it_is_where_the_model_unrolls_it(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = workspace.tasks[TASK]
    assert workspace.ground_picture(task, 1) is workspace.card(task, 1)
    monkeypatch.setattr(type(workspace.contract), "unrolled", lambda *_: True)
    np.testing.assert_array_equal(workspace.ground_picture(task, 1), task.gallery[1].load())


def test_a_registered_frame_stands_at_its_pose_and_a_click_looks_through_it(workspace: Workspace) -> None:
    task = workspace.tasks[TASK]
    assert task.geometry is not None
    pose = CameraPose(30.0, 40.0, 150.0, 100.0, 90.0, -60.0, 0.0, 70.0, "told", True, 50, np.eye(6).ravel().tolist())
    frame = Frame("a", task.queries[4].path, 400, 300)
    located = LocatedFrame(frame, None, {"registration": StageRecord("accepted", "", 30.0, 40.0, True, pose=pose)})
    other = LocatedFrame(frame, None, {"registration": StageRecord("refused", "", pose=pose)})
    origin = task.geometry.origin
    basemap = SimpleNamespace(frame=LocalFrame(origin.latitude, origin.longitude))
    workspace.flight = SimpleNamespace(frames=[other] * 4 + [located])  # type: ignore[assignment]
    workspace.basemap = basemap  # type: ignore[assignment]
    looked: list[Eye] = []
    scene = Scene()
    try:
        shown = GalleryMap(SimpleNamespace(scene=scene), workspace, 6, lambda *_: None, looked.append)  # type: ignore[arg-type]
        analyse = StateAnalyser(workspace).analyse
        shown.show(analyse(SessionState(TASK, 4, query=4, map=True), 6), Lettering(24, 100.0))
        scene.click(None)
        upright = scene.camera.fov
        ground = shown.ground(task.geometry)
        photo = shown.view_of(looked[0])
        assert str(photo["source"]).startswith("data:image/jpeg")
        assert photo["aspect"] == pytest.approx(4 / 3)
        shown.bare()
        assert not scene.lines.visible
        assert not scene.camera.visible
        shown.show_photo()
        assert (scene.camera.visible, scene.lines.visible) == (True, True)
        shown.show(analyse(SessionState(TASK, 4, map=True), 6), Lettering(24, 100.0))
        assert shown.eye is None
    finally:
        workspace.flight = workspace.basemap = None
    (eye,) = looked
    metres = (eye.position - [*ground["middle"], MAP_CENTRE[2]]) * ground["metres"]  # type: ignore[misc, operator]
    np.testing.assert_allclose(metres, [30.0, 40.0, 150.0], rtol=0.01)
    # The camera looks east and 60 degrees down.
    np.testing.assert_allclose(eye.forward, [0.5, 0, -np.sqrt(0.75)], atol=1e-9)
    np.testing.assert_allclose(eye.up, [np.sqrt(0.75), 0, 0.5], atol=1e-9)
    assert (eye.across, eye.aspect) == pytest.approx((np.tan(np.radians(35)), 4 / 3))
    assert upright == pytest.approx(2 * np.arctan(eye.across * 3 / 4))


def test_the_photo_in_a_frustum_hangs_above_the_ground(workspace: Workspace) -> None:
    task = workspace.tasks[TASK]
    assert task.geometry is not None
    origin = task.geometry.origin
    scene, scales = Scene(), []
    try:
        workspace.basemap = SimpleNamespace(frame=LocalFrame(origin.latitude, origin.longitude))  # type: ignore[assignment]
        for height in (5.0, 10.0, 5000.0):
            pose = CameraPose(
                30.0, 40.0, 150.0, height, 90.0, -90.0, 0.0, 70.0, "told", True, 50, np.eye(6).ravel().tolist()
            )
            answer = StageRecord("accepted", "", 30.0, 40.0, True, pose=pose)
            located = LocatedFrame(Frame("a", task.queries[4].path, 400, 300), None, {"registration": answer})
            workspace.flight = SimpleNamespace(frames=[located] * 5)  # type: ignore[assignment]
            shown = GalleryMap(SimpleNamespace(scene=scene), workspace, 6, lambda *_: None)  # type: ignore[arg-type]
            viewpoint = shown.show(
                StateAnalyser(workspace).analyse(SessionState(TASK, 4, query=4, map=True), 6), Lettering(24, 100.0)
            )
            scales.append(scene.camera.scale)
    finally:
        workspace.flight = workspace.basemap = None
    half_height = np.tan(scene.camera.fov / 2)
    metres = 3 ** (1 / 3) * scales[0] / (half_height**2 * 4 / 3) ** (1 / 3) * shown.ground(task.geometry)["metres"]
    assert metres == pytest.approx(3.0), "three fifths of the way down"
    assert scales[1:] == [pytest.approx(2 * scales[0]), 0.5 * viewpoint.scale]


@pytest.mark.parametrize(("posed", "plain"), [(True, False), (False, True)])
def test_the_ground_of_an_own_picture_that_is_registered_is_framed_and_its_camera_stands_there(
    workspace: Workspace, posed: bool, plain: bool
) -> None:
    task = workspace.tasks[TASK]
    assert task.geometry is not None
    pose = CameraPose(30.0, 40.0, 150.0, 100.0, 90.0, -60.0, 0.0, 70.0, "told", True, 50, np.eye(6).ravel().tolist())
    # A pixel is half a metre of ground, and the photo's middle lies 30 m east and 40 m north.
    homography = [0.5, 0, 30.0 - 0.25 * 399, 0, -0.5, 40.0 + 0.25 * 299, 0, 0, 1]
    answer = StageRecord("accepted", "", 30.0, 40.0, homography=homography, pose=pose if posed else None)
    located = LocatedFrame(Frame("own.jpg", Path("own.jpg"), 400, 300), None, {"registration": answer})
    job: BackgroundJob[OwnPhoto] = BackgroundJob(lambda _: OwnPhoto(located, True), None)
    assert job.wait(60)
    own = OwnPicture("own.jpg", np.full((300, 400, 3), 90, np.uint8))
    origin, scene = task.geometry.origin, Scene()
    workspace.basemap = SimpleNamespace(frame=LocalFrame(origin.latitude, origin.longitude))  # type: ignore[assignment]
    try:
        shown = GalleryMap(SimpleNamespace(scene=scene), workspace, 6, lambda *_: None)  # type: ignore[arg-type]
        analysis = StateAnalyser(workspace).analyse(SessionState(TASK, 4, upload=own, map=True, plain=plain), 6)
        shown.show(replace(analysis, own_photo=job), Lettering(24, 100.0))
        ground = shown.ground(task.geometry)
    finally:
        workspace.basemap = None
    framed, joined = (
        (lines.points - [*ground["middle"], MAP_CENTRE[2]]) * ground["metres"]  # type: ignore[misc]
        for lines in (scene.frame, scene.lines)
    )
    frame = [(-70, 115), (130, 115), (130, -35), (-70, -35)]
    np.testing.assert_allclose(framed[:, 0, :2], frame, rtol=0.01, atol=0.5)
    assert (scene.here.visible, scene.here.text) == (True, "your picture")
    (line,) = joined
    np.testing.assert_allclose(line[0, :2], (30, 40), rtol=0.01, atol=0.5)
    assert scene.camera.visible is posed
    if posed:
        assert scene.camera.image.shape == (300, 400, 3)
        assert line[0, 2] == pytest.approx(150.0, rel=0.01)
    assert sum(tile.visible for tile in scene.tiles) == (1 if plain else 6)


def test_the_other_cameras_of_a_flight_and_the_ground_of_their_photos_are_lines_of_one_mesh(
    workspace: Workspace,
) -> None:
    task = workspace.tasks[TASK]
    assert task.geometry is not None
    pose = CameraPose(30.0, 40.0, 150.0, 100.0, 90.0, -60.0, 0.0, 70.0, "told", True, 50, np.eye(6).ravel().tolist())
    homography = [0.5, 0, 30.0 - 0.25 * 399, 0, -0.5, 40.0 + 0.25 * 299, 0, 0, 1]
    frame = Frame("a", task.queries[4].path, 400, 300)
    answer = StageRecord("accepted", "", 30.0, 40.0, True, homography=homography, pose=pose)
    located = LocatedFrame(frame, None, {"registration": answer})
    refused = LocatedFrame(frame, None, {"registration": replace_record(answer, state="refused")})
    basemap = SimpleNamespace(
        frame=LocalFrame(task.geometry.origin.latitude, task.geometry.origin.longitude), elevation=None
    )
    workspace.flight = SimpleNamespace(frames=[located] * 3 + [refused] * 2)  # type: ignore[assignment]
    workspace.basemap = basemap  # type: ignore[assignment]
    scene = Scene()
    try:
        shown = GalleryMap(SimpleNamespace(scene=scene), workspace, 6, lambda *_: None)  # type: ignore[arg-type]
        state = SessionState(TASK, 4, map=True)
        analysis = StateAnalyser(workspace).analyse(state, 6)
        shown.show(analysis, Lettering(24, 100.0))
        # Each of the two other registered cameras has 8 edges, and its ground has 4 sides of 6 pieces.
        assert scene.flight.visible
        assert scene.flight.points.shape == (2 * (8 + 24), 2, 3)
        assert scene.flight.colors.shape == scene.flight.points.shape
        planes = [*scene.tiles, *scene.sign]
        assert len(scene.sign) == 3
        shown.bare()
        assert not any([scene.flight.visible, scene.camera.visible, *(plane.visible for plane in planes)])
        shown.show_photo()
        assert all([scene.flight.visible, scene.camera.visible, *(plane.visible for plane in planes)])
        shown.bare()
        shown.show(analysis, Lettering(24, 100.0))
        assert all(plane.visible for plane in planes), "a photo without a pose is not looked through"
        shown.show(replace(analysis, state=replace(state, cameras=False)), Lettering(24, 100.0))
        assert not scene.flight.visible
    finally:
        workspace.flight = workspace.basemap = None
