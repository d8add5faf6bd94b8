"""Random changes to training pictures: compression, one geometric warp, then colour."""

from __future__ import annotations

import math
from typing import cast

import cv2
import numpy as np

from lpn.core import images
from lpn.core.arrays import UInt8Array
from lpn.core.views import View
from lpn.training.recipes import Recipe


def place_draw(recipe: Recipe, rng: np.random.Generator) -> tuple[float, bool]:
    """What all views of a place share this time: an angle in degrees, and whether they are mirrored."""
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
    """One random version of a picture at the recipe's input size: (height, width, 3) uint8.

    Args:
        angle: degrees counter-clockwise the whole place is turned, mirror: whether it is mirrored, see `place_draw`.
        view: the satellite alone has its further rotation, and is unrolled where the recipe says so.
        panorama: the picture shows the full circle, north in the middle; it is turned by moving its columns around.
    """
    height, width = recipe.input_size
    unrolled = recipe.polar and view == "satellite"
    if recipe.compression and rng.random() < recipe.compression:
        picture = _compressed(picture, int(rng.integers(40, 96)))
    if mirror or (recipe.flip == "picture" and rng.random() < 0.5):
        picture = cast(UInt8Array, np.ascontiguousarray(picture[:, ::-1]))
    if panorama:
        picture = images.resize(images.roll(picture, angle), height, width)
    else:
        native = rng.random() < recipe.own_canvas
        if not native and not unrolled:
            picture = images.resize(picture, height, width)
        angle += float(rng.uniform(-1, 1)) * recipe.rotation
        if view == "satellite":
            angle += float(rng.uniform(-1, 1)) * recipe.satellite_rotation
        picture = _warped(picture, angle, recipe, rng)
        picture = images.polar(picture, height, width) if unrolled else images.resize(picture, height, width)
    return _recolour(picture, recipe.colour, rng) if recipe.colour else picture


def _warped(picture: UInt8Array, angle: float, recipe: Recipe, rng: np.random.Generator) -> UInt8Array:
    """Turned, scaled, and shifted in one step."""
    scale = math.exp(float(rng.uniform(-1, 1)) * recipe.scale)
    height, width = picture.shape[:2]
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), angle, scale)
    matrix[:, 2] = matrix[:, 2] + rng.uniform(-1, 1, 2) * recipe.shift * (width, height)
    black = rng.random() < recipe.black_corners
    turned = cv2.BORDER_CONSTANT if black else cv2.BORDER_REFLECT_101
    border = turned if angle else cv2.BORDER_REPLICATE
    return cast(UInt8Array, cv2.warpAffine(picture, matrix, (width, height), flags=cv2.INTER_CUBIC, borderMode=border))


def _compressed(picture: UInt8Array, quality: int) -> UInt8Array:
    """What is left of a picture after JPEG; a network that has seen only one quality leans on its traces."""
    _, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    return cast(UInt8Array, cv2.cvtColor(cast(UInt8Array, cv2.imdecode(data, cv2.IMREAD_COLOR)), cv2.COLOR_BGR2RGB))


def _recolour(picture: UInt8Array, strength: float, rng: np.random.Generator) -> UInt8Array:
    """Brightness, colour cast, contrast, and now and then grey."""
    values = picture.astype(np.float32)
    gain = (1 + 0.3 * strength * rng.uniform(-1, 1)) * (1 + 0.15 * strength * rng.uniform(-1, 1, 3))
    values = values * gain.astype(np.float32) + np.float32(20 * strength * rng.uniform(-1, 1))
    mean = values.mean()
    values = mean + (values - mean) * np.float32(1 + 0.3 * strength * rng.uniform(-1, 1))
    if rng.random() < 0.2 * strength:
        values[:] = values.mean(axis=2, keepdims=True)
    return cast(UInt8Array, np.clip(values, 0, 255).astype(np.uint8))
