from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from PIL import Image

from lpn.core.errors import DataError, InputError
from lpn.flight.maps import Map, MapOptions, Window, open_map
from lpn.flight.maps.sheet import datum_notes
from lpn.flight.maps.sources import parse_crs
from tests.lpn.flight.maps.small_maps import EAST, NORTH, refused, smooth, write_geotiff

WORLD = f"0.5\n0\n0\n-0.5\n{EAST + 0.25}\n{NORTH - 0.25}\n"


def picture_with_world_file(path: Path, suffix: str, crs: str | None = "EPSG:32632", world: str = WORLD) -> Path:
    Image.fromarray(smooth(120, 160)).save(path)
    path.with_suffix(suffix).write_text(world)
    if crs is not None:
        path.with_suffix(".prj").write_text(pyproj.CRS(crs).to_wkt("WKT1_ESRI"))
    return path


def cut(town: Map) -> np.ndarray:
    return town.read(Window(0, 0, 30), 60)[0]


UTM = pyproj.CRS(32632)
PRJ = UTM.to_wkt("WKT1_ESRI").encode()


@pytest.mark.parametrize(
    ("name", "suffix", "world", "prj"),
    [
        *((name, suffix, WORLD.encode(), PRJ) for name, suffix in (
            ("a.png", ".pgw"), ("a.PNG", ".PGW"), ("a.webp", ".wld"), ("a.png", ".pngw"), ("a.tif", ".tfw"), ("a.tif", ".TFW"),
            ("a.tif", ".tifw"), ("a.tiff", ".tiffw"),
        )),
        *(("a.png", ".pgw", world, PRJ) for world in (
            b"\xef\xbb\xbf" + WORLD.encode(), WORLD.encode("utf-16"), WORLD.replace("\n", "\r\n\r\n").encode(),
            WORLD.replace(".", ",").encode(), WORLD.replace("\n", " ").encode(), WORLD.encode() + b"\nEPSG:32632\n",
        )),
        *(("a.png", ".pgw", WORLD.encode(), prj) for prj in (
            b"EPSG:32632\n", b"+proj=utm +zone=32 +datum=WGS84 +units=m", UTM.to_wkt("WKT1_GDAL").encode(),
            UTM.to_wkt().encode("utf-16"), b"\xef\xbb\xbf" + PRJ,
        )),
    ],
)  # fmt: skip
def test_a_picture_with_a_world_file_is_the_geotiff(
    tmp_path: Path, name: str, suffix: str, world: bytes, prj: bytes
) -> None:
    path = picture_with_world_file(tmp_path / name, suffix, None)
    path.with_suffix(suffix).write_bytes(world)
    path.with_suffix(".prj").write_bytes(prj)
    town, same = open_map(path), open_map(write_geotiff(tmp_path / "same.tif", smooth(120, 160)))
    np.testing.assert_allclose(town.bounds, same.bounds, atol=1e-3)
    assert town.frame == same.frame
    if name != "a.webp":  # which is not lossless
        np.testing.assert_array_equal(cut(town), cut(same))


def test_a_given_crs_takes_precedence(tmp_path: Path) -> None:
    path = picture_with_world_file(tmp_path / "a.png", ".pgw", None)
    assert open_map(path, MapOptions(crs="EPSG:32632")).frame.longitude == pytest.approx(9.0, abs=0.01)
    assert open_map(path, MapOptions(crs="32633")).frame.longitude == pytest.approx(15.0, abs=0.01)


CORNERS = (48.0, 9.0, 47.9992, 9.001)
HEADER = "Filename,Top_left_lat,Top_left_lon,Bottom_right_lat,Bottom_right_lon\n"


