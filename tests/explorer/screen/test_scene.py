"""The scene draws the result: its nodes, and hits of the pointer."""

from __future__ import annotations

import math
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import viser.transforms as tf

from explorer.screen.scene import city, plan, shapes
from explorer.screen.scene.scene import Scene, views_of
from explorer.workspace import Workspace
from lpn.datasets.geo import Position
from tests.explorer.screen.test_result import result_of


class Client:
    """A stand-in of viser's client that records the nodes that are in the page."""

    def __init__(self, aspect: float = 1.3) -> None:
        self.nodes: dict[str, Any] = {}
        self.scene, self.gui = (
            self,
            SimpleNamespace(
                configure_theme=lambda **_: None,
                add_html=lambda _: None,
                main_panel=SimpleNamespace(dock_right=lambda: None, set_width=lambda _: None),
            ),
        )
        self.camera = SimpleNamespace(aspect=aspect)

    @contextmanager
    def atomic(self) -> Any:
        yield

    def flush(self) -> None: ...

    def set_background_image(self, *_: Any, **__: Any) -> None: ...

    def __getattr__(self, kind: str) -> Any:
        assert kind.startswith("add_"), kind

        def add(name: str, *values: Any, **options: Any) -> Any:
            node = SimpleNamespace(visible=True, kind=kind, values=values, options=options)
            node.remove = lambda: self.nodes.pop(name)
            self.nodes[name] = node
            return node

        return add


def looking(client: Client, point: np.ndarray) -> tuple[float, float]:
    """Return where a point is seen in the picture of the client's camera."""
    camera = client.camera
    forward = np.asarray(camera.look_at) - np.asarray(camera.position)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, camera.up_direction)
    right = right / np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward], axis=1)
    camera.wxyz = tf.SO3.from_matrix(axes).wxyz
    x, y, z = axes.T @ (point - np.asarray(camera.position))
    across = math.tan(camera.fov / 2)
    return (x / z / across / camera.aspect + 1) / 2, (y / z / across + 1) / 2


def missed(workspace: Workspace) -> int:
    return int(np.argmax(workspace.rankings["drone-to-satellite"].ranks))


def test_the_city_has_the_tiles_of_the_result_and_shows_them(workspace: Workspace) -> None:
    client = Client()
    scene = Scene(client)
    result = result_of(workspace, query=missed(workspace))
    scene.show(result)
    places = result.task.geometry
    shown = {match.index for match in result.analysis.matches[:3]} | {result.analysis.positive.index}
    frames = {name for name, node in client.nodes.items() if node.kind == "add_line_segments" and "/tile" in name}
    assert frames == {f"/city/tile{index}" for index in shown}
    for index in shown:
        corners = client.nodes[f"/city/tile{index}"].values[0]
        assert np.allclose(corners[:, 0, :2].mean(axis=0), places.ground[index], atol=1e-3)
    colour = client.nodes[f"/city/tile{result.first.index}"].values[1]
    assert colour == shapes.WRONG[True]
    assert client.nodes["/city/metres"].values[0].endswith(" m")
    for index in (result.first.index, result.analysis.positive.index):
        x, y = looking(client, np.array([*places.ground[index], 3.0]))
        assert 0 < x < 1
        assert 0 < y < 1
        assert scene.pick(x, y) is not None
    x, y = looking(client, np.array([*places.ground[result.first.index], 3.0]))
    assert scene.pick(x, y) in [{"tile": index} for index in shown]


@pytest.mark.parametrize("query", range(8))
def test_badges_are_equally_large_and_none_lies_behind_the_photo(workspace: Workspace, query: int) -> None:
    result = result_of(workspace, query=query)
    places = result.task.geometry
    laid = city.lay(result, places, 1.3, dark=True)
    photo = laid.photo
    side = city.DEPTH * math.tan(photo.fov / 2)
    corners = [photo.place + photo.axes @ np.array([x, y, city.DEPTH]) for x in (-side, side) for y in (-side, side)]

    def seen(points: Any) -> Any:
        turned = (np.array(points) - laid.position) @ laid.axes
        return turned[:, :2] / turned[:, 2:], turned[:, 2]

    frame, _ = seen(corners)
    heights = []
    for badge in laid.badges.values():
        (middle,), (depth,) = seen([badge.middle])
        heights.append(badge.size[1] / depth)
        off = np.array(badge.size) / depth / 2
        assert ((middle + off <= frame.min(axis=0)) | (middle - off >= frame.max(axis=0))).any()
    assert np.allclose(heights, heights[0], rtol=0.15)
    signs = {match.index for match in result.analysis.matches[:3]} | {result.analysis.positive.index}
    assert set(laid.badges) == {f"tile{index}/rank" for index in signs}


def test_the_camera_sees_what_the_photo_shows(workspace: Workspace) -> None:
    client = Client()
    result = result_of(workspace, query=1)
    Scene(client).show(result)
    camera = client.nodes["/city/camera"].options
    places = result.task.geometry
    forward = tf.SO3(np.asarray(camera["wxyz"])).as_matrix()[:, 2]
    ground = shapes.on_level(np.asarray(camera["position"]), forward, 0.0)
    assert np.abs(ground[:2] - places.query_ground[1]).max() < 1.0, "the middle of the photo is its place"


