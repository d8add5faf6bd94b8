"""Tests of where matchers place their keypoints."""

import numpy as np

from lpn.flight.locate.matchers import SiftMatcher


def test_sift_places_a_keypoint_at_the_middle_of_a_round_spot() -> None:
    row, column = np.mgrid[:101, :101]
    spot = 255 * np.exp(-((column - 50) ** 2 + (row - 50) ** 2) / (2 * 5.0**2))
    picture = np.repeat(spot.astype(np.uint8)[..., None], 3, axis=2)
    points = SiftMatcher().features(picture).points
    off = points - 50
    nearest = off[np.argmin(np.abs(off).sum(axis=1))]
    assert np.abs(nearest).max() < 0.1