def test_corners_come_from_options_lists_and_names(tmp_path: Path) -> None:
    top, left, bottom, right = CORNERS
    names = ("one.png", "two.png", "01/satellite01.png")
    (tmp_path / "01").mkdir()
    for name in names:
        Image.fromarray(smooth(120, 160)).save(tmp_path / name)
    (tmp_path / "map.csv").write_text(
        f"Filename,Top_left_lat,Top_left_lon,Bottom_right_lat,Bottom_right_long\ntwo.png,{top},{left},{bottom},{right}\n"
    )
    head = "mapname,LT_lat_map,LT_lon_map,RB_lat_map,RB_lon_map,region"
    row = f"satellite01.png,{top},{left},{bottom},{right},here"
    (tmp_path / "satellite_coordinates_range.csv").write_text(f"{head}\n{row}\n")
    towns = [open_map(tmp_path / names[0], MapOptions(corners=CORNERS))]
    # Of a folder, its list names the sheets.
    towns += [open_map(path) for path in (tmp_path, *(tmp_path / name for name in ("map.csv", *names[1:])))]
    for town in towns:
        outer = town.frame.xy([top, bottom], [left, right])
        np.testing.assert_allclose([outer[0, 0], outer[1, 1]], town.bounds[:2], atol=0.01)
        np.testing.assert_array_equal(cut(town), cut(towns[0]))


def test_ground_control_points_that_fit_a_plane_are_a_transform(tmp_path: Path) -> None:
    from rasterio.control import GroundControlPoint

    places = [(0, 0), (0, 160), (120, 0), (120, 160)]
    points = [GroundControlPoint(row, column, EAST + 0.5 * column, NORTH - 0.5 * row) for row, column in places]
    known: dict[str, Any] = {"matrix": None, "gcps": points}
    path = write_geotiff(tmp_path / "a.tif", smooth(120, 160), **known)
    same = open_map(write_geotiff(tmp_path / "b.tif", smooth(120, 160)))
    np.testing.assert_array_equal(cut(open_map(path)), cut(same))
    points[0].x += 20
    write_geotiff(path, smooth(120, 160), **known)
    with pytest.raises(DataError, match="pixels off a plane"):
        open_map(path)


def test_the_finest_sheet_wins_and_fills_its_gaps(tmp_path: Path) -> None:
    grey = np.full((60, 60, 3), 50, np.uint8)
    coarse = write_geotiff(tmp_path / "coarse.tif", grey, matrix=(2, 0, EAST, 0, -2, NORTH))
    fine = np.full((80, 80, 3), 200, np.uint8)
    fine[20:40] = 0
    write_geotiff(tmp_path / "fine.tif", fine, matrix=(0.5, 0, EAST + 40, 0, -0.5, NORTH - 40), nodata=0)
    town = open_map([coarse, tmp_path / "fine.tif"])
    assert [sheet.name for sheet in town.sheets] == ["fine.tif", "coarse.tif"]
    assert town.resolution == pytest.approx(0.5, rel=1e-3)
    centre = pyproj.Transformer.from_crs(32632, 4326).transform(EAST + 60, NORTH - 60)
    picture, valid = town.read(Window(*town.frame.xy(*centre)[0].tolist(), 60), 60)
    assert valid.all()
    assert picture[30, 5].tolist() == [50] * 3  # west of the fine sheet
    assert picture[15, 30].tolist() == [200] * 3  # on it
    assert picture[25, 30].tolist() == [50] * 3  # in its gap


def test_what_has_no_georeference_is_refused(tmp_path: Path) -> None:
    Image.fromarray(smooth(60, 60)).save(tmp_path / "bare.png")
    refused(tmp_path / "bare.png", "no georeference", "--corners")
    refused(picture_with_world_file(tmp_path / "a.png", ".pgw", None), "no coordinate reference system", "--crs")
    refused(picture_with_world_file(tmp_path / "b.png", ".pgw", world="1\n2\n"), "b.pgw is no world file")
    refused(picture_with_world_file(tmp_path / "c.webp", ".wld", world="1\nx\n"), "c.wld is no world file")
    path = picture_with_world_file(tmp_path / "d.png", ".pgw")
    for given in ((95.0, 9.0, 48.0, 9.1), (48.0, 9.0, 47.9, 190.0), (math.nan, 9.0, 47.9, 9.1)):
        refused(tmp_path / "bare.png", "outside the world", corners=given)
    for given in ((47.9, 9.0, 48.0, 9.1), (48.0, 9.1, 47.9, 9.0)):
        refused(tmp_path / "bare.png", "not top left and bottom right", corners=given)
    (tmp_path / "d.prj").write_text("nonsense")
    refused(path, "d.prj holds no coordinate reference system", "--crs")
    refused(path, "no CRS 'EPSG:nothing'", error=InputError, crs="EPSG:nothing")
    refused(path, "not both", error=InputError, crs="EPSG:4326", corners=CORNERS)


