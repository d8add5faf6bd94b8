"""Tests of the first screen's content, and of what leaves it."""

from __future__ import annotations

import os
import re
from base64 import b64decode
from dataclasses import replace
from hashlib import sha256
from html import unescape
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import cv2
import msgspec
import numpy as np
import pytest

from explorer import judge, reports, session_state
from explorer.browse.query_list import entries
from explorer.cli import Explore
from explorer.client.address import opened_alone
from explorer.client.views import ClientViews
from explorer.compute.request_context import RequestContext
from explorer.explain_window import activation, comparison, model_comparison, sweep_page
from explorer.failure_lab import map_data, table
from explorer.failure_lab.service import FailureLab
from explorer.failure_lab.state import LabState
from explorer.flight_window.service import FlightView
from explorer.lab_choices import LabChoices, Selection
from explorer.layout import layout_for
from explorer.opening import open_model, open_source
from explorer.panels import answer_text, details_pair, first_screen, pages, place_text, wrong_answer
from explorer.panels.navigation import Navigation
from explorer.panels.stage_controls import StageControls
from explorer.session_state import SessionState, StateChange
from explorer.stories import exported
from explorer.stories.story import Step, Story
from explorer.url_state import UrlState
from explorer.web import terms
from explorer.workspace import LazyWorkspace, StateAnalyser, StateAnalysis, Workspace
from lpn import explain
from lpn.analysis.comparison import Comparison
from lpn.core import images
from lpn.core.errors import PictureError
from lpn.datasets import rendered
from lpn.datasets.geo import Position
from lpn.descriptors.transforms import Change
from lpn.drawing import theme, verdicts
from lpn.drawing.words import speaking
from lpn.explain.sweeps import SweepPoint, SweepResult
from lpn.flights.photo_file import PhotoFile
from lpn.library.analyser import OwnPicture
from lpn.library.matching_turn import MatchingTurn, matching_turn
from lpn.locate.belief import disagreements
from lpn.locate.located import LocatedFlight, StageRecord
from lpn.locate.matchers import SiftMatcher, XFeatMatcher
from lpn.maps.named_window import WindowCut
from lpn.sources import SourceOptions
from lpn.tasks.gallery_geometry import GalleryGeometry
from tools.fixtures import small_worlds
from tools.fixtures.published_results import save_result

DEMO = Path(__file__).parents[3] / "assets" / "demo"
PLACE = DEMO.parent / "demo-place" / "caliterra-even"

TASK = "drone-to-satellite"
# Seconds that a workspace may take to open on a busy machine.
PATIENCE = 120.0


@pytest.fixture(scope="module")
def workspace(data: Path, model_file: Path) -> Workspace:
    return open_model(data, model_file)


def analyse(workspace: Workspace, state: SessionState) -> StateAnalysis:
    return StateAnalyser(workspace).analyse(state, 10)


def query(workspace: Workspace, found: bool) -> StateAnalysis:
    """The first query that is found, or that is not."""
    for index in range(len(workspace.tasks[TASK].queries)):
        analysis = analyse(workspace, SessionState(TASK, 4, query=index, first_screen=True))
        if bool(analysis.matches[0].true) == found:
            return analysis
    raise AssertionError(f"no query has found = {found}")


def assert_ungraded(html: str) -> None:
    """No word, sign, or colour calls a piece right or wrong."""
    assert not re.search(r"right (one|picture|tile)|wrong (one|tile)|best wrong|[✓✗]", text(html)), text(html)
    colours = (theme.css(colour) for colour in (theme.TRUE_COLOUR, theme.FALSE_COLOUR))
    for mark in (*colours, "--lpn-right", "--lpn-wrong", "--mark-right", "--mark-wrong"):
        assert mark not in html


def text(html: str) -> str:
    return unescape(" ".join(re.sub(r"<[^>]*>", " ", html).split()))


@pytest.mark.parametrize("found", [True, False])
def test_the_first_screen_has_two_pictures_one_sentence_and_one_button(workspace: Workspace, found: bool) -> None:
    analysis = query(workspace, found)
    html = first_screen.page(analysis, workspace)
    assert html.count("<img") == (2 if found else 3)
    assert html.count("<button") == 1
    right, headline, sentence = answer_text.plain_verdict(analysis, workspace)
    assert (right, headline) == (found, "Right" if found else "Wrong")
    assert sentence in text(html)
    assert sentence.startswith(f"The model compared {len(analysis.task.gallery)} satellite pictures")
    if found:
        placed = replace(analysis, errors_m=np.full(len(analysis.task.gallery), 3.2))
        assert (
            "found the right one, whose middle lies 3 m from the place photographed."
            in answer_text.plain_verdict(placed, workspace)[2]
        )
    else:
        assert analysis.positive is not None
        assert re.search(rf"the right one came {analysis.positive.rank}(st|nd|rd|th)\.$", sentence)
    assert "d²" not in html, "figures are for those who ask why"


def test_the_answer_is_turned_to_lie_like_the_query(workspace: Workspace) -> None:
    by_model = query(workspace, True)
    assert by_model.task.geometry is None
    tiles = [Position(46.0, 8.0)] * len(by_model.task.gallery)
    places = [Position(46.0, 8.0, heading=188.0)] * len(by_model.task.queries)
    known = replace(by_model, task=replace(by_model.task, geometry=GalleryGeometry.of(places, tiles)))
    html = first_screen.page(known, workspace)
    assert "turned 172° to match" in text(html)
    assert re.findall(r"--turn:(-?\d+)deg", html) == ["172"], "the top of the tile is turned clockwise in the page"
    assert "by its known heading" in html
    upright = replace(known, state=replace(known.state, angle=172.0))
    assert "to match" not in text(first_screen.page(upright, workspace)), "the query is north up by now"
    unknown = matching_turn(by_model, by_model.state.query, 0.0, None)
    assert unknown is not None
    assert unknown.source == "model"
    assert matching_turn(known, None, 0.0, None) == unknown, "the heading of an own picture is not known"
    registered = matching_turn(known, known.state.query, 10.0, -30.0)
    assert registered == MatchingTurn(-20.0, "registration")


@pytest.mark.parametrize("found", [True, False])
def test_why_shows_the_lead_part_by_part_and_it_adds_up(workspace: Workspace, found: bool) -> None:
    before = query(workspace, found)
    analysis = analyse(workspace, replace(before.state, why=True))
    lead = answer_text.lead(analysis)
    assert lead is not None
    other = before.positive if not found else next(match for match in before.matches if not match.true)
    assert other is not None
    sign = 1 if found else -1  # positive speaks for the right picture
    assert lead.terms.sum() == pytest.approx(sign * (other.distance2 - before.matches[0].distance2), abs=1e-6)
    assert (lead.terms.sum() > 0) == found
    html = first_screen.page(analysis, workspace)
    assert html.count('class="track"') == 4
    assert f"{lead.shown:+.3f}".replace("-", "−") in text(html)
    assert all(workspace.part_names[part] in text(html) for part in lead.decisive)
    cells = first_screen._lead_cells(analysis, lead)
    assert cells is not None
    np.testing.assert_allclose(cells.sum(axis=(1, 2)), lead.terms, atol=3e-5)
    assert "comes from no place" not in text(html)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(first_screen, "_lead_cells", lambda *_: np.full_like(cells, (lead.shown + 1) / cells.size))
        assert "comes from no place" not in text(first_screen.page(analysis, workspace)), "all of it is of cells"
        patch.setattr(first_screen, "no_place", lambda _: "what re-ranking takes")
        rest = "A further −1.000 comes from no place, but from what re-ranking takes."
        assert rest in text(first_screen.page(analysis, workspace))
    assert html.count("<img") == 3, "the other tile stands beside the answer"
    assert ("The best wrong picture" if found else "The right one") in html
    plain = first_screen.page(before, workspace)
    spoken_for = "this answer" if found else "the right picture"
    assert f"gold places speak for {spoken_for}, blue ones for" in text(html)
    assert f"for {spoken_for} (+) →" in text(html)
    assert f"← for {'the best wrong picture' if found else 'this answer'} (−)" in text(html)
    assert "gold places" not in text(plain)
    assert re.findall(r'src="([^"]+)"', html)[:2] != re.findall(r'src="([^"]+)"', plain)[:2], "parts are not drawn"


