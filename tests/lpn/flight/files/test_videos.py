"""The chosen frames of a small video, their telemetry from subtitles, and every dialect of these."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lpn.core.errors import DataError
from lpn.core.images import load_picture
from lpn.core.progress import listening
from lpn.flight.files import FlightOptions, make_flight, open_flight
from lpn.flight.files.subtitles import GpsOrder, blocks_of, parse_subtitles, read_subtitles
from lpn.flight.files.telemetry import Log, Telemetry, TelemetryEntry
from tools.fixtures.videos import embed, srt, turn, write_video

# 11.13 m to the north each second.
TELEMETRY = [
    f"[latitude: {47 + i / 10_000:.6f}] [longitude: 8.000000] [rel_alt: {50 + i}.0 abs_alt: 450.0]" for i in range(6)
]


def second(file: Path) -> int:
    """The second of the video that a frame shows, by its brightness."""
    return round((float(np.mean(load_picture(file))) - 60) / 20)


def test_the_sharpest_picture_of_each_second_is_taken(tmp_path: Path) -> None:
    write_video(tmp_path / "DJI_1.mp4", 5, frozenset({3, 17, 21, 38}))
    (tmp_path / "DJI_1.SRT").write_text(srt(TELEMETRY))
    flight = make_flight([tmp_path / "DJI_1.mp4"], tmp_path / "flight")
    # In the last second no picture is sharp.
    assert [frame.time for frame in flight.frames][:4] == pytest.approx([0.3, 1.7, 2.1, 3.8])
    assert [second(frame.file) for frame in flight.frames] == [0, 1, 2, 3, 4]
    first = flight.frames[1]
    assert first.latitude == pytest.approx(47 + (first.time or 0) / 10_000)
    assert first.height_above_takeoff == pytest.approx(50 + (first.time or 0))
    assert (first.width, first.height, first.heading_source) == (64, 48, "course")
    assert first.heading == pytest.approx(0.0, abs=1e-6)
    assert open_flight(tmp_path / "flight") == flight


def test_frames_are_chosen_by_seconds_or_by_metres(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4", 6)
    (tmp_path / "a.srt").write_text(srt(TELEMETRY))
    slow = make_flight([video], tmp_path / "slow", FlightOptions(every=2.5))
    assert [2 * (frame.time or 0) // 5 for frame in slow.frames] == [0, 1, 2]
    assert all((frame.time or 0) % 2.5 < 1 for frame in slow.frames)
    quick = make_flight([video], tmp_path / "quick", FlightOptions(every=0.2))
    assert [frame.time for frame in quick.frames] == pytest.approx(np.arange(0, 6, 0.2), abs=0.11)
    far = make_flight([video], tmp_path / "far", FlightOptions(every_metres=22.3))
    marks = [(frame.time or 0) - i * 22.3 / 11.12 for i, frame in enumerate(far.frames)]
    assert len(marks) == 3
    assert all(-0.01 <= mark <= 1.01 for mark in marks)


DOUBT = " If the gimbal itself turned the camera, the heading, which is that of the aircraft, is off by as much."


@pytest.mark.parametrize(
    ("turns", "angles", "heading", "fov", "told"),
    [
        (0, "[gb_yaw: 40.0 gb_pitch: -90.0] [focal_len: 24.00]", 40.0, 71.59, None),
        (1, "[gb_yaw: 40.0 gb_pitch: -90.0] [focal_len: 24.00]", 310.0, 56.81, ", and its heading with it."),
        (1, "", None, None, "."),
        (1, "F.PRY (0.0°, 0.0°, 40.0°)", 310.0, None, f", and its heading with it.{DOUBT}"),
    ],
)
def test_a_video_that_its_file_turns_has_its_heading_and_field_of_view_turned(
    tmp_path: Path, turns: int, angles: str, heading: float | None, fov: float | None, told: str | None
) -> None:
    video = turn(write_video(tmp_path / "a.mp4", 2), turns)
    (tmp_path / "a.srt").write_text(srt([f"{TELEMETRY[0]} {angles}"] * 2))
    flight = make_flight([video], tmp_path / "flight")
    frame = flight.frames[0]
    assert (frame.width, frame.height) == ((48, 64) if turns % 2 else (64, 48))
    assert (frame.heading, frame.fov) == (pytest.approx(heading), pytest.approx(fov, abs=0.01))
    notes = [] if told is None else [f"a.mp4 is turned by {90 * turns}° by its file{told}"]
    assert [note for note in flight.notes if "turned" in note] == notes


def test_a_log_s_field_of_view_is_that_across_the_picture_s_width(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4", 2, size=(48, 64))
    (tmp_path / "log.csv").write_text("time,lat,lon,hfov\n0,47,8,45\n2,47,8,45\n")
    assert make_flight([video, tmp_path / "log.csv"], tmp_path / "flight").frames[0].fov == pytest.approx(45.0)


@pytest.mark.parametrize(
    ("text", "latitude", "note"),
    [
        ("HOME(E: 8.5, N: 47.3)\nGPS(E: 8.501, N: 47.301, 574.2m)", 47.301, None),
        ("GPS(E: 8.501, N: 47.301, 574.2m)", 47.301, None),
        ("Bat 15.1 V", None, "the subtitle stream of inside.mp4 holds no telemetry"),
    ],
)
def test_subtitles_inside_are_read_in_every_dialect_or_named(
    tmp_path: Path, text: str, latitude: float | None, note: str | None
) -> None:
    video = embed(write_video(tmp_path / "plain.mp4", 2), [text] * 2, tmp_path / "inside.mp4")
    flight = make_flight([video], tmp_path / "flight")
    assert flight.frames[0].latitude == latitude
    assert note is None or any(one.startswith(note) and f"one of its lines is {text!r}" in one for one in flight.notes)


def test_without_telemetry_frames_have_times_only(tmp_path: Path) -> None:
    options, video = FlightOptions(fov=70.0, pitch=-90.0), write_video(tmp_path / "a.mp4", 2)
    flight = make_flight([video], tmp_path / "flight", options)
    told = [(frame.latitude, frame.heading, frame.fov, frame.pitch) for frame in flight.frames]
    assert told == [(None, None, 70.0, -90.0)] * 2
    assert "a.mp4 has no subtitles with telemetry." in flight.notes
    assert any("The field of view of 2 of 2 photos is the 70° given with --fov" in note for note in flight.notes)
    with pytest.raises(DataError, match=r"a\.mp4 has no positions, so frames cannot be chosen by metres"):
        make_flight([tmp_path / "a.mp4"], tmp_path / "other", FlightOptions(every_metres=5.0))
    assert not (tmp_path / "other").exists()


def test_subtitles_of_another_video_are_told(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", 2)
    (tmp_path / "other.SRT").write_text(srt(TELEMETRY * 3))
    flight = make_flight([tmp_path / "a.mp4", tmp_path / "other.SRT"], tmp_path / "flight")
    note = next(note for note in flight.notes if "recordings" in note)
    assert note.startswith("other.SRT ends at 18 s and a.mp4 at 2 s")
    (tmp_path / "a.SRT").write_text("1\n00:00:00,000 --> 00:00:01,000\nHello\n")
    flight = make_flight([tmp_path / "a.mp4"], tmp_path / "flight")
    assert any(note.startswith("a.SRT holds no telemetry of DJI") for note in flight.notes)
    assert len(flight.frames) == 2


def test_several_videos_are_on_one_clock(tmp_path: Path) -> None:
    for name, start in (("b", "14:00:00"), ("a", "14:01:00")):
        write_video(tmp_path / f"{name}.mp4", 1)
        (tmp_path / f"{name}.SRT").write_text(srt([f"2024-05-01 {start}.000\n{TELEMETRY[0]}"]))
    heard: list[tuple[str, int, int]] = []
    with listening(lambda *told: heard.append(told)):
        flight = make_flight([tmp_path], tmp_path / "flight")
    a, b = (("Reading a.mp4, frame", 10, 10), ("Reading b.mp4, frame", 10, 10))
    assert heard == [a, ("Reading videos", 1, 2), b, ("Reading videos", 2, 2)]
    assert [(frame.name[0], (frame.time or 0) >= 60) for frame in flight.frames] == [("b", False), ("a", True)]
    (tmp_path / "a.SRT").unlink()
    flight = make_flight([tmp_path / "a.mp4", tmp_path / "b.mp4"], tmp_path / "flight")
    assert [(frame.name[0], 1 <= (frame.time or 0) < 2) for frame in flight.frames] == [("a", False), ("b", True)]
    assert any("Not all of the 2 videos have a start time" in note for note in flight.notes)


def test_broken_videos_are_left_out_and_named(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", 1)
    (tmp_path / "b.mp4").write_bytes((tmp_path / "a.mp4").read_bytes()[:400])
    flight = make_flight([tmp_path / "a.mp4", tmp_path / "b.mp4"], tmp_path / "flight")
    assert len(flight.frames) == 1
    assert any(note.startswith("1 of 2 videos are left out: b.mp4 is not a video") for note in flight.notes)
    with pytest.raises(DataError, match=r"No video of 1 can be read\. b\.mp4 is not a video that can be read"):
        make_flight([tmp_path / "b.mp4"], tmp_path / "none")


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
