"""Where the browser looks at the map from."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from explorer.stage.camera import MAP_CENTRE, SIDE, SIGN_PICTURE, Viewpoint, oblique_view

FOV = 0.45
Points = np.ndarray[Any, np.dtype[np.float64]]


def seen(viewpoint: Viewpoint, points: Points, aspect: float) -> Points:
    """Places (n, 2) in the window: x right and y up, -1 to 1."""
    position, target = viewpoint.camera(aspect, FOV)
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    x, y, depth = (np.stack([right, np.cross(right, forward), forward]) @ (points - position).T) / math.tan(FOV / 2)
    return np.stack([x / aspect, y], axis=1) / (depth * math.tan(FOV / 2))[:, None]


@pytest.mark.parametrize("aspect", [0.6, 0.94, 1.8])
def test_the_whole_map_and_its_sign_are_in_view(aspect: float) -> None:
    whole = Viewpoint()
    corners = MAP_CENTRE + np.array([(x, y, 0) for x in (-SIDE / 2, SIDE / 2) for y in (-SIDE / 2, SIDE / 2)])
    assert np.abs(seen(whole, corners, aspect)).max() < 1
    assert np.abs(seen(whole, sign_corners(whole, aspect), aspect)).max() < 1


@pytest.mark.parametrize("aspect", [0.6, 0.94, 1.8])
def test_the_drone_and_its_tiles_are_in_view_below_the_sign(aspect: float) -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        ground = rng.uniform(-3, 3, (4, 2))
        points = np.column_stack([np.concatenate([ground, ground[:1] + rng.uniform(-0.5, 0.5, 2)]), [0, 0, 0, 0, 1.0]])
        viewpoint = oblique_view(points, 2.0)
        assert viewpoint.side >= 2
        at, sign = (
            seen(viewpoint, MAP_CENTRE + points, aspect),
            seen(viewpoint, sign_corners(viewpoint, aspect), aspect),
        )
        assert np.abs(at).max() < 1
        assert np.abs(sign).max() < 1
        assert at[:, 1].max() < sign[:, 1].min()


def sign_corners(viewpoint: Viewpoint, aspect: float) -> Points:
    middle, half = viewpoint.sign_position(0.0, aspect), viewpoint.scale / 2
    offsets = [
        x * SIDE * half * np.array([1.0, 0, 0]) + y * SIGN_PICTURE * half * viewpoint.up
        for x in (-1, 1)
        for y in (-1, 1)
    ]
    return np.asarray(middle + np.array(offsets))
