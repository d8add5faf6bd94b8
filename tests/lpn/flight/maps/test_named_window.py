from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lpn.core.errors import PictureError
from lpn.flight.maps import LocalFrame, NamedWindow, Window, open_map
from lpn.flight.maps.named_window import WindowCut, caption_of, covers_part_of, describe_offset
from tests.lpn.flight.maps.small_maps import smooth, write_geotiff


@pytest.mark.parametrize(
    ("window", "ending"),
    [
        (Window(12.3, -45.6, 70.0), ",70m"),
        (Window(0, 0, 83.666, -0.004), ",83.67m"),
        (Window(5, 5, 9.5, -30.0), ",9.5m,330deg"),
    ],
)
def test_the_name_of_a_window_leads_back_to_it(window: Window, ending: str) -> None:
    frame = LocalFrame(-48.0, 9.0)
    named = NamedWindow.all_of([window], frame)[0]
    assert named.name.endswith(ending)
    assert NamedWindow.parse(named.name) == named
    (again,) = NamedWindow.all_on([named], frame)
    assert np.hypot(again.x - window.x, again.y - window.y) < 0.01
    assert again.size == pytest.approx(window.size, abs=0.005)
    assert (again.heading - window.heading + 180) % 360 - 180 == pytest.approx(0, abs=0.005)


@pytest.mark.parametrize(
    "name",
    [
        "",
        "0001/0001.jpg",
        "48.0,9.0,70m",
        "48.0000000,9.0000000,0m",
        "98.0000000,9.0000000,7m",
        "48.0000000,9.0000000,7m,360deg",
        "48.0000000,9.0000000,7m.jpg",
    ],
)
def test_other_names_are_no_windows(name: str) -> None:
    assert NamedWindow.parse(name) is None


def test_a_window_is_cut_again_from_its_name(tmp_path: Path) -> None:
    town = open_map(write_geotiff(tmp_path / "town.tif", smooth(200, 300)))
    window = Window(10.0, -20.0, 40.0, 30.0)
    (named,) = NamedWindow.all_on(NamedWindow.all_of([window], town.frame), town.frame)
    cut = WindowCut(town, named, 64)()
    np.testing.assert_allclose(cut, town.read(window, 64)[0], atol=2)
    assert covers_part_of(town, named)
    assert not covers_part_of(town, Window(5000.0, 0.0, 40.0))


def test_a_damaged_map_is_a_picture_that_cannot_be_read(tmp_path: Path) -> None:
    file = write_geotiff(tmp_path / "town.tif", smooth(200, 300), compress="deflate")
    town = open_map(file)
    town.close()
    data = bytearray(file.read_bytes())
    data[len(data) // 4 : 3 * len(data) // 4] = bytes(len(data) // 2)
    file.write_bytes(data)
    with pytest.raises(PictureError):
        WindowCut(town, Window(0, 0, 90.0), 64)()


@pytest.mark.parametrize(
    ("x", "y", "place"),
    [
        (-46.1, 0.2, "46 m west of the map's middle"),
        (1234.0, -13.0, "1,234 m east and 13 m south of the map's middle"),
        (0.3, -0.4, "in the map's middle"),
    ],
)
def test_a_place_is_said_in_metres_and_no_degrees(x: float, y: float, place: str) -> None:
    assert describe_offset(x, y) == place


def test_a_window_has_a_short_caption() -> None:
    assert caption_of(Window(-46.1, 12.0, 36.6)) == "46 m W, 12 m N, 37 m wide"
