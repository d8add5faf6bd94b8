"""Every dialect of subtitles, in a few lines each, and what cannot be known from them."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lpn.core.errors import DataError
from lpn.flight.files import make_flight
from lpn.flight.files.subtitles import GpsOrder, blocks_of, parse_subtitles, read_subtitles
from lpn.flight.files.telemetry import Telemetry, TelemetryEntry
from tools.fixtures.videos import write_video

BRACKETS = "[focal_len: 24.00] [latitude: 34.270373] [longitude: -84.176160] [rel_alt: 1.500 abs_alt: 302.208] [ct: 5]"
PRY = "F.PRY (2.7°, -7.0°, 110.1°), G.PRY (-24.4°, 0.0°, 110.4°)"
# Name: the text of an entry; latitude, longitude, height above take-off, altitude, heading, pitch.
DIALECTS = {
    "mini 4 pro": (
        "[latitude: 59.302335] [longitude: 18.203059] [rel_alt: 1.300 abs_alt: 132.860] [iso : 2700] [shutter : 1/30.0]",
        (59.302335, 18.203059, 1.3, 132.86, None, None),
    ),
    "air 3s": (
        f'<font size="28">FrameCnt: 1, DiffTime: 16ms\n2026-05-17 08:28:30.219\n{BRACKETS}',
        (34.270373, -84.17616, 1.5, 302.208, None, None),
    ),
    "air 2s": (
        '<font size="36">SrtCnt : 1, DiffTime : 33ms\n2022-08-07 13:40:40,774,808\n[focal_len : 240] [latitude: 41.424724] '
        "[longitude: 2.234156] [altitude: 117.000000] </font>",
        (41.424724, 2.234156, None, 117.0, None, None),
    ),
    "mavic 2 pro": (
        "2019-09-27 10:28:08,438,904\n[focal_len : 280] [latitude : -35.080155] [longtitude : -60.286702] </font>",
        (-35.080155, -60.286702, None, None, None, None),
    ),
    "avata 360": (
        "[dzoom_ratio: 1.00], [latitude: 53.365080] [longitude: 6.460739] [rel_alt: 5.400 abs_alt: -124.744] "
        "[gb_yaw: -162.8 gb_pitch: -10.0 gb_roll: 0.0] [shift x: 0.00, y: 0.00] [pp_target:0.000, 0.000]",
        (53.36508, 6.460739, 5.4, -124.744, 197.2, -10.0),
    ),
    "avata 2": (
        "GPS(39.906217,116.391305,69.800) BAROMETER(91.2) HOME(39.906206,116.391400)",
        (39.906217, 116.391305, 91.2, 69.8, None, None),
    ),
    "mavic pro": (
        "HOME(149.0251,-20.2532) 2017.08.05 14:11:51\nGPS(149.0251,-20.2533,16) BAROMETER:1.9\nISO:100 Shutter:60 EV: Fnum:2.2",
        (-20.2533, 149.0251, 1.9, None, None, None),
    ),
    "phantom 3": (
        "HOME(149.0251,-20.2532) 2017.8.5 14:11:51\nGPS(149.0251,-20.2533,16) Hb:1.9 Hs:1.9\nISO:100 TV:60 EV: 0 IR:F2.8",
        (-20.2533, 149.0251, 1.9, None, None, None),
    ),
    "mavic mini": (
        "F/2.8, SS 30.15, ISO 260, EV -1.7, GPS (-121.7458, 48.0771, 17), D 221.21m, H 200.70m, H.S n/a, V.S n/a ",
        (48.0771, -121.7458, 200.7, None, None, None),
    ),
    "phantom 4 rtk": (
        "F/5.6, SS 400, GPS (-58.851745, -34.237922, 15), HOME (-58.847509, -34.232707, -57.98m), D 698.70m, H 85.80m, "
        f"H.S 0.00m/s, V.S 0.00m/s, {PRY}",
        (-34.237922, -58.851745, 85.8, None, 110.4, -24.4),
    ),
    "matrice 300": (
        "2022.06.21 16:06:17\nGPS(36.6146,-6.1120,0.0M) BAROMETER:0.3M",
        (36.6146, -6.112, 0.3, None, None, None),
    ),
    "no gimbal": (
        "GPS (-58.851745, -34.237922, 15), D 1.0m, H 85.80m, F.PRY (2.7°, -7.0°, -110.1°), G.PRY (0.0°, 0.0°, 0.0°)",
        (-34.237922, -58.851745, 85.8, None, 249.9, None),
    ),
    "feet": ("GPS (-121.7458, 48.0771, 17), D 221.21ft, H 100.00ft", (48.0771, -121.7458, 30.48, None, None, None)),
}  # fmt: skip


def srt(*texts: str, seconds: float = 1.0, codes: bool = True) -> bytes:
    """A `.SRT` file with one entry for each text."""

    def code(time: float) -> str:
        return f"{int(time // 3600):02d}:{int(time // 60 % 60):02d}:{int(time % 60):02d},{round(time % 1 * 1000):03d}"

    lines = []
    for i, text in enumerate(texts):
        when = f"{code(i * seconds)} --> {code((i + 1) * seconds)}\n" if codes else ""
        lines.append(f"{i + 1}\n{when}{text}\n\n")
    return "".join(lines).encode()


def one(text: str, order: GpsOrder | None = None) -> TelemetryEntry:
    return parse_subtitles(blocks_of(srt(text)), "a.SRT", order).entries[0]


@pytest.mark.parametrize(("text", "expected"), DIALECTS.values(), ids=DIALECTS)
def test_each_dialect_is_read(text: str, expected: tuple[float | None, ...]) -> None:
    entry = one(text)
    found = (entry.latitude, entry.longitude, entry.height_above_takeoff, entry.altitude, entry.heading, entry.pitch)
    assert [value is None for value in found] == [value is None for value in expected]
    assert [value for value in found if value] == pytest.approx([value for value in expected if value])


def test_headings_say_whose_they_are_and_times_of_day_are_read_in_every_spelling() -> None:
    assert one(DIALECTS["phantom 4 rtk"][0]).heading_source == "gimbal"
    assert one(DIALECTS["no gimbal"][0]).heading_source == "aircraft"
    assert one(DIALECTS["air 3s"][0]).clock == 1779006510.219
    assert one(DIALECTS["mavic 2 pro"][0]).clock == pytest.approx(1569580088.438904, abs=1e-5)
    assert one(DIALECTS["matrice 300"][0]).clock == 1655827577.0
    assert one(DIALECTS["phantom 3"][0]).clock == 1501942311.0


def test_focal_lengths_are_in_millimetres_or_in_tenths_of_them() -> None:
    whole, tenths = one(DIALECTS["air 3s"][0]).fov, one(DIALECTS["air 2s"][0]).fov
    assert whole is not None
    assert whole == tenths == pytest.approx(71.6, abs=0.1)
    assert one(BRACKETS.replace("24.00]", "24.00] [dzoom_ratio: 2.00]")).fov == pytest.approx(39.7, abs=0.1)
    for zoom, fov in (("10000", whole), ("20000", 39.7)):
        text = BRACKETS.replace("24.00]", f"24.00] [dzoom_ratio: {zoom}, delta:0]")
        assert one(text).fov == pytest.approx(fov, abs=0.1)


@pytest.mark.parametrize("spoil", ["crlf", "bom", "no blank lines", "no final line", "no index lines"])
def test_bytes_of_every_kind_are_read(spoil: str) -> None:
    data = srt(DIALECTS["mavic pro"][0], DIALECTS["mavic pro"][0], DIALECTS["mavic pro"][0])
    changed = {
        "crlf": data.replace(b"\n", b"\r\n"),
        "bom": b"\xef\xbb\xbf" + data,
        "no blank lines": data.replace(b"\n\n", b"\n"),
        "no final line": data.rstrip(),
        "no index lines": re.sub(rb"(?m)^\d+\n", b"", data),
    }[spoil]
    assert parse_subtitles(blocks_of(changed), "a") == parse_subtitles(blocks_of(data), "a")


def test_entries_without_time_codes_have_their_clock() -> None:
    texts = [
        f"2017.08.05 14:11:{51 + i},393,525,393,525\n[latitude : -20.2533] [longtitude : 149.02{i}]" for i in range(3)
    ]
    found = parse_subtitles(blocks_of(srt(*texts, codes=False)), "a")
    assert [entry.time for entry in found.entries] == pytest.approx([0, 1, 2], abs=1e-3)
    assert found.end == pytest.approx(2, abs=1e-3)


def test_a_file_that_mixes_dialects_settles_the_order_by_its_brackets() -> None:
    tuple_only = "GPS (-59.409424, -34.650200, 16), H 17.39m"
    named = "[latitude : -34.651180] [longtitude : -59.409483] [altitude: 120.098999]"
    found = parse_subtitles(blocks_of(srt(tuple_only, named)), "a")
    assert [(entry.latitude, entry.longitude) for entry in found.entries] == [
        (-34.6502, -59.409424),
        (-34.65118, -59.409483),
    ]
    assert not found.notes


def test_the_distance_to_home_settles_the_order() -> None:
    text = DIALECTS["phantom 4 rtk"][0]
    assert not parse_subtitles(blocks_of(srt(text)), "a").notes
    # The same flight written latitude first has the same distance.
    swapped = text.replace("-58.851745, -34.237922", "-34.237922, -58.851745").replace(
        "-58.847509, -34.232707", "-34.232707, -58.847509"
    )
    found = parse_subtitles(blocks_of(srt(swapped)), "a")
    assert (found.entries[0].latitude, found.notes) == (-34.237922, ())


@pytest.mark.parametrize(
    ("text", "place", "other"),
    [
        ("GPS (8.2090, 47.4692, 18), D 49.21m, H 45.60m", (47.4692, 8.209), "lat-lon"),
        ("GPS(36.6146,-6.1120,0.0M) BAROMETER:0.3M", (36.6146, -6.112), "lon-lat"),
    ],
)
def test_an_ambiguous_order_is_guessed_by_the_third_value_and_said(
    text: str, place: tuple[float, float], other: GpsOrder
) -> None:
    found = parse_subtitles(blocks_of(srt(text)), "a.SRT")
    assert (found.entries[0].latitude, found.entries[0].longitude) == place
    assert "ambiguous" in found.notes[0]
    assert f"--gps-order {other}" in found.notes[0]
    told = parse_subtitles(blocks_of(srt(text)), "a.SRT", other)
    assert (told.entries[0].latitude, told.entries[0].longitude) == place[::-1]
    assert not told.notes


def test_positions_before_the_fix_or_without_numbers_are_unknown() -> None:
    texts = ["[latitude: 0.000000] [longitude: 0.000000] [rel_alt: 0.400 abs_alt: 269.099]"] * 3
    found = parse_subtitles(blocks_of(srt(*texts, BRACKETS)), "a.SRT")
    assert [entry.latitude for entry in found.entries] == [None, None, None, 34.270373]
    assert found.entries[0].height_above_takeoff == 0.4
    assert found.notes == ("3 of 4 entries of a.SRT have no position.",)
    lost = "HOME(-1.2218,42.4668) 2018.08.19 08:00:50\nGPS(N/A,N/A,3) BAROMETER:0.0"
    assert one(f"{lost}\nISO:100").latitude is None
    assert one("[latitude: 95.0] [longitude: 10.0] [rel_alt: 3.0 abs_alt: 4.0]").latitude is None


@pytest.mark.parametrize("text", ["GPS(W: 0.0, N: 0.0, 0m)", "GPS (0, 0, 0)", "[latitude: 0.0] [longitude: 0.0]"])
def test_a_video_without_any_fix_is_of_a_known_dialect(text: str) -> None:
    found = parse_subtitles(blocks_of(srt(text)), "a.SRT")
    assert found.entries[0].latitude is None
    assert found.notes[-1] == "1 of 1 entries of a.SRT have no position."


@given(st.integers(20, len(BRACKETS) - 1))
def test_a_number_that_the_end_cuts_off_is_not_used(length: int) -> None:
    whole = one(BRACKETS)
    try:
        cut = one(BRACKETS[:length])
    except DataError:
        return
    assert cut.latitude in (None, whole.latitude)
    assert cut.longitude in (None, whole.longitude)
    assert cut.height_above_takeoff in (None, whole.height_above_takeoff)


@pytest.mark.parametrize("text", ["", "1\n", "1\n00:00:00,000 --> 00:00:01,000\nHello [there: 3]\n\n", "\x00\xff" * 50])
def test_subtitles_without_telemetry_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.SRT").write_text(text, "utf-8")
    with pytest.raises(DataError, match=r"a\.SRT holds no telemetry of DJI"):
        read_subtitles(tmp_path / "a.SRT")
    with pytest.raises(DataError, match=r"b\.SRT cannot be read"):
        read_subtitles(tmp_path / "b.SRT")


def test_positions_are_interpolated_between_their_changes() -> None:
    # Ten entries a second, a fix each second: 0, 0, ..., 1, 1, ...
    entries = [TelemetryEntry(i / 10, latitude=float(i // 10), longitude=0.0, heading=350.0 + i) for i in range(31)]
    telemetry = Telemetry(entries)
    assert telemetry.at(1.5)["latitude"] == pytest.approx(1.5)
    assert telemetry.at(2.0)["heading"] == pytest.approx(10.0)
    assert telemetry.at(0.95)["heading"] == pytest.approx(359.5)
    assert telemetry.at(4.0)["latitude"] == 3.0
    assert telemetry.at(10.0)["latitude"] is None


def test_a_drone_that_hovers_does_not_creep_and_gaps_are_not_filled() -> None:
    entries = [TelemetryEntry(float(i), latitude=10.0, longitude=179.999) for i in range(20)]
    entries += [
        TelemetryEntry(20.0, latitude=10.001, longitude=-179.999),
        TelemetryEntry(60.0, latitude=10.1, longitude=0.0),
    ]
    telemetry = Telemetry(entries)
    assert telemetry.at(15.0)["latitude"] == 10.0
    middle = telemetry.at(19.5)
    assert middle["latitude"] == pytest.approx(10.0005)
    assert abs(float(middle["longitude"] or 0)) == pytest.approx(180.0)
    assert telemetry.at(40.0)["latitude"] is None
    assert Telemetry([]).at(0.0)["latitude"] is None


def test_moments_are_chosen_by_the_distance_flown() -> None:
    # A degree of longitude at the equator is 111,320 m: one metre a second, with a rest of ten seconds.
    degrees = [min(i, 30) + max(i - 40, 0) for i in range(71)]
    telemetry = Telemetry(
        [TelemetryEntry(float(i), latitude=0.0, longitude=d / 111_319.4) for i, d in enumerate(degrees)]
    )
    assert telemetry.times_by_distance(20.0) == pytest.approx([0, 20, 50, 70], abs=0.01)
    assert Telemetry([TelemetryEntry(0.0)]).times_by_distance(5.0) == []
    far = [TelemetryEntry(float(i), latitude=80.0 * i, longitude=1.0) for i in range(2)]
    with pytest.raises(DataError, match="a picture every 5 m is too many"):
        Telemetry(far).times_by_distance(5.0)


# Source: the text of an entry; latitude, longitude, height above take-off, altitude, heading, pitch. Numbers are invented.
FIELD = {
    "letters before": ("GPS (W: 70.5, S: 33.4, 812.5m)", (-33.4, -70.5, None, 812.5, None, None)),
    "letters, east and north": ("GPS(E: 10.2, N: 47.3, 600.0m)", (47.3, 10.2, None, 600.0, None, None)),
    "letters without a space": ("GPS(W:70.5,S:33.4,812.5m)", (-33.4, -70.5, None, 812.5, None, None)),
    "letters behind": ("GPS(70.5W, 33.4S, 812.5m)", (-33.4, -70.5, None, 812.5, None, None)),
    "autel evo": (
        "HOME(W: 70.6, S: 33.5) 2020-11-01 15:29:24\nGPS(W: 70.5, S: 33.4, 161) \nISO:105 SHUTTER:500 EV:0.0 F-NUM:2.8",
        (-33.4, -70.5, None, 161.0, None, None),
    ),
    "autel max": (
        "HOME(E: 8.5, N: 47.3) 2025-08-27 13:21:35\nGPS(E: 8.501, N: 47.301, 574.21m)\nISO:100 SHUTTER:400 EV:0.0 F-NUM:2.8\n"
        "F.PRY (0.6°, 1.2°, -31.2°), G.PRY (-40.3°, 0.0°, -31.2°)",
        (47.301, 8.501, None, 574.21, 328.8, -40.3),
    ),
    "autel with a doubled sign": (
        "HOME(-70.5006, -33.4324) 2019.9.8 16:49:24\nGPS(W: -70.-5005, S: -33.-4323, -37) ReH:12 \nISO:100 SHUTTER:1000",
        (-33.4323, -70.5005, 12.0, -37.0, None, None),
    ),
    "letters alone": ("[N: 47.3 W: 8.5] ISO:100", (47.3, -8.5, None, None, None, None)),
    "letters in two brackets": ("[E: 8.5][S: 47.3]", (-47.3, 8.5, None, None, None, None)),
    "degrees, minutes, seconds": (
        "N 47°18'04.44\" E 8°30'04.44\"", (47.301233333, 8.501233333, None, None, None, None),
    ),
    "an equals sign": ("latitude=47.301 longitude=8.501 rel_alt=45.2", (47.301, 8.501, 45.2, None, None, None)),
    "short names and units": ("Lat: 47.301° Lon: 8.501° Alt: 100ft H: 45.2 m", (47.301, 8.501, 45.2, 30.48, None, None)),
    "bars": ("|LAT:59.3023|LON:18.2030|ALT:132.86|", (59.3023, 18.203, None, 132.86, None, None)),
    "a real minus sign": ("[latitude: −33.4] [longitude: −70.5]", (-33.4, -70.5, None, None, None, None)),
    "decimal commas by name": (
        "[latitude: 47,301] [longitude: 8,501] [rel_alt: 12,5 abs_alt: 512,0]", (47.301, 8.501, 12.5, 512.0, None, None),
    ),
    "decimal commas in a list": (
        "GPS (8,501, 47,301, 16), D 252,06m, H 76,19m, G.PRY (-90,0°, 0,0°, 28,2°)", (47.301, 8.501, 76.19, None, 28.2, -90.0),
    ),
    "decimal commas without spaces": ("GPS(8,501,47,301,16)", (47.301, 8.501, None, None, None, None)),
    "decimal commas with letters": ("GPS (W: 70,5, S: 33,4, 812,5m)", (-33.4, -70.5, None, 812.5, None, None)),
    "semicolons": ("GPS(8,501; 47,301; 16)", (47.301, 8.501, None, None, None, None)),
    "radians": ("[latitude: 0.825562] [longtitude: 0.148374] [altitude: 27.3]", (47.301218, 8.501204, None, 27.3, None, None)),
    "JSON": ('{"lat": 47.301, "lng": 8.501, "alt_rel": 45.2, "alt_amsl": 512.0}', (47.301, 8.501, 45.2, 512.0, None, None)),
}  # fmt: skip


@pytest.mark.parametrize(("text", "expected"), FIELD.values(), ids=FIELD)
def test_dialects_of_the_field_are_read(text: str, expected: tuple[float | None, ...]) -> None:
    entry = one(text)
    found = (entry.latitude, entry.longitude, entry.height_above_takeoff, entry.altitude, entry.heading, entry.pitch)
    assert found == pytest.approx(expected, abs=2e-6)


P4RTK = (
    "F/6.3, SS 60, ISO 100, EV 0, RTK ({longitude:.6f}, 47.300000, 28), HOME (10.203000, 47.301000, 603.55m), D {metres:.2f}m, "
    "H 76.19m, H.S 7.50m/s, V.S 0.00m/s, F.PRY (-5.3°, 2.1°, 28.3°), G.PRY (-90.0°, 0.0°, 28.2°)"
)


def test_an_rtk_fix_is_a_position_whose_order_home_and_distance_settle(tmp_path: Path) -> None:
    distances = (252.06, 245.32, 238.62, 231.98, 225.39, 218.86)
    texts = [P4RTK.format(longitude=10.2 + k / 10_000, metres=metres) for k, metres in enumerate(distances)]
    (tmp_path / "DJI_0001.SRT").write_bytes(srt(*texts))
    video = write_video(tmp_path / "DJI_0001.MP4", 6)
    flight = make_flight([video], tmp_path / "flight")
    assert len(flight.frames) == 6
    for k, entry in enumerate(read_subtitles(tmp_path / "DJI_0001.SRT").entries):
        assert (entry.latitude, entry.longitude) == (47.3, pytest.approx(10.2 + k / 10_000, abs=1e-9))
    for frame in flight.frames:
        assert frame.latitude == pytest.approx(47.3, abs=1e-9)
        assert frame.longitude == pytest.approx(10.2 + (frame.time or 0.0) / 10_000, abs=1e-4)
        assert (frame.height_above_takeoff, frame.heading, frame.pitch) == pytest.approx((76.19, 28.2, -90.0))
    assert not any("order of latitude" in note or "no position" in note for note in flight.notes)


def test_commas_count_for_the_file_as_a_whole() -> None:
    # The second entry alone could be two whole numbers and a height; the first one shows that commas are decimal.
    found = parse_subtitles(blocks_of(srt("GPS(8,501, 47,301, 16)", "GPS(8,502,47,302,16)")), "a.SRT")
    assert [(entry.latitude, entry.longitude) for entry in found.entries] == [(47.301, 8.501), (47.302, 8.502)]
    assert any("count as decimal commas" in note for note in found.notes)
    # Where positions have points, a comma before three digits groups thousands.
    grouped = one("[latitude: 47.301] [longitude: 8.501] [rel_alt: 12,5 abs_alt: 1,234]")
    assert (grouped.latitude, grouped.height_above_takeoff, grouped.altitude) == (47.301, 12.5, 1234.0)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("Signal:4 CH:8 FlightTime:0 SBat:4.7V GBat:7.2V", "Signal:4 CH:8 FlightTime:0 SBat:4.7V GBat:7.2V"),
        ("Altitude high\n[latitude: 47,8.5]", "[latitude: 47,8.5]"),
        ("GPS(E: -117.5, N: 33.5, 4.0m)", "GPS(E: -117.5, N: 33.5, 4.0m)"),
        ("47.301234, 8.501234 15.1 V", "47.301234, 8.501234 15.1 V"),
    ],
)
def test_a_dialect_that_is_not_known_is_named_by_a_line_of_it(text: str, line: str) -> None:
    with pytest.raises(DataError, match=r"holds no telemetry of DJI or Autel") as error:
        one(text)
    assert f"one of its lines is {line!r}" in str(error.value)
    # With a height beside it the file is used, and the note has the line.
    found = parse_subtitles(blocks_of(srt(f"{text}\nH: 12.5m")), "a.SRT")
    assert found.entries[0].height_above_takeoff == 12.5
    assert found.notes == (f"1 of 1 entries of a.SRT have no position; one of its lines is {line!r}.",)


def test_subtitles_in_utf_16_are_read() -> None:
    data = srt(DIALECTS["mavic pro"][0]).decode().encode("utf-16")
    assert parse_subtitles(blocks_of(data), "a").entries[0].latitude == -20.2533


SAMPLES = Path(os.environ["LPN_FLIGHTS"]).parent / "srt" if "LPN_FLIGHTS" in os.environ else None


@pytest.mark.skipif(
    SAMPLES is None or not SAMPLES.is_dir(), reason="LPN_FLIGHTS does not name real flights with srt beside them"
)
def test_real_samples_are_read() -> None:
    assert SAMPLES is not None
    refused = set()
    for file in sorted(SAMPLES.glob("*.SRT")):
        try:
            found = read_subtitles(file)
        except DataError:
            refused.add(file.stem)
            continue
        assert any(entry.latitude is not None for entry in found.entries), file.stem
    assert refused == {"mavic_air", "broken_empty2"}


@pytest.mark.parametrize(
    ("text", "latitude", "longitude", "altitude", "takeoff"),
    [
        ("Home: lat: 47.3 lon: 8.5\nGPS (8.6, 47.4, 15)", 47.4, 8.6, None, None),
        ("[home latitude: 47.3] [home longitude: 8.5] [latitude: 47.4] [longitude: 8.6]", 47.4, 8.6, None, None),
        ("HOME(W: 70.5, S: 33.4) ISO:100\nGPS (W: 70.6 S: 33.5 812.5m)", -33.5, -70.6, 812.5, None),
        ("HOME(lat: 47.3, lon: 8.5)\nlat: 47.4 lon: 8.6", 47.4, 8.6, None, None),
        ("Pilot lat: 47.3 lon: 8.5 Drone lat: 47.4 lon: 8.6", 47.4, 8.6, None, None),
        ("Home N 47.3, E 8.5 N 47.4, E 8.6", 47.4, 8.6, None, None),
        ("HOME(W: 70.5, S: 33.4) ReH 40.0m\nGPS (N/A)", None, None, None, 40.0),
        ("GPS 15 47.3N 8.5E", 47.3, 8.5, None, None),
        ("RTK_GPS (W: 70.5, S: 33.4, 812.5m)", -33.4, -70.5, 812.5, None),
        ("RTK(FIXED) GPS(W: 70.5, S: 33.4, 812.5m) H 131.2 feet", -33.4, -70.5, 812.5, 39.98976),
        ("GPS: W 70.5°, S 33.4°, 812.5 m", -33.4, -70.5, 812.5, None),
    ],
)
def test_the_position_is_the_drone_s_and_no_other_s(
    text: str, latitude: float | None, longitude: float | None, altitude: float | None, takeoff: float | None
) -> None:
    content = "".join(f"{i}\n00:00:0{i},000 --> 00:00:0{i},900\n{text}\n\n" for i in (1, 2, 3))
    for entry in parse_subtitles(blocks_of(content.encode()), "a.SRT").entries:
        assert (entry.latitude, entry.longitude, entry.altitude) == (latitude, longitude, altitude)
        assert entry.height_above_takeoff == (None if takeoff is None else pytest.approx(takeoff))
