"""What the flight panel's script draws, and the sentences beside it."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

from explorer.flight import lines, page, part, text
from explorer.flight.own import own_photo
from explorer.flight.service import FlightSnapshot
from explorer.parameters import UnusableError
from lpn.core.arrays import UInt8Array
from lpn.flight.locate.agreement import MapAgreement, MatchedDetails
from lpn.flight.locate.audit import TagAudit
from lpn.flight.locate.camera_pose import CameraPose
from lpn.flight.locate.located import LocatedFlight, LocatedFrame, StageRecord
from lpn.flight.locate.own_photo import OwnPhoto
from lpn.flight.maps import open_map
from lpn.library.analyser import OwnPicture
from tests.explorer.flight.conftest import SIZE, registered
from tests.lpn.flight.maps.small_maps import EAST, NORTH, smooth, write_geotiff

ADDRESSES = {"tiles": ["t/"], "photo": "p/", "square": "s/", "ground": "g/"}


def with_answer(flight: LocatedFlight, frame: int, stage: str = "registration", **changes: Any) -> LocatedFlight:
    """Return a flight whose answer of a stage for a frame is changed."""
    frames = list(flight.frames)
    stages = frames[frame].stages
    frames[frame] = replace(frames[frame], stages=stages | {stage: msgspec.structs.replace(stages[stage], **changes)})
    return replace(flight, frames=frames)


def compared(flight: LocatedFlight, frame: int, *metres: float) -> LocatedFlight:
    """Return a flight with a frame whose places away from the middle lie some metres from where the map has them."""
    places = [(0.5, 0.5), (0.1, 0.2), (0.5, 0.9)]
    rows = [(*place, 0.0, north) for place, north in zip(places, metres, strict=False)]
    return with_answer(flight, frame, agreement=MapAgreement(rows, 9.0))


@pytest.fixture
def seen(flight: LocatedFlight) -> FlightSnapshot:
    return FlightSnapshot(flight)


def test_the_script_gets_every_track_and_what_is_unknown_as_null(seen: FlightSnapshot) -> None:
    data = json.loads(json.dumps(page.data(seen, ADDRESSES), allow_nan=False))
    assert list(data["tracks"]) == ["tag", "retrieval", "sequence", "registration"]
    track = data["tracks"]["registration"]
    assert (track["x"], track["state"], track["radius"]) == ([-20.0, 45.0, None], [0, 0, 2], [1.0, 1.0, None])
    assert data["tracks"]["retrieval"]["state"] == [1, 1, 1]
    assert (data["times"], data["errors"], data["off"]) == ([0.0, 2.0, 4.0], [1.0, 45.0, 5.0], "m from its GPS tag")
    # The first frame is registered, the second contradicts its tag, and only neighbours tell the third.
    assert (data["states"], data["marks"]) == (["right", "contradicted", "unknown"], ["✓", "?", "?"])
    assert [one[4] for one in data["outlines"]] == [True, True, False]
    assert data["outlines"][0][0] == pytest.approx([-40.0, 16.0])
    assert (data["main"], data["sheets"]) == ("registration", [])
    assert data["counts"] == "3 photos: 1 placed, 1 in doubt, 1 not placed."
    assert data["doubtful"] == [
        [1, "contradicted", "Registration and tag lie 45.0 m apart; their radii allow 15.3 m."],
        [2, "unknown", "Only <i>4</i> matches agree."],
    ]
    assert data["notes"][:2] == ["Said.", "A note."]


def test_tags_far_off_the_map_are_told(flight: LocatedFlight) -> None:
    away = page.data(FlightSnapshot(replace(flight, tags_away=5200.0)), ADDRESSES)["counts"]
    assert "GPS tags lie 5,200 m from this map: give the map of the tags' place, unless the tags are wrong." in away


def test_where_tags_lag_the_figures_are_those_without_the_lag(flight: LocatedFlight) -> None:
    moved = np.array([(-20.0, 0.5), (44.0, 0.0), (np.nan, np.nan)])
    late = replace(flight, audit=TagAudit(8, 4.0, 9.0, 1.9, 0.1, 0.5, 0.2, 3.0), tags_without_lag=moved)
    data = page.data(FlightSnapshot(late), ADDRESSES)
    assert (data["errors"], data["off"]) == ([0.5, 1.0, None], "m from its GPS tag without the lag")
    name, figure, source = data["accuracy"][2]
    assert (name, figure) == ("GPS tags without their lag of 1.9 s", "0.8 m")
    assert source == "Median of 2 photos, at most 1.0 m. With it 5.0 m."
    assert page.card(FlightSnapshot(late), 1)["facts"][2] == "1.0 m from its GPS tag without the lag"


def test_frames_that_wait_for_their_registration_are_neither_accepted_nor_refused(flight: LocatedFlight) -> None:
    stages = {name: answer for name, answer in flight.frames[2].stages.items() if name != "registration"}
    waiting = replace(flight, frames=[*flight.frames[:2], replace(flight.frames[2], stages=stages)])
    assert page.data(FlightSnapshot(waiting), ADDRESSES)["tracks"]["registration"]["state"] == [0, 0, -1]


def test_several_sheets_have_a_colour_each(flight: LocatedFlight, tmp_path: Path) -> None:
    for i in range(2):
        write_geotiff(tmp_path / f"sheet{i}.tif", smooth(40, 200, i), matrix=(0.5, 0, EAST + 150 * i, 0, -0.5, NORTH))
    sheets = page.data(FlightSnapshot(replace(flight, basemap=open_map(tmp_path))), ADDRESSES)["sheets"]
    assert sorted(sheet["name"] for sheet in sheets) == ["sheet0.tif", "sheet1.tif"]
    assert len({sheet["colour"] for sheet in sheets}) == 2


def test_a_card_has_verdict_place_and_grounds(seen: FlightSnapshot) -> None:
    cards = [page.chosen(seen, frame, ADDRESSES)["card"] for frame in range(3)]
    states = [("✓", "right", "registration"), ("?", "contradicted", "registration"), ("?", "unknown", "sequence")]
    assert [(card["mark"], card["state"], card["stage"]) for card in cards] == states
    assert cards[0]["headline"] == "Placed by its details, ± 1.0 m on this map"
    assert cards[0]["facts"] == ["1 of 3", "30 m high", "1.0 m from its GPS tag"]
    assert cards[0]["what"] == "Below the drone"
    assert cards[0]["at"].startswith("47.")
    assert cards[0]["link"].startswith("https://www.openstreetmap.org/?mlat=47.")
    assert cards[0]["lines"] == ["40 matches agree."]
    assert "45.0 m apart" in cards[1]["lines"][0]
    assert cards[2]["lines"] == ["Only <i>4</i> matches agree."]


@pytest.mark.parametrize(
    ("metres", "radius", "said"),
    [
        ((0.4, 5.2, 1), 1.0, "Checked at 3 places: 1.0 m off in the median, the largest 5.2 m; 3.0 m are allowed."),
        ((0.4, 8.9, 1), 1.01, "1.0 m off in the median, the largest 8.9 m or more; 3.1 m are allowed."),
        ((0.4, 5.2), 1.0, "Not checked: away from its middle, only 2 places of the photo could be found on the map."),
    ],
)
def test_places_beside_the_middle_say_how_far_off_they_are(
    flight: LocatedFlight, metres: tuple[float, ...], radius: float, said: str
) -> None:
    one = FlightSnapshot(with_answer(compared(flight, 0, *metres), 0, radius=radius))
    assert page.card(one, 0)["lines"][1].endswith(said)


def test_a_photo_that_does_not_fit_beside_its_middle_is_in_doubt(flight: LocatedFlight) -> None:
    one = FlightSnapshot(compared(flight, 0, 4.0, 8.2, 3.2))
    assert [entry[0] for entry in page.data(one, ADDRESSES)["doubtful"]] == [0, 1, 2]
    assert page.card(one, 0)["headline"].endswith("it does not fit the map")
    assert page.card(FlightSnapshot(compared(flight, 0, 0.4)), 0)["headline"].endswith(", at least its middle")


def test_accuracy_has_three_rows_with_their_sources(flight: LocatedFlight, monkeypatch: pytest.MonkeyPatch) -> None:
    def rows(**changes: Any) -> dict[str, tuple[str, str]]:
        accuracy = text.accuracy(FlightSnapshot(replace(flight, **changes)))
        return {name: (figure, source) for name, figure, source in accuracy}

    known = rows(map_error=0.8)
    assert list(known) == ["On this map", "On Earth", "GPS tags"]
    assert known["On this map"][0] == "± 1.0 m"
    assert "GPS tags do not confirm it: 50 % lie within 3 radii, where 99 % should" in known["On this map"][1]
    assert known["GPS tags"] == ("5.0 m", "Median of 3 photos, at most 45.0 m.")
    surveyed = rows(map_error=0.02, place_error=0.02)
    assert surveyed["On Earth"] == ("± 0.02 m", "The error that lpn map --error states.")
    assert rows(frames=[replace(frame, stages={}) for frame in flight.frames]) == {}
    note = "The map is made of 30 photos. Place and scale are those of the GPS tags, which lie 13.2 m from the photos."
    monkeypatch.setattr(type(flight.basemap), "notes", [note])
    assert rows()["On Earth"] == ("", note.partition(". ")[2])


def test_the_drone_has_a_place_and_a_tilt(flight: LocatedFlight) -> None:
    covariance = np.diag([1.0, 1.0, 4.0, 1.0, 4.0, 4.0]).ravel().tolist()
    pose = CameraPose(1.0, 2.0, 40.0, 40.0, 180.0, -93.0, 4.0, 70.0, True, 40, covariance)

    def drone(**changes: Any) -> str:
        return text.drone(flight, with_answer(flight, 0, pose=pose, **changes).frames[0])

    said = drone(camera=False)
    assert "(± 1.0 m on this map), 40 m above the ground (± 2 m)" in said
    # 3 degrees to the back and 4 to the side.
    assert said.endswith("its camera 5.0° (± 2.0°) from straight down.")
    # The pose is 1 m off on the map, whose own error is 2.4 m.
    assert "(± 2.6 m on earth)" in drone(camera=False, map_error=2.4, place_error=2.0)
    assert drone(x=1.0, y=2.0).startswith("The drone: 40 m above the ground")
    assert text.drone(flight, flight.frames[0]) == ""


def test_scores_are_painted_whole_or_by_a_part_where_windows_are_ranked(seen: FlightSnapshot) -> None:
    values = np.linspace(0.2, 0.8, 15).astype(np.float32)
    order = np.arange(15)
    ranking: Any = SimpleNamespace(scores=values, cosines=np.column_stack([values, values[::-1]]), order=order)
    names = ["centre", "outer"]
    assert page.painting(seen, ranking, "off", names) is None
    whole, outer = (page.painting(seen, ranking, painted, names) for painted in ("all", "1"))
    assert (whole["label"], outer["label"]) == ("0.20 to 0.80, score", "0.20 to 0.80, cosine of outer")
    # Windows lie 30 m apart: five columns and three rows of cells.
    assert whole["bounds"] == [-75.0, -45.0, 75.0, 45.0]
    cells = [_decoded(one["picture"]) for one in (whole, outer)]
    assert cells[0].shape == (3, 5, 4)
    assert (cells[0] == cells[1][::-1, ::-1]).all()
    ranking.order = order[:5]
    painted = page.painting(seen, ranking, "all", names)
    assert painted["bounds"] == [-75.0, 15.0, 75.0, 45.0]
    assert page.answer_window(seen, 7) == [0.0, 0.0, 60.0]


def _decoded(uri: str) -> UInt8Array:
    data = base64.b64decode(uri.partition(",")[2])
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED), np.uint8)


def test_a_spot_lists_the_frames_that_show_it(seen: FlightSnapshot) -> None:
    spot = page.spot(seen, (-20.0, 0.0))
    assert 0 in spot["frames"]
    assert 1 not in spot["frames"]
    assert spot["sentence"].startswith(f"{len(spot['frames'])} of 3 photos show 47.")


def test_pins_go_from_where_the_photo_has_a_detail_to_where_the_map_has_it(flight: LocatedFlight) -> None:
    rows = [(0.25, 0.5, 0.0, 0.5), (0.75, 0.5, 0.3, -0.1)]
    details = MatchedDetails(rows, 0.4, 0.9)
    one = FlightSnapshot(with_answer(flight, 0, details=details))
    pins = page.chosen(one, 0, ADDRESSES)["pins"]
    np.testing.assert_allclose([pin[2:] for pin in pins], [row[2:] for row in rows], atol=0.011)
    laid = one.flight.frames[0].laid
    on_map = details.on_map(laid, *SIZE)
    np.testing.assert_allclose([[x + east, y + north] for x, y, east, north in pins], on_map, atol=0.011)
    moved = np.array([[1.0, 0, 5], [0, 1, 0], [0, 0, 1]]) @ laid
    # A photo that is moved by hand has its details elsewhere, and the map has them where it had them.
    np.testing.assert_allclose(np.array(page.pins(moved, one.flight.frames[0]))[:, 2], [-5.0, -4.7], atol=0.011)
    assert page.chosen(FlightSnapshot(flight), 0, ADDRESSES)["pins"] == []


def test_an_own_photo_has_a_card_of_the_same_kind(seen: FlightSnapshot, flight: LocatedFlight) -> None:
    latitude, longitude = flight.basemap.frame.degrees([(30.0, 0.0)])[0].tolist()
    picture = OwnPicture("mine.jpg", np.full((60, 80, 3), 90, np.uint8), (latitude, longitude))

    def shown(answer: StageRecord | None, **job: Any) -> dict[str, Any]:
        located = LocatedFrame(flight.frames[0].frame, None, {} if answer is None else {"registration": answer})
        value = None if answer is None else OwnPhoto(located, whole_map=False)
        given: Any = SimpleNamespace(value=value, error=None, done=1, total=8, **job)
        return own_photo(seen, picture, given, ADDRESSES)

    waits = shown(None)
    assert (waits["frame"], waits["own"]["place"], waits["photo"]) == (-1, None, "")
    assert waits["own"]["tag"] == pytest.approx([30.0, 0.0], abs=0.1)
    assert "1 of 8 tries" in waits["card"]["headline"]
    placed = shown(registered(-20.0, 1.0))
    assert placed["own"]["place"] == [-20.0, 1.0]
    assert placed["own"]["radius"] == 1.0
    assert placed["own"]["outline"][4] is True
    assert placed["photo"].startswith("data:image/jpeg")
    assert placed["card"]["headline"].startswith("Placed by its details, ± 1.0 m")
    assert placed["card"]["name"] == "mine.jpg"
    refused = shown(StageRecord("refused", "Too few matches."))
    assert (refused["own"]["place"], refused["homography"], refused["ground"]) == (None, None, "")
    assert refused["card"]["mark"] == "✗"
    assert any("Too few matches." in line for line in refused["card"]["lines"])
    assert any("only the most similar windows were searched" in line for line in refused["card"]["lines"])


def test_the_scene_has_the_cameras_the_way_and_the_ground_of_the_chosen_photo(flight: LocatedFlight) -> None:
    pose = CameraPose(-20.0, 1.0, 40.0, 30.0, 0.0, -90.0, 0.0, 60.0, True, 40, [0.0] * 36)
    workspace: Any = SimpleNamespace(flight=with_answer(flight, 0, pose=pose))
    (way, _), (chosen, _) = lines.scene_lines(workspace, 0)
    np.testing.assert_allclose(way[:, :, :2], [[(-20.0, 1.0), (45.0, 0.0)]])
    assert chosen.shape == (8 + 4, 2, 3)
    np.testing.assert_allclose(chosen[0, 0], (-20.0, 1.0, 30.0), err_msg="above the ground, not the datum")
    np.testing.assert_allclose(chosen[8, 0, :2], (-40.0, 16.0))
    (others, _), (ground, _) = lines.scene_lines(workspace, 1)
    assert (len(others), len(ground)) == (1 + 8, 4)
    unregistered: Any = SimpleNamespace(flight=replace(flight, frames=flight.frames[2:]))
    assert lines.scene_lines(unregistered, 0) == []


@pytest.mark.parametrize(
    ("kind", "good", "value", "bad"),
    [
        (part.MetresOf(2), "1.5,-2", (1.5, -2.0), ["1", "1,x", "1,2e9", [1, 2, 3], 5]),
        (part.MetresOf(2), "", (), []),
        (part.PaintedPart(), "1", "1", ["2", "-1", "heat", None]),
    ],
)
def test_a_choice_is_one_of_the_panel(kind: Any, good: str, value: object, bad: list[object]) -> None:
    workspace: Any = SimpleNamespace(contract=SimpleNamespace(n_parts=2))
    assert kind.read(good, None, workspace) == value
    assert kind.read(kind.write(value, None, workspace), None, workspace) == value
    for one in bad:
        with pytest.raises(UnusableError):
            kind.read(one, None, workspace)