METRES = (0.5, 0, EAST, 0, -0.5, NORTH)


@pytest.mark.parametrize(
    ("crs", "matrix", "words"),
    [
        ("EPSG:32632", (7e-6, 0, 9.0, 0, -5e-6, 48.0), "which is not in degrees, and they look like degrees"),
        ("EPSG:4326", METRES, "is in degrees, and they lie outside the world"),
        ("EPSG:3857", (0.5, 0, 0, 0, -0.5, 9e9), "0 m wide on the ground; its transform does not fit"),
        ("EPSG:32632", (0.5, 0, 9e9, 0, -0.5, NORTH), "does not cover them"),
        ("EPSG:32632", (1e-6, 0, EAST, 0, -1e-6, NORTH), "1e-06 m wide on the ground"),
        ('LOCAL_CS["site",UNIT["metre",1]]', METRES, "neither in degrees nor a projection"),
        ("EPSG:4978", (2, 0, 4e6, 0, -2, 6e5), "EPSG:4978, which is neither in degrees nor a projection"),
        ("EPSG:5773", METRES, "neither in degrees nor a projection"),
    ],
)
def test_a_wrong_crs_is_refused(tmp_path: Path, crs: str, matrix: tuple[float, ...], words: str) -> None:
    refused(write_geotiff(tmp_path / "a.tif", smooth(60, 60), crs, matrix), words, "--crs")


def test_a_map_of_the_world_and_a_position_by_rpcs_are_refused(tmp_path: Path) -> None:
    from rasterio.rpc import RPC

    whole = (0.5, 0, -180.0, 0, -0.5, 90.0)
    refused(write_geotiff(tmp_path / "a.tif", smooth(360, 720)[:, :, :1], "EPSG:4326", whole), "at most 400 km")
    one = [1.0] + [0.0] * 19
    position = RPC(0, 1, 48, 0.01, one, one, 30, 30, 9, 0.01, one, one, 30, 30, None, None)
    refused(write_geotiff(tmp_path / "b.tif", smooth(60, 60), None, None, rpcs=position), "RPCs only", "gdalwarp -rpc")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name;lat\n", "The first line of"),
        (HEADER, "names no picture"),
        (HEADER + "a.png,1,2,3\n", "Line 2 of"),
        (HEADER + "a.png,1,2,3,x\n", "Line 2 of"),
        (HEADER + "a.png,48,9,47.9,9.1\n", "not beside it"),
    ],
)
def test_broken_lists_are_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "map.csv").write_text(text)
    refused(tmp_path / "map.csv", words)


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.tif", b"no picture", "begins with 'no picture' and cannot be read as a map ("),
        ("a.tif", b"", "is empty and cannot be read as a map ("),
        ("a.tif", b"oid\nsha", "begins with 'oid sha' and cannot"),
        ("a.tif", b"PK\x03\x04", "a.tif cannot be read as a map ("),
        ("a.tif", b"PK", "; expected a GeoTIFF, a picture, or an .mbtiles of pictures, so convert, unpack, or copy"),
        ("a.mbtiles", b"SQLite format 3\0" + bytes(100), "cannot be read as a map"),
        ("a.MP4", b"\0", "; make a flight of it with lpn flight."),
        ("a.pth", b"\0", "; give a model with --model."),
        ("a.las", b"\0", "; give the orthophoto and not the point cloud."),
        ("a.kmz", b"\0", "; give the picture in it, with --corners."),
    ],
)
def test_what_is_no_raster_is_refused_with_a_remedy(tmp_path: Path, name: str, data: bytes, words: str) -> None:
    (tmp_path / name).write_bytes(data)
    refused(tmp_path / name, words)


