"""city.glb: the reader of the 3-D model that the explorer takes, and the writer of its triangles."""

from __future__ import annotations

import gzip
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lpn.core.errors import DataError
from lpn.datasets.city_model import MAX_BYTES, NAME, PACKED, city_model
from tools.fixtures import small_worlds
from tools.fixtures.glb_parts import header


def test_a_model_may_be_compressed(tmp_path: Path) -> None:
    whole = small_worlds.city()
    packed = gzip.compress(whole)
    for name, data in ((PACKED, packed), (NAME, whole)):
        (tmp_path / name).write_bytes(data)
        read = city_model(tmp_path)
        assert read is not None
        assert read.data == whole
        (tmp_path / name).unlink()
    damaged = packed[:20] + bytes(20) + packed[40:]
    for data, error in ((packed[:-9], "damaged"), (damaged, "damaged"), (whole, "Not a gzipped file")):
        (tmp_path / PACKED).write_bytes(data)
        with pytest.raises(DataError, match=error):
            city_model(tmp_path)
    (tmp_path / PACKED).write_bytes(gzip.compress(bytes(MAX_BYTES + 1)))
    with pytest.raises(DataError, match=r"city\.glb\.gz has more than 4 MB uncompressed"):
        city_model(tmp_path)


def test_a_folder_without_a_city_has_none(tmp_path: Path) -> None:
    assert city_model(tmp_path) is None


def _changed(change: Callable[[dict[str, Any]], object]) -> bytes:
    """A good file with something changed in its header."""
    good = small_worlds.city()
    values = header(good)
    change(values)
    text = json.dumps(values).encode()
    body = good[20 + struct.unpack_from("<I", good, 12)[0] :]
    total = 20 + len(text) + len(body)
    return struct.pack("<4sIII4s", b"glTF", 2, total, len(text), b"JSON") + text + body


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "not a binary glTF"),
        (b"solid cube\n" * 9, "not a binary glTF"),
        (small_worlds.city()[:-40], "where it says"),
        (small_worlds.city() + b"more", "where it says"),
        (small_worlds.city().replace(b"glTF\2", b"glTF\1", 1), "version 1"),
        (small_worlds.city().replace(b'{"asset"', b'["asset"', 1), "not JSON"),
        (_changed(lambda h: h["scenes"][0].pop("extras")), "does not say where it stands"),
        (_changed(lambda h: h["scenes"][0].update(extras={"latitude": 1})), "does not say where it stands"),
        (_changed(lambda h: h["scenes"][0].update(extras={"latitude": 91, "longitude": 0})), "expected degrees"),
        (_changed(lambda h: h["scenes"][0].update(extras={"latitude": "1", "longitude": 0})), "expected degrees"),
        (_changed(lambda h: h.update(images=[{"uri": "http://example.org/x.png"}])), "refers to other files"),
        (_changed(lambda h: h.update(images={"0": {"uri": "http://example.org/x.png"}})), "refers to other files"),
        (_changed(lambda h: h.update(extensions={"X": [{"uri": "//example.org"}]})), "refers to other files"),
        (_changed(lambda h: h["scenes"][0].update(extras={"latitude": 10**400, "longitude": 0})), "expected degrees"),
        (_changed(lambda h: h.update(extensionsUsed=["KHR_draco_mesh_compression"])), "compressed with Draco"),
        (bytes(MAX_BYTES + 1), "has more than 4 MB"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_in_one_sentence(tmp_path: Path, data: bytes, said: str) -> None:
    (tmp_path / NAME).write_bytes(data)
    with pytest.raises(DataError, match=said) as caught:
        city_model(tmp_path)
    assert str(caught.value).startswith(NAME)
    assert "\n" not in str(caught.value)


def test_the_origin_may_be_the_asset_s(tmp_path: Path) -> None:
    def move(values: dict[str, Any]) -> None:
        values["asset"]["extras"] = values["scenes"][0].pop("extras") | {"latitude": -12.5}

    (tmp_path / NAME).write_bytes(_changed(move))
    read = city_model(tmp_path)
    assert read is not None
    assert read.origin.latitude == -12.5
