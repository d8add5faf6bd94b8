"""Files of users that would make GDAL read other files or ask servers."""

from __future__ import annotations

import io
import json
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
import pytest
from PIL import Image

from lpn.cli.main import main
from lpn.core.errors import DataError, InputError
from lpn.flight.maps import MapOptions, _gdal, open_map
from lpn.flight.maps.elevation import ElevationFile
from lpn.flight.maps.folder import build_map
from lpn.flight.maps.sources import parse_crs
from tests.lpn.flight.maps.small_maps import EAST, NORTH, smooth, write_geotiff
from tools.fixtures.small_tiles import write_mbtiles

_LISTENER = """
import socket, sys
listener = socket.create_server(("127.0.0.1", 0))
print(listener.getsockname()[1], flush=True)
while True:
    connection = listener.accept()[0]
    connection.settimeout(60)
    with connection, open(sys.argv[1], "ab") as heard:
        heard.write(connection.recv(1000).split(b"\\r\\n")[0] + b"\\n")
        heard.flush()
        connection.sendall(b"HTTP/1.1 404 Not Found\\r\\nContent-Length: 0\\r\\nConnection: close\\r\\n\\r\\n")
"""
_WMS = (
    '<GDAL_WMS><Service name="TMS"><ServerUrl>{}/${{z}}/${{x}}/${{y}}.png</ServerUrl></Service><DataWindow><UpperLeftX>0'
    "</UpperLeftX><UpperLeftY>600</UpperLeftY><LowerRightX>600</LowerRightX><LowerRightY>0</LowerRightY><TileLevel>2</TileLevel>"
    "<SizeX>600</SizeX><SizeY>600</SizeY></DataWindow><Projection>EPSG:3857</Projection><BandsCount>3</BandsCount></GDAL_WMS>"
)
_WCS = "<WCS_GDAL><ServiceURL>{}/wcs?</ServiceURL><Version>1.0.0</Version><CoverageName>a</CoverageName></WCS_GDAL>"
_VRT = (
    '<VRTDataset rasterXSize="600" rasterYSize="600"><VRTRasterBand dataType="Byte" band="1"><SimpleSource><SourceFilename>'
    "/vsicurl/{}/a.tif</SourceFilename><SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"
)
_RAW = (
    '<VRTDataset rasterXSize="20" rasterYSize="20"><GeoTransform>0,1,0,0,0,-1</GeoTransform>'
    '<VRTRasterBand dataType="Byte" band="1" subClass="VRTRawRasterBand">'
    '<SourceFilename relativeToVRT="1">secret.txt</SourceFilename><PixelOffset>1</PixelOffset><LineOffset>20</LineOffset>'
    "</VRTRasterBand></VRTDataset>"
)
_NOTES = (
    '<PAMDataset><Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">/vsicurl/{}/a.tif</MDI></Metadata></PAMDataset>'
)


@pytest.fixture
def listener(tmp_path: Path) -> Iterator[tuple[str, Path]]:
    """A server on loopback in a process of its own, as GDAL holds Python's lock while it asks: its address, and what it hears."""
    heard = tmp_path / "heard.txt"
    heard.touch()
    process = subprocess.Popen([sys.executable, "-c", _LISTENER, heard], stdout=subprocess.PIPE, text=True)
    yield f"http://127.0.0.1:{int(process.stdout.readline())}", heard
    process.kill()
    process.communicate()


def text(contents: str) -> Callable[[Path, str], Path]:
    def write(folder: Path, address: str) -> Path:
        path = folder / "town.tif"
        path.write_text(contents.format(address))
        return path

    return write


def beside(contents: str, end: str) -> Callable[[Path, str], Path]:
    def write(folder: Path, address: str) -> Path:
        path = write_geotiff(folder / "town.tif", smooth(600, 600)[:, :, :1])
        Path(f"{path}{end}").write_text(contents.format(address))
        return path

    return write


def inside(folder: Path, address: str) -> Path:
    """Write a whole GeoTIFF whose own tag names its overviews."""
    import rasterio

    path = write_geotiff(folder / "town.tif", smooth(600, 600)[:, :, :1])
    with rasterio.open(path, "r+") as file:
        file.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=f"/vsicurl/{address}/a.tif")
    return path