def test_what_is_no_map_is_refused(tmp_path: Path) -> None:
    refused(tmp_path / "missing.tif", "There is no file")
    for rows, columns in ((1, 64), (15, 400)):
        few = write_geotiff(tmp_path / "few.tif", smooth(64, 400)[:rows, :columns])
        refused(few, f"The map few has {columns} x {rows} pixels; expected at least 16 on each side")
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", "holds nothing; expected GeoTIFF files")
    refused(write_geotiff(tmp_path / "c.tif", np.zeros((9, 9, 1), np.complex64)), "complex")
    far = write_geotiff(tmp_path / "far.tif", smooth(60, 60), matrix=(0.5, 0, EAST, 0, -0.5, NORTH - 600_000))
    refused([write_geotiff(tmp_path / "near.tif", smooth(60, 60)), far], "at most 400 km")
    damaged = write_geotiff(tmp_path / "a.tif", smooth(600, 600))
    damaged.write_bytes(damaged.read_bytes()[: damaged.stat().st_size // 2])
    with pytest.raises(DataError, match=r"^[^\n]*a\.tif (is damaged|cannot be read)[^\n]*$"):
        open_map(damaged).overview(100)


@pytest.mark.parametrize(
    ("wkt", "place"),
    [
        ('LOCAL_CS["OSGB 1936 / British National Grid",UNIT["metre",1],AUTHORITY["EPSG","27700"]]', (51.507, -0.1275)),
        (
            'LOCAL_CS["WGS 84 / Pseudo-Mercator",GEOGCS["WGS 84",DATUM["unknown",SPHEROID["unretrievable - using WGS84",6378137,'
            '298.257223563]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],AUTHORITY["EPSG","3857"],UNIT["metre",1]]',
            (1.6202, 4.7625),
        ),
    ],
)
def test_a_local_crs_is_read_by_its_code(tmp_path: Path, wkt: str, place: tuple[float, float]) -> None:
    path = picture_with_world_file(tmp_path / "a.png", ".pgw", None, "2\n0\n0\n-2\n530000\n180500\n")
    path.with_suffix(".prj").write_text(wkt)
    frame = open_map(path).frame
    assert (frame.latitude, frame.longitude) == pytest.approx(place, abs=2e-3)


@pytest.mark.parametrize(
    ("crs", "matrix", "place"),
    [
        ("EPSG:32632+5773", (2, 0, EAST, 0, -2, NORTH), (47.996723, 9.000858)),  # with heights
        ("EPSG:31467", (2, 0, 3_500_000, 0, -2, 5_317_000), (47.990545, 8.999834)),  # northing comes first
        ("EPSG:2180", (2, 0, 500_000, 0, -2, 500_000), (52.365372, 19.000940)),
        ("EPSG:4258", (2e-5, 0, 9.0, 0, -2e-5, 48.0), (47.999360, 9.000640)),  # latitude comes first
        ("EPSG:2263", (2, 0, 980_000, 0, -2, 200_000), (40.715454, -74.015100)),  # feet
        ("EPSG:4807", (2e-5, 0, 2.0, 0, -2e-5, 52.0), (46.799383, 4.137180)),  # gons from Paris
    ],
)
def test_coordinates_of_any_axis_order_and_unit(
    tmp_path: Path, crs: str, matrix: tuple[float, ...], place: tuple[float, float]
) -> None:
    town = open_map(write_geotiff(tmp_path / "a.tif", smooth(64, 64), crs, matrix))
    assert (town.frame.latitude, town.frame.longitude) == pytest.approx(place, abs=2e-6)


def test_a_raster_from_the_south_up_is_not_mirrored(tmp_path: Path) -> None:
    picture = smooth(120, 160)
    north = open_map(write_geotiff(tmp_path / "a.tif", picture))
    south = open_map(write_geotiff(tmp_path / "b.tif", picture[::-1], matrix=(0.5, 0, EAST, 0, 0.5, NORTH - 60)))
    assert south.frame == north.frame
    np.testing.assert_array_equal(cut(south), cut(north))


def test_a_turned_photo_with_corners_is_refused(tmp_path: Path) -> None:
    turned = Image.Exif()
    turned[0x0112] = 6
    Image.fromarray(smooth(60, 80)).save(tmp_path / "a.jpg", exif=turned)
    refused(tmp_path / "a.jpg", "EXIF orientation 6", "save it upright", corners=CORNERS)
    turned[0x0112] = 1
    Image.fromarray(smooth(60, 80)).save(tmp_path / "a.jpg", exif=turned)
    assert open_map(tmp_path / "a.jpg", MapOptions(corners=CORNERS)).frame.latitude == pytest.approx(47.9996)


def test_narrow_strips_are_sheets_of_a_map_that_is_large_enough(tmp_path: Path) -> None:
    picture = smooth(60, 80)
    whole = open_map(write_geotiff(tmp_path / "whole.tif", picture))
    strips = [
        write_geotiff(tmp_path / f"{row}.tif", picture[row : row + 5], matrix=(0.5, 0, EAST, 0, -0.5, NORTH - row / 2))
        for row in range(0, 60, 5)
    ]
    town = open_map(strips)
    assert town.bounds == pytest.approx(whole.bounds, abs=0.01)
    np.testing.assert_allclose(cut(town), cut(whole), atol=6)  # without a seam
    refused(strips[:2], "80 x 10 pixels")
    assert open_map(write_geotiff(tmp_path / "least.tif", smooth(16, 16))).bounds


def test_a_file_of_several_rasters_names_them(tmp_path: Path) -> None:
    import rasterio.shutil

    source, path = write_geotiff(tmp_path / "a.tif", smooth(64, 64)), tmp_path / "a.gpkg"
    rasterio.shutil.copy(str(source), str(path), driver="GPKG")
    assert open_map(path).frame == open_map(source).frame
    more = {"APPEND_SUBDATASET": "YES", "RASTER_TABLE": "second"}
    rasterio.shutil.copy(str(source), str(path), driver="GPKG", **more)
    refused(path, "rasters (", "export the right one as GeoTIFF")


@pytest.mark.parametrize(
    ("driver", "name"),
    [("JP2OpenJPEG", "b.jp2"), ("COG", "b.tif"), ("HFA", "b.img"), ("BMP", "b.bmp"), ("ENVI", "b.dat")],
)
def test_other_rasters_with_a_georeference_are_the_geotiff(tmp_path: Path, driver: str, name: str) -> None:
    import rasterio.shutil

    source = write_geotiff(tmp_path / "a.tif", smooth(64, 64))
    rasterio.shutil.copy(str(source), str(tmp_path / name), driver=driver)
    assert open_map(tmp_path / name).frame == open_map(source).frame


@pytest.mark.parametrize(
    ("crs", "words"),
    [
        ("EPSG:26732", "The datum of a.tif is North American Datum 1927, by which places may be off by some 20 m"),
        ("EPSG:2334", "Xian 1980, by which places may be off by more than 100 m"),
        ("+proj=utm +zone=32 +ellps=bessel +units=m", "by more than 100 m"),
        ("EPSG:4807", "by some 2 m"),
        ("EPSG:4004", "Not specified based on Bessel 1841 ellipsoid, by which places may be off by more than 100 m"),
        ("EPSG:4019", ""),
        ("+proj=utm +zone=32 +ellps=bessel +towgs84=598,74,418,0.2,0,-2.5,6.7", ""),
        ("EPSG:25832", ""),
        ("EPSG:3857", ""),
        ("EPSG:2056", ""),
    ],
)
def test_a_map_on_an_old_datum_tells_how_far_off_it_may_be(crs: str, words: str) -> None:
    notes = datum_notes([("a.tif", parse_crs(crs))])
    assert (words in notes[0]) if words else not notes


def test_a_map_has_one_note_for_all_sheets_on_an_old_datum(tmp_path: Path) -> None:
    place = (0.5, 0, 3_500_000, 0, -0.5, 5_400_000)
    files = [write_geotiff(tmp_path / name, smooth(60, 60), "EPSG:31467", place) for name in ("a.tif", "b.tif")]
    (note,) = open_map(files).notes
    assert note.startswith("The datum of a.tif, b.tif is Deutsches Hauptdreiecksnetz, by which")


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (" EPSG:32632\n", 32632),
        ("32632 ", 32632),
        ("urn:ogc:def:crs:EPSG::32632", 32632),
        ("urn:ogc:def:crs:EPSG:9.9:32632", 32632),
        ("EPSG: 32632", 32632),
        ("http://www.opengis.net/def/crs/EPSG/0/32632", 32632),
        ("+init=epsg:32632", 32632),
        ("+zone=32 +proj=utm +datum=WGS84", 32632),
        ("wgs84", 4326),
        ("NAD83", 4269),
        ("NAD27", 4267),
        ("WGS72", 4322),
        ("IAU_2015:30100", None),
    ],
)
def test_spellings_of_a_crs(text: str, code: int | None) -> None:
    assert parse_crs(text).to_epsg() == code


