"""The 3-D stage: the query and the compared tile, the lines between their parts, and the ranked tiles."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from threading import RLock, Thread

import numpy as np
import viser

from explorer.compute.request_context import QueuedModel
from explorer.layout import HEIGHT, Box, ScreenLayout, layout_for
from explorer.session_state import SessionState
from explorer.stage import pair_picture
from explorer.stage.camera import FOV, Viewpoint
from explorer.stage.cards import SHOWN, Cards
from explorer.stage.image_planes import UPRIGHT, Plane, Rotation, query_title, rank_title, title
from explorer.stage.lettering import Lettering
from explorer.stage.map_view import Eye, GalleryMap
from explorer.stage.viewport import Viewport
from explorer.workspace import StateAnalysis, Workspace
from lpn.core.arrays import AnyArray, UInt8Array
from lpn.core.errors import PictureError
from lpn.core.views import View
from lpn.drawing import overlays, theme
from lpn.drawing.part_areas import PartAreas
from lpn.drawing.theme import Palette
from lpn.explain import Evidence
from lpn.models.partition import PartBox
from lpn.retrieval import DescribedPicture

# Distance between the parts of an exploded picture relative to its height: side by side, and stacked.
_LIFT, _STEP = 0.15, 0.08
# Parts whose middle is nearer to the picture's than this share of its height are rings.
_CENTRED = 1e-6
# Pixels of the frame that says whether the compared tile is true.
_FRAME = 6
# Shifts of an exploded picture towards the other one and away from the camera, relative to its width.
_INWARD, _BACK = 0.05, 0.35

# Steps in which the view flies from one photo's camera to another one's, and the seconds that it takes.
_GLIDE, _GLIDE_SECONDS = 10, 0.4


def _between(one: Eye, other: Eye, share: float) -> Eye:
    """Return a camera on the way from one to another."""
    first, second, third, across, aspect = (
        (1 - share) * np.asarray(a) + share * np.asarray(b) for a, b in zip(one, other, strict=True)
    )
    forward, up = (vector / max(float(np.linalg.norm(vector)), 1e-9) for vector in (second, third))
    return Eye(first, forward, up, float(across), float(aspect))


class StagePicture:
    """One large picture with a caption, either flat or exploded into its parts."""

    def __init__(self, client: viser.ClientHandle, name: str, n_parts: int) -> None:
        self._n, self._box, self._stacked = n_parts, ((0.0, 0.0), (1.0, 1.0)), False
        scene = client.scene
        self._group = scene.add_frame(f"/{name}", show_axes=False)
        self._flat = Plane(scene, f"/{name}/flat", 1.0, 1.0, (0.0, 0.0, 0.0))
        self._caption = Plane(scene, f"/{name}_caption", 1.0, 1.0, (0.0, 0.0, 0.0))
        self._areas: PartAreas | None = None
        self._layers: list[viser.ImageHandle] = []
        self._layer_pictures: list[UInt8Array | None] = [None] * n_parts
        for part in range(n_parts):
            layer = scene.add_image(
                f"/{name}/layer{part}",
                np.zeros((2, 2, 4), np.uint8),
                1.0,
                1.0,
                format="png",
                cast_shadow=False,
                receive_shadow=False,
                wxyz=UPRIGHT,
                visible=False,
            )
            self._layers.append(layer)

    def place(self, box: Box, caption: Box, stacked: bool) -> None:
        """Move the picture and its caption to boxes of the stage."""
        self._box, self._stacked = box, stacked
        self._caption.place(caption)
        for plane in (self._flat.handle, *self._layers):
            plane.render_width, plane.render_height = box[1]

    def show(
        self, picture: UInt8Array, caption: UInt8Array, areas: PartAreas | None, exploded: bool, towards: float
    ) -> None:
        """Draw the picture; `towards` is the direction of the other picture, -1 (left) or 1 (right)."""
        self._areas = areas
        self._caption.show(caption)
        self._flat.handle.visible = not exploded
        # An exploded picture turns towards the other one; a panorama leans back.
        angle = math.radians(self._angle) if exploded else 0.0
        (x, y), (width, _) = self._box
        self._group.wxyz = _about_x(-angle) if self._stacked else _about_y(towards * angle)
        inward, back = (towards * _INWARD * width, _BACK * width) if exploded and not self._stacked else (0.0, 0.0)
        self._group.position = (x + inward, y, -back)
        if not exploded:
            self._flat.show(picture)
        for part, layer in enumerate(self._layers):
            layer_picture = self._layer_pictures[part]
            if exploded and (layer_picture is None or not np.array_equal(layer_picture, picture)):
                inside = np.ones(picture.shape[:2], bool) if areas is None else areas.mask(part, picture.shape[:2])
                layer.image = overlays.part_layer(picture, inside)
                self._layer_pictures[part] = picture
            layer.position = (0.0, 0.0, self.depth(part, exploded))
            layer.visible = exploded

    def depth(self, part: int, exploded: bool) -> float:
        """Return the distance of a part from the picture's plane; the centre is closest to the camera."""
        if not exploded:
            return 0.0
        order = part if self._areas is not None and self._areas.outside_in else self._n - 1 - part
        return (order - (self._n - 1) / 2) * (_STEP if self._stacked else _LIFT) * self._box[1][1]

    @property
    def _angle(self) -> float:
        """Rotation of the exploded picture in degrees."""
        return 32.0 if self._stacked else 38.0

    def anchor(self, part: int, side: float) -> tuple[float, float, float]:
        """Return the point, in stage coordinates, where the line from an exploded part's border to the other picture begins.

        Args:
            side: for pictures side by side, the left (-1) or the right (1) border; for stacked ones, the lower or the upper one.
        """
        left, _, right, _ = (0.0, 0.0, 1.0, 1.0) if self._areas is None else self._areas.boxes[part]
        width, height = self._box[1]
        z, angle = self.depth(part, True) + 0.01, math.radians(self._angle)
        if self._stacked:
            x, y = ((left + right) / 2 - 0.5) * width, side * height / 2
            y, z = y * math.cos(angle) + z * math.sin(angle), z * math.cos(angle) - y * math.sin(angle)
        else:
            x = ((right if side > 0 else left) - 0.5) * width
            y = _line_height(part, self._n, [] if self._areas is None else self._areas.boxes) * height
            x, z = x * math.cos(angle) + side * z * math.sin(angle), -side * x * math.sin(angle) + z * math.cos(angle)
        centre = self._group.position
        return float(centre[0]) + x, float(centre[1]) + y, float(centre[2]) + z


