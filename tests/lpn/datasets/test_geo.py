from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest

from lpn.core.errors import DataError, InputError
from lpn.datasets import Picture, geo
from lpn.datasets.geo import Position, Positions


def write(root: Path, text: str) -> Path:
    root.mkdir(parents=True, exist_ok=True)
    (root / "geo.csv").write_text(text, encoding="utf-8")
    return root


def test_distances_are_those_on_the_ground() -> None:
    hangzhou, beijing, pole = Position(30.2741, 120.1551), Position(39.9042, 116.4074), Position(90, 0)
    along = geo.metres([hangzhou, beijing, Position(0, 179.9995)], [beijing, beijing, Position(0, -179.9995)])
    assert along[0] == pytest.approx(1_123_000, rel=0.01)
    assert along[1] == 0
    assert along[2] == pytest.approx(0.001 * geo.metres_per_degree(0)[1])
    assert geo.metres([Position(0, 0)], [pole])[0] == pytest.approx(10_001_965.729)  # a quarter of WGS 84's meridian


def test_geodesic_is_that_of_the_ellipsoid() -> None:
    rng = np.random.default_rng(0)
    a = np.stack([rng.uniform(-80, 80, 300), rng.uniform(-180, 180, 300)], axis=1)
    b = a + rng.uniform(-1, 1, a.shape) * rng.choice([1e-6, 1e-3, 1, 9], (300, 1))
    b[0], a[1], b[1] = a[0], (0, 10), (0, 11)  # the same point, and two on the equator
    expected = pyproj.Geod(ellps="WGS84").inv(a[:, 1], a[:, 0], b[:, 1], b[:, 0])[2]
    np.testing.assert_allclose(geo.geodesic(a, b), expected, rtol=1e-9, atol=1e-4)
    opposite = geo.geodesic([0.0, 0.0], [0.3, 179.7])
    assert opposite == pytest.approx(pyproj.Geod(ellps="WGS84").inv(0.0, 0.0, 179.7, 0.3)[2], rel=6e-3)


def test_the_plane_keeps_distances_near_its_origin() -> None:
    rng = np.random.default_rng(0)
    origin = Position(48.0, 11.5)
    places = [Position(48 + a, 11.5 + b) for a, b in rng.uniform(-0.05, 0.05, (50, 2))]
    plane = geo.on_plane(places, origin)
    assert plane.shape == (50, 2)
    np.testing.assert_allclose(np.hypot(*plane.T), geo.metres(places, [origin] * 50), rtol=1e-3)
    assert geo.on_plane([Position(48.01, 11.5)], origin)[0] == pytest.approx([0, 1112], abs=1)


def test_positions_are_read_with_or_without_altitude_and_heading(tmp_path: Path) -> None:
    write(tmp_path, "path,latitude,longitude,altitude,heading\na/1.jpg,1.5,-2,,\n./a/2.jpg, 3 ,4,120,359.5\n\n")
    pictures = [Picture(tmp_path / "a" / name, 1, "1") for name in ("2.jpg", "1.jpg")]
    assert Positions(tmp_path).of(pictures) == [Position(3, 4, 120, 359.5), Position(1.5, -2)]
    write(tmp_path, "\ufeffLongitude,Latitude,Path\n9,8,a/1.jpg\n")
    assert Positions(tmp_path).of(pictures[1:]) == [Position(8, 9)]
    assert geo.positions(tmp_path / "a") is None


def test_names_of_a_folder_further_down_find_their_positions() -> None:
    def found(*paths: str) -> dict[str, geo.Position]:
        return {path: geo.Position(i, 0) for i, path in enumerate(paths)}

    def matched(known: dict[str, geo.Position], *names: str) -> list[float | None]:
        return [None if place is None else place.latitude for place in Positions(Path(), known).match(names)]

    assert matched(found("a.png", "b/a.png"), "a.png", "b/a.png", "c.png") == [0, 1, None]
    assert matched(found("x/y/a.png", "z/a.png", "x/y/b/a.png"), "a.png", "b/a.png") == [0, 2]
    assert matched(found("x/a.png", "a.png"), "a.png") == [1]  # the file's own folder
    assert matched({}, "a.png") == [None]
    with pytest.raises(InputError, match="these names below x/ and y/ at different positions"):
        Positions(Path(), found("x/a.png", "y/a.png")).match(["a.png"])
    alike = dict.fromkeys(("x/a.png", "y/a.png"), geo.Position(1, 2))
    assert Positions(Path(), alike).match(["a.png"]) == [geo.Position(1, 2)]


def test_a_camera_stands_behind_what_it_shows() -> None:
    origin = Position(46.0, 7.0)
    east, north, up = geo.camera(replace(origin, altitude=100, heading=90, tilt=-45), origin)  # type: ignore[misc]
    assert (east, north, up) == pytest.approx((-100, 0, 100))
    assert geo.camera(replace(origin, altitude=80), origin) == pytest.approx([0, 0, 80])
    assert geo.camera(origin, origin) is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "first line of geo.csv is empty"),
        ("path,lat,lon\n", r"width\.$"),
        ("path;latitude,longitude\n", r"width\. Semicolons stand beside commas or tabs in it"),
        ("path,latitude,longitude\na,1\n", "Line 2 of geo.csv should have 3 values"),
        ("path,latitude,longitude\na,1,2\nb,north,2\n", "Line 3 .* latitude 'north'"),
        ("path,latitude,longitude\na,91,2\n", "from -90 to 90; it may be a longitude, so check that the two"),
        ("path,latitude,longitude\na,1200,2\n", r"from -90 to 90\.$"),
        ("path,latitude,longitude,tilt\na,1,2,30\n", "tilt '30'"),
        ("path,latitude,longitude\na,1,nan\n", "longitude 'nan'"),
        ("path,latitude,longitude\na,1,2\na,1,2\n", "second position"),
        ("path,latitude,longitude\n,1,2\n", "no path"),
        ("path,latitude,longitude\na,0.0,0\n", "Line 2 of geo.csv has the position 0, 0"),
        ("path,latitude,longitude\na,1,2\n", "no position for 1 of 1 pictures, the first being b"),
    ],
)
def test_mistakes_in_a_file_of_positions_are_named(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(DataError, match=said):
        Positions(write(tmp_path, text)).of([Picture(tmp_path / "b", 1, "1")])
    (tmp_path / "geo.csv").write_bytes(b"path,latitude,longitude\n\xff\xfe,1,2\n")
    with pytest.raises(DataError, match="UTF-8"):
        Positions(tmp_path)