@pytest.mark.parametrize(
    "text", ["nonsense", "FOO:BAR", "urn:ogc:def:crs:EPSG::1", "urn:ogc:def:crs:../a:b:c", "WGS84 or so", "+proj=none"]
)
def test_what_is_no_crs_is_said_without_a_line_of_gdal(capfd: pytest.CaptureFixture[str], text: str) -> None:
    with pytest.raises(InputError, match="There is no CRS"):
        parse_crs(text)
    assert capfd.readouterr() == ("", "")


def test_the_georeferenced_file_of_a_survey_programs_folder_is_the_map(tmp_path: Path) -> None:
    """ODM leaves a bare preview, and other programs a surface model, beside the orthophoto."""
    folder = tmp_path / "project" / "odm_orthophoto"
    folder.mkdir(parents=True)
    write_geotiff(folder / "odm_orthophoto.tif", smooth(120, 160))
    Image.fromarray(smooth(120, 160)).save(folder / "odm_orthophoto.png")
    write_geotiff(folder / "dsm.tif", np.full((12, 16, 1), 300, np.float32), matrix=(5, 0, EAST, 0, -5, NORTH))
    town = open_map(folder)
    assert [sheet.name for sheet in town.sheets] == ["odm_orthophoto.tif"]
    assert town.notes == [
        "dsm.tif is left out of the map: it holds heights, which --elevation takes.",
        "odm_orthophoto.png is left out of the map: it has no georeference.",
    ]
    refused(tmp_path / "project", "is not the folder of the map itself; give", str(folder))
    (folder / "odm_orthophoto.tif").unlink()
    (folder / "dsm.tif").unlink()
    refused(folder, "odm_orthophoto.png has no georeference")


