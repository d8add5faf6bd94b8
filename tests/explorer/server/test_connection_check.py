"""The lines of the terminal about a page that cannot connect."""

from __future__ import annotations

import logging

import pytest

from explorer.server.auth import HttpRequest
from explorer.server.connection_check import ConnectionCheck, is_websocket
from tests.explorer.server.test_auth import request

PAGE, HOST, SERVER = "https://maps.example.org", "maps.example.org", "127.0.0.1:8080"
HOST_LINE = "proxy_set_header Host $http_host;"
ADVICE = "If the page is yours, its proxy must pass Host as the browser sent it, and websockets. See docs/serving.md."


def socket(host: str, upgrade: bool = True, protocol: str = "lpn-json", origin: str = PAGE) -> HttpRequest:
    headers = {"sec_websocket_protocol": protocol} if protocol else {}
    return request(host, "/maps/", upgrade, origin=origin, sec_websocket_key="x", **headers)


@pytest.mark.parametrize(
    ("arrived", "saw"),
    [
        (socket(SERVER), f"for {SERVER}, which is another web site"),
        (socket(HOST, upgrade=False), "without the header Upgrade"),
        (socket(HOST, protocol=""), "without the header Sec-WebSocket-Protocol"),
        (
            socket(SERVER, upgrade=False),
            f"for {SERVER}, which is another web site, and without the header Upgrade",
        ),
        (socket(HOST, origin="null"), "from a frame that hides its address"),
    ],
)
def test_what_arrived_of_a_websocket_is_logged_once(
    arrived: HttpRequest, saw: str, caplog: pytest.LogCaptureFixture
) -> None:
    check = ConnectionCheck()
    assert is_websocket(arrived)
    for _ in range(3):
        check.note(arrived)
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    origin = arrived.only("origin")
    assert record.getMessage() == f"A page at {origin} cannot connect: its websocket arrived {saw}. {ADVICE}"


def test_nothing_is_logged_of_what_is_right_or_no_browser(caplog: pytest.LogCaptureFixture) -> None:
    check = ConnectionCheck()
    check.note(socket(HOST))
    check.note(socket(SERVER, origin=""))
    assert not caplog.records


def test_the_log_cannot_be_flooded_nor_its_lines_broken(caplog: pytest.LogCaptureFixture) -> None:
    check = ConnectionCheck()
    for number in range(200):
        check.note(request(SERVER, "/", True, origin=f"https://evil{number}.example\n\x1b[2J" + "x" * 500))
    assert 1 <= len(caplog.records) <= 9
    assert all(record.getMessage().isprintable() and len(record.getMessage()) < 600 for record in caplog.records)


def test_an_unknown_name_is_logged_for_browsers_only(caplog: pytest.LogCaptureFixture) -> None:
    check = ConnectionCheck()
    check.note_name(request("scanner.example"))
    assert not caplog.records
    for _ in range(2):
        check.note_name(request("explorer", accept="text/html,*/*"))
    (record,) = caplog.records
    assert "asked for by the name explorer" in record.getMessage()
    assert HOST_LINE in record.getMessage()
