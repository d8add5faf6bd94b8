"""Readers of flights and maps, and the real files for damaged ones."""

from __future__ import annotations

import io
import json
from contextlib import closing
from pathlib import Path
from typing import Any

from tools.fuzz.targets import FuzzCase, in_file


def flights(folder: Path) -> list[FuzzCase]:
    """Metadata of photos, subtitles, logs, tracks, and the folder of a flight."""
    from PIL import ExifTags

    from lpn.core.images import header_error
    from lpn.flight.files import Frame, footprint, open_flight, write_flight
    from lpn.flight.files.clock_fit import fit_clocks
    from lpn.flight.files.logs import entries_by_name, for_video, moments, parse_track, read_log
    from lpn.flight.files.makers import Properties
    from lpn.flight.files.photos import Photo, photo_of
    from lpn.flight.files.subtitles import blocks_of, parse_subtitles
    from lpn.flight.files.telemetry import Log, Telemetry
    from lpn.flight.files.values import decoded
    from tools.fixtures.field_photos import FIELD
    from tools.fixtures.photos import dji_xmp, exif, photo_bytes, sensefly_xmp, write_photo, xmp_packet

    base, gps = ExifTags.Base, ExifTags.GPS
    camera: dict[int, Any] = {base.DateTimeOriginal: "2024:05:01 14:00:00", base.OffsetTimeOriginal: "+02:00"}
    camera |= {base.FocalLength: 4.5, base.FocalLengthIn35mmFilm: 24, base.FocalPlaneXResolution: 16393.4}
    clock: dict[int, Any] = {gps.GPSDateStamp: "2024:05:01", gps.GPSTimeStamp: (12.0, 0.0, 4.0), gps.GPSAltitude: 12.5}
    packets = [
        dji_xmp(GpsLatitude="+46.8", GimbalYawDegree="-45.00", GimbalPitchDegree="-89.90", RelativeAltitude="+39.80"),
        sensefly_xmp(Heading=70.06, Height=66.1, RollAngle=-2.9, PitchAngle=2.5, UTCTime="2013-06-04T17:38:03"),
        xmp_packet(
            "<s:CameraOrientationNED rdf:parseType='Resource'><s:Yaw>1</s:Yaw></s:CameraOrientationNED>", {"s": "a:b"}
        ),
    ]
    whole = [photo_bytes(exif(46.8, -91.9, {base.Orientation: 6}, camera, clock), packet, (8, 6)) for packet in packets]
    directories = exif(46.8, -91.9, {base.Orientation: 8}, camera, clock).tobytes()

    def photo(data: bytes) -> None:
        if header_error(io.BytesIO(data)) is None:
            taken = photo_of(data, Path("a.jpg"))
            assert all(len(oddity) < 2000 and oddity.isprintable() for oddity in taken.oddities)
            footprint(taken.frame, 50.0)

    def with_exif(data: bytes) -> None:
        """A photo with damaged EXIF of the right length, which the whole file's damage seldom makes."""
        plain = photo_bytes(size=(8, 6))
        photo(plain[:2] + b"\xff\xe1" + min(len(data) + 2, 65_535).to_bytes(2, "big") + data[:65_533] + plain[2:])

    def packet(data: bytes) -> None:
        told = Properties()
        told.add_xmp(data)
        assert all(len(list(told.rows(field))) < 17 for field in ("position", "angles", "altitude"))

    lines = (
        "1\n00:00:00,000 --> 00:00:01,000\n2024-05-01 14:00:00.000\n[focal_len: 24.00] [latitude: 47.1] [longitude: 8.1] "
        "[rel_alt: 1.0 abs_alt: 2.0] [gb_yaw: 1.0 gb_pitch: -80.0 gb_roll: 2.0]\n\n2\n00:00:01,000 --> 00:00:02,000\n"
        "GPS (-58.85, -34.23, 15), HOME (-58.84, -34.23, -57.98m), D 698.70m, H 85.80m, F.PRY (2.7°, -7.0°, 110.1°), "
        "G.PRY (-24.4°, 0.0°, 110.4°)\n\n3\n00:00:02,000 --> 00:00:03,000\nGPS(36.6,-6.1,0.0M) BAROMETER:0.3M\n"
    )
    autel = (
        "1\n00:00:00,000 --> 00:00:01,000\nHOME(E: 8.5, N: 47.3) 2024-05-01 14:00:00\nGPS(E: 8.501, N: 47.301, 574.2m) ReH:1\n\n"
        "2\n00:00:01,000 --> 00:00:02,000\nRTK (8.501, 47.301, 28), D 252.06m, H 76.19m\n"
    )

    def subtitles(data: bytes) -> None:
        telemetry = Telemetry(parse_subtitles(blocks_of(data), "a.SRT").entries)
        _ = telemetry.at(0.5), telemetry.times_by_distance(1000.0)

    logs = [
        "filename,time(ms),datetime(utc),lat,lon,rel_alt(feet),gimbal_yaw,gimbal_pitch,isVideo\n"
        "a.jpg,0,2024-05-01 12:00:00,47,8,10,20,-90,1\nb.jpg,1000,2024-05-01T12:00:01+02:00,47.1,8,10,20,-90,1\n",
        "#Label;X/Longitude;Y/Latitude;Z/Altitude;Yaw;Pitch;Roll\na.JPG;8,501;47,301;512,5;30;2;-1\n# Total error;1\n",
        "latitude,longitude,time(ms),gimbalPitchRaw,gimbalRollRaw,gimbalYawRaw\n47.3,8.5,0,-900,0,450\n",
        'SourceFile,GPSPosition,GPSDateTime\na.jpg,"47 deg 18\' 4.44"" N, 8 deg 30\' 4.44"" E",2024:05:01 12:00:00Z\n',
        "EPSG:4326\na.jpg 8.5 47.3 512 30 0 0\n",
        "Date,Time,lat [degE7],lon [degE7],alt (mm)\n5/1/2024,1:00:00.5 PM,473010000,85010000,512000\n",
        "%  GPST  latitude(deg) longitude(deg) height(m) Q\n2024/05/01 12:00:18.0 47.3 8.5 512.5 5\n",
    ]
    frames = [Frame(f"{i}.jpg", Path(f"{i}.jpg"), 4, 3, latitude=47.0 + i, longitude=8.0) for i in range(3)]
    photos = [Photo(frame, 1714564800.0 + i) for i, frame in enumerate(frames)]

    def fitted(found: Log) -> None:
        entries_by_name(found)
        fit_clocks(photos, Telemetry(moments(found)[0]), found.utc)
        Telemetry(for_video(found, 0)[0]).at(0.5)

    gpx = (
        '<gpx version="1.1"><wpt lat="47.3" lon="8.5"><name>a.jpg</name></wpt><trk><trkseg><trkpt lat="47.3" lon="8.5">'
        '<ele>5</ele><time>2024-05-01T12:00:00Z</time></trkpt><trkpt lat="47.4" lon="8.5">'
        "<time>2024-05-01T12:00:09+02:00</time></trkpt></trkseg></trk></gpx>"
    )
    write_photo(folder / "photos" / "a.jpg", exif(46.8, -91.9, {}, camera, clock), packets[0])
    write_flight(open_flight(folder / "photos"), folder / "flight")
    log, flight = folder / "log.csv", folder / "flight"
    return [
        FuzzCase(whole, photo),
        FuzzCase([data for data, _, _ in FIELD.values()], photo),
        FuzzCase([directories], with_exif),
        FuzzCase(packets, packet),
        FuzzCase([lines.encode(), autel.encode()], subtitles),
        in_file(log, lambda: fitted(read_log(log)), *(text.encode() for text in logs)),
        FuzzCase([gpx.encode()], lambda data: fitted(parse_track(decoded(data, "a.gpx"), "a.gpx"))),
        *(in_file(flight / name, lambda: open_flight(flight).degrees) for name in ("flight.csv", "flight.json")),
    ]


