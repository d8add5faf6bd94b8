from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pyproj
import pytest

from lpn.core.errors import InputError
from lpn.flight.maps import Map, MapOptions, Window, open_map
from tests.lpn.flight.maps.small_maps import EAST, NORTH, at, smooth, write_geotiff


def expected(
    town: Map, picture: np.ndarray, crs: str, matrix: tuple[float, ...], window: Window, pixels: int
) -> tuple[np.ndarray, np.ndarray]:
    """Cut a window with pyproj and NumPy: its colours, and where it lies within the picture, (pixels, pixels)."""
    metres = window.size / pixels
    v, u = np.mgrid[:pixels, :pixels]
    right, up = (u + 0.5 - pixels / 2) * metres, (pixels / 2 - v - 0.5) * metres
    turn = math.radians(window.heading)
    x = window.x + right * math.cos(turn) + up * math.sin(turn)
    y = window.y - right * math.sin(turn) + up * math.cos(turn)
    local = f"+proj=tmerc +lat_0={town.frame.latitude} +lon_0={town.frame.longitude} +k=1 +ellps=WGS84"
    xs, ys = pyproj.Transformer.from_crs(local, crs, always_xy=True).transform(x.ravel(), y.ravel())
    if crs == "EPSG:4326":
        xs = xs % 360
    a, b, c, d, e, f = matrix
    cells = np.linalg.solve([[a, b], [d, e]], np.stack([xs - c, ys - f])).T
    inside = ((cells > 1) & (cells < (picture.shape[1] - 1, picture.shape[0] - 1))).all(axis=1)
    colours = np.zeros((pixels**2, 3))
    colours[inside] = at(picture, cells[inside])
    return colours.reshape(pixels, pixels, 3), inside.reshape(pixels, pixels)


# Pixels of 0.5 m: north up, turned by 20 degrees, in degrees, in Web Mercator (0.5 m there are 0.33 m at 48 degrees).
TURN = math.radians(20)
GEOREFERENCES = {
    "UTM": ("EPSG:32632", (0.5, 0, EAST, 0, -0.5, NORTH)),
    "turned": (
        "EPSG:32632",
        (0.5 * math.cos(TURN), 0.5 * math.sin(TURN), EAST, 0.5 * math.sin(TURN), -0.5 * math.cos(TURN), NORTH),
    ),
    "degrees": ("EPSG:4326", (7e-6, 0, 9.0, 0, -5e-6, 48.0)),
    "Web Mercator": ("EPSG:3857", (0.5, 0, 1_001_875.0, 0, -0.5, 6_106_854.0)),
    "antimeridian": ("EPSG:4326", (7e-6, 0, 179.999, 0, -5e-6, 48.0)),
}


@pytest.mark.parametrize("georeference", GEOREFERENCES)
def test_a_window_is_what_pyproj_and_numpy_cut(tmp_path: Path, georeference: str) -> None:
    crs, matrix = GEOREFERENCES[georeference]
    picture = smooth(240, 300)
    town = open_map(write_geotiff(tmp_path / "town.tif", picture, crs, matrix))
    for window, pixels in ((Window(0, 0, 50), 110), (Window(5, -9, 40, 37), 100), (Window(50, 20, 60, -120), 64)):
        colours, inside = expected(town, picture, crs, matrix, window, pixels)
        found, valid = town.read(window, pixels)
        assert found.shape == (pixels, pixels, 3)
        assert found.dtype == np.uint8
        assert inside.mean() > 0.2
        assert valid[inside].all()
        # A coarser picture is a mean over its pixels, which differs from a sample where the waves curve.
        np.testing.assert_allclose(found[inside], colours[inside], atol=2.5)


def test_a_window_reduces_by_means_not_by_samples(tmp_path: Path) -> None:
    chess = np.zeros((256, 256, 3), np.uint8)
    chess[::2, ::2] = chess[1::2, 1::2] = 200
    town = open_map(write_geotiff(tmp_path / "chess.tif", chess))
    for pixels in (16, 25, 32):
        found, valid = town.read(Window(0, 0, 80, 15), pixels)
        assert valid.all()
        np.testing.assert_allclose(found, 100, atol=6)


def test_pixels_beyond_the_map_are_invalid_and_black(tmp_path: Path) -> None:
    town = open_map(write_geotiff(tmp_path / "town.tif", smooth(200, 200)))
    west, south, east, north = town.bounds
    assert (east - west, north - south) == pytest.approx((100, 100), abs=0.1)
    picture, valid = town.read(Window(west, north, 100), 100)  # only its lower right quarter is on the map
    assert valid.mean() == pytest.approx(0.25, abs=0.005)
    assert valid[55:, 55:].all()
    assert not picture[~valid].any()
    picture, valid = town.read(Window(10_000, 0, 100), 32)
    assert not valid.any()
    assert not picture.any()


