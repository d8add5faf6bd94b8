"""The city as a light 3-D model, `city.glb`: ground, buildings, bridges, and trees with baked light.

`lpn.datasets.city_model` states the format. The model needs no lamps, so that it is fast to draw without a graphics card.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from lpn.core import images
from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError
from lpn.datasets.city_model import MAX_BYTES
from tools.world import light, paint, photo, solids, textures
from tools.world.atlas import Atlas
from tools.world.cameras import TILE, Site, Tile
from tools.world.city import City, Window, grid, middles, within_window
from tools.world.glb import MOST_VERTICES, Primitive, glb
from tools.world.meshes import BAYS, STOREYS
from tools.world.solids import PLAIN, TREE_BYTES, Solid, Solids

_MARGIN = 120.0  # metres around the tiles
_PIECE = 512.0  # metres of ground painted at once
_QUALITY = 72  # of the ground's JPEG
_UNITS, _UNIT_PIXELS = 4, 16  # windows in a wall's texture, each way
_BORDER = 14.0  # metres the model's edge reaches below the ground
_SOIL = (0.16, 0.13, 0.10)
_HEADER = 20_000  # bytes of the file's tables, at most
_ENOUGH = 0.5  # share of the trees there must be room for


@dataclass(frozen=True)
class Detail:
    """Limits of a model's detail.

    Attributes:
        pixel: metres per pixel of the ground's picture.
        grid: metres between height samples of the ground.
        house: minimum footprint of a building in square metres.
        item: minimum area of a roof item in square metres.
        face: minimum area of a surface in square metres.
    """

    pixel: float
    grid: float
    house: float
    item: float
    face: float


DETAILS = (
    Detail(0.8, 24, 0, 3, 0),
    Detail(1.0, 24, 0, 6, 0),
    Detail(1.25, 30, 0, 12, 0),
    Detail(1.5, 30, 0, 30, 4),
    Detail(2.0, 40, 30, 60, 8),
    Detail(2.5, 50, 60, 1e9, 20),
    Detail(3.0, 60, 100, 1e9, 30),
    Detail(4.0, 60, 260, 1e9, 40),
)


def test_window(atlas: Atlas) -> Window:
    """Return the ground that the tiles of the test split show, with a margin; the explorer's map covers it."""
    tiles = [
        shot.camera
        for sector in atlas.sectors
        for shot in sector.tiles
        if isinstance(shot.camera, Tile) and any(path.startswith("test/") for path in shot.paths)
    ]
    places = np.array([(tile.x, tile.y) for tile in tiles])
    reach = TILE / 2 + _MARGIN
    (west, south), (east, north) = (places.min(axis=0) - reach).tolist(), (places.max(axis=0) + reach).tolist()
    return west, south, east, north


