"""The lines of a flight in the tab's scene, and the mark of a photo in the head of the tile."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from explorer.flight.text import STATES, state
from explorer.screen.panel import SceneLines
from explorer.workspace import Workspace
from lpn.core.arrays import Float64Array
from lpn.drawing import theme
from lpn.flight.files.cameras import rotation
from lpn.flight.locate.camera_pose import CameraPose
from lpn.flight.locate.coverage import outline
from lpn.flight.locate.verdict import judge

# Depth of a camera's pyramid as a share of the flying height, and metres of lines above the ground.
_DEPTH, _LIFT = 0.12, 2.0
_LEGEND = (
    "Lines in the scene: the cameras of the placed photos, and the way along them. This photo's camera and its ground have "
    "another colour."
)


def scene_lines(workspace: Workspace, query: int) -> list[SceneLines]:
    """Return the cameras of the registered photos, the path along them, and the outline of the chosen photo on the ground."""
    flight = workspace.flight
    if flight is None or flight.retrieval is None:
        return []
    places = flight.retrieval.gallery.places
    middle = np.array([*(places.min(axis=0) + places.max(axis=0)) / 2, 0.0])
    stops = []
    others: list[Float64Array] = []
    chosen: list[Float64Array] = []
    for index, located in enumerate(flight.frames):
        answer = located.stages.get("registration")
        if answer is None or not answer.accepted:
            continue
        stops.append((answer.x, answer.y, _LIFT))
        if answer.pose is not None:
            aspect = located.frame.width / located.frame.height
            (chosen if index == query else others).append(_pyramid(answer.pose, aspect))
        if index == query and (ground := outline(located)) is not None:
            corners = np.column_stack([ground.corners, np.full(4, _LIFT)])
            chosen.append(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1))
    way = np.array(stops, np.float64).reshape(-1, 3)
    others.append(np.stack([way[:-1], way[1:]], axis=1))
    kinds = ((others, "registration"), (chosen, "accent"))
    return [(np.concatenate(of) - middle, theme.COLOURS[name]) for of, name in kinds if sum(map(len, of))]


def _pyramid(pose: CameraPose, aspect: float) -> Float64Array:
    """Return the edges of a camera's pyramid, (8, 2, 3), in metres east, north, and above the ground, which is flat."""
    height = pose.altitude if pose.height is None else pose.height
    up, right, forward = (rotation(pose.heading, pose.pitch, pose.roll)[[1, 0, 2]] * [[1], [1], [-1]]).T
    across, depth = math.tan(math.radians(pose.fov) / 2), _DEPTH * height
    eye = np.array([pose.east, pose.north, height])
    signs = ((-1, 1), (1, 1), (1, -1), (-1, -1))
    corners = [eye + depth * (forward + x * across * right + y * across / aspect * up) for x, y in signs]
    return np.array([(eye, corner) for corner in corners] + [(corners[i - 1], corners[i]) for i in range(4)])


def mark(workspace: Workspace, query: int) -> dict[str, Any] | None:
    """Return the state of a flight's photo in a few words, with its sign; None without a flight."""
    flight = workspace.flight
    if flight is None or query >= len(flight.frames):
        return None
    verdict = judge(flight.frames[query])
    return {"sign": verdict.sign, "text": f"photo {STATES[state(verdict)]}", "why": _LEGEND}
