"""The details of a registered photo on a drawn map lie where the true camera has them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lpn.core.homography import apply_homography, inverse
from lpn.flight.files import Frame
from lpn.flight.locate.ground import MapFeatures
from lpn.flight.locate.located import LocatedFrame
from lpn.flight.locate.matchers import SiftMatcher
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.registered_stage import PhotoSearch, register_photo
from lpn.flight.maps import Map
from tests.lpn.flight.locate.scenery import ground_to_photo, land, photo_of

SIZE = (640, 480)
WIDTH, HEADING = 90.0, 130.0
FRAME = Frame("own.jpg", Path("own.jpg"), *SIZE, height_above_ground=45.0, fov=90.0, heading=HEADING)


def tilted_camera() -> np.ndarray:
    """The homography from metres to pixels of a camera at (0, 0), 45 m up, that looks 30 degrees aside along its heading."""
    turn, tilt = np.radians(HEADING), np.radians(30.0)
    forward, right = np.array([np.sin(turn), np.cos(turn), 0]), np.array([np.cos(turn), -np.sin(turn), 0])
    axis = np.sin(tilt) * forward + np.array([0, 0, -np.cos(tilt)])
    down = -(np.cos(tilt) * forward + np.array([0, 0, np.sin(tilt)]))
    focal = SIZE[0] / 2
    camera = np.array([[focal, 0, (SIZE[0] - 1) / 2], [0, focal, (SIZE[1] - 1) / 2], [0, 0, 1]])
    # Columns of the rays of ground points (x, y, -45).
    true = camera @ np.stack([right, down, axis]) @ np.array([[1, 0, 0], [0, 1, 0], [0, 0, -45.0]])
    return np.asarray(true / true[2, 2])


@pytest.mark.parametrize(
    ("true", "frame"),
    [
        (ground_to_photo((20.0, -30.0), HEADING, WIDTH, SIZE), FRAME),
        (tilted_camera(), replace(FRAME, pitch=-60.0, roll=0.0)),
    ],
    ids=["from above", "levelled"],
)
def test_details_lie_on_the_map_where_the_true_camera_has_them(fine_town: Map, true: np.ndarray, frame: Frame) -> None:
    photo, features = photo_of(land(), true, SIZE), [MapFeatures(fine_town, SiftMatcher())]
    answer = register_photo(PhotoSearch(fine_town, features, LocatedFrame(frame, None), photo, LocateOptions()))
    details = answer.details
    assert answer.inliers > len(details.rows) == 24
    assert 0 < details.median < details.limit
    on_map = details.on_map(np.array(answer.homography).reshape(3, 3), *SIZE)
    by_camera = apply_homography(inverse(true), details.places * SIZE - 0.5)
    assert np.median(np.linalg.norm(on_map - by_camera, axis=1)) < 0.5, "some pixels of the map"
    rows = np.floor(4 * details.places[:, 1])
    assert (np.diff(rows) >= 0).all(), "numbered from the top to the bottom"
    if frame is FRAME:
        assert details.limit == pytest.approx(0.015 * WIDTH, rel=0.02)
        assert (details.metres <= details.limit).all()
        for quarter in ((0, 0), (0, 1), (1, 0), (1, 1)):
            assert ((details.places >= 0.5) == quarter).all(axis=1).sum() >= 3, "the sample is spread over the photo"
