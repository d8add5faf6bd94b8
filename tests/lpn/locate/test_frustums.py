"""The cameras of a flight over the ground."""

from __future__ import annotations

import numpy as np

from lpn.locate.camera_pose import CameraPose
from lpn.locate.frustums import border, frustum


def test_a_camera_s_pyramid_opens_where_it_looks() -> None:
    # It looks east and 60 degrees down; the tangent of half its field of view is 1 across, and 0.75 up.
    pose = CameraPose(10.0, 20.0, 100.0, None, 90.0, -60.0, 0.0, 90.0, "told", True, 50, np.eye(6).ravel().tolist())
    edges = frustum(pose, 4 / 3, 8.0)
    assert edges.shape == (8, 2, 3)
    np.testing.assert_allclose(edges[:4, 0], [[10.0, 20.0, 100.0]] * 4)
    np.testing.assert_allclose(edges[:4, 1].mean(axis=0), [14.0, 20.0, 100.0 - 8 * np.sqrt(0.75)])
    sides = np.linalg.norm(edges[4:, 1] - edges[4:, 0], axis=1)
    np.testing.assert_allclose(np.sort(sides), [12.0, 12.0, 16.0, 16.0])
    # The photo's left is north, and its top is farther away than its bottom.
    assert edges[0, 1, 1] > 20 > edges[1, 1, 1]
    assert edges[0, 1, 0] > edges[3, 1, 0]


def test_a_border_follows_the_relief_and_leaves_out_what_has_no_height() -> None:
    corners = np.array([(0.0, 0.0), (60.0, 0.0), (60.0, 60.0), (0.0, 60.0)])
    pieces = border(corners, lambda places: np.where(places[:, 0] < 35, places[:, 0] / 10, np.nan))
    assert len(pieces) == 24 - 6 - 2 * 3
    np.testing.assert_allclose(pieces[..., 2], pieces[..., 0] / 10)
    assert border(corners, None).shape == (24, 2, 3)
