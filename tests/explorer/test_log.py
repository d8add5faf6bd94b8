"""Tests of the explorer's log, which holds no token."""

from __future__ import annotations

import http.client
import re
from pathlib import Path

import pytest

from tests.explorer.test_shutdown import Explorer
from tools.fixtures import small_worlds
from tools.fixtures.screen_tab import ScreenTab

TOKEN = "correct horse battery"


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_worlds.make_dataset(tmp_path_factory.mktemp("log") / "places", train=1, test=4)


def test_what_is_refused_is_a_line_each_at_debug_and_no_token_is_in_them(
    places: Path, model_file: Path, tmp_path: Path
) -> None:
    with Explorer(places, model_file, tmp_path / "cache", LPN_LOG="debug", LPN_TOKEN=TOKEN) as explorer:
        explorer.until(lambda: "ready: " in explorer.out)
        url = f"http://127.0.0.1:{explorer.port}"
        for path in ("/?token=guessed+wrong", "/?token=correct+horse+battery"):
            connection = http.client.HTTPConnection("127.0.0.1", explorer.port, timeout=120)
            connection.request("GET", path)
            connection.getresponse().read()
            connection.close()
        with ScreenTab(f"{url}/?token=correct+horse+battery") as tab:
            tab.open("?query=0003")
            tab.socket.send("no JSON")
            tab.turn(30)
        explorer.interrupt()
        assert explorer.ended()[0] == 0
        found = explorer.err.splitlines()
    assert all(
        re.match(r"\d{4}-\d\d-\d\d [\d:.]{12} (DEBUG|INFO|WARNING) +(explorer|lpn)[.\w]+: ", line) for line in found
    )
    said = "\n".join(line.split(": ", 1)[1] for line in found)
    for line in (
        "A wrong token came from 127.0.0.1",
        "Refused 127.0.0.1, 403: Wrong token",
        "A message of a page is no JSON: 7 characters",
    ):
        assert line in said
    for secret in ("guessed", "horse", "token="):
        assert secret not in said + explorer.out.replace("token=<yours>", "")


def test_by_default_it_is_quiet(places: Path, model_file: Path, tmp_path: Path) -> None:
    with Explorer(places, model_file, tmp_path / "cache") as explorer, explorer.browsers(1) as tabs:
        tabs[0].turn(30)
        tabs[0].socket.send("no JSON")
        connection = http.client.HTTPConnection("127.0.0.1", explorer.port, timeout=120)
        connection.connect()  # as browsers open one ahead, and port scans do
        connection.close()
        explorer.interrupt()
        explorer.stopped()
