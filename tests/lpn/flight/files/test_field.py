"""Text telemetry from the field: the right values of each file, and their documentation. Numbers are invented."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from lpn.core.errors import DataError
from lpn.flight.files.dialects import DIALECTS, table_of
from lpn.flight.files.logs import read_log
from lpn.flight.files.sources import read_any_log

SRT = "1\n00:00:00,000 --> 00:00:01,000\n{}\n\n"
PARSER, ODM_SRT = "https://github.com/JuanIrache/DJI_SRT_Parser", "https://github.com/OpenDroneMap/ODM/pull/1667"
GEO = "https://docs.opendronemap.org/geo/"
PRY = "F.PRY (2.7°, -7.0°, 110.1°), G.PRY (-24.4°, 0.0°, 110.4°)"
AIRDATA = (
    "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),height_above_ground_at_drone_location(feet),"
    "altitude_above_seaLevel(feet), compass_heading(degrees), pitch(degrees),isVideo,gimbal_heading(degrees),"
    "gimbal_pitch(degrees),gimbal_roll(degrees)\n"
)
LITCHI = "latitude,longitude,altitude(feet),ascent(feet),time(millisecond),datetime(utc),datetime(local),pitch(deg),roll(deg),"
LITCHI += "yaw(deg),pitchRaw,rollRaw,yawRaw,gimbalPitchRaw,gimbalRollRaw,gimbalYawRaw,isRecordingVideo\n"
PHANTOMHELP = "https://forum.phantomhelp.com/t/flight-reader-field-descriptions/10579"
MAVLINK = "https://mavlink.io/en/messages/common.html#GLOBAL_POSITION_INT"

ARDUPILOT = "https://ardupilot.org/copter/docs/logmessages.html"
FMT = (
    "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n"
    "FMT, 130, 50, GPS, QBIHBcLLefffB, TimeUS,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,U\n"
    "FMT, 131, 44, MNT, Qffff, TimeUS,R,P,YB,YE\nFMT, 132, 44, ATT, Qffffff, TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw\n"
)
FIXES = "".join(
    f"GPS, 100{i}00000, 4, {468018000 + 100 * i}, 2313, 14, 0.8, 47.301, 8.501, 500.0, 2.0, 0.0, 0.0, 1\n"
    for i in range(8)
)

Case = tuple[str, str, str, dict[str, Any], str]


def by(source: str, file: str, text: str, note: str = "", **values: Any) -> Case:
    """A case: where it is documented, the file, its text, the values of its first row, and a part of a note."""
    return source, file, text, values, note


def at(latitude: float, longitude: float) -> dict[str, float]:
    return {"latitude": latitude, "longitude": longitude}


HERE = at(47.301, 8.501)
CASES = (
    # Tables
    by(DIALECTS[0].source, "airdata.csv",
       AIRDATA + "500,2024-05-01 12:00:00,47.301,8.501,100,90,1000,350,5,1,10,-90,0\n", **HERE, time=0.5, clock=1714564800.0,
       height_above_takeoff=30.48, height_above_ground=27.432, altitude=304.8, heading=10.0, heading_source="gimbal",
       pitch=-90.0),
    by(PHANTOMHELP, "phantomhelp.csv",
       "sep=,\nCUSTOM.date [local],CUSTOM.updateTime [local],OSD.flyTime,OSD.flyTime [s],OSD.latitude,OSD.longitude,"
       "OSD.height [ft],OSD.yaw [360],OSD.yaw,GIMBAL.pitch,GIMBAL.roll,GIMBAL.yaw,HOME.latitude,HOME.longitude\n"
       "6/15/2026,1:00:00.05 PM,0m 0.1s,0.1,47.301,8.501,100,10,10,-90,0,12,1.0,2.0\n",
       **HERE, time=0.1, clock=1781528400.05, height_above_takeoff=30.48, heading=12.0, pitch=-90.0),
    by(PHANTOMHELP, "flight_reader.csv",
       "CUSTOM.date [local];CUSTOM.updateTime [local];OSD.latitude;OSD.longitude;OSD.height [m]\n"
       "15.05.2024;12:00:00,05;47,301;8,501;45,2\n", **HERE, clock=1715774400.05, height_above_takeoff=45.2),
    by("pitch(deg) beside pitchRaw", "litchi.csv",
       LITCHI + "47.301,8.501,200,200,0,2019-02-16 08:56:00.000,2019-02-16 09:56:00.000,-3.1,0.2,45.0,-31,2,450,-900,0,451,0\n",
       **HERE, clock=1550307360.0, heading=45.1, heading_source="gimbal", pitch=-90.0, roll=0.0),
    by("https://exiftool.org/exiftool_pod.html", "exiftool.csv",
       "SourceFile,GPSLatitude,GPSLongitude,GPSAltitude,GPSAltitudeRef,DateTimeOriginal,GPSImgDirection\n"
       "./a/DJI_0001.JPG,\"47 deg 18' 3.60\"\" N\",\"8 deg 30' 3.60\"\" W\",12.5 m,Below Sea Level,2024:05:01 14:00:00,40\n",
       **at(47.301, -8.501), altitude=-12.5, clock=1714572000.0, heading=40.0, heading_source="camera"),
    by("https://exiftool.org/exiftool_pod.html", "exiftool_groups.csv",
       'SourceFile,EXIF:GPSPosition,XMP:GimbalYawDegree,XMP:GimbalPitchDegree\n'
       'a.jpg,"47 deg 18\' 3.60"" N, 8 deg 30\' 3.60"" E",+12.0,-90.0\n', **HERE, heading=12.0, pitch=-90.0),
    by("https://exiftool.org/TagNames/GPS.html", "exiftool_letters.csv",
       "SourceFile,GPSLatitude,GPSLatitudeRef,GPSLongitude,GPSLongitudeRef\na.jpg,47.301,South,8.501,West\n",
       **at(-47.301, -8.501)),
    by("https://exiftool.org/TagNames/XMP.html", "xmp.csv",
       'SourceFile,XMP:GPSLatitude,XMP:GPSLongitude\na.jpg,"9,9,9S","70,30.6W"\n', **at(-9.1525, -70.51)),
    by("https://exiftool.org/TagNames/DJI.html, RtkFlag of 16 is a single solution", "exiftool_rtk.csv",
       "SourceFile,GPSLatitude,GPSLongitude,RtkFlag\na.jpg,47.301,8.501,16\nb.jpg,47.301,8.501,50\nc.jpg,47.301,8.501,\n",
       "1 of 3 rows of exiftool_rtk.csv have no fixed RTK solution (RtkFlag is not 50)", **HERE),
    by("https://photogrammetrycommunity.github.io/metashape-expert-manual/", "agisoft.csv",
       "# CoordinateSystem: WGS 84\n#Label,X/Longitude,Y/Latitude,Z/Altitude,Error_(m),Yaw,Pitch,Roll\n"
       "DJI_0001.JPG,8.501,47.301,512.5,0.1,30,2,-1\n# Total error,0.1\n",
       **HERE, altitude=512.5, heading=30.0, heading_source="camera", pitch=-88.0, roll=-1.0),
    by("https://photogrammetrycommunity.github.io/metashape-expert-manual/", "photoscan.csv",
       "#Label,X/East,Y/North,Z/Altitude,Yaw,Pitch,Roll\nDJI_1.JPG,8.501,47.301,450,40,3,1\n", **HERE, heading=40.0, pitch=-87.0),
    by("https://support.pix4d.com/hc/en-us/articles/202558539", "pix4d.csv",
       "DJI_0001.JPG,47.301,8.501,512.5\nDJI_0002.JPG,47.302,8.501,512.5\n", "latitude was read before longitude",
       **HERE, altitude=512.5),
    by("https://support.pix4d.com/hc/en-us/articles/360056389172", "pix4dmatic.csv",
       "#imagename,coordinate1,coordinate2,z,yaw,pitch,roll\nIMG_1.JPG,47.301,8.501,512.5,38.6,3.5,8.3\n",
       "The columns pitch and roll of pix4dmatic.csv do not say whether they are the camera's",
       **HERE, altitude=512.5, heading=38.6, pitch=None),
    by(GEO, "geo.txt", "EPSG:4326\na.jpg 8.501 47.301 102.5 45.0 0.5 -0.3 1.5 3.0\n", "longitude was read before latitude",
       **HERE, altitude=102.5, heading=45.0, heading_source="camera", pitch=-89.5, roll=-0.3),
    by(GEO, "geo_angles_of_zero.txt", "EPSG:4326\na.jpg 8.501 47.301 102.5 0 0 0 1.5 3.0\n", "read before latitude",
       **HERE, heading=None, pitch=None, roll=None),
    by(GEO, "geo_longlat.txt", "+proj=longlat +datum=WGS84\na.jpg 8.501 47.301\n", "read before latitude", **HERE),
    by("https://github.com/IntelliSensing/UAV-VisLoc", "visloc.csv",
       "num,filename,date,lat,lon,height,Omega,Kappa,Phi1,Phi2\n"
       "1,a.JPG,2018-09-13 10:00:00,47.301,8.501,405.25,1.5,-2.5,-170.0,10\n",
       "does not state its reference", **HERE, height_above_takeoff=405.25, heading=190.0, heading_source="aircraft", pitch=-88.5,
       roll=-2.5),
    by("https://github.com/TIERS/wildnav", "wildnav.csv",
       "Filename,Latitude,Longitude,Altitude,Gimball_Roll,Gimball_Yaw,Gimball_Pitch,Flight_Roll,Flight_Yaw,Flight_Pitch\n"
       "1.jpg,47.301,8.501,+119.98,+0.00,-4.70,-89.30,-8.50,+1.60,-11.00\n", "counts as height above take-off",
       **HERE, height_above_takeoff=119.98, altitude=None, heading=355.3, heading_source="gimbal", pitch=-89.3, roll=0.0),
    by("a gimbal of which all angles are 0 is unknown", "wildnav_zeros.csv",
       "Filename,Latitude,Longitude,Altitude,Gimball_Roll,Gimball_Yaw,Gimball_Pitch,Flight_Yaw\n1.jpg,47.301,8.501,120,0,0,0,-86.8\n",
       "counts as height", **HERE, heading=273.2, heading_source="aircraft", pitch=None),
    by("https://www.rtklib.com/prog/manual_2.4.2.pdf", "ppk.pos",
       "% program   : RTKPOST\n%\n%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns\n"
       "2024/05/01 12:00:18.000   47.301000000    8.501000000   512.5000   1  12\n", "18 s were subtracted",
       **HERE, altitude=512.5, clock=1714564800.0),
    by("https://www.rtklib.com/prog/manual_2.4.2.pdf, Q of 5 is a single solution", "failed.pos",
       "%  UTC  latitude(deg) longitude(deg)  height(m)   Q  ns\n2024/05/01 12:00:00.000 47.301 8.501 512.5 5 12\n",
       "1 of 1 rows of failed.pos have no fixed RTK solution", **HERE, clock=1714564800.0),
    by("https://www.rtklib.com/prog/manual_2.4.2.pdf", "ellipsoid.pos",
       "%  UTC  latitude(deg) longitude(deg)  height(m)   Q  ns\n2024/05/01 12:00:00.000 47.301 8.501 512.5 1 12\n",
       "above the ellipsoid", **HERE),
    by("a header", "ellipsoid.csv", "name,lat,lon,Ellipsoidal height\na.jpg,47.301,8.501,512.5\n", "above the ellipsoid", **HERE,
       altitude=512.5),
    by(MAVLINK, "mavlogdump.csv",
       "timestamp,time_boot_ms,lat,lon,alt,relative_alt,vx,vy,vz,hdg\n1714564800.5,100,473010000,85010000,512500,45200,0,0,0,2820\n",
       **HERE, altitude=512.5, height_above_takeoff=45.2, heading=28.2, clock=1714564800.5),
    by(ARDUPILOT, "2024-05-10.log", FMT + "ATT, 100000000, 0, 0, 0, 0, 0, 10\n" + FIXES,
       **HERE, altitude=500.0, clock=1715335200.0, heading=10.0, heading_source="aircraft", pitch=-90.0),
    by(ARDUPILOT, "nose.log", FMT + "ATT, 100000000, 0, 0, 0, 0, 0, 10\nMNT, 100000000, 0, -60, 20, nan\n" + FIXES,
       heading=30.0, heading_source="gimbal", pitch=-60.0),
    by(ARDUPILOT, "north.log", FMT + "ATT, 100000000, 0, 0, 0, 0, 0, 10\nMNT, 100000000, 0, -60, 20, 50\n" + FIXES,
       heading=50.0, heading_source="gimbal", pitch=-60.0),
    # Units that headers say
    by("a header", "units.csv",
       "lat_degE7,lon [degE7],alt mm AMSL,relative_alt (mm),hdg [cdeg]\n473010000,85010000,1500000,60000,120\n",
       **HERE, altitude=1500.0, height_above_takeoff=60.0, heading=1.2),
    by("a header", "decimal.csv", "file,latitude_decimal_degrees,Longitude decimal\na.jpg,47.301,8.501\n", **HERE),
    by("a header", "words.csv",
       "file,Latitude (decimal degrees),Longitude (decimal degrees),Altitude (m),Rel Alt [ft],Yaw (rad),elapsed_ms\n"
       "a.jpg,47.301,8.501,500,100,3.14159265,1500\n",
       **HERE, altitude=500.0, height_above_takeoff=30.48, heading=180.0, time=1.5),
    by("a header", "radians.csv", "file,lat (rad),longitude rad,gimbal yaw rad,gimbal pitch rad\n"
       "a.jpg,0.825558190,0.148370440,0.5235987756,-1.5707963268\n", **HERE, heading=30.0, pitch=-90.0),
    by("no header", "no_unit.csv", "file,lat,lon,yaw,gimbal_pitch\na.jpg,47.301,8.501,1.57,-1.5\n",
       "All values of yaw, gimbal_pitch in no_unit.csv lie within 6.28", **HERE, heading=1.57, pitch=-1.5),
    by("no header", "no_unit_of_positions.csv",
       "file,lat,lon\na.jpg,0.8255,0.1483\n", "All values of lat, lon", **at(0.8255, 0.1483)),
    by("a unit in the cell", "cells.csv", "file,lat,lon,heading (rad)\na.jpg,47.301°,8.501 E,90°\n", **HERE, heading=90.0),
    by("two zones", "zones.csv", "latitude,longitude,altitude(feet),datetime(local),datetime(utc)\n"
       "47.301,8.501,100,2024-05-01 14:00:00,2024-05-01 12:00:00\n", **HERE, altitude=30.48, clock=1714564800.0),
    by("spreadsheets", "semicolons.csv", "filename;latitude;longitude;altitude\na.jpg;47,301 N;8,501° W;512,5\n",
       **at(47.301, -8.501), altitude=512.5),
    by("https://github.com/GPSBabel/gpsbabel/issues/1286", "quotes.csv", '"a;b;c;d",lat,lon\nx,47.301,8.501\n', **HERE),
    by("spreadsheets, which fear formulas", "apostrophes.csv", "name,lat,long\na.jpg,'-47.301,−8.501\n", **at(-47.301, -8.501)),
    by("an unknown unit", "fathoms.csv", "lat,lon,rel_alt(fathoms)\n47.301,8.501,3\n", "in an unknown unit and was left out",
       **HERE, height_above_takeoff=None),
    by("https://docs.opendronemap.org/tutorials, angles of photogrammetry", "omega.csv",
       "imageName,latitude,longitude,altitude,omega,phi,kappa\na.jpg,47.301,8.501,450,1,2,40\n", "angles of photogrammetry",
       **HERE, heading=None, pitch=None),
    # Subtitles
    by(PARSER, "mini4pro.srt", "[latitude: 59.302335] [longitude: 18.203059] [rel_alt: 1.300 abs_alt: 132.860] [iso : 2700]",
       **at(59.302335, 18.203059), height_above_takeoff=1.3, altitude=132.86),
    by(PARSER, "air3s.srt", '<font size="28">FrameCnt: 1, DiffTime: 16ms\n2026-05-17 08:28:30.219\n[focal_len: 24.00] '
       "[latitude: 34.270373] [longitude: -84.176160] [rel_alt: 1.500 abs_alt: 302.208] [ct: 5]",
       **at(34.270373, -84.17616), height_above_takeoff=1.5, altitude=302.208, clock=1779006510.219, fov=71.591520),
    by(PARSER, "air2s.srt", "2022-08-07 13:40:40,774,808\n[focal_len : 240] [latitude: 41.424724] [longitude: 2.234156] "
       "[altitude: 117.000000] </font>", **at(41.424724, 2.234156), altitude=117.0, fov=71.591520),
    by(PARSER, "mavic2.srt", "2019-09-27 10:28:08,438,904\n[latitude : -35.080155] [longtitude : -60.286702] </font>",
       **at(-35.080155, -60.286702), clock=1569580088.438904),
    by(PARSER, "zoom.srt", "[focal_len: 24.00] [dzoom_ratio: 20000, delta:0] [latitude: 47.301] [longitude: 8.501]", **HERE,
       fov=39.654057),
    by("DJI Avata 360", "avata360.srt", "[dzoom_ratio: 1.00], [latitude: 53.365080] [longitude: 6.460739] [rel_alt: 5.400 "
       "abs_alt: -124.744] [gb_yaw: -162.8 gb_pitch: -10.0 gb_roll: 0.0] [shift x: 0.00, y: 0.00] [pp_target:0.000, 0.000]",
       **at(53.36508, 6.460739), height_above_takeoff=5.4, altitude=-124.744, heading=197.2, pitch=-10.0),
    by(PARSER, "avata2.srt", "GPS(39.906217,116.391305,69.800) BAROMETER(91.2) HOME(39.906206,116.391400)",
       **at(39.906217, 116.391305), height_above_takeoff=91.2, altitude=69.8),
    by(PARSER, "mavicpro.srt",
       "HOME(149.0251,-20.2532) 2017.8.5 14:11:51\nGPS(149.0251,-20.2533,16) BAROMETER:1.9\nISO:100 Fnum:2.2",
       **at(-20.2533, 149.0251), height_above_takeoff=1.9, clock=1501942311.0),
    by(PARSER, "phantom3.srt", "GPS(8.501,47.301,16) Hb:1.9 Hs:1.8\nISO:100", **HERE, height_above_takeoff=1.9, altitude=None),
    by(PARSER, "mavicmini.srt", "F/2.8, SS 30.15, GPS (8.501, 47.301, 17), D 221.21m, H 200.70m, H.S n/a, V.S n/a ", **HERE,
       height_above_takeoff=200.7),
    by(ODM_SRT, "p4rtk.srt",
       f"F/6.3, RTK (8.501, 47.301, 28), HOME (8.503, 47.301, 603.55m), D 252.06m, H 76.19m, H.S 7.50m/s, {PRY}",
       **HERE, height_above_takeoff=76.19, heading=110.4, heading_source="gimbal", pitch=-24.4),
    by(PARSER, "no_gimbal.srt",
       "GPS (8.501, 47.301, 15), H 100.00ft, F.PRY (2.7°, -7.0°, -110.1°), G.PRY (0.0°, 0.0°, 0.0°)", **HERE,
       height_above_takeoff=30.48, heading=249.9, heading_source="aircraft", pitch=None),
    by(PARSER, "m300.srt", "2022.06.21 16:06:17\nGPS(36.6146,-6.1120,0.0M) BAROMETER:0.3M", "give --gps-order lon-lat",
       **at(36.6146, -6.112), height_above_takeoff=0.3, altitude=None, clock=1655827577.0),
    by("Autel", "autel.srt", "HOME(W: 70.6, S: 33.5) 2020-11-01 15:29:24\nGPS(W: 70.5, S: 33.4, 161) \nISO:105",
       **at(-33.4, -70.5), altitude=161.0),
    by("Autel EVO Max", "autel_max.srt",
       f"HOME(E: 8.5, N: 47.3) 2025-08-27 13:21:35\nGPS(E: 8.501, N: 47.301, 574.21m)\nISO:100\n{PRY}",
       **HERE, altitude=574.21, heading=110.4, pitch=-24.4),
    by("Autel's first EVO", "autel_signs.srt", "GPS(W: -70.-5005, S: -33.-4323, -37) ReH:12 \nISO:100", **at(-33.4323, -70.5005),
       height_above_takeoff=12.0, altitude=-37.0),
    by("Autel EVO II RTK", "autel_rtk.srt", "RTK(FIXED) GPS(W: 70.5, S: 33.4, 812.5m) ReH:40.0m ",
       **at(-33.4, -70.5), altitude=812.5,
       height_above_takeoff=40.0),
    by("before the fix", "no_fix.srt", "[latitude: 0.000000] [longitude: 0.000000] [rel_alt: 0.400 abs_alt: 269.099]",
       "1 of 1 entries of no_fix.srt have no position", latitude=None, longitude=None, height_above_takeoff=0.4),
    by("before the fix", "lost.srt", "HOME(-1.2218,42.4668) 2018.08.19 08:00:50\nGPS(N/A,N/A,3) BAROMETER:0.0\nISO:100",
       "have no position", latitude=None, height_above_takeoff=0.0),
    by("no place on Earth", "beyond.srt", "[latitude: 95.0] [longitude: 10.0] [rel_alt: 3.0 abs_alt: 4.0]", "have no position",
       latitude=None, longitude=None, height_above_takeoff=3.0),
    by("before the fix", "letters.srt", "GPS(W: 0.0, N: 0.0, 0m)", "have no position", latitude=None),
    by("before the fix", "zeros.srt", "GPS (0, 0, 0)", "have no position", latitude=None),
    by(PARSER, "home.srt", "HOME(8.5, 47.3)\nGPS (8.501, 47.301, 15)", **HERE),
    by(PARSER, "home_names.srt", "[home latitude: 47.3] [home longitude: 8.5] [latitude: 47.301] [longitude: 8.501]", **HERE),
    by("Autel", "home_letters.srt", "HOME(W: 70.5, S: 33.4) ISO:100\nGPS (E: 8.501, N: 47.301, 812.5m)", **HERE),
    by("a Mavic Air 2 that wrote radians", "radians.srt", "[latitude: 0.825562] [longtitude: 0.148374] [altitude: 27.3]",
       "if the camera wrote radians, they are wrong", **at(0.825562, 0.148374)),
)  # fmt: skip


@pytest.mark.parametrize(
    ("file", "text", "expected", "note"), [case[1:] for case in CASES], ids=[case[1] for case in CASES]
)
def test_text_of_the_field_is_read(tmp_path: Path, file: str, text: str, expected: dict[str, Any], note: str) -> None:
    (tmp_path / file).write_text(SRT.format(text) if file.endswith(".srt") else text, "utf-8")
    if text.startswith("FMT"):
        pytest.importorskip("pymavlink")
    log = read_any_log(tmp_path / file)
    read = {name: getattr(log.entries[0], name) for name in expected}
    assert read == {
        name: pytest.approx(value, abs=1e-6) if isinstance(value, float) else value for name, value in expected.items()
    }
    assert any(note in line for line in log.notes) if note else not log.notes


def test_every_dialect_has_a_case_and_a_source() -> None:
    tables = [table_of(text, file).dialect for _, file, text, _, _ in CASES if not file.endswith((".srt", ".log"))]
    assert {dialect.program for dialect in DIALECTS} <= {dialect.program for dialect in tables}
    assert all(dialect.source.startswith("https://") for dialect in DIALECTS)


GRID = "Eastings and northings of a map are not read; export degrees of WGS 84."
GROUND = "is a list of ground control points: it has positions of points in the photos, and none of the photos"
BEGINS = "log.csv begins with {!r}; expected a line of column names with latitude and longitude."


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "log.csv is empty"),
        ("a,b\n1,2\n", BEGINS.format("a,b")),
        ("Dateiname;Breitengrad;Längengrad\na.jpg;47,3;8,5\n", BEGINS.format("Dateiname;Breitengrad;Längengrad")),
        ("#photo,first,second\na.jpg,47.312345,8.512345\n", BEGINS.format("#photo,first,second")),
        ("made by hand\nname,lat,lon\na.jpg,47.3,8.5\n", BEGINS.format("made by hand")),
        ("lat,lon\n", "log.csv has column names and no row"),
        ("lat,lon\n1,2\nx,3\n", "Line 3 of log.csv has the latitude 'x'; expected a number"),
        ('sep=,\nlat,lon,name\n1,2,"a\nb"\n\nx,3,c\n', "Line 6 of log.csv has the latitude 'x'"),
        ("timestamp,lat,lon\n1e999,47,8e+999\n", "Line 2 of log.csv has the longitude '8e+999'"),
        ("lat,lon\n1,inf\n", "Line 2 of log.csv has the longitude 'inf'"),
        ("lat,lon\n47.3 E,8.5 N\n", "has the latitude '47.3 E'; expected a number of degrees"),
        ('lat,lon,alt\n47.3,8.5,"1,234"\n', "has the altitude '1,234'; expected a number"),
        ("lat,lon\n100,3\n", "Line 2 of log.csv has the position 100, 3; expected degrees, latitude from -90 to 90."),
        ("lat,lon\n120.35,23.12\n", "Check that latitude and longitude are not exchanged."),
        ("lat,lon\n473000000,85000000\n", "Name another unit behind a column, as in lat (degE7)."),
        ("lat,lon\n465123.1,5242123.1\n", GRID),
        ("name,easting,northing\na.jpg,465123.1,5242123.1\n", GRID),
        ("imageName X Y Z Omega Phi Kappa\na.jpg 464512.10 5238471.2 560.2 0.51 -0.42 -116.5\n", GRID),
        ("a.jpg,464512.10,5238471.2,560.2\n", GRID),
        ("EPSG:32632\na.jpg 464512.10 5238471.2 560.2\n", f"log.csv has positions in EPSG:32632. {GRID}"),
        ("WGS84 UTM 32N\na.jpg 464512.10 5238471.2 560.2\n", f"log.csv has positions in WGS84 UTM 32N. {GRID}"),
        ("EPSG:4326\n-7.395223 39.650364 2.59 1920 1080 a.jpg\n", GROUND),
        ("EPSG:32632\n500100.5 5205000.2 412.3 800.0 600.0 a.jpg\n", GROUND),
        ("EPSG:4326\n8.1,47.1,400,10,20,a.jpg,gcp1\n", GROUND),
        ("name,lat,lon" + ",x" * 200_000, "log.csv begins with 'name,lat,lon,x"),
        ("lat,lon,a,b,c\n47,301,8,501,1,2,3,4\n", "has 8 values below 5 names, perhaps by decimal commas between commas"),
        ("name,lat,Longitude (W)\na.jpg,33.4,70.5\n", "The column Longitude (W) of log.csv is in an unknown unit"),
        ("\x00\x01\x02binary", "log.csv is no text"),
    ],
)  # fmt: skip
def test_tables_that_cannot_be_read_for_certain_are_refused_in_a_sentence(
    tmp_path: Path, text: str, message: str
) -> None:
    (tmp_path / "log.csv").write_text(text, "utf-8")
    with pytest.raises(DataError) as error:
        read_log(tmp_path / "log.csv")
    assert message in str(error.value)
