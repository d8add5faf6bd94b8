"""A registered photo beside the map about it, turned to lie like the photo: its frame, and the details that both show."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np

from lpn.core import images
from lpn.core.arrays import Float64Array, UInt8Array
from lpn.core.homography import corner_pixels, four_point_homography
from lpn.locate.coverage import corners_of
from lpn.locate.located import StageRecord
from lpn.locate.registration import pose
from lpn.maps import Map, Window

# The ground that a picture of the map shows, in sizes of the photo's frame.
_AROUND = 1.3
# The grey of a map's places without data.
_NOTHING = 40


@dataclass(frozen=True, eq=False)
class MatchedPictures:
    """A photo, the map about it, and the photo laid over that map, as pictures of one size.

    Attributes:
        photo: without the distortion of its lens, (H, W, 3) uint8.
        ground: the map about the photo, turned to lie like it, (H, W, 3) uint8.
        laid: the photo as the registration lays it over `ground`, black beyond its frame, (H, W, 3) uint8.
        frame: the photo's corners as shares of the width and height of `ground`, (4, 2).
        in_photo, on_map: the details of the sample, as shares of the widths and heights of `photo` and `ground`, (N, 2).
        heading: what points up in `ground`, degrees clockwise from north.
        width: metres of ground across `ground`.
    """

    photo: UInt8Array
    ground: UInt8Array
    laid: UInt8Array
    frame: Float64Array
    in_photo: Float64Array
    on_map: Float64Array
    heading: float
    width: float


def matched_pictures(
    basemap: Map, answer: StageRecord, photo: UInt8Array, size: tuple[int, int], side: int
) -> MatchedPictures | None:
    """Lay a photo over its map; None without an accepted registration with details, or if a corner lies beyond the horizon.

    Args:
        answer: the registration of the photo.
        photo: RGB, of any size, without the distortion of its lens.
        size: width and height in pixels of the photo as it was registered.
        side: the longer side of the pictures in pixels.

    Raises:
        DataError: if a sheet of the map is damaged.
    """
    if not answer.accepted or answer.homography is None or answer.details is None:
        return None
    homography = np.array(answer.homography).reshape(3, 3)
    corners = corners_of(homography, *size)
    if corners is None:
        return None
    small = images.shrink(photo, side)
    height, width = small.shape[:2]
    longer = max(height, width)
    _, heading, _ = pose(homography, *size)
    # The frame's box in a picture that is turned to lie like the photo, in metres to the right and down.
    turned = Window(0.0, 0.0, float(longer), heading)
    box = turned.to_pixels(corners, longer)
    low, high = box.min(axis=0), box.max(axis=0)
    middle = turned.to_ground((low + high) / 2, longer)[0]
    metres = _AROUND * float(((high - low) / (width, height)).max()) * longer
    window = Window(float(middle[0]), float(middle[1]), metres, heading)
    square, valid = basemap.read(window, longer)
    square[~valid] = _NOTHING
    corner = np.array([(longer - width) // 2, (longer - height) // 2])

    def pixels(ground: Float64Array) -> Float64Array:
        return np.asarray(window.to_pixels(ground, longer) - corner, np.float64)

    over = four_point_homography(corner_pixels(width, height), pixels(corners))
    return MatchedPictures(
        small,
        square[corner[1] : corner[1] + height, corner[0] : corner[0] + width],
        cast(UInt8Array, cv2.warpPerspective(small, over, (width, height), flags=cv2.INTER_AREA)),
        (pixels(corners) + 0.5) / (width, height),
        answer.details.places,
        (pixels(answer.details.on_map(homography, *size)) + 0.5) / (width, height),
        heading,
        metres * width / longer,
    )
