"""The gallery as a map: the tiles at their positions, the query's camera, and the compared tile."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import viser

from explorer.session_state import SessionState
from explorer.stage.camera import MAP_CENTRE, SIDE, SIGN_CAPTION, SIGN_PICTURE, Viewpoint, oblique_view
from explorer.stage.flight_lines import LIFT, FlightLines
from explorer.stage.image_planes import Plane, Rotation, query_title, rank_title
from explorer.stage.lettering import LEAST, SIGN_PIXELS, Lettering, legible
from explorer.workspace import StateAnalysis, Workspace
from lpn.core import images
from lpn.core.arrays import AnyArray, Float64Array, FloatingArray, UInt8Array
from lpn.core.numbers import distance
from lpn.datasets import geo
from lpn.datasets.geo import Position
from lpn.datasets.rendered import shows_rendered
from lpn.drawing import captions, overlays, theme
from lpn.flights import Frame
from lpn.flights.cameras import rotation
from lpn.library.analyser import OwnPicture
from lpn.locate.belief import belief
from lpn.locate.camera_pose import CameraPose
from lpn.locate.coverage import crossing, outline
from lpn.locate.frustums import border
from lpn.locate.located import LocatedFrame
from lpn.tasks.gallery_geometry import GalleryGeometry

# Height of lines over the mosaic, in stage units.
_LINE_HEIGHT = 0.2
# Smallest side of a view of the city, in metres.
_MIN_VIEW = 520.0
# Width in pixels of other lines, and of the frame of a registered photo, which leads.
_THIN, _THICK = 3.0, 7.0
# Straight pieces of each side of that frame where it lies on a relief.
_PIECES = 40
# Half the width of the mark of a GPS tag, in stage units.
_TAG = 0.1
# The view includes the query's camera up to this distance from the compared tile, in metres.
_MAX_CAMERA_DISTANCE = 5000.0
# Depth of the query's frustum, as a share of the way down to the ground at most: its photo hangs above it.
_DEPTH = 0.6
# Longer side in pixels of the photo in the query's camera, and of the one that lies over the view through it.
_PHOTO, _LOOKED_AT = 512, 1280
# Two ends in stage units, (3,) each, and a colour.
_Segment = tuple[AnyArray, AnyArray, theme.Colour]
# Rotation from glTF (y is up) to the stage (z is up).
_Z_UP: Rotation = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)


class Eye(NamedTuple):
    """The query's camera on the stage.

    Attributes:
        position: in stage units, (3,).
        forward, up: unit vectors of the view's direction, and of the picture's top, (3,) each.
        across: tangent of half of the horizontal field of view.
        aspect: width of the picture over its height.
    """

    position: Float64Array
    forward: Float64Array
    up: Float64Array
    across: float
    aspect: float


class GalleryMap:
    """One browser's map.

    Args:
        slots: number of ranked tiles.
        on_select: called with the shown state and the gallery position of a clicked tile.
        on_look: called with where the query's camera stands, when it is clicked.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        workspace: Workspace,
        slots: int,
        on_select: Callable[[SessionState, int], None],
        on_look: Callable[[Eye], None] = lambda _: None,
    ) -> None:
        self._workspace = workspace
        self.eye: Eye | None = None
        self._framed = False
        # The ranked tiles that lie on the map, unless `bare` hides them.
        self._seen = [False] * slots
        self._photo: tuple[Path | OwnPicture, UInt8Array] | None = None
        self._analysis: StateAnalysis | None = None
        self._task = ""
        self._scale, self._middle = 1.0, np.zeros(2)
        self._most_scale = math.inf  # of the frustum
        self._scene = scene = client.scene
        self._city: viser.GlbHandle | None = None
        self._ground = Plane(scene, "/map/ground", 1.0, 1.0, _point(0, 0, 0))
        self._caption = Plane(scene, "/map/caption", SIGN_CAPTION, SIGN_PICTURE, _point(0, 0, 0))
        self._query = Plane(scene, "/map/query", SIGN_PICTURE, SIGN_PICTURE, _point(0, 0, 0))
        self._tile = Plane(scene, "/map/tile", SIGN_PICTURE, SIGN_PICTURE, _point(0, 0, 0))
        self._lines, self._frame = (
            scene.add_line_segments(
                f"/map/{name}",
                np.zeros((1, 2, 3), np.float32),
                np.zeros((1, 2, 3), np.uint8),
                thickness=thickness,
                thickness_units="screen",
            )
            for name, thickness in (("lines", _THIN), ("frame", _THICK))
        )
        self._flight = FlightLines(scene)
        self._here = scene.add_label("/map/here", "", anchor="bottom-center")
        self._tiles = [Plane(scene, f"/map/tile{slot}", 0.3, 0.3, _point(0, 0, 0), "png") for slot in range(slots)]
        for slot, tile in enumerate(self._tiles):
            tile.handle.on_click(self._clicked(slot, on_select))
        self._camera: viser.CameraFrustumHandle = scene.add_camera_frustum(
            "/map/camera",
            fov=0.7,
            aspect=1.0,
            scale=0.5,
            color=theme.UNKNOWN_COLOUR,
            visible=False,
            cast_shadow=False,
        )
        self._camera.on_click(lambda _: on_look(self.eye) if self.eye is not None else None)

    def show(self, analysis: StateAnalysis, lettering: Lettering) -> Viewpoint:
        """Draw an analysis whose task has positions, and return the view of it."""
        places = analysis.task.geometry
        assert places is not None
        self._analysis = analysis
        if self._task != analysis.task.name:
            self._set_scale(analysis, places)
        city = self._show_city(analysis, places)
        camera = self._show_camera(analysis, places)
        viewpoint = self._city_viewpoint(analysis, places, camera) if city else self._map_viewpoint(places)
        pixels = lettering.ground / viewpoint.scale
        model = self._workspace.city
        top = model.top * self._scale if city and model is not None else None
        self._show_tiles(analysis, places, city, 0.03 if top is None else top, pixels)
        self._show_lines(analysis, places, camera, city, _LINE_HEIGHT if top is None else top)
        self._lines.thickness = 5.0 if city else _THIN
        self._camera.scale = min(0.5 * viewpoint.scale, self._most_scale)
        self._show_flight(analysis, places, city)
        self._caption.show(self._draw_caption(analysis, lettering.sign))
        palette = analysis.state.palette
        self._camera.color = palette.text
        self._query.show(overlays.framed(overlays.square(analysis.query.picture, 256), palette.text, 4))
        colour = theme.verdict_colour(analysis.chosen.true)
        self._tile.show(overlays.framed(overlays.square(analysis.tile.picture, 256), colour, 6))
        self._show_sign(True)
        return viewpoint

    def bare(self) -> None:
        """Hide all but the ground: the query's camera and the others, tiles, lines, and the sign."""
        for tile in self._tiles:
            tile.handle.visible = False
        self._show_sign(False)
        self._camera.visible = self._lines.visible = self._frame.visible = self._here.visible = False
        self._flight.hide()

    def show_photo(self) -> None:
        """Show again what `bare` hides, if the pose of the query's camera is known."""
        if self.eye is not None:
            for tile, visible in zip(self._tiles, self._seen, strict=True):
                tile.handle.visible = visible
            self._show_sign(True)
            self._camera.visible = self._lines.visible = True
            self._frame.visible = self._here.visible = self._framed
            if self._analysis is not None and (places := self._analysis.task.geometry) is not None:
                self._show_flight(self._analysis, places, self._city is not None and self._city.visible)

    def view_of(self, eye: Eye) -> dict[str, object]:
        """Return the photo for a view through the query's camera, as JSON takes it: `source`, a data URI, and `aspect`."""
        assert self._analysis is not None
        own, located = self._analysis.state.upload, self._workspace.located(self._analysis)
        assert located is not None
        picture = images.load_picture(located.frame.file) if own is None else own.picture
        shown = located.frame.undistorted(images.shrink(picture, _LOOKED_AT))
        return {"source": overlays.data_uri(shown), "aspect": eye.aspect}

    def ground(self, places: GalleryGeometry) -> dict[str, object]:
        """Return what the page needs to measure on the ground, as JSON takes it.

        These are `through`, True if the view can look through the photo's camera; the `middle` of the positions' metres in stage
        units, (2,); the `metres` of a stage unit; and for latitude and longitude the `degrees` of that middle and of a metre; a
        rendered place, which is no real one, has none.
        """
        origin = places.origin
        steps = geo.metres_per_degree(origin.latitude)
        return {
            "through": self.eye is not None,
            "middle": self._to_stage(np.zeros(2), 0.0)[:2].tolist(),
            "metres": 1 / self._scale,
            "degrees": None
            if shows_rendered(self._workspace.root)
            else [[origin.latitude, 1 / steps[0]], [origin.longitude, 1 / steps[1]]],
        }

    def _set_scale(self, analysis: StateAnalysis, places: GalleryGeometry) -> None:
        west, south, east, north = places.bounds()
        self._scale = SIDE / max(east - west, north - south)
        self._middle = np.array([west + east, south + north]) / 2
        handle = self._ground.handle
        handle.render_width, handle.render_height = (east - west) * self._scale, (north - south) * self._scale
        self._task = analysis.task.name

    def _show_city(self, analysis: StateAnalysis, places: GalleryGeometry) -> bool:
        """Show the city, if it is chosen and available, or the mosaic of tiles; return True for the city."""
        model = self._workspace.city
        has_city = analysis.state.city and model is not None
        self._ground.handle.visible = not has_city
        if not has_city:
            self._ground.show(self._workspace.mosaic(analysis.task))
        if has_city and model is not None:
            if self._city is None:
                # It lights the walls that the default lights do not reach.
                self._scene.configure_environment_map("city")
                self._city = self._scene.add_glb(
                    "/map/city", model.data, wxyz=_Z_UP, cast_shadow=False, receive_shadow=False
                )
            self._city.scale = self._scale
            self._city.position = self._to_stage(geo.on_plane([model.origin], places.origin)[0], 0.0)
        if self._city is not None:
            self._city.visible = has_city
        return has_city

    def _map_viewpoint(self, places: GalleryGeometry) -> Viewpoint:
        _, south, _, north = places.bounds()
        return Viewpoint(depth=(north - south) * self._scale)

    def _city_viewpoint(
        self, analysis: StateAnalysis, places: GalleryGeometry, camera: Float64Array | None
    ) -> Viewpoint:
        """Return a view of the city with the camera, the compared tile, and the positive."""
        half = 0.6 * places.width
        tiles = [analysis.chosen.index, *([analysis.positive.index] if analysis.positive is not None else [])]
        around = [places.ground[tile] + np.array(off) * half for tile in tiles for off in ((-1, -1), (1, 1))]
        points = [self._to_stage(point, 0.0) for point in around]
        if camera is not None and float(np.abs(camera - points[0]).max()) < _MAX_CAMERA_DISTANCE * self._scale:
            points.append(camera)
        points = [point for point in points if np.isfinite(point).all()] or [self._to_stage(np.zeros(2), 0.0)]
        return oblique_view(np.array(points) - MAP_CENTRE, _MIN_VIEW * self._scale)

    def _show_sign(self, visible: bool) -> None:
        for plane in (self._query, self._caption, self._tile):
            plane.handle.visible = visible

    def put_sign(self, viewpoint: Viewpoint, aspect: float) -> None:
        """Arrange query, caption, and tile along the top of a view in a window of the given aspect."""
        edge = (SIDE - SIGN_PICTURE) / 2
        for plane, x, width in (
            (self._query, -edge, SIGN_PICTURE),
            (self._caption, 0.0, SIGN_CAPTION),
            (self._tile, edge, SIGN_PICTURE),
        ):
            plane.handle.render_width, plane.handle.render_height = (
                width * viewpoint.scale,
                SIGN_PICTURE * viewpoint.scale,
            )
            plane.handle.position = viewpoint.sign_position(x, aspect)
            plane.handle.wxyz = viewpoint.image_rotation

    def _to_stage(self, ground: Float64Array, up: float, lift: float = 0.0) -> Float64Array:
        """Convert a position (east, north) and a height in metres to stage units; `lift` is added to the height."""
        x, y = (ground - self._middle) * self._scale
        return np.asarray(MAP_CENTRE + np.array([x, y, up * self._scale + lift]), np.float64)

    def _tile_side(self, places: GalleryGeometry, index: int) -> float:
        """Return the side of a tile in stage units; windows of a map have several sizes."""
        return max((places.tiles[index].width or places.width) * self._scale, 0.12)

    def _show_tiles(
        self, analysis: StateAnalysis, places: GalleryGeometry, city: bool, lift: float, pixels: float
    ) -> None:
        """Draw the ranked tiles as pictures on the ground, or as frames above the roofs.

        Where the photo's details were compared with the map, their answer leads: in plain words the compared tile alone is
        drawn, as a thin frame.

        Args:
            pixels: CSS pixels of a stage unit.
        """
        examined = self._workspace.located(analysis)
        alone = (
            analysis.state.plain and examined is not None and (analysis.state.upload is not None or _placed(examined))
        )
        for slot, plane in enumerate(self._tiles):
            match = analysis.matches[slot] if slot < len(analysis.matches) else None
            # Tiles of an index may lack a position.
            plane.handle.visible = (
                match is not None
                and bool(np.isfinite(places.ground[match.index]).all())
                and (not alone or match.index == analysis.chosen.index)
            )
            self._seen[slot] = plane.handle.visible
            if match is None or not plane.handle.visible:
                continue
            colour = theme.verdict_colour(match.true)
            if city:
                chosen = match.index == analysis.chosen.index and not alone
                framed = overlays.outlined(160, colour, 7 if chosen else 4, 0.12 if chosen else 0.03)
            else:  # a clear picture would leave a hole in the ground, which is a picture itself
                picture = self._workspace.ground_picture(analysis.task, match.index)
                framed = overlays.framed(overlays.square(picture, 96), colour, 1 if alone else 5)
            side = self._tile_side(places, match.index)
            if side * pixels > 1.3 * LEAST and not alone:  # otherwise the number would not fit
                framed = captions.numbered(framed, match.rank, legible(30, framed.shape[0], side * pixels))
            plane.show(framed)
            plane.handle.render_width = plane.handle.render_height = side
            # Where tiles overlap, the highest ranked one lies on top.
            height = (0.001 if city else 0.012) * (len(self._tiles) - slot)
            plane.handle.position = self._to_stage(places.ground[match.index], 0.0, lift + height)

    def _show_camera(self, analysis: StateAnalysis, places: GalleryGeometry) -> Float64Array | None:
        """Show the frustum at the query's pose and return its position; None when the pose is not known.

        A registered photo stands where its pose has it, with its whole picture.
        """
        located = self._workspace.located(analysis)
        answer = None if located is None else located.stages.get("registration")
        if located is not None and answer is not None and answer.accepted and answer.pose is not None:
            return self._show_pose(answer.pose, located.frame, analysis, places)
        self.eye, self._most_scale = None, math.inf
        place = None if analysis.state.upload else places.queries[analysis.state.query]
        stands = None if place is None else geo.camera(place, places.origin)
        self._camera.visible = stands is not None
        if place is None or stands is None:
            return None
        at = self._to_stage(stands[:2], float(stands[2]))
        heading = math.radians(place.heading or 0.0)
        tilt = math.radians(-90.0 if place.tilt is None else place.tilt)
        ahead = np.array([math.sin(heading), math.cos(heading), 0.0])
        forward = math.cos(tilt) * ahead + np.array([0.0, 0.0, math.sin(tilt)])
        right = np.array([math.cos(heading), -math.sin(heading), 0.0])
        self._camera.fov = math.radians(place.fov or 40.0)
        self._camera.position = at
        self._camera.wxyz = _quaternion(np.stack([right, np.cross(forward, right), forward], axis=1))
        self._camera.aspect = 1.0
        self._camera.image = overlays.square(analysis.query.picture, 128)
        return at

    def _show_flight(self, analysis: StateAnalysis, places: GalleryGeometry, city: bool) -> None:
        """Show the cameras of the other photos of a flight, and the ground that they show."""
        workspace, state = self._workspace, analysis.state
        flight, basemap = workspace.flight, workspace.basemap
        if flight is None or basemap is None or not state.cameras:
            return self._flight.hide()
        chosen, relief = None if state.upload else state.query, city and basemap.elevation is not None
        to_stage = partial(self._from_altitudes, places)
        return self._flight.show(flight.frames, chosen, basemap, self._base, relief, to_stage)

    @property
    def _base(self) -> float:
        """The altitude in metres of the stage's ground."""
        return 0.0 if self._workspace.city is None else self._workspace.city.base

    def _from_altitudes(self, places: GalleryGeometry, points: Float64Array) -> Float64Array:
        """Convert metres in the map's frame and of altitude, (N, 3), to stage units."""
        ground = (self._from_map(points[:, :2], places) - self._middle) * self._scale
        lifted = (points[:, 2] - self._base) * self._scale
        return np.asarray(np.column_stack([ground, lifted]) + MAP_CENTRE, np.float64)

    def _from_map(self, points: FloatingArray, places: GalleryGeometry) -> Float64Array:
        """Convert metres in the map's frame, (K, 2), to those that the stage counts, (K, 2)."""
        basemap = self._workspace.basemap
        assert basemap is not None
        return geo.on_plane([Position(*degrees) for degrees in basemap.frame.degrees(points).tolist()], places.origin)

    def _show_pose(
        self, pose: CameraPose, frame: Frame, analysis: StateAnalysis, places: GalleryGeometry
    ) -> Float64Array:
        """Show the frustum of a photo's pose, and return its position."""
        model, own = self._workspace.city, analysis.state.upload
        base = model.base if model is not None and not pose.flat else 0.0
        at = self._to_stage(self._from_map(np.array([(pose.east, pose.north)]), places)[0], pose.altitude - base)
        # Columns of the camera's body, (north, east, down), become (east, north, up).
        top, right, forward = (rotation(pose.heading, pose.pitch, pose.roll)[[1, 0, 2]] * [[1], [1], [-1]]).T
        turn = _quaternion(np.stack([right, -top, forward], axis=1))
        aspect = frame.width / frame.height
        across = math.tan(math.radians(pose.fov) / 2)
        self._camera.visible, self._camera.aspect = True, aspect
        self._camera.fov = 2 * math.atan(across / aspect)
        self._camera.position, self._camera.wxyz = at, turn
        photo = own or frame.file
        if self._photo is None or self._photo[0] != photo:
            picture = images.load_picture(frame.file) if own is None else own.picture
            self._photo = photo, frame.undistorted(images.shrink(picture, _PHOTO))
        self._camera.image = self._photo[1]
        self.eye = Eye(at, np.asarray(forward), np.asarray(top), across, aspect)
        # In viser's frustum, depth times half of the width times half of the height is three times the cube of the scale.
        down = pose.altitude - base if pose.height is None else pose.height
        self._most_scale = _DEPTH * down * self._scale * math.cbrt(across**2 / aspect / 3)
        return at

    def _show_lines(
        self, analysis: StateAnalysis, places: GalleryGeometry, camera: Float64Array | None, city: bool, lift: float
    ) -> None:
        """Draw a line to the compared tile, and frame the positive, and the ground of a photo that is registered.

        The line begins at the query's camera, at the middle of that ground, at the marked GPS tag of the user's own picture,
        or without any of them at the positive.
        """
        segments: list[_Segment] = []
        chosen = self._to_stage(places.ground[analysis.chosen.index], 0.0, lift)
        truth = None
        if analysis.positive is not None:
            truth = self._to_stage(places.ground[analysis.positive.index], 0.0, lift)
            half = self._tile_side(places, analysis.positive.index) / 2
            signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
            true = theme.verdict_colour(analysis.positive.true)
            segments += _outline([np.add(truth, (x * half, y * half, 0.0)) for x, y in signs], true)
            if camera is not None and not (analysis.chosen.true or analysis.chosen.index == analysis.positive.index):
                segments.append((camera, truth, true))
        start, own = camera if camera is not None else truth, analysis.state.upload
        located = self._workspace.located(analysis)
        ground = None if located is None else outline(located)
        frame: list[_Segment] = []
        if located is not None and ground is not None and ground.registered:
            points = self._from_map(np.vstack([ground.corners, crossing(ground.corners)]), places)
            *corners, middle = [self._to_stage(point, 0.0, lift) for point in points]
            colour = theme.placed_colour(belief(located).sign)
            frame = _outline(corners, colour)
            basemap = self._workspace.basemap
            if city and basemap is not None and basemap.elevation is not None:  # it lies on the relief
                draped = border(ground.corners, basemap.heights, _PIECES) + np.array([0, 0, LIFT])
                ends = self._from_altitudes(places, draped.reshape(-1, 3)).reshape(-1, 2, 3)
                frame = [(one, other, colour) for one, other in ends]
            start = middle if camera is None else camera
            self._here.text = "your picture" if own is not None else f"{analysis.name}, by its details"
            self._here.position = max(corners, key=lambda corner: float(corner[1]))
        self._framed = bool(frame)
        self._here.visible = self._framed
        _draw(self._frame, frame)
        if own is not None and own.place is not None:
            tag = self._to_stage(geo.on_plane([Position(*own.place)], places.origin)[0], 0.0, lift)
            if float(np.abs(tag - chosen).max()) < _MAX_CAMERA_DISTANCE * self._scale:
                start = tag if start is None else start
                tips = [np.add(tag, (x, y, 0.0)) for x, y in ((-_TAG, 0), (0, -_TAG), (_TAG, 0), (0, _TAG))]
                segments += _outline(tips, analysis.state.palette.text)
        if start is not None:
            segments.append((start, chosen, theme.verdict_colour(analysis.chosen.true)))
        _draw(self._lines, segments)

    def _draw_caption(self, analysis: StateAnalysis, size: int) -> UInt8Array:
        """Draw the names of the query and the compared tile, at a size in pixels, and the error in metres."""
        chosen = analysis.chosen
        name = analysis.task.gallery[chosen.index].title
        palette = analysis.state.palette
        image, draw = captions.caption(*SIGN_PIXELS, palette)
        head, step = max(30, size), max(36, round(1.1 * size))
        source = "your picture" if analysis.state.upload else analysis.task.query_view
        draw.text((18, 30), "‹", palette.dim, captions.font(34), anchor="lm")
        draw.text((44, 30), query_title(), palette.text, captions.font(head), anchor="lm")
        draw.text(
            (44, 30 + step),
            captions.fitted(draw, f"{source} {analysis.name}", size, 394),
            palette.dim,
            captions.font(size),
            anchor="lm",
        )
        draw.text((438, 222 - step), "›", palette.dim, captions.font(34), anchor="rm")
        rank = rank_title(chosen, analysis.state.upload is not None)
        draw.text((412, 222 - step), rank, palette.text, captions.font(head), anchor="rm")
        left = 412 - draw.textlength(rank, font=captions.font(head))
        captions.draw_sign(draw, left - 40, 210 - step, 24, chosen.true, palette)
        tile = captions.fitted(draw, f"{analysis.task.gallery_view} {name}", size, 394)
        draw.text((412, 222), tile, palette.dim, captions.font(size), anchor="rm")
        if text := self._distance(analysis):
            placed = (located := self._workspace.located(analysis)) is not None and _placed(located)
            colour = palette.text if placed else palette.ink(theme.verdict_colour(chosen.true))
            large = max(40, size) if draw.textlength(text, font=captions.font(max(40, size))) <= 440 else size
            draw.text((228, 126), captions.fitted(draw, text, large, 440), colour, captions.font(large), anchor="mm")
        return np.asarray(image)

    def _distance(self, analysis: StateAnalysis) -> str:
        """Say the one distance that matters, from what to what; "" where there is none.

        It is that from the frame of a registered photo to its GPS tag, as the verdict has it. An own picture that fits nowhere
        has none: a tile that merely looks like it is no answer.
        """
        located, own = self._workspace.located(analysis), analysis.state.upload is not None
        if located is not None and _placed(located):
            error = located.error("registration")
            return "" if error is None else f"frame {distance(error)} from its GPS tag"
        if (own and located is not None) or analysis.errors_m is None:
            return ""
        off = float(analysis.errors_m[analysis.chosen.index])
        if not math.isfinite(off):
            return ""
        return f"answer {distance(off)} from its GPS tag" if own else f"{distance(off)} off"

    def _clicked(self, slot: int, on_select: Callable[[SessionState, int], None]) -> Callable[[Any], None]:
        def clicked(_: Any) -> None:
            analysis = self._analysis
            if analysis is not None and slot < len(analysis.matches):
                on_select(analysis.state, analysis.matches[slot].index)

        return clicked


