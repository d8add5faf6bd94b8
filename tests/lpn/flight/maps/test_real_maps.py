"""Real orthophotos, where LPN_FLIGHTS names the folder of the flights."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from lpn.flight.maps import Window, open_map

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
    # The frame's north differs from UTM's, so the bounds are a little wider than the sheet.
    assert (east - west, north - south) == pytest.approx(metres, rel=0.04)
    assert town.resolution == pytest.approx(resolution, rel=2e-3)
    shown = metres[0] * metres[1] * valid
    assert town.overview(500)[1].mean() * (east - west) * (north - south) == pytest.approx(shown, rel=0.03)
    picture, known = town.read(Window(0, 0, 40), 224)
    assert known.all()
    assert not (picture > 245).all(axis=2).any()
    turned, _ = town.read(Window(0, 0, 40, 180), 224)
    assert np.abs(turned[::-1, ::-1].astype(int) - picture).mean() < 0.6