class Stage:
    """One browser's 3-D view.

    Args:
        on_select: called with the shown state and the gallery position of a clicked tile.
        viewport: the size of the stage, which the sizes of texts follow.
        on_photo: called with the photo that lies over the view through its camera, see `GalleryMap.view_of`, with `flips`, the
            times that it was hidden or shown since; None takes it away.

    Attributes:
        layout: where the pictures are.
        ground: what the page needs to measure on the map, see `GalleryMap.ground`; None while the pair is shown.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        workspace: Workspace,
        on_select: Callable[[SessionState, int], None],
        model: QueuedModel | None,
        viewport: Viewport,
        on_photo: Callable[[dict[str, object] | None], None] = lambda _: None,
    ) -> None:
        self._client, self._workspace, self._viewport = client, workspace, viewport
        self._on_photo, self._photo, self._flips = on_photo, dict[str, object](), 0
        self._n = workspace.contract.n_parts
        scene = client.scene
        self._query = StagePicture(client, "query", self._n)
        self._tile = StagePicture(client, "tile", self._n)
        self._links: viser.LineSegmentsHandle = scene.add_line_segments(
            "/links",
            np.zeros((self._n, 2, 3), np.float32),
            _link_colours(np.ones(self._n), theme.DARK),
            thickness=2.5,
            thickness_units="screen",
            visible=False,
        )
        self._cards = Cards(scene, workspace, on_select, model)
        self._aspect, self._on_select = 0.0, on_select
        self._framing = RLock()
        self._drawn: list[tuple[DescribedPicture, Evidence | None, View, object, UInt8Array] | None] = [None, None]
        self._viewpoint: Viewpoint | None = None
        self._exploded = False
        self._map: GalleryMap | None = None
        # The camera that the view looks through.
        self._looking: Eye | None = None
        self.ground: dict[str, object] | None = None
        self._lettering = Lettering.of(viewport)
        self.layout = self._new_layout()
        self._place()
        self.fit()

    def leave(self) -> None:
        """Stop all work: the browser has left."""
        self._cards.leave()

    @property
    def outgrown(self) -> bool:
        """Return True if the stage has another size than it was drawn for, so that `show` would draw it anew."""
        now = Lettering.of(self._viewport)
        of_map = self._viewpoint is not None and (now != self._lettering or now.ground != self._lettering.ground)
        return of_map or self._new_layout() != self.layout

    def _new_layout(self) -> ScreenLayout:
        viewport = self._viewport
        return layout_for(self._workspace.contract.input_size, self._n, (viewport.width, viewport.height))

    def _place(self) -> None:
        """Move all of the pair's view to where the layout has it."""
        layout = self.layout
        self._query.place(layout.query, layout.query_caption, layout.stacked)
        self._tile.place(layout.tile, layout.tile_caption, layout.stacked)
        self._cards.place(layout)

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

    def look_through(self) -> None:
        """Look at the map through the camera of the query's photo, if its pose is known; the second time, flip its photo."""
        if self._viewpoint is not None and self._map is not None and self._map.eye is not None:
            if self._looking is self._map.eye:
                self._flips += 1
                self._on_photo({**self._photo, "flips": self._flips})
            else:
                self._look_through(self._map.eye)

    def look_away(self) -> None:
        """Show the query's camera on the map again: the view through it has been moved."""
        with self._framing, self._client.atomic():
            if self._looking is not None and self._map is not None:
                self._looking = None
                self._on_photo(None)
                self._map.show_photo()

    def _look_through(self, eye: Eye) -> None:
        """Put the view's camera where a photo's camera was, so that the whole photo fits into it, and lay it over the view.

        From the camera of one photo to that of another the view flies.
        """
        gallery_map = self._map
        assert gallery_map is not None
        with self._framing:
            if self._viewpoint is None:  # the map has been closed meanwhile
                return
            gallery_map.bare()
            before, self._looking = self._looking, eye
            if before is not None and not np.allclose(before.position, eye.position):
                self._on_photo(None)
                for step in range(1, _GLIDE):
                    self._stand(_between(before, eye, step / _GLIDE))
                    self._client.flush()
                    time.sleep(_GLIDE_SECONDS / _GLIDE)
            if gallery_map.eye is not eye:  # another photo has come meanwhile
                return
            self._stand(eye)
            try:
                self._photo = gallery_map.view_of(eye)
            except PictureError:  # its file is gone, which the analysis of the photo says
                self._looking = None
                self._on_photo(None)
                gallery_map.show_photo()
                return
            self._on_photo({**self._photo, "flips": self._flips})

    def _stand(self, eye: Eye) -> None:
        """Put the view's camera where a camera stands."""
        with self._client.atomic():
            camera = self._client.camera
            camera.fov = 2 * math.atan(eye.across / min(self._aspect or eye.aspect, eye.aspect))
            camera.up_direction = eye.up
            camera.position = eye.position + 1.0
            camera.position = eye.position
            camera.look_at = eye.position + eye.forward

    def _point_camera(self) -> None:
        """Point the camera at the pair and the ranked tiles, or at the map."""
        if not self._aspect:
            return
        camera, viewpoint = self._client.camera, self._viewpoint
        tangent = math.tan(FOV / 2)
        width = HEIGHT * self.layout.stage[0] / self.layout.stage[1]
        distance = max(HEIGHT / 2 / tangent, width / 2 / (tangent * self._aspect))
        position, target = np.array([0.0, 0.0, distance]), np.zeros(3)
        if self._looking is not None:
            self._looking = None
            self._on_photo(None)
        if viewpoint is not None and self._map is not None:
            self._map.show_photo()
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
        self._lettering, layout = Lettering.of(self._viewport), self._new_layout()
        if layout != self.layout:
            self.layout = layout
            with self._client.atomic(), self._framing:
                self._place()
                self._point_camera()
        viewpoint, ground = None, None
        if state.map and task.geometry is not None:
            self._map = self._map or GalleryMap(
                self._client, self._workspace, SHOWN, self._on_select, self._look_through
            )
            with self._client.atomic():
                viewpoint = self._map.show(analysis, self._lettering)
            ground = self._map.ground(task.geometry)
        self.ground = ground
        with self._framing:
            # A turn around the pulled rings ends with them.
            before, self._viewpoint = self._viewpoint, viewpoint
            if self._looking is not None and viewpoint is not None and self._map is not None:
                if self._map.eye is None:  # a photo without a pose: the map as it is, without the photo before
                    self._on_photo(None)
                else:  # one that flies along goes on to the next photo whose pose is known
                    self._map.bare()
                    # The page draws nothing of the flight before all else of the analysis is sent.
                    Thread(target=self._look_through, args=(self._map.eye,), name="look", daemon=True).start()
            elif viewpoint != before or (self._exploded and not state.exploded):
                self._point_camera()
            self._exploded = state.exploded
        if viewpoint is not None:
            return
        areas = [
            self._workspace.areas(view, described)
            for view, described in zip(task.views, (analysis.query, analysis.tile), strict=True)
        ]
        left = self._with_overlays(analysis, 0, analysis.query, task.query_view, areas[0])
        right = self._with_overlays(analysis, 1, analysis.tile, task.gallery_view, areas[1])
        if not state.exploded:  # a frame around the picture, which hides no part
            right = np.pad(right, ((_FRAME, _FRAME), (_FRAME, _FRAME), (0, 0)))
        right = overlays.framed(right, theme.verdict_colour(analysis.chosen.true), _FRAME)
        with self._client.atomic():
            self._query.show(left, self._query_caption(analysis), areas[0], state.exploded, 1.0)
            self._tile.show(right, self._tile_caption(analysis), areas[1], state.exploded, -1.0)
            self._links.visible = state.exploded
            if state.exploded:
                ends = [
                    (self._query.anchor(part, self._towards), self._tile.anchor(part, -self._towards))
                    for part in range(self._n)
                ]
                self._links.points = np.array(ends, np.float32)
                self._links.colors = _link_colours(analysis.ranking.weights, state.palette)
            self._cards.show(analysis)

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
        return title(query_title(), texts, None, analysis.state.palette, self._caption_width)

    @property
    def _caption_width(self) -> float:
        return self.layout.query_caption[1][0] * self.layout.unit

    @property
    def _towards(self) -> float:
        """The side of the query that the tile is on, see `StagePicture.anchor`."""
        return -1.0 if self.layout.stacked else 1.0

    def _tile_caption(self, analysis: StateAnalysis) -> UInt8Array:
        chosen = analysis.chosen
        tile, palette = analysis.task.gallery[chosen.index], analysis.state.palette
        own = analysis.state.upload is not None
        view = analysis.task.gallery_view if tile.cut is None else "map"
        text = ", ".join(filter(None, (f"{view} {tile.title}", tile.note)))
        return title(
            rank_title(chosen, own),
            (text, tile.title),
            chosen.true,
            palette,
            self._caption_width,
            chosen.distance2,
        )


