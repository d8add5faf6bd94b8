"""Real orthophotos, where LPN_FLIGHTS names the folder of the flights."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from lpn.flight.maps import MapOptions, Window, open_map
from tools.fixtures.small_tiles import write_folder

FLIGHTS = os.environ.get("LPN_FLIGHTS")
pytestmark = pytest.mark.skipif(not FLIGHTS, reason="LPN_FLIGHTS does not name the folder of the real flights")


@pytest.mark.parametrize(
    ("name", "metres", "resolution", "valid"),
    [
        ("caliterra/map.tif", (176, 200), 0.233, 0.56),  # its alpha band is opaque, and white where nothing is known
        ("brighton/map.jpg", (162, 95), 0.0871, 0.36),
        ("seneca/map.jpg", (538, 543), 0.465, 0.46),
    ],
)
def test_real_maps_are_read_without_their_borders(
    name: str, metres: tuple[int, int], resolution: float, valid: float
) -> None:
    town = open_map(Path(str(FLIGHTS)) / name)
    west, south, east, north = town.bounds
    # The frame's north is not that of UTM, so that the bounds are a little wider than the sheet.
    assert (east - west, north - south) == pytest.approx(metres, rel=0.04)
    assert town.resolution == pytest.approx(resolution, rel=2e-3)
    shown = metres[0] * metres[1] * valid
    assert town.overview(500)[1].mean() * (east - west) * (north - south) == pytest.approx(shown, rel=0.03)
    picture, known = town.read(Window(0, 0, 40), 224)
    assert known.all()
    assert not (picture > 245).all(axis=2).any()
    turned, _ = town.read(Window(0, 0, 40, 180), 224)
    assert np.abs(turned[::-1, ::-1].astype(int) - picture).mean() < 0.6


@pytest.mark.parametrize("name", ["caliterra/map.tif", "brighton/map.jpg", "seneca/map.jpg"])
@pytest.mark.parametrize(
    ("names", "words"),
    [
        ("{z}/{x}/{y}.jpg", None),
        ("{z}/{x}/{south}.jpg", "rows count from the south (TMS): there the tiles fit together."),
        ("{z}/{y}/{x}.jpg", "names are {z}/{y}/{x}, with rows from the north: there the tiles fit together."),
    ],
)
def test_tiles_of_real_maps_fit_together_in_their_order(
    tmp_path: Path, name: str, names: str, words: str | None
) -> None:
    import rasterio
    from rasterio.windows import Window as Pixels

    with rasterio.open(Path(str(FLIGHTS)) / name) as file:
        rows, columns = (min(1024, side // 256 * 256) for side in file.shape)
        middle = Pixels((file.width - columns) // 2, (file.height - rows) // 2, columns, rows)
        picture = np.ascontiguousarray(np.moveaxis(file.read([1, 2, 3], window=middle), 0, 2))
    town = open_map(write_folder(tmp_path / "town", picture, names), MapOptions(keep_borders=True))
    assert town.frame.latitude > 48
    assert town.notes[1:] == ([f"In town, {words}"] if words else [])
