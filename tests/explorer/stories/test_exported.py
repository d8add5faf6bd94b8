from __future__ import annotations

import base64
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from explorer.failure_lab import map_data
from explorer.failure_lab.service import MapPoints
from explorer.session_state import SessionState
from explorer.stories import exported, ground
from explorer.stories.map_picture import MapPicture
from explorer.stories.story import Step, Story
from explorer.stories.windows import ROWS, WindowSources, draw_queries
from explorer.url_state import UrlState
from explorer.workspace import StateAnalyser, Workspace
from lpn.core.errors import InputError
from lpn.drawing import theme
from tests.explorer.stories.conftest import TASK


def test_an_export_shows_each_step_and_needs_nothing_else(workspace: Workspace, sources: WindowSources) -> None:
    names = workspace.tasks[TASK].query_names
    told = Story(
        'A <b>"story"</b>',
        (
            Step(f"query={names[0]}", "<script>alert(1)</script>", "not for the audience"),
            Step(f"query={names[1]}&map=1", "second"),
            Step(f"query={names[2]}&why=1&off=2", "third"),
        ),
    )
    steps: list[tuple[int, int]] = []
    name, data = exported.export(sources, UrlState(workspace), told, True, lambda *now: steps.append(now))
    page = data.decode()
    assert name == "A--b--story---b-.html"
    assert steps == [(1, 3), (2, 3), (3, 3)]
    assert page.count('<section class="slide') == 3
    assert "alert(1)" in page
    assert "<script>alert" not in page
    assert "<b>&#34;story" not in page
    assert "not for the audience" not in page
    for shown in names[:3]:
        assert f"drone {shown}<" in page
    assert "Altered by: part weights 33 : 0 : 33 : 33 %." in page
    assert page.count('class="map"') == 1
    assert len(re.findall(r"adds most to the score", page)) == 1
    sources = re.findall(r'src="([^"]{0,40})', page)
    assert sources
    assert all(source.startswith("data:image/jpeg;base64,") for source in sources)
    assert not re.findall(r"(?:href|url\(|@import|https?:)", page)
    for encoded in re.findall(r'src="data:image/jpeg;base64,([^"]+)"', page):
        assert cv2.imdecode(np.frombuffer(base64.b64decode(encoded), np.uint8), cv2.IMREAD_COLOR) is not None


def test_an_export_is_utf_8_whatever_its_markup_holds(
    workspace: Workspace, sources: WindowSources, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exported, "render", lambda *_, **__: "<p>caf\udce9\x1b\u202e\n")
    assert exported.export(sources, UrlState(workspace), Story("a", ()), True)[1] == b"<p>caf???\n"


def links_and_handlers(page: str) -> list[str]:
    """Find addresses other than data, and handlers of clicks, which need a server."""
    return re.findall(r"""(?:src|href)="(?!data:)[^"]*"|onclick=|url\(|@import|https?:""", page)


def test_a_step_with_the_laboratory_exports_the_rows_that_it_shows(
    workspace: Workspace, sources: WindowSources
) -> None:
    names = workspace.tasks[TASK].query_names
    told = Story(
        "Lab",
        (
            Step(f"query={names[0]}&lab=1&where=rank > 0&sort=name&order=down&columns=latitude"),
            Step("lab=1&tab=breakdown"),
            Step("lab=1&tab=maps&by=rank"),
            Step("lab=1&tab=maps&on=ground"),
        ),
    )
    page = exported.export(sources, UrlState(workspace), told, False)[1].decode()
    table, breakdown, pca, ground_map = page.split('<section class="slide')[1:]
    cells = re.findall(r'<td class="text"[^>]*>(?:<[^>]*>)*([^<]+)', table)
    assert [cell for cell in cells if cell in names] == sorted(names, reverse=True)[:ROWS]
    assert "6 of 6 queries" in table
    assert "rank &gt; 0, sorted by name, descending" in table
    assert len(re.findall(r'<tr class="chosen">', table)) == 1
    assert re.findall(r"<th[^>]*>latitude", table)
    assert "Part that lowers the margin most" in breakdown
    assert "of the variance across" in pca
    assert "linear-gradient" in pca
    assert "found" in ground_map
    assert not links_and_handlers(page)
    assert page.count('class="tile"') == 4
    tall = exported.export(sources, UrlState(workspace), Story("T", (Step("lab=1&tall=1"),)), False)[1].decode()
    assert 'class="tile"' not in tall, "the window covers the pair"