def polyglot(folder: Path, address: str) -> Path:
    """Write a JPEG with a VRT as its comment, which stands before any zero."""
    path, packed = folder / "town.jpg", io.BytesIO()
    Image.fromarray(smooth(600, 600)).save(packed, "JPEG")
    comment = _VRT.format(address).encode().ljust(0x0401, b" ")
    path.write_bytes(b"\xff\xd8\xff\xfe" + (len(comment) + 2).to_bytes(2, "big") + comment + packed.getvalue()[2:])
    return path


CASES: dict[str, Callable[[Path, str], Path]] = {
    "WMS": text(_WMS),
    "WCS": text(_WCS),
    "VRT": text(_VRT),
    "overviews that are a WMS": beside(_WMS, ".ovr"),
    "overviews that are a VRT": beside(_VRT, ".OVR"),
    "notes that name overviews": beside(_NOTES, ".aux.xml"),
    "a tag that names overviews": inside,
    "a CRS that names a grid": beside(
        "<PAMDataset><SRS>+proj=longlat +nadgrids={}/a.gsb</SRS></PAMDataset>", ".aux.xml"
    ),
    "a JPEG that is a VRT, too": polyglot,
}


@pytest.mark.parametrize("case", CASES)
def test_no_file_of_a_user_makes_gdal_ask_a_server(tmp_path: Path, listener: tuple[str, Path], case: str) -> None:
    _gdal.rasterio()  # before anything else uses GDAL, as the commands do
    (tmp_path / "theirs").mkdir()
    path = CASES[case](tmp_path / "theirs", listener[0])
    corners = MapOptions(corners=(48.0, 9.0, 47.999, 9.0014))
    if case == "a JPEG that is a VRT, too":
        open_map(path, corners).overview(8)
    else:
        with pytest.raises(DataError, match=r"^[^\n]*$"):
            open_map(path, corners)
    with pytest.raises(DataError, match=r"^[^\n]*$"):
        ElevationFile(path)
    main(["doctor", "--data", str(path.parent)])
    assert not listener[1].read_text()


_OPENS = """
import sys
from lpn.flight.maps import _gdal
gdal = _gdal.rasterio()
for name in sys.argv[1:]:
    try:
        print(gdal.open(name))
    except gdal.errors.RasterioIOError:
        pass
"""


