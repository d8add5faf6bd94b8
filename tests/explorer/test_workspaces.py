"""A page that changes its workspace, without a browser."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest

from explorer.app import App
from explorer.client.session import ClientSession
from explorer.opening import open_model
from explorer.workspace import LazyWorkspace
from tools.fixtures import small_worlds
from tools.fixtures.waiting import wait_until
from tools.fixtures.websocket_client import WebSocketClient


@pytest.fixture
def app(tmp_path: Path, model_file: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[App]:
    """An app that offers the same places twice."""
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "cache"))
    data = small_worlds.make_dataset(tmp_path / "places", train=1, test=3)
    others = {"again": LazyWorkspace("once more", lambda: open_model(data, model_file))}
    served = App(open_model(data, model_file), "127.0.0.1", 0, None, "once", others)
    yield served
    served.close()


def replaced(app: App, browser: WebSocketClient, before: ClientSession, kind: str, value: str) -> ClientSession:
    """Send a message that changes the workspace, and greet the new session as the page does."""
    page = browser.find("page")
    browser.tell(kind, value)
    wait_until(lambda: next(iter(app._sessions.values())) is not before)
    session = next(iter(app._sessions.values()))
    # The old session's element may still be in the page: what is told to it is lost.
    browser.wait(lambda: browser.find("page") not in (None, page))
    browser.tell("hello", {"search": "", "small": False})
    return session


def test_own_pictures_stay_while_a_page_shows_another_workspace_and_comes_back(app: App) -> None:
    with WebSocketClient(f"http://127.0.0.1:{app.server.get_port()}") as browser:
        browser.greet("?screen=all")
        (first,) = app._sessions.values()
        browser.upload("mine.png", cv2.imencode(".png", small_worlds.place(2))[1].tobytes())
        browser.wait(lambda: first._state.upload is not None)
        own = first._state.upload
        assert own is not None
        second = replaced(app, browser, first, "show", "again")
        assert second._workspace.key == "again"
        assert second.views.panels.query.own is not None
        assert second.views.panels.query.own.held == 1
        third = replaced(app, browser, second, "back", f"?query=own&own={own.key}&screen=all")
        browser.wait(lambda: third._state.upload is not None)
        assert third._state.upload is not None
        assert (third._workspace, third._state.upload.name) == (first._workspace, "mine.png")
