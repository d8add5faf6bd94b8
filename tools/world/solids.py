"""The city's polygons as triangles with baked light, for its 3-D model."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from lpn.core.arrays import Float64Array
from tools.world import light, meshes
from tools.world.architecture import Architecture
from tools.world.city import SPECIES, City
from tools.world.geometry import turned

# The material of surfaces without windows.
PLAIN = ""
_DARK_FOOT = 0.78  # of a wall where it meets the ground


@dataclass(frozen=True)
class Solid:
    """Triangles of one material.

    Attributes:
        vertices: (n, 3) metres east, north, up.
        faces: (t, 3) corners of triangles, counter-clockwise from outside.
        colours: (n, 3) sRGB.
        uv: (n, 2) texture coordinates, zeros without a texture.
    """

    vertices: Float64Array
    faces: NDArray[np.int64]
    colours: NDArray[np.uint8]
    uv: Float64Array


@dataclass
class Solids:
    """Polygons collected by material."""

    _parts: dict[str, list[Solid]] = field(default_factory=lambda: defaultdict(list))

    def add(self, material: str, solid: Solid) -> None:
        if len(solid.faces):
            self._parts[material].append(solid)

    def place(self, made: dict[str, Polygons], angle: float, place: tuple[float, float, float]) -> None:
        """Add polygons by their materials, turned and moved."""
        for material, polygons in made.items():
            self.add(material, polygons.placed(angle, np.array(place)))

    def extend(self, other: Solids) -> None:
        for material, parts in other._parts.items():
            self._parts[material].extend(parts)

    def joined(self, most: int) -> Iterator[tuple[str, Solid]]:
        """Merge the triangles of each material into as few solids of at most `most` vertices as possible, ordered by name."""
        for name, parts in sorted(self._parts.items()):
            numbers = np.cumsum([len(part.vertices) for part in parts])
            first = 0
            while first < len(parts):
                before = numbers[first - 1] if first else 0
                last = max(int(np.searchsorted(numbers, before + most, side="right")), first + 1)
                yield name, _joined(parts[first:last])
                first = last


def buildings(city: City, numbers: NDArray[np.int_], item: float, face: float) -> Solids:
    """Make the buildings in their places.

    Args:
        item: minimum area of a roof item in square metres.
        face: minimum area of a surface in square metres, to omit parapets for example.
    """
    solids = Solids()
    made: dict[int, dict[str, Polygons]] = {}
    for number in numbers:
        b = city.buildings[number]
        if b.architecture not in made:
            made[b.architecture] = _polygons(meshes.building(_simpler(city.architectures[b.architecture], item)), face)
        solids.place(made[b.architecture], b.angle, (b.x, b.y, city.height(b.x, b.y)))
    return solids


def bridges(city: City, numbers: NDArray[np.int_]) -> Solids:
    solids = Solids()
    for number in numbers:
        bridge = city.bridges[number]
        solids.place(_polygons(meshes.bridge(bridge.length, bridge.width)), bridge.angle, (bridge.x, bridge.y, 0.12))
    return solids


def trees(city: City, numbers: NDArray[np.int_]) -> Solid:
    """Make trees as pointed crowns of their species' shape and colour."""
    planted = city.trees
    kinds = planted.species[numbers].astype(int)
    across, low, wide = np.array([_CROWNS[name] for name in SPECIES])[kinds].T
    height, look = planted.height[numbers], planted.look[numbers]
    places = np.stack([planted.x[numbers], planted.y[numbers]], axis=1)
    foot = city.terrain(places)
    turn = look[:, None] * 7 + np.arange(_SIDES) * 2 * np.pi / _SIDES
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    n = len(numbers)
    vertices = np.empty((n, _SIDES + 2, 3))
    vertices[:, :, :2] = places[:, None]
    vertices[:, 1:-1, :2] += ring * (across * height)[:, None, None]
    vertices[:, 0, 2] = foot + low * height
    vertices[:, 1:-1, 2] = (foot + wide * height)[:, None]
    vertices[:, -1, 2] = foot + height
    outward = np.zeros_like(vertices)
    outward[:, 1:-1, :2] = ring
    outward[:, 1:-1, 2] = 0.35
    outward[:, 0, 2], outward[:, -1, 2] = -1, 1
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    leaves = np.array(light.DAY.season.leaves)
    choice = np.where(kinds == SPECIES.index("fir"), 2, ((look * 7.3 + kinds * 0.37) % 1 * len(leaves)).astype(int))
    tint = leaves[choice] * ((0.8 + 0.45 * (look * 31.7 % 1)) * 1.45)[:, None]
    tints = np.repeat(tint[:, None], _SIDES + 2, axis=1) * np.array([0.55, *[0.95] * _SIDES, 1.2])[:, None]
    sides = np.arange(_SIDES)
    following = (sides + 1) % _SIDES
    crown = np.concatenate(
        [
            np.stack([np.zeros(_SIDES, int), 1 + following, 1 + sides], axis=1),
            np.stack([1 + sides, 1 + following, np.full(_SIDES, _SIDES + 1)], axis=1),
        ]
    )
    faces = crown + (np.arange(n) * (_SIDES + 2))[:, None, None]
    lit = light.reflected(tints.reshape(-1, 3), outward.reshape(-1, 3))
    flat = vertices.reshape(-1, 3)
    return Solid(flat, faces.reshape(-1, 3), light.displayed(lit), np.zeros((len(flat), 2)))


