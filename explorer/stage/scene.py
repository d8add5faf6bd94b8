"""The 3-D stage: the query and the compared tile, the lines between their parts, and the ranked tiles."""

from __future__ import annotations

import math
from collections.abc import Callable
from threading import RLock

import numpy as np
import viser
from PIL.ImageDraw import ImageDraw

from explorer.compute.request_context import QueuedModel
from explorer.layout import CAPTION, Point, ScreenLayout
from explorer.session_state import SessionState
from explorer.stage import pair_picture
from explorer.stage.camera import FOV, HEIGHT, WIDTH, Viewpoint
from explorer.stage.cards import SHOWN, Cards
from explorer.stage.image_planes import UPRIGHT, Plane, Rotation, rank_title, title
from explorer.stage.lettering import GUTTER_COLUMN, GUTTER_ROW, Lettering
from explorer.stage.map_view import GalleryMap
from explorer.stage.viewport import Viewport
from explorer.workspace import StateAnalysis, Workspace
from lpn.core.arrays import AnyArray, Float32Array, UInt8Array
from lpn.core.numbers import rounded_to_sum
from lpn.core.views import View
from lpn.drawing import captions, overlays, theme
from lpn.drawing.part_areas import PartAreas
from lpn.drawing.theme import Palette
from lpn.explain import Evidence
from lpn.retrieval import DescribedPicture, Match

# Distance between the parts of an exploded picture, in stage units, if the pictures are side by side.
_LIFT = 0.5
# The same for stacked panoramas.
_STEP = 0.12
# Shift of an exploded picture towards the other picture, in stage units.
_INWARD = 0.3
_MIDDLE = (0.0, 0.51)
# The area of the stage that is always in view, in stage units.
SCENE = {"width": WIDTH, "height": HEIGHT, "middle": _MIDDLE}


class StagePicture:
    """One large picture with a caption, either flat or exploded into its parts."""

    def __init__(
        self, client: viser.ClientHandle, workspace: Workspace, name: str, centre: Point, caption: Point, n_parts: int
    ) -> None:
        self._n, self._centre, self._layout = n_parts, centre, workspace.layout
        scene = client.scene
        size = self._layout.picture
        self._group = scene.add_frame(f"/{name}", show_axes=False, position=(*centre, 0.0))
        self._flat = Plane(scene, f"/{name}/flat", *size, (0.0, 0.0, 0.0))
        self._caption = Plane(scene, f"/{name}_caption", *CAPTION, (*caption, 0.0))
        self._areas: PartAreas | None = None
        self._layers: list[viser.ImageHandle] = []
        self._layer_pictures: list[UInt8Array | None] = [None] * n_parts
        for part in range(n_parts):
            layer = scene.add_image(
                f"/{name}/layer{part}",
                np.zeros((2, 2, 4), np.uint8),
                *size,
                format="png",
                cast_shadow=False,
                receive_shadow=False,
                wxyz=UPRIGHT,
                visible=False,
            )
            self._layers.append(layer)

    def show(
        self, picture: UInt8Array, caption: UInt8Array, areas: PartAreas | None, exploded: bool, towards: float
    ) -> None:
        """Draw the picture; `towards` is the direction of the other picture, -1 (left) or 1 (right)."""
        self._areas = areas
        self._caption.show(caption)
        self._flat.handle.visible = not exploded
        # An exploded picture turns towards the other one; a panorama leans back.
        angle = math.radians(self._angle) if exploded else 0.0
        self._group.wxyz = _about_x(-angle) if self._layout.stacked else _about_y(towards * angle)
        inward = towards * _INWARD if exploded and not self._layout.stacked else 0.0
        self._group.position = (self._centre[0] + inward, self._centre[1], 0.0)
        if not exploded:
            self._flat.show(picture)
        for part, layer in enumerate(self._layers):
            layer_picture = self._layer_pictures[part]
            if exploded and (layer_picture is None or not np.array_equal(layer_picture, picture)):
                inside = np.ones(picture.shape[:2], bool) if areas is None else areas.mask(part, picture.shape[:2])
                layer.image = overlays.part_layer(picture, inside)
                layer.position = (0.0, 0.0, self.depth(part, exploded))
                self._layer_pictures[part] = picture
            layer.visible = exploded

    def depth(self, part: int, exploded: bool) -> float:
        """Return the distance of a part from the picture's plane; the centre is closest to the camera."""
        if not exploded:
            return 0.0
        order = part if self._areas is not None and self._areas.outside_in else self._n - 1 - part
        return (order - (self._n - 1) / 2) * (_STEP if self._layout.stacked else _LIFT)

    @property
    def _angle(self) -> float:
        """Rotation of the exploded picture in degrees."""
        return 32.0 if self._layout.stacked else 38.0

    def anchor(self, part: int, along: float, side: float, exploded: bool) -> tuple[float, float, float]:
        """Return the point, in stage coordinates, where the line from a part's border begins.

        For pictures side by side, `side` is the left (-1) or right (1) border and `along` the height of the point. For stacked
        pictures, `side` is the lower (-1) or upper (1) border, and the point is its middle.
        """
        left, top, right, bottom = (0.0, 0.0, 1.0, 1.0) if self._areas is None else self._areas.boxes[part]
        width, height = self._layout.picture
        z = self.depth(part, exploded) + 0.01
        angle = math.radians(self._angle) if exploded else 0.0
        if self._layout.stacked:
            x, y = ((left + right) / 2 - 0.5) * width, side * height / 2
            y, z = y * math.cos(angle) + z * math.sin(angle), z * math.cos(angle) - y * math.sin(angle)
        else:
            x = ((right if side > 0 else left) - 0.5) * width
            y = min(max(along, (0.5 - bottom) * height + 0.05), (0.5 - top) * height - 0.05)
            x, z = x * math.cos(angle) + side * z * math.sin(angle), -side * x * math.sin(angle) + z * math.cos(angle)
        centre = self._group.position
        return float(centre[0]) + x, float(centre[1]) + y, z


