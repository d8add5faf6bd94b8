"""Random augmentation of training pictures: of their geometry (mirroring, one warp, a crop), and of their appearance."""

from __future__ import annotations

import math
from typing import cast

import cv2
import numpy as np

from lpn.core import images
from lpn.core.arrays import UInt8Array
from lpn.core.views import View
from lpn.descriptors.weather import draw_any
from lpn.training.recipe import Recipe

# Weights of red, green, and blue in a grey level.
_GREY = np.full(3, 1 / 3, np.float32)


def change_appearance(picture: UInt8Array, recipe: Recipe, rng: np.random.Generator) -> UInt8Array:
    """Simulate another day, camera, and height in a picture: (H, W, 3) uint8.

    The order is nature's: the ground's colours, shadows, occluding objects, the lens, the sensor. A change that the recipe lacks
    draws no random number.
    """
    changes = (
        (recipe.season, change_season),
        (recipe.bands, mix_bands),
        (recipe.shadows, cast_shadows),
        (float(recipe.colour > 0), lambda picture, rng: recolour(picture, recipe.colour, rng)),
        (recipe.occlusion, occlude),
        (recipe.blur, blur),
        (float(recipe.noise > 0), lambda picture, rng: add_noise(picture, recipe.noise * float(rng.random()), rng)),
    )
    for probability, change in changes:
        if probability == 1 or (probability and rng.random() < probability):
            picture = change(picture, rng)
    return picture


def recolour(picture: UInt8Array, strength: float, rng: np.random.Generator) -> UInt8Array:
    """Change brightness, colour cast, and contrast, and sometimes remove all colour; strength is 0 to 1."""
    values = picture.astype(np.float32)
    gain = (1 + 0.3 * strength * rng.uniform(-1, 1)) * (1 + 0.15 * strength * rng.uniform(-1, 1, 3))
    values = values * gain.astype(np.float32) + np.float32(20 * strength * rng.uniform(-1, 1))
    mean = values.mean()
    values = mean + (values - mean) * np.float32(1 + 0.3 * strength * rng.uniform(-1, 1))
    if rng.random() < 0.2 * strength:
        values[:] = values.mean(axis=2, keepdims=True)
    return cast(UInt8Array, np.clip(values, 0, 255).astype(np.uint8))


def change_season(picture: UInt8Array, rng: np.random.Generator) -> UInt8Array:
    """Shift the colour of everything with one hue, such as leaves, by up to 60 grey levels where that hue is strong."""
    hue = rng.normal(size=3)
    hue -= hue.mean()
    hue /= max(float(np.linalg.norm(hue)), 1e-9)
    share = cv2.transform(picture.astype(np.float32), (hue[None] / 50).astype(np.float32)).clip(0, 1)
    shift = rng.uniform(-60, 60, 3).astype(np.float32)
    return cast(UInt8Array, np.clip(picture + share[..., None] * shift, 0, 255).astype(np.uint8))


def mix_bands(picture: UInt8Array, rng: np.random.Generator) -> UInt8Array:
    """Mix the three bands at random, half of the time in another order, like a near-infrared camera; grey stays grey."""
    matrix = np.eye(3)[rng.permutation(3)] if rng.random() < 0.5 else np.eye(3)
    matrix = matrix + rng.normal(0, 0.35, (3, 3))
    matrix += (1 - matrix.sum(axis=1, keepdims=True)) * _GREY
    return cast(UInt8Array, cv2.transform(picture, matrix))


def cast_shadows(picture: UInt8Array, rng: np.random.Generator) -> UInt8Array:
    """Darken one to three areas with soft edges, all by one factor from 0.4 to 0.8."""
    side = max(picture.shape[:2])
    lit = np.full(picture.shape[:2], 255, np.uint8)
    darkest = float(rng.uniform(0.4, 0.8))
    for _ in range(int(rng.integers(1, 4))):
        box = _box(picture, rng, 0.05 * side, 0.5 * side)
        cv2.fillConvexPoly(lit, box, int(255 * darkest))
    width = 2 * int(rng.integers(0, max(side // 40, 1))) + 1
    return cast(UInt8Array, cv2.multiply(picture, cv2.merge([cv2.blur(lit, (width, width))] * 3), scale=1 / 255))


def occlude(picture: UInt8Array, rng: np.random.Generator) -> UInt8Array:
    """Hide one to four areas of up to a quarter of the side, each in one colour."""
    side = max(picture.shape[:2])
    hidden = picture.copy()
    for _ in range(int(rng.integers(1, 5))):
        cv2.fillConvexPoly(hidden, _box(picture, rng, 0.04 * side, 0.25 * side), rng.uniform(0, 255, 3).tolist())
    return hidden


def blur(picture: UInt8Array, rng: np.random.Generator) -> UInt8Array:
    """Blur a picture like a lens out of focus, sigma up to 1.5 pixels, or a motion of up to 8 pixels."""
    if rng.random() < 0.5:
        return cast(UInt8Array, cv2.GaussianBlur(picture, (0, 0), float(rng.uniform(0.3, 1.5))))
    angle, length = float(rng.uniform(0, np.pi)), float(rng.uniform(1, 8))
    kernel = np.zeros((9, 9), np.float32)
    half = length / 2 * np.array([np.cos(angle), np.sin(angle)])
    start, end = ([round(16 * float(x)) for x in 4 + sign * half] for sign in (-1, 1))
    cv2.line(kernel, start, end, 1.0, 1, cv2.LINE_AA, 4)
    return cast(UInt8Array, cv2.filter2D(picture, -1, kernel / max(float(kernel.sum()), 1e-9)))


def add_noise(picture: UInt8Array, sigma: float, rng: np.random.Generator) -> UInt8Array:
    """Add a sensor's noise with standard deviation `sigma` in grey levels."""
    noise = rng.standard_normal(picture.shape, np.float32) * np.float32(sigma)
    return cast(UInt8Array, np.clip(picture + noise, 0, 255).astype(np.uint8))


def compress(picture: UInt8Array, probability: float, rng: np.random.Generator) -> UInt8Array:
    """Compress as JPEG with a probability, so that a network does not overfit to the artefacts of one quality."""
    if not probability or rng.random() >= probability:
        return picture
    data = np.frombuffer(images.jpeg(picture, int(rng.integers(40, 96))), np.uint8)
    return cast(UInt8Array, cv2.cvtColor(cast(UInt8Array, cv2.imdecode(data, cv2.IMREAD_COLOR)), cv2.COLOR_BGR2RGB))


def _box(picture: UInt8Array, rng: np.random.Generator, least: float, most: float) -> np.ndarray:
    """Draw a turned rectangle with sides in pixels from `least` to `most`: (4, 2) int32."""
    rows, columns = picture.shape[:2]
    middle = float(rng.uniform(0, columns)), float(rng.uniform(0, rows))
    size = float(rng.uniform(least, most)), float(rng.uniform(least, most))
    return cv2.boxPoints((middle, size, float(rng.uniform(0, 180)))).astype(np.int32)


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
        mirror: whether to mirror the whole place.
        view: satellite pictures have a further rotation and no weather, and are unrolled if the recipe is polar.
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
        # A zoom after the reduction would lose detail that a test preserves.
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