@pytest.mark.parametrize(
    ("crs", "x", "y", "place"),
    [
        ("EPSG:32630", -117.0, 161.0, "0.0012, -7.4888 on Earth"),
        ("EPSG:32630", -7.4, 39.65, "on Earth"),  # degrees as metres
        ("EPSG:3857", 0.0, 0.0, "0.0000, 0.0000 on Earth"),
        ("EPSG:32632", 5_000.0, 5_316_000.0, "on Earth"),  # local metres
        ("EPSG:4326", 0.0, 0.0, "0.0000, 0.0000 on Earth"),
        ("EPSG:32632", EAST, NORTH, None),
        ("EPSG:27700", 90_000.0, 10_000.0, None),  # Scilly
    ],
)
def test_coordinates_near_an_origin_are_warned_of(
    tmp_path: Path, crs: str, x: float, y: float, place: str | None
) -> None:
    pixel = 1e-5 if crs == "EPSG:4326" else 0.5
    town = open_map(write_geotiff(tmp_path / "a.tif", smooth(60, 220), crs, (pixel, 0, x, 0, -pixel, y)))
    warnings = [note for note in town.notes if "on Earth" in note]
    assert len(warnings) == (place is not None)
    if place is not None:
        assert place in warnings[0]
        assert f"in its CRS {crs}" in warnings[0]
