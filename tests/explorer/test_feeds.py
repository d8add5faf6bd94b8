from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from explorer.feeds import CHUNK, Feeds
from explorer.opening import open_model, open_tasks
from explorer.server.picture_route import PREFIX
from explorer.workspace import Workspace
from lpn.core import images

TASK = "drone-to-satellite"


@pytest.fixture(scope="module")
def workspace(data: Path, model_file: Path) -> Workspace:
    opened = open_model(data, model_file)
    assert opened.rankings[TASK].join("test").wait(60)
    return opened


@pytest.fixture
def feeds(workspace: Workspace) -> Feeds:
    return workspace.feeds


def below(feeds: Feeds, address: str) -> str:
    """The path of an address as the picture route hands it over."""
    return f"/{feeds.address}{address}".removeprefix(PREFIX)


def fetch(feeds: Feeds, address: str) -> object:
    compute = feeds.find(below(feeds, address))
    return None if compute is None else json.loads(compute().data or b'"ended"')


class Owner:
    """A browser's window."""


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
        assert compute().mime == "image/jpeg"
        assert cv2.imdecode(np.frombuffer(compute().data, np.uint8), cv2.IMREAD_COLOR).shape == (64, 64, 3)
        assert feeds.find(below(feeds, address.replace(str(count - 1), str(count)))) is None
    for path in ("thumb/9/query/0", "thumb/0/quarry/0", "0123456789abcdef/0", "../thumb/0/query/0", ""):
        assert feeds.find(below(feeds, path)) is None
    assert feeds.find("thumb/0/query/0") is None


def test_a_tile_is_drawn_at_its_zoom_and_a_query_is_zoomed_by_the_page(workspace: Workspace) -> None:
    task = workspace.tasks[TASK]
    query, tile = task.queries[0].load(), task.gallery[0].load()
    queries, gallery = ([replace(one, zoom=2.0) for one in side] for side in (task.queries, task.gallery))
    feeds = open_tasks([task.with_fields(queries=queries, gallery=gallery)]).feeds
    for side, expected in (("query", query), ("tile", images.zoom(tile, 2.0))):
        compute = feeds.find(below(feeds, f"picture/0/{side}/0"))
        shown = cv2.imdecode(np.frombuffer(compute().data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        assert shown.shape == expected.shape
        assert np.abs(shown.astype(float) - expected).mean() < 20
