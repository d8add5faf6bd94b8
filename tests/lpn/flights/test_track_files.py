"""Tracks as GPX, KML, and KMZ beside photos and videos, and files that are damaged or harmful."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import pytest
from PIL import ExifTags

from lpn.core.errors import DataError
from lpn.flights import make_flight
from lpn.flights.track_files import parse_track, read_track
from tools.fixtures.photos import exif, write_photo
from tools.fixtures.videos import write_video

HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'
KML = (
    HEAD
    + '<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2"><Document>{}</Document></kml>'
)


def time(second: int, zone: str = "Z") -> str:
    return f"2024-05-01T12:00:{second:02d}{zone}"


def gpx(points: int = 20, zone: str = "Z", decimal: str = ".") -> str:
    """A track of one point a second to the north."""
    inside = "".join(
        f'<trkpt lat="47{decimal}3{i:02d}" lon="8{decimal}5"><ele>{500 + i}</ele><time>{time(i, zone)}</time></trkpt>\n'
        for i in range(points)
    )
    return (
        HEAD
        + '<gpx version="1.1" creator="a &amp; b" xmlns="http://www.topografix.com/GPX/1/1"><trk><name>x</name><trkseg>\n'
        f"{inside}</trkseg></trk></gpx>"
    )


TRACK = (
    "<Placemark><name>t</name><gx:Track>"
    + "".join(f"<when>{time(i)}</when>" for i in range(3))
    + "".join(f"<gx:coord>8.5 47.30{i} {500 + i}</gx:coord>" for i in range(3))
    + "</gx:Track></Placemark>"
)
POINTS = "".join(
    f"<Placemark><TimeStamp><when>{time(i)}</when></TimeStamp>"
    f"<Point><coordinates>8.5,47.30{i},{500 + i}</coordinates></Point></Placemark>"
    for i in range(3)
)
LINE = (
    "<Placemark>"
    + "".join(f"<when>{time(i)}</when>" for i in range(3))
    + f"<LineString><coordinates>{' '.join(f'8.5,47.30{i},{500 + i}' for i in range(3))}</coordinates></LineString></Placemark>"
)
WITHOUT_TIMES = "{1} has {0} points without a time, so it fits no picture; export a track with times."
LONG_LINE = "<LineString><coordinates>8,47 8,48</coordinates></LineString>"
DATA = "".join(
    f'<Placemark><ExtendedData><Data name="time"><value>{time(i)}</value></Data></ExtendedData>'
    f"<Point><coordinates>8.5,47.30{i},{500 + i}</coordinates></Point></Placemark>"
    for i in range(3)
)


def kmz(text: str) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr("doc.kml", text)
    return data.getvalue()


@pytest.mark.parametrize("zone", ["Z", "+00:00", ".000Z", ""])
def test_a_gpx_track_is_a_log_of_moments_in_utc(zone: str) -> None:
    log = parse_track(gpx(3, zone).encode(), "a.gpx")
    assert [(r.entry.clock, r.entry.latitude, r.entry.longitude, r.entry.altitude) for r in log.rows] == [
        (1714564800.0 + i, pytest.approx(47.3 + i / 1000), 8.5, 500.0 + i) for i in range(3)
    ]
    assert log.utc == (zone != "")
    assert log.notes == ()


@pytest.mark.parametrize(
    ("spelling", "clock"),
    [
        ("2024-05-01T12:00:00.3700Z", 1714564800.37),
        ("2024-05-01T14:00:00.504+02:00[Europe/Brussels]", 1714564800.504),
        ("2024-05-01T11:00:00-01:00", 1714564800.0),
    ],
)
def test_times_of_other_spellings_are_read(spelling: str, clock: float) -> None:
    log = parse_track(gpx(1).replace(time(0), spelling).encode(), "a.gpx")
    assert (log.rows[0].entry.clock, log.utc) == (clock, True)


def test_numbers_that_are_none_are_no_position_and_no_altitude() -> None:
    point = '<trkpt lat="{}" lon="8.5"><ele>{}</ele><time>2024-05-01T12:00:0{}Z</time></trkpt>'
    text = gpx(0).replace("</trkseg>", point.format("nan", 5, 1) + point.format(47.3, "nan", 2) + "</trkseg>")
    log = parse_track(text.encode(), "a.gpx")
    assert [(row.entry.latitude, row.entry.altitude) for row in log.rows] == [(47.3, None)]
    assert log.notes == ("1 points of a.gpx are outside of the Earth's degrees, and were left out.",)
    with pytest.raises(DataError, match="Its 1 positions are outside of the Earth's degrees"):
        parse_track(gpx(0).replace("</trkseg>", point.format(147.3, 5, 1) + "</trkseg>").encode(), "a.gpx")


def test_gpx_of_other_writers_is_read(tmp_path: Path) -> None:
    rows = parse_track(gpx(3).encode(), "a.gpx").rows
    prefixed = (
        gpx(3)
        .replace('xmlns="http://www.topografix.com/GPX/1/1"', 'xmlns="http://www.garmin.com/x" xmlns:ns2="http://www.topografix.com/GPX/1/1"')
        .replace("</", "</ns2:").replace("<trk", "<ns2:trk").replace("<gpx", "<ns2:gpx").replace("<ele", "<ns2:ele")
        .replace("<time", "<ns2:time").replace("<name", "<ns2:name")
    )  # fmt: skip
    assert parse_track(prefixed.encode(), "a.gpx").rows == rows
    # A mark of UTF-8 that was taken for letters, and extensions in the namespace of GPX.
    assert parse_track(f"\u00ef\u00bb\u00bf{gpx(3)}".encode(), "a.gpx").rows == rows
    extended = gpx(3).replace("</ele>", "</ele><extensions><speed>3</speed></extensions>")
    assert parse_track(extended.encode(), "a.gpx").rows == rows
    # Coordinates in the wrong order, which the photo's own position proves.
    flipped = KML.format(TRACK.replace("8.5 47.30", "47.3 8.50"))
    (tmp_path / "track.kml").write_text(flipped, "utf-8")
    clock = {ExifTags.GPS.GPSDateStamp: "2024:05:01", ExifTags.GPS.GPSTimeStamp: (12.0, 0.0, 1.0)}
    photo = write_photo(tmp_path / "a.jpg", exif(47.3, 8.5, gps=clock))
    flight = make_flight([photo, tmp_path / "track.kml"], tmp_path / "flight")
    assert (flight.frames[0].latitude, flight.frames[0].longitude) == pytest.approx((47.3, 8.501))
    assert "Latitude and longitude of track.kml are swapped, as the photos' own positions say." in flight.notes


def test_a_track_whose_times_are_all_the_same_fits_nothing_and_says_so(tmp_path: Path) -> None:
    text = gpx(20)
    for i in range(20):
        text = text.replace(time(i), "2024-05-01T00:00:00+02:00")
    (tmp_path / "track.gpx").write_text(text, "utf-8")
    clock = {ExifTags.GPS.GPSDateStamp: "2024:05:01", ExifTags.GPS.GPSTimeStamp: (12.0, 0.0, 5.0)}
    write_photo(tmp_path / "a.jpg", exif(gps=clock))
    flight = make_flight([tmp_path / "a.jpg", tmp_path / "track.gpx"], tmp_path / "flight")
    assert flight.frames[0].latitude is None
    assert any(
        "1 of 1 moments of track.gpx are listed more than once with different positions" in n for n in flight.notes
    )
    assert any(n.startswith("track.gpx fits none of the 1 photos by UTC, and was not used") for n in flight.notes)


def test_places_and_times_of_a_track_that_differ_in_number_are_paired_only_where_that_is_certain() -> None:
    # Times and places in turn, of which the second place has no time; then three places after two times.
    turns = f"<when>{time(0)}</when><coord>8.5 47.3</coord><coord>8.5 47.4</coord><when>{time(2)}</when><coord>8.5 47.2</coord>"
    log = parse_track(KML.format(f"<Track>{turns}</Track>").encode(), "a.kml")
    assert [(r.entry.clock, r.entry.latitude) for r in log.rows] == [(1714564800.0, 47.3), (1714564802.0, 47.2)]
    assert log.notes == ("1 points of a.kml have no time, and were left out.",)
    places = KML.format(f"<Track>{''.join(f'<coord>8.5 47.{i}</coord>' for i in range(3))}</Track>")
    assert parse_track(places.encode(), "a.kml").notes == (WITHOUT_TIMES.format(3, "a.kml"),)


def test_spaces_behind_the_commas_of_a_place_are_read() -> None:
    text = "<Placemark><name>DJI_0001.JPG</name><Point><coordinates> 8.5, 47.3, 512 </coordinates></Point></Placemark>"
    row = parse_track(KML.format(text).encode(), "a.kml").rows[0]
    assert (row.entry.latitude, row.entry.longitude, row.entry.altitude, row.file) == (47.3, 8.5, 512.0, "DJI_0001.JPG")


@pytest.mark.parametrize(
    "inside", [TRACK, POINTS, LINE, DATA], ids=["gx:Track", "TimeStamp", "LineString", "ExtendedData"]
)
@pytest.mark.parametrize("namespace", ["http://www.opengis.net/kml/2.2", "http://earth.google.com/kml/2.1", ""])
def test_kml_of_every_form_is_read(inside: str, namespace: str) -> None:
    text = KML.format(inside).replace("http://www.opengis.net/kml/2.2", namespace)
    log = parse_track(text.encode(), "a.kml")
    assert [(r.entry.clock, r.entry.latitude, r.entry.longitude, r.entry.altitude) for r in log.rows] == [
        (1714564800.0 + i, pytest.approx(47.3 + i / 1000), 8.5, 500.0 + i) for i in range(3)
    ]
    assert log.utc
    assert parse_track(kmz(text), "a.kmz").rows == log.rows


@pytest.mark.parametrize("suffix", [".gpx", ".kml"])
def test_waypoints_named_as_pictures_are_their_positions(tmp_path: Path, suffix: str) -> None:
    place = (
        '<wpt lat="47.3" lon="8.5"><ele>512</ele><name>DJI_0001.JPG</name></wpt>'
        if suffix == ".gpx"
        else "<Placemark><name>DJI_0001.JPG</name><Point><coordinates>8.5,47.3,512</coordinates></Point></Placemark>"
    )
    text = f'<gpx version="1.1">{place}</gpx>' if suffix == ".gpx" else KML.format(place)
    (tmp_path / f"places{suffix}").write_text(text, "utf-8")
    write_photo(tmp_path / "DJI_0001.JPG")
    frame = make_flight([tmp_path / f"places{suffix}"], tmp_path / "flight").frames[0]
    assert (frame.latitude, frame.longitude, frame.altitude) == (47.3, 8.5, 512.0)


@pytest.mark.parametrize(("hour", "offset"), [(12, ""), (14, ", with a constant offset: the photos' clock is UTC+2")])
def test_photos_take_their_positions_from_a_track(tmp_path: Path, hour: int, offset: str) -> None:
    (tmp_path / "track.gpx").write_text(gpx(), "utf-8")
    for second in (3, 7, 12):
        clock = {ExifTags.GPS.GPSDateStamp: "2024:05:01", ExifTags.GPS.GPSTimeStamp: (12.0, 0.0, float(second))}
        taken = {ExifTags.Base.DateTimeOriginal: f"2024:05:01 {hour}:00:{second:02d}"}
        write_photo(tmp_path / "photos" / f"{second:02d}.jpg", exif(camera=taken, gps=clock if hour == 12 else None))
    flight = make_flight([tmp_path / "photos", tmp_path / "track.gpx"], tmp_path / "flight")
    assert [frame.latitude for frame in flight.frames] == pytest.approx([47.303, 47.307, 47.312])
    assert [frame.altitude for frame in flight.frames] == pytest.approx([503.0, 507.0, 512.0])
    how = "UTC" if hour == 12 else "their clock"
    said = f"track.gpx gives the values of 3 of 3 photos, by {how}{offset}; they replace those in the files."
    assert said in flight.notes


def test_a_video_takes_its_positions_from_a_track(tmp_path: Path) -> None:
    (tmp_path / "track.gpx").write_text(gpx(), "utf-8")
    video = write_video(tmp_path / "a.mp4", 3)
    flight = make_flight([video, tmp_path / "track.gpx"], tmp_path / "flight")
    assert [frame.latitude for frame in flight.frames] == pytest.approx(
        [47.3 + (frame.time or 0) / 1000 for frame in flight.frames]
    )
    assert any(
        "track.gpx does not say when the video began; its first row counts as the beginning" in n for n in flight.notes
    )


def test_a_video_that_says_when_it_began_starts_there_in_the_track(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    (tmp_path / "track.gpx").write_text(gpx(), "utf-8")
    with (
        av.open(str(write_video(tmp_path / "plain.mp4", 3))) as source,
        av.open(str(tmp_path / "a.mp4"), "w") as target,
    ):
        target.metadata["creation_time"] = time(10)
        pictures = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.stream = pictures
                target.mux(packet)
    flight = make_flight([tmp_path / "a.mp4", tmp_path / "track.gpx"], tmp_path / "flight")
    assert [frame.latitude for frame in flight.frames] == pytest.approx(
        [47.31 + (frame.time or 0) / 1000 for frame in flight.frames]
    )
    assert any("The time in the video's file says where in track.gpx it began" in note for note in flight.notes)


def test_a_track_that_is_cut_off_or_damaged_is_read_up_to_there() -> None:
    whole = gpx(20)
    cut = parse_track(whole[: whole.index("<time>2024-05-01T12:00:12")].encode(), "a.gpx")
    assert (len(cut.rows), cut.rows[-1].entry.latitude) == (12, 47.311)
    assert cut.notes == ("a.gpx is cut off or damaged; only its points before the damage were used.",)
    places = KML.format(POINTS)
    cut = parse_track(places[: places.index("8.5,47.302")].encode(), "a.kml")
    assert len(cut.rows) == 2
    assert "only its points before the damage were used" in cut.notes[0]
    # A bare & is no damage, and commas within numbers are said.
    assert len(parse_track(whole.replace("<name>x", "<name>a & b").encode(), "a.gpx").rows) == 20
    commas = parse_track(gpx(3, decimal=",").encode(), "a.gpx")
    assert commas.rows[1].entry.latitude == 47.301
    assert "count as decimal commas" in commas.notes[0]
    untimed = whole.replace(f"<time>{time(4)}</time>", "")
    assert parse_track(untimed.encode(), "a.gpx").notes == ("1 points of a.gpx have no time, and were left out.",)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "is neither GPX nor KML"),
        (b"PK\x03\x04damaged", "is a damaged archive"),
        (b"<gpx>", "is damaged, and no point of it can be read"),
        (b'<gpx version="1.1"></gpx>', "has no point with a position"),
        (b'<!DOCTYPE x [<!ENTITY a "b">]><gpx>&a;</gpx>', "has a DTD or entities"),
        (KML.format("<!DOCTYPE x SYSTEM 'file:///etc/passwd'>").encode(), "has a DTD or entities"),
        (
            KML.format(LONG_LINE).encode(),
            "has no point with a position",
        ),
    ],
)
def test_files_that_are_no_tracks_are_refused_in_one_sentence(data: bytes, message: str) -> None:
    with pytest.raises(DataError) as error:
        parse_track(data, "a.gpx")
    assert message in str(error.value)


@pytest.mark.parametrize(
    "text",
    [
        gpx(2).replace("time>", "tame>"),
        KML.format(f"<Placemark>{LONG_LINE}</Placemark>"),
        KML.format(f"<Placemark><name>2024-05-01 12:00 - 2024-05-01 12:30</name>{LONG_LINE}</Placemark>"),
        KML.format(
            f"<Placemark>{LONG_LINE}<TimeSpan><begin>{time(0)}</begin><end>{time(9)}</end></TimeSpan></Placemark>",
        ),
    ],
    ids=["GPX", "LineString", "name", "TimeSpan"],
)
def test_a_track_without_times_fits_nothing_and_the_run_goes_on(tmp_path: Path, text: str) -> None:
    (tmp_path / "track.gpx").write_text(text, "utf-8")
    photo = write_photo(tmp_path / "a.jpg", exif(47.3, 8.5))
    flight = make_flight([photo, tmp_path / "track.gpx"], tmp_path / "flight")
    assert flight.frames[0].latitude == 47.3
    assert WITHOUT_TIMES.format(2, "track.gpx") in flight.notes
    assert any(note.startswith("track.gpx fits none of the 1 photos by") for note in flight.notes)


def test_an_archive_without_a_track_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr("a.txt", "x")
    with pytest.raises(DataError, match=r"a\.kmz has no \.kml in it"):
        parse_track(data.getvalue(), "a.kmz")
    with pytest.raises(DataError, match=r"b\.gpx cannot be read"):
        read_track(tmp_path / "b.gpx")


def kml_point(coordinates: str, mode: str = "") -> bytes:
    """A KML of one point with a time, and what its height is measured from."""
    told = f"<altitudeMode>{mode}</altitudeMode>" if mode else ""
    return (
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><TimeStamp><when>2024-05-01T10:00:00Z</when></TimeStamp>'
        f"<Point>{told}<coordinates>{coordinates}</coordinates></Point></Placemark></kml>"
    ).encode()


@pytest.mark.parametrize(
    ("mode", "height", "altitude", "above_ground"),
    [
        ("absolute", "40", 40.0, None),
        ("absolute", "0", 0.0, None),
        ("relativeToGround", "40", None, 40.0),
        ("clampToGround", "40", None, None),
        ("", "450", 450.0, None),
        ("", "0", None, None),
    ],
)
def test_a_height_of_kml_is_measured_from_what_it_says(
    mode: str, height: str, altitude: float | None, above_ground: float | None
) -> None:
    (row,) = parse_track(kml_point(f"8.5,47.3,{height}", mode), "a.kml").rows
    assert (row.entry.latitude, row.entry.longitude) == (47.3, 8.5)
    assert (row.entry.altitude, row.entry.height_above_ground) == (altitude, above_ground)


def test_decimal_commas_of_kml_are_refused_and_those_of_gpx_read() -> None:
    with pytest.raises(
        DataError, match=r"coordinates 8,5,47,3,450; expected longitude, latitude, and height with points"
    ):
        parse_track(kml_point("8,5,47,3,450"), "a.kml")
    gpx = (
        '<gpx version="1.1" creator="a"><trk><trkseg><trkpt lat="47,3" lon="8,5"><ele>450,5</ele>'
        '<time>2024-05-01T10:00:00Z</time></trkpt><trkpt lat="47,3" lon="8,5"><ele>450,5</ele>'
        '<time>2024-05-01T10:00:01Z</time></trkpt><trkpt lat="103.8" lon="1"/></trkseg></trk></gpx>'
    )
    track = parse_track(gpx.encode(), "a.gpx")
    assert [(row.entry.latitude, row.entry.longitude, row.entry.altitude) for row in track.rows] == [
        (47.3, 8.5, 450.5)
    ] * 2
    assert "1 points of a.gpx are outside of the Earth's degrees, and were left out." in track.notes


def test_each_geometry_of_kml_has_its_own_mode_and_tracks_have_that_of_the_multitrack() -> None:
    start = '<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2"><Placemark>'
    track = "<gx:Track><when>2024-05-01T10:00:0{0}Z</when><gx:coord>8.5 47.3 {0}0</gx:coord></gx:Track>"
    several = "<gx:MultiTrack><altitudeMode>relativeToGround</altitudeMode>" + track.format(4) + track.format(5)
    rows = parse_track((start + several + "</gx:MultiTrack></Placemark></kml>").encode(), "a.kml").rows
    assert [(row.entry.altitude, row.entry.height_above_ground) for row in rows] == [(None, 40.0), (None, 50.0)]
    times = "".join(f"<when>2024-05-01T10:00:0{second}Z</when>" for second in (1, 2))
    points = "<Point><altitudeMode>{}</altitudeMode><coordinates>8.5,47.3,{}</coordinates></Point>"
    several = f"<MultiGeometry>{points.format('relativeToGround', 40)}{points.format('absolute', 450)}</MultiGeometry>"
    rows = parse_track(f"{start}{times}{several}</Placemark></kml>".encode(), "a.kml").rows
    assert [(row.entry.altitude, row.entry.height_above_ground) for row in rows] == [(None, 40.0), (450.0, None)]


@pytest.mark.parametrize(("angles", "noted"), [("45 0 0", True), ("0 0 0", False)])
def test_angles_of_a_tracks_model_are_named_as_not_read(angles: str, noted: bool) -> None:
    start = '<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2"><Placemark>'
    inside = f"<when>2024-05-01T10:00:00Z</when><gx:coord>8.5 47.3 40</gx:coord><gx:angles>{angles}</gx:angles>"
    track = parse_track(f"{start}<gx:Track>{inside}</gx:Track></Placemark></kml>".encode(), "a.kml")
    assert len(track.rows) == 1
    assert any("gx:angles of a.kml" in note for note in track.notes) == noted
