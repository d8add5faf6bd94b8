"""The gallery as a map: tiles at their places, the query's camera over them, and where the model puts it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import viser

from explorer import overlays
from explorer.chart import Places
from explorer.exhibit import Answer, Exhibit
from explorer.planes import Plane, Rotation
from explorer.session import State
from lpn import geo

AT = np.array([60.0, 0.0, 0.0])
"""The map lies this far from the compared pair, in stage units, so that neither is in the other's picture."""

_SIDE = 8.0
_LINES = 0.2
_PICTURE = 2.1
_WORDS = 3.3
_TILT = math.radians(38)
_ABOVE = np.array([0.0, math.cos(_TILT), math.sin(_TILT)])
"""What is up in the browser's picture of the map."""
_TOWARDS: Rotation = (math.cos((_TILT + math.pi) / 2), math.sin((_TILT + math.pi) / 2), 0.0, 0.0)
"""Sets a scene image upright in that picture."""


class GalleryMap:
    """One browser's map, built when it is first shown. `on_select` is told the state shown and a clicked tile."""

    def __init__(
        self, client: viser.ClientHandle, exhibit: Exhibit, shown: int, on_select: Callable[[State, int], None]
    ) -> None:
        self._exhibit = exhibit
        self._answer: Answer | None = None
        self._task = ""
        self._scale, self._middle = 1.0, np.zeros(2)
        scene = client.scene
        self._ground = Plane(scene, "/map/ground", 1.0, 1.0, _point(0, 0, 0))
        self._caption = Plane(scene, "/map/caption", _WORDS, 0.6 * _WORDS, _point(0, 0, 0))
        self._query = Plane(scene, "/map/query", _PICTURE, _PICTURE, _point(0, 0, 0))
        self._tile = Plane(scene, "/map/tile", _PICTURE, _PICTURE, _point(0, 0, 0))
        for plane in (self._caption, self._query, self._tile):
            plane.handle.wxyz = _TOWARDS
        self._lines = scene.add_line_segments(
            "/map/lines",
            np.zeros((1, 2, 3), np.float32),
            np.zeros((1, 2, 3), np.uint8),
            thickness=3.0,
            thickness_units="screen",
        )
        self._tiles = [Plane(scene, f"/map/tile{slot}", 0.3, 0.3, _point(0, 0, 0)) for slot in range(shown)]
        for slot, tile in enumerate(self._tiles):
            tile.handle.on_click(self._clicked(slot, on_select))
        self._camera: viser.CameraFrustumHandle = scene.add_camera_frustum(
            "/map/camera", fov=0.7, aspect=1.0, scale=0.5, color=overlays.TEXT, visible=False, cast_shadow=False
        )

    @staticmethod
    def view(aspect: float, fov: float) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        """Where the browser's camera stands and looks to have all of the map in view."""
        distance = max(4.6, 4.7 / aspect) / math.tan(fov / 2)
        middle = AT + 0.5 * (_PICTURE + 0.2) * _ABOVE
        return middle + distance * np.array([0.0, -math.sin(_TILT), math.cos(_TILT)]), middle

    def show(self, answer: Answer) -> None:
        """Draw an answer whose task has places."""
        places = answer.task.places
        assert places is not None
        self._answer = answer
        if self._task != answer.task.name:
            self._lay_out(answer, places)
        self._show_tiles(answer, places)
        camera = self._show_camera(answer, places)
        self._show_lines(answer, places, camera)
        self._caption.show(self._words(answer))
        self._query.show(overlays.framed(overlays.square(answer.query.picture, 256), overlays.TEXT, 4))
        colour = overlays.verdict_colour(answer.chosen.true)
        self._tile.show(overlays.framed(overlays.square(answer.tile.picture, 256), colour, 6))

    def _lay_out(self, answer: Answer, places: Places) -> None:
        west, south, east, north = places.bounds()
        self._scale = _SIDE / max(east - west, north - south)
        self._middle = np.array([west + east, south + north]) / 2
        handle = self._ground.handle
        handle.render_width, handle.render_height = (east - west) * self._scale, (north - south) * self._scale
        self._ground.show(self._exhibit.mosaic(answer.task))
        edge = np.add(AT, (0.0, (north - south) * self._scale / 2, 0.0))
        for plane, x in (
            (self._caption, 0.0),
            (self._query, (_PICTURE - _SIDE) / 2),
            (self._tile, (_SIDE - _PICTURE) / 2),
        ):
            plane.handle.position = np.add(edge, (x, 0.0, 0.0)) + (_PICTURE / 2 + 0.15) * _ABOVE
        self._task = answer.task.name

    def _place(self, ground: npt.NDArray[np.float64], up: float, lift: float = 0.0) -> npt.NDArray[np.float64]:
        """A place (east, north) and height in metres on the stage, raised by some stage units more."""
        x, y = (ground - self._middle) * self._scale
        return np.asarray(AT + np.array([x, y, up * self._scale + lift]), np.float64)

    def _show_tiles(self, answer: Answer, places: Places) -> None:
        side = max(places.width * self._scale, 0.12)
        for slot, plane in enumerate(self._tiles):
            plane.handle.visible = slot < len(answer.matches)
            if not plane.handle.visible:
                continue
            match = answer.matches[slot]
            picture = overlays.square(self._exhibit.entry_picture(answer.task.gallery[match.index].path), 96)
            framed = overlays.framed(picture, overlays.verdict_colour(match.true), 5)
            plane.show(overlays.numbered(framed, match.rank))
            plane.handle.render_width = plane.handle.render_height = side
            # The nearest lies on top where tiles overlap.
            height = 0.03 + 0.012 * (len(self._tiles) - slot)
            plane.handle.position = self._place(places.ground[match.index], 0.0, height)

    def _show_camera(self, answer: Answer, places: Places) -> npt.NDArray[np.float64] | None:
        """The frustum at the query's pose; None when it is not known."""
        place = None if answer.state.upload else places.queries[answer.state.query]
        stands = None if place is None else geo.camera(place, places.origin)
        self._camera.visible = stands is not None
        if place is None or stands is None:
            return None
        at = self._place(stands[:2], float(stands[2]))
        heading = math.radians(place.heading or 0.0)
        tilt = math.radians(-90.0 if place.tilt is None else place.tilt)
        ahead = np.array([math.sin(heading), math.cos(heading), 0.0])
        forward = math.cos(tilt) * ahead + np.array([0.0, 0.0, math.sin(tilt)])
        right = np.array([math.cos(heading), -math.sin(heading), 0.0])
        self._camera.fov = math.radians(place.fov or 40.0)
        self._camera.position = at
        self._camera.wxyz = _quaternion(np.stack([right, np.cross(forward, right), forward], axis=1))
        self._camera.image = overlays.square(answer.query.picture, 128)
        return at

    def _show_lines(self, answer: Answer, places: Places, camera: npt.NDArray[np.float64] | None) -> None:
        """From the camera, or from the true place, to the compared tile; a frame around the true tile."""
        segments: list[tuple[npt.NDArray[Any], npt.NDArray[Any], overlays.Colour]] = []
        chosen = self._place(places.ground[answer.chosen.index], 0.0, _LINES)
        truth = None
        if answer.truth is not None:
            truth = self._place(places.ground[answer.truth.index], 0.0, _LINES)
            half = max(places.width * self._scale, 0.12) / 2
            signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
            corners = [np.add(truth, (x * half, y * half, 0.0)) for x, y in signs]
            segments += [(corners[i], corners[(i + 1) % 4], overlays.TRUE_COLOUR) for i in range(4)]
        start = camera if camera is not None else truth
        if start is not None:
            segments.append((start, chosen, overlays.verdict_colour(answer.chosen.true)))
        if camera is not None and truth is not None and not answer.chosen.true:
            segments.append((camera, truth, overlays.TRUE_COLOUR))
        self._lines.visible = bool(segments)
        if segments:
            self._lines.points = np.array([(a, b) for a, b, _ in segments], np.float32)
            self._lines.colors = np.array([(c, c) for *_, c in segments], np.uint8)

    def _words(self, answer: Answer) -> npt.NDArray[np.uint8]:
        """What the two pictures above the map are, and how far apart they lie."""
        chosen = answer.chosen
        name = answer.task.gallery[chosen.index].name
        image, draw = overlays.caption(420, 252)
        source = "your picture" if answer.state.upload else answer.task.query_view
        draw.text((0, 30), "‹", overlays.DIM, overlays.font(34), anchor="lm")
        draw.text((26, 30), "QUERY", overlays.TEXT, overlays.font(30), anchor="lm")
        draw.text(
            (26, 66),
            overlays.fitted(draw, f"{source} {answer.name}", 24, 394),
            overlays.DIM,
            overlays.font(24),
            anchor="lm",
        )
        draw.text((420, 186), "›", overlays.DIM, overlays.font(34), anchor="rm")
        draw.text((394, 186), f"RANK {chosen.rank}", overlays.TEXT, overlays.font(30), anchor="rm")
        left = 394 - draw.textlength(f"RANK {chosen.rank}", font=overlays.font(30))
        overlays.draw_sign(draw, left - 40, 174, 24, chosen.true)
        tile = overlays.fitted(draw, f"{answer.task.gallery_view} {name}", 24, 394)
        draw.text((394, 222), tile, overlays.DIM, overlays.font(24), anchor="rm")
        if answer.off is not None:
            colour = overlays.verdict_colour(chosen.true)
            draw.text((210, 126), f"{answer.off[chosen.index]:,.0f} m off", colour, overlays.font(40), anchor="mm")
        return np.asarray(image)

    def _clicked(self, slot: int, on_select: Callable[[State, int], None]) -> Callable[[Any], None]:
        def clicked(_: Any) -> None:
            answer = self._answer
            if answer is not None and slot < len(answer.matches):
                on_select(answer.state, answer.matches[slot].index)

        return clicked


def _point(x: float, y: float, z: float) -> tuple[float, float, float]:
    return float(AT[0] + x), float(AT[1] + y), float(AT[2] + z)


def _quaternion(rotation: npt.NDArray[np.float64]) -> Rotation:
    """(w, x, y, z) of a rotation matrix (3, 3)."""
    w = math.sqrt(max(0.0, 1.0 + float(np.trace(rotation)))) / 2
    x, y, z = (
        math.copysign(
            math.sqrt(max(0.0, 1.0 + 2.0 * float(rotation[i, i]) - float(np.trace(rotation)))) / 2,
            float(rotation[(i + 2) % 3, (i + 1) % 3] - rotation[(i + 1) % 3, (i + 2) % 3]),
        )
        for i in range(3)
    )
    return w, x, y, z
