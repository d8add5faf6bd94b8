"""A compact writer of binary glTF: 16-bit positions and indices, 8-bit colours.

trimesh and Blender read such files; files that they write use 32 bits for each number and are twice as large.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpn.core.arrays import Float64Array

# Maximum number of vertices of a primitive; index 65535 is reserved.
MOST_VERTICES = 65_535
_STEPS = 65_534  # of a place along the longest side
_BYTE, _USHORT, _SHORT, _FLOAT = 5121, 5123, 5122, 5126
_VERTICES, _INDICES = 34962, 34963


@dataclass(frozen=True)
class Primitive:
    """Triangles of one material.

    Attributes:
        name: of the mesh in the file.
        vertices: (n, 3) metres east, north, up; n is at most `MOST_VERTICES`.
        faces: (t, 3) corners, counter-clockwise from outside.
        colours: (n, 3) uint8, linear, or None for white.
        uv: (n, 2) texture coordinates from the top left corner, or None without a picture.
        picture: a JPEG or PNG file that multiplies the colours, or None.
    """

    name: str
    vertices: Float64Array
    faces: NDArray[np.int64]
    colours: NDArray[np.uint8] | None = None
    uv: Float64Array | None = None
    picture: bytes | None = None


def glb(primitives: Sequence[Primitive], extras: dict[str, Any]) -> bytes:
    """Encode primitives as a file that shows them unlit; `extras` belong to its scene."""
    low = np.min([p.vertices.min(axis=0) for p in primitives], axis=0)
    high = np.max([p.vertices.max(axis=0) for p in primitives], axis=0)
    middle, step = (low + high) / 2, float((high - low).max()) / _STEPS
    file = _File()
    for primitive in primitives:
        file.add(primitive, np.rint((primitive.vertices - middle) / step).astype(np.int16))
    east, north, up = middle.tolist()
    # The first node turns z up into glTF's y up, the second takes steps to metres.
    nodes = [
        {"name": "city", "rotation": [-(0.5**0.5), 0, 0, 0.5**0.5], "children": [1]},
        {"translation": [east, north, up], "scale": [step] * 3, "children": list(range(2, 2 + len(primitives)))},
        *({"name": primitive.name, "mesh": i} for i, primitive in enumerate(primitives)),
    ]
    used = ["KHR_mesh_quantization", "KHR_materials_unlit"]
    header = {
        "asset": {"version": "2.0", "generator": "lpn-explorer"},
        "extensionsUsed": used,
        "extensionsRequired": used[:1],
        "scene": 0,
        "scenes": [{"nodes": [0], "extras": extras}],
        "nodes": nodes,
        **file.tables(),
    }
    return _joined(json.dumps(header, separators=(",", ":")).encode(), bytes(file.data))


class _File:
    """The binary part of the file, and the JSON tables that describe it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._meshes: list[dict[str, Any]] = []
        self._materials: list[dict[str, Any]] = []
        self._pictures: dict[bytes, int] = {}
        self._material_of: dict[bytes | None, int] = {}

    def add(self, primitive: Primitive, places: NDArray[np.int16]) -> None:
        attributes = {"POSITION": self._array(places, _SHORT, "VEC3", bounds=True)}
        if primitive.colours is not None:
            attributes["COLOR_0"] = self._array(primitive.colours, _BYTE, "VEC3", normalized=True)
        if primitive.uv is not None:
            attributes["TEXCOORD_0"] = self._array(primitive.uv.astype(np.float32), _FLOAT, "VEC2")
        faces = primitive.faces.astype(np.uint16).reshape(-1)
        triangles = {
            "attributes": attributes,
            "indices": self._accessor(faces.tobytes(), {"target": _INDICES}, _USHORT, "SCALAR", len(faces)),
            "material": self._material(primitive.picture),
        }
        self._meshes.append({"name": primitive.name, "primitives": [triangles]})

    def tables(self) -> dict[str, Any]:
        pictures = {
            "images": [
                {"bufferView": view, "mimeType": "image/jpeg" if picture[:2] == b"\xff\xd8" else "image/png"}
                for picture, view in self._pictures.items()
            ],
            "textures": [{"source": i} for i in range(len(self._pictures))],
        }
        return {
            "meshes": self._meshes,
            "materials": self._materials,
            **(pictures if self._pictures else {}),
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": len(self.data)}],
        }

    def _material(self, picture: bytes | None) -> int:
        if picture not in self._material_of:
            surface: dict[str, Any] = {"metallicFactor": 0, "roughnessFactor": 1}
            if picture is not None:
                surface["baseColorTexture"] = {"index": len(self._pictures)}
                self._pictures[picture] = self._view(picture, {})
            self._material_of[picture] = len(self._materials)
            self._materials.append({"pbrMetallicRoughness": surface, "extensions": {"KHR_materials_unlit": {}}})
        return self._material_of[picture]

    def _array(
        self, values: NDArray[Any], kind: int, shape: str, bounds: bool = False, normalized: bool = False
    ) -> int:
        """Append a vertex attribute (n, k), each vertex aligned to four bytes."""
        more: dict[str, Any] = {"normalized": True} if normalized else {}
        if bounds:
            more |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        width = values.itemsize * values.shape[1]
        padded = np.zeros((len(values), -(-width // 4) * 4), np.uint8)
        padded[:, :width] = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), width)
        layout = {"target": _VERTICES, "byteStride": padded.shape[1]}
        return self._accessor(padded.tobytes(), layout, kind, shape, len(values), more)

    def _accessor(
        self, data: bytes, layout: dict[str, int], kind: int, shape: str, count: int, more: dict[str, Any] | None = None
    ) -> int:
        view = self._view(data, layout)
        self._accessors.append(
            {"bufferView": view, "componentType": kind, "count": count, "type": shape, **(more or {})}
        )
        return len(self._accessors) - 1

    def _view(self, data: bytes, layout: dict[str, int]) -> int:
        self._views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **layout})
        self.data += data + bytes(-len(data) % 4)
        return len(self._views) - 1


def _joined(header: bytes, data: bytes) -> bytes:
    header += b" " * (-len(header) % 4)
    total = 12 + 8 + len(header) + 8 + len(data)
    return b"".join(
        [
            struct.pack("<4sII", b"glTF", 2, total),
            struct.pack("<I4s", len(header), b"JSON"),
            header,
            struct.pack("<I4s", len(data), b"BIN\0"),
            data,
        ]
    )
