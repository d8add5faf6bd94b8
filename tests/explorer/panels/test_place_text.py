"""Tests of the sentence about the place of a map."""

from __future__ import annotations

import re
from datetime import date
from html import unescape
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from explorer.panels import place_text
from lpn.core.demo import DEMO, DEMO_FLIGHT, DEMO_PLACE
from lpn.datasets import Picture
from lpn.flights import open_flight
from lpn.maps import MapPlace, Window, open_map
from lpn.maps.named_window import WindowCut

DRONE, STREET = (cast(Any, SimpleNamespace(views=(view, "satellite"), tiles=161)) for view in ("drone", "street"))
RENDERED = "This is a rendered place, no real one: a computer drew it from a plan, so every true place is known."


def workspace_of(place: tuple[Any, Any]) -> Any:
    basemap, flight = open_map(place[0]), open_flight(place[1])
    return SimpleNamespace(
        root=place[1], about="", basemap=basemap, flight=SimpleNamespace(basemap=basemap, flight=flight)
    )


def text(html: str) -> str:
    return unescape(" ".join(re.sub(r"<[^>]*>", "", html).split()))


def test_a_real_place_has_a_coordinate_and_a_day() -> None:
    workspace = workspace_of(DEMO_PLACE)
    html = place_text.place(workspace, DRONE)
    assert text(html).startswith(
        "A drone without GPS can find its place this way: the program looks for its picture on one map of Caliterra in Dripping "
        "Springs, Texas, 186 m by 166 m, and knows no other ground. The map's middle lies at latitude 30.17117, longitude "
        "-98.08956 (OpenStreetMap). Map and photos are of 19 Oct"
    )
    links = re.findall(r'<a href="(https://www\.openstreetmap[^"]*)" target="_blank" rel="noopener noreferrer"', html)
    assert links == ["https://www.openstreetmap.org/?mlat=30.171165&amp;mlon=-98.089561#map=18/30.171165/-98.089561"]
    unlinked = place_text.place(workspace, DRONE, linked=False)
    assert "<a " not in unlinked
    assert "OpenStreetMap" not in unlinked, "a link's words say nothing without it"


def test_a_rendered_place_has_no_coordinate() -> None:
    workspace = workspace_of(DEMO_FLIGHT)
    said = text(place_text.place(workspace, DRONE))
    assert said.startswith(
        "A drone without GPS can find its place this way: the program looks for its picture on one map, 720 m by 720 m, and "
        "knows no other ground."
    )
    assert f"{RENDERED} The map is of spring and the photos are of 14" in said
    assert "latitude" not in said
    city = cast(Any, SimpleNamespace(root=DEMO, flight=None, basemap=None, about=""))
    assert RENDERED in text(place_text.place(city, DRONE))
    assert text(place_text.place(city, STREET)) == RENDERED
    assert place_text.place(cast(Any, SimpleNamespace(root=DEMO_PLACE[0], flight=None, basemap=None)), STREET) == ""


@pytest.mark.parametrize(
    ("mapped", "flown", "said"),
    [
        ("", None, ""),
        ("2020-05-01", None, "the map is of 1 May 2020"),
        ("2020-05-01", date(2020, 5, 2), "the map is of 1 May 2020 and the photos are of 2 May 2020"),
    ],
)
def test_only_known_days_are_named(mapped: str, flown: date | None, said: str) -> None:
    assert " ".join(place_text._times(MapPlace(photographed=mapped), flown).split()) == said


def test_the_judge_of_right_answers_is_named() -> None:
    place = workspace_of(DEMO_FLIGHT)
    place.flight.retrieval = SimpleNamespace(sizes=np.array([99.2, 99.2]))
    place.flight.late_tags = None
    task = cast(Any, SimpleNamespace(of_map=True))
    said = "Right is a piece, 99 m wide, on which the photo's middle lies; its GPS tag is the judge."
    assert (place_text.criterion(place, task), place_text.season(place)) == (
        said,
        "Map and photos are of different seasons.",
    )
    place.rankings, place.counts = {"a": None}, lambda _: (17, 40)
    place.tasks, place.choices = {"": SimpleNamespace(key="a")}, {"other": "an autumn"}

    same = workspace_of(DEMO_PLACE)
    same.flight.retrieval, same.choices = SimpleNamespace(sizes=np.array([26.0, 99.6])), place.choices
    same.flight.late_tags = SimpleNamespace(lag=2.71, median=15.2)
    same.opened = lambda: {"other": place}
    assert place_text.criterion(same, task) == (
        "Right is a piece, 26 to 100 m wide, on which the photo's middle lies, so the middle of a large piece may lie farther "
        "off than that of a small one. GPS tags here lie 15 m off in the median, some of "
        "which a lag of 2.7 s explains, so the judge is the program's second method, which lays the photo's details over the "
        "map."
    )
    same.flight.rendered = False
    assert place_text.untried(same) == place_text.UNTRIED
    place.flight.rendered = True
    assert place_text.untried(place) == ""
    assert place_text.season(same) == (
        "At another place (an autumn), whose map is of another season, the first answer is right 17 of 40 times."
    )


def test_a_piece_says_how_much_of_it_is_off_the_map() -> None:
    basemap = open_map(DEMO_PLACE[0])
    east = basemap.bounds[2]

    def called(x: float) -> str:
        cut = WindowCut(basemap, Window(x, 0.0, 40.0), 8)
        return place_text.piece(Picture(DEMO_PLACE[0], 0, "id", cut=cut))

    assert called(0.0) == "in the map's middle, 40 m wide"
    assert re.fullmatch(r"94 m east of the map's middle, 40 m wide, [5-9]\d % of it off the map", called(east))