def test_gdal_itself_has_no_driver_of_servers_and_opens_no_address(tmp_path: Path, listener: tuple[str, Path]) -> None:
    """In a new process: GDAL takes its settings once, and another test may have imported rasterio before."""
    names = text(_WMS)(tmp_path, listener[0]), f"/vsicurl/{listener[0]}/a.tif"
    done = subprocess.run([sys.executable, "-c", _OPENS, *map(str, names)], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
    assert not listener[1].read_text()


def test_a_sheet_is_read_by_the_driver_that_opened_it(tmp_path: Path) -> None:
    """A grid of bytes, which only its header tells from any other file, begins as the index of a raw band over a text file."""
    side = 400
    (tmp_path / "secret.txt").write_bytes(b"what no map shows. " * (side * side // 19 + 1))
    (tmp_path / "raw.vrt").write_text(_RAW.replace("20", str(side)))
    index = (
        f"<Dimap_Document><Raster_Dimensions><NCOLS>{side}</NCOLS><NROWS>{side}</NROWS><NBANDS>1</NBANDS></Raster_Dimensions>"
        '<Data_Access><Data_File><DATA_FILE_PATH href="raw.vrt"/></Data_File></Data_Access></Dimap_Document>'
    ).encode()
    header = f"NROWS {side}\nNCOLS {side}\nNBITS 8\nULXMAP {EAST}\nULYMAP {NORTH}\nXDIM 1\nYDIM 1\n"
    (tmp_path / "town.hdr").write_text(header)
    pixels = index + b"\0" + smooth(side, side)[:, :, 0].tobytes()[len(index) + 1 :]
    path = tmp_path / "town.bil"
    path.write_bytes(pixels)
    raster = open_map(path, MapOptions(crs="EPSG:32632")).sheets[0].raster
    row = raster.cut(np.array([[1.0, 0, 0], [0, 1, 100]]), (side, 1), 1)[0]
    assert row[0, :, 0].tobytes() == pixels[100 * side : 101 * side]
    assert {file.name for file in raster.files()} == {"town.bil", "town.hdr"}


def test_no_table_of_an_mbtiles_is_another_file(tmp_path: Path) -> None:
    """GDAL has virtual tables of SQLite that open any file by any of its drivers."""
    path, other = tmp_path / "town.mbtiles", tmp_path / "other.sqlite"
    for file in (path, other):
        write_mbtiles(file, smooth(512, 512), {})
    open_map(path).close()
    with sqlite3.connect(path) as database:
        database.execute("DROP TABLE tiles")
        database.execute("PRAGMA writable_schema = ON")
        virtual = f"CREATE VIRTUAL TABLE tiles USING VirtualOGR('{other}', 0, 'tiles')"
        database.execute("INSERT INTO sqlite_master VALUES ('table', 'tiles', 'tiles', 0, ?)", (virtual,))
    database.close()
    with pytest.raises(DataError, match="cannot be read as a map"):
        open_map(path)


@pytest.mark.parametrize("elsewhere", [False, True])
def test_a_file_of_imagine_takes_pixels_from_its_own_folder_alone(tmp_path: Path, elsewhere: bool) -> None:
    import rasterio.shutil

    mine, other = tmp_path / "mine", tmp_path / "other"
    mine.mkdir()
    other.mkdir()
    written = mine / "a-long-name-of-a-town.img"
    plain = write_geotiff(tmp_path / "town.tif", smooth(60, 60))
    rasterio.shutil.copy(plain, written, driver="HFA", USE_SPILL="YES")
    if elsewhere:
        name = b"a-long-name-of-a-town.ige"
        written.with_suffix(".ige").rename(other / "secret.ige")
        named = b"../other/".ljust(len(name) - len(b"secret.ige"), b"/") + b"secret.ige"
        written.write_bytes(written.read_bytes().replace(name, named))
    (mine / "link.img").symlink_to(written.name)
    for path in (mine / ".." / "mine" / written.name, mine / "link.img"):
        if elsewhere:
            with pytest.raises(DataError, match=r"takes pixels from another folder \(.*other.*secret\.ige\); make one"):
                open_map(path)
        else:
            open_map(path).close()


def test_a_folder_beside_a_raster_is_not_taken_for_its_overviews(tmp_path: Path) -> None:
    path = write_geotiff(tmp_path / "town.tif", smooth(600, 600)[:, :, :1])
    (tmp_path / "town.tif.OVR").mkdir()
    with pytest.raises(DataError, match=r"town\.tif\.OVR holds no overviews and no mask"):
        open_map(path)


@pytest.mark.parametrize("name", ["a?if=VRT.tif", "<VRTDataset>.tif"])
def test_a_name_by_which_gdal_would_open_another_file_is_refused(tmp_path: Path, name: str) -> None:
    path = write_geotiff(tmp_path / "a.tif", smooth(60, 60)).rename(tmp_path / name)
    with pytest.raises(DataError, match=r"has \? or < in its path"):
        open_map(path)


def test_no_crs_is_asked_of_a_server_or_read_from_a_file(tmp_path: Path, listener: tuple[str, Path]) -> None:
    from rasterio.crs import CRS

    (tmp_path / "wkt.txt").write_text(CRS.from_epsg(32632).to_wkt())
    plain = write_geotiff(tmp_path / "b.tif", smooth(60, 60), crs=None)
    build_map([write_geotiff(tmp_path / "a.tif", smooth(60, 60))], tmp_path / "map").close()
    record = json.loads((tmp_path / "map" / "map.json").read_text())
    for crs in (f"{listener[0]}/crs", str(tmp_path / "wkt.txt")):
        with pytest.raises(InputError, match="There is no CRS"):
            parse_crs(crs)
        plain.with_suffix(".prj").write_text(crs)
        with pytest.raises(DataError, match="holds no coordinate reference system"):
            open_map(plain)
        record["sheets"][0]["crs"] = crs
        (tmp_path / "map" / "map.json").write_text(json.dumps(record))
        with pytest.raises(InputError, match="There is no CRS"):
            open_map(tmp_path / "map")
    assert not listener[1].read_text()


_DEGREES = 'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]]'
_BOUND = (
    'BOUNDCRS[SOURCECRS[GEOGCRS["x",DATUM["d",ELLIPSOID["WGS 84",6378137,298.257223563]],CS[ellipsoidal,2],AXIS["lat",north],'
    'AXIS["lon",east],UNIT["degree",0.0174532925199433]]],TARGETCRS[GEOGCRS["WGS 84",DATUM["World Geodetic System 1984",'
    'ELLIPSOID["WGS 84",6378137,298.257223563]],CS[ellipsoidal,2],AXIS["lat",north],AXIS["lon",east],'
    'UNIT["degree",0.0174532925199433],ID["EPSG",4326]]],ABRIDGEDTRANSFORMATION["t",METHOD["NTv2",ID["EPSG",9615]],'
    'PARAMETERFILE["Latitude and longitude difference file","{}"]]]'
)
_GRIDS = {
    "PROJ": "+proj=longlat +ellps=WGS84 +nadgrids=@null,{} +no_defs",
    "heights": "+proj=utm +zone=32 +ellps=WGS84 +geoidgrids={}",
    "quoted": '+proj=longlat +ellps=WGS84 +nadgrids="{}"',
    "init": "+proj=longlat +init={}:x",
    "WKT 1": 'GEOGCS["x",DATUM["d",SPHEROID["W",6378137,298.2572],EXTENSION["PROJ4_GRIDS","{}"]],' + _DEGREES,
    "PROJ in WKT 1": 'GEOGCS["x",DATUM["d",SPHEROID["W",6378137,298.2572]],'
    + _DEGREES.removesuffix("]")
    + ',EXTENSION["PROJ4","+proj=longlat +ellps=WGS84 +nadgrids={}"]]',
    "WKT 2": _BOUND,
}


@pytest.mark.parametrize("kind", _GRIDS)
def test_no_crs_makes_proj_open_a_path(tmp_path: Path, capfd: pytest.CaptureFixture[str], kind: str) -> None:
    crs = _GRIDS[kind].format(tmp_path / "grid")
    for text in (crs, f" {crs}\n"):
        with pytest.raises(DataError, match="names a file by its path"):
            parse_crs(text)
    if kind != "init":  # which GDAL itself refuses
        # Rasterio opens the path where it lies in a raster, before any of us knows of it.
        (tmp_path / "grid.txt").write_text("what no map shows")
        crs = _GRIDS[kind].format(tmp_path / "grid.txt")
        plain = write_geotiff(tmp_path / "a.tif", smooth(60, 60), crs=None)
        Path(f"{plain}.aux.xml").write_text(f"<PAMDataset><SRS>{escape(crs)}</SRS></PAMDataset>")
        with pytest.raises(DataError, match="has a CRS that names a file by its path"):
            open_map(plain)
    assert "PROJ" not in capfd.readouterr().err


def test_a_crs_may_name_grids_without_a_path() -> None:
    from rasterio.crs import CRS

    mercator = CRS.from_epsg(3857)  # with nadgrids=@null
    for text in (mercator.to_wkt(), mercator.to_proj4(), "+proj=longlat +ellps=bessel +nadgrids=BETA2007.gsb"):
        assert parse_crs(text)


def test_overviews_and_notes_beside_a_file_are_used(tmp_path: Path) -> None:
    import rasterio

    path = write_geotiff(tmp_path / "a.tif", smooth(600, 600), tiled=True, blockxsize=256, blockysize=256)
    with rasterio.Env(TIFF_USE_OVR=True), rasterio.open(path, "r+") as file:
        file.build_overviews([2], rasterio.enums.Resampling.average)
    (tmp_path / "a.aux").write_text(r"\relax")  # of LaTeX
    files = {file.name for file in open_map(path).sheets[0].raster.files()}
    assert files == {"a.tif", "a.tif.ovr"}


@pytest.mark.parametrize("fine_overviews", [False, True])
def test_a_sparse_file_of_many_gigapixels_is_refused_before_any_work(tmp_path: Path, fine_overviews: bool) -> None:
    import rasterio

    path = tmp_path / "sparse.tif"
    kind = {"driver": "GTiff", "count": 1, "dtype": "int16", "crs": "EPSG:32632", "sparse_ok": True, "bigtiff": "YES"}
    place = rasterio.Affine(0.5, 0, 5e5, 0, -0.5, 5_316_000)
    for file, side in ((path, 400_000 if fine_overviews else 200_000), (Path(f"{path}.ovr"), 200_000)):
        if file == path or fine_overviews:
            blocks = {"tiled": True, "blockxsize": 4096, "blockysize": 4096}
            with rasterio.open(file, "w", width=side, height=side, transform=place, **blocks, **kind):
                pass
            assert file.stat().st_size < 200_000
    for door in (open_map, ElevationFile):
        with pytest.raises(DataError, match=r"00000 pixels, and a first look at it would take 31 minutes or more; cut"):
            door(path)
