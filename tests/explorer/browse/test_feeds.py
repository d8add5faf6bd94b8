from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from explorer.feeds import CHUNK, Feeds
from explorer.browse.messages import BrowseMessage, PickQuery
from explorer.browse.query_list import QueryList, position_of, publish
from explorer.opening import open_model
from explorer.server.picture_route import PREFIX
from explorer.session_state import SessionState, StateChange
from explorer.web.messages import decode
from explorer.workspace import StateAnalyser, Workspace

TASK = "drone-to-satellite"


@pytest.fixture(scope="module")
def workspace(data: Path, model_file: Path) -> Workspace:
    opened = open_model(data, model_file)
    assert opened.rankings[TASK].join("test").wait(60)
    return opened


@pytest.fixture
def feeds(workspace: Workspace) -> Feeds:
    return Feeds(workspace)


def below(feeds: Feeds, address: str) -> str:
    """The path of an address as the picture route hands it over."""
    return f"/{feeds.address}{address}".removeprefix(PREFIX)


def fetch(feeds: Feeds, address: str) -> object:
    compute = feeds.find(below(feeds, address))
    return None if compute is None else json.loads(compute().data or b'"ended"')


class Owner:
    """A browser's window."""


def test_names_in_a_list_hold_no_control_characters(feeds: Feeds) -> None:
    listed = feeds.publish_list(Owner(), "names", 1, lambda *_: [{"names": ("a\x1b[31m\u202eb", 1.5)}])
    assert fetch(feeds, f"{listed}0") == [{"names": ["a?[31m?b", 1.5]}]


def test_a_list_is_served_in_pieces_until_its_owner_publishes_two_others_or_leaves(feeds: Feeds) -> None:
    me, you = Owner(), Owner()
    numbers = list(range(2 * CHUNK + 5))
    old = feeds.publish_list(me, "numbers", len(numbers), lambda start, end: numbers[start:end])
    assert fetch(feeds, f"{old}0") == numbers[:CHUNK]
    assert fetch(feeds, f"{old}2") == numbers[2 * CHUNK :]
    assert fetch(feeds, f"{old}3") == []
    new = feeds.publish_list(me, "numbers", 1, lambda *_: [7])
    other = feeds.publish_list(you, "numbers", 1, lambda *_: [8])
    assert (fetch(feeds, f"{old}0"), fetch(feeds, f"{new}0")) == (numbers[:CHUNK], [7])
    newest = feeds.publish_bytes(me, "numbers", lambda: b"[9]")
    assert fetch(feeds, f"{old}0") == "ended", "a page that still asks for it sees no error"
    assert fetch(feeds, f"{newest}0") == [9]
    feeds.leave(me)
    assert [fetch(feeds, f"{key}0") for key in (new, newest, other)] == ["ended", "ended", [8]]
    late = feeds.publish_list(me, "numbers", 1, lambda *_: [10])
    assert fetch(feeds, f"{late}0") == "ended", "a thread may publish after its browser left"


def test_thumbnails_are_pictures_of_queries_and_tiles_and_other_paths_are_none(
    feeds: Feeds, workspace: Workspace
) -> None:
    task = workspace.tasks[TASK]
    for side, count in (("query", len(task.queries)), ("tile", len(task.gallery))):
        address = feeds.thumbnail(task, side, count - 1).removeprefix(feeds.address)
        compute = feeds.find(below(feeds, address))
        assert compute is not None
        assert compute().mime == "image/jpeg"
        assert cv2.imdecode(np.frombuffer(compute().data, np.uint8), cv2.IMREAD_COLOR).shape == (64, 64, 3)
        assert feeds.find(below(feeds, address.replace(str(count - 1), str(count)))) is None
    for path in ("thumb/9/query/0", "thumb/0/quarry/0", "0123456789abcdef/0", "../thumb/0/query/0", ""):
        assert feeds.find(below(feeds, path)) is None
    assert feeds.find("thumb/0/query/0") is None


def test_a_list_of_queries_tells_names_and_outcomes(feeds: Feeds, workspace: Workspace) -> None:
    task, ranking = workspace.tasks[TASK], workspace.rankings[TASK]
    queries = np.array([3, 0, 5])
    fetched = fetch(feeds, publish(feeds, "me", ranking, queries, workspace.graded(ranking)) + "0")
    assert fetched == [[query, task.query_names[query], int(not ranking.failed[query])] for query in queries.tolist()]
    assert [position_of(query, np.array([2, 5, 9])) for query in (2, 3, 9, 12)] == [0, -1, 2, -1]


def test_the_list_follows_the_query_and_the_search_text_and_takes_no_wrong_message(
    feeds: Feeds, workspace: Workspace
) -> None:
    shown: list[SimpleNamespace] = []

    def add_html(content: str) -> SimpleNamespace:
        shown.append(SimpleNamespace(content=content))
        return shown[-1]

    state = SessionState(TASK, 4)
    changes: list[StateChange] = []
    gui = SimpleNamespace(add_html=add_html)
    queries = QueryList(gui, workspace, feeds, changes.append)  # type: ignore[arg-type]
    analyser = StateAnalyser(workspace)
    show: Callable[[SessionState], None] = lambda state: queries.show(analyser.analyse(state, 3))  # noqa: E731
    show(state)
    first = shown[2].content
    assert "14 pictures" in shown[0].content
    show(replace(state, query=3))
    assert shown[2].content != first
    show(replace(state, query=3, find="0011"))
    assert "1 of 14 pictures" in shown[0].content
    show(replace(state, find="nothing"))
    assert "No picture has this" in shown[0].content
    for wrong in (None, 3, [TASK], [TASK, "1"], [TASK, 1, 2], [TASK, 1.5], [TASK, True]):
        assert decode(BrowseMessage, "pick", wrong) is None
    queries.pick(PickQuery("other", 1))
    assert not changes
    for query, expected in ((4, 4), (-1, 0), (14, 0)):
        queries.pick(PickQuery(TASK, query))
        changed = changes.pop()(state)
        assert changed is not None
        assert changed.query == expected
    queries.leave()
