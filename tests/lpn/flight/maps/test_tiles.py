from __future__ import annotations

import gzip
import shutil
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from PIL import EpsImagePlugin, Image

from lpn.cli.main import main
from lpn.core.errors import InputError, OutputError
from lpn.flight.maps import Map, MapOptions, Window, open_map
from lpn.flight.maps.folder import build_map
from tests.lpn.flight.maps.small_maps import refused, smooth, write_geotiff
from tools.fixtures.small_tiles import NORTH, WEST, ZOOM, bounds_text, encoded, matrix, write_folder, write_mbtiles

PICTURE = smooth(512, 512)
FINE = smooth(1024, 1024)
# Middle of the four tiles.
LATITUDE, LONGITUDE = 48.205456, 9.103546
METADATA = {"name": "town", "format": "png", "bounds": bounds_text()}


@pytest.fixture(scope="module")
def same(tmp_path_factory: pytest.TempPathFactory) -> Map:
    """The map that the tiles were cut of."""
    return open_map(write_geotiff(tmp_path_factory.mktemp("same") / "same.tif", PICTURE, "EPSG:3857", matrix()))


@pytest.fixture(scope="module")
def fine(tmp_path_factory: pytest.TempPathFactory) -> Map:
    """The map that the tiles of 512 pixels were cut of."""
    return open_map(write_geotiff(tmp_path_factory.mktemp("fine") / "fine.tif", FINE, "EPSG:3857", matrix(512)))


def check(town: Map, same: Map, tolerance: int = 3) -> list[str]:
    """Check that two maps show the same at the same place; return the notes of the first."""
    assert (town.frame.latitude, town.frame.longitude) == (same.frame.latitude, same.frame.longitude)
    assert (town.frame.latitude, town.frame.longitude) == (LATITUDE, LONGITUDE)
    np.testing.assert_allclose(town.bounds, same.bounds, atol=0.01)
    assert town.resolution == pytest.approx(same.resolution)
    for window in (Window(0, 0, 60), Window(20, -30, 100, 40)):
        picture, valid = town.read(window, 80)
        assert valid.all()
        np.testing.assert_allclose(picture.astype(int), same.read(window, 80)[0], atol=tolerance)
    return town.notes


SHOWN = "town is shown at zoom 18, the deepest of 1."
NORTHERN = (
    "town does not say where its rows begin; they are counted from the north (XYZ). For rows from the south (TMS), add a "
    "tilemapresource.xml."
)


@pytest.mark.parametrize(
    ("name", "tolerance"),
    [
        ("{z}/{x}/{y}.png", 3),
        ("{z}/{x}/{y}.webp", 12),
        ("{z}/{x}/{y}.jpg", 12),
        ("{z}/{x}/{y}.PNG", 3),
        ("{z}/{x}/{y}.png.tile", 3),  # OsmAnd, osmdroid
        ("{z}/{x}/{y}", 3),
    ],
)
def test_tiles_by_the_names_that_programs_give_them(tmp_path: Path, same: Map, name: str, tolerance: int) -> None:
    assert check(open_map(write_folder(tmp_path / "town", PICTURE, name)), same, tolerance) == [SHOWN, NORTHERN]


def test_tiles_of_all_kinds_in_one_folder(tmp_path: Path) -> None:
    """The contents of a tile tell its format; grey, palettes, and other files may be among them."""
    tiles = write_folder(tmp_path / "town", PICTURE)
    first, second, third = (
        tiles / f"{ZOOM}/{x}/{y}.png" for x, y in ((WEST, NORTH), (WEST + 1, NORTH), (WEST, NORTH + 1))
    )
    Image.open(first).convert("RGB").save(first, "JPEG", quality=95)
    Image.open(second).convert("L").save(second)
    opaque = Image.open(third).convert("RGBA")
    opaque.putalpha(Image.fromarray(np.repeat(np.uint8([255, 0]), 128)[None].repeat(256, 0)))
    opaque.save(third)
    plain = np.zeros((256, 256), np.uint8)
    plain[:128] = 1
    palette = Image.fromarray(plain, "P")
    palette.putpalette([10, 200, 30, 250, 0, 0])
    palette.save(tiles / f"{ZOOM}/{WEST + 1}/{NORTH + 1}.png", transparency=bytes([255, 0]))
    (tiles / "leaflet.html").write_text("<html/>")  # as gdal2tiles leaves it
    Image.fromarray(smooth(50, 50)).save(tiles / "preview.png")
    town = open_map(tiles)
    picture, valid = town.overview(512)
    np.testing.assert_allclose(picture[100, 100].astype(int), PICTURE[100, 100], atol=12)
    assert np.ptp(picture[100, 400].astype(int)) == 0
    assert valid.mean() == pytest.approx(0.75, abs=0.01)
    assert picture[480, 400].tolist() == [10, 200, 30]


