"""The light of the drone's summer afternoon without a renderer: sun, sky, and shadows, baked into colours."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from lpn.core.arrays import Float32Array, Float64Array
from tools.world import photo
from tools.world.city import City
from tools.world.geometry import turned

DAY = replace(photo.DRONE, haze=0.0, blur=0.0, noise=0.0)
_SUN = 1.5 * np.array([1.0, 0.94, 0.86])  # light of a white surface that faces it
_SKY = 0.36 * np.array([0.86, 0.95, 1.1])  # light of a white surface that faces up
_SOFT = 1.2  # metres over which a shadow's edge fades


def towards_sun() -> Float64Array:
    """Unit vector (3,) towards the sun: x east, y north, z up."""
    elevation, bearing = np.radians(DAY.sun)
    level = np.cos(elevation)
    return np.array([level * np.sin(bearing), level * np.cos(bearing), np.sin(elevation)])


def reflected(tints: Float64Array, normals: Float64Array) -> Float64Array:
    """Compute the light (n, 3) reflected by surfaces of linear reflectance (n, 3) with unit normals (n, 3)."""
    sun = np.clip(normals @ towards_sun(), 0, None)[:, None]
    sky = (0.62 + 0.38 * normals[:, 2])[:, None]
    return np.asarray(tints * (sun * _SUN + sky * _SKY))


def displayed(light: Float64Array) -> NDArray[np.uint8]:
    """Convert light (..., 3) to sRGB with the exposure and tone curve of the drone's camera."""
    picture = light.reshape(-1, 1, 3).astype(np.float32)
    return np.asarray(photo.develop(picture, DAY, np.random.default_rng(0)).reshape(light.shape), np.uint8)


def linear(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Convert sRGB colours to linear ones, which glTF uses for vertices."""
    return np.asarray(np.rint(255 * photo.linear_of(colours / 255)), np.uint8)


def sunshine(city: City, west: float, north: float, shape: tuple[int, int], scale: float) -> Float32Array:
    """Compute the fraction (h, w) of sunlight on the ground behind buildings and trees, `scale` metres a pixel, north up."""
    height, width = shape
    mask = np.zeros(shape, np.uint8)
    sun = towards_sun()
    drift = -sun[:2] / sun[2]  # of a shadow, for each metre of height
    corner = np.array([west, north])

    def fill(ring: Float64Array) -> None:
        at = (ring - corner) * (1, -1) / scale * 16
        if (at.max(axis=0) > 0).all() and (at.min(axis=0) < (16 * width, 16 * height)).all():
            cv2.fillConvexPoly(mask, cv2.convexHull(at.astype(np.int32)), 255, cv2.LINE_AA, 4)

    for building in city.buildings:
        for part in city.architectures[building.architecture].parts:
            ring = turned(np.array(part.outline), building.angle) + np.array([building.x, building.y])
            top = part.eaves + 0.6 * part.rise
            fill(np.concatenate([ring + drift * part.base, ring + drift * top]))
    trees = city.trees
    around = np.arange(10) * 2 * np.pi / 10
    circle = np.stack([np.cos(around), np.sin(around)], axis=1)
    for x, y, tall in zip(trees.x, trees.y, trees.height, strict=True):
        fill(np.array([x, y]) + drift * 0.55 * tall + circle * 0.3 * tall)
    soft = cv2.GaussianBlur(mask, (0, 0), _SOFT / scale) if scale < _SOFT * 2 else mask
    return np.asarray(1 - soft.astype(np.float32) / 255)


def ground(colour: Float32Array, water: Float32Array, sunshine: Float32Array) -> NDArray[np.uint8]:
    """Light the ground: sRGB (h, w, 3) from reflectance (h, w, 3), fraction of water, and fraction of the sun."""
    light = colour * (sunshine[..., None] * towards_sun()[2] * _SUN + _SKY)
    light += water[..., None] * np.array([0.03, 0.055, 0.075])  # the sky on it
    return displayed(light)
