"""A workspace of places with known positions, an app on it, and the screen's computations without a server."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from http.client import HTTPConnection, HTTPMessage
from itertools import cycle
from pathlib import Path
from queue import Queue
from typing import Any

import pytest

from explorer.app import App
from explorer.opening import open_model
from explorer.screen.fields import needs_answer
from explorer.screen.result import ScreenResult
from explorer.screen.session import Screens, ScreenSession
from explorer.workspace import LazyWorkspace, Workspace
from lpn.core.errors import DataError
from tools.fixtures import small_worlds
from tools.fixtures.screen_tab import ScreenTab
from tools.fixtures.waiting import TIMEOUT

TASK = "drone-to-satellite"
TAB = "0123456789abcdef"


class RefusedError(Exception):
    """The sentence that the page shows in place of a result."""


def answered(workspace: Workspace, search: str = "", own: bytes = b"", **fields: object) -> ScreenResult:
    """Return the result of a page's address, after an own photo was sent and some fields were set.

    Raises:
        RefusedError: with the sentence that the page shows instead.
    """
    messages = Queue[dict[str, Any]]()
    screens = Screens(lambda _: workspace, workspace.key, {workspace.key: workspace.data_name})
    session = ScreenSession(screens, messages.put)
    try:
        session.receive({"do": "open", "args": {"search": search}})
        if own:
            session.receive({"do": "upload", "args": {"name": "mine.png", "size": len(own)}})
            session.receive_bytes(own)
        if fields:
            session.receive({"set": fields})
        while True:
            message = messages.get(timeout=TIMEOUT)
            if "error" in message:
                raise RefusedError(message["error"])
            if own and not session.state.own:  # it was refused, which a message says
                continue
            result = session.result
            if "result" in message and result is not None and not needs_answer(result.state, session.state):
                return result
    finally:
        session.leave()


@contextmanager
def mapped_workspace(
    folder: Path, model: Path, baseline: Path, places: int = 8, columns: Mapping[str, Sequence[str]] | None = None
) -> Iterator[Workspace]:
    """Open places on a map under an LPN of four parts, with the baseline beside it; all queries are ranked.

    Args:
        columns: metadata of the queries: names, and values that the queries take in turn.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LPN_CACHE", str(folder / "cache"))
        data = small_worlds.map_dataset(small_worlds.make_dataset(folder / "places", train=1, test=places))
        if columns:
            files = sorted((data / "test" / "query_drone").rglob("*.png"))
            paths = (file.relative_to(data).as_posix() for file in files)
            with (data / "metadata.csv").open("w", newline="") as written:
                csv.writer(written).writerows(
                    [["path", *columns], *zip(paths, *map(cycle, columns.values()), strict=False)]
                )
        opened = open_model(data, model, baseline=baseline)
        for ranking in opened.rankings.values():
            ranking.wait(opened, lambda *_: None)
        yield opened


@pytest.fixture(scope="session")
def workspace(
    tmp_path_factory: pytest.TempPathFactory, model_file: Path, one_part_model_file: Path
) -> Iterator[Workspace]:
    with mapped_workspace(tmp_path_factory.mktemp("screen"), model_file, one_part_model_file) as opened:
        yield opened


@pytest.fixture(scope="session")
def app(workspace: Workspace) -> Iterator[App]:
    """The app on these places, which offers another one that does not open."""

    def never() -> Workspace:
        raise DataError("The map is not there; give another.")

    others = {"broken": LazyWorkspace("a broken map", never)}
    with closing(App(workspace, "127.0.0.1", 0, None, "places", others)) as served:
        yield served


class Tab(ScreenTab):
    """A tab of an app in this process."""

    def __init__(self, app: App, tab: str = TAB, protocol: str = "lpn-json", **options: Any) -> None:
        super().__init__(f"http://127.0.0.1:{app.server.get_port()}", tab, protocol, **options)


@pytest.fixture
def tab(app: App) -> Iterator[Tab]:
    with Tab(app) as connected:
        yield connected


def get(app: App, path: str = "/", **headers: str) -> tuple[int, HTTPMessage, bytes]:
    """Return status, headers, and body of the response to a request; underscores of header names stand for dashes."""
    connection = HTTPConnection("127.0.0.1", app.server.get_port(), timeout=TIMEOUT)
    connection.request("GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, answer.headers, body
