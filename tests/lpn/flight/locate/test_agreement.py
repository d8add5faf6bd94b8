from __future__ import annotations

import cv2
import numpy as np
import pytest

from lpn.core.arrays import UInt8Array
from lpn.flight.locate.agreement import MapAgreement, map_agreement
from lpn.flight.maps import Map, Window, open_map
from tests.lpn.flight.maps.small_maps import EAST, NORTH, write_geotiff

# Pixels of a photo that shows 80 m of ground, and metres per pixel.
SIZE, SCALE = 320, 0.25


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Map:
    """A map of 200 by 200 m in pixels of 0.25 m."""
    pytest.importorskip("rasterio")
    grains = np.random.default_rng(0).integers(20, 230, (160, 160, 3), dtype=np.uint8)
    ground = cv2.resize(grains, (800, 800), interpolation=cv2.INTER_CUBIC)
    file = tmp_path_factory.mktemp("town") / "town.tif"
    return open_map(write_geotiff(file, ground, matrix=(SCALE, 0, EAST, 0, -SCALE, NORTH)))


def compared(town: Map, photo: UInt8Array, east: float = 0.0) -> MapAgreement:
    """Compare a north-up photo about the map's middle, laid some metres to the east of there."""
    half = SCALE * (SIZE - 1) / 2
    return map_agreement(town, photo, np.array([[SCALE, 0, east - half], [0, -SCALE, half], [0, 0, 1.0]]), (SIZE, SIZE))


def photographed(town: Map) -> UInt8Array:
    return town.read(Window(0.0, 0.0, SIZE * SCALE), SIZE)[0]


def test_a_part_of_a_photo_that_the_map_has_elsewhere_is_measured_there(town: Map) -> None:
    photo = photographed(town)
    agreeing = compared(town, photo)
    assert len(agreeing.metres) >= 9
    assert agreeing.metres.max() < 0.5
    bent = photo.copy()
    bent[:, : SIZE // 2] = np.roll(photo, 12, axis=0)[:, : SIZE // 2]  # 3 m to the south
    found = compared(town, bent)
    left, right = found.metres[found.places[:, 0] < 0.35], found.metres[found.places[:, 0] > 0.65]
    assert len(left) >= 3
    assert len(right) >= 3
    np.testing.assert_allclose(left, 3.0, atol=0.5)
    north = found.offsets[found.places[:, 0] < 0.35, 1]
    # The map has it to the north of where the photo has it.
    np.testing.assert_allclose(north, 3.0, atol=0.5)
    assert right.max() < 0.5


def test_a_place_on_the_border_of_the_search_is_left_out_as_a_better_one_may_lie_beyond(town: Map) -> None:
    photo = photographed(town)
    beyond = round(compared(town, photo).reach / SCALE + 0.5)
    bent = photo.copy()
    bent[:, : SIZE // 2] = np.roll(photo, beyond, axis=0)[:, : SIZE // 2]
    matched = compared(town, bent)
    assert len(matched.metres) >= 3
    assert (matched.places[:, 0] > 0.35).all()


def test_a_photo_of_another_place_or_without_contrast_agrees_nowhere(town: Map) -> None:
    photo = photographed(town)
    assert len(compared(town, np.random.default_rng(1).permutation(photo)).metres) == 0
    assert len(compared(town, np.full_like(photo, 90)).metres) == 0
    assert len(compared(town, photo, east=90.0).metres) == 0, "half of it is off the map, and the rest is elsewhere"


def test_a_photo_that_reaches_the_horizon_is_not_compared(town: Map) -> None:
    tilted = np.array([[SCALE, 0, 0], [0, -SCALE, 0], [0, -1 / SIZE, 1.0]])
    assert len(map_agreement(town, photographed(town), tilted, (SIZE, SIZE)).metres) == 0


def test_a_photo_may_be_given_smaller_than_it_is(town: Map) -> None:
    half = SCALE * (SIZE - 1) / 2
    matrix = np.array([[SCALE / 2, 0, -half], [0, -SCALE / 2, half], [0, 0, 1.0]])
    found = map_agreement(town, photographed(town), matrix, (2 * SIZE, 2 * SIZE))
    assert len(found.metres) >= 9
    assert found.metres.max() < 0.5


def test_the_farthest_place_may_be_farther_where_it_lies_at_the_border_of_the_search() -> None:
    def of(*metres: float) -> MapAgreement:
        return MapAgreement([(0.5, 0.5, 0.0, one) for one in metres], 10.0)

    assert [of(1.0, 2.0, one).may_be_larger for one in (8.9, 9.1)] == [False, True]
    assert (of(1.0, 2.0, 9.1).median, of(1.0, 2.0, 9.1).largest) == (2.0, 9.1)
    assert (of(1.0, 2.0).median, of(1.0, 2.0).largest) == (None, None), "too few"
    assert not of().may_be_larger
