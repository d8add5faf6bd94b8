"""Buildings, trees, vehicles, and bridges as polygons, independent of a renderer."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lpn.core.arrays import Float64Array
from tools.world.architecture import Architecture, Reflectance, RoofItem, Volume
from tools.world.geometry import area, rectangle

BAYS, STOREYS = 16, 8  # of a wall's texture
COVER = 32.0  # metres across a roof's texture
FOOT = -4.0  # walls reach this far below the ground they stand on
CROWNS = {  # radius of the crown and where it begins, for a tree of height 1
    "oak": (0.52, 0.16), "maple": (0.44, 0.14), "lime": (0.38, 0.13), "poplar": (0.17, 0.08), "fir": (0.24, 0.06),
    "bush": (0.7, 0.0),
}  # fmt: skip


@dataclass
class Mesh:
    """Polygons with one material and one tint each.

    Attributes:
        vertices: (n, 3) in metres; polygons do not share them.
        sizes: number of corners of each polygon.
        uv: (n, 2) texture coordinates.
        materials: name of each polygon's material.
        tints: linear reflectance of each polygon.
    """

    vertices: list[Float64Array] = field(default_factory=list)
    uv: list[Float64Array] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)
    materials: list[str] = field(default_factory=list)
    tints: list[Reflectance] = field(default_factory=list)

    def add(self, corners: Float64Array, material: str, tint: Reflectance, uv: Float64Array | None = None) -> None:
        """Add a polygon (k, 3)."""
        self.vertices.append(corners)
        self.uv.append(corners[:, :2] / COVER if uv is None else uv)
        self.sizes.append(len(corners))
        self.materials.append(material)
        self.tints.append(tint)

    def quads(self, corners: Float64Array, material: str, tints: Float64Array) -> None:
        """Add quadrilaterals (n, 4, 3) with tints (n, 3)."""
        self.vertices.append(corners.reshape(-1, 3))
        self.uv.append(corners.reshape(-1, 3)[:, :2] / COVER)
        self.sizes.extend([4] * len(corners))
        self.materials.extend([material] * len(corners))
        self.tints.extend((r, g, b) for r, g, b in tints.tolist())

    def wall(self, a: Float64Array, b: Float64Array, low: float, high: float, part: Volume, start: float = 0.0) -> None:
        """Add a wall from a to b with whole window units; its outside is on the right."""
        length = float(np.linalg.norm(b - a))
        bays = max(1, round(length / part.bay))
        corners = np.array([[*a, low], [*b, low], [*b, high], [*a, high]])
        floors = [(low - part.base) / part.storey, (high - part.base) / part.storey]
        uv = np.array([[start, floors[0]], [start + bays, floors[0]], [start + bays, floors[1]], [start, floors[1]]])
        self.add(corners, f"wall {part.wall}", part.wall_tint, uv / (BAYS, STOREYS))

    def box(self, x: float, y: float, z: float, length: float, width: float, height: float, angle: float,
            material: str, tint: Reflectance) -> None:  # fmt: skip
        self.prism(rectangle(x, y, length, width, angle), z, z + height, material, tint)

    def prism(self, ring: Float64Array, low: float, high: float, material: str, tint: Reflectance) -> None:
        for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            self.add(np.array([[*a, low], [*b, low], [*b, high], [*a, high]]), material, tint)
        self.add(np.column_stack([ring, np.full(len(ring), high)]), material, tint)

    def arrays(self) -> tuple[Float64Array, Float64Array, NDArray[np.int32], Float64Array]:
        """Vertices (n, 3), uv (n, 2), sizes (p,), and tints (p, 3)."""
        tints = np.array(self.tints, dtype=np.float64)
        return np.concatenate(self.vertices), np.concatenate(self.uv), np.array(self.sizes, np.int32), tints


def building(look: Architecture) -> Mesh:
    """A building in its own frame, its ground at z = 0."""
    mesh = Mesh()
    for number, part in enumerate(look.parts):
        _part(mesh, part, number * 3.0)
    for item in look.items:
        _item(mesh, item)
    return mesh


def _part(mesh: Mesh, part: Volume, start: float) -> None:
    ring = np.array(part.outline)
    if area(ring) < 0:
        ring = ring[::-1]
    low = part.base if part.base else FOOT
    cover = f"roof {part.cover}"
    flat = part.roof == "flat"
    rim = 0.7 if flat and part.eaves > 3 else 0.0
    for i, (a, b) in enumerate(zip(ring, np.roll(ring, -1, axis=0), strict=True)):
        mesh.wall(a, b, low, part.eaves + rim, part, start + 5 * i)
    if flat:
        _flat(mesh, part, ring, rim, cover)
    elif part.roof in ("dome", "cone"):
        _round(mesh, part, ring, cover)
    elif part.roof == "sawtooth":
        _sawtooth(mesh, part, ring, cover)
    else:
        _pitched(mesh, part, ring, cover)


def _flat(mesh: Mesh, part: Volume, ring: Float64Array, rim: float, cover: str) -> None:
    inner = _shrunk(ring, 0.4) if rim else ring
    mesh.add(np.column_stack([inner, np.full(len(inner), part.eaves)]), cover, part.cover_tint)
    if rim:
        top = part.eaves + rim
        light: Reflectance = tuple(min(0.7, 0.5 * v + 0.15) for v in part.wall_tint)  # type: ignore[assignment]
        following = np.roll(ring, -1, axis=0), np.roll(inner, -1, axis=0)
        for a, b, c, d in zip(ring, following[0], following[1], inner, strict=True):
            mesh.add(np.array([[*a, top], [*b, top], [*c, top], [*d, top]]), "plain", light)
            mesh.add(np.array([[*d, part.eaves], [*d, top], [*c, top], [*c, part.eaves]]), "plain", light)


def _shrunk(ring: Float64Array, by: float) -> Float64Array:
    """Move a ring inwards; it may be concave."""
    ahead = np.roll(ring, -1, axis=0) - ring
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    normal = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    before = np.roll(normal, 1, axis=0)
    middle = normal + before
    return np.asarray(ring + by * middle * (2 / (middle**2).sum(axis=1))[:, None])


def _pitched(mesh: Mesh, part: Volume, ring: Float64Array, cover: str) -> None:
    """Add a gable, hip, or barrel roof over a rectangle whose first edge runs along the ridge."""
    a, b, _, d = ring[:4]
    along = (b - a) / np.linalg.norm(b - a)
    depth = float(np.linalg.norm(d - a))
    across = (d - a) / depth
    over = 0.45 if part.roof != "barrel" else 0.0
    z, top = part.eaves, part.eaves + part.rise
    drop = over * part.rise / (depth / 2)
    if part.roof == "barrel":
        angles = np.linspace(0, np.pi, 13)
        depths, heights = depth / 2 * (1 - np.cos(angles)), z + part.rise * np.sin(angles)
        profile = list(zip(depths, heights, strict=True))
        end = 0.0
    else:
        profile = [(-over, z - drop), (depth / 2, top), (depth + over, z - drop)]
        end = depth / 2 if part.roof == "hip" else 0.0
    length = float(np.linalg.norm(b - a))
    end = min(end, length / 2 - 0.1)

    def at(x: float, y: float, height: float) -> Float64Array:
        return np.array([*(a + along * x + across * y), height])

    travelled = 0.0
    for (y0, z0), (y1, z1) in pairwise(profile):
        ends = [(end if part.roof == "hip" and y == depth / 2 else -over) for y in (y0, y1)]
        corners = [at(ends[0], y0, z0), at(length - ends[0], y0, z0), at(length - ends[1], y1, z1), at(ends[1], y1, z1)]
        step = float(np.hypot(y1 - y0, z1 - z0))
        up = z1 >= z0
        v = (travelled, travelled + step) if up else (travelled + step, travelled)
        uv = np.array([[ends[0], v[0]], [length - ends[0], v[0]], [length - ends[1], v[1]], [ends[1], v[1]]]) / COVER
        mesh.add(np.array(corners), cover, part.cover_tint, uv)
        travelled += step
    slope = float(np.hypot(depth / 2, part.rise))
    for side in (0, 1):
        x = 0.0 if side == 0 else length
        if part.roof == "hip":
            out, peak = (-over, end) if side == 0 else (length + over, length - end)
            face = [at(out, -over, z - drop), at(out, depth + over, z - drop), at(peak, depth / 2, top)]
            uv = np.array([[0, 0], [depth, 0], [depth / 2, slope]]) / COVER
            mesh.add(np.array(face), cover, part.cover_tint, uv)
        else:
            mesh.add(np.array([at(x, y, h) for y, h in profile if 0 <= y <= depth or part.roof == "barrel"]
                              + [at(x, depth, z), at(x, 0, z)]), "plain", part.wall_tint)  # fmt: skip


def _round(mesh: Mesh, part: Volume, ring: Float64Array, cover: str) -> None:
    middle = ring.mean(axis=0)
    levels = np.linspace(0, np.pi / 2, 7) if part.roof == "dome" else np.array([0.0, np.pi / 2])
    reach = np.cos(levels) if part.roof == "dome" else np.array([1.03, 0.0])
    rings = [np.column_stack([middle + (ring - middle) * r, np.full(len(ring), part.eaves + part.rise * np.sin(t))])
             for r, t in zip(reach, levels, strict=True)]  # fmt: skip
    for low, high in pairwise(rings):
        for i in range(len(ring)):
            j = (i + 1) % len(ring)
            mesh.add(np.array([low[i], low[j], high[j], high[i]]), cover, part.cover_tint)


def _sawtooth(mesh: Mesh, part: Volume, ring: Float64Array, cover: str) -> None:
    a, b, _, d = ring[:4]
    length = float(np.linalg.norm(b - a))
    along, across = (b - a) / length, d - a
    teeth = max(2, round(length / 8))
    step = length / teeth
    z, top = part.eaves, part.eaves + part.rise
    for i in range(teeth):
        p, q = a + along * i * step, a + along * (i + 1) * step
        mesh.add(np.array([[*p, top], [*q, z], [*(q + across), z], [*(p + across), top]]), cover, part.cover_tint)
        mesh.add(np.array([[*p, z], [*p, top], [*(p + across), top], [*(p + across), z]]), "glass", (0.3, 0.36, 0.4))
        for side in (np.zeros(2), across):
            mesh.add(np.array([[*(p + side), z], [*(q + side), z], [*(p + side), top]]), "plain", part.wall_tint)


def _item(mesh: Mesh, item: RoofItem) -> None:
    if item.shape == "cylinder":
        around = np.arange(8) * np.pi / 4
        ring = np.stack([np.cos(around), np.sin(around)], axis=1) * item.length / 2 + (item.x, item.y)
        mesh.prism(ring, item.z, item.z + item.height, "plain", item.tint)
    elif item.shape == "solar":
        ring = rectangle(item.x, item.y, item.length, item.width, 0.0)
        heights = item.z + np.array([0.25, 0.25, 0.25 + item.height, 0.25 + item.height])
        mesh.add(np.column_stack([ring, heights]), "glass", item.tint)
    else:
        material = "glass" if item.shape == "skylight" else "plain"
        mesh.box(item.x, item.y, item.z, item.length, item.width, item.height, 0, material, item.tint)


def tree(species: str, rng: np.random.Generator) -> Mesh:
    """Make a tree of height 1: some hundred clumps of leaves as small quads, darker inside and below."""
    mesh = Mesh()
    across, low = CROWNS[species]
    lumps, leaves = {
        "oak": (22, 2300), "maple": (17, 2000), "lime": (13, 1700), "poplar": (9, 1200), "fir": (0, 1600),
        "bush": (7, 420),
    }[species]  # fmt: skip
    if species == "fir":
        height = 1 - np.sqrt(rng.uniform(0.0, 1, leaves)) * (1 - low)
        around = rng.uniform(0, 2 * np.pi, leaves)
        reach = across * (1 - height) ** 0.85 * rng.uniform(0.75, 1.05, leaves) * (1 + 0.2 * np.sin(around * 5))
        places = np.stack([np.cos(around) * reach, np.sin(around) * reach, height], axis=1)
        outward = places * (1, 1, 0) + (0, 0, 0.15)
        size = 0.035
    else:
        centre = np.array([0, 0, (1 + low) / 2])
        half = np.array([across, across, (1 - low) / 2])
        # Lumps around the crown, then leaves on the lumps.
        direction = rng.normal(size=(lumps, 3)) + np.array([0, 0, 0.35])
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        hearts = centre + direction * half * rng.uniform(0.45, 0.72, (lumps, 1))
        pick = rng.integers(lumps, size=leaves)
        outward = rng.normal(size=(leaves, 3)) + direction[pick] * 0.6 + (0, 0, 0.3)
        outward /= np.linalg.norm(outward, axis=1)[:, None]
        reach = rng.uniform(0.22, 0.46, lumps)[pick] * rng.uniform(0.8, 1.1, leaves)
        places = hearts[pick] + outward * reach[:, None] * half
        size = 0.043 if species != "bush" else 0.13
    shade = np.clip(0.55 + 0.55 * (places[:, 2] - low) / (1 - low), 0.5, 1.1) * rng.uniform(0.7, 1.25, leaves)
    outward = outward + rng.normal(0, 0.35, outward.shape)
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    first = np.cross(outward, rng.normal(size=outward.shape))
    first /= np.linalg.norm(first, axis=1)[:, None]
    second = np.cross(outward, first)
    edge = (size * rng.uniform(0.6, 1.3, leaves))[:, None]
    u, v = edge * first, edge * second
    corners = np.stack([places - u - v * 0.6, places + u - v, places + u * 0.7 + v, places - u + v * 0.8], axis=1)
    mesh.quads(corners, "leaves", np.stack([shade, shade, shade * rng.uniform(0.8, 1.1, leaves)], axis=1))
    if species not in ("fir", "bush"):
        mesh.box(0, 0, -0.1, 0.03, 0.03, 0.1 + (1 + low) / 2, 0, "plain", (0.1, 0.08, 0.06))
    return mesh


def vehicle(kind: str) -> Mesh:
    """Make a vehicle along x in metres; faces of material `paint` take the object's colour."""
    mesh = Mesh()
    white, dark = (1.0, 1.0, 1.0), (0.03, 0.035, 0.04)
    if kind == "car":
        mesh.box(0, 0, 0.25, 4.4, 1.8, 0.65, 0, "paint", white)
        low, high = rectangle(-0.25, 0, 2.9, 1.66, 0), rectangle(-0.35, 0, 1.7, 1.4, 0)
        for i in range(4):
            j = (i + 1) % 4
            mesh.add(np.array([[*low[i], 0.9], [*low[j], 0.9], [*high[j], 1.45], [*high[i], 1.45]]), "glass", dark)
        mesh.add(np.column_stack([high, np.full(4, 1.46)]), "paint", white)
    elif kind == "van":
        mesh.box(-0.4, 0, 0.3, 4.4, 2.0, 1.8, 0, "paint", white)
        mesh.box(2.2, 0, 0.3, 0.9, 1.9, 0.9, 0, "paint", white)
        mesh.add(np.array([[2.5, -0.9, 1.2], [2.5, 0.9, 1.2], [1.8, 0.9, 2.1], [1.8, -0.9, 2.1]]), "glass", dark)
    elif kind == "truck":
        mesh.box(-1.0, 0, 0.9, 7.5, 2.5, 2.7, 0, "plain", (0.55, 0.55, 0.53))
        mesh.box(3.9, 0, 0.5, 1.9, 2.4, 2.3, 0, "paint", white)
    else:
        mesh.box(0, 0, 0.4, 11.5, 2.5, 2.6, 0, "paint", white)
        mesh.box(-2, 0, 3.0, 2.2, 1.5, 0.3, 0, "plain", (0.5, 0.5, 0.5))
    return mesh


def bridge(length: float, width: float) -> Mesh:
    """Make a deck along x with pavements, rails, a broken line, and piers; its top is z = 0."""
    mesh = Mesh()
    mesh.box(0, 0, -1.6, length, width, 1.6, 0, "plain", (0.15, 0.15, 0.15))
    for side in (-1, 1):
        mesh.box(0, side * (width / 2 - 1.4), 0, length, 2.8, 0.18, 0, "plain", (0.34, 0.33, 0.3))
        mesh.box(0, side * (width / 2 - 0.2), 0, length, 0.4, 1.1, 0, "plain", (0.42, 0.41, 0.38))
    for x in np.arange(-length / 2 + 2, length / 2 - 2, 9.0):
        mesh.box(float(x), 0, 0.0, 3.0, 0.18, 0.02, 0, "plain", (0.6, 0.6, 0.58))
    for x in np.arange(-length / 2 + length / 5, length / 2 - 5, length / 5):
        mesh.box(float(x), 0, -9, 2.4, width * 0.9, 7.6, 0, "plain", (0.3, 0.29, 0.27))
    return mesh