def test_tiles_of_512_pixels(tmp_path: Path, same: Map, fine: Map) -> None:
    check(open_map(write_folder(tmp_path / "town", FINE, side=512)), fine)
    assert check(open_map(write_mbtiles(tmp_path / "town.mbtiles", FINE, METADATA, side=512)), fine) == []
    tiles = write_folder(tmp_path / "both", PICTURE)
    write_folder(tiles, FINE, "{z}/{x}/{y}@2x.png", side=512)
    check(open_map(tiles), fine)
    # A tile that is there in 256 pixels alone is enlarged.
    (tiles / f"{ZOOM}/{WEST}/{NORTH}@2x.png").unlink()
    town = open_map(tiles)
    assert town.read(Window(-40, 40, 60), 60)[1].all()
    assert town.resolution == pytest.approx(fine.resolution)
    shown, expected = (one.read(Window(-55, 55, 60), 60)[0].astype(int) for one in (town, same))
    np.testing.assert_allclose(shown, expected, atol=6)


@pytest.mark.parametrize("zoom", [23, 25])
def test_tiles_deeper_than_gdal_reads(tmp_path: Path, zoom: int) -> None:
    """Drone orthophotos of 1 cm have tiles at zoom 23."""
    tiles = write_folder(tmp_path / "town", PICTURE)
    deep, by = tmp_path / "deep" / "town", 1 << zoom - ZOOM
    for file in tiles.rglob("*.png"):
        moved = deep / f"{zoom}/{int(file.parent.name) - WEST + WEST * by}/{int(file.stem) - NORTH + NORTH * by}.png"
        moved.parent.mkdir(parents=True, exist_ok=True)
        file.rename(moved)
    town = open_map(deep)
    assert town.notes == [f"town is shown at zoom {zoom}, the deepest of 1.", NORTHERN]
    a, b, c, d, e, f = matrix()
    same = open_map(write_geotiff(tmp_path / "same.tif", PICTURE, "EPSG:3857", (a / by, b, c, d, e / by, f)))
    assert town.frame == same.frame
    np.testing.assert_allclose(town.bounds, same.bounds, atol=1e-4)
    window = Window(0, 0, 60 / by)
    np.testing.assert_allclose(town.read(window, 80)[0].astype(int), same.read(window, 80)[0], atol=3)
    (deep / f"{zoom}/0").mkdir()
    (deep / f"{zoom}/0/1.png").write_bytes(encoded(PICTURE[:256, :256]))
    refused(deep, "lie too far apart for one map")


def test_a_full_folder_for_temporary_files_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    resource = pytest.importorskip("resource")
    tiles = write_folder(tmp_path / "town", PICTURE)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8192, limits[1]))
    try:
        with pytest.raises(OutputError, match=r"town cannot be packed .* free space in the folder for temporary files"):
            open_map(tiles)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == [tiles]


@pytest.mark.parametrize(
    ("name", "file", "text"),
    [
        ("south", "tilemapresource.xml", "<TileMap><SRS>EPSG:900913</SRS><TileSets profile='mercator'/></TileMap>"),
        ("south", "metadata.json", '{"scheme": "tms"}'),
        ("y", "tiles.json", '{"scheme": "xyz", "crs": "EPSG:3857"}'),
    ],
)
def test_metadata_say_where_rows_begin(tmp_path: Path, same: Map, name: str, file: str, text: str) -> None:
    tiles = write_folder(tmp_path / "town", PICTURE, f"{{z}}/{{x}}/{{{name}}}.png")
    (tiles / file).write_text(text)
    assert check(open_map(tiles), same) == [SHOWN]