def test_no_share_of_a_hole_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    town = open_map(write_geotiff(tmp_path / "town.tif", smooth(200, 200)))
    shown = np.random.default_rng(0).choice((0.25, 0.5, 0.75, 1.0), (300, 300)).astype(np.float32)
    shown[100:200, 100:200] = 0
    monkeypatch.setattr(town, "coverage", lambda: shown)
    inside = np.random.default_rng(1).uniform(-14, 14, (2000, 2))
    assert not town.valid_shares(inside, town.resolution).any()
    assert (town.valid_shares(inside - 30.0, town.resolution) > 0).all()


def test_resolution_and_sizes_are_true_metres(tmp_path: Path) -> None:
    crs, matrix = GEOREFERENCES["Web Mercator"]
    town = open_map(write_geotiff(tmp_path / "town.tif", smooth(200, 200), crs, matrix))
    factor = pyproj.Proj("EPSG:3857").get_factors(9.0, 48.0)
    true = 0.5 / math.sqrt(factor.meridional_scale * factor.parallel_scale)
    assert true < 0.34
    assert town.resolution == pytest.approx(true, rel=1e-3)


def test_blocks_of_a_large_picture_fit_together(tmp_path: Path) -> None:
    picture = smooth(300, 300)
    crs, matrix = GEOREFERENCES["turned"]
    town = open_map(write_geotiff(tmp_path / "town.tif", picture, crs, matrix))
    window = Window(0, 0, 130, 10)
    colours, inside = expected(town, picture, crs, matrix, window, 540)
    found, _ = town.read(window, 540)
    np.testing.assert_allclose(found[inside], colours[inside], atol=2)


def test_threads_read_what_one_thread_reads(tmp_path: Path) -> None:
    town = open_map(write_geotiff(tmp_path / "town.tif", smooth(300, 300)))
    windows = [Window(x, y, 40, x) for x in range(-50, 50, 20) for y in range(-50, 50, 20)]
    alone = [town.read(window, 48) for window in windows]
    with ThreadPoolExecutor(4) as threads:
        for one, other in zip(alone, threads.map(lambda window: town.read(window, 48), windows), strict=True):
            np.testing.assert_array_equal(one[0], other[0])
            np.testing.assert_array_equal(one[1], other[1])
    town.close()


def test_windows_lie_where_the_map_is(tmp_path: Path) -> None:
    picture = smooth(400, 400)
    picture[:, :200] = 0
    town = open_map(write_geotiff(tmp_path / "town.tif", picture, nodata=0))  # 200 m by 200 m, the western half empty
    windows = town.pyramid([40, 80])
    assert [window.size for window in windows] == sorted(window.size for window in windows)
    small = [window for window in windows if window.size == 40]
    assert len(small) == 45
    assert all(town.read(window, 40)[1].mean() > 0.47 for window in windows)
    assert windows == [window for block in town.pyramid_blocks([40, 80]) for window in block]
    assert len(windows) == town.count_pyramid([40, 80])


def test_impossible_requests_are_refused(tmp_path: Path) -> None:
    town = open_map(write_geotiff(tmp_path / "town.tif", smooth(64, 64)))
    for pixels in (0, -1, 100_000):
        with pytest.raises(InputError, match="pixels a side"):
            town.read(Window(0, 0, 10), pixels)
    with pytest.raises(InputError, match="overlap"):
        town.pyramid([10], 1.0)
    with pytest.raises(InputError, match="at least one file"):
        open_map([])
    with pytest.raises(InputError, match="one picture"):
        open_map([tmp_path / "town.tif"] * 2, MapOptions(corners=(1, 2, 0, 3)))


def test_the_digest_changes_with_the_pixels_and_how_they_are_read_but_not_with_the_folder(tmp_path: Path) -> None:
    crs, matrix = GEOREFERENCES["UTM"]
    picture = smooth(240, 300)
    file = write_geotiff(tmp_path / "town.tif", picture, crs, matrix)
    first = open_map(file).digest()
    assert open_map(file).digest() == first
    assert open_map(file, MapOptions(bands=(3, 2, 1))).digest() != first
    (tmp_path / "elsewhere").mkdir()
    moved = file.rename(tmp_path / "elsewhere" / "town.tif")
    assert open_map(moved).digest() == first
    picture[100, 100] ^= 255  # a pixel that no overview shows
    changed = write_geotiff(tmp_path / "town.tif", picture, crs, matrix)
    assert changed.stat().st_size == moved.stat().st_size
    assert open_map(changed).digest() != first


@pytest.mark.skipif("LPN_FLIGHTS" not in os.environ, reason="LPN_FLIGHTS does not name the folder of the real flights")
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
    town = open_map(Path(os.environ["LPN_FLIGHTS"]) / name)
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
