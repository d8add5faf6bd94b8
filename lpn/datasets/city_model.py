"""The 3-D model of a data set's city: `city.glb` beside `geo.csv`, or `city.glb.gz`, the same file compressed by gzip.

The uncompressed file is a self-contained binary glTF of at most 4 MB, in metres: y is up, x is east, -z is north. The extras
of its scene or asset record the latitude and longitude (WGS 84 degrees) of its origin:

    "scenes": [{"nodes": [0], "extras": {"latitude": 46.2, "longitude": -31.4}}]

Any program may write one.
"""

from __future__ import annotations

import gzip
import json
import re
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lpn.core.errors import DataError
from lpn.datasets.geo import Position

NAME = "city.glb"
PACKED = f"{NAME}.gz"
# The largest model in bytes; every browser that opens the map loads it.
MAX_BYTES = 4_000_000


@dataclass(frozen=True)
class CityModel:
    """A 3-D model.

    Attributes:
        data: the file, uncompressed.
        origin: the geographic position of the model's origin.
    """

    data: bytes
    origin: Position


def city_model(root: Path) -> CityModel | None:
    """Read the city model of a data set's folder; None if it has neither `city.glb` nor `city.glb.gz`.

    Raises:
        DataError: if the file cannot be used.
    """
    path = next((root / name for name in (NAME, PACKED) if (root / name).is_file()), None)
    if path is None:
        return None
    try:
        with path.open("rb") if path.name == NAME else gzip.open(path) as file:
            data = file.read(MAX_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise DataError(f"{path} cannot be read, or is damaged ({error}); copy it again.") from error
    if len(data) > MAX_BYTES:
        raise DataError(
            f"{path.name} has more than {MAX_BYTES / 1e6:g} MB uncompressed; expected at most as many, so leave detail out."
        )
    return CityModel(data, _origin(_header(data, path.name), path.name))


def _header(data: bytes, name: str) -> dict[str, Any]:
    """Parse the JSON chunk of a GLB file; references to other files are refused."""
    if len(data) < 20 or data[:4] != b"glTF" or data[16:20] != b"JSON":
        raise DataError(f"{name} is not a binary glTF file; export it as .glb.")
    version, length, size = struct.unpack_from("<III", data, 4)
    if version != 2:
        raise DataError(f"{name} is of glTF version {version}; expected version 2.")
    if length != len(data):
        raise DataError(f"{name} has {len(data)} bytes where it says {length}; copy it again.")
    try:
        header = json.loads(data[20 : 20 + size])
    except (ValueError, RecursionError) as error:
        raise DataError(f"{name} is damaged: its header is not JSON; export it again.") from error
    if re.search(rb'"uri"\s*:\s*"(?!data:)', data[20 : 20 + size]):
        raise DataError(f"{name} refers to other files; export it with everything embedded.")
    if b"KHR_draco_mesh_compression" in data[20 : 20 + size]:
        raise DataError(f"{name} is compressed with Draco, which is not supported; export it without.")
    return header if isinstance(header, dict) else {}


def _origin(header: dict[str, Any], name: str) -> Position:
    scenes = header.get("scenes")
    parts = [*(scenes if isinstance(scenes, list) else ()), header.get("asset")]
    extras = [part.get("extras") for part in parts if isinstance(part, dict)]
    for values in extras:
        if isinstance(values, dict) and {"latitude", "longitude"} <= {*values}:
            latitude, longitude = values["latitude"], values["longitude"]
            if not all(type(value) in (int, float) for value in (latitude, longitude)) or not (
                -90 <= latitude <= 90 and -180 <= longitude <= 180
            ):
                raise DataError(
                    f"{name} has its origin at {latitude!r}, {longitude!r}; expected degrees of latitude and longitude."
                )
            return Position(float(latitude), float(longitude))
    raise DataError(
        f"{name} does not say where it stands; record latitude and longitude of its origin in its scene's extras."
    )