_SIDES = 4
# Size of a tree in a file.
TREE_BYTES = (_SIDES + 2) * 12 + 2 * _SIDES * 6
_CROWNS = {  # half the crown's width, its lowest and its widest point, as shares of the height
    "oak": (0.44, 0.08, 0.52), "maple": (0.37, 0.08, 0.50), "lime": (0.32, 0.08, 0.46),
    "poplar": (0.15, 0.04, 0.40), "fir": (0.22, 0.02, 0.16), "bush": (0.6, -0.1, 0.40),
}  # fmt: skip


@dataclass(frozen=True)
class Polygons:
    """Convex polygons of one material in a building's frame: triangles, with a normal and a tint each."""

    vertices: Float64Array
    faces: NDArray[np.int64]
    normals: Float64Array
    tints: Float64Array
    uv: Float64Array

    def placed(self, angle: float, place: Float64Array) -> Solid:
        """Rotate, move, and light the polygons."""
        vertices = np.column_stack([turned(self.vertices[:, :2], angle), self.vertices[:, 2]]) + place
        normals = np.column_stack([turned(self.normals[:, :2], angle), self.normals[:, 2]])
        lit = light.reflected(self.tints, normals)
        lit *= np.where(self.vertices[:, 2] < 0.5, _DARK_FOOT, 1.0)[:, None]
        return Solid(vertices, self.faces, light.displayed(lit), self.uv)


def _simpler(look: Architecture, least: float) -> Architecture:
    """Remove small roof items, and those that only change the roof's colour."""
    return replace(look, items=tuple(i for i in look.items if i.length * i.width >= least and i.height > 0.2))


def _polygons(mesh: meshes.Mesh, face: float = 0.0) -> dict[str, Polygons]:
    """Group a mesh's polygons of at least `face` square metres by material; only walls with windows are not plain."""
    vertices, uv, sizes, tints = mesh.arrays()
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    crosses = np.array([_cross(vertices[i : i + k]) for i, k in zip(starts, sizes, strict=True)])
    areas = np.linalg.norm(crosses, axis=1) / 2
    units = crosses / np.maximum(2 * areas, 1e-12)[:, None]
    styles = np.array([name.removeprefix("wall ") if _has_windows(name) else PLAIN for name in mesh.materials])
    by_style = {}
    for style in sorted(set(styles[areas >= face].tolist())):
        mine = np.flatnonzero((styles == style) & (areas >= face))
        corners = np.concatenate([np.arange(starts[i], starts[i] + sizes[i]) for i in mine])
        faces, first = [], 0
        for i in mine:
            k = int(sizes[i])
            faces.append(first + np.stack([np.zeros(k - 2, int), np.arange(1, k - 1), np.arange(2, k)], axis=1))
            first += k
        by_style[style] = Polygons(
            vertices[corners],
            np.concatenate(faces),
            np.repeat(units[mine], sizes[mine], axis=0),
            np.repeat(tints[mine], sizes[mine], axis=0),
            uv[corners] * (style != PLAIN),
        )
    return by_style


def _has_windows(material: str) -> bool:
    return material.startswith("wall ") and material != "wall plain"


def _cross(ring: Float64Array) -> Float64Array:
    """Normal (3,) of a polygon (k, 3) with twice its area as length."""
    return np.asarray(np.cross(ring - ring[0], np.roll(ring, -1, axis=0) - ring[0]).sum(axis=0))


def _joined(parts: list[Solid]) -> Solid:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return Solid(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]),
        np.concatenate([part.colours for part in parts]),
        np.concatenate([part.uv for part in parts]),
    )