class Stage:
    """One browser's 3-D view.

    Args:
        on_select: called with the shown state and the gallery position of a clicked tile.
        viewport: the size of the stage, which the sizes of texts follow.

    Attributes:
        ground: what the page needs to measure on the map, see `GalleryMap.ground`; None while the pair is shown.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        workspace: Workspace,
        on_select: Callable[[SessionState, int], None],
        model: QueuedModel | None,
        viewport: Viewport,
    ) -> None:
        self._client, self._workspace, self._viewport = client, workspace, viewport
        self._n = workspace.contract.n_parts
        scene = client.scene
        scene.configure_default_lights(cast_shadow=False)
        self._layout = layout = workspace.layout
        self._query = StagePicture(client, workspace, "query", layout.query, layout.query_caption, self._n)
        self._tile = StagePicture(client, workspace, "tile", layout.tile, layout.tile_caption, self._n)
        (x, y), size = layout.gutter
        self._gutter = Plane(scene, "/gutter", *size, (x, y, 0.02))
        self._links: viser.LineSegmentsHandle = scene.add_line_segments(
            "/links",
            np.zeros((2 * self._n, 2, 3), np.float32),
            _link_colours(np.ones(self._n), theme.DARK),
            thickness=2.5,
            thickness_units="screen",
        )
        self._cards = Cards(scene, workspace, on_select, model)
        self._aspect, self._on_select = 0.0, on_select
        self._framing = RLock()
        self._drawn: list[tuple[DescribedPicture, Evidence | None, View, object, UInt8Array] | None] = [None, None]
        self._viewpoint: Viewpoint | None = None
        self._map: GalleryMap | None = None
        self.ground: dict[str, object] | None = None
        self._lettering = self._new_lettering()
        self.fit()

    def leave(self) -> None:
        """Stop all work: the browser has left."""
        self._cards.leave()

    @property
    def outgrown(self) -> bool:
        """Return True if the stage has another size than its texts were drawn for, so that `show` would draw others."""
        now = self._new_lettering()
        return now != self._lettering or (self._viewpoint is not None and now.ground != self._lettering.ground)

    def _new_lettering(self) -> Lettering:
        return Lettering.of(self._layout, self._n, self._viewport)

    def fit(self) -> None:
        """Reset the camera if the window's aspect has changed; otherwise keep the user's orbit."""
        with self._framing:  # several threads call this on a resize, and the last aspect must win
            aspect = self._client.camera.aspect
            if math.isfinite(aspect) and aspect > 0 and abs(aspect - self._aspect) >= 0.01:
                self._aspect = aspect
                self._point_camera()

    def straighten(self) -> None:
        """Undo the user's orbit."""
        with self._framing:
            self._point_camera()

    def _point_camera(self) -> None:
        """Point the camera at the pair and the ranked tiles, or at the map."""
        if not self._aspect:
            return
        camera, viewpoint = self._client.camera, self._viewpoint
        tangent = math.tan(FOV / 2)
        distance = max(HEIGHT / 2 / tangent, WIDTH / 2 / (tangent * self._aspect))
        position, target = np.array([*_MIDDLE, distance]), np.array([*_MIDDLE, 0.0])
        if viewpoint is not None and self._map is not None:
            self._map.put_sign(viewpoint, self._aspect)
            position, target = viewpoint.camera(self._aspect, FOV)
        with self._client.atomic():
            camera.fov = FOV
            camera.up_direction = (0.0, 0.0, 1.0) if viewpoint else (0.0, 1.0, 0.0)
            # viser skips a position equal to the last reported one, although the page may still be about to receive another.
            # Setting a different value first makes viser send position and target.
            camera.position = position + 1.0
            camera.position = position
            camera.look_at = target

    def show(self, analysis: StateAnalysis) -> None:
        """Draw an analysis."""
        state, task = analysis.state, analysis.task
        self._lettering = self._new_lettering()
        viewpoint, ground = None, None
        if state.map and task.geometry is not None:
            self._map = self._map or GalleryMap(self._client, self._workspace, SHOWN, self._on_select)
            with self._client.atomic():
                viewpoint = self._map.show(analysis, self._lettering)
            ground = self._map.ground(task.geometry)
        self.ground = ground
        with self._framing:
            if viewpoint != self._viewpoint:
                self._viewpoint = viewpoint
                self._point_camera()
        if viewpoint is not None:
            return
        areas = [
            self._workspace.areas(view, described)
            for view, described in zip(task.views, (analysis.query, analysis.tile), strict=True)
        ]
        left = self._with_overlays(analysis, 0, analysis.query, task.query_view, areas[0])
        right = self._with_overlays(analysis, 1, analysis.tile, task.gallery_view, areas[1])
        right = overlays.framed(right, theme.verdict_colour(analysis.chosen.true), 6)
        with self._client.atomic():
            self._query.show(left, self._query_caption(analysis), areas[0], state.exploded, 1.0)
            self._tile.show(right, self._tile_caption(analysis), areas[1], state.exploded, -1.0)
            draw = self._gutter_row if self._layout.stacked else self._gutter_picture
            self._gutter.show(draw(analysis.chosen, state.palette))
            self._links.points = self._link_points(analysis)
            self._links.colors = _link_colours(analysis.ranking.weights, state.palette)
            self._cards.show(analysis, self._lettering)

    def _with_overlays(
        self, analysis: StateAnalysis, side: int, described: DescribedPicture, view: View, areas: PartAreas | None
    ) -> UInt8Array:
        """Return a large picture with heatmap and rings, redrawn only if one of them has changed."""
        state = analysis.state
        evidence = (
            analysis.pair_evidence.evidence
            if analysis.pair_evidence is not None and state.heat_kind == "evidence"
            else None
        )
        look = (state.heat, state.heat_kind, state.heat_part, state.opacity, state.rings, state.parts_off)
        before = self._drawn[side]
        if before is None or before[0] is not described or before[1] is not evidence or before[2:4] != (view, look):
            picture = pair_picture.draw(self._workspace, analysis, side, areas)
            before = self._drawn[side] = (described, evidence, view, look, picture)
        return before[4]

    def _query_caption(self, analysis: StateAnalysis) -> UInt8Array:
        own = analysis.state.upload is not None
        source = "your picture" if own else analysis.task.query_view
        notes = [note for note in (analysis.query_note, analysis.state.change.describe()) if note]
        texts = ", ".join([f"{source} {analysis.name}", *notes]), source if own else analysis.name
        return title("QUERY", texts, None, analysis.state.palette, self._lettering.caption)

    def _tile_caption(self, analysis: StateAnalysis) -> UInt8Array:
        chosen = analysis.chosen
        tile, palette = analysis.task.gallery[chosen.index], analysis.state.palette
        text = ", ".join(filter(None, (f"{analysis.task.gallery_view} {tile.name}", tile.note)))
        return title(
            rank_title(chosen), (text, tile.name), chosen.true, palette, self._lettering.caption, chosen.distance2
        )

    def _gutter_picture(self, chosen: Match, palette: Palette) -> UInt8Array:
        """Draw the part bars in a column, between pictures side by side."""
        width, height = GUTTER_COLUMN
        image, draw = captions.caption(width, height, palette)
        rows = _row_heights(self._layout, self._n)
        for part in range(self._n):
            y = (0.5 - rows[part] / self._layout.picture[1]) * height
            self._draw_part(draw, palette, chosen, part, (10, width - 10), y, height / self._n)
        return np.asarray(image)

    def _gutter_row(self, chosen: Match, palette: Palette) -> UInt8Array:
        """Draw the part bars in a row, between stacked pictures."""
        width, height = self._layout.gutter[1]
        image, draw = captions.caption(GUTTER_ROW, round(GUTTER_ROW * height / width), palette)
        room = GUTTER_ROW / self._n
        for part in range(self._n):
            sides = (part * room + 8, (part + 1) * room - 8)
            self._draw_part(draw, palette, chosen, part, sides, 37, image.height)
        return np.asarray(image)

    def _draw_part(
        self,
        draw: ImageDraw,
        palette: Palette,
        chosen: Match,
        part: int,
        sides: tuple[float, float],
        y: float,
        room: float,
    ) -> None:
        """Draw a part's share of the distance as a bar at the height `y`, its name above, the share below.

        If name and share do not fit above and below the bar in `room` pixels, both are written above it.
        """
        left, right = sides
        size, small, middle = self._lettering.part, self._lettering.share, (left + right) / 2
        colour, name = theme.part_colour(part), self._workspace.part_names[part]
        number = name.partition(" ")[0]
        off = chosen.contributions[part] == 0 and chosen.cosines[part] < 1
        share = "off" if off else f"{rounded_to_sum(chosen.contributions.tolist())[part]:.3f}"
        one_line = size + small + 31 > room
        if one_line:
            y = max(y, size + 4)
            draw.text((right, y - 6), share, palette.dim, captions.font(small), anchor="rb")
            beside = right - left - draw.textlength(share, captions.font(small)) - 8
            name = captions.fitted(draw, name, size, beside, number)
            draw.text((left, y - 6), name, palette.ink(colour), captions.font(size), anchor="lb")
        else:
            name = captions.fitted(draw, name, size, right - left, number)
            draw.text((middle, y - 6), name, palette.ink(colour), captions.font(size), anchor="mb")
        draw.rectangle((left, y, right, y + 9), fill=palette.track)
        full = max(0.4 * chosen.distance2, float(chosen.contributions.max()), 1e-6)
        length = (right - left) * float(chosen.contributions[part]) / full
        if length >= 1:
            draw.rectangle((left, y, left + length, y + 9), fill=palette.mark(colour))
        below = y + 16 + small / 2
        if off and not one_line:
            draw.text((middle, below), share, palette.dim, captions.font(small), anchor="mm")
        elif not one_line:
            captions.draw_squared(draw, right, below, share, small, palette.dim)

    def _link_points(self, analysis: StateAnalysis) -> Float32Array:
        """Return two segments per part, from the query's ring to its bar and on to the tile's ring: (2n, 2, 3)."""
        state = analysis.state
        points = np.zeros((2 * self._n, 2, 3), np.float32)
        (x, y), (width, height) = self._layout.gutter
        for part, along in enumerate(_row_heights(self._layout, self._n)):
            if self._layout.stacked:
                across = x + ((part + 0.5) / self._n - 0.5) * width
                ends = (-1.0, (across, y + height / 2, 0.03), (across, y - height / 2, 0.03), 1.0)
            else:
                ends = (1.0, (-0.6, y + along - 0.025, 0.03), (0.6, y + along - 0.025, 0.03), -1.0)
            points[2 * part, 0] = self._query.anchor(part, along, ends[0], state.exploded)
            points[2 * part, 1], points[2 * part + 1, 0] = ends[1], ends[2]
            points[2 * part + 1, 1] = self._tile.anchor(part, along, ends[3], state.exploded)
        return points


def _row_heights(layout: ScreenLayout, n: int) -> list[float]:
    """Return the height of each part's bar relative to the pictures' centre, from the top."""
    return [(0.5 - (part + 0.5) / n) * layout.picture[1] for part in range(n)]


def _link_colours(weights: AnyArray, palette: Palette) -> UInt8Array:
    """Return the colour of each segment's ends, (2n, 2, 3): the part's colour, or a very dim one at weight 0."""
    colours = [
        palette.mark(theme.part_colour(part)) if weight > 0 else palette.off for part, weight in enumerate(weights)
    ]
    return np.repeat(np.array(colours, np.uint8), 2, axis=0)[:, None].repeat(2, axis=1)


def _about_y(angle: float) -> Rotation:
    return math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0


def _about_x(angle: float) -> Rotation:
    return math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0
