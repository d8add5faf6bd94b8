"""Tests of the explorer's log, which holds no token."""

from __future__ import annotations

import http.client
import re
from pathlib import Path

import pytest

from tests.explorer.test_shutdown import Explorer
from tools.fixtures import small_worlds
from tools.fixtures.websocket_client import WebSocketClient

TOKEN = "correct horse battery"


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_worlds.make_dataset(tmp_path_factory.mktemp("log") / "places", train=1, test=4)


def test_requests_are_a_line_each_at_debug_and_no_token_is_in_them(
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
        entered = f"{url}/?token=correct+horse+battery"
        with WebSocketClient(entered) as one:
            one.greet("?query=0003")
            one.wait(lambda: one.status("name") == "0003")  # a page that greets late has shown another picture before
            opened = f"Browser 0: answer {one.status('seq')}: drone-to-satellite, query 0003, turn 0"
            explorer.until(lambda: opened in explorer.err)
        with WebSocketClient(entered) as other:
            other.greet("?query=0004")
            other.wait(lambda: other.status("name") == "0004")
            other.set("Rotate", 30)
            other.wait(lambda: other.status("angle") == "30")
            other.send("ShareUrlRequest")
            other.raw("no message")
            assert other.gone()
            explorer.until(lambda: "Browser 1 left" in explorer.err)
        explorer.interrupt()
        assert explorer.ended()[0] == 0
        found = explorer.err.splitlines()
    assert all(
        re.match(r"\d{4}-\d\d-\d\d [\d:.]{12} (DEBUG|INFO|WARNING) +(explorer|lpn)[.\w]+: ", line) for line in found
    )
    said = "\n".join(line.split(": ", 1)[1] for line in found)
    for line in ("Browser 0 connected", "Browser 1 connected", "Browser 1 left", "A wrong token came from 127.0.0.1"):
        assert line in said
    turned = (
        r"Browser 1: answer \d+: drone-to-satellite, query 0004\S*, turn 30, shift 0 0, zoom 1: computed in \d+ ms, "
    )
    assert re.search(turned, said)
    assert re.search(r"Browser 1: dropped a message of kind 'ShareUrlRequest' and \d+ bytes", said)
    assert "Browser 1 sent a text frame" in said
    assert "Refused 127.0.0.1, 403: Wrong token" in said
    for secret in ("guessed", "horse", "token="):
        assert secret not in said + explorer.out.replace("token=<yours>", "")


def test_by_default_it_is_quiet(places: Path, model_file: Path, tmp_path: Path) -> None:
    with Explorer(places, model_file, tmp_path / "cache") as explorer, explorer.browsers(1) as talkers:
        talkers[0].set("Rotate", 30)
        talkers[0].wait(lambda: talkers[0].status("angle") == "30")
        talkers[0].send("ShareUrlRequest")
        connection = http.client.HTTPConnection("127.0.0.1", explorer.port, timeout=120)
        connection.connect()  # as browsers open one ahead, and port scans do
        connection.close()
        explorer.interrupt()
        explorer.stopped()
