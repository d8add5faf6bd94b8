"""The cameras of a whole flight on the stage's map, and the ground of its photos: thin lines of one mesh."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import viser

from lpn.core.arrays import Float64Array
from lpn.drawing import theme
from lpn.locate.coverage import outline
from lpn.locate.frustums import border, frustum
from lpn.locate.located import LocatedFrame
from lpn.maps import Map

# Pixels of a line; share of the flying height that is the depth of a camera's pyramid; and metres of borders above the ground.
_THICKNESS, _DEPTH, LIFT = 1.5, 0.12, 1.0


class FlightLines:
    """One browser's lines of a flight.

    Args:
        scene: in which they are drawn.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self._lines = scene.add_line_segments(
            "/map/flight",
            np.zeros((1, 2, 3), np.float32),
            np.zeros((1, 2, 3), np.uint8),
            thickness=_THICKNESS,
            thickness_units="screen",
            visible=False,
        )
        # The browser has lines that were drawn of these answers; None before the first.
        self._drawn: object = None
        self._empty = True

    def hide(self) -> None:
        """Show no lines."""
        self._lines.visible = False

    def show(
        self,
        frames: Sequence[LocatedFrame],
        chosen: int | None,
        basemap: Map,
        base: float,
        relief: bool,
        to_stage: Callable[[Float64Array], Float64Array],
    ) -> None:
        """Show the registered photos of a flight, except for the chosen one, whose camera has its photo.

        Args:
            base: altitude of flat ground.
            relief: whether the ground has the map's heights; it is flat otherwise.
            to_stage: from metres in the map's frame and of altitude, (N, 3), to stage units, (N, 3).
        """
        answers = [located.stages.get("registration") for located in frames]
        key = answers, chosen, relief, to_stage(np.zeros((1, 3))).tolist()
        if key != self._drawn:
            self._drawn = key
            cameras, grounds = _pieces(frames, chosen, basemap, base, relief)
            pieces = np.concatenate([cameras, grounds])
            colours = np.array([theme.COLOURS["registration"]] * len(cameras) + [theme.DIM] * len(grounds), np.uint8)
            if len(pieces):
                self._lines.points = to_stage(pieces.reshape(-1, 3)).reshape(-1, 2, 3).astype(np.float32)
                self._lines.colors = np.repeat(colours[:, None], 2, axis=1)
            self._empty = not len(pieces)
        self._lines.visible = not self._empty


def _pieces(
    frames: Sequence[LocatedFrame], chosen: int | None, basemap: Map, base: float, relief: bool
) -> tuple[Float64Array, Float64Array]:
    """Return the pieces of cameras and of grounds, (K, 2, 3) metres each."""
    cameras, grounds = [np.zeros((0, 2, 3))], [np.zeros((0, 2, 3))]
    for index, located in enumerate(frames):
        answer = located.stages.get("registration")
        if index == chosen or answer is None or not answer.accepted:
            continue
        if (pose := answer.pose) is not None:
            depth = _DEPTH * (pose.altitude if pose.height is None else pose.height)
            lift = base if pose.flat else 0.0
            aspect = located.frame.width / located.frame.height
            cameras.append(frustum(pose, aspect, depth) + np.array([0, 0, lift]))
        if (ground := outline(located)) is not None and ground.registered:
            up = LIFT + (0.0 if relief else base)
            grounds.append(border(ground.corners, basemap.heights if relief else None) + np.array([0, 0, up]))
    return np.concatenate(cameras), np.concatenate(grounds)
