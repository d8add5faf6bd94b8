"""Every dialect of DJI's subtitles, in a few lines each, and what cannot be known from them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from lpn.core.errors import DataError
from lpn.flights.subtitles import GpsOrder, blocks_of, parse_subtitles, read_subtitles
from lpn.flights.telemetry import Telemetry, TelemetryEntry

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


@pytest.mark.parametrize("spoil", ["crlf", "bom", "no blank lines", "no final line"])
def test_bytes_of_every_kind_are_read(spoil: str) -> None:
    data = srt(DIALECTS["mavic pro"][0], DIALECTS["mavic pro"][0], DIALECTS["mavic pro"][0])
    changed = {
        "crlf": data.replace(b"\n", b"\r\n"),
        "bom": b"\xef\xbb\xbf" + data,
        "no blank lines": data.replace(b"\n\n", b"\n"),
        "no final line": data.rstrip(),
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


@pytest.mark.parametrize("length", range(20, len(BRACKETS)))
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
    with pytest.raises(DataError, match="of which every 5 m is too many pictures"):
        Telemetry(far).times_by_distance(5.0)


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
