"""A real flight over its own map; LPN_FLIGHTS names the folder of flights."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from lpn.flight.files import open_flight
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.pipeline import locate
from lpn.flight.maps import open_map

# Two photos as taken, and two that someone turned by 180 degrees.
PHOTOS = ("DJI_0024", "DJI_0028", "DJI_0031", "DJI_0034")


@pytest.mark.slow
def test_photos_of_brighton_are_registered_and_turned_ones_are_named() -> None:
    if "LPN_FLIGHTS" not in os.environ:
        pytest.skip("LPN_FLIGHTS names no folder of real flights")
    pytest.importorskip("rasterio")
    folder = Path(os.environ["LPN_FLIGHTS"]) / "brighton"
    flight = open_flight(folder / "photos")
    chosen = tuple(frame for frame in flight.frames if frame.file.stem in PHOTOS)
    found = locate(open_map(folder / "map.jpg"), replace(flight, frames=chosen), None, LocateOptions())
    assert [located.stages["registration"].accepted for located in found.frames] == [True] * 4
    assert max(located.error("registration") or 99.0 for located in found.frames) < 4
    assert any("2 photos are turned" in note and "DJI_0024" in note and "DJI_0028" in note for note in found.notes)