def test_the_exported_map_of_queries_has_a_dot_for_each(sources: WindowSources) -> None:
    lab = sources.lab
    assert lab.build(TASK, None).wait(60)
    findings = lab.findings(TASK)
    assert findings is not None
    places = np.array([(x, 0.0) for x in range(6)])
    shown = map_data.Colours(np.array([0, 1, 0, 1, 0, 255], np.uint8), ["#ff0000", "rgb(0,0,255)"], ["a", "b"])
    drawn = draw_queries(findings, MapPoints(places, np.zeros((0, 2))), shown, np.array([0, 1, 2, 5]), 2)
    red, blue = ((drawn == colour).all(axis=2) for colour in ((255, 0, 0), (0, 0, 255)))
    one = blue.sum()
    assert 60 < one < 160
    assert red.sum() == pytest.approx(2 * one, rel=0.1), "the third red one and the second blue one are not selected"
    assert np.flatnonzero(blue.any(axis=0)).mean() < np.flatnonzero(red.any(axis=0)).max()


def test_the_bar_of_a_map_is_as_long_as_it_says() -> None:
    drawn = MapPicture(np.array([(0.0, 0.0), (900.0, 0.0)]), 0.05)
    before = drawn.picture().copy()
    metres = drawn.mark_ground()
    changed = (drawn.picture() != before).any(axis=2)
    foot = np.flatnonzero(changed[-22, 60:])
    bar = foot[: np.flatnonzero(np.diff(foot, append=9999) > 1)[0] + 1]  # the number comes after a gap
    assert metres == 200
    assert len(bar) == pytest.approx(metres / drawn.unit, abs=8)


def test_a_step_in_the_city_says_that_its_map_is_flat(
    workspace: Workspace, sources: WindowSources, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = Story("City", (Step("map=1"), Step("map=1&city=0"), Step("")))
    monkeypatch.setattr(workspace, "city", object())
    page = exported.export(sources, UrlState(workspace), told, False)[1].decode()
    assert [exported._FLAT in slide for slide in page.split('<section class="slide')[1:]] == [True, False, False]


def test_a_step_that_points_at_something_marks_it(workspace: Workspace, sources: WindowSources) -> None:
    page = exported.export(sources, UrlState(workspace), Story("P", (Step("", "a", "", "verdict"),)), False)[1].decode()
    assert '<section class="slide at-verdict"' in page
    assert ".at-verdict .verdict" in page


def test_a_step_that_cannot_be_shown_is_one_sentence(workspace: Workspace, sources: WindowSources) -> None:
    told = Story("Old", (Step(f"query={workspace.tasks[TASK].query_names[0]}"), Step("query=gone")))
    with pytest.raises(InputError, match=r"Step 2 of 'Old' cannot be shown: query=gone: there is no such query"):
        exported.export(sources, UrlState(workspace), told, False)


def test_the_map_frames_the_compared_tile_and_joins_it_with_the_query(workspace: Workspace) -> None:
    state = SessionState(TASK, 4, query=1, selected=4, map=True)
    analysis = StateAnalyser(workspace).analyse(state, 3)
    assert not analysis.chosen.true
    drawn = ground.draw(workspace, analysis)
    assert drawn is not None
    assert drawn.shape == (620, 1000, 3)
    shown = {colour: (drawn == colour).all(axis=2).sum() for colour in (theme.TRUE_COLOUR, theme.FALSE_COLOUR)}
    right = ground.draw(workspace, StateAnalyser(workspace).analyse(replace(state, selected="truth"), 1))
    assert right is not None
    assert (right == theme.TRUE_COLOUR).all(axis=2).sum() > shown[theme.TRUE_COLOUR], "enlarged, and the thicker frame"
    assert shown[theme.FALSE_COLOUR] > 500
