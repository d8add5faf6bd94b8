"""Textures of walls and roofs, as linear reflectance in float32 arrays."""

from __future__ import annotations

import numpy as np

from lpn.core.arrays import Float32Array
from tools.world.canvas import noise


def wall_texture(style: str) -> Float32Array:
    """Make a wall of 16 by 8 window units, 32 pixels each: (256, 512, 3), bottom row last."""
    rng = np.random.default_rng([hash_of(style), 1])
    unit = 32
    image = np.ones((8 * unit, 16 * unit, 3), np.float32)
    image *= 1 + 0.06 * noise(2.0)[: 8 * unit, : 16 * unit, None] + 0.06 * noise(30.0)[: 8 * unit, : 16 * unit, None]
    pane = {"punched": (7, 9, 18, 14), "sash": (10, 8, 12, 17), "ribbon": (0, 9, 32, 15), "glass": (1, 3, 30, 27)}.get(
        style
    )
    for row in range(8):
        for column in range(16):
            y, x = row * unit, column * unit
            if pane is not None:
                px, py, w, h = pane
                glass = np.array([0.10, 0.13, 0.16]) * rng.uniform(0.5, 1.7) + (0.25 if rng.random() < 0.1 else 0.0)
                image[y + py - 1 : y + py + h + 1, max(0, x + px - 1) : x + px + w + 1] *= 1.12
                image[y + py : y + py + h, x + px : x + px + w] = glass
                if style in ("punched", "sash"):
                    image[y + py : y + py + h, x + 15 : x + 17] *= 2.0
                    image[y + py + h : y + py + h + 2, x + px - 1 : x + px + w + 1] = 0.85
                if style == "ribbon":
                    image[y + py : y + py + h, x : x + 2] = 0.5
                if style == "glass":
                    image[y : y + 3, x : x + unit] = rng.uniform(0.6, 0.9)
            elif style == "cladding" and row % 2 == 1 and column % 5 == 2:
                image[y + 8 : y + 32, x + 4 : x + 28] *= 0.55
        if style in ("ribbon", "punched"):
            image[row * unit : row * unit + 1] *= 0.8
    if style == "cladding":
        image *= (1 + 0.1 * np.sign(np.sin(np.arange(16 * unit) * 2 * np.pi / 8)))[None, :, None]
    return np.clip(image, 0.02, 1.2)


def roof_texture(style: str) -> Float32Array:
    """Make a roof of 32 m by 32 m: (512, 512, 3), of mean about 1."""
    rng = np.random.default_rng([hash_of(style), 2])
    size = 512
    fine, blobs, large = (noise(scale)[:size, :size] for scale in (1.2, 12.0, 60.0))
    value = np.ones((size, size), np.float32)
    if style in ("membrane", "bitumen"):
        value += 0.05 * fine + 0.10 * np.minimum(blobs, 1) + 0.10 * large
        for x in range(0, size, 32):
            value[:, x] *= 0.82
        for y in range(0, size, 128):
            value[y + int(rng.integers(20))] *= 0.85
        for _ in range(26):  # repairs
            x, y = rng.integers(size - 60, size=2)
            w, h = rng.integers(6, 50, size=2)
            value[y : y + h, x : x + w] *= rng.uniform(0.8, 1.15)
    elif style == "gravel":
        value += 0.16 * fine + 0.14 * blobs + 0.12 * large
    elif style == "tiles":
        rows = (np.arange(size) * 32 / size / 0.4) % 1
        value *= (0.78 + 0.35 * rows[:, None]).astype(np.float32)
        value += 0.14 * fine + 0.10 * blobs + 0.08 * large
    elif style == "seams":
        value += 0.03 * fine + 0.05 * blobs + 0.06 * large
        value[:, ::10] *= 0.75
    elif style == "seats":
        value[::14] *= 0.5
        value[:, ::96] *= 1.6
        value += 0.06 * fine
    stain = np.clip(large + 0.6 * blobs - 1.3, 0, 1)
    value *= 1 - 0.35 * stain
    tinted = value[..., None] * (1 + 0.03 * noise(20.0)[:size, :size, None] * np.array([1, 0, -1], np.float32))
    return np.clip(tinted, 0.1, 1.6).astype(np.float32)


def hash_of(name: str) -> int:
    """Hash a name to a number, the same in every process."""
    return sum((i + 1) * ord(letter) for i, letter in enumerate(name))
