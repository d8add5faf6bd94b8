"""A drawn flight in progress over a drawn map, and a simulated vehicle over loopback MAVLink."""

from __future__ import annotations

import json
import math
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace as replace_record
from PIL import ExifTags

import lpn.flight.live.frames
import lpn.flight.live.locator
import lpn.flight.live.run
import lpn.flight.locate.registered_stage
from lpn.cli.main import main
from lpn.core.errors import DataError, InputError
from lpn.flight.files import Flight, Frame
from lpn.flight.live.frames import (
    ArrivedPicture,
    LiveSource,
    Say,
    folder_pictures,
    open_source,
    shown_name,
    stream_pictures,
)
from lpn.flight.live.locator import LiveLocator
from lpn.flight.live.run import live_answer, locate_live
from lpn.flight.live.telemetry import LiveTelemetry, LogTelemetry, MavlinkLink, open_telemetry
from lpn.flight.locate.agreement import MapAgreement
from lpn.flight.locate.camera_place import below_camera
from lpn.flight.locate.located import LocatedFlight, StageRecord
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.registered_stage import PhotoSearch
from lpn.flight.locate.tracks import best_track, track_bytes
from lpn.flight.maps import Map
from tests.conftest import Refused
from tests.lpn.flight.locate.scenery import GridModel, ground_to_photo, photographed
from tools.fixtures.photos import exif, photo_bytes, write_photo
from tools.fixtures.simulated_vehicle import SimulatedVehicle
from tools.fixtures.videos import srt, turn, write_video
from tools.fixtures.waiting import TIMEOUT, wait_until

SIZE, HEIGHT, FOV = (360, 270), 60.0, 60.0
WIDTH = 2 * HEIGHT * math.tan(math.radians(FOV / 2))
# To the east through the map's middle.
PLACES = [(x, 5.0) for x in (-50.0, -35.0, -20.0, -5.0, 10.0, 25.0)]
OPTIONS = LocateOptions(matcher="sift")
# Registrations of frames by name, which replace matching: place and turn, or None for a refusal.
Laid = dict[str, tuple[float, ...] | None]


@pytest.fixture(scope="module")
def flight(town: Map, tmp_path_factory: pytest.TempPathFactory) -> Flight:
    folder = tmp_path_factory.mktemp("photos")
    return photographed(folder, town, PLACES, 90.0, SIZE, WIDTH, FOV, step=1.5, pitch=-90.0, roll=0.0)


