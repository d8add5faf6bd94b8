from __future__ import annotations

import numpy as np

from lpn.core.homography import apply_homography, corner_pixels, four_point_homography, middle_pixel, translation

CORNERS = np.array([(100.0, 60.0), (180.0, 70.0), (170.0, 0.0), (95.0, 5.0)])


def test_four_points_are_mapped_to_the_micrometre_far_from_the_origin() -> None:
    far = CORNERS + np.array([300_000.0, -200_000.0])
    found = four_point_homography(corner_pixels(4000, 3000), far)
    np.testing.assert_allclose(apply_homography(found, corner_pixels(4000, 3000)), far, rtol=0, atol=1e-6)


def test_a_projection_is_found_from_four_points() -> None:
    given = np.array([[2.0, 0.3, 5.0], [-0.1, 1.5, -7.0], [1e-3, -2e-3, 1.0]])
    points = corner_pixels(80, 60)
    found = four_point_homography(points, apply_homography(given, points))
    np.testing.assert_allclose(found / found[2, 2], given, rtol=1e-9, atol=1e-12)


def test_the_middle_lies_between_the_corners_and_whole_numbers_are_centres_of_pixels() -> None:
    np.testing.assert_array_equal(corner_pixels(3, 2), [(-0.5, -0.5), (2.5, -0.5), (2.5, 1.5), (-0.5, 1.5)])
    np.testing.assert_array_equal(middle_pixel(3, 2), (1.0, 0.5))
    np.testing.assert_array_equal(apply_homography(translation((1, 2)), middle_pixel(3, 2)), (2.0, 2.5))
