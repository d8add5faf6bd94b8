"""The relief of a map as a 3-D model."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from lpn.datasets.city_model import MAX_BYTES
from lpn.locate.relief import relief_model
from lpn.maps import open_map
from lpn.maps.elevation import ElevationFile
from lpn.maps.folder import build_map
from tests.lpn.maps.small_maps import EAST, NORTH, smooth, write_geotiff


def test_the_relief_stands_on_the_ground_with_the_map_on_it(tmp_path: Path) -> None:
    ortho = write_geotiff(tmp_path / "ortho.tif", smooth(200, 120))
    heights = np.full((60, 40, 1), 300.0, np.float32)
    heights[20:30, 10:20] = 330.0
    heights[:5] = np.nan
    dsm = write_geotiff(tmp_path / "dsm.tif", heights, matrix=(2, 0, EAST - 5, 0, -2, NORTH + 5))
    basemap = build_map([ortho], tmp_path / "map", elevation=ElevationFile(dsm))
    model = relief_model(basemap)
    assert model is not None
    assert (model.base, model.top) == pytest.approx((300.0, 38.0))
    assert len(model.data) < MAX_BYTES
    assert model.origin.latitude == basemap.frame.latitude
    length = struct.unpack_from("<I", model.data, 12)[0]
    header = json.loads(model.data[20 : 20 + length])
    position = header["accessors"][header["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    place = header["nodes"][1]
    low, high = (np.array(position[end]) * place["scale"][0] + place["translation"] for end in ("min", "max"))
    np.testing.assert_allclose([*low, *high], [*basemap.bounds[:2], 0, *basemap.bounds[2:], 30], atol=0.02)
    # Ground without a height has no triangles: some 5 of the map's 100 m from the north.
    index = header["accessors"][header["meshes"][0]["primitives"][0]["indices"]]
    assert 0.85 < index["count"] / 3 / (2 * 249 * 149) < 0.98
    assert header["images"][0]["mimeType"] == "image/jpeg"
    assert relief_model(open_map(ortho)) is None