def test_another_result_leaves_nothing_of_the_one_before(workspace: Workspace) -> None:
    client = Client()
    scene = Scene(client)
    scene.show(result_of(workspace, query=missed(workspace)), [(np.zeros((4, 2, 3)), (1, 2, 3))])
    assert client.nodes["/city/lines0"].values[1] == (1, 2, 3), "a panel's lines"
    apart = result_of(workspace, query=1, view="apart", theme="light")
    scene.show(apart)
    kept = {"/city", "/apart", "/city/sky", "/city/ground"}
    assert set(client.nodes) - set(scene.nodes) == kept
    assert not client.nodes["/city"].visible
    assert client.nodes["/apart"].visible


def test_the_rings_apart_have_ribbons_and_layers_of_each_part(workspace: Workspace) -> None:
    client = Client()
    scene = Scene(client)
    result = result_of(workspace, view="apart")
    assert views_of(result) == ["city", "apart"]
    scene.show(result)
    for part in range(4):
        assert f"/apart/ribbon/{part}" in client.nodes
        for side in ("photo", "tile"):
            layers = [name for name in client.nodes if name.startswith(f"/apart/{side}/{part}/") and name[-1].isdigit()]
            assert len(layers) == (1 if part == 0 else 4), "the centre has no hole"
    scene.hover(2)
    seen = {name for name, node in client.nodes.items() if name.startswith("/apart/ribbon") and node.visible}
    assert seen == {"/apart/ribbon/2"}
    scene.hover(None)
    assert all(node.visible for name, node in client.nodes.items() if name.startswith("/apart/"))
    z, half, hole = scene._layers[3]
    corner = tf.SO3.from_z_radians(math.radians(33)).apply(np.array([(half + hole) / 2, 0.0, 0.0]))
    assert scene.pick(*looking(client, corner + np.array([-scene._apart_by, 0.0, z]))) == {"part": 3}
    assert scene.pick(0.5, 0.02) is None


def test_a_ring_is_cut_into_strips_that_cover_it_once() -> None:
    picture = np.arange(64 * 64 * 3, dtype=np.uint8).reshape(64, 64, 3)
    covered = np.zeros((64, 64), int)
    for pixels, wide, high, x, y in shapes.strips(picture, 0.75, 0.5):
        top, left = round((y - high / 2 + 1) * 32), round((x - wide / 2 + 1) * 32)
        covered[top : top + len(pixels), left : left + pixels.shape[1]] += 1
        assert (picture[top : top + len(pixels), left : left + pixels.shape[1]] == pixels).all()
    ring = np.zeros((64, 64), int)
    ring[8:56, 8:56] = 1
    ring[16:48, 16:48] = 0
    assert (covered == ring).all()


@pytest.mark.parametrize("clockwise", [False, True])
def test_a_building_is_closed_by_walls_and_a_roof_of_its_area(clockwise: bool) -> None:
    outline = np.array([(0, 0), (10, 0), (10, 4), (4, 4), (4, 10), (0, 10)], float)
    vertices, faces = shapes.extruded([outline[::-1] if clockwise else outline], [2.0], [9.0])
    assert vertices[:, 2].max() == 11
    roof = [face for face in faces.tolist() if all(vertices[corner, 2] == 11 for corner in face)]
    corners = [vertices[face][:, :2] for face in roof]
    areas = [float(np.linalg.det(np.stack([c[1] - c[0], c[2] - c[0]]))) / 2 for c in corners]
    assert sum(areas) == pytest.approx(64)
    assert min(areas) >= -1e-9, "all look up"
    assert len(faces) == 2 * 6 + 4


def test_a_crossed_outline_ends() -> None:
    crossed = np.array([(0, 0), (10, 10), (10, 0), (0, 10), (5, 20)], float)
    assert len(shapes.extruded([crossed], [0.0], [5.0])[1]) == 2 * 5 + 3


def test_a_fitting_camera_sees_all_points() -> None:
    points = np.random.default_rng(3).normal(size=(20, 3)) * (300, 100, 40)
    axes = shapes.camera_axes(130.0, -40.0)
    position, target = shapes.fitting(points, axes, math.radians(38), 1.7, 0.9)
    seen = (points - position) @ axes
    across = math.tan(math.radians(19))
    assert (np.abs(seen[:, 1] / seen[:, 2]) <= 0.9 * across + 1e-9).all()
    assert (np.abs(seen[:, 0] / seen[:, 2]) <= 0.9 * across * 1.7 + 1e-9).all()
    assert np.allclose(np.cross(target - position, axes[:, 2]), 0, atol=1e-6)


def test_a_damaged_plan_is_left_out(tmp_path: Any, caplog: pytest.LogCaptureFixture) -> None:
    assert plan.buildings(tmp_path, Position(46, 7)) is None
    assert not caplog.records
    (tmp_path / "world.json").write_text('{"buildings": [{"x": 1}]}')
    assert plan.buildings(tmp_path, Position(46, 7)) is None
    assert "cannot be drawn" in caplog.text


def test_dashes_lie_on_their_line() -> None:
    drawn = shapes.dashes(np.zeros(3), np.array([10.0, 0, 0]), 3, 1)
    assert drawn[:, :, 0].tolist() == [[0, 3], [4, 7], [8, 10]]
    assert not drawn[:, :, 1:].any()
