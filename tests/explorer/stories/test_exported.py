from __future__ import annotations

import base64
import re

import cv2
import numpy as np
import pytest

from explorer.stories import exported
from explorer.stories.story import Step, Story
from explorer.url_state import UrlState
from explorer.workspace import Workspace
from lpn.core.errors import InputError
from tests.explorer.stories.conftest import TASK


def test_an_export_shows_each_step_and_needs_nothing_else(workspace: Workspace) -> None:
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
    name, data = exported.export(workspace, UrlState(workspace), told, True, lambda *now: steps.append(now))
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
    assert len(re.findall(r"adds most to the score", page)) == 1
    sources = re.findall(r'src="([^"]{0,40})', page)
    assert sources
    assert all(source.startswith("data:image/jpeg;base64,") for source in sources)
    assert not re.findall(r"(?:href|url\(|@import|https?:)", page)
    for encoded in re.findall(r'src="data:image/jpeg;base64,([^"]+)"', page):
        assert cv2.imdecode(np.frombuffer(base64.b64decode(encoded), np.uint8), cv2.IMREAD_COLOR) is not None


def test_an_export_is_utf_8_whatever_its_markup_holds(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exported, "render", lambda *_, **__: "<p>caf\udce9\x1b\u202e\n")
    assert exported.export(workspace, UrlState(workspace), Story("a", ()), True)[1] == b"<p>caf???\n"


def test_a_step_says_what_the_file_does_not_have_of_it(workspace: Workspace) -> None:
    told = Story("Windows", (Step("map=1"), Step("lab=1&map=1"), Step("why=1")))
    page = exported.export(workspace, UrlState(workspace), told, False)[1].decode()
    map_step, table_step, pair = page.split('<section class="slide')[1:]
    assert "The app shows the map here, which this file does not have." in map_step
    assert "The app shows all pictures in a table here, which this file does not have." in table_step
    assert "does not have" not in pair
    assert page.count('class="tile"') == 3


def test_a_step_that_points_at_something_marks_it(workspace: Workspace) -> None:
    page = exported.export(workspace, UrlState(workspace), Story("P", (Step("", "a", "", "verdict"),)), False)[
        1
    ].decode()
    assert '<section class="slide at-verdict"' in page
    assert ".at-verdict .verdict" in page


def test_a_step_that_cannot_be_shown_is_one_sentence(workspace: Workspace) -> None:
    told = Story("Old", (Step(f"query={workspace.tasks[TASK].query_names[0]}"), Step("query=gone")))
    with pytest.raises(InputError, match=r"Step 2 of 'Old' cannot be shown: query=gone: there is no such query"):
        exported.export(workspace, UrlState(workspace), told, False)