def _link_colours(weights: AnyArray, palette: Palette) -> UInt8Array:
    """Return the colour of each segment's ends, (n, 2, 3): the part's colour, or a very dim one at weight 0."""
    colours = [
        palette.mark(theme.part_colour(part)) if weight > 0 else palette.off for part, weight in enumerate(weights)
    ]
    return np.array(colours, np.uint8)[:, None].repeat(2, axis=1)


def _about_y(angle: float) -> Rotation:
    return math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0


def _about_x(angle: float) -> Rotation:
    return math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0


def _line_height(part: int, n: int, boxes: Sequence[PartBox]) -> float:
    """Return how far above the middle the line of a part begins, as a share of the height, so that no two lines meet.

    The lines of rings lie in the bands between a ring and the next inner one, above and below by turns.

    Args:
        boxes: left, top, right, and bottom of each part in shares of the picture; none if it is not known where they are.
    """
    rings = sorted({round(bottom - top, 6) for _, top, _, bottom in boxes if abs(top + bottom - 1) < _CENTRED})
    _, top, _, bottom = boxes[part] if boxes else (0.0, 0.0, 1.0, 1.0)
    if len(rings) == n > 1:
        order = rings.index(round(bottom - top, 6))
        return (-1) ** order * (rings[order] + rings[order - 1]) / 4 if order else 0.0
    return min(max(0.5 - (part + 0.5) / n, 0.52 - bottom), 0.48 - top)