def test_tiles_that_are_no_pictures_have_no_data(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", ran := MagicMock())
    tiles = write_folder(tmp_path / "town", PICTURE)
    (tiles / f"{ZOOM}/{WEST}/{NORTH}.png").write_bytes(b"<!DOCTYPE html><html>Not found</html>")
    (tiles / f"{ZOOM}/{WEST + 1}/{NORTH}.png").write_bytes(
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 256 256\n%%EndComments\nshowpage\n"
    )
    broken = tiles / f"{ZOOM}/{WEST}/{NORTH + 1}.png"
    broken.write_bytes(broken.read_bytes()[:100])
    assert main(["map", str(tiles), "--out", str(tmp_path / "map")]) == 0
    printed = capsys.readouterr().out
    assert "The tiles of town that are no whole PNG, JPEG, or WebP, as failed downloads are, have no data: " in printed
    assert not ran.called
    assert f"{ZOOM}/{WEST + 1}/{NORTH}.png is no picture" in printed
    assert f"{ZOOM}/{WEST}/{NORTH + 1}.png is cut short or damaged" in printed
    assert "75% of its rectangle have no tile." in printed
    assert "shows 204 m by 204 m about 48.205456, 9.103546, 25% of it with data" in printed
    for file in tiles.rglob("*.png"):
        file.rename(file.with_suffix(".pbf")).write_bytes(b"\x1a\x10")
    refused(tiles, "are no PNG, JPEG, or WebP; expected pictures, so render vector tiles")


@pytest.mark.parametrize(
    ("file", "text", "words"),
    [
        ("tilemapresource.xml", "<TileMap><SRS>EPSG:4326</SRS><TileSets/></TileMap>", "in EPSG:4326"),
        ("tilemapresource.xml", "<TileMap><SRS></SRS><TileSets profile='raster'/></TileMap>", "in raster"),
        ("metadata.json", '{"profile": "geodetic"}', "in geodetic"),
    ],
)
def test_tiles_in_another_projection_are_refused(tmp_path: Path, file: str, text: str, words: str) -> None:
    tiles = write_folder(tmp_path / "town", PICTURE)
    (tiles / file).write_text(text)
    refused(tiles, words, "expected Web Mercator (EPSG:3857)")


def test_what_a_folder_of_tiles_does_not_show_is_told(tmp_path: Path) -> None:
    tiles = write_folder(tmp_path / "town", PICTURE)
    finer = tiles / str(ZOOM + 1) / str(2 * WEST)
    finer.mkdir(parents=True)
    Image.fromarray(smooth(256, 256)).save(finer / f"{2 * NORTH}.png")
    assert "Zoom 18 of town reaches further than zoom 19; that part is not shown." in open_map(tiles).notes
    shutil.rmtree(finer.parent)
    (tiles / f"{ZOOM}/{WEST}/{NORTH}.png").unlink()
    assert "town is shown at zoom 18, the deepest of 1; 25% of its rectangle have no tile." in open_map(tiles).notes
    for column, row, words in (
        (0, NORTH, "town has 35251712 x 512 pixels, and a first look at it would take"),
        (1 << ZOOM, 1, "has tiles beyond 262143 at zoom 18"),
    ):
        (tiles / f"{ZOOM}/{column}").mkdir()
        (tiles / f"{ZOOM}/{column}/{row}.png").write_bytes(encoded(PICTURE[:256, :256]))
        refused(tiles, words)


def test_a_white_border_of_tiles_has_no_data(tmp_path: Path) -> None:
    picture = PICTURE.copy()
    picture[:, :205] = 255
    path = write_folder(tmp_path / "town", picture)
    town = open_map(path)
    assert "The white border of town (40% of it) is taken as no data." in town.notes
    assert open_map(path, MapOptions(keep_borders=True)).overview(200)[1].mean() > 0.99
    for shown in (town, build_map([path], tmp_path / "map")):
        assert shown.overview(200)[1].mean() == pytest.approx(0.6, abs=0.015)
    with pytest.raises(InputError, match="leave CRS, corners, and bands out"):
        open_map(path, MapOptions(bands=(1,)))


@pytest.mark.parametrize(("metadata", "view"), [(METADATA | {"scheme": "tms"}, False), (METADATA, True), ({}, False)])
def test_an_mbtiles_is_read_by_its_tiles(tmp_path: Path, same: Map, metadata: dict[str, str], view: bool) -> None:
    assert check(open_map(write_mbtiles(tmp_path / "town.mbtiles", PICTURE, metadata, view=view)), same) == []


@pytest.mark.parametrize(
    ("metadata", "from_south", "words"),
    [
        (METADATA | {"scheme": "xyz"}, False, "counts rows from the north (scheme xyz)"),
        (METADATA, False, "has no valid pixel"),
        (METADATA | {"bounds": "-180.0,-85,180,85"}, True, "a first look at it would take"),
        (METADATA | {"format": "pbf"}, True, "cannot be read as a map"),
        (None, True, "cannot be read as a map"),
    ],
)
def test_an_mbtiles_against_its_format_is_refused(
    tmp_path: Path, metadata: dict[str, str] | None, from_south: bool, words: str
) -> None:
    encode = encoded if metadata != METADATA | {"format": "pbf"} else lambda _: gzip.compress(b"\x1a\x10" + bytes(50))
    refused(write_mbtiles(tmp_path / "a.mbtiles", PICTURE, metadata, from_south=from_south, encode=encode), words)


def test_the_folder_of_tiles_is_named_from_above_and_below(tmp_path: Path) -> None:
    tiles = write_folder(tmp_path / "download" / "tiles", PICTURE)
    for given in (tmp_path / "download", tiles / str(ZOOM)):
        refused(given, f"give {tiles}.")
