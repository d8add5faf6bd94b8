from __future__ import annotations

import base64
import re

import cv2
import numpy as np
import pytest

from explorer.session_state import SessionState
from explorer.stories import exported
from explorer.stories.story import Step, Story
from explorer.url_state import UrlState
from explorer.workspace import StateAnalyser, Workspace
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
    name, data = exported.export(workspace, UrlState(workspace), told, lambda *now: steps.append(now))
    page = data.decode()
    assert name == "A--b--story---b-.html"
    assert steps == [(1, 3), (2, 3), (3, 3)]
    assert page.count('<section class="case') == 3
    assert "alert(1)" in page
    assert "<script" not in page
    assert "<b>&#34;story" not in page
    assert "not for the audience" not in page
    for number, shown in enumerate(names[:3]):
        assert f"<br>{shown}, drone<" in page
        weights = (1.0, 0.0, 1.0, 1.0) if number == 2 else (1.0,) * 4
        state = SessionState(TASK, 4, query=number, weights=weights)
        verdict = StateAnalyser(workspace).analyse(state, 10).verdict
        assert f"<b>{verdict.headline}</b><p>{verdict.sentence}</p>" in page
    assert "Altered by: part weights 33 : 0 : 33 : 33 %." in page
    sources = re.findall(r'src="([^"]{0,40})', page)
    assert sources
    assert all(re.match("data:image/(jpeg|png);base64,", source) for source in sources)
    assert not re.findall(r'(?:href="(?!#|data:)|url\(|@import|https?:)', page)
    for encoded in re.findall(r'src="data:image/jpeg;base64,([^"]+)"', page):
        assert cv2.imdecode(np.frombuffer(base64.b64decode(encoded), np.uint8), cv2.IMREAD_COLOR) is not None


def test_an_export_is_utf_8_whatever_its_captions_hold(workspace: Workspace) -> None:
    _, data = exported.export(workspace, UrlState(workspace), Story("a", (Step("", "caf\udce9\x1b\u202e"),)))
    assert ">caf???<" in data.decode()


def test_a_step_says_what_the_file_does_not_have_of_it(workspace: Workspace) -> None:
    told = Story("Windows", (Step("map=1"), Step("lab=1&map=1"), Step("why=1")))
    page = exported.export(workspace, UrlState(workspace), told)[1].decode()
    map_step, table_step, pair = page.split('<div class="said">')[1:]
    assert "The app shows the map here, which this file does not have." in map_step
    assert "The app shows all pictures in a table here, which this file does not have." in table_step
    assert "does not have" not in pair


def test_a_step_that_cannot_be_shown_is_one_sentence(workspace: Workspace) -> None:
    told = Story("Old", (Step(f"query={workspace.tasks[TASK].query_names[0]}"), Step("query=gone")))
    with pytest.raises(InputError, match=r"Step 2 of 'Old' cannot be shown: query=gone: there is no such query"):
        exported.export(workspace, UrlState(workspace), told)
