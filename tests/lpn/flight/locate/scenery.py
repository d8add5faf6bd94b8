"""A drawn piece of land, and photos of it by a known camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from lpn.core.arrays import Float32Array, Float64Array, UInt8Array
from lpn.flight.files import Flight, Frame
from lpn.flight.maps import Map, open_map
from tests.lpn.flight.maps.small_maps import write_geotiff

# Metres per pixel, and side in pixels, of the drawn map; its centre is the origin.
RESOLUTION = 0.25
SIDE = 800
CORNER = (-SIDE * RESOLUTION / 2, SIDE * RESOLUTION / 2)
# Where `small_flight` takes its photos, in metres.
FLOWN_PLACES = [(x, y) for x in (-60.0, -20.0, 20.0, 60.0) for y in (-60.0, -30.0, 0.0, 30.0, 60.0)]
BOUNDS = (CORNER[0], -CORNER[1], -CORNER[0], CORNER[1])


@cache
def land(seed: int = 0, side: int = SIDE) -> UInt8Array:
    """Draw fields, paths, and houses, (side, side, 3)."""
    rng = np.random.default_rng(seed)
    coarse = rng.normal(0, 1, (side // 40, side // 40)).astype(np.float32)
    grey = 110 + 18 * cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC)
    picture = np.repeat(grey[..., None], 3, axis=2)
    for _ in range(side // 2):
        middle, size = rng.uniform(0, side, 2), rng.uniform(6, 34, 2)
        box = cv2.boxPoints((tuple(middle), tuple(size), float(rng.uniform(0, 90)))).astype(np.int32)
        cv2.fillPoly(picture, [box], tuple(rng.uniform(20, 235, 3)))
    return (picture + rng.normal(0, 4, picture.shape)).clip(0, 255).astype(np.uint8)


def ground_to_photo(
    centre: tuple[float, float], heading: float, width: float, pixels: tuple[int, int], tilt: float = 0.0
) -> Float64Array:
    """Return the homography from metres to pixels (column, row, 1) of a photo, (3, 3).

    Args:
        tilt: relative change of scale from the picture's middle to its right edge.
    """
    columns, rows = pixels
    turn = np.radians(heading)
    # Metres to the right and up in the picture.
    turned = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1.0]])
    place = turned @ np.array([[1, 0, -centre[0]], [0, 1, -centre[1]], [0, 0, 1.0]])
    scale = columns / width
    lens = np.array([[scale, 0, 0], [0, -scale, 0], [2 * tilt / width, 0, 1]])
    shift = np.array([[1, 0, (columns - 1) / 2], [0, 1, (rows - 1) / 2], [0, 0, 1.0]])
    return np.asarray(shift @ lens @ place, np.float64)


def photo_of(picture: UInt8Array, homography: Float64Array, pixels: tuple[int, int], seed: int = 0) -> UInt8Array:
    """Photograph a drawn map in other light and with noise, (rows, columns, 3)."""
    to_metres = np.array(
        [[RESOLUTION, 0, CORNER[0] + RESOLUTION / 2], [0, -RESOLUTION, CORNER[1] - RESOLUTION / 2], [0, 0, 1.0]]
    )
    seen = cv2.warpPerspective(picture, homography @ to_metres, pixels, flags=cv2.INTER_CUBIC)
    noise = np.random.default_rng(seed).normal(0, 5, seen.shape)
    return (seen * 0.75 + 40 + noise).clip(0, 255).astype(np.uint8)


def write_map(file: Path, picture: np.ndarray) -> Map:
    """Write the whole drawn map, (side, side, 3), as a GeoTIFF, and open it."""
    pytest.importorskip("rasterio")
    metres = SIDE * RESOLUTION / len(picture)
    matrix = (metres, 0, 500_000 + CORNER[0], 0, -metres, 5_200_000 + CORNER[1])
    return open_map(write_geotiff(file, picture, matrix=matrix))


def photographed(
    folder: Path,
    town: Map,
    places: Sequence[tuple[float, float]],
    headings: float | Sequence[float],
    size: tuple[int, int],
    width: float,
    fov: float,
    names: str = "{}.png",
    step: float = 2.0,
    **known: Any,
) -> Flight:
    """Photograph the drawn map straight from above, a photo each `step` seconds that shows `width` metres, with its GPS tag."""
    height = round(width / 2 / math.tan(math.radians(fov / 2)), 6)
    degrees = town.frame.degrees(places).tolist()
    frames = []
    for i, (place, heading) in enumerate(zip(places, np.broadcast_to(headings, len(places)).tolist(), strict=True)):
        file = folder / names.format(i)
        cv2.imwrite(str(file), photo_of(land(), ground_to_photo(place, heading, width, size), size)[..., ::-1])
        told = {"heading": heading, "heading_source": "gimbal", "fov": fov, **known}
        frames.append(Frame(file.name, file, *size, step * i, *degrees[i], height, **told))
    return Flight("monday", tuple(frames))


def small_flight(folder: Path, town: Map) -> Flight:
    """Photograph a drawn map; headings are 40 degrees, heights are known.

    The first frame has no position, the second no certain heading, the third is no picture, and the last was taken higher up.
    """
    flight = photographed(folder, town, FLOWN_PLACES, 40.0, (96, 96), 60.0, 90.0, "{:02d}.png")
    first, second, *others = flight.frames
    first, second = replace(first, latitude=None, longitude=None), replace(second, heading_source="course")
    (folder / "02.png").write_bytes(b"no picture")
    high = replace(others[1], name="high.png", time=2.0 * len(FLOWN_PLACES), height_above_ground=60.0 * 0.7)
    return replace(flight, frames=(first, second, *others, high))


class GridModel:
    """Describes a picture by the colours of a grid, as a network that has learned the place would; counts what it describes."""

    views = ("satellite", "drone")
    fingerprint = "grid"
    contract = SimpleNamespace(roles="view")
    input_size = (32, 32)
    n_parts = 2
    batch = 8
    parallel = True
    embedding = 16

    def __init__(self) -> None:
        self.described = 0

    def check_view(self, view: str) -> None:
        assert view in self.views

    def for_parallel_inference(self) -> GridModel:
        return self

    def prepare(self, picture: np.ndarray, view: str) -> Float32Array:
        del view
        return cv2.resize(picture, (32, 32), interpolation=cv2.INTER_AREA).transpose(2, 0, 1).astype(np.float32)

    def descriptors(self, batch: Float32Array, view: str) -> Float32Array:
        del view
        self.described += len(batch)
        grey = np.stack([cv2.resize(picture[1], (4, 8), interpolation=cv2.INTER_AREA) for picture in batch])
        parts = grey.reshape(len(batch), 2, 16)
        parts = parts - parts.mean(axis=2, keepdims=True)
        norms = np.linalg.norm(parts, axis=2, keepdims=True)
        return (parts / np.maximum(norms, 1e-6) / np.sqrt(2)).astype(np.float32)
