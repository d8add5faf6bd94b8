"""One tab's scene: the city with the photo's camera and the ranked tiles, or the rings of photo and tile apart."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import viser
import viser.transforms as tf

from explorer.screen.result import ScreenResult
from explorer.screen.scene import city, plan, shapes
from lpn.core.arrays import Float64Array, UInt8Array
from lpn.core.numbers import rounded_to_sum
from lpn.drawing.theme import Colour
from lpn.tasks.gallery_geometry import GalleryGeometry

# Vertical field of view of the rings in radians; they are seen from far away.
_APART_FOV = math.radians(16)
# Side of the scene's pictures in pixels; the height of a stack of rings, and its turn.
_PIXELS, _TALL, _TURN = 256, 2.3, math.radians(33)


class Scene:
    """Draws results in one tab's frame.

    Attributes:
        client: viser's client, whose page is in the frame.
        nodes: the handles of the newest result's nodes, by their names.
    """

    def __init__(self, client: viser.ClientHandle) -> None:
        self.client = self._client = client
        self.nodes: dict[str, Any] = {}
        self._city = client.scene.add_frame("/city", show_axes=False)
        self._apart = client.scene.add_frame("/apart", show_axes=False, visible=False)
        self._task: object = None
        self._buildings: viser.SceneNodeHandle | None = None
        # Targets of the pointer: in the city, the gallery position, middle, and half side of tiles; else the layers.
        self._tiles: list[tuple[int, Float64Array, float]] = []
        self._layers: list[tuple[float, float, float]] = []
        self._apart_by = 0.0
        client.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        client.gui.main_panel.dock_right()
        client.gui.main_panel.set_width(240)
        # Viser's notice of software WebGL would cover the scene. No other CSS class of viser's page is used.
        client.gui.add_html("<style>.mantine-Notifications-root{display:none!important}</style>")
        client.scene.add_light_hemisphere(
            "/city/sky", sky_color=(215, 228, 255), ground_color=(120, 110, 100), intensity=2.2
        )

    def show(self, result: ScreenResult, lines: Sequence[tuple[Float64Array, Colour]] = ()) -> None:
        """Draw a result in place of the last one, in the state's view and theme, with further lines over the city."""
        dark = result.state.theme == "dark"
        places = result.task.geometry
        halves = _halves(result)
        of_city = places is not None and (result.state.view == "city" or halves is None)
        with self._client.atomic():
            for node in reversed(list(self.nodes.values())):  # children first
                node.remove()
            self.nodes, self._tiles, self._layers = {}, [], []
            self._city.visible, self._apart.visible = of_city, not of_city
            self._client.scene.set_background_image(_background(dark), format="png")
            if of_city and places is not None:
                self._show_city(result, places, dark)
                for number, (segments, colour) in enumerate(lines):
                    self._lines(f"/city/lines{number}", segments, colour, 1.5)
            elif halves is not None:
                self._show_apart(result, halves, dark)
        self._client.flush()

    def hover(self, part: int | None) -> None:
        """Show one part alone among the layers; None shows all."""
        with self._client.atomic():
            for name, node in self.nodes.items():
                if name.startswith("/apart/") and name.count("/") == 3:
                    node.visible = part is None or name.endswith(f"/{part}")

    def pick(self, x: float, y: float) -> dict[str, int] | None:
        """Return the tile or the part at a place of the frame, in shares of its sides; None for neither."""
        camera = self._client.camera
        axes, origin = np.asarray(tf.SO3(camera.wxyz).as_matrix(), np.float64), np.asarray(camera.position)
        direction = shapes.ray(axes, camera.fov, camera.aspect, x, y)
        for index, middle, half in self._tiles:
            hit = shapes.on_level(origin, direction, city.LIFT)
            if hit is not None and np.abs(hit[:2] - middle).max() <= half:
                return {"tile": index}
        for part, (z, half, hole) in sorted(enumerate(self._layers), key=lambda layer: -layer[1][0]):
            hit = shapes.on_level(origin, direction, z)
            for side in (-self._apart_by, self._apart_by):
                if hit is None:
                    continue
                off = np.array([hit[0] - side, hit[1]])
                turned = tf.SO2.from_radians(-_TURN).apply(off)
                if hole <= np.abs(turned).max() <= half:
                    return {"part": part}
        return None

    # The city.

    def _show_city(self, result: ScreenResult, places: GalleryGeometry, dark: bool) -> None:
        if self._task is not result.task:
            self._task = result.task
            self._build_city(result, places)
        laid = city.lay(result, places, self._client.camera.aspect, dark)
        if laid.photo is not None:
            self._show_photo(result, laid.photo, dark)
        for name, lines in laid.lines.items():
            self._lines(f"/city/{name}", lines.segments, lines.colour, lines.thickness)
        for name, badge in laid.badges.items():
            self._image(f"/city/{name}", badge.pixels, badge.size, badge.middle, laid.axes)
        if laid.metres is not None:
            text, place = laid.metres
            self.nodes["/city/metres"] = self._client.scene.add_label(
                "/city/metres", text, position=place, anchor="bottom-center"
            )
        self._tiles = laid.tiles
        self._look(laid.position, laid.target, city.FOV, 0.5, 6000.0)

    def _build_city(self, result: ScreenResult, places: GalleryGeometry) -> None:
        """Draw the ground, and the buildings if there is a plan, once for each task."""
        scene, workspace = self._client.scene, result.workspace
        west, south, east, north = places.bounds()
        mosaic = workspace.mosaic(result.task)
        scene.add_image(
            "/city/ground",
            (mosaic * 0.78).astype(np.uint8),
            east - west,
            north - south,
            position=((west + east) / 2, (south + north) / 2, -0.5),
            wxyz=(0, 1, 0, 0),
            format="jpeg",
            jpeg_quality=85,
            cast_shadow=False,
            receive_shadow=False,
        )
        if self._buildings is not None:
            self._buildings.remove()
            self._buildings = None
        found = plan.buildings(workspace.root, places.origin)
        if found is not None:
            self._buildings = scene.add_mesh_simple(
                "/city/buildings",
                *found,
                color=(140, 152, 166),
                flat_shading=True,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )

    def _show_photo(self, result: ScreenResult, photo: city.PhotoCamera, dark: bool) -> None:
        """Show the drone's camera with its photo."""
        self.nodes["/city/camera"] = self._client.scene.add_camera_frustum(
            "/city/camera",
            fov=photo.fov,
            aspect=1.0,
            scale=city.DEPTH,
            thickness=1.5,
            thickness_units="screen",
            color=shapes.INK[dark],
            image=shapes.square(result.analysis.query.picture, _PIXELS),
            format="jpeg",
            jpeg_quality=85,
            position=photo.place,
            wxyz=tf.SO3.from_matrix(photo.axes).wxyz,
            cast_shadow=False,
            receive_shadow=False,
        )

    # The rings apart.

    def _show_apart(self, result: ScreenResult, halves: list[float], dark: bool) -> None:
        compared, count = result.compared, len(halves)
        order = sorted(range(count), key=lambda part: halves[part])
        step = _TALL / max(count - 1, 1)
        aspect = self._client.camera.aspect
        self._apart_by = beside = min(1.3 + 0.65 * aspect, 3.1)  # a narrow frame has less room
        tile = result.described(result.first)
        quarter = result.quarter(result.first)
        workspace, task = result.workspace, result.task
        pictures = [
            _prepared(workspace.as_partitioned(one.picture, view), one.activation, dark, turns)
            for one, view, turns in ((result.analysis.query, task.query_view, 0), (tile, task.gallery_view, quarter))
        ]
        turn = tf.SO3.from_z_radians(_TURN)
        level = turn @ tf.SO3.from_matrix(np.diag([1.0, -1.0, -1.0]))
        self._layers = [(0.0, 0.0, 0.0)] * count
        shares = rounded_to_sum(result.first.contributions.tolist(), total=result.first.distance2)
        for place, part in enumerate(order):
            half, hole, z = halves[part], halves[order[place - 1]] if place else 0.0, (count - 1 - place) * step
            self._layers[part] = z, half, hole
            colour = shapes.SOFT[dark] if count == 1 else shapes.PARTS[dark][part % 4]
            for side, picture in zip((-beside, beside), pictures, strict=True):
                name = f"/apart/{'photo' if side < 0 else 'tile'}/{part}"
                self.nodes[name] = self._client.scene.add_frame(
                    name, show_axes=False, position=(side, 0, z), wxyz=level.wxyz
                )
                for number, (pixels, wide, high, x, y) in enumerate(shapes.strips(picture, half, hole)):
                    self._image(f"{name}/{number}", pixels, (wide, high), np.array([x, y, 0.0]), None)
                self._lines(f"{name}/outer", shapes.rectangle((0, 0), half, -0.004), colour, 2)
            corner = turn.apply(np.array([half, -half, 0.0]))
            begin, end = np.array([corner[0] - beside, corner[1], z]), np.array([beside - corner[0], corner[1], z])
            rival = None if compared is None else float(compared.contributions[part])
            length = float(end[0] - begin[0])
            text = f"{part + 1}   {shares[part]:.3f}" if count > 1 else f"{shares[part]:.3f}"
            drawn, high = shapes.ribbon(length, shares[part], rival, text, colour, shapes.SOFT[dark])
            upright = np.stack([np.array([1.0, 0, 0]), np.array([0, 0, -1.0]), np.array([0, 1.0, 0])], axis=1)
            self._image(f"/apart/ribbon/{part}", drawn, (length, high), (begin + end) / 2, upright)
        axes = shapes.camera_axes(0.0, -26.0)
        reach = beside + math.sqrt(2) * max(halves)
        points = np.array([(x, y, z) for x in (-reach, reach) for y in (-1.2, 1.2) for z in (-0.1, _TALL)])
        position, target = shapes.fitting(points, axes, _APART_FOV, aspect, 0.96)
        self._look(position, target, _APART_FOV, 0.1, 200.0)

    # Nodes.

    def _lines(self, name: str, segments: Any, colour: Colour, thickness: float) -> None:
        self.nodes[name] = self._client.scene.add_line_segments(
            name, segments, colour, thickness=thickness, thickness_units="screen"
        )

    def _image(
        self,
        name: str,
        pixels: UInt8Array,
        size: tuple[float, float],
        position: Float64Array,
        axes: Float64Array | None,
    ) -> None:
        """Show a picture whose right and down directions are the first two columns of `axes`, (3, 3)."""
        opaque = pixels.shape[-1] == 3
        self.nodes[name] = self._client.scene.add_image(
            name,
            np.ascontiguousarray(pixels),
            *size,
            position=position,
            wxyz=(1, 0, 0, 0) if axes is None else tf.SO3.from_matrix(axes).wxyz,
            format="jpeg" if opaque else "png",
            jpeg_quality=88,
            cast_shadow=False,
            receive_shadow=False,
        )

    def _look(self, position: Float64Array, target: Float64Array, fov: float, near: float, far: float) -> None:
        camera = self._client.camera
        camera.up_direction = (0.0, 0.0, 1.0)
        camera.position, camera.look_at = position, target
        camera.fov, camera.near, camera.far = fov, near, far


