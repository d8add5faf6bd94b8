from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj
import pytest

from lpn.core.errors import InputError, PictureError
from lpn.flight.maps import LocalFrame, NamedWindow, Window, open_map
from lpn.flight.maps.named_window import WindowCut, caption_of, covers_part_of, describe_offset
from lpn.flight.maps.window import grid
from tests.lpn.flight.maps.small_maps import smooth, write_geotiff


@pytest.mark.parametrize("origin", [(48.0, 9.0), (-33.9, 151.2), (65.0, 179.99), (0.0, 0.0)])
def test_the_frame_is_pyprojs_transverse_mercator(origin: tuple[float, float]) -> None:
    frame = LocalFrame(*origin)
    rng = np.random.default_rng(0)
    degrees = origin + rng.uniform(-0.4, 0.4, (50, 2))
    degrees[:, 1] = (degrees[:, 1] + 180) % 360 - 180
    ours = frame.xy(*degrees.T)
    theirs = pyproj.Transformer.from_crs(
        "EPSG:4326", f"+proj=tmerc +lat_0={origin[0]} +lon_0={origin[1]} +k=1 +ellps=WGS84", always_xy=True
    ).transform(degrees[:, 1], degrees[:, 0])
    np.testing.assert_allclose(ours, np.stack(theirs, axis=1), atol=1e-6)
    np.testing.assert_allclose(frame.degrees(ours), degrees, atol=1e-11)


@pytest.mark.parametrize(
    ("latitude", "longitude", "zone"), [(46.8, -91.99, 32615), (-33.9, 18.4, 32734), (5.0, 180.0, 32660)]
)
def test_eastings_and_northings_are_those_of_the_origin_s_utm_zone(
    latitude: float, longitude: float, zone: int
) -> None:
    frame = LocalFrame(latitude, longitude)
    points = np.array([(0.0, 0.0), (-90.0, 250.0)])
    theirs = pyproj.Transformer.from_crs("EPSG:4326", f"EPSG:{zone}", always_xy=True)
    assert frame.utm_zone == zone
    expected = np.stack(theirs.transform(*frame.degrees(points)[:, ::-1].T), axis=1)
    np.testing.assert_allclose(frame.utm(points), expected, atol=1e-3)
    assert np.isnan(frame.utm([(np.nan, 0.0)])).all()


@pytest.mark.parametrize(("half", "metres"), [(1_000, 1e-4), (20_000, 1e-2), (100_000, 1.0)])
def test_polynomials_stand_for_the_projection(half: float, metres: float) -> None:
    frame = LocalFrame(48.0, 9.0)
    u, v = np.random.default_rng(0).uniform(-1, 1, (2, 200))
    terms = np.stack([np.ones(200), u, v, u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3])
    found = (frame.polynomials((-half, -2 * half, half, half)) @ terms).T
    exact = frame.degrees(np.stack([u * half, (3 * v - 1) * half / 2], axis=1))
    assert (np.abs(found - exact) * (111_000, 75_000)).max() < metres


def test_unknown_positions_stay_unknown() -> None:
    frame = LocalFrame(48.0, 9.0)
    xy = frame.xy([48.0, np.nan, 48.0], [9.0, 9.0, np.nan])
    assert np.isnan(xy).tolist() == [[False, False], [True, True], [True, True]]
    assert np.isnan(frame.degrees([(np.nan, 0.0)])).all()
    assert frame.xy(48.0, 9.0).shape == (1, 2)


def test_a_windows_pixels_lie_where_its_heading_says() -> None:
    window = Window(100.0, 200.0, 40.0, heading=90.0)  # east points up
    pixels = [(19.5, 19.5), (19.5, -0.5), (39.5, 19.5)]  # the middles of the picture, of its top, and of its right
    np.testing.assert_allclose(window.to_ground(pixels, 40), [(100, 200), (120, 200), (100, 180)], atol=1e-12)
    np.testing.assert_allclose(window.corners, [(120, 220), (120, 180), (80, 180), (80, 220)], atol=1e-12)
    points = np.random.default_rng(0).uniform(-10, 300, (20, 2))
    turned = Window(-3.0, 7.0, 90.0, heading=-33.0)
    np.testing.assert_allclose(turned.to_pixels(turned.to_ground(points, 224), 224), points, atol=1e-9)


def test_a_grid_covers_its_rectangle_and_is_centred_on_it() -> None:
    centres = grid((-100.0, -50.0, 105.0, 50.0), 40.0, 20.0)
    columns, rows = np.unique(centres[:, 0]), np.unique(centres[:, 1])
    np.testing.assert_allclose(np.diff(columns), 20)
    assert (len(columns), len(rows)) == (10, 4)
    assert columns[0] - 20 <= -100
    assert columns[-1] + 20 >= 105
    assert columns.mean() == pytest.approx(2.5)
    np.testing.assert_allclose(centres[0], (columns[0], rows[-1]))  # north-west first
    assert grid((0, 0, 10, 10), 40, 20).tolist() == [[5, 5]]


@pytest.mark.parametrize(("size", "step"), [(0, 10), (10, 0), (np.nan, 10), (10, np.inf), (1e-4, 1e-4)])
def test_impossible_grids_are_refused(size: float, step: float) -> None:
    with pytest.raises(InputError, match="Windows of"):
        grid((-1000, -1000, 1000, 1000), size, step)


@pytest.mark.parametrize("numbers", [(np.nan, 0, 10, 0), (0, 0, 0, 0), (0, 0, -1, 0), (0, 0, 10, np.inf)])
def test_impossible_windows_are_refused(numbers: tuple[float, float, float, float]) -> None:
    with pytest.raises(InputError, match="size above 0 m"):
        Window(*numbers)


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