def _placed(located: LocatedFrame) -> bool:
    """Return True if a photo is laid over the map by an accepted registration."""
    ground = outline(located)
    return ground is not None and ground.registered


def _draw(handle: viser.LineSegmentsHandle, segments: Sequence[_Segment]) -> None:
    """Draw the segments that are known; without any, hide the lines."""
    known = [one for one in segments if np.isfinite(one[:2]).all()]
    handle.visible = bool(known)
    if known:
        handle.points = np.array([(a, b) for a, b, _ in known], np.float32)
        handle.colors = np.array([(c, c) for *_, c in known], np.uint8)


def _outline(corners: Sequence[AnyArray], colour: theme.Colour) -> list[_Segment]:
    """Return the sides of a quadrangle."""
    return [(corners[i], corners[(i + 1) % 4], colour) for i in range(4)]


def _point(x: float, y: float, z: float) -> tuple[float, float, float]:
    return float(MAP_CENTRE[0] + x), float(MAP_CENTRE[1] + y), float(MAP_CENTRE[2] + z)


def _quaternion(rotation: Float64Array) -> Rotation:
    """Convert a rotation matrix (3, 3) to a quaternion."""
    w = math.sqrt(max(0.0, 1.0 + float(np.trace(rotation)))) / 2
    x, y, z = (
        math.copysign(
            math.sqrt(max(0.0, 1.0 + 2.0 * float(rotation[i, i]) - float(np.trace(rotation)))) / 2,
            float(rotation[(i + 2) % 3, (i + 1) % 3] - rotation[(i + 1) % 3, (i + 2) % 3]),
        )
        for i in range(3)
    )
    return w, x, y, z
