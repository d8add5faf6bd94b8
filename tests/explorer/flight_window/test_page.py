from __future__ import annotations

import base64
import json
import re
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

from explorer.compute.background_jobs import BackgroundJob, ReportProgress
from explorer.flight_window import flight_text, page, service
from explorer.flight_window.service import FlightService, FlightView
from explorer.panels import answer_text
from lpn.core.demo import DEMO_PLACE
from lpn.core.errors import DataError
from lpn.drawing.words import Vocabulary, speaking
from lpn.locate.agreement import MapAgreement
from lpn.locate.audit import TagAudit
from lpn.locate.belief import Belief, FlightVerdicts
from lpn.locate.camera_pose import CameraPose
from lpn.locate.located import LocatedFlight
from lpn.locate.matched_details import MatchedDetails
from lpn.locate.summary import describe_flight, placed_errors
from lpn.maps import open_map
from lpn.maps.tag_placed import placing_sentence
from tests.explorer.flight_window.conftest import registered
from tests.lpn.maps.small_maps import EAST, NORTH, smooth, write_geotiff


def view_of(flight: LocatedFlight) -> FlightView:
    folder = flight.frames[0].frame.file.parent
    return FlightService(SimpleNamespace(flight=flight, root=folder, verdicts_of=FlightVerdicts.of)).view()  # type: ignore[arg-type]


@pytest.fixture
def view(flight: LocatedFlight) -> FlightView:
    return view_of(flight)


def analysis(flight: LocatedFlight, tile: int = 0) -> Any:
    """An analysis with scores of all windows, the part 1 in the opposite order of the whole."""
    assert flight.retrieval is not None
    values = np.linspace(0.2, 0.8, len(flight.retrieval.windows)).astype(np.float32)
    order = np.arange(len(values))
    ranking = SimpleNamespace(scores=values, cosines=np.column_stack([values, values[::-1]]), order=order)
    return SimpleNamespace(ranking=ranking, chosen=SimpleNamespace(index=tile))


