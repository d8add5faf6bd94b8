"""The 3-D model of a data set's city: `city.glb` beside `geo.csv`, or `city.glb.gz`, the same file compressed by gzip.

The uncompressed file is a self-contained binary glTF of at most 4 MB, in metres: y is up, x is east, -z is north. The extras
of its scene or asset record the latitude and longitude (WGS 84 degrees) of its origin:

    "scenes": [{"nodes": [0], "extras": {"latitude": 46.2, "longitude": -31.4}}]

Any program may write one.
"""

from __future__ import annotations

import gzip
import json
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

_MAGIC, _JSON, _BINARY = b"glTF", b"JSON", b"BIN\0"
_DRACO = "KHR_draco_mesh_compression"


@dataclass(frozen=True)
class CityModel:
    """A 3-D model.

    Attributes:
        data: the file, uncompressed.
        origin: the position of the model's origin.
        base: metres above the datum of heights at which the model's height is 0.
        top: height of the model in metres above which tiles and lines are drawn.
    """

    data: bytes
    origin: Position
    base: float = 0.0
    top: float = 42.0


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
    except OSError as error:
        raise DataError(
            f"{path} cannot be read ({error.strerror or error}); check that it is there and readable."
        ) from error
    except (EOFError, zlib.error) as error:
        raise DataError(f"{path} is damaged: it cannot be uncompressed ({error}); copy it again.") from error
    if len(data) > MAX_BYTES:
        raise DataError(
            f"{path.name} has more than {MAX_BYTES / 1e6:g} MB uncompressed; expected at most as many, so leave detail out."
        )
    return CityModel(data, _origin(_header(data, path.name), path.name))


def _header(data: bytes, name: str) -> dict[str, Any]:
    """Parse and check the JSON chunk of a GLB file of this name."""
    if len(data) < 20 or data[:4] != _MAGIC or data[16:20] != _JSON:
        raise DataError(f"{name} is not a binary glTF file; export it as .glb.")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise DataError(f"{name} is of glTF version {version}; expected version 2.")
    chunks = _chunks(data)
    if length != len(data) or chunks is None:
        raise DataError(f"{name} has {len(data)} bytes where it says {length} or its parts do; copy it again.")
    # With two JSON chunks, a browser might read the one that was not checked.
    if [kind for kind, _ in chunks] not in ([_JSON], [_JSON, _BINARY]):
        raise DataError(f"{name} holds more than a header and one block of data; export it again.")
    try:
        header = json.loads(chunks[0][1])
    except (ValueError, RecursionError) as error:
        raise DataError(f"{name} is damaged: its header is not JSON; export it again.") from error
    if not isinstance(header, dict):
        raise DataError(f"{name} is damaged: its header is not a glTF scene; export it again.")
    # The page must load nothing from elsewhere: no other files, and no decoder for compressed meshes.
    if _refers(header):
        raise DataError(f"{name} refers to other files; export it with everything embedded.")
    if _DRACO in str([header.get("extensionsUsed"), header.get("extensionsRequired")]):
        raise DataError(f"{name} is compressed with Draco, which is not supported; export it without.")
    return header


def _chunks(data: bytes) -> list[tuple[bytes, bytes]] | None:
    """Return the kind and content of each chunk; None if they do not end with the file."""
    chunks, at = [], 12
    while at + 8 <= len(data):
        (size,) = struct.unpack_from("<I", data, at)
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 8 + size
    return chunks if at == len(data) else None


def _refers(value: object) -> bool:
    """Return whether a value contains a URI other than a data URI."""
    if isinstance(value, dict):
        own = "uri" in value and not str(value["uri"]).startswith("data:")
        return own or any(_refers(below) for below in value.values())
    return isinstance(value, list) and any(_refers(below) for below in value)


def _origin(header: dict[str, Any], name: str) -> Position:
    extras = [part.get("extras") for part in (*_dicts(header.get("scenes")), *_dicts([header.get("asset")]))]
    for values in _dicts(extras):
        if "latitude" in values and "longitude" in values:
            latitude, longitude = values["latitude"], values["longitude"]
            if not (_degrees(latitude, 90) and _degrees(longitude, 180)):
                raise DataError(
                    f"{name} has its origin at {latitude!r}, {longitude!r}; expected degrees of latitude and longitude."
                )
            return Position(float(latitude), float(longitude))
    raise DataError(
        f"{name} does not say where it stands; record latitude and longitude of its origin in its scene's extras."
    )


def _degrees(value: object, limit: float) -> bool:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and -limit <= value <= limit  # type: ignore[operator]


def _dicts(values: object) -> list[dict[str, Any]]:
    return [value for value in values if isinstance(value, dict)] if isinstance(values, list) else []
