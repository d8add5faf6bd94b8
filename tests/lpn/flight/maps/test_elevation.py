from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lpn.cli.main import main
from lpn.core.arrays import Float64Array
from lpn.core.errors import DataError, InputError
from lpn.flight.maps import Map, open_map
from lpn.flight.maps.elevation import ElevationFile, HeightUnit
from lpn.flight.maps.folder import build_map
from tests.lpn.flight.maps.small_maps import EAST, NORTH, smooth, write_geotiff

FOOT, SURVEY_FOOT = 0.3048, 1200 / 3937
# North American zone 11: metres with heights in US survey feet, and a state plane in US survey feet.
IN_SURVEY_FEET, STATE_PLANE = "EPSG:26911+6360", "EPSG:2229"


@pytest.fixture
def ortho(tmp_path: Path) -> Path:
    """A map of 100 m by 100 m."""
    return write_geotiff(tmp_path / "ortho.tif", smooth(200, 200))


def slope(pixel: float = 2.0, side: int = 80, unit: float = 1.0, west: float = -30.0) -> tuple[Any, tuple[float, ...]]:
    """Heights of a plane, 300 m + 0.1 m a metre to the east + 0.2 m a metre to the south, and their transform."""
    columns, rows = np.meshgrid(*[(np.arange(side) + 0.5) * pixel] * 2)
    heights = (300 + 0.1 * (columns + west) + 0.2 * (rows - 30)) / unit
    return heights[..., None].astype(np.float32), (pixel, 0, EAST + west, 0, -pixel, NORTH + 30)


def expected(basemap: Map, points: Float64Array) -> Float64Array:
    """The plane's heights at points of the map's frame, which is the zone's grid here but for its scale of 0.9996."""
    west, _, _, north = basemap.bounds
    return np.asarray(300 + 0.1 * (points[:, 0] - west) * 0.9996 + 0.2 * (north - points[:, 1]) * 0.9996)


POINTS = np.array([(0.0, 0.0), (-40.3, 12.7), (33.3, -45.1), (49.9, 49.9)])


@pytest.mark.parametrize(
    ("unit", "given"), [(1.0, None), (FOOT, "foot"), (SURVEY_FOOT, "us-foot")], ids=["metre", "foot", "us-foot"]
)
def test_heights_in_any_unit_become_metres_at_places_of_the_map(
    tmp_path: Path, ortho: Path, unit: float, given: HeightUnit | None
) -> None:
    values, matrix = slope(unit=unit)
    source = write_geotiff(tmp_path / "dsm.tif", values, matrix=matrix)
    built = build_map([ortho], tmp_path / "map", elevation=ElevationFile(source, given))
    opened = open_map(tmp_path / "map")
    for basemap in (built, opened):
        np.testing.assert_allclose(basemap.heights(POINTS), expected(basemap, POINTS), atol=0.01)
        assert np.isnan(basemap.heights(np.array([(500.0, 0.0)]))).all()
    assert opened.elevation is not None
    assert any("does not say its unit" in note for note in opened.notes) == (given is None)
    source.unlink()  # the folder has heights of its own
    assert np.isfinite(open_map(tmp_path / "map").heights(POINTS)).all()


def test_units_are_read_from_the_band_and_from_the_vertical_crs(tmp_path: Path) -> None:
    import rasterio

    place = (0.5, 0, EAST, 0, -0.5, 4_000_000.0)
    ortho = write_geotiff(tmp_path / "ortho.tif", smooth(200, 200), "EPSG:26911", place)
    values, matrix = slope(unit=SURVEY_FOOT)
    matrix = (*matrix[:5], 4_000_030.0)
    by_crs = write_geotiff(tmp_path / "crs.tif", values, IN_SURVEY_FEET, matrix)
    by_band = write_geotiff(tmp_path / "band.tif", values, "EPSG:26911", matrix)
    with rasterio.open(by_band, "r+") as file:
        file.units = ("US survey foot",)
    for source in (by_crs, by_band):
        basemap = build_map([ortho], tmp_path / source.stem, elevation=ElevationFile(source))
        np.testing.assert_allclose(basemap.heights(POINTS), expected(basemap, POINTS), atol=0.01)
        assert basemap.notes == []


def test_pixels_without_data_have_no_height(tmp_path: Path, ortho: Path) -> None:
    values, matrix = slope(side=70)
    values[:, 45:] = -9999
    source = write_geotiff(tmp_path / "dsm.tif", values, matrix=matrix, nodata=-9999)
    basemap = build_map([ortho], tmp_path / "map", elevation=ElevationFile(source))
    heights = basemap.heights(np.array([(-40.0, 0.0), (40.0, 0.0)]))
    assert np.isfinite(heights).tolist() == [True, False]
    assert any("covers 5" in note or "covers 6" in note for note in basemap.notes)


def test_a_few_pixels_of_an_undeclared_value_have_no_height(tmp_path: Path, ortho: Path) -> None:
    values, matrix = slope(pixel=0.1, side=1500)
    values[801, 803] = -9999  # which a look at every second pixel does not see
    source = write_geotiff(tmp_path / "dsm.tif", values, matrix=matrix)
    basemap = build_map([ortho], tmp_path / "map", elevation=ElevationFile(source))
    at = np.array([(x, y) for x in np.arange(-1, 2, 0.05) for y in np.arange(-1, 2, 0.05)])
    heights = basemap.heights(at)
    assert np.isfinite(heights).any()
    assert np.nanmin(heights) > 290
    assert "1 heights of dsm.tif lie outside -500 to 9000 m, and count as unknown." in basemap.notes


def test_heights_that_cannot_be_the_maps_are_refused_before_anything_is_written(tmp_path: Path, ortho: Path) -> None:
    values, matrix = slope()
    for made, crs, place, words in (
        (values, "EPSG:32632", (*matrix[:5], NORTH + 5000), "covers none of the map"),
        (values, None, matrix, "has no coordinate reference system"),
        (values * 100, "EPSG:32632", matrix, "heights from 2"),
        (values, STATE_PLANE, (2, 0, 6_400_000, 0, -2, 1_800_000), "in US survey foot, which does not tell the unit"),
        (smooth(80, 80), "EPSG:32632", matrix, "3 bands of the type uint8"),
        (np.full_like(values, np.nan), "EPSG:32632", matrix, "no valid height"),
        (slope(side=30)[0], "EPSG:32632", matrix, "% of the map; expected 50% at least"),
    ):
        source = write_geotiff(tmp_path / "heights.tif", made, crs, place)
        with pytest.raises(DataError, match=rf"^[^\n]*{words}[^\n]*$"):
            build_map([ortho], tmp_path / "map", elevation=ElevationFile(source))
    assert not (tmp_path / "map").exists()


def test_the_command_names_the_heights_and_refuses_a_unit_alone(
    tmp_path: Path, ortho: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values, matrix = slope()
    source, out = write_geotiff(tmp_path / "dsm.tif", values, matrix=matrix), tmp_path / "map"
    assert main(["map", str(ortho), "--elevation", str(source), "--out", str(out)]) == 0
    assert "Its heights go from 300." in capsys.readouterr().out
    assert main(["map", str(ortho), "--elevation-unit", "foot", "--out", str(out)]) == 2
    assert "--elevation-unit needs --elevation" in capsys.readouterr().err
    with pytest.raises(InputError, match="expected metre, foot, us-foot"):
        build_map([ortho], out, elevation=ElevationFile(source, "fathom"))  # type: ignore[arg-type]
