"""Logs of the programs that people use, their units, and logs that fit nothing."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
from PIL import ExifTags

from lpn.core.errors import DataError
from lpn.flight.files import make_flight
from lpn.flight.files.folder import read_flight
from lpn.flight.files.logs import for_video, moments, nearest_in_folders, path_parts, read_log, rows_by_name
from tools.fixtures.photos import dji_xmp, exif, write_photo
from tools.fixtures.videos import write_video

WILDNAV = (
    "Filename,Latitude,Longitude,Altitude,Gimball_Roll,Gimball_Yaw,Gimball_Pitch,Flight_Roll,Flight_Yaw,Flight_Pitch\n"
    "1.jpg,60.403241,22.462133,+119.98,+0.00,-4.70,-89.30,-8.50,+1.60,-11.00\n"
    "2.jpg,60.402258,22.465155,+120.01,+0.00,+0.00,+0.00,-1.00,-86.80,-10.90\n"
)
VISLOC = (
    "num,filename,date,lat,lon,height,Omega,Kappa,Phi1,Phi2\n"
    "1,01_0001.JPG,2018-09-13 10:00:00,29.774065,115.970635,405.251007,1.5,-2.5,-170.0,10\n"
    "2,01_0002.JPG,2018-09-13 10:00:04,29.775065,115.970635,405.251007,0.5,0.5,-170.0,10\n"
)
AIRDATA = (
    "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),height_above_ground_at_drone_location(feet),"
    "altitude_above_seaLevel(feet), compass_heading(degrees), pitch(degrees),isVideo,gimbal_heading(degrees),"
    "gimbal_pitch(degrees),gimbal_roll(degrees)\n"
    + "".join(
        f"{1000 * i},2024-05-01 12:00:{i:02d},{47 + i / 10_000},8.0,{100 + i},{90 + i},1000,350,5,{int(i in (3, 4, 5) or i > 7)},"
        "10,-90,0\n"
        for i in range(12)
    )
)


def written(folder: Path, text: str, name: str = "log.csv") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text, "utf-8")
    return folder / name


def test_wildnav_s_rows_are_read(tmp_path: Path) -> None:
    log = read_log(written(tmp_path, WILDNAV))
    first, second = (rows_by_name(log)[name][0].entry for name in ("1.jpg", "2.jpg"))
    assert (first.latitude, first.longitude, first.height_above_takeoff, first.altitude) == (
        60.403241,
        22.462133,
        119.98,
        None,
    )
    assert (first.heading, first.heading_source, first.pitch, first.roll) == (
        pytest.approx(355.3),
        "gimbal",
        -89.3,
        0.0,
    )
    # A gimbal of which all angles are 0 is unknown, so the aircraft's heading counts.
    assert (second.heading, second.heading_source, second.pitch) == (pytest.approx(273.2), "aircraft", None)
    assert any("counts as height above take-off" in note for note in log.notes)


def test_uav_visloc_brings_its_photos(tmp_path: Path) -> None:
    for name in ("01_0001.JPG", "01_0002.JPG", "other.JPG"):
        write_photo(tmp_path / "drone" / name)
    flight = make_flight([written(tmp_path, VISLOC, "01.csv")], tmp_path / "flight")
    assert [frame.name for frame in flight.frames] == ["01_0001.JPG", "01_0002.JPG"]
    frame = flight.frames[0]
    assert (frame.latitude, frame.longitude, frame.height_above_takeoff) == (29.774065, 115.970635, 405.251007)
    assert (frame.heading, frame.heading_source, frame.pitch, frame.roll) == (190.0, "aircraft", -88.5, -2.5)
    assert flight.times.tolist() == [0.0, 4.0]
    assert any("does not say above what" in note for note in flight.notes)


def test_a_log_s_aircraft_does_not_replace_the_gimbal_s_heading(tmp_path: Path) -> None:
    packet = dji_xmp(GimbalYawDegree=190, GimbalPitchDegree=-80, GimbalRollDegree=0)
    write_photo(tmp_path / "gimbal.jpg", exif(1.0, 2.0), packet)
    write_photo(tmp_path / "bare.jpg")
    log = "filename,latitude,longitude,compass_heading\ngimbal.jpg,47,8,10\nbare.jpg,47,8,10\n"
    flight = make_flight([tmp_path, written(tmp_path, log)], tmp_path / "flight")
    found = {frame.name: (frame.latitude, frame.heading, frame.heading_source, frame.pitch) for frame in flight.frames}
    assert found == {"gimbal.jpg": (47.0, 190.0, "gimbal", -80.0), "bare.jpg": (47.0, 10.0, "aircraft", None)}
    assert any(
        "keeps the heading of its gimbal, which is better than that of the aircraft" in note for note in flight.notes
    )


@pytest.mark.parametrize(("orientation", "heading"), [(1, 40.0), (3, 220.0), (6, 310.0), (8, 130.0)])
def test_a_log_s_heading_turns_with_the_picture(tmp_path: Path, orientation: int, heading: float) -> None:
    write_photo(tmp_path / "a.jpg", exif(1.0, 2.0, main={ExifTags.Base.Orientation: orientation}))
    for columns, values, pitch in (("heading", "40", None), ("gimbal_yaw,gimbal_pitch", "40,-90", -90.0)):
        log = written(tmp_path, f"filename,latitude,longitude,{columns}\na.jpg,47,8,{values}\n")
        flight = make_flight([tmp_path / "a.jpg", log], tmp_path / "flight")
        assert flight.frames[0].heading == pytest.approx(heading)
        assert flight.frames[0].pitch == (None if pitch is None else pytest.approx(pitch))
        assert any("by its EXIF orientation" in note for note in flight.notes) == (orientation != 1)


@pytest.mark.parametrize(("orientation", "fov"), [(1, 45.0), (3, 45.0), (6, 34.51), (8, 34.51)])
def test_a_log_s_field_of_view_turns_with_the_picture(tmp_path: Path, orientation: int, fov: float) -> None:
    photo = write_photo(tmp_path / "a.jpg", exif(main={ExifTags.Base.Orientation: orientation}), size=(64, 48))
    log = written(tmp_path, "filename,latitude,longitude,hfov\na.jpg,47,8,45\n")
    frame = make_flight([photo, log], tmp_path / "flight").frames[0]
    assert frame.width / frame.height == pytest.approx(4 / 3 if orientation < 5 else 3 / 4)
    assert frame.fov == pytest.approx(fov, abs=0.01)


def test_airdata_s_feet_become_metres_and_its_recordings_begin_with_the_video(tmp_path: Path) -> None:
    log = read_log(written(tmp_path, AIRDATA))
    assert log.utc
    entries, notes = for_video(log, 0)
    assert notes == []
    assert [entry.time for entry in entries] == [0.0, 1.0, 2.0]
    assert entries[0].latitude == pytest.approx(47.0003)
    assert entries[0].height_above_takeoff == pytest.approx(103 * 0.3048)
    assert entries[0].height_above_ground == pytest.approx(93 * 0.3048)
    assert entries[0].altitude == pytest.approx(304.8)
    assert (entries[0].heading, entries[0].heading_source, entries[0].pitch) == (10.0, "gimbal", -90.0)
    assert [entry.time for entry in for_video(log, 1)[0]] == [0.0, 1.0, 2.0, 3.0]
    with pytest.raises(DataError, match=r"log\.csv has 2 recordings, and this is video 3"):
        for_video(log, 2)
    video = write_video(tmp_path / "a.mp4", 3)
    flight = make_flight([video, tmp_path / "log.csv"], tmp_path / "flight")
    assert [frame.latitude for frame in flight.frames] == pytest.approx(
        [47.0003 + (f.time or 0) / 10_000 for f in flight.frames]
    )


def test_a_log_that_tells_only_when_the_recording_began_is_used_from_there_on(tmp_path: Path) -> None:
    rows = [f"{1000 * i},{47 + i / 1000},8.5,{int(i in (3, 12))}\n" for i in range(20)]
    log = read_log(written(tmp_path, "time(millisecond),latitude,longitude,isVideo\n" + "".join(rows)))
    entries, notes = for_video(log, 0)
    assert [(entry.time, entry.latitude) for entry in entries] == [
        (float(i), pytest.approx(47.003 + i / 1000)) for i in range(9)
    ]
    assert notes == ["log.csv has the start of the video but not its length; all rows from there on were used."]
    assert [entry.time for entry in for_video(log, 1)[0]] == [float(i) for i in range(8)]
    with pytest.raises(DataError, match=r"log\.csv has 2 recordings, and this is video 3"):
        for_video(log, 2)


def test_a_log_of_moments_fits_photos_by_utc(tmp_path: Path) -> None:
    gps = {ExifTags.GPS.GPSDateStamp: "2024:05:01", ExifTags.GPS.GPSTimeStamp: (12.0, 0.0, 4.0)}
    write_photo(tmp_path / "a.jpg", exif(1.0, 2.0, gps=gps))
    write_photo(tmp_path / "b.jpg", exif(1.0, 2.0))
    flight = make_flight([tmp_path / "a.jpg", tmp_path / "b.jpg", written(tmp_path, AIRDATA)], tmp_path / "flight")
    assert [frame.latitude for frame in flight.frames] == pytest.approx([47.0004, 1.0])
    assert any("gives the values of 1 of 2 photos, by UTC" in note for note in flight.notes)


def test_a_log_that_fits_nothing_is_told_and_the_run_goes_on(tmp_path: Path) -> None:
    photo = write_photo(tmp_path / "other.jpg", exif(1.0, 2.0))
    flight = make_flight([photo, written(tmp_path, WILDNAV)], tmp_path / "flight")
    assert flight.frames[0].latitude == 1.0
    assert "log.csv fits none of the 1 photos by name, and was not used." in flight.notes
    with pytest.raises(DataError, match=r"No photo that log\.csv names is below its folder"):
        make_flight([written(tmp_path / "alone", WILDNAV)], tmp_path / "none")
    video = write_video(tmp_path / "a.mp4", 1)
    flight = make_flight([video, tmp_path / "log.csv"], tmp_path / "flight")
    assert any("log.csv has no times" in note for note in flight.notes)


def test_generic_names_units_and_separators_are_known(tmp_path: Path) -> None:
    header = "File;Lat;Lng;Rel Alt [ft];Yaw (rad);FOV;elapsed_ms"
    rows = "photos\\A.JPG;10;-20;100;3.14159265;70;1500\nb.jpg;0;0;N/A;;;\n"
    log = read_log(written(tmp_path, f"\ufeffsep=;\n{header}\n{rows}"))
    entry = rows_by_name(log)["a.jpg"][0].entry
    assert (entry.latitude, entry.longitude, entry.fov, entry.time) == (10.0, -20.0, 70.0, 1.5)
    assert entry.height_above_takeoff == pytest.approx(30.48)
    assert (entry.heading, entry.heading_source) == (pytest.approx(180.0), "aircraft")
    empty = rows_by_name(log)["b.jpg"][0].entry
    assert (empty.latitude, empty.height_above_takeoff, empty.heading, math.isnan(empty.time)) == (
        None,
        None,
        None,
        True,
    )
    assert "1 of 2 rows of log.csv have no position." in log.notes
    fathoms = read_log(written(tmp_path, "lat,lon,rel_alt(fathoms)\n1,2,3\n"))
    assert fathoms.rows[0].entry.height_above_takeoff is None
    assert "in an unknown unit" in fathoms.notes[0]


def test_a_log_without_a_recording_begins_with_the_video_and_says_so(tmp_path: Path) -> None:
    log = read_log(written(tmp_path, "timestamp,lat,lon\n1714564800.5,1,2\n1714564802.5,1.1,2\n"))
    entries, notes = for_video(log, 0)
    assert [entry.time for entry in entries] == [0.0, 2.0]
    assert "its first row counts as the beginning" in notes[0]
    dated = read_log(written(tmp_path, "date,lat,lon\n2024-05-01T12:00:00+02:00,1,2\n"))
    assert dated.utc
    assert dated.rows[0].entry.clock == 1714557600.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"log\.csv is empty"),
        ("a,b\n1,2\n", r"log\.csv has the columns a, b; expected latitude and longitude"),
        ("lat,lon\n", r"log\.csv has column names and no row"),
        ("lat,lon\n1,2\nx,3\n", r"Line 3 of log\.csv has the latitude 'x'; expected a number"),
        ("sep=,\nlat,lon\n\n1,2\n\nx,3\n", r"Line 6 of log\.csv has the latitude 'x'"),
        ('lat,lon,name\n1,2,"a\nb"\nx,3,c\n', r"Line 4 of log\.csv has the latitude 'x'"),
        ("lat,lon\n100,3\n", r"Line 2 of log\.csv has the position 100, 3; expected degrees"),
        ("lat,lon\n1,inf\n", r"Line 2 of log\.csv has the longitude 'inf'"),
    ],
)
def test_damaged_logs_are_refused_by_their_row(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        read_log(written(tmp_path, text))


# Name: the file; latitude, longitude, height above take-off, altitude, heading, pitch, clock of its first row; a part of a note.
# Numbers are invented.
FIELD: dict[str, tuple[str, tuple[float | None, ...], str]] = {
    "agisoft.csv": (
        "# CoordinateSystem: WGS 84\n#Label,X/Longitude,Y/Latitude,Z/Altitude,Error_(m),Yaw,Pitch,Roll\n"
        "DJI_0001.JPG,8.501234,47.301234,512.5,0.1,30,2,-1\n# Total error,0.1\n",
        (47.301234, 8.501234, None, 512.5, 30.0, -88.0, None), "",
    ),
    "exiftool.csv": (
        "SourceFile,GPSLatitude,GPSLongitude,GPSAltitude,DateTimeOriginal\n"
        "./a/DJI_0001.JPG,\"47 deg 18' 4.44\"\" N\",\"8 deg 30' 4.44\"\" W\",512.3 m Above Sea Level,2024:05:01 14:00:00\n",
        (47.301233333, -8.501233333, None, 512.3, None, None, 1714572000.0), "",
    ),
    "exiftool_letters.csv": (
        "SourceFile,GPSLatitude,GPSLatitudeRef,GPSLongitude,GPSLongitudeRef\nDJI_0001.JPG,33.4,South,70.5,West\n",
        (-33.4, -70.5, None, None, None, None, None), "",
    ),
    "exiftool_position.csv": (
        "SourceFile,EXIF:GPSPosition\nDJI_0001.JPG,\"47 deg 18' 4.44\"\" N, 8 deg 30' 4.44\"\" E\"\n",
        (47.301233333, 8.501233333, None, None, None, None, None), "",
    ),
    "west.csv": (
        "name,Latitude S,Longitude (W),Altitude Ft\nDJI_0001.JPG,33.4,70.5,1000\n",
        (-33.4, -70.5, None, 304.8, None, None, None), "column Longitude (W) of west.csv have no signs, and count as negative",
    ),
    "west_signed.csv": (
        "name,lat,longitude west\nDJI_0001.JPG,33.4,-70.5\n",
        (33.4, -70.5, None, None, None, None, None), "count as the position",
    ),
    "west_letters.csv": (
        "name,lat,longitude west\nDJI_0001.JPG,33.4,70.5 W\n",
        (33.4, -70.5, None, None, None, None, None), "count as the position",
    ),
    "hundredths.csv": (
        "name,lat,lon,hdg\nDJI_0001.JPG,33.4,-70.5,90\nDJI_0002.JPG,33.4,-70.5,9000\n",
        (33.4, -70.5, None, None, 0.9, None, None), "The column hdg of hundredths.csv counts as hundredths of degrees",
    ),
    "units.csv": (
        "lat_degE7,lon [degE7],alt [mm],relative_alt (mm),hdg [cdeg]\n334000000,-705000000,1500000,60000,120\n",
        (33.4, -70.5, 60.0, 1500.0, 1.2, None, None), "",
    ),
    "scaled_positions.csv": (
        "lat,lon,alt [m],relative_alt [mm],heading [deg]\n334000000,-705000000,1500,60000,365\n",
        (33.4, -70.5, 60.0, 1500.0, 5.0, None, None), "count as degrees times 1e7",
    ),
    "unknown_heading.csv": (
        "name,lat,lon,relative_alt,hdg\n1.JPG,334000000,-705000000,60000,65535\n2.JPG,334000000,-705000000,60000,9000\n",
        (33.4, -70.5, 60.0, None, None, None, None), "count as degrees times 1e7",
    ),
    "pitch_up.csv": (
        "name,lat,lon,gimbal_yaw,gimbal_pitch\nDJI_0001.JPG,33.4,-70.5,10,90\nDJI_0002.JPG,33.4,-70.5,10,85\n",
        (33.4, -70.5, None, None, 10.0, None, None), "looks up by 85 degrees",
    ),
    "semicolons.csv": (
        "Dateiname;Breitengrad;Längengrad;Höhe\nDJI_0001.JPG;47,301234;8,501234;512,5\n",
        (47.301234, 8.501234, None, 512.5, None, None, None), "count as decimal commas",
    ),
    "commas.csv": (
        "filename,lat,lon,alt\nDJI_0001.JPG,47,301234,8,501234,120,5\nDJI_0002.JPG,47,301244,8,501234,120,5\n",
        (47.301234, 8.501234, None, 120.5, None, None, None), "joined to one number a column",
    ),
    "pix4d.csv": (
        "DJI_0001.JPG,47.301234,8.501234,512.5\nDJI_0002.JPG,47.301334,8.501234,512.5\n",
        (47.301234, 8.501234, None, 512.5, None, None, None), "latitude before longitude was taken",
    ),
    "pix4dmatic.csv": (
        "#imagename,coordinate1,coordinate2,z,yaw,pitch,roll\nIMG_1.JPG,47.301234,8.501234,512.5,38.6,3.5,8.3\n",
        (47.301234, 8.501234, None, 512.5, 38.6, None, None), "",
    ),
    "geo.txt": (
        "EPSG:4326\nDJI_0001.JPG 8.501234 47.301234 512.5 30 0 0\n",
        (47.301234, 8.501234, None, 512.5, None, None, None), "longitude before latitude was taken",
    ),
    "mavlink.csv": (
        "timestamp,lat,lon,alt,relative_alt,hdg\n1714564800.5,473012340,85012340,512500,45200,2820\n",
        (47.301234, 8.501234, 45.2, 512.5, 28.2, None, 1714564800.5), "degrees times 1e7",
    ),
    "location.txt": (
        "#name latitude/Y longitude/X height/Z yaw pitch roll SAlt\nDSC1.JPG -31077865 322473932 1401.75 359.22 4.96 1.17 99\n",
        (-3.1077865, 32.2473932, None, 1401.75, 359.22, None, None), "degrees times 1e7",
    ),
    "phantomhelp.csv": (
        "sep=,\nCUSTOM.date [local],CUSTOM.updateTime [local],OSD.flyTime,OSD.flyTime [s],OSD.latitude,OSD.longitude,"
        "OSD.height [ft],OSD.yaw [360],OSD.yaw,GIMBAL.pitch,GIMBAL.roll,GIMBAL.yaw,HOME.latitude,HOME.longitude\n"
        "6/15/2026,1:00:00.05 PM,0m 0.1s,0.1,47.301,8.501,100,10,10,-90,0,12,1.0,2.0\n",
        (47.301, 8.501, 30.48, None, 12.0, -90.0, 1781528400.05), "",
    ),
    "datcon.csv": (
        "Tick#,Clock:offsetTime,IMU_ATTI(0):Longitude[degrees [-180;180]],IMU_ATTI(0):Latitude[degrees [-180;180]],"
        "IMU_ATTI(0):relativeHeight:C,GPS:dateTimeStamp\n1,0.0,8.501,47.301,10.0,2021-04-19T09:31:07Z\n",
        (47.301, 8.501, 10.0, None, None, None, 1618824667.0), "count as the position",
    ),
    "radians.csv": (
        "offsetTime,IMU_ATTI(0):Longitude,IMU_ATTI(0):Latitude\n0.0,0.14837436,0.82556238\n",
        (47.3012401, 8.5012246, None, None, None, None, None), "count as radians",
    ),
    "flysight.csv": (
        "time,lat,lon,hMSL,velN,heading\n,(deg),(deg),(m),(m/s),(deg)\n2021-04-20T04:20:00.50Z,47.301,8.501,515.06,-0.6,30\n",
        (47.301, 8.501, None, 515.06, 30.0, None, 1618892400.5), "",
    ),
    "yuneec.csv": (
        ",fsk_rssi,voltage,altitude,latitude,longitude,roll,yaw,pitch\n20160815 12:34:56:789,-50,15,45.2,47.301,8.501,0,30,0\n",
        (47.301, 8.501, None, 45.2, 30.0, None, 1471264496.789), "",
    ),
    "edgetx.csv": (
        "Date,Time,1RSS(dB),GPS,Hdg(°),Alt(m)\n2024-05-01,12:00:01.100,-50,47.301 8.501,30,45\n",
        (47.301, 8.501, None, 45.0, 30.0, None, 1714564801.1), "",
    ),
    "potensic.csv": (
        "recnum,timestamp,tod,time,altitude2metric,ctrllat,ctrllon,homelat,homelon,dronelat,dronelon\n"
        "1,2024-05-01 12:00:00.5,12:00:00,0:00:00,45.2,1,2,3,4,47.301,8.501\n",
        (47.301, 8.501, 45.2, None, None, None, 1714564800.5), "",
    ),
    "apostrophes.csv": ("name,lat,long\na.jpg,'-33.4,'-70.5\n", (-33.4, -70.5, None, None, None, None, None), ""),
    "suffixes.csv": ("name;lat;long\na.jpg;1.23456N;8.5W\n", (1.23456, -8.5, None, None, None, None, None), ""),
    "semicolons_within.csv": (
        '"lat","lon","name","foo; bar; baz; blah; boom"\n"47.301","8.501","a.jpg","a; b; c; d; e"\n',
        (47.301, 8.501, None, None, None, None, None), "",
    ),
    "commas_with_letters.csv": (
        "name;Lat (DD);Lon (DD)\na.jpg;47,301 N;8,501° W\n",
        (47.301, -8.501, None, None, None, None, None), "count as decimal commas",
    ),
    "commas_in_seconds.csv": (
        "name;lat;lon\na.jpg;47°18'4,44\"N;8°30'4,44\"E\n".replace('"', "''"),
        (47.301233333, 8.501233333, None, None, None, None, None), "",
    ),
    "ethos.csv": (
        "Date,Time,GPS,RSSI(dB)\n2024-05-01,12:00:00.500,47.301,-8.501,75\n2024-05-01,12:00:01.500,47.302,-8.501,75\n",
        (47.301, -8.501, None, None, None, None, 1714564800.5), "",
    ),
    "opentx.csv": (
        "Date,Time,GPS\n2024-05-01,12:00:01.100,4718.0600 N 830.0600 E\n",
        (47.301, 8.501, None, None, None, None, 1714564801.1), "",
    ),
    "nmea.csv": (
        "filename,latitude,longitude\na.jpg,4718.0600,830.0600\nb.jpg,4718.0700,830.0600\n",
        (47.301, 8.501, None, None, None, None, None), "degrees and minutes",
    ),
    "swapped.csv": (
        "name,latitude,longitude\na.jpg,120.35,23.12\nb.jpg,120.36,23.12\n",
        (23.12, 120.35, None, None, None, None, None), "are swapped",
    ),
    "dronedeploy.log": (
        "#DroneDeploy\t2.1.0\nSession ID\t5879\nDate/Time (UTC)\tElapsed Time (sec)\tDevice Latitude (Degrees)\t"
        "Device Longitude (Degrees)\tAircraft Latitude (Degrees)\tAircraft Longitude (Degrees)\t"
        "Aircraft Barometric Altitude (ft)\t"
        "Aircraft Heading (Degrees)\n01/13/2017 20:22:54\t0.5\t1.0\t2.0\t47.301\t8.501\t100\t30\n",
        (47.301, 8.501, 30.48, None, 30.0, None, 1484338974.0), "",
    ),
    "ppk.pos": (
        "% program   : RTKPOST\n%\n%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns\n"
        "2024/05/01 12:00:18.000   47.301234000    8.501234000   512.5000   1  12\n",
        (47.301234, 8.501234, None, 512.5, None, None, 1714564800.0), "18 s were taken off",
    ),
    "thousands.csv": (
        "name,latitude,longitude,altitude\na.jpg,47.301,8.501,\"1,234.5\"\n",
        (47.301, 8.501, None, 1234.5, None, None, None), "",
    ),
    "letters.csv": ("name,lat,lon\na.jpg,33.4° S,W 70.5\n", (-33.4, -70.5, None, None, None, None, None), ""),
    "minus.csv": ("name,lat,lon\na.jpg,−33.4,−70.5\n", (-33.4, -70.5, None, None, None, None, None), ""),
    "zones.csv": (
        "latitude,longitude,altitude(feet),datetime(local),datetime(utc)\n"
        "47.301,8.501,100,2024-05-01 14:00:00,2024-05-01 12:00:00\n",
        (47.301, 8.501, None, 30.48, None, None, 1714564800.0), "",
    ),
    "qgroundcontrol.csv": (
        "Timestamp,roll,pitch,heading,gps.lat,gps.lon,altitudeRelative,altitudeAMSL\n"
        "2024-05-01 12:00:00.5,0,0,30,47.301,8.501,45,512\n",
        (47.301, 8.501, 45.0, 512.0, 30.0, None, 1714564800.5), "",
    ),
    "words.csv": (
        "Image Filename,Date Exif,GPS Lat Exif,GPS Long Exif\na.jpg,2024:05:01 12:00:00,47.301,8.501\n",
        (47.301, 8.501, None, None, None, None, None), "GPS Lat Exif and GPS Long Exif of words.csv count as the position",
    ),
    "xmp.csv": (
        'SourceFile,XMP:GPSLatitude,XMP:GPSLongitude\na.jpg,"9,9,9S","70,30.6W"\n',
        (-9.1525, -70.51, None, None, None, None, None), "count as the position",
    ),
    "garmin.csv": (
        "#airframe_info, log_version=1\n#yyy-mm-dd, hh:mm:ss,   hh:mm,  degrees,      degrees\n"
        "  Lcl Date, Lcl Time, UTCOfst,    Latitude,    Longitude\n2024-05-01, 14:00:00, +02:00,  47.3010,  8.5010\n",
        (47.301, 8.501, None, None, None, None, 1714572000.0), "",
    ),
    "flytrex.csv": (
        "latitude,longitude,altitude(feet),ascent(feet),time(millisecond),datetime(utc),max_altitude(feet),max_ascent(feet)\n"
        "47.301,8.501,4800,100,334100.0,2024-05-01 12:00:00.288000,9000,9000\n",
        (47.301, 8.501, 30.48, 1463.04, None, None, 1714564800.288), "",
    ),
    "flight_reader.csv": (
        "CUSTOM.date [local];CUSTOM.updateTime [local];OSD.latitude;OSD.longitude;OSD.height [m]\n"
        "15.05.2024;12:00:00,05;47,301;8,501;45,2\n",
        (47.301, 8.501, 45.2, None, None, None, 1715774400.05), "count as decimal commas",
    ),
    "chinese.csv": ("文件名,纬度,经度,高度\na.jpg,47.301,8.501,512\n", (47.301, 8.501, None, 512.0, None, None, None), ""),
}  # fmt: skip


@pytest.mark.parametrize("name", FIELD)
def test_dialects_of_the_field_are_read(tmp_path: Path, name: str) -> None:
    text, expected, note = FIELD[name]
    log = read_log(written(tmp_path, text, name))
    entry = log.rows[0].entry
    found = (
        entry.latitude,
        entry.longitude,
        entry.height_above_takeoff,
        entry.altitude,
        entry.heading,
        entry.pitch,
        entry.clock,
    )
    assert found == pytest.approx(expected, abs=1e-6)
    assert any(note in line for line in log.notes) if note else not log.notes


@pytest.mark.parametrize(
    "sides",
    [
        "{side}", "({side})", "[deg, {word}]", "{word} (deg)", "(°, {side})",
    ],
)  # fmt: skip
def test_numbers_without_a_sign_lie_where_the_name_says(tmp_path: Path, sides: str) -> None:
    latitude, longitude = (sides.format(side=word[0].upper(), word=word) for word in ("south", "west"))
    header = f'name,"Latitude {latitude}","Longitude {longitude}"\n'
    for numbers, expected in (("33.4,70.5", (-33.4, -70.5)), ("-33.4,-70.5", (-33.4, -70.5))):
        entry = read_log(written(tmp_path, f"{header}a.jpg,{numbers}\n")).rows[0].entry
        assert (entry.latitude, entry.longitude) == expected
    # One number with a sign tells that all have theirs.
    log = read_log(written(tmp_path, f"{header}a.jpg,33.4,0.5\nb.jpg,33.4,-0.5\n"))
    assert [row.entry.longitude for row in log.rows] == [0.5, -0.5]
    assert sum("count as negative" in note for note in log.notes) == 1


@pytest.mark.parametrize(
    "sides",
    [
        "E/W", "(E/W)", "(E / W)", "E W", "E_W", "(W negative)", "(deg, W negative)", "[deg, west negative]", "(degrees, -W)",
        "(deg; E positive, W negative)", "(+E, -W)", "(+E/-W)", "(W<0)", "(W is minus)", "(west: neg.)", "W negative",
        "(W = −)", "(East/West)", "(-W)",
    ],
)  # fmt: skip
def test_a_name_that_explains_the_signs_changes_none(tmp_path: Path, sides: str) -> None:
    south = sides
    for word, other in (("East", "North"), ("west", "south"), ("West", "South"), ("E", "N"), ("W", "S")):
        south = re.sub(rf"(?<![a-zA-Z]){word}(?![a-zA-Z])", other, south)
    log = read_log(written(tmp_path, f'name,"Latitude {south}","lon {sides}"\na.jpg,33.4,70.5\n'))
    assert (log.rows[0].entry.latitude, log.rows[0].entry.longitude) == (33.4, 70.5)
    assert not any("count as negative" in note for note in log.notes)


def test_letters_in_the_cells_are_believed_before_a_name(tmp_path: Path) -> None:
    log = read_log(written(tmp_path, "name,lat,Longitude W\na.jpg,33.4,70.5 E\nb.jpg,33.4,70.5 W\nc.jpg,33.4,\n"))
    assert [row.entry.longitude for row in log.rows] == [70.5, -70.5, None]
    assert not any("count as negative" in note for note in log.notes)


def test_a_column_of_letters_is_believed_before_a_name(tmp_path: Path) -> None:
    header = "name,Latitude S,GPSLatitudeRef,Longitude W,GPSLongitudeRef\n"
    log = read_log(written(tmp_path, f"{header}a.jpg,33.4,North,70.5,East\nb.jpg,33.4,South,70.5,West\n"))
    assert [(row.entry.latitude, row.entry.longitude) for row in log.rows] == [(33.4, 70.5), (-33.4, -70.5)]
    assert not any("count as negative" in note for note in log.notes)


@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("photo_n,name,lat,lon", "1,a.jpg,33.4,70.5"),
        ("photo s,name,lat,lon", "1,a.jpg,33.4,70.5"),
        ("lat_e,lon_n,lat_deg,lon_deg,name", "1,2,33.4,70.5,a.jpg"),
        ("lat_n,lon_e,name", "33.4,70.5,a.jpg"),
        ("latitude_e,longitude_n,GPS Lat,GPS Lon,name", "1,2,33.4,70.5,a.jpg"),
        ("gps_n,gps_s,name,gps", '1,2,a.jpg,"33.4, 70.5"'),
    ],
)
def test_a_letter_behind_a_name_is_a_hemisphere_only_where_it_can_be(tmp_path: Path, header: str, row: str) -> None:
    (found,) = read_log(written(tmp_path, f"{header}\n{row}\n")).rows
    assert (found.file, found.entry.latitude, found.entry.longitude) == ("a.jpg", 33.4, 70.5)


# The column, and its cells; the headings or pitches and rolls that are read; a part of a note.
ANGLES: dict[str, tuple[str, list[str], list[float | None], str]] = {
    "unwrapped": ("yaw", ["10", "730"], [10.0, 10.0], ""),
    "many turns": ("yaw", [f"{350.5 + 90 * i}" for i in range(30)], [(350.5 + 90 * i) % 360 for i in range(30)], ""),
    "one error": (
        "yaw", ["10"] * 15 + ["-9999"] + ["20"] * 4, [10.0] * 15 + [None] + [20.0] * 4,
        "1 of 20 values of the column yaw of log.csv are no angles in degrees and were not used, first in line 17.",
    ),
    "one error of a few": (
        "yaw", ["10", "-9999", "20"], [10.0, None, 20.0],
        "1 of 3 values of the column yaw of log.csv are no angles in degrees and were not used, first in line 3.",
    ),
    "one error of two": ("yaw", ["10", "9000"], [None] * 2, "was left out: it holds 9000, which is no angle in degrees"),
    "two errors of a few": ("yaw", ["10", "9000", "20", "8000"], [None] * 4, "was left out: it holds 9000"),
    "unknown": ("hdg", ["65535.0", "90", "655.35", "65535"], [None, 90.0, None, None], ""),
    "a unit in the cell": ("heading (rad)", ["90°", "1.5707963267948966"], [90.0, 90.0], ""),
    "pitch": ("gimbal_pitch", ["270", "275", "285.5"], [-90.0, -85.0, -74.5], ""),
    "hundredths": (
        "yaw", ["9000", "9010", "9005"], [None] * 3,
        "left out: it holds 9010, which is no angle in degrees; another unit is named behind a column, as in [cdeg].",
    ),
    "MAVLink's hundredths": ("hdg", ["120", "65535", "720"], [1.2, None, 7.2], "hdg of log.csv counts as hundredths of degrees"),
    "MAVLink's name": ("M_T.hdg", ["90", "360", "271"], [90.0, 0.0, 271.0], ""),
    "errors": ("gimbal_pitch", ["-90"] * 8 + ["-9999"] * 2, [None] * 10, "was left out: it holds -9999"),
}  # fmt: skip


@pytest.mark.parametrize("name", ANGLES)
def test_angles_are_told_from_numbers_that_are_none(tmp_path: Path, name: str) -> None:
    column, cells, expected, note = ANGLES[name]
    log = read_log(written(tmp_path, f"lat,lon,{column}\n" + "".join(f"47.3,8.5,{cell}\n" for cell in cells)))
    found = [row.entry.pitch if "pitch" in column else row.entry.heading for row in log.rows]
    assert found == [None if angle is None else pytest.approx(angle) for angle in expected]
    assert any(note in line for line in log.notes) if note else not log.notes


def test_mavlink_s_heading_beside_its_positions_is_in_hundredths_near_north_too(tmp_path: Path) -> None:
    log = read_log(written(tmp_path, "lat,lon,hdg\n473000000,85000000,120\n473000000,85000000,200\n"))
    assert [row.entry.heading for row in log.rows] == [1.2, 2.0]


@pytest.mark.parametrize(
    ("numbers", "expected", "told"),
    [
        (
            ["0", "0"],
            [None, None],
            "column fov of log.csv was left out: it holds 0, which is no field of view from 0.1 to 170",
        ),
        (
            ["70", "-70", "84"],
            [70.0, None, 84.0],
            "1 of 3 values of the column fov of log.csv are no fields of view from 0.1",
        ),
        (["175", "170", "0.1"], [None, 170.0, 0.1], "not used, first in line 2."),
    ],
)
def test_a_field_of_view_that_no_camera_has_is_not_used(
    tmp_path: Path, numbers: list[str], expected: list[float | None], told: str
) -> None:
    photos = [write_photo(tmp_path / f"{i}.jpg", exif(47.3, 8.5)) for i in range(len(numbers))]
    rows = "".join(f"{i}.jpg,47.3,8.5,{number}\n" for i, number in enumerate(numbers))
    flight = make_flight([*photos, written(tmp_path, f"name,lat,lon,fov\n{rows}")], tmp_path / "flight")
    assert [frame.fov for frame in read_flight(tmp_path / "flight").frames] == expected
    assert any(told in note for note in flight.notes)


def test_a_gimbal_s_angles_from_0_to_360_are_those_about_0(tmp_path: Path) -> None:
    text = "lat,lon,gimbal_yaw,gimbal_pitch,gimbal_roll\n47.3,8.5,10,320,359.9\n47.3,8.5,10,320,0.1\n"
    entries = [row.entry for row in read_log(written(tmp_path, text)).rows]
    assert [(entry.heading, entry.pitch) for entry in entries] == [(10.0, -40.0)] * 2
    assert [entry.roll for entry in entries] == pytest.approx([-0.1, 0.1])


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "cp1252"])
def test_logs_of_every_common_encoding_are_read(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "log.csv").write_bytes("name;lat (°);lon (°)\nö.jpg;47.3;8.5\n".encode(encoding))
    row = read_log(tmp_path / "log.csv").rows[0]
    assert (row.entry.latitude, row.entry.longitude, row.file) == (47.3, 8.5, "ö.jpg")


@pytest.mark.parametrize(
    ("dates", "clock", "says"),
    [
        (("5/13/2024 12:00:00", "5/1/2024 12:00:00"), 1715601600.0, False),
        (("13/5/2024 12:00:00", "1/5/2024 12:00:00"), 1715601600.0, False),
        (("5/1/2024 12:00 PM", "5/1/2024 12:00 AM"), 1714564800.0, True),
        (("01.05.2024 12:00:00", "02.05.2024 12:00:00"), 1714564800.0, True),
        (("2024-05-01T14:00:00+0200", ""), 1714564800.0, False),
        (("1714564800000", ""), 1714564800.0, False),
        (("1714564800000000", ""), 1714564800.0, False),
        (("2024:05:01 12:00:00Z", ""), 1714564800.0, False),
    ],
)
def test_dates_of_every_spelling_are_read_for_the_file_as_a_whole(
    tmp_path: Path, dates: tuple[str, str], clock: float, says: bool
) -> None:
    log = read_log(written(tmp_path, "date,lat,lon\n" + "".join(f"{date},47.3,8.5\n" for date in dates)))
    assert log.rows[0].entry.clock == clock
    assert any("nothing in it rules that out" in note for note in log.notes) == says


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "utm.csv",
            "name,easting,northing\na.jpg,465123.1,5242123.1\n",
            "Eastings and northings of a map are not read",
        ),
        ("utm.csv", "name,lat,lon\na.jpg,465123.1,5242123.1\n", "Eastings and northings of a map are not read"),
        ("grid.csv", "name,lat,lon\na.jpg,465123,5242123\n", "expected degrees, latitude from -90 to 90"),
        (
            "other.csv",
            "number,north_value,east_value\n1,47.30123,8.50123\n",
            "north_value and east_value look like degrees",
        ),
        ("commas.csv", "lat,lon,a,b,c\n47,301,8,501,1,2,3,4\n", "has 8 values below 5 names"),
        ("letters.csv", "lat,lon\n47.3 E,8.5 N\n", "has the latitude '47.3 E'; expected a number of degrees"),
        ("comma.csv", 'lat,lon,alt\n47.3,8.5,"12,5,1"\n', "has the altitude '12,5,1'; expected a number"),
        ("record.txt", "\x00\x01\x02binary", "A flight record of DJI's app is encrypted"),
    ],
)
def test_what_cannot_be_read_for_certain_is_refused_with_its_reason(
    tmp_path: Path, name: str, text: str, message: str
) -> None:
    with pytest.raises(DataError) as error:
        read_log(written(tmp_path, text, name))
    assert message in str(error.value)


def test_labels_without_an_ending_name_their_pictures(tmp_path: Path) -> None:
    write_photo(tmp_path / "DJI_0001.JPG")
    log = written(tmp_path, "#Label,X/Longitude,Y/Latitude\nDJI_0001,8.5,47.3\n")
    assert make_flight([log], tmp_path / "flight").frames[0].latitude == 47.3


def test_a_moment_listed_twice_is_said_and_fractions_of_seconds_come_from_the_elapsed_time(tmp_path: Path) -> None:
    rows = ["2024-05-01 12:00:00,47.0,8", "2024-05-01 12:00:00,47.9,8", "2024-05-01 12:00:01,47.1,8"]
    log = read_log(written(tmp_path, "datetime(utc),lat,lon\n" + "\n".join(rows)))
    entries, note = moments(log)
    assert [entry.latitude for entry in entries] == [47.0, 47.1]
    assert note is not None
    assert note.startswith(
        "1 of 2 moments of log.csv are listed more than once with different positions; the first row"
    )
    entries, notes = for_video(log, 0)
    assert [entry.latitude for entry in entries] == [47.0, 47.1]
    assert any("1 of 2 moments" in note for note in notes)
    # Airdata has ten rows a second, whole seconds of UTC, and milliseconds from the start, here 0.3 s past a second.
    rows = [f"{100 * i},2024-05-01 12:00:0{(3 + i) // 10},{47 + i / 1000},8" for i in range(30)]
    entries, note = moments(read_log(written(tmp_path, "time(millisecond),datetime(utc),lat,lon\n" + "\n".join(rows))))
    assert note is None
    assert [round(entry.time - 1714564800.0, 3) for entry in entries[:3]] == [0.3, 0.4, 0.5]


def test_a_few_positions_that_are_none_are_left_out_and_many_refuse_the_log(tmp_path: Path) -> None:
    rows = [f"{'-5.797e+148' if i == 7 else 47 + i / 1000},8.5\n" for i in range(30)]
    log = read_log(written(tmp_path, "lat,lon\n" + "".join(rows)))
    assert [row.line for row in log.rows if row.entry.latitude is None] == [9]
    assert log.notes == (
        "1 positions of log.csv are none on the Earth and were not used, first in line 9.",
        "1 of 30 rows of log.csv have no position.",
    )
    with pytest.raises(DataError, match=r"Line 2 of log\.csv has the position 64\.0359, 407\.553; expected degrees"):
        read_log(written(tmp_path, "Lat,Lng\n64.0359128,407.5528816\n64.0359138,407.5528816\n"))


def test_logs_that_were_joined_have_the_line_of_names_again(tmp_path: Path) -> None:
    log = read_log(written(tmp_path, "name,lat,lon\na.jpg,47.3,8.5\nname,lat,lon\nb.jpg,47.4,8.5\n"))
    assert [(row.file, row.entry.latitude, row.line) for row in log.rows] == [("a.jpg", 47.3, 2), ("b.jpg", 47.4, 4)]


def test_text_that_is_no_log_is_left_out_and_the_run_goes_on(tmp_path: Path) -> None:
    photo = write_photo(tmp_path / "a.jpg", exif(47.3, 8.5))
    files = [
        photo,
        written(tmp_path, "hello\n", "readme.txt"),
        written(tmp_path, "\x00\x01\x02", "DJIFlightRecord.txt"),
    ]
    notes = make_flight(files, tmp_path / "flight").notes
    assert "Left out, because their kind is not supported: readme.txt, DJIFlightRecord.txt." in notes
    assert any(
        note.startswith("DJIFlightRecord.txt is no text. A flight record of DJI's app is encrypted") for note in notes
    )


def test_east_and_north_of_old_programs_are_degrees(tmp_path: Path) -> None:
    text = "#Label,X/East,Y/North,Z/Altitude,Yaw,Pitch,Roll\nDJI_1.JPG,8.5012,47.3012,450,40,3,1\n"
    (row,) = read_log(written(tmp_path, text)).rows
    entry = row.entry
    assert (entry.latitude, entry.longitude, entry.altitude) == (47.3012, 8.5012, 450.0)
    assert (entry.heading, entry.pitch, entry.roll) == (40.0, -87.0, 1.0)


def test_exiftool_tells_the_sign_of_an_altitude_and_the_direction(tmp_path: Path) -> None:
    names = "SourceFile,GPSLatitude,GPSLongitude,GPSImgDirection,GPSAltitude,GPSAltitudeRef\n"
    text = names + "a.jpg,47.3,8.5,40,100,Below Sea Level\nb.jpg,47.3,8.5,41,100,Above Sea Level\n"
    entries = [row.entry for row in read_log(written(tmp_path, text)).rows]
    assert [(entry.altitude, entry.heading, entry.heading_source) for entry in entries] == [
        (-100.0, 40.0, "camera"),
        (100.0, 41.0, "camera"),
    ]


def test_angles_of_photogrammetry_are_named_and_not_read(tmp_path: Path) -> None:
    log = read_log(
        written(tmp_path, "imageName,latitude,longitude,altitude,omega,phi,kappa\na.jpg,47.3,8.5,450,1,2,40\n")
    )
    (row,) = log.rows
    assert (row.entry.heading, row.entry.pitch, row.entry.roll) == (None, None, None)
    assert "The columns omega, phi, and kappa of log.csv are angles of photogrammetry, and were not read." in log.notes


def test_a_gimbal_s_pitch_needs_no_heading(tmp_path: Path) -> None:
    (row,) = read_log(written(tmp_path, "file,latitude,longitude,gimbal_pitch\na.jpg,47.3,8.5,-60\n")).rows
    assert (row.entry.heading, row.entry.pitch) == (None, -60.0)


def test_a_line_of_other_names_is_not_taken_for_none(tmp_path: Path) -> None:
    for names, sentence in (
        ("#Label,X/Easting,Y/Northing,Z/Altitude", "Eastings and northings of a map are not read"),
        ("#photo,first,second,third", "first and second look like degrees; if they are, name them so"),
    ):
        (tmp_path / "cameras.txt").write_text(f"{names}\na.jpg,8.512345,47.312345,450\n")
        with pytest.raises(DataError, match=sentence):
            read_log(tmp_path / "cameras.txt")
    (tmp_path / "cameras.txt").write_text("# exported by hand, 2024\na.jpg,47.312345,8.512345,450\n")
    assert read_log(tmp_path / "cameras.txt").rows[0].entry.latitude == 47.312345


def test_folders_tell_apart_names_with_and_without_a_suffix() -> None:
    named = [path_parts(path) for path in ("A/1", "B/1", "C\\B\\1", "1")]
    assert nearest_in_folders(path_parts("/flights/b/1.JPG"), named) == [1, 2]
    assert nearest_in_folders(path_parts("c/b/1.JPG"), named) == [2]
    assert nearest_in_folders(path_parts("1.JPG"), named) == [0, 1, 2, 3]
