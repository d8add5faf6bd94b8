"""The drawn land as a map, and a flight over it; no test changes them."""

from __future__ import annotations

import cv2
import pytest

from lpn.flight.files import Flight
from lpn.flight.maps import Map
from tests.lpn.flight.locate.scenery import SIDE, land, small_flight, write_map


@pytest.fixture(scope="session")
def town(tmp_path_factory: pytest.TempPathFactory) -> Map:
    """A map in pixels of 0.5 m, which are coarser than those of the photos."""
    picture = cv2.resize(land(), (SIDE // 2, SIDE // 2), interpolation=cv2.INTER_AREA)
    return write_map(tmp_path_factory.mktemp("coarse") / "town.tif", picture)


@pytest.fixture(scope="session")
def monday(town: Map, tmp_path_factory: pytest.TempPathFactory) -> Flight:
    return small_flight(tmp_path_factory.mktemp("monday"), town)