def maps(folder: Path) -> list[FuzzCase]:
    """GeoTIFFs, side files, lists of corners, MBTiles and folders of tiles, and map.json."""
    import rasterio
    from PIL import Image

    from lpn.flight.maps import MapOptions, Window, open_map
    from lpn.flight.maps.folder import build_map
    from tools.fixtures import small_tiles, small_worlds

    picture = small_worlds.place(1)[:64, :64]
    tiles = small_worlds.place(2)[:64, :64]
    corners = MapOptions(corners=(48.0, 9.0, 47.999, 9.0014))

    def shown(path: Path, options: MapOptions | None = None) -> None:
        with closing(open_map(path, options)) as town:
            cut, valid = town.read(Window(0, 0, 50, 20), 24)
            assert (cut.shape, valid.shape) == ((24, 24, 3), (24, 24))

    def file(name: str, seed: bytes, opened: str | None = None, options: MapOptions | None = None) -> FuzzCase:
        (folder / name).write_bytes(seed)
        return in_file(folder / name, lambda: shown(folder / (opened or name), options))

    def geotiff(name: str, bands: int, kind: str, **options: Any) -> bytes:
        profile = {"driver": "GTiff", "height": 64, "width": 64, "count": bands, "dtype": kind, "crs": "EPSG:32632"}
        transform = rasterio.Affine(2, 0, 500_000, 0, -2, 5_316_000)
        with rasterio.open(folder / name, "w", transform=transform, **profile, **options) as opened:
            for band in range(bands):
                opened.write(picture[:, :, band % 3].astype(kind), band + 1)
        return (folder / name).read_bytes()

    world = b"2\n0\n0\n-2\n500001\n5315999\n"
    Image.fromarray(picture).save(folder / "world.png")
    (folder / "world.prj").write_text("EPSG:32632")
    (folder / "world.pgw").write_bytes(world)
    Image.fromarray(picture).save(folder / "listed.png")
    header = "Filename,Top_left_lat,Top_left_lon,Bottom_right_lat,Bottom_right_lon\n"
    notes = b"<MDI key='OVERVIEW_FILE'>/vsicurl/http://127.0.0.1:9/a.tif</MDI></Metadata></PAMDataset>"
    notes = b"<PAMDataset><Metadata domain='OVERVIEWS'>" + notes
    geotiff("beside.tif", 1, "uint8")
    geotiff("beside.tif.ovr", 1, "uint8")
    geotiff("noted.tif", 1, "uint8")
    metadata = {"bounds": small_tiles.bounds_text(), "scheme": "tms", "minzoom": "18"}
    database = folder / "a.mbtiles"
    databases = [small_tiles.write_mbtiles(database, tiles, metadata, side=32).read_bytes()]
    databases.append(small_tiles.write_mbtiles(database, tiles, {}, side=32, view=True).read_bytes())
    small_tiles.write_folder(folder / "tiles", tiles, side=32)
    first = next(path for path in sorted((folder / "tiles").rglob("*.png")))
    small_tiles.write_folder(folder / "south", tiles, side=32)
    build_map([folder / "tiles"], folder / "map")
    return [
        file("alpha.tif", geotiff("alpha.tif", 4, "uint16", photometric="RGB", alpha="yes", compress="deflate")),
        file("nodata.tif", geotiff("nodata.tif", 1, "float32", nodata=7, tiled=True, blockxsize=32, blockysize=32)),
        file("jpeg.tif", geotiff("jpeg.tif", 3, "uint8", photometric="YCBCR", compress="jpeg")),
        file("plain.png", (folder / "world.png").read_bytes(), options=corners),
        file("world.pgw", world, "world.png"),
        file("world.prj", b"EPSG:32632", "world.png"),
        file("map.csv", (header + "listed.png,48.0,9.0,47.999,9.0014\n").encode(), "map.csv"),
        file("beside.tif.ovr", (folder / "beside.tif.ovr").read_bytes(), "beside.tif"),
        file("noted.tif.aux.xml", notes, "noted.tif"),
        file("named.tif", b'<VRTDataset rasterXSize="64" rasterYSize="64"></VRTDataset>'),
        file("tiles/" + first.relative_to(folder / "tiles").as_posix(), first.read_bytes(), "tiles"),
        file("tiles/metadata.json", json.dumps(metadata).encode(), "tiles"),
        file("map/map.json", (folder / "map" / "map.json").read_bytes(), "map"),
        file("south/tilemapresource.xml", b"<TileMap><SRS>EPSG:3857</SRS></TileMap>", "south"),
        *(file("a.mbtiles", seed) for seed in databases),
    ]