def city_model(city: City, site: Site, window: Window, largest: int = MAX_BYTES) -> bytes:
    """Encode the part of a city within a window as GLB, with as much detail as fits.

    Args:
        site: position on the Earth of the origin of the plan and of the model.
        largest: maximum size of the file in bytes.

    Raises:
        InputError: when the least detail does not fit.
    """
    trees = within_window(window, city.trees.x, city.trees.y)
    trees = trees[np.argsort(-city.trees.height[trees], kind="stable")]
    for detail in DETAILS:
        built = _primitives(_built(city, window, detail))
        if _bytes(built) > largest:
            continue
        ground = _ground(city, window, detail)
        room = (largest - _HEADER - _bytes([ground, *built])) // TREE_BYTES
        if room >= _ENOUGH * len(trees) or (detail is DETAILS[-1] and room >= 0):
            planted = Solids()
            for some in np.array_split(np.sort(trees[:room]), 1 + len(trees) // 8000):
                planted.add(PLAIN, solids.trees(city, some))
            extras = {"latitude": site.latitude, "longitude": site.longitude}
            return glb([ground, *built, *_primitives(planted, "trees")], extras)
    west, south, east, north = window
    raise InputError(
        f"A 3-D model of {east - west:.0f} m by {north - south:.0f} m does not fit into {largest / 1e6:.1f} MB; choose a "
        "smaller window."
    )


def _bytes(primitives: list[Primitive]) -> int:
    """Size of primitives in a file, without its tables."""
    pictures = {p.picture for p in primitives if p.picture is not None}
    arrays = sum(
        len(p.vertices) * (8 + 4 * (p.colours is not None) + 8 * (p.uv is not None)) + 6 * len(p.faces)
        for p in primitives
    )
    return arrays + sum(len(picture) for picture in pictures)


def _built(city: City, window: Window, detail: Detail) -> Solids:
    """Return everything in the window except ground and trees."""
    sizes = np.array([np.prod(city.architectures[b.architecture].size) for b in city.buildings])
    numbers = within_window(window, *middles(city.buildings))
    built = solids.buildings(city, numbers[sizes[numbers] >= detail.house], detail.item, detail.face)
    built.extend(solids.bridges(city, within_window(window, *middles(city.bridges))))
    built.add(PLAIN, _edge(city, window, detail.grid))
    return built


def _primitives(built: Solids, plain: str = "plain") -> list[Primitive]:
    made = []
    for style, solid in built.joined(MOST_VERTICES):
        colours = light.linear(solid.colours)
        if style == PLAIN:
            made.append(Primitive(plain, solid.vertices, solid.faces, colours))
        else:
            uv = solid.uv * (BAYS / _UNITS, -STOREYS / _UNITS)
            made.append(Primitive(f"walls {style}", solid.vertices, solid.faces, colours, uv, _windows(style)))
    return made


def _windows(style: str) -> bytes:
    """Make a wall's light map as a PNG file with `_UNITS` windows each way."""
    pattern = textures.wall_texture(style)
    height, width = (int(_UNITS * side / units) for side, units in zip(pattern.shape, (STOREYS, BAYS), strict=False))
    side = _UNITS * _UNIT_PIXELS
    value = np.clip(cv2.resize(pattern[-height:, :width], (side, side), interpolation=cv2.INTER_AREA), 0, 1)
    return cv2.imencode(".png", np.rint(photo.srgb_of(value)[..., ::-1] * 255).astype(np.uint8))[1].tobytes()


def _ground(city: City, window: Window, detail: Detail) -> Primitive:
    west, south, east, north = window
    columns, rows = (max(2, round(length / detail.grid) + 1) for length in (east - west, north - south))
    vertices, quads = grid(city.terrain, np.linspace(west, east, columns), np.linspace(south, north, rows))
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    uv = (vertices[:, :2] - (west, north)) / (east - west, south - north)
    picture = images.jpeg(_painted(city, window, detail.pixel), _QUALITY)
    return Primitive("ground", vertices, faces, uv=uv, picture=picture)


def _painted(city: City, window: Window, pixel: float) -> NDArray[np.uint8]:
    """Paint the lit ground (h, w, 3) in sRGB, north up, at twice the resolution, and shrink it."""
    west, south, east, north = window
    width, height = round((east - west) / pixel), round((north - south) / pixel)
    sun = light.sunshine(city, west, north, (height, width), pixel)
    picture = np.empty((height, width, 3), np.uint8)
    side = max(int(np.ceil(length / np.ceil(length * pixel / _PIECE))) for length in (width, height))
    for top in range(0, height, side):
        for left in range(0, width, side):
            rows, columns = slice(top, min(top + side, height)), slice(left, min(left + side, width))
            x, y = west + left * pixel, north - top * pixel
            seen = slice(0, rows.stop - top), slice(0, columns.stop - left)
            colour, water = paint.ground(city, x, y, side * pixel, pixel / 2, light.DAY.season)
            colour, water = (_halved(layer, side)[seen] for layer in (colour, water))
            picture[rows, columns] = light.ground(colour, water, sun[rows, columns])
    return picture


def _halved(layer: Float32Array, side: int) -> Float32Array:
    return np.asarray(cv2.resize(layer, (side, side), interpolation=cv2.INTER_AREA), np.float32)


def _edge(city: City, window: Window, grid: float) -> Solid:
    """Make the cut through the soil along the border."""
    west, south, east, north = window
    corners = np.array([(west, south), (east, south), (east, north), (west, north), (west, south)])
    vertices, faces, normals, first = [], [], [], 0
    for start, end in pairwise(corners):
        length = float(np.linalg.norm(end - start))
        n = max(2, round(length / grid) + 1)
        line = np.linspace(start, end, n)
        top = city.terrain(line)
        vertices += [np.column_stack([line, top - _BORDER]), np.column_stack([line, top])]
        i = first + np.arange(n - 1)
        faces += [np.stack([i, i + 1, i + n + 1], axis=1), np.stack([i, i + n + 1, i + n], axis=1)]
        east_of, north_of = (end - start) / length
        normals.append(np.tile([north_of, -east_of, 0.0], (2 * n, 1)))
        first += 2 * n
    normal = np.concatenate(normals)
    colours = light.displayed(light.reflected(np.tile(_SOIL, (len(normal), 1)), normal))
    return Solid(np.concatenate(vertices), np.concatenate(faces), colours, np.zeros((len(normal), 2)))
