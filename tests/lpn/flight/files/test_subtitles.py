"""Every dialect of subtitles, in a few lines each, and values that they leave unknown."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lpn.core.errors import DataError
from lpn.flight.files.subtitles import GpsOrder, blocks_of, parse_subtitles, read_subtitles
from lpn.flight.files.telemetry import Log, Telemetry, TelemetryEntry
from tools.fixtures.videos import srt

BRACKETS = "[focal_len: 24.00] [latitude: 34.270373] [longitude: -84.176160] [rel_alt: 1.500 abs_alt: 302.208] [ct: 5]"
MAVIC_PRO = (
    "HOME(149.0251,-20.2532) 2017.08.05 14:11:51\nGPS(149.0251,-20.2533,16) BAROMETER:1.9\nISO:100 Shutter:60 EV:"
)


def parsed(text: str, order: GpsOrder | None = None) -> Log:
    return parse_subtitles(blocks_of(text.encode()), "a.SRT", order)


@pytest.mark.parametrize(
    ("pattern", "instead"),
    [(r"\n", "\r\n"), (r"\A", "\ufeff"), (r"\n\n", "\n"), (r"\s*\Z", ""), (r"(?m)^\d+\n", "")],
    ids=["crlf", "bom", "no blank lines", "no final line", "no index lines"],
)
def test_bytes_of_every_kind_are_read(pattern: str, instead: str) -> None:
    text = srt([MAVIC_PRO] * 3)
    assert parsed(re.sub(pattern, instead, text)) == parsed(text)


def test_entries_without_time_codes_have_their_clock() -> None:
    stamp = "2017.08.05 14:11:5{},393,525,393,525\n[latitude : -20.2533] [longtitude : 149.02{}]"
    found = parsed(re.sub(r".*-->.*\n", "", srt([stamp.format(i, i) for i in range(3)])))
    assert [entry.time for entry in found.entries] == pytest.approx([0, 1, 2], abs=1e-3)
    assert found.end == pytest.approx(2, abs=1e-3)


def test_a_file_may_mix_dialects() -> None:
    tuple_only = "GPS (-59.409424, -34.650200, 16), H 17.39m"
    named = "[latitude : -34.651180] [longtitude : -59.409483] [altitude: 120.098999]"
    found = parsed(srt([tuple_only, named]))
    places = [(entry.latitude, entry.longitude) for entry in found.entries]
    assert places == [(-34.6502, -59.409424), (-34.65118, -59.409483)]
    assert not found.notes


@pytest.mark.parametrize(
    ("text", "order", "place", "note"),
    [
        ("GPS (8.2090, 47.4692, 18), D 49.21m", None, (47.4692, 8.209), False),
        ("GPS (8.2090, 47.4692, 18), D 49.21m", "lat-lon", (8.209, 47.4692), False),
        ("GPS(36.6146,-6.1120,0.0M) BAROMETER:0.3M", None, (36.6146, -6.112), True),
        ("GPS(36.6146,-6.1120,0.0M) BAROMETER:0.3M", "lon-lat", (-6.112, 36.6146), False),
        ("GPS(47.4692, 121.5, 18)", None, (47.4692, 121.5), False),
        ("GPS(121.5, 47.4692, 0.0M)", None, (47.4692, 121.5), False),
    ],
)
def test_degrees_beyond_90_settle_the_order_or_else_the_third_value(
    text: str, order: GpsOrder | None, place: tuple[float, float], note: bool
) -> None:
    found = parsed(srt([text]), order)
    assert (found.entries[0].latitude, found.entries[0].longitude) == place
    assert any("give --gps-order lon-lat" in line for line in found.notes) == note


@given(st.integers(20, len(BRACKETS) - 1))
def test_a_number_that_the_end_cuts_off_is_not_used(length: int) -> None:
    whole = parsed(srt([BRACKETS])).entries[0]
    try:
        cut = parsed(srt([BRACKETS[:length]])).entries[0]
    except DataError:
        return
    for name in ("latitude", "longitude", "height_above_takeoff"):
        assert getattr(cut, name) in (None, getattr(whole, name))


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
    assert "latitude" not in telemetry.at(10.0)


def test_a_drone_that_hovers_does_not_creep_and_gaps_are_not_filled() -> None:
    places = [(float(i), 10.0, 179.999) for i in range(20)] + [(20.0, 10.001, -179.999), (60.0, 10.1, 0.0)]
    telemetry = Telemetry([TelemetryEntry(time, None, *place) for time, *place in places])
    assert telemetry.at(15.0)["latitude"] == 10.0
    middle = telemetry.at(19.5)
    assert middle["latitude"] == pytest.approx(10.0005)
    assert abs(middle["longitude"]) == pytest.approx(180.0)
    assert telemetry.at(40.0) == Telemetry([]).at(0.0) == {}


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


@pytest.mark.parametrize(
    "line",
    [
        "[iso : 100] [fnum : 280]",
        "Signal:4 CH:8 FlightTime:0 SBat:4.7V GBat:7.2V",
        "[latitude: 47,301] [longitude: 8,501]",
        "GPS (8,501, 47,301, 16)",
        "GPS(E: -117.5, N: 33.5, 4.0m)",
        "47.301234, 8.501234 15.1 V",
    ],
)
def test_a_dialect_that_is_not_known_is_named_by_a_line_of_it(line: str) -> None:
    text = f"2018-02-19 08:04:51,265,847\nAltitude high\n{line}"
    with pytest.raises(DataError, match=r"holds no telemetry of DJI or Autel") as error:
        parsed(srt([text]))
    assert f"one of its lines is {line!r}" in str(error.value)
    # With a height beside it the file is used, and the note has the line.
    found = parsed(srt([f"{text}\nH: 12.5m"]))
    assert found.entries[0].height_above_takeoff == 12.5
    assert found.notes == (f"1 of 1 entries of a.SRT have no position; one of its lines is {line!r}.",)