def test_rings_that_lead_alike_are_named_together(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    analysis = analyse(workspace, replace(query(workspace, True).state, why=True))
    lead = answer_text.lead(analysis)
    assert lead is not None
    alike = replace(lead, terms=np.array([0.1, 0.312, 0.05, 0.309]))
    monkeypatch.setattr(answer_text, "lead", lambda *_: alike)
    assert workspace.part_names[3] == "4 outer"
    shown = text(first_screen.page(analysis, workspace))
    assert "Parts 2 and 4 (outer) speak most, alike, for this answer (81 % of what speaks for it)" in shown
    assert "No part as a whole speaks for the best wrong picture" in shown


def test_a_picture_that_is_farther_than_right_answers_is_said_to_be_none_of_these(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    picture = OwnPicture("mine.png", np.random.default_rng(5).integers(0, 255, (64, 64, 3)).astype(np.uint8))
    own = analyse(workspace, SessionState(TASK, 4, upload=picture, first_screen=True))
    assert "nothing measured here tells if yours shows one of these places." in text(
        first_screen.page(own, workspace)
    ), "14 are too few"
    monkeypatch.setattr("lpn.analysis.answer_context._FEWEST", 2)
    measured = workspace.answer_distances(own.task)
    assert measured is not None
    result = workspace.rankings[TASK].result
    assert result is not None
    queries, gallery = own.task.sides()
    hits = np.flatnonzero(result.ranking.first == 0)
    right = [float(((queries[i] - gallery[result.ranking.true[i]]) ** 2).sum()) for i in hits]
    np.testing.assert_allclose(measured.right, right, atol=1e-5)
    for shift, headline in ((3.0, "Best match."), (-3.0, "Probably none of these.")):
        moved = replace(measured, right=measured.right + shift)
        monkeypatch.setattr(workspace, "answer_distances", lambda _, moved=moved: moved)
        html = first_screen.page(own, workspace)
        assert ('<details class="bring" open>' in html) == (shift < 0), "another map is the way out"
        shown = text(html)
        assert headline in shown
        of_right = "None of the" if shift > 0 else "All"
        assert f"{of_right} {len(hits)} right answers here are closer to their pictures than this one" in shown
    weighted = analyse(workspace, replace(own.state, weights=(2.0, 1.0, 1.0, 1.0)))
    assert "nothing measured here" in text(first_screen.page(weighted, workspace))


def test_a_lead_is_set_beside_those_of_all_answers(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lpn.analysis.answer_context._FEWEST", 1)
    analysis = analyse(workspace, replace(query(workspace, True).state, why=True))
    assert "right answers." in text(first_screen.page(analysis, workspace))
    turned = analyse(workspace, replace(analysis.state, angle=20.0))
    assert answer_text.context(turned, workspace, 0.1) == "", "it is no lead of the picture as it is"


def test_every_answer_says_how_far_to_trust_it(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    picture = OwnPicture("mine.png", small_worlds.place(3))
    own = analyse(workspace, SessionState(TASK, 4, upload=picture, first_screen=True))
    wrong, right = (query(workspace, found) for found in (False, True))
    assert not any(answer_text.trust(analysis, workspace) for analysis in (own, wrong, right)), "14 are too few"
    monkeypatch.setattr("lpn.analysis.answer_context._ALIKE", 5)
    monkeypatch.setattr("lpn.analysis.answer_context.FEWEST_GRADED", 10)
    result = workspace.rankings[TASK].result
    assert result is not None
    told = 0
    for analysis in (own, wrong, right):
        gap, known = analysis.matches[0].gap, analysis.state.upload is None
        assert gap is not None
        others = [i for i in range(14) if not (known and i == analysis.state.query)]
        nearest = sorted(others, key=lambda i: abs(result.ranking.gap[i] - gap))[:5]
        times = sum(int(result.ranking.first[i]) == 0 for i in nearest)
        shown = text(first_screen.page(analysis, workspace))
        gaps = result.ranking.gap[others]
        if gap > gaps.max():
            assert "How far to trust it" not in shown, "no other answer was that far ahead"
            continue
        told += 1
        pictures = "5 other pictures" if known else "5 pictures"
        words = (
            "How far one would trust it, not knowing that it is wrong" if analysis is wrong else "How far to trust it"
        )
        assert f"{words} : among the {pictures} here whose answer was about as far ahead" in shown
        assert f"it was right {times} times ({20 * times} %)." in shown
        assert ("That holds for pictures like those of" in shown) != known
        reason = text(first_screen.page(analyse(workspace, replace(analysis.state, why=True)), workspace))
        assert f"The answer is {analysis.matches[0].shown_gap:.3f} ahead of the second best. {words}" in reason
    assert told >= 2
    # The gap of a graded query is the one that its ranking tells.
    assert result.ranking.gap[right.state.query] == pytest.approx(right.matches[0].gap, abs=1e-3)
    turned = analyse(workspace, replace(right.state, angle=20.0))
    assert "other pictures here, taken as they are, whose answer" in answer_text.trust(turned, workspace)


def test_figures_of_the_unaltered_model_are_said_to_be_that(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lpn.analysis.answer_context.FEWEST_GRADED", 10)
    weighted = analyse(workspace, replace(query(workspace, True).state, weights=(1.0, 0.0, 0.0, 0.0)))
    shown = text(first_screen.page(weighted, workspace))
    assert "Unaltered, over all 14 pictures its first answer is right" in shown
    assert "How far to trust it" not in shown, "no other query was ranked by these weights"


def test_it_says_how_often_the_model_is_right(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    counts = workspace.counts(workspace.rankings[TASK])
    right = sum(analyse(workspace, SessionState(TASK, 4, query=i)).matches[0].true is True for i in range(14))
    assert f"Over all 14 pictures its first answer is right {right} times" in answer_text.overall(*counts)
    assert answer_text.overall(*counts) in text(first_screen.page(query(workspace, True), workspace))
    assert answer_text.overall(0, 0) == ""
    monkeypatch.setattr(Workspace, "has_flight", True)
    assert "searched by itself, without the flight:" in pages.header(workspace, workspace.tasks[TASK])
    assert "This photo searched by itself:" in pages.verdict(query(workspace, True), workspace)
    assert "%), each searched by itself. How that is judged Right is an answer that shows the same place" in text(
        first_screen.page(query(workspace, True), workspace)
    )


def test_the_open_place_leads_back_to_its_first_picture(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workspace, "choices", {workspace.key: "a city"})
    header = text(first_screen.page(query(workspace, True), workspace).partition("</header>")[0])
    assert header.startswith(f"LPN Explorer a city {workspace.data_name} "), (
        "the name of one place moves no place's button"
    )
    shown: list[SessionState | None] = []
    navigation = SimpleNamespace(**dict.fromkeys(("random", "previous", "next", "next_failure")))
    gui, later = SimpleNamespace(add_html=lambda _: None), SessionState(TASK, 4, query=5, first_screen=True)
    screen = first_screen.FirstScreen(
        gui, workspace, navigation, lambda change: shown.append(change(later)), print, None
    )  # type: ignore[arg-type]
    screen.act("first")
    (first,) = shown
    assert first == replace(later, query=workspace.first_query)
    for state, offered in ((later, True), (first, False)):
        assert ('data-act="first"' in first_screen.page(analyse(workspace, state), workspace)) == offered


def test_an_own_picture_tells_what_becomes_of_it(workspace: Workspace) -> None:
    own = OwnPicture("mine.png", small_worlds.place(3)[:48])
    analysis = analyse(workspace, SessionState(TASK, 4, upload=own, first_screen=True))
    html = first_screen.page(analysis, workspace, own_position=(1, 3))
    assert "pixels; the model sees it pressed into a square." in text(html)
    assert answer_text.OWN_KEPT in text(html)
    assert "2 of 3" in text(html)
    no_link = 'data-tip="A link cannot carry your own picture. “Save” makes a file that can be sent."'
    for own_shown in (html, pages.header(workspace, analysis.task, own=True)):
        assert no_link in own_shown
        assert "lpn.copy()" not in own_shown
        assert 'aria-label="Save this answer"' in own_shown
    assert "lpn.copy()" in pages.header(workspace, analysis.task)
    # The picture is shown in its own shape; explained, it is shown as the model sees it.
    for why, of_height in ((False, 48 / small_worlds.place(3).shape[1]), (True, 1.0)):
        shown = first_screen.page(analyse(workspace, replace(analysis.state, why=why)), workspace)
        encoded = re.search('<img class="whole" src="data:image/jpeg;base64,([^"]*)"', shown)
        assert encoded is not None
        height, width = cv2.imdecode(np.frombuffer(b64decode(encoded[1]), np.uint8), cv2.IMREAD_COLOR).shape[:2]
        assert height / width == pytest.approx(of_height, abs=0.01)
    square = replace(analysis, state=replace(analysis.state, upload=OwnPicture("mine.png", small_worlds.place(3))))
    assert answer_text.own_shape(square, workspace) == ""


def test_the_links_to_the_laboratory_name_its_tab(workspace: Workspace) -> None:
    kept = LabChoices("table", sort_column="rank", columns=("rank",), full_height=True, map="umap", colour="altitude")
    filters = {"outcome": "failed", "filter": "rank > 9", "name_search": "0001"}
    chosen = replace(kept, selections=(Selection("rows", "6 rows", (1, 2)),), **filters)  # type: ignore[arg-type]
    state, shown = SessionState(TASK, 4, first_screen=True, laboratory=chosen), []
    html = SimpleNamespace()
    gui, navigation = SimpleNamespace(add_html=lambda _: html), SimpleNamespace()
    for name in ("random", "previous", "next", "next_failure"):
        setattr(navigation, name, lambda state: state)

    def change(function: StateChange) -> None:
        shown.append(function(state))

    restored: list[SessionState] = []
    screen = first_screen.FirstScreen(gui, workspace, navigation, change, restored.append, None)  # type: ignore[arg-type]
    for action, tab in (("fails", "breakdown"), ("lab", "table")):
        screen.act(action)
        assert shown[-1] == restored[-1]
        assert shown[-1] is not None
        assert shown[-1].lab
        assert shown[-1].laboratory == replace(kept, tab=tab), "it shows all queries"
    screen.fail("It cannot be <read>.")
    assert "lpn.unopened" in html.content
    assert "It cannot be <read>." in unescape(html.content)


def test_a_rendered_city_is_said_to_be_one(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    analysis = query(workspace, True)
    said = "This is a rendered place, no real one"
    assert said not in text(first_screen.page(analysis, workspace))
    for kind in ("is_rendered", "is_rendered_flight"):
        with monkeypatch.context() as patch:
            patch.setattr(rendered, kind, lambda _: True)
            assert said in text(first_screen.page(analysis, workspace))
            with speaking(workspace.vocabulary(True)):
                page = text(first_screen.page(analysis, workspace))
            assert "This is a computer-generated place, no real one" in page
            assert "rendered" not in page, "plain words have another meaning for it"


def test_a_rendered_place_offers_no_picture_that_was_sent_at_another_one(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    analysis, back = query(workspace, True), "Back to your picture"
    assert back in text(first_screen.page(analysis, workspace, own_held=1, own_brought=True)), "the place is real"
    monkeypatch.setattr(rendered, "is_rendered", lambda _: True)
    assert back in text(first_screen.page(analysis, workspace, own_held=1))
    with speaking(workspace.vocabulary(True)):
        page = text(first_screen.page(analysis, workspace, own_held=1, own_brought=True))
    assert back not in page
    assert "Your picture is kept, and is not searched here: this place is computer-generated." in page


def test_a_report_has_the_screen_s_caveats(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = analyse(workspace, replace(query(workspace, False).state, angle=20.0))
    monkeypatch.setattr("lpn.analysis.answer_context._ALIKE", 5)
    monkeypatch.setattr("lpn.analysis.answer_context.FEWEST_GRADED", 10)
    own = small_worlds.place(3)
    data = images.jpeg(own, 90)
    photo = OwnPicture("mine.jpg", own, facts=tuple(PhotoFile.of(data, Path("mine.jpg")).facts))
    with monkeypatch.context() as patch, speaking(workspace.vocabulary(True)):
        patch.setattr(rendered, "is_rendered", lambda _: True)
        told = first_screen.said(wrong, workspace)
        of_own = first_screen.said(analyse(workspace, SessionState(TASK, 4, upload=photo)), workspace)
    job: Any = SimpleNamespace(error=None, value=None, done=2, total=8)
    waiting = replace(analyse(workspace, SessionState(TASK, 4, upload=photo)), own_photo=job)
    early = first_screen.said(waiting, workspace).sentences
    job.error, job.cancelled = "No file <a&amp;b> …", False
    assert "Its details could not be compared with the map: No file <a&amp;b> …" in (
        first_screen.said(waiting, workspace).sentences
    )
    job.error = None
    assert "When this was saved, its details were still being compared with the map." in early
    comparing = first_screen.page(waiting, workspace)
    assert "2 of 8 tries" in text(comparing)
    assert 'value="2" max="8"' in comparing
    assert "Its place is not known yet" in text(comparing)
    assert comparing.count("data:image/jpeg") == 1, "no piece of the map is shown as its place before that ends"
    assert "most similar" not in text(comparing).lower()
    assert 'data-act="why"' not in comparing
    assert [picture.caption for picture in first_screen.said(waiting, workspace).pictures] == ["Your picture"]
    assert told.headline == "✗ Wrong."
    assert told.sentences[0].startswith("The model compared")
    paragraphs = " ".join(told.sentences)
    assert "Altered by: turned 20°." in paragraphs
    assert "How far one would trust it, not knowing that it is wrong: among" in paragraphs
    assert "This is a computer-generated place, no real one: a computer drew it from a plan" in paragraphs
    assert "<" not in paragraphs
    assert [picture.caption for picture in told.pictures] == [
        "A picture from a drone",
        "The model’s answer",
        "The right one",
    ]
    assert dict(told.photo)["File"] == wrong.task.queries[wrong.state.query].path.name
    assert "a photo of a real place has no right answer in it." in " ".join(of_own.sentences)
    assert answer_text.OWN_KEPT not in of_own.sentences, "the file is kept by whom it is given"
    assert dict(of_own.photo)["SHA-256"] == sha256(data).hexdigest()
    assert [picture.caption for picture in of_own.pictures] == ["Your picture", "The model’s answer"]


def test_a_saved_answer_has_the_map_s_digests_and_counts_many_or_large_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [tmp_path / f"{i:02}.tif" for i in range(21)]
    for i, file in enumerate(files):
        file.write_bytes(bytes([i]) * 100_000)
    gone = tmp_path / "town.zip" / "a.tif"
    read: list[tuple[int, int]] = []

    def facts(*of: Path) -> Any:
        sheet = SimpleNamespace(raster=SimpleNamespace(files=lambda: [*of, gone]))
        place: Any = SimpleNamespace(basemap=SimpleNamespace(sheets=[sheet, sheet]))
        return first_screen._map_facts(place, lambda *counted: read.append(counted))

    few = tuple(("Map", f"{file.name}, SHA-256 {sha256(file.read_bytes()).hexdigest()}") for file in files[:20])
    assert facts(*files[:20]) == few, "a file of two sheets is one, and one within an archive none"
    assert read == [(100_000 * i, 2_000_000) for i in range(1, 21)]
    assert facts(*files[:20]) == few
    assert len(read) == 20, "a file is read once"
    files[0].write_bytes(bytes([1]) * 100_000)
    os.utime(files[0], ns=(1, 1))
    few = (("Map", f"00.tif, SHA-256 {sha256(bytes([1]) * 100_000).hexdigest()}"), *few[1:])
    assert facts(*files[:20]) == few, "one that has changed is read again"
    assert len(read) == 21
    assert facts(*files) == (("Map", "21 files of 2 MB, too many or too large for their SHA-256 here"),)
    monkeypatch.setattr(first_screen, "_MOST_MAP_BYTES", 150_000)
    assert facts(files[0]) == few[:1]
    assert facts(*files[:2]) == (("Map", "2 files of 0 MB, too many or too large for their SHA-256 here"),)


def test_a_picture_of_ones_own_is_not_graded(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    own = OwnPicture("mine.png", small_worlds.place(3))
    analysis = analyse(workspace, SessionState(TASK, 4, upload=own, first_screen=True, why=True))
    html = first_screen.page(analysis, workspace)
    assert "Your picture" in html
    assert "not graded" in html
    assert "The city is rendered" not in html
    with monkeypatch.context() as patch:
        patch.setattr(rendered, "is_rendered", lambda _: True)
        closed = analyse(workspace, replace(analysis.state, why=False))
        assert "a photo of a real place has no right answer in it" in first_screen.page(closed, workspace)
    assert "Over all" not in html, "nobody knows how often the model is right on such pictures"
    lead = answer_text.lead(analysis)
    assert lead is not None
    assert lead.other == "the next best picture"
    assert "orange places speak for this answer" in text(html)
    frames = re.findall(r"outline-color:(#\w+)", html)
    assert frames == [theme.css(theme.FOR), theme.css(theme.AGAINST)], (
        "what speaks for a picture has its frame's colour"
    )
    np.testing.assert_allclose(lead.terms.sum(), analysis.matches[0].gap, atol=1e-6)


def test_without_a_network_the_button_shows_everything(data: Path, model_file: Path, tmp_path: Path) -> None:
    save_result(tmp_path / "r.mat", data, model_file)
    saved = open_source(SourceOptions(source=str(tmp_path / "r.mat"), data=data, n_parts=4))
    html = first_screen.page(analyse(saved, SessionState(TASK, 4, first_screen=True)), saved)
    assert "Why?" not in html
    assert re.search(r"<button[^>]*>Show everything<", html)
    assert "Your own picture" not in html


def test_what_the_first_screen_cannot_show_leaves_it() -> None:
    first = SessionState("t", 4, first_screen=True)
    for field in ("lab", "flight", "exploded", "map"):
        assert not session_state.leave_first_screen(first, replace(first, **{field: True})).first_screen
    assert not session_state.leave_first_screen(first, replace(first, selected=3)).first_screen
    for stays in (
        replace(first, query=2),
        replace(first, why=True),
        replace(first, angle=5.0),
        replace(first, dark=False),
    ):
        assert session_state.leave_first_screen(first, stays) == stays
    compared = replace(first, selected=3)
    assert session_state.leave_first_screen(compared, replace(compared, query=1, selected=None)).first_screen
    everything = replace(first, first_screen=False)
    assert session_state.leave_first_screen(everything, replace(first, map=True)).first_screen


def test_what_was_opened_from_the_first_screen_leads_back_to_it() -> None:
    leave, first = session_state.leave_first_screen, SessionState("t", 4, first_screen=True, plain=True)
    for field in ("lab", "flight", "exploded", "map"):
        opened = leave(first, replace(first, **{field: True}))
        turned = leave(opened, replace(opened, angle=9.0))
        back = leave(turned, replace(turned, **{field: False}))
        assert back == replace(first, angle=9.0), field
    # A window over another one leads back to that one first.
    lab = leave(first, replace(first, lab=True))
    both = leave(lab, replace(lab, why=True))
    assert leave(both, replace(both, why=False)) == lab
    # The flight that takes the laboratory's place leads back to it, and the laboratory to the first screen.
    flight = leave(lab, session_state.flip_flight(lab))
    assert (flight.flight, flight.lab) == (True, False)
    again = leave(flight, replace(flight, flight=False))
    assert again == lab
    assert leave(again, replace(again, lab=False)) == first
    assert leave(flight, session_state.to_first_screen(flight)) == first
    # Everything was asked for, so the end of a window shows that.
    everything = leave(first, replace(first, first_screen=False))
    opened = leave(everything, replace(everything, lab=True))
    assert leave(opened, replace(opened, lab=False)) == everything
    # The cells behind the reason are the explain window of the workbench.
    reason = replace(first, why=True)
    cells = leave(reason, replace(reason, first_screen=False))
    assert leave(cells, replace(cells, why=False)) == first
    # The map that takes their place was opened in the workbench, so its end stays there.
    mapped = leave(cells, replace(cells, why=False, map=True))
    assert not leave(mapped, replace(mapped, map=False)).first_screen


def test_an_address_that_names_nothing_opens_the_first_screen_and_any_other_what_it_names(workspace: Workspace) -> None:
    address, plain = UrlState(workspace), SessionState(TASK, 4)
    for bare in ("", "?", "?theme=light", "?words=plain", "?unknown=1"):
        assert not address.names_a_state(bare)
        assert opened_alone(address, workspace, bare, plain).first_screen
    for named in ("?query=0003", "?lab=1", "?screen=all", "?show=data"):
        assert address.names_a_state(named) is (named not in ("?screen=all", "?show=data"))
        assert opened_alone(address, workspace, named, plain) == plain
    first = replace(plain, first_screen=True, start_plain=False, why=True)
    assert address.read(address.write(first), plain) == (first, [])
    assert "screen" not in address.write(plain)


def test_the_workbench_speaks_plain_words_until_everything_is_shown(workspace: Workspace) -> None:
    analysis = query(workspace, True)
    buttons = [""] * 11

    def said() -> str:
        pieces = pages.header(workspace, analysis.task), pages.verdict(analysis, workspace)
        return text(
            "".join((*pieces, pages.matches(analysis, workspace, buttons), pages.parts_table(analysis, workspace)))
        )

    with speaking(workspace.vocabulary(True)):
        plain = said()
    expert = said()
    for word in ("part ", "d²", "R@1", "AP ", "cosine", "level", "gap"):
        assert word in expert
        assert word not in plain
    for word in (
        "ring ",
        "right at once",
        "It leads the nearest wrong tile by ",
        "how far the next one is behind",
        "likeness",
    ):
        assert word in plain
    state = SessionState(TASK, 4, first_screen=True, plain=True)
    everything = session_state.show_everything(state)
    assert (everything.plain, everything.first_screen) == (False, False)
    # The first screen speaks as before, or as the switch was set meanwhile.
    assert session_state.to_first_screen(everything) == state
    chosen = session_state.flip_words(session_state.flip_words(everything))
    assert not session_state.to_first_screen(chosen).plain
    address = UrlState(workspace)
    assert "words=plain" in address.write(state)
    assert address.read("?words=plain", SessionState(TASK, 4)) == (SessionState(TASK, 4, plain=True), [])
    assert not address.read("?words=expert", state)[0].start_plain


def test_terms_have_the_glossary_s_meaning() -> None:
    assert terms.meanings()["distance"].startswith("How far two descriptors lie apart: d, with d² = 2 − 2 · score")
    assert not [meaning for meaning in terms.meanings().values() if re.search(r"\*\*|`|\]\(", meaning)]
    html = terms.term("margin", "Lead <1>")
    assert 'data-tip="margin: The lead of the right tile' in html
    assert html.endswith(">Lead &lt;1&gt;</span>")
    with pytest.raises(KeyError):
        terms.term("no such term")


@pytest.mark.parametrize("found", [True, False])
def test_on_the_demo_the_constants_of_both_tiles_lie_on_the_cells_of_their_parts(found: bool) -> None:
    demo = open_model(DEMO, DEMO / "lpn.onnx")
    before = query(demo, found)
    analysis = analyse(demo, replace(before.state, why=True))
    lead = answer_text.lead(analysis)
    assert lead is not None
    assert analysis.query.trace is not None
    weights = analysis.ranking.weights
    answer, other = (
        float(
            (
                explain.side_evidence(analysis.query.trace, analysis.task.gallery_descriptors[index]).constants
                * weights
            ).sum()
        )
        for index in (before.matches[0].index, lead.index)
    )
    assert abs(answer - other) > 0.005, "the demo's network has constants"
    cells = first_screen._lead_cells(analysis, lead)
    assert cells is not None
    np.testing.assert_allclose(cells.sum(axis=(1, 2)), lead.terms, atol=3e-5)
    shown = text(first_screen.page(analysis, demo))
    assert "comes from no place" not in shown
    ((method, said),) = first_screen._because(analysis, demo, lead, cells)
    assert method == "", "it is the only one"
    assert said[0] in shown
    assert re.match(r"(Part|Only part|Parts) .* speaks? (most )?.*for this answer", said[0])
    # The sentence names the part that the table of the numbers and the workbench name, with its share.
    terms = (1 if found else -1) * lead.terms
    assert f"{int(terms.argmax()) + 1}" in said[0].partition("speak")[0]
    assert lead.decisive == verdicts.leading_parts(terms)
    share = terms[lead.decisive].sum() / np.maximum(terms, 0).sum()
    assert f"({100 * share:.0f} % of what speaks for it)" in said[0]
    assert said[1].startswith("No ") == (terms.min() >= 0), "no part speaks against the answer as a whole"
    assert re.search("show", said[0] + said[1]), "the plan of the city tells what lies there"


def test_the_demo_s_tiles_show_what_the_plan_of_the_city_says() -> None:
    demo = open_model(DEMO, DEMO / "lpn.onnx")
    task = demo.tasks[TASK]
    grounds = [demo.ground_of(task, index) for index in range(task.tiles)]
    # The building that a tile is of stands in its middle.
    built = [ground is not None and "b" in ground.letters[6:10, 6:10] for ground in grounds]
    assert sum(built) >= 0.95 * len(built)


def test_what_only_the_city_has_opens_the_city(monkeypatch: pytest.MonkeyPatch) -> None:
    for options in ({"query": "0394/06"}, {"calibrate": True}, {"beside_weather": ("fog",)}):
        opening = Explore(**options).workspaces()
        assert (opening.key, opening.label, [*opening.others]) == (
            "data",
            "a computer-generated city",
            ["place", "flight"],
        )
    monkeypatch.setattr("explorer.cli.find_spec", lambda _: None)  # without the extra `maps`
    assert Explore().workspaces().key == "data"
    assert Explore(source=str(DEMO), model=DEMO / "lpn.onnx").workspaces().others == {}


def assert_details_come_first(workspace: Workspace, state: SessionState, monkeypatch: pytest.MonkeyPatch) -> None:
    """The reason begins with the details in photo and map, and ends with the rings; without an accepted place it shows none."""
    html = first_screen.page(analyse(workspace, state), workspace)
    in_photo, on_map = html.partition("The map about it")[::2]
    for half in (in_photo, on_map.partition("<table")[0]):
        assert re.findall(r'<i class="pin[^"]*" data-pin="(\d+)"', half) == [str(number) for number in range(1, 25)]
    order = [html.index(words) for words in ("268 details of the photo", "By its look</h2>", "The query, ")]
    assert order == sorted(order), "the rings come last"
    told = text(html)
    assert (
        "268 details of the photo lie on the map where they should: half of them within 0.43 m, and all within 0.9 m, beyond "
        "which none counts. 24 of them have a number." in told
    )
    offs = [float(metres) for metres in re.findall(r"<td>([\d.]+) m</td>", html)]
    assert len(offs) == 24
    assert 0 < min(offs) < max(offs) <= 0.9
    with monkeypatch.context() as patch:
        patch.setattr(first_screen, "_because", lambda *_: [])
        unexplained = first_screen.page(analyse(workspace, state), workspace)
    assert "The query, " in unexplained, "without places of the lead, the pictures that were compared are shown"
    assert unexplained.count("<tr data-pin=") == 24
    with monkeypatch.context() as patch:
        patch.setattr(images, "load_picture", Mock(side_effect=PictureError("gone")))
        again = first_screen.page(analyse(workspace, state), workspace)
        assert again.count("data-pin") == html.count("data-pin"), "photo and map are drawn once"
        details_pair._draw_once.cache_clear()
        gone = first_screen.page(analyse(workspace, state), workspace)
    assert "data-pin" not in gone
    assert "268 details of the photo lie where the map has them: they place it." in text(gone)
    assert workspace.flight is not None
    stages = workspace.flight.frames[state.query].stages
    before = stages["registration"]
    stages["registration"] = msgspec.structs.replace(before, state="refused", sentence="Too few agree.")
    refused = first_screen.page(analyse(workspace, state), workspace)
    stages["registration"] = before
    assert "data-pin" not in refused
    assert "well enough to place it, so no detail is shown. Too few agree." in text(refused)


def test_a_real_photo_is_shown_on_its_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rasterio")
    monkeypatch.setenv("LPN_CACHE", str(tmp_path))
    opening = Explore().workspaces()
    assert (opening.key, opening.label) == ("place", "a real flight")
    assert {key: other.label for key, other in opening.others.items()} == {
        "data": "a computer-generated city",
        "flight": "a computer-generated flight",
    }
    workspace = opening.open_workspace()
    assert workspace.registration is not None
    assert workspace.registration.wait(PATIENCE)
    state = SessionState(TASK, 4, query=workspace.first_query, first_screen=True)
    monkeypatch.setattr(answer_text, "open_matchers", lambda: [SiftMatcher()])
    assert "photos of other places" not in text(first_screen.page(analyse(workspace, state), workspace)), "XFeat, too"
    monkeypatch.setattr(answer_text, "open_matchers", lambda: [XFeatMatcher(), SiftMatcher()])
    page = first_screen.page(analyse(workspace, state), workspace)
    said = text(page)
    assert "a place that the model was not trained on" in said
    assert "✓ By its look: right, judged by its details." in said
    assert (
        "The chosen piece is 37 m wide; by its details, the photo's middle lies on it, 3 m from its middle, where 18 m each way "
        "are allowed." in said
    )
    with speaking(workspace.vocabulary(True)):
        plain = text(first_screen.page(analyse(workspace, state), workspace))
    assert "GPS tags place this map, so a tag of the same flight is no independent proof." in plain
    told = re.findall(r"[\d.]+ m\b", plain[plain.index("By its details: placed") : plain.index("How far to trust it")])
    assert told == ["18.2 m", "10 m", "37 m"], (
        "how exact, one distance of the tag, and the size of the piece; limits are folded"
    )
    assert re.search(r"On the map, by its details \d+ m west", said)
    assert (
        "✓ By its details: placed, ± 6.1 m on earth (not confirmed). ± 6.1 m should hold for 39 of 100 photos, and 12.1 m for "
        "86; the check of this flight does not confirm it. GPS tags place this map, so a tag of the same flight is no "
        "independent proof. 268 details of the photo lie where the map has them. Its GPS tag, the "
        "white circle, lies 10 m from there, where 32 m are allowed. "
        "The photo's middle lies at 30.171" in said
    )
    assert page.count("data:image/jpeg") == 3
    tips = " ".join(unescape(page).split())
    assert "39 of 100 places lie within 6.1 m of the true one, and 86 within 12.1 m" in tips
    with speaking(workspace.vocabulary(True)):
        tips = " ".join(unescape(first_screen.page(analyse(workspace, state), workspace)).split())
    assert "99 of 100 places lie within 18.2 m of the true one. That is three times ± 6.1 m, which is 1 sigma" in tips
    assert re.search(
        r"It joins ± [\d.]+ m for the place on this map and ± 6.0 m for the map's own place on earth", tips
    )
    assert re.search(r"Check: \d+, \d+, and \d+ % of the flight's photos lie within one, two, and three radii", tips)
    assert "So the check does not confirm the radius" in tips
    assert "On the map, by" not in text(first_screen.page(analyse(workspace, replace(state, why=True)), workspace))
    with speaking(workspace.vocabulary(True)):
        assert_details_come_first(workspace, replace(state, why=True), monkeypatch)
    assert "compared 224 pieces of the map" in said
    assert "drone → map" in text(pages.header(workspace, workspace.tasks[TASK])), "no satellite took its picture"
    # Its tags are late, so the registrations that ship with it say what is right.
    flight = workspace.flight
    assert flight is not None
    assert flight.late_tags is not None
    assert flight.late_tags.lag == pytest.approx(2.81, abs=0.01)
    assert (
        "Right is a piece, 26 to 100 m wide, on which the photo's middle lies, so the middle of a large piece may lie farther "
        "off than that of a small one. GPS tags here lie 15 m off" in said
    )
    assert "some of which a lag of 2.8 s explains, so the judge is the program's second method" in said
    ranking = workspace.rankings[TASK].result
    assert ranking is not None
    right = [bool(first == 0) for first in ranking.ranking.first]
    flight_names = workspace.tasks[TASK].query_names
    assert (
        "How far to trust it: of 26 graded photos, 22 were right by their look alone; their details placed all 30, 4 of them in "
        "doubt; 9 more could not be checked away from the middle. Nobody measured where they really are. Of 68 photos of other "
        "places, none was placed on this map. Photos of damage, such as a storm's, and real photos of another season than the "
        "map's have not been tried." in said
    )
    assert (
        "In doubt is a photo whose GPS tag lies elsewhere (1 here), or one that does not fit the map away from its "
        "middle (3 more here)." in said
    )
    last = flight.frames[-1]
    waiting = replace(last, stages={name: answer for name, answer in last.stages.items() if name != "registration"})
    comparing = replace(flight, frames=[*flight.frames[:-1], waiting])
    with monkeypatch.context() as while_compared:
        while_compared.setattr(workspace, "flight", comparing)
        said = text(first_screen.page(analyse(workspace, state), workspace))
        wrong = np.flatnonzero(~np.array(right[:-1]))
        overall = [wrong_answer._overall(rows, np.ones(30, bool), workspace) for rows in (wrong, np.array([29]))]
    assert re.search(r"their details placed all 29 so far, 4 of them in doubt", said)
    assert "so far" not in overall[0]
    assert "by their details, so far 0 of these 1 are placed" in overall[1]
    with speaking(workspace.vocabulary(True)):
        told = first_screen.said(analyse(workspace, state), workspace)
    assert workspace.basemap is not None
    _, file = reports.of_analysis(workspace, analyse(workspace, state), said=told)
    for sentence in (
        "✓ By its details: placed.",
        "268 details of the photo lie where the map has them.",
        "The photo's middle lies at 30.17132, -98.09001.",
        "Nobody measured where they really are.",
        "It should lie within 18.2 m of the true place on earth; nobody knows if it does: only 19 of 30 photos here lie that "
        "near to their GPS tags, where nearly all should. The tags may be off, too.",
        "Its GPS tag, the white circle, lies 10 m from there, which is within what is allowed.",
        "found the piece where details place the photo: it is 37 m wide, and that place lies on it.",
        "the photo's middle lies on it, 3 m from its middle, where 18 m each way are allowed. A GPS tag may lie 32 m from",
        "of the flight's photos lie within one, two, and three radii of their GPS tags",
        "The tags may be off, too. GPS tags place this map, so a tag of the same flight is no independent proof.",
        *(sha256(path.read_bytes()).hexdigest() for sheet in workspace.basemap.sheets for path in sheet.raster.files()),
        "Caliterra in Dripping Springs, Texas",
        "All 26 graded queries of the data set together: R@1 84.6 % (true tile first)",
    ):
        assert sentence in unescape(file.decode())
    words, experts = unescape(file.decode()).split("For experts")
    assert words.count("<circle ") == 2 * 24, "the details are numbered in photo and map"
    assert "half of them within 0.43 m, and all within 0.9 m" in words
    assert len(re.findall(r"\d+: 0\.\d\d m", words)) == 24
    title = re.search(r'title="([^"]*)"[^>]*>turned 11° to match', page)
    assert title is not None
    assert (
        "Its top points to 359.2° by its details, and to 10.5° by the heading with which the model searched" in title[1]
    )
    with speaking(workspace.vocabulary(True)):
        why = text(first_screen.page(analyse(workspace, replace(state, why=True)), workspace))
    methods = dict(told.reasons)
    assert list(methods) == ["By its details", "By its look"]
    for sentence in methods["By its look"]:
        assert sentence in words, "a saved answer names the ring that the screen names"
        assert sentence in why
    assert "speaks most for this answer" in methods["By its look"][0]
    assert [picture.caption for picture in told.pictures] == [
        "A picture from a drone",
        "The model’s answer",
        "On the map, by its details",
    ]
    assert all(picture.source in words for picture in told.pictures)
    assert "IMG_9408.webp, its middle" in words
    for row in (
        ("File", "IMG_9408.webp"),
        ("SHA-256", sha256((PLACE / "IMG_9408.webp").read_bytes()).hexdigest()),
        ("Taken", "2014-10-19 13:22:45 by the camera's clock, 2014-10-19 18:22:45 UTC"),
        ("Camera", "Canon PowerShot SX260 HS"),
    ):
        assert "<dt>{}</dt><dd>{}</dd>".format(*row) in words
    for term in ("OpenStreetMap", "satellite", "R@1", "d²", "true tile"):
        assert term not in words
    assert "every one of the pieces of the map" in experts
    assert "30 queries (26 of known place, for certain, which are graded), 224 tiles, pieces of the map" in experts
    assert "Contents" not in experts
    bent = next(i for i, frame in enumerate(flight.frames) if frame.frame.name == "IMG_9405.webp")
    unfit = text(first_screen.page(analyse(workspace, replace(state, query=bent)), workspace))
    assert "on earth (not confirmed), but away from its middle it does not fit the map." in unfit
    (misfit,) = (one.sentence for one in disagreements(flight.frames) if (one.frame, one.other) == (bent, "map"))
    assert misfit.startswith("Away from its middle, the photo lies 6.")
    assert misfit in unfit
    reasons = text(first_screen.page(analyse(workspace, replace(state, query=bent, why=True)), workspace))
    assert reasons.index("By its details The numbered details") < reasons.index(misfit) < reasons.rindex("By its look")
    in_doubt = analyse(workspace, replace(state, query=bent))
    html, panel = first_screen.page(in_doubt, workspace), pages.verdict(in_doubt, workspace)
    assert 'color:var(--lpn-contradicted)">?' in html
    assert "On the map, by its details: in doubt" in text(html)
    red = theme.css(theme.COLOURS["contradicted"])
    assert f"outline-color:{red}" in html
    assert f"border-color:{red}" in panel
    saved = first_screen.said(in_doubt, workspace).pictures[-1]
    assert (saved.caption, saved.doubted) == ("On the map, by its details: in doubt", True)
    for one in (
        first_screen.page(analyse(workspace, state), workspace),
        pages.verdict(analyse(workspace, state), workspace),
    ):
        assert "contradicted" not in one
        assert red not in one
    # The box on the map has the colour of the verdict.
    for frame, other, colour in ((workspace.first_query, bent, "right"), (bent, workspace.first_query, "contradicted")):
        laid = first_screen._laid(flight.frames[frame], workspace, own=False)
        assert laid is not None
        encoded = np.frombuffer(b64decode(laid.picture.partition(",")[2]), np.uint8)
        drawn = cv2.imdecode(encoded, cv2.IMREAD_COLOR)[..., ::-1].astype(int)
        near = {
            name: int((np.abs(drawn - theme.COLOURS[name]).max(axis=2) < 60).sum())
            for name in ("right", "contradicted")
        }
        assert near[colour] == max(near.values()) > 200, (other, near)
    # Where tag and details agree, neighbours that differ leave no doubt which of the answers errs.
    settled = flight.frames[workspace.first_query]
    before = settled.stages["sequence"]
    settled.stages["sequence"] = msgspec.structs.replace(before, state="accepted", x=500.0, y=0.0, radius=1.0)
    with speaking(workspace.vocabulary(True)):
        reasons = text(first_screen.page(analyse(workspace, replace(state, why=True)), workspace))
    assert "Its neighbours would place it" in reasons
    assert "Nothing here tells" not in reasons
    settled.stages["sequence"] = before
    unchecked = flight_names.index("IMG_9365.webp")
    said = text(first_screen.page(analyse(workspace, replace(state, query=unchecked)), workspace))
    assert (
        "Away from its middle, only 1 place of the photo could be found on the map. At least 3 such places are needed to check "
        "that the photo fits there, too." in said
    )
    assert re.search(r"✓ By its details: placed, ± [\d.]+ m on earth \(not confirmed\), at least its middle\.", said)
    with speaking(workspace.vocabulary(True)):
        fails = session_state.show_fails(state, flight_names.index("IMG_9395.webp"), 30)
        of_wrong = text(first_screen.page(analyse(workspace, fails), workspace))
    assert "By their look alone, the first answer is wrong for 4 of 26 graded pictures (15 %)." in of_wrong
    assert "✗ By its look: wrong, judged by its details." in of_wrong
    headline = analyse(workspace, fails).verdict.headline
    assert re.match("Rings? ", headline)
    assert f"{headline}." in of_wrong
    assert (
        "and chose one that lies 50 m to the south-west; the piece where details place the photo came 2nd." in of_wrong
    )
    assert (
        "the photo's square shows 45 m of ground from side to side, this answer 26 m and the piece where details place the photo "
        "100 m." in of_wrong
    )
    assert (
        "of the true place on earth; nobody knows if it does: only 19 of 30 photos here lie that near to their GPS tags, where "
        "nearly all should." in of_wrong
    )
    assert "±" not in of_wrong
    navigation, shown = Navigation(workspace, lambda *_: None), [state]
    for _ in range(right.count(False) - 1):
        after = navigation.next_failure(shown[-1])
        assert after is not None
        shown.append(after)
    signs = [FlightView.of(flight, {}, "").beliefs[one.query].sign for one in shown[1:]]
    assert signs == [True, True, True, True], "only an answer that is wrong for certain is a wrong one"
    with monkeypatch.context() as patch:
        # The tag judges it and its details agree with the tag, so that the map beside its middle casts no doubt on the answer.
        patch.setattr(LocatedFlight, "judge_of", lambda *_: "its GPS tag")
        patch.setattr(workspace, "flight", replace(flight))
        after = navigation.next_failure(state)
        assert after is not None
        assert after.query not in [one.query for one in shown]
        assert {one.other for one in disagreements(flight.frames) if one.frame == after.query} == {"map"}
        assert "✗ By its look: wrong, judged by its GPS tag." in text(
            first_screen.page(analyse(workspace, after), workspace)
        )
    with monkeypatch.context() as patch, speaking(workspace.vocabulary(True)):
        patch.setattr(judge, "confirmed", lambda _: True)
        of_first = text(first_screen.page(analyse(workspace, state), workspace))
        assert "the right one: it is 37 m wide, and the place by its details lies on it." in of_first
    with monkeypatch.context() as patch, speaking(workspace.vocabulary(True)):
        name = flight.frames[workspace.first_query].frame.name
        patch.setattr(flight, "shipped", {key: one for key, one in flight.shipped.items() if key != name})
        of_first = text(first_screen.page(analyse(workspace, state), workspace))
        assert "right, judged by its GPS tag without its lag." in of_first
        assert "found the piece where the photo's GPS tag lies without its lag: it is" in of_first
        assert "by its GPS tag without its lag, the photo's middle lies on it, " in of_first
    # The page of wrong answers, the first screen, its reasons, and the flight window say the same of each photo.
    placed, doubted, *_ = (i for i, was_right in enumerate(right) if not was_right)
    of_doubted = flight.frames[doubted]
    assert of_doubted.tag is not None
    of_doubted.tag = of_doubted.tag + 100
    workspace.flight = flight = replace(flight)
    beliefs = FlightView.of(flight, {}, "").beliefs
    assert (beliefs[placed].sign, beliefs[doubted].sign) == (True, None)
    for index, headline, by_look in (
        (
            placed,
            " m away. ✓ By its details: placed, ± 6.1 m on earth (not confirmed).",
            "✗ By its look: wrong, judged by its details.",
        ),
        (
            doubted,
            "? By its details: placed, ± 6.1 m on earth (not confirmed), but its GPS tag disagrees.",
            "? By its look: wrong, if its details are right.",
        ),
    ):
        for why in (False, True):
            html = first_screen.page(analyse(workspace, replace(state, query=index, why=why)), workspace)
            said = text(html)
            if why and index == doubted:
                behind, ahead = (theme.css(colour) for colour in (theme.AGAINST, theme.FOR))
                assert re.findall(r'class="frame" style="outline-color:(#\w+)', html) == [behind, ahead]
                assert re.search(
                    rf"background:{ahead}.{{,80}}places speak for the piece where details", html, re.DOTALL
                )
            assert f"{by_look} The model compared 224 pieces" in said
            limit = re.search(
                r"The chosen piece is \d+ m wide; by its details, the photo's middle lies beyond its edge\.", said
            )
            assert (limit is None) == why
            assert headline in said
            assert ("✗ The model's own guess, by its look alone, was wrong, " in said) == (index == placed)
            if why:
                assert ("Right, if its details are right" in said) == (index == doubted)
                assert ("are those of the two frames: orange" in said) == (index == doubted), said
            assert ("By its look, which errs" in said) == why
            assert ("which errs if its details are right" in said) == (why and index == doubted)
            assert ("GPS tag, the white circle, lies " in said) != why
            # Nothing confirms the judge, so no piece is called right without it.
            assert not re.search(r"right (one|picture|tile)|best wrong", said), said
            assert ("for the piece where details place the photo" in said) == why
    with speaking(workspace.vocabulary(True)):
        fails = session_state.show_fails(state, doubted, 30)
        html = first_screen.page(analyse(workspace, fails), workspace)
    assert "? By its look: wrong, if its details are right. The model compared" in text(html)
    assert "? By its details: placed, but its GPS tag disagrees." in text(html)
    assert "the first answer is wrong for" not in text(html), "it is none of the wrong answers"
    assert theme.css(theme.COLOURS["wrong"]) not in html
    assert theme.css(theme.COLOURS["right"]) not in html
    # Nor does the workbench call it right.
    with speaking(workspace.vocabulary(True)):
        analysis = analyse(workspace, replace(state, query=doubted, first_screen=False))
        assert analysis.positive is not None
        compared = Comparison.of(analysis.ranking, analysis.positive)
        bars = StageControls(workspace, navigation, print).html(analysis, layout_for(workspace.contract.input_size))
        for html in (bars, comparison.page(analysis, workspace, compared, None, computing=False)):
            assert "the piece where details place the photo" in text(html)
            assert_ungraded(html)
        assert "var(--mark-against)" in bars
        assert re.search("(puts|put) first the piece where details place the photo", text(html))
        positive, top = analysis.positive, analysis.matches[0]
        point = SweepPoint(
            Change(), positive.index, True, positive.score, positive.rank, positive.cosines, top.index, top.score
        )
        sweep = sweep_page.page(
            analysis,
            "rotation",
            SweepResult("rotation", (point,)),
            1,
            workspace.part_names,
            judged=judge.judged_piece(analysis, workspace),
        )
        assert "Best for the piece where details place the photo: " in text(sweep)
        beside = LazyWorkspace("the same", lambda: workspace)
        assert beside.open().wait(PATIENCE)
        with monkeypatch.context() as patch:
            patch.setattr(workspace, "beside", [beside])
            models = model_comparison.ModelComparison(workspace, RequestContext(workspace.inference))
            columns = re.sub(r"(?s)Where the place in the list.*", "", models.page(analysis))
        below = replace(analysis, matches=[one for one in analysis.matches if one.index != positive.index][:1])
        listed = pages.matches(below, workspace, ["first", "last"])
        for html in (sweep, columns, listed, pages.verdict(analysis, workspace)):
            assert_ungraded(html)
        heat = activation.page(analysis, workspace, workspace.tile(analysis.task, positive.index))
        assert_ungraded(heat)
        for html in (columns, listed, heat):
            assert "the piece where details place the photo" in text(html)
        views = Mock(_workspace=workspace)
        ClientViews._draw_stage(views, analysis)
        assert views.stage.show.call_args.args[0].chosen.true is None
    with speaking(workspace.vocabulary(False)):
        said = text(pages.verdict(analysis, workspace))
        assert not re.search("[✓✗]|Wrong|true tile|place photographed", said)
        assert "? By its look: wrong, if its details are right The model compared 224 pieces" in said
        assert "wrong tile" not in comparison.page(analysis, workspace, compared, None, computing=False)
    # Nor do the table, the map, and a report's part for experts.
    lab = FailureLab(workspace)
    assert lab.build(state.task, lab).wait(PATIENCE)
    findings = lab.findings(state.task)
    assert findings is not None
    cells = table.visible_columns(findings, LabState(task=state.task))
    row, sure_row = (line for _, line in table.lines(findings, cells, Mock(), np.array([doubted, placed])))
    assert_ungraded(row + table.tip(findings, workspace, np.array([doubted]), 1))
    assert 'title="Not graded' in row
    assert "✗" in sure_row
    colours = map_data.colours(findings, map_data.OUTCOME)
    assert [colours.labels[colours.codes[i]] for i in (doubted, placed)] == ["not graded", "failed"]
    flags = np.frombuffer(map_data.flags(findings, np.arange(30), np.array([])), np.uint8)
    assert [bool(flags[i] & map_data.FAILED) for i in (doubted, placed)] == [False, True]
    ground = lab.points("ground", state.task, lab)
    assert ground.wait(PATIENCE)
    assert ground.value is not None
    joined = [query for query, _ in map_data.lines(findings, ground.value, np.arange(30))]
    assert (doubted in joined, placed in joined) == (False, True)
    ranking = workspace.rankings[state.task]
    assert [sign for *_, sign in entries(ranking, [doubted, placed], workspace.graded(ranking))] == [None, 0]
    address = UrlState(workspace)
    for make in (
        lambda: reports.of_analysis(workspace, analysis),
        lambda: reports.of_selection(workspace, findings.task, [doubted], "one"),
        lambda: exported.export(workspace, address, Story("One", (Step(address.write(analysis.state)),))),
    ):
        experts = make()[1].decode().partition("</style>")[2].partition("<section")[2]
        assert "It is not graded, as no tile is right for certain" in text(experts)
        assert not re.search(r'class="sign (true|false)"|"framed (true|false)"|true tile|[Ww]rong tile', experts)
    with monkeypatch.context() as patch:
        patch.setattr(place_text, "share_off_map", lambda _: 0.25)
        wrong = analyse(workspace, replace(state, query=placed))
        said = text(first_screen.page(wrong, workspace))
        assert f"25 % of this answer is off the map, and black to the model. {wrong.verdict.headline}." in said
        fails = text(first_screen.page(analyse(workspace, replace(state, query=placed, fails=True)), workspace))
        assert fails.count("25 % of this answer is off the map") == 1
    # A sure judge keeps its signs.
    sure = analyse(workspace, replace(state, query=placed, first_screen=False))
    assert judge.shown(sure, workspace) is sure
    assert "✗" in pages.matches(sure, workspace, [""] * 11)
    assert 'class="sign false"' in reports.of_analysis(workspace, sure)[1].decode()
    with monkeypatch.context() as patch:
        patch.setattr(LocatedFlight, "judge_of", lambda *_: "its GPS tag")
        said = text(first_screen.page(analyse(workspace, replace(state, query=doubted)), workspace))
        assert "The model's own guess, by its look alone, was wrong, " in said
        assert "which are doubtful" not in said, "the details did not judge it"
    before = flight.frames[placed].stages["registration"]
    flight.frames[placed].stages["registration"] = StageRecord("refused", "Few agree.")
    flight.frames[placed].stages.pop("sequence", None)
    said = text(first_screen.page(analyse(workspace, replace(state, query=placed)), workspace))
    assert "? Not placed, a best guess only. Its details fit nowhere well enough." in said
    assert "✗ By its look: wrong, judged by its details." in said
    assert "The piece where details place the photo" in said
    # A photo that is graded by a place off all pieces.
    off = replace(analyse(workspace, replace(state, query=placed)), positive=None)
    nowhere = (
        "The place that the photo is graded by lies on none of the 224 pieces of the map, so no answer counts as right."
    )
    said = text(first_screen.page(off, workspace))
    assert f"? Not graded. {nowhere}" in said
    flight.frames[placed].stages["registration"] = before
    said = text(first_screen.page(off, workspace))
    assert f"? Not graded. {nowhere}" in said
    assert "✓ By its details: placed" in said
    for query, sentence in ((right.index(True), "it lies elsewhere"), (right.index(False), "it lies on this piece")):
        shown = analyse(workspace, replace(state, query=query))
        assert "the map disagree" not in text(first_screen.page(shown, workspace))
        cut = shown.task.gallery[shown.matches[0].index].cut
        assert isinstance(cut, WindowCut)
        record = flight.frames[query].stages["registration"]
        x = cut.window.x + (2 * cut.window.size if right[query] else 0)
        flight.frames[query].stages["registration"] = msgspec.structs.replace(record, x=x, y=cut.window.y)
        said = text(first_screen.page(shown, workspace))
        assert "Its GPS tag and the map disagree" in said
        assert sentence in said
    assert list(tmp_path.rglob("*.npy")) == []