@pytest.fixture(scope="module")
def described(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(tmp_path_factory.mktemp("described"))


@pytest.fixture(autouse=True)
def _one_cache(described: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let all tests describe the map's windows once."""
    monkeypatch.setenv("LPN_CACHE", described)


def free_port(kind: int = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class StepByStep(LiveSource):
    """A source that gives each frame after the last one was taken."""

    def __init__(self, frames: list[Frame]) -> None:
        super().__init__(lambda _: (ArrivedPicture(frame, time.monotonic()) for frame in self._next()), print)
        self._frames = frames

    def _next(self) -> Iterator[Frame]:
        for frame in self._frames:
            wait_until(lambda: self._stop.is_set() or self._waiting is None)
            yield frame


def locator_of(basemap: Map, options: LocateOptions = OPTIONS, say: Say = print) -> LiveLocator:
    return LiveLocator(basemap, GridModel(), options, say=say)  # type: ignore[arg-type]


def lines_of(
    town: Map, frames: list[Frame], options: LocateOptions = OPTIONS
) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the properties of the lines of a run, and its sentences."""
    said: list[str] = []
    lines: list[str] = []
    locator = locator_of(town, options, said.append)
    locator.prepare([44.0])
    outputs = [lambda fix: lines.append(fix.line())]
    count = locate_live(StepByStep(frames), LiveTelemetry(), locator, outputs, said.append)
    features = [json.loads(line) for line in lines]
    assert len(features) == count
    return [feature["properties"] | {"geometry": feature["geometry"]} for feature in features], said


def registered(town: Map, frames: list[Frame]) -> list[bool]:
    """Tell for each line of a run whether its place is an accepted registration's."""
    lines, _ = lines_of(town, frames)
    return [line["stage"] == "registration" and line["state"] == "accepted" for line in lines]


def test_a_newer_picture_replaces_the_one_that_waits() -> None:
    frames, last = [Frame(str(i), Path(), 1, 1) for i in range(4)], threading.Event()

    def read(_: threading.Event) -> Iterator[ArrivedPicture]:
        yield from (ArrivedPicture(frame, 0.0) for frame in frames[:3])
        assert last.wait(TIMEOUT)
        yield ArrivedPicture(frames[3], 0.0)

    source = LiveSource(read, print)
    source.start()
    wait_until(lambda: source.dropped == 2)
    assert source.take(0).frame.name == "2"
    assert not source.replaced()
    last.set()
    wait_until(source.replaced)
    assert source.dropped == 3
    assert source.take(0).frame.name == "3"
    assert source.take(TIMEOUT) is None
    assert source.ended


@pytest.fixture
def laid(monkeypatch: pytest.MonkeyPatch) -> Laid:
    places: Laid = {f"{i}.png": (*place, 0.0) for i, place in enumerate(PLACES)}
    width = 50.0  # neighbours are 0.3 of it apart, so they are separate views

    def register(search: PhotoSearch) -> StageRecord:
        if (place := places.get(search.located.frame.name)) is None:
            return StageRecord("refused", "It fits nowhere.")
        x, y, turn = place
        matrix = np.linalg.inv(ground_to_photo((x, y), 90.0 + turn, width, SIZE)).ravel().tolist()
        return StageRecord("accepted", "It fits.", x, y, True, 1.0, 90.0 + turn, turn, width, 50, matrix)

    monkeypatch.setattr(lpn.flight.live.locator, "register_photo", register)
    return places


def test_frames_are_registered_near_the_prediction_while_the_flight_goes_on(town: Map, flight: Flight) -> None:
    lines, said = lines_of(town, list(flight.frames[:2]))
    assert [(line["stage"], line["state"]) for line in lines] == [("registration", "accepted")] * 2
    assert max(line["error"] for line in lines) < 0.5
    assert all(line["geometry"]["type"] == "Point" and line["age"] >= 0 and line["dropped"] == 0 for line in lines)
    assert said == []


@pytest.mark.parametrize(("metres", "state", "doubt"), [(40.0, "contradicted", "tag"), (None, "accepted", "")])
def test_a_line_doubts_a_place_as_the_track_of_a_whole_flight_does(
    town: Map, flight: Flight, metres: float | None, state: str, doubt: str
) -> None:
    tag = [None, None] if metres is None else town.frame.degrees([(PLACES[0][0], PLACES[0][1] + metres)])[0].tolist()
    frame = replace(flight.frames[0], latitude=tag[0], longitude=tag[1])
    (line,), said = lines_of(town, [frame])
    locator = locator_of(town)
    locator.prepare([44.0])
    located = locator.locate(frame, ArrivedPicture(frame, 0).pixels())
    track = best_track(LocatedFlight(Flight("friday", (frame,)), town, [located], None, [], None))
    (point,) = (one["properties"] for one in json.loads(track_bytes(".geojson", "friday", track))["features"])
    names = ("frame", "stage", "state", "doubt", "checked_beside_middle", "reason", "note")
    assert {name: line[name] for name in names} == {name: point.get(name, "") for name in names}
    assert (line["stage"], line["state"], line["doubt"]) == ("registration", state, doubt)
    assert line["checked_beside_middle"] == "yes", "places away from the middle were looked for"
    assert line["reason"] == f"Placed by its details{', but its GPS tag disagrees' if doubt else ''}."
    assert said == []


def contradict(monkeypatch: pytest.MonkeyPatch, *places: tuple[float, float]) -> None:
    """Let the map contradict the registrations at these places, or all."""
    off = MapAgreement([(0.5, 0.5, 9.0, 9.0)] * 4, 20.0)
    plain = lpn.flight.live.locator.register_photo

    def register(search: PhotoSearch) -> StageRecord:
        answer = plain(search)
        is_off = answer.accepted and (not places or (answer.x, answer.y) in places)
        return replace_record(answer, agreement=off) if is_off else answer

    monkeypatch.setattr(lpn.flight.live.locator, "register_photo", register)


def test_places_that_the_map_contradicts_prove_nothing_and_lead_no_later_frame(
    town: Map, flight: Flight, laid: Laid, monkeypatch: pytest.MonkeyPatch
) -> None:
    registered = lpn.flight.live.locator.register_photo
    contradict(monkeypatch)
    unseen = [replace(flight.frames[-1], name=f"unseen {i}", time=9.0 + i) for i in range(2)]
    frames = [replace(frame, latitude=None, longitude=None) for frame in (*flight.frames, *unseen)]
    locator = locator_of(town)
    located = [locator.locate(frame, ArrivedPicture(frame, 0).pixels()) for frame in frames]
    answers = [live_answer(one) for one in located]
    assert [one.state for one in answers] == ["contradicted"] * 6 + ["refused"] * 2
    assert all(one.doubt == ["map"] for one in answers[:6])
    # They differ in place and turn from all accepted ones, and do not affect the next one.
    monkeypatch.setattr(lpn.flight.live.locator, "register_photo", registered)
    laid["there"] = (80.0, -80.0, 40.0)
    there = replace(frames[-1], name="there", time=10.5)
    assert live_answer(locator.locate(there, ArrivedPicture(there, 0).pixels())).state == "accepted"


@pytest.mark.parametrize(("metres", "refused"), [(60.0, 0), (60.0, 9), (0.0, 10)])
def test_ten_frames_in_a_row_without_a_certain_place_are_said_once(
    town: Map, flight: Flight, laid: Laid, metres: float, refused: int
) -> None:
    longitude = float(town.frame.degrees([(PLACES[0][0] + metres, PLACES[0][1])])[0, 1])
    frames = [replace(flight.frames[0], name=f"at {i}", time=1.0 + i, longitude=longitude) for i in range(10)]
    laid |= {frame.name: (*PLACES[0], 0.0) for frame in frames[refused:]}
    lines, said = lines_of(town, frames)
    assert [line["state"] for line in lines] == ["refused"] * refused + ["contradicted"] * (10 - refused)
    last = f"the last one says: {lines[-1]['reason']} {lines[-1]['note']}"
    if refused < 10:
        last = "its details place the last one; only its GPS tag disagrees, and may have drifted."
    assert said == [said[0]]
    assert said[0].startswith("10 frames in a row have no certain place")
    assert said[0].endswith(last)


def test_a_flight_that_leaves_the_map_is_said(town: Map, flight: Flight, laid: Laid) -> None:
    laid["0.png"] = (-70.0, 5.0, 0.0)
    beyond = [replace(flight.frames[0], name=f"sea {i}", time=1.0 + i) for i in range(10)]
    first = replace(flight.frames[0], latitude=None, longitude=None)
    lines, said = lines_of(town, [first, *beyond])
    assert [line["state"] for line in lines] == ["accepted"] + ["refused"] * 10
    assert len(said) == 1
    assert said[0].endswith("near the border of the map; the flight may have left it.")


def without_tags(flight: Flight) -> list[Frame]:
    return [replace(frame, latitude=None, longitude=None) for frame in flight.frames]


@pytest.mark.usefixtures("laid")
def test_registrations_prove_the_map(town: Map, flight: Flight) -> None:
    locator = locator_of(town)
    frames = without_tags(flight)
    states = [locator.locate(frame, ArrivedPicture(frame, 0).pixels()).stages["sequence"].state for frame in frames]
    assert states[:2] == ["refused"] * 2
    assert states[-2:] == ["accepted"] * 2
    unseen = replace(frames[-1], name="unregistered.png", time=9.0)
    answer = live_answer(locator.locate(unseen, ArrivedPicture(unseen, 0).pixels()))
    assert (answer.stage, answer.state) == ("sequence", "accepted")
    assert math.dist((answer.answer.x or 0.0, answer.answer.y or 0.0), PLACES[-1]) < 10
    (line,), _ = lines_of(town, [unseen])
    assert line["state"] == "refused"


def test_a_drone_that_hovers_proves_no_map(town: Map, flight: Flight, laid: Laid) -> None:
    laid |= dict.fromkeys(laid, (*PLACES[0], 0.0))
    locator = locator_of(town)
    photo = ArrivedPicture(flight.frames[0], 0).pixels()
    frames = [replace(without_tags(flight)[0], time=float(i)) for i in range(10)]
    assert not any(locator.locate(frame, photo).stages["sequence"].accepted for frame in frames)


def test_a_registration_that_the_drone_can_hardly_reach_is_refused_until_others_agree(
    town: Map, flight: Flight, laid: Laid
) -> None:
    jumps = {"2.png": (80.0, 80.0), "4.png": (20.0, -80.0), "5.png": (25.0, -80.0), "6.png": (30.0, -80.0)}
    laid |= {name: (*place, 0.0) for name, place in jumps.items()}
    lines, said = lines_of(town, [*flight.frames, replace(flight.frames[-1], name="6.png", time=9.0)])
    assert [line["stage"] == "registration" for line in lines] == [True, True, False, True, False, False, True]
    assert "can hardly have flown here" in lines[2]["note"]
    assert said == []


# Turns of the registrations before those of another turn.
USUAL = [0.0] * 6


def hovering(flight: Flight, laid: Laid, turns: Sequence[float]) -> list[Frame]:
    """Return frames at one place that are registered with these turns."""
    frames = [replace(flight.frames[-1], name=f"turned {i}", time=9.0 + i) for i in range(len(turns))]
    laid |= {frame.name: (*PLACES[-1], degrees) for frame, degrees in zip(frames, turns, strict=True)}
    return frames


def test_a_registration_that_is_turned_unlike_those_before_is_refused_until_ten_are(
    town: Map, flight: Flight, laid: Laid
) -> None:
    frames = hovering(flight, laid, [179.0, -179.0, 0.0, 180.0, -1.0, 1.0, *[-171.0] * 10])
    assert registered(town, frames) == [True] * 6 + [False] * 9 + [True]
    assert all(registered(town, [replace(frame, heading_source="aircraft") for frame in frames]))


CONTRADICTED = (20.0, 0.0)


@pytest.mark.parametrize("between", [None, (*PLACES[-1], 40.0), (*CONTRADICTED, -171.0)])
def test_photos_that_fit_nowhere_or_badly_and_one_of_yet_another_turn_begin_the_ten_anew(
    town: Map, flight: Flight, laid: Laid, between: tuple[float, ...] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    contradict(monkeypatch, CONTRADICTED)
    frames = hovering(flight, laid, [*USUAL, *[-171.0] * 16])
    laid[frames[11].name] = between
    assert registered(town, frames) == [True] * 6 + [False] * 15 + [True]


def test_turns_that_drift_make_no_new_heading(town: Map, flight: Flight, laid: Laid) -> None:
    turns = (10.0, 14.9, 21.9, 38.4, 74.9, 88.9, 88.9, 88.9, 88.9, 88.9)
    assert registered(town, hovering(flight, laid, [*USUAL, *turns])) == [True] * 6 + [False] * 10


def test_frames_that_cannot_be_read_and_clocks_that_jump_are_said_and_the_flight_goes_on(
    town: Map, flight: Flight, tmp_path: Path
) -> None:
    (tmp_path / "bad.png").write_bytes(b"no picture")
    first, second = flight.frames[:2]
    frames = [first, replace(first, name="bad.png", file=tmp_path / "bad.png"), replace(second, time=-500.0)]
    lines, said = lines_of(town, frames, options=replace(OPTIONS, register=False))
    assert [line["frame"] for line in lines] == ["0.png", "1.png"]
    assert said[0].endswith("The flight goes on without it.")
    assert said[1].startswith("The clock of the pictures has jumped by -500.0 s at 1.png;")


def test_memory_does_not_grow_with_the_flight(town: Map, flight: Flight, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lpn.flight.live.locator, "_KEPT", 30)
    monkeypatch.setattr(lpn.flight.live.locator, "_SCORED", 8)
    locator = locator_of(town, replace(OPTIONS, register=False))
    rng, photo = np.random.default_rng(0), np.zeros((*SIZE[::-1], 3), np.uint8)
    for i in range(60):
        photo[:] = np.kron(rng.integers(0, 255, (9, 12, 1), np.uint8), np.ones((30, 30, 3), np.uint8))
        locator.locate(replace(flight.frames[0], time=2.0 * i), photo)
    assert len(locator._kept) == 30
    assert len(locator._scored) == 8


def test_new_photos_below_a_folder_are_read_when_they_are_whole(tmp_path: Path) -> None:
    write_photo(tmp_path / "before.jpg")
    (tmp_path / "later.jpg").symlink_to(tmp_path / "elsewhere")  # there is no photo yet
    said: list[str] = []
    source = LiveSource(folder_pictures(tmp_path, said.append), said.append)
    whole = photo_bytes(exif(main={ExifTags.Base.Orientation: 6}))
    for name in ("inside/.hidden.jpg", "inside/notes.txt", ".trash/new.jpg"):
        write_photo(tmp_path / name)
    new = tmp_path / "inside" / "later" / "new.jpg"
    new.parent.mkdir()
    source.start()
    try:
        new.write_bytes(whole[: len(whole) // 2])
        assert source.take(0.15) is None
        new.write_bytes(whole)
        picture = source.take(TIMEOUT)
        assert source.take(3 * lpn.flight.live.frames._POLL) is None
        (tmp_path / "elsewhere").write_bytes(whole)
        assert source.take(TIMEOUT) is not None
    finally:
        source.close()
    assert (picture.frame.file, picture.turns) == (new, 1)
    assert picture.pixels().shape == (40, 30, 3)
    assert said == [f"Left out: 1 photo that {tmp_path.name} held before."]


def test_frames_of_a_video_have_their_times_and_its_turn(tmp_path: Path) -> None:
    video = turn(write_video(tmp_path / "v.mp4", 0.5), 1)
    said: list[str] = []
    pictures = list(stream_pictures(video, said.append, fov=70.0)(threading.Event()))
    assert [picture.frame.time for picture in pictures] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert {(one.frame.width, one.frame.height, one.frame.fov, one.turns) for one in pictures} == {(48, 64, 70.0, 1)}
    assert said == ["v.mp4 asks for a turn of 90°; the heading of its telemetry is turned equally."]


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("nowhere", "There is no nowhere; give a folder"),
        ("udp://127.0.0.1:1/?timeout=1000", "udp://127.0.0.1:1/ cannot be opened"),
        ("text.mp4", "text.mp4 cannot be opened as a video"),
        ("notes.txt", "is not a supported video"),
    ],
)
def test_a_source_that_cannot_be_opened_is_refused_in_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str, said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("text.mp4", "notes.txt"):
        Path(name).write_text("no video")
    with pytest.raises(InputError, match=said):
        open_source(source, print)


def test_a_source_is_shown_without_its_password() -> None:
    assert shown_name("rtsp://me:secret@cam:8554/drone?key=secret") == "rtsp://cam:8554/drone"


def arrived(frame: Frame, later: float = 0.0) -> ArrivedPicture:
    bare = replace(frame, heading=None, heading_source=None, latitude=None, longitude=None, height_above_ground=None)
    return ArrivedPicture(bare, time.monotonic() + later)


def test_a_link_gives_frames_heading_height_and_position_and_says_what_is_odd(flight: Flight) -> None:
    pytest.importorskip("pymavlink")
    said: list[str] = []
    port = free_port()
    link = MavlinkLink(f"udp:127.0.0.1:{port}", said.append)
    vehicle, other = SimulatedVehicle(port=port, system=7), SimulatedVehicle(port=port, system=9)
    frame = flight.frames[0]

    def told(sent: Frame, *names: str) -> Any:
        """Send a frame's telemetry until a picture has the named values."""

        def known() -> Frame | None:
            vehicle.tell(sent)  # repeated, because a position holds for only 2 s
            found = link.value(arrived(frame)).frame
            return found if all(getattr(found, name) is not None for name in names) else None

        return wait_until(known)

    try:
        assert link.value(arrived(frame)).age is None
        lost = replace(frame, latitude=None, longitude=None, heading_source="aircraft")
        found = told(lost, "heading", "height_above_takeoff")
        assert (found.heading, found.flying_height, found.latitude) == (pytest.approx(90), HEIGHT, None)
        assert link.vehicle.system == 7
        found = told(frame, "latitude")
        assert found.latitude == pytest.approx(frame.latitude, abs=1e-6)
        assert (found.heading, found.heading_source) == (pytest.approx(90), "gimbal")
        assert found.flying_height == HEIGHT
        kept = link.value(arrived(frame, 5.0)).frame
        assert (kept.heading, kept.latitude, kept.longitude, kept.flying_height) == (None, None, None, HEIGHT)
        assert link.value(arrived(frame, 50.0)).frame.flying_height is None
        other.tell(frame)
        wait_until(lambda: any("System 9" in sentence for sentence in said))
    finally:
        for one in (link, vehicle, other):
            one.close()
    assert said[0].startswith("No position has come by udp:127.0.0.1")
    late = next(sentence for sentence in said if "s late; frames have no heading" in sentence)
    assert float(late.split()[2]) > 4.8
    assert any(sentence.endswith("those of system 7 are taken.") for sentence in said)


def test_a_log_gives_frames_its_values_from_the_first_picture_on(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("time,latitude,longitude,heading\n" + "".join(f"{100 + i},47.{i},8.0,{10 * i}\n" for i in range(4)))
    said: list[str] = []
    telemetry = open_telemetry(str(log), said.append)
    assert isinstance(telemetry, LogTelemetry)
    latitudes = [telemetry.value(ArrivedPicture(Frame("a", Path(), 1, 1, at), 0.0)).frame.latitude for at in (5.0, 6.5)]
    assert latitudes == pytest.approx([47.0, 47.15])
    assert telemetry.value(ArrivedPicture(Frame("late", Path(), 1, 1, 99.0), 0.0)).age is None
    assert said == ["log.csv has nothing at the time of late; it may have ended."]
    (tmp_path / "empty.csv").write_text("time,latitude,longitude\n")
    with pytest.raises(DataError):
        open_telemetry(str(tmp_path / "empty.csv"), print)
    with pytest.raises(InputError, match="give a log, a track, or an address"):
        open_telemetry("nothing", print)


@pytest.mark.parametrize(
    ("name", "text", "fov"),
    [
        ("v.srt", srt(["[latitude: 47.0] [longitude: 8.0] [gb_yaw: 40.0 gb_pitch: -90.0] [focal_len: 24.00]"]), 56.81),
        ("v.csv", "time,lat,lon,gimbal_yaw,gimbal_pitch,hfov\n0,47,8,40,-90,45\n", 34.51),
    ],
)
def test_telemetry_turns_with_the_picture(tmp_path: Path, name: str, text: str, fov: float) -> None:
    (tmp_path / name).write_text(text)
    picture = ArrivedPicture(Frame("a", Path(), 48, 64, 0.0), 0.0, turns=1)
    frame = open_telemetry(str(tmp_path / name), print).value(picture).frame
    assert (frame.heading, frame.fov) == (pytest.approx(310.0), pytest.approx(fov, abs=0.01))


def test_the_command_locates_what_a_vehicle_sends(
    town: Map, flight: Flight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pymavlink")
    monkeypatch.setattr(lpn, "load", lambda *_, **__: GridModel())
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "cache"))
    photos, out, port = tmp_path / "photos", tmp_path / "lines.jsonl", free_port()
    photos.mkdir()
    vehicle, started, start = SimulatedVehicle(photos, port), threading.Event(), LiveSource.start
    monkeypatch.setattr(LiveSource, "start", lambda source: (start(source), started.set()))
    skipped = [0.0]  # seconds by which the run's clock jumps, so that only the wait after the last frame is long
    clock = SimpleNamespace(time=time.time, monotonic=lambda: time.monotonic() + skipped[0])
    monkeypatch.setattr(lpn.flight.live.run, "time", clock)

    def answered(frame: Frame, lines: int) -> bool:
        vehicle.tell(frame)  # repeated, because a busy machine may find the photo seconds later
        return out.read_text().count("\n") >= lines

    def fly() -> None:
        assert started.wait(TIMEOUT)
        for i, frame in enumerate(flight.frames[:3]):
            vehicle.tell(frame)
            time.sleep(0.15)  # the telemetry of this frame is the nearest one
            vehicle.photograph(frame)
            wait_until(lambda frame=frame, lines=i + 1: answered(frame, lines))
        skipped[0] = 1000.0

    thread = threading.Thread(target=fly)
    thread.start()
    command = ["locate", "--live", str(photos), "--map", str(town.sheets[0].raster.path), "--model", "grid.onnx"]
    command += ["--telemetry", f"udp:127.0.0.1:{port}", "--out", str(out), "--no-register"]
    assert main([*command, "--size", "44", "--idle", "900"]) == 0
    thread.join()
    vehicle.close()
    lines = [json.loads(line)["properties"] for line in out.read_text().splitlines()]
    assert [line["frame"] for line in lines] == ["0.png", "1.png", "2.png"]
    assert all(line["telemetry_age"] < 2 for line in lines)
    said = capsys.readouterr().err
    assert "windows of the map are described. This is done once" in said
    assert "Located 3 frames." in said


def test_a_field_of_view_that_cannot_be_is_refused(tmp_path: Path, refused: Refused) -> None:
    said = refused("locate", "--live", tmp_path, "--map", "town.tif", "--model", "grid.onnx", "--fov", 500)
    assert "--fov is 500; expected a number from 0.1 to 170." in said


def test_an_answer_is_moved_below_a_camera_of_known_tilt(flight: Flight) -> None:
    frame = replace(flight.frames[0], pitch=-45.0, roll=0.0, height_above_ground=100.0)
    middle = StageRecord("accepted", "", 140.0, 20.0, radius=3.0, heading=90.0)
    below = below_camera(frame, middle)
    assert (below.x, below.y, below.camera) == (pytest.approx(40), pytest.approx(20), True)
    degree, tenth = math.radians(1), 10.0
    assert below.radius == pytest.approx(math.hypot(3, 2 * 100 * 1.5 * degree, 100 * 5 * degree, tenth))
    turned = below_camera(frame, replace_record(middle, heading=270.0, turn=180.0))
    assert (turned.x, turned.y) == (pytest.approx(40), pytest.approx(20))
    # Here the file's heading is wrong, and the photo is as it was taken.
    wrong = below_camera(frame, replace_record(middle, turn=100.0))
    assert (wrong.x, wrong.y) == (below.x, below.y)
    for unknown in ({"pitch": None}, {"pitch": -20.0}, {"height_above_ground": None}):
        assert below_camera(replace(frame, **unknown), middle) is middle
    assert below_camera(frame, below) is below