def test_sentence_and_accuracy_compute_the_errors_of_the_placed_photos_once(
    flight: LocatedFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    computed: list[LocatedFlight] = []
    monkeypatch.setattr(service, "placed_errors", lambda *of: computed.append(of[0]) or placed_errors(*of))
    view = view_of(flight)
    for _ in range(2):
        page.sentence(view, running=False)
        page.accuracy(view)
    assert computed == [flight]


def test_one_sentence_says_how_the_photos_were_placed(view: FlightView) -> None:
    text = page.sentence(view, running=False)
    assert text.startswith(
        "A drone took 3 photos over this map: 3 placed (2 by registration, 1 by sequence), 1 of them in "
        "doubt. The placed "
    )
    assert "The placed ones lie 5.0 m from their GPS tags in the median, which is the error of both together." in text
    assert text.endswith(
        "which is the error of both together. In doubt is photo1, contradicted by GPS tag, neighbours, or the map away from the "
        "photo's middle."
    )
    best = Belief(None, "", "", "", "retrieval")
    verdicts = [view.beliefs[0], best, Belief(False, "", "", "")]
    guessed = describe_flight(view.flight, verdicts, placed_errors(view.flight, verdicts))
    assert guessed == (
        "A drone took 3 photos over this map: 1 placed (1 by registration), 1 only guessed by retrieval, 1 refused. The "
        "placed ones lie 1.0 m from their GPS tags in the median, which is the error of both together."
    ), "a guess counts for nothing"
    with speaking(Vocabulary(plain=True)):
        assert ": 1 placed (1 by their details), 1 only guessed by their look, 1" in describe_flight(
            view.flight, verdicts, None
        )
    assert page.sentence(view, running=True).endswith("Registration is still running, so these numbers change.")
    away = view_of(replace(view.flight, tags_away=1.929e6))
    assert page.sentence(away, running=False).startswith(
        "The flight's GPS tags lie 1,929 km from this map, so the map is probably of another place. Give the map of the "
        "tags' place unless the tags are wrong. A drone took 3 photos: 3 placed"
    )
    assert page.data(away, "x/")["elsewhere"] == "The flight's GPS tags lie 1,929 km from this map"


def test_every_count_of_photos_in_doubt_is_that_of_the_verdicts(flight: LocatedFlight) -> None:
    untagged = replace(flight.frames[1], tag=None)
    for frames, kind in (
        (flight.frames, "whose GPS tag lies elsewhere (1 here)"),
        ([flight.frames[0], untagged, flight.frames[2]], "without a GPS tag whose neighbours lie elsewhere (1 here)"),
    ):
        view = view_of(replace(flight, frames=frames))
        assert "3 placed (2 by registration, 1 by sequence), 1 of them in doubt." in page.sentence(view, running=False)
        assert page.data(view, "x/")["tracks"]["registration"]["count"] == "2 of 3, 1 in doubt"
        workspace: Any = SimpleNamespace(verdicts=FlightVerdicts.of(view.flight))
        assert answer_text.doubts(workspace) == f"In doubt is a photo {kind}."


def test_a_photo_that_a_person_has_corrected_is_no_longer_in_doubt(flight: LocatedFlight) -> None:
    corrected = replace(flight.frames[1], by_hand=flight.frames[1].stages["registration"])
    view = view_of(replace(flight, frames=[flight.frames[0], corrected, flight.frames[2]]))
    assert "in doubt" not in page.sentence(view, running=False).lower()
    assert page.data(view, "x/")["tracks"]["registration"]["count"] == "2 of 3"


def test_the_script_gets_every_track_and_what_is_unknown_as_null(view: FlightView) -> None:
    data = json.loads(json.dumps(page.data(view, "pictures/x/"), allow_nan=False))
    assert list(data["tracks"]) == ["tag", "retrieval", "sequence", "registration"]
    track = data["tracks"]["registration"]
    assert track["x"] == [-20.0, 45.0, None]
    assert track["state"] == [0, 0, 2]
    assert track["error"] == [1.0, 45.0, None]
    assert track["count"] == "2 of 3, 1 in doubt"
    assert track["reason"] == [
        None,
        "Registration and sequence lie 45.3 m apart; their radii allow 38.5 m. Registration and tag lie 45.0 m apart; "
        "their radii allow 15.3 m.",
        "Registration: refused. Only <i>4</i> matches agree.",
    ]
    assert data["tracks"]["tag"]["count"] == "3 of 3"
    assert "the places of the photos, by their details" in track["mark"]
    assert "guesses by the look alone" in data["tracks"]["retrieval"]["mark"], "a guess is no place"
    assert data["tracks"]["retrieval"]["state"] == [1, 1, 1]
    assert data["times"] == [0.0, 2.0, 4.0]
    # The first frame is registered, the second contradicts its tag, and only neighbours tell the third.
    assert data["signs"] == [True, None, None]
    assert data["states"] == ["right", "contradicted", "unknown"]
    assert "the true place of 39 of 100 photos lies in it (1 sigma along each axis)." in data["circle"]
    assert data["circle"].endswith("The flight's GPS tags do not confirm that.")
    with speaking(Vocabulary(plain=True)):
        assert "the true place of 99 of 100 photos lies in it." in page.data(view, "")["circle"]
    assert [one[4] for one in data["outlines"]] == [True, True, False]
    assert data["outlines"][0][0] == pytest.approx([-40.0, 16.0])
    assert data["sheets"] == []


def test_several_sheets_have_a_colour_each(flight: LocatedFlight, tmp_path: Path) -> None:
    for i in range(2):
        place = (0.5, 0, EAST + 150 * i, 0, -0.5, NORTH)
        write_geotiff(tmp_path / f"sheet{i}.tif", smooth(40, 200, i), matrix=place)
    two = replace(flight, basemap=open_map(tmp_path))
    sheets = page.data(view_of(two), "x/")["sheets"]
    assert sorted(sheet["name"] for sheet in sheets) == ["sheet0.tif", "sheet1.tif"]
    assert len({sheet["colour"] for sheet in sheets}) == 2
    west, east = sorted(min(x for x, _ in sheet["outline"]) for sheet in sheets)
    assert east - west == pytest.approx(150, abs=0.5)


def test_the_card_answers_query_answer_and_belief_without_running_what_a_file_says(view: FlightView) -> None:
    first, third = page.card(view, 0, "pictures/x/"), page.card(view, 2, "pictures/x/")
    assert "✓ Placed by its details, ± 1.0 m on this map" in first
    assert "1.0 m from its GPS tag" in first
    assert "pictures/x/pair/0" in first
    assert "pictures/x/ground/0" in first
    assert "by its neighbours" in third
    assert "alone is" not in first
    for frame, state in enumerate(("right", "contradicted", "unknown")):
        assert f"border-color:var(--mark-{state})" in page.card(view, frame, "pictures/x/")
    assert "its top points to" not in third
    failed = page.card(view, 0, "pictures/x/", retrieval_right=False)
    assert failed.index("Placed by its details") < failed.index("Retrieval alone is wrong.")
    doubted = page.card(view, 1, "pictures/x/", retrieval_right=True)
    assert "Retrieval alone is right, by its GPS tag." in doubted
    assert "alone is right" not in page.card(view, 0, "pictures/x/", retrieval_right=True)
    assert "<b>photo2" not in third
    assert "<i>4" not in third
    assert third.count("Only &lt;i&gt;4&lt;/i&gt; matches agree.") == 1
    assert "✗ Registration: refused. Only" in third


@pytest.fixture
def plainly() -> Iterator[None]:
    with speaking(Vocabulary(plain=True)):
        yield


def compared(flight: LocatedFlight, frame: int, *metres: float) -> LocatedFlight:
    """Return a flight with a frame whose places away from the middle lie some metres from where the map has them."""
    places = [(0.5, 0.5), (0.1, 0.2), (0.5, 0.9)]
    agreement = MapAgreement([(*place, 0.0, north) for place, north in zip(places, metres, strict=False)], 9.0)
    frames = list(flight.frames)
    stages = dict(frames[frame].stages)
    stages["registration"] = msgspec.structs.replace(stages["registration"], agreement=agreement)
    frames[frame] = replace(frames[frame], stages=stages)
    return replace(flight, frames=frames)


@pytest.mark.usefixtures("plainly")
def test_places_beside_the_middle_say_how_far_off_they_are_and_whether_that_fits(flight: LocatedFlight) -> None:
    def said(*metres: float) -> str:
        view = view_of(compared(flight, 0, *metres))
        answer = view.flight.frames[0].stages["registration"]
        assert answer.agreement is not None
        return flight_text.agreement(view, 0, answer.agreement)

    assert said(0.4, 5.2, 1.0) == (
        "✓ Away from its middle, 3 places of the photo were found on the map one by one, looked for within ± 9.0 m: their median "
        "lies 1.0 m from where the photo has it, and the farthest 5.2 m, at the upper left. At most 3.0 m are "
        "allowed for the median, as far as the middle may be off on this map."
    )
    assert "the farthest 1.0 m, at the bottom." in said(0.4, 0.2, 1.0)
    finer = compared(flight, 0, 0.4, 5.2, 1.0)
    answer = finer.frames[0].stages["registration"]
    finer.frames[0].stages["registration"] = msgspec.structs.replace(answer, radius=1.01, place_error=0.0)
    assert answer.agreement is not None
    assert " At most 3.1 m are" in flight_text.agreement(view_of(finer), 0, answer.agreement), "a bound is rounded up"
    assert "the farthest 2.4 m, near the middle." in said(2.4, 0.2, 1.0)
    assert said(0.4, 5.2) == (
        "Not checked: away from its middle, only 2 places of the photo could be found on the map. At least 3 such places are "
        "needed to check that the photo fits there, too."
    )
    assert "away from its middle, no place of the photo" in said()
    unfit = said(4.0, 8.2, 3.2)
    assert unfit.startswith("? Away from its middle")
    assert unfit.endswith("the farthest at least 8.2 m, at the upper left, as nothing beyond was looked for.")


@pytest.mark.usefixtures("plainly")
def test_a_photo_that_does_not_fit_beside_its_middle_is_doubted_wherever_it_is_told(flight: LocatedFlight) -> None:
    view = view_of(compared(flight, 0, 4.0, 8.2, 3.2))
    assert view.beliefs[0].sign is None
    card = page.card(view, 0, "x/", agreement=view.flight.frames[0].stages["registration"].agreement)
    assert "? Placed by its details, but away from its middle it does not fit the map" in card
    told = (
        "Away from its middle, 3 places of the photo lie 4.0 m in the median from where the map has them, and 8.2 m at the "
        "farthest, at the upper left. At most 3.0 m are allowed for the median, as far as the middle may be off on this map. "
        "Uneven ground, the lens, or ground that has changed can do this, too; nothing here tells which. The middle may still "
        "be right."
    )
    lists = page.lists(view)
    track = page.data(view, "x/")["tracks"]["registration"]
    assert told in card
    assert told in track["reason"][0]
    assert lists["audit"].count(told) == 1
    assert "the radius on this map" not in card + lists["audit"]
    with speaking(Vocabulary()):
        assert "map, three times ± 1.0 m. Uneven ground" in page.card(view, 0, "x/")
    earthly = msgspec.structs.replace(view.flight.frames[0].stages["registration"], radius=6.0, place_error=5.9)
    frame = replace(view.flight.frames[0], stages={"registration": earthly})
    (one,) = (one for one in view_of(replace(flight, frames=[frame])).contradictions if one.other == "map")
    earthly_view = view_of(replace(flight, frames=[frame]))
    assert flight_text.contradiction(earthly_view, one).endswith("The middle may still be right.")
    with speaking(Vocabulary()):
        assert flight_text.contradiction(earthly_view, one).endswith(
            "Its place is ± 6.0 m on earth, where the map's own error moves all of the photo alike."
        )
    assert page.sentence(view, running=False).endswith(
        "In doubt are photo0 and photo1, contradicted by GPS tag, neighbours, or the map away from the photo's middle."
    )
    assert "Contradictions 2" in re.sub(r"<[^>]*>", "", lists["counts"])
    assert "Not checked 0" in re.sub(r"<[^>]*>", "", lists["counts"])
    assert re.findall(r"<b>(photo\d.png)</b>", lists["worst"]) == ["photo1.png", "photo0.png"]
    assert "away from its middle 4.0 m off where 3.0 m are allowed" in lists["worst"]
    bent = page.lists(view_of(compared(flight, 0, 40.0, 41.0, 3.2)))["worst"]
    assert re.findall(r"<b>(photo\d.png)</b>", bent) == ["photo0.png", "photo1.png"], (
        "by its tag, photo1 is farther off"
    )
    known = flight_text.accuracy(view)
    assert known is not None
    assert known[0].endswith("and 1 of 1 photos do not fit the map away from their middle.")
    unchecked = view_of(compared(flight, 0, 0.4))
    assert page.sentence(unchecked, running=False).endswith(
        "In doubt is photo1, contradicted by GPS tag, neighbours, or the map away from the photo's middle. 1 more could not be "
        "checked away from the middle, where too few places were found on the map; the list Not checked names it."
    )
    assert "not checked away from its middle" in page.lists(unchecked)["worst"]
    listed = page.lists(unchecked)
    assert "Not checked 1" in re.sub(r"<[^>]*>", "", listed["counts"])
    assert re.findall(r'data-frame="(\d)"', listed["unchecked"]) == ["0"]
    assert "Every photo by its details was checked." in lists["unchecked"]
    # In plain words the card folds what is no warning; in the field's words nothing is folded.
    for shown, folded in ((view, True), (unchecked, False)):
        card = page.card(shown, 0, "x/", agreement=shown.flight.frames[0].stages["registration"].agreement)
        told = card.partition("<details")
        assert ('id="lpn-flight-agreement"' in told[2]) == folded != ('id="lpn-flight-agreement"' in told[0])
    with speaking(Vocabulary()):
        card = page.card(view, 0, "x/", agreement=view.flight.frames[0].stages["registration"].agreement)
    assert '<details data-words="expert" open>' in card


@pytest.mark.usefixtures("plainly")
def test_a_picture_whose_file_was_turned_says_so(flight: LocatedFlight) -> None:
    def told(turn: float) -> str:
        stages = dict(flight.frames[0].stages)
        stages["registration"] = msgspec.structs.replace(stages["registration"], turn=turn)
        return flight_text.reason(view_of(replace(flight, frames=[replace(flight.frames[0], stages=stages)])), 0)

    assert "The picture is turned by 179 degrees here: its file tells another heading" in told(-179.2)
    assert "turned" not in told(4.0)
    fits = flight_text.accuracy(view_of(compared(flight, 0, 0.4, 0.5, 0.6)))
    assert fits is not None
    assert "do not fit" not in fits[0]


@pytest.mark.usefixtures("plainly")
def test_accuracy_is_said_source_by_source(flight: LocatedFlight) -> None:
    def lines(**changes: Any) -> tuple[str, dict[str, str]]:
        known = flight_text.accuracy(view_of(replace(flight, **changes)))
        assert known is not None
        return known[0], {line.name: f"{line.figure} {line.source}" for line in known[1]}

    summary, of = lines(map_error=0.8)
    assert summary == (
        "99 of 100 photos like the typical one should lie within 3.0 m on this map; on earth as good as the map’s georeference, "
        "which nothing here checks. Not confirmed: only 50 % of the GPS tags lie that near, where 99 % should "
        "(tags or radii fail; this does not tell which)."
    )
    with speaking(Vocabulary()):
        summary, _ = lines(map_error=0.8)
    assert summary.startswith(
        "± 1.0 m on this map (1 sigma along each axis); on earth as good as the map’s georeference"
    )
    assert summary.endswith(
        "Not confirmed: only 50 % of the GPS tags lie within 3 radii, where 99 % should "
        "(tags or radii fail; this does not tell which)."
    )
    assert "the tilt that the photos tell give ± 0.6 m, and ± 0.8 m are assumed" in of["On this map"]
    assert of["GPS tags"].startswith("5.0 m Median of 3 photos and 45.0 m at most, between the GPS tag and the place")
    assert "error of both together" in of["GPS tags"]
    assert "late" not in of["GPS tags"]
    late = TagAudit(9, 15.3, 33.0, 2.8, 0.5, 10.5, 2.7, 14.0, 8.6, 225.0)
    _, of = lines(audit=late)
    assert "are 2.8 s (± 0.5 s) late, or that the camera looks 8.6 m ahead" in of["GPS tags"]
    assert (
        "a constant offset of 2.7 m of the tags to the south-west that explains a part: 10.5 m remain in the median"
        in of["GPS tags"]
    )
    unplaced = [replace(frame, stages={}) for frame in flight.frames]
    assert flight_text.accuracy(view_of(replace(flight, frames=unplaced))) is None
    assert page.accuracy(view_of(replace(flight, frames=unplaced))).strip() == ""


@pytest.mark.usefixtures("plainly")
def test_accuracy_tells_the_share_of_the_tags_that_lie_near(flight: LocatedFlight) -> None:
    frames = []
    for i, off in enumerate(4.0 + np.tile([1.0, -1.0], 10)):
        answer = msgspec.structs.replace(registered(float(off), 5.0 * i, 1.0), camera=False)
        frames.append(replace(flight.frames[0], tag=np.array([0.0, 5.0 * i]), stages={"registration": answer}))
    view = view_of(replace(flight, flight=replace(flight.flight, frames=()), frames=frames, audit=None))
    known = flight_text.accuracy(view)
    assert known is not None
    assert "of them within" in page.sentence(view, running=False)
    (of_tags,) = (line for line in known[1] if line.name == "GPS tags")
    assert f"{of_tags.figure} {of_tags.source}".startswith(
        "4.0 m Median of 20 photos, 95 % of them within 5.0 m and 5.0 m at most, between"
    )


def test_a_map_made_of_photos_names_the_tags_that_place_it(
    flight: LocatedFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    note = "The map is made of 30 photos. Place and scale are those of the GPS tags, which lie 13.2 m from the photos."
    monkeypatch.setattr(type(flight.basemap), "notes", [note])
    known = flight_text.accuracy(view_of(flight))
    assert known is not None
    assert "on earth no better than the GPS tags that the map was made by." in known[0]
    assert known[1][1].source == "Place and scale are those of the GPS tags, which lie 13.2 m from the photos."
    assert placing_sentence([(DEMO_PLACE[0] / "map.json").read_text("utf-8")])
    known = flight_text.accuracy(view_of(replace(flight, map_error=0.8, place_error=0.6)))
    assert known is not None
    assert known[0].startswith(
        "± 0.8 m on this map (1 sigma along each axis); ± 1.0 m on earth, as far as the tags of the map do not all err alike."
    )
    assert [line.figure for line in known[1][:2]] == ["± 0.8 m", "± 0.6 m"]
    assert "the tilt that the photos tell give ± 0.6 m, and ± 0.5 m are assumed for the map" in known[1][0].source
    # Two of three places by their neighbours, whose radii of 10 m are on the map.
    monkeypatch.delitem(flight.frames[0].stages, "registration")
    known = flight_text.accuracy(view_of(replace(flight, map_error=6.1, place_error=6.0)))
    assert known is not None
    assert known[0].startswith("± 10.0 m on this map (1 sigma along each axis); ± 11.7 m on earth")


def test_a_surveyed_map_tells_its_error_on_earth(flight: LocatedFlight) -> None:
    known = flight_text.accuracy(view_of(replace(flight, map_error=0.02, place_error=0.02)))
    assert known is not None
    assert known[0].startswith("± 1.0 m on this map (1 sigma along each axis); ± 1.0 m on earth.")
    assert "are assumed for the map" not in known[1][0].source
    assert (known[1][1].figure, known[1][1].source[:25]) == ("± 0.02 m", "Its places were surveyed:")


@pytest.mark.usefixtures("plainly")
def test_contradictions_say_what_is_allowed_and_what_nothing_tells(view: FlightView) -> None:
    (one,) = [one for one in view.contradictions if one.other == "tag"]
    assert one.told(view.beliefs[1]) == (
        "Its place by its details and its GPS tag lie 45.0 m apart, and 15.3 m are allowed: three times the error of both. "
        "Nothing here tells which of the two errs."
    )
    assert "and 6.0 m as a tilted camera looks aside" in replace(one, tilt=6.0).told(view.beliefs[1])
    assert flight_text.reason(view, 1).startswith(
        "40 details of the photo agree with the map. Its place by its details and"
    )
    assert flight_text.reason(view, 2) == ""


@pytest.mark.usefixtures("plainly")
def test_neighbours_that_alone_disagree_are_not_said_to_leave_the_place_open(flight: LocatedFlight) -> None:
    stages = dict(flight.frames[0].stages)
    stages["sequence"] = msgspec.structs.replace(stages["sequence"], x=80.0, y=1.0)
    view = view_of(replace(flight, frames=[replace(flight.frames[0], stages=stages), *flight.frames[1:]]))
    assert view.beliefs[0].sign
    assert flight_text.reason(view, 0).endswith(
        "lies 1 m from its GPS tag, where 16 m are allowed. Its neighbours would place it 100.0 m from here."
    )
    listed = page.lists(view)["audit"]
    assert "Its neighbours would place it 100.0 m from here." in listed
    assert "Its neighbours would place it 100.0 m from its GPS tag." in listed
    assert listed.count("Nothing here tells which of the two errs.") == len(view.contradictions) - 2


@pytest.mark.usefixtures("plainly")
def test_the_drone_has_a_place_and_a_tilt_that_a_person_would_say(flight: LocatedFlight) -> None:
    covariance = np.diag([1.0, 1.0, 4.0, 1.0, 4.0, 4.0]).ravel().tolist()
    pose = CameraPose(1.0, 2.0, 40.0, 40.0, 180.0, -93.0, 4.0, 70.0, "told", True, 40, covariance)
    frame = flight.frames[0]

    def drone(**changes: Any) -> str:
        answer = msgspec.structs.replace(frame.stages["registration"], pose=pose, **changes)
        return flight_text.drone(flight, replace(frame, stages={"registration": answer}))

    said = drone(camera=False)
    assert (
        "(±\N{NO-BREAK SPACE}1.0 m on this map), 21.1 m from its GPS tag, "
        "40 m above the ground (±\N{NO-BREAK SPACE}2 m)" in said
    )
    # 3 degrees to the back, which is north, and 4 to the side.
    assert "looked 5.0° (±\N{NO-BREAK SPACE}2.0°) away from straight down, to the north-east" in said
    assert "The map has no heights" in said
    # The pose is 1 m off on the map, whose own error is 2.4 m; the tag lies at (-20, 0).
    assert "(±\N{NO-BREAK SPACE}2.6 m on earth), 21.1 m from its GPS tag, 40 m above" in drone(
        camera=False, map_error=2.4, place_error=2.0
    )
    assert drone(x=1.0, y=2.0).startswith("there, 40 m above the ground")
    assert drone().endswith("Its place rests on the tilt in the photo's file.")
    assert flight_text.drone(flight, frame) == ""


def test_a_photo_that_the_map_hardly_shows_says_so(flight: LocatedFlight) -> None:
    assert "The map shows only" not in page.card(view_of(flight), 0, "x/")
    east = flight.basemap.bounds[2]
    edge = msgspec.structs.replace(flight.frames[0].stages["registration"], x=east + 5.0, homography=None)
    moved = replace(flight.frames[0], stages={"registration": edge})
    said = page.card(view_of(replace(flight, frames=[moved, *flight.frames[1:]])), 0, "x/")
    assert "The map shows only" in said


def test_frames_that_wait_for_their_registration_are_neither_accepted_nor_refused(flight: LocatedFlight) -> None:
    stages = {name: answer for name, answer in flight.frames[2].stages.items() if name != "registration"}
    waiting = view_of(replace(flight, frames=[*flight.frames[:2], replace(flight.frames[2], stages=stages)]))
    track = page.data(waiting, "x/")["tracks"]["registration"]
    assert track["state"] == [0, 0, -1]
    assert track["count"] == "2 of 3, 1 in doubt"
    assert "Not placed 0" in page.lists(waiting)["counts"]


def test_plain_words_say_of_a_refused_sequence_how_far_off_it_may_be(flight: LocatedFlight) -> None:
    frame, radius = (
        flight.frames[2],
        "Its radius of 126 m (1 sigma along each axis) is larger than a piece of the map, 40 m wide.",
    )
    likely = "The frame lies within 30 m of this place with a probability of 0.86, and 0.98 are needed."
    for sentence, unverified, told in (
        (radius, False, "Its neighbours do not settle where it is: this place may be 126 m off, or more."),
        (likely, False, "Its neighbours do not settle where it is: this place may be 126 m off, or more."),
        ("Nothing shows that the map is of this place: steps.", True, "Nothing shows that the map is of this place."),
    ):
        refused = msgspec.structs.replace(
            frame.stages["sequence"], state="refused", sentence=sentence, radius=126.4, unverified=unverified
        )
        stages = {"retrieval": frame.stages["retrieval"], "sequence": refused}
        one = view_of(replace(flight, frames=[*flight.frames[:2], replace(frame, stages=stages)]))
        assert f"Sequence: refused. {sentence}" in page.lists(one)["refused"]
        with speaking(Vocabulary(plain=True)):
            assert f"By its neighbours: refused. {told}" in page.lists(one)["refused"]
            assert sentence not in page.lists(one)["refused"] + page.card(one, 2, "x/")
            assert "does not speak against" not in page.card(one, 2, "x/")
        stages["registration"] = flight.frames[0].stages["registration"]
        placed = view_of(replace(flight, frames=[*flight.frames[:2], replace(frame, stages=stages)]))
        with speaking(Vocabulary(plain=True)):
            assert told in page.card(placed, 2, "x/")
            assert ("That does not speak against its details." in page.card(placed, 2, "x/")) != unverified


def test_lists_have_refused_frames_contradictions_and_notes(view: FlightView, flight: LocatedFlight) -> None:
    placed = page.lists(view)
    assert "Not placed 0<" in placed["counts"], "its neighbours place the frame whose registration was refused"
    assert placed["refused"].index("Every photo is placed.") < placed["refused"].index("Registration: refused. Only")
    stages = {name: answer for name, answer in flight.frames[2].stages.items() if name != "sequence"}
    lists = page.lists(view_of(replace(flight, frames=[*flight.frames[:2], replace(flight.frames[2], stages=stages)])))
    assert "Registration: refused. Only &lt;i&gt;4&lt;/i&gt; matches agree." in lists["refused"]
    assert "photo0" not in lists["refused"]
    assert "up to 45." in lists["audit"]
    assert "Registration and tag lie 45.0 m apart" in lists["audit"]
    assert lists["notes"].count("<p>") == 2
    order = re.findall(r"<b>(.*?)</b> <span>(.*?)</span>", lists["worst"])
    assert order == [
        ("photo1.png", "? 45.0 m from its GPS tag where 15.3 m are allowed, Registration, ± 1.0 m on this map"),
        ("photo0.png", "1.0 m from its GPS tag, Registration, ± 1.0 m on this map"),
        ("&lt;b&gt;photo2&lt;/b&gt;.png", "20.0 m from its GPS tag, Retrieval, not verified"),
    ]
    assert "Not placed 1<" in lists["counts"]


@pytest.mark.usefixtures("plainly")
def test_the_larger_ratio_to_its_limit_orders_a_photo_that_breaks_two(flight: LocatedFlight) -> None:
    def listed(flight: LocatedFlight) -> list[str]:
        return re.findall(r"<b>(photo\d.png)</b>", page.lists(view_of(flight))["worst"])

    # The tag of photo1 is 45 m off where 15.3 m are allowed, 2.9 times as many; away from their middles 3.0 m are allowed.
    of_map = compared(flight, 0, 10.0, 10.0, 10.0)
    assert listed(of_map) == ["photo0.png", "photo1.png"], "3.3 times"
    both = compared(of_map, 1, 12.0, 12.0, 12.0)
    assert listed(both) == ["photo1.png", "photo0.png"], "4 times, by the map"
    assert (
        "45.0 m from its GPS tag where 15.3 m are allowed, away from its middle 12.0 m off where 3.0"
        in page.lists(view_of(both))["worst"]
    )
    assert listed(compared(of_map, 1, 3.3, 3.3, 3.3)) == ["photo0.png", "photo1.png"], "2.9 times, by its tag"


@pytest.mark.usefixtures("plainly")
def test_what_contradicts_another_answer_neither_orders_a_photo_nor_is_its_limit(flight: LocatedFlight) -> None:
    bent = compared(flight, 0, 4.0, 4.0, 4.0)
    far = msgspec.structs.replace(bent.frames[0].stages["sequence"], x=90.0, y=90.0, radius=1.0)
    stages = bent.frames[0].stages | {"sequence": far}
    flight = replace(bent, frames=[replace(bent.frames[0], stages=stages), *bent.frames[1:]])
    worst = page.lists(view_of(flight))["worst"]
    assert re.findall(r"<b>(photo\d.png)</b>", worst) == ["photo1.png", "photo0.png"]
    assert "? 1.0 m from its GPS tag, away from its middle 4.0 m off where 3.0 m are allowed" in worst
    untagged = replace(flight, frames=[flight.frames[0], replace(flight.frames[1], tag=None), flight.frames[2]])
    alone = page.lists(view_of(untagged))["worst"]
    assert "45.3 m from its place by its neighbours where 38.5 m are allowed" in alone


def test_the_photo_is_laid_only_where_a_registration_was_accepted(view: FlightView) -> None:
    assert page.chosen(view, 0, "x/")["homography"] == view.flight.frames[0].stages["registration"].homography
    assert page.chosen(view, 2, "x/")["homography"] is None


def test_scores_are_painted_whole_or_by_a_part(view: FlightView, flight: LocatedFlight) -> None:
    names = ["centre", "outer"]
    assert page.painting(view, analysis(flight), "off", names) is None
    whole, outer = (page.painting(view, analysis(flight), part, names) for part in ("all", 1))
    assert whole is not None
    assert outer is not None
    assert (whole["low"], whole["high"], whole["label"]) == ("0.20", "0.80", "score")
    assert outer["label"] == "cosine of outer"
    # Windows lie 30 m apart: five columns and three rows of cells.
    assert whole["bounds"] == [-75.0, -45.0, 75.0, 45.0]
    cells = [_decoded(one["picture"]) for one in (whole, outer)]
    assert cells[0].shape == (3, 5, 4)
    assert (cells[0] == cells[1][::-1, ::-1]).all()
    assert not (cells[0] == cells[1]).all()


def test_windows_that_are_not_ranked_are_not_painted(view: FlightView, flight: LocatedFlight) -> None:
    one = analysis(flight)
    one.ranking.order = one.ranking.order[:5]
    painted = page.painting(view, one, "all", [])
    assert painted is not None
    assert painted["bounds"] == [-75.0, 15.0, 75.0, 45.0]
    assert painted["high"] == "0.37"


def test_the_answer_is_the_window_that_the_stage_compares(view: FlightView, flight: LocatedFlight) -> None:
    assert page.answer_window(view, analysis(flight, 7)) == [0.0, 0.0, 60.0]


def test_the_progress_of_the_registration_is_told_until_it_ends() -> None:
    assert page.progress(None, 60) == ""
    may_begin, may_end = threading.Event(), threading.Event()

    def register(report: ReportProgress) -> None:
        assert may_begin.wait(60)
        report(2, 60)
        may_end.wait(60)
        if may_fail:
            raise DataError("A photo is damaged.")

    may_fail = False
    job = BackgroundJob(register, None)
    assert page.progress(job, 60).startswith("Registering 0/60<progress ")
    may_begin.set()
    while job.total == 0:
        time.sleep(0.01)
    shown = page.progress(job, 60)
    assert shown.startswith("Registering 2/60<progress ")
    assert 'value="2" max="60"' in shown
    may_end.set()
    assert job.wait(60)
    assert page.progress(job, 60) == ""
    may_fail = True
    job = BackgroundJob(register, None)
    assert job.wait(60)
    assert page.progress(job, 60) == "Registration failed: A photo is damaged."


def test_a_spot_lists_the_frames_that_show_it(view: FlightView) -> None:
    html = page.spot_list(view, [0, 2], (0.0, 0.0))
    assert "2 of 3 photos show" in html
    assert html.count('data-frame="') == 2
    assert "by its registration" in html


def _decoded(uri: str) -> Any:
    data = base64.b64decode(uri.partition(",")[2])
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


def test_a_map_that_stands_alone_has_a_way_back_beside_its_photo() -> None:
    alone, beside = page.shell(["1"], 500, alone=True), page.shell(["1"], 500)
    assert 'class="lpn flight alone"' in alone
    assert "‹ Back" in alone
    assert "‹ Back" not in beside


def test_pins_are_the_numbered_details_of_why(flight: LocatedFlight) -> None:
    located = flight.frames[0]
    answer = located.stages["registration"]
    rows = [(0.25, 0.5, 0.0, 0.5), (0.75, 0.5, 0.3, -0.1)]
    located.stages["registration"] = msgspec.structs.replace(answer, details=MatchedDetails(rows, 0.4, 0.9))
    assert answer.homography is not None
    laid, size = np.array(answer.homography).reshape(3, 3), (located.frame.width, located.frame.height)
    chosen = page.chosen(view_of(flight), 0, "x/")["pins"]
    np.testing.assert_allclose([pin[2:] for pin in chosen], [row[2:] for row in rows], atol=0.011)
    details = located.stages["registration"].details
    assert details is not None
    on_map = details.on_map(laid, *size)
    np.testing.assert_allclose([[x + east, y + north] for x, y, east, north in chosen], on_map, atol=0.011)
    moved = np.array([[1.0, 0, 5], [0, 1, 0], [0, 0, 1]]) @ laid
    np.testing.assert_allclose(
        np.array(page.pins(moved, located))[:, 2], [row[2] - 5 for row in rows], atol=0.011
    )  # a photo that is moved by hand has its details elsewhere, and the map has them where it had them
    located.stages["registration"] = msgspec.structs.replace(answer, details=None)
    assert page.chosen(view_of(flight), 0, "x/")["pins"] == []
