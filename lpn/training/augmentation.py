"""Random augmentation of training pictures: weather, JPEG compression, mirroring, one warp, a random crop, then colour."""

from __future__ import annotations

import math
from typing import cast

import cv2
import numpy as np

from lpn.core import images
from lpn.core.arrays import UInt8Array
from lpn.core.views import View
from lpn.descriptors.weather import draw_any
from lpn.training.appearance import change_appearance, compress
from lpn.training.recipe import Recipe


def draw_place_pose(recipe: Recipe, rng: np.random.Generator) -> tuple[float, bool]:
    """Draw the rotation in degrees and the mirroring that all views of a place share."""
    return float(rng.uniform(-1, 1)) * recipe.place_rotation, recipe.flip == "place" and rng.random() < 0.5


def augment(
    picture: UInt8Array,
    recipe: Recipe,
    rng: np.random.Generator,
    angle: float,
    mirror: bool,
    view: View,
    panorama: bool = False,
) -> UInt8Array:
    """Augment a picture and resize it to the recipe's input size: (height, width, 3) uint8.

    Args:
        angle: rotation of the whole place, in degrees counter-clockwise; see `draw_place_pose`.
        mirror: mirror the whole place.
        view: pictures of the satellite view have a further rotation and no weather, and are unrolled if the recipe is polar.
        panorama: the picture covers the full circle with north in the middle, so a rotation rolls its columns.
    """
    height, width = recipe.input_size
    unrolled = recipe.polar and view == "satellite"
    if view != "satellite":
        picture = draw_any(picture, recipe.weather, rng)
    picture = compress(picture, recipe.compression, rng)
    if mirror or (recipe.flip == "picture" and rng.random() < 0.5):
        picture = cast(UInt8Array, np.ascontiguousarray(picture[:, ::-1]))
    if panorama:
        picture = _pad(images.resize(images.roll(picture, angle), height, width), recipe.padding)
    else:
        zoom = recipe.zoom(view)
        # A picture that is zoomed after it was reduced would lose the detail that a test keeps.
        native = rng.random() < recipe.own_canvas or zoom > 1
        on_canvas = not native and not unrolled
        if on_canvas:
            picture = _pad(images.resize(picture, height, width), recipe.padding)
        angle += float(rng.uniform(-1, 1)) * recipe.rotation
        if view == "satellite":
            angle += float(rng.uniform(-1, 1)) * recipe.satellite_rotation
        picture = _warp(picture, angle, zoom, recipe, rng)
        if not on_canvas:
            picture = images.polar(picture, height, width) if unrolled else images.resize(picture, height, width)
            picture = _pad(picture, recipe.padding)
    if recipe.padding:
        top, left = (int(start) for start in rng.integers(0, 2 * recipe.padding + 1, 2))
        picture = cast(UInt8Array, np.ascontiguousarray(picture[top : top + height, left : left + width]))
    return change_appearance(picture, recipe, rng)


def _pad(picture: UInt8Array, pixels: int) -> UInt8Array:
    """Extend a picture by its edge on each side."""
    if not pixels:
        return picture
    return cast(UInt8Array, cv2.copyMakeBorder(picture, *4 * (pixels,), cv2.BORDER_REPLICATE))


def _warp(picture: UInt8Array, angle: float, zoom: float, recipe: Recipe, rng: np.random.Generator) -> UInt8Array:
    """Rotate, scale, and shift in one interpolation."""
    scale = zoom * math.exp(float(rng.uniform(-1, 1)) * recipe.scale)
    height, width = picture.shape[:2]
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), angle, scale)
    matrix[:, 2] = matrix[:, 2] + rng.uniform(-1, 1, 2) * recipe.shift * (width, height)
    corners = cv2.BORDER_CONSTANT if rng.random() < recipe.black_corners else cv2.BORDER_REFLECT_101
    border = corners if angle else cv2.BORDER_REPLICATE
    flags = cv2.INTER_CUBIC if recipe.interpolation == "cubic" else cv2.INTER_NEAREST
    return cast(UInt8Array, cv2.warpAffine(picture, matrix, (width, height), flags=flags, borderMode=border))