def views_of(result: ScreenResult) -> list[str]:
    """Return the views of a result's scene: "city" if tiles have positions, "apart" if parts are square rings."""
    halves = _halves(result)
    apart = halves is not None and len(halves) > 1
    return ["city"] * (result.task.geometry is not None) + ["apart"] * apart


def _halves(result: ScreenResult) -> list[float] | None:
    """Return the half side of each ring; None if a view's parts are no square rings."""
    halves = None
    for view in result.task.views:
        areas = result.workspace.areas(view)
        halves = None if areas is None else shapes.half_sides(areas.outlines)
        if halves is None:
            return None
    return halves


def _prepared(picture: UInt8Array, activation: Any, dark: bool, quarter: int) -> UInt8Array:
    shown = shapes.heated(shapes.square(picture, _PIXELS), activation, dark)
    return np.ascontiguousarray(np.rot90(shown, quarter))


def _background(dark: bool) -> UInt8Array:
    """Return a gradient behind the scene; its lower end has the panel's colour."""
    low = np.array(shapes.GROUND[dark], float)
    high = np.minimum(low * (1.5 if dark else 1.0) + 6, 250)
    share = np.linspace(0, 1, 64)[:, None, None]
    return np.broadcast_to(high * (1 - share) + low * share, (64, 2, 3)).astype(np.uint8)
