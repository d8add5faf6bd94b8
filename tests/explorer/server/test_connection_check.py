"""What a page and the terminal are told of a websocket that does not open."""

from __future__ import annotations

import json
import logging
from typing import Any
from urllib.parse import urlencode

import pytest

from explorer.server.auth import HttpRequest, Refusal
from explorer.server.connection_check import FAULTS, ConnectionCheck, is_websocket

PAGE, SERVER = "https://maps.example.org", "127.0.0.1:8080"
NUMBER = "0123456789abcdef"
REFUSED = Refusal(401, "A token is needed", "")
HOST_LINE = "proxy_set_header Host $http_host;"
UPGRADE_LINES = [
    "proxy_http_version 1.1;",
    "proxy_set_header Upgrade $http_upgrade;",
    'proxy_set_header Connection "upgrade";',
]


def request(path: str, host: str, upgrade: bool = False, **headers: str) -> HttpRequest:
    named = {name.replace("_", "-"): [value] for name, value in headers.items()}
    return HttpRequest(path, {"host": [host], **named}, upgrade)


def socket(host: str, upgrade: bool = True, protocol: bool = True, number: str = NUMBER) -> HttpRequest:
    headers = {"sec_websocket_protocol": "lpn-check"} if protocol else {}
    return request(f"/maps/?check={number}", host, upgrade, origin=PAGE, sec_websocket_key="x", **headers)


def answer(check: ConnectionCheck, host: str, **query: str) -> dict[str, Any]:
    asked = {
        "page": PAGE,
        "checks": f"{NUMBER} f",
        "at": "/maps/ /maps",
        "answers": "200 200",
        "saw": "closed",
        **query,
    }
    response = check.answer(request(f"/maps/connection?{urlencode({**asked, 'folder': '/maps/'})}", host), SERVER)
    assert response.headers["Cache-Control"] == "no-store"
    content: dict[str, Any] = json.loads(response.body)
    return content


def test_a_changed_host_is_named_with_its_line_on_page_and_terminal(caplog: pytest.LogCaptureFixture) -> None:
    check = ConnectionCheck()
    check.note(socket(SERVER), SERVER, Refusal(403, "", ""))
    assert not caplog.records, "one of the page's own; another may be open"
    found = answer(check, SERVER, proxy="nginx/1.22.1")
    assert found["title"] == "Another web site may not use this server"
    assert f"This page is at {PAGE}, but the proxy asks LPN Explorer for {SERVER}" in found["texts"][0]
    assert found["lines"] == {"nginx": [HOST_LINE]}
    for _ in range(3):
        answer(check, SERVER, proxy="nginx/1.22.1")
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert record.getMessage() == (
        f"A page at {PAGE} cannot connect: its requests come for {SERVER}, and another web site may not use this server; if the "
        f"page is yours, its proxy must pass Host as the browser sent it (nginx: {HOST_LINE}). See docs/serving.md."
    )


@pytest.mark.parametrize(
    ("proxy", "lines"),
    [
        ("Apache/2.4.57 (Debian)", {"Apache": ["ProxyPreserveHost On"]}),
        ("openresty", {"nginx": [HOST_LINE]}),
        ("Caddy", {"other proxies": ["pass Host on unchanged"]}),
        ("", {"nginx": [HOST_LINE], "Apache": ["ProxyPreserveHost On"], "other proxies": ["pass Host on unchanged"]}),
    ],
)
def test_the_lines_are_those_of_the_proxy_that_answers(proxy: str, lines: dict[str, list[str]]) -> None:
    assert answer(ConnectionCheck(), "localhost", proxy=proxy)["lines"] == lines


def test_all_missing_lines_are_named_at_once() -> None:
    check = ConnectionCheck()
    check.note(socket(SERVER, upgrade=False), SERVER, Refusal(403, "", ""))
    found = answer(check, SERVER, proxy="nginx")
    assert found["lines"] == {"nginx": [HOST_LINE, *UPGRADE_LINES]}
    assert len(found["texts"]) == 2


HOST = "maps.example.org"


@pytest.mark.parametrize(
    ("arrival", "refusal", "query", "fault"),
    [
        (socket(HOST, upgrade=False), None, {}, "upgrade"),
        (socket(HOST, protocol=False), None, {}, "protocol"),
        (socket(HOST), REFUSED, {}, "refused"),
        (socket(HOST), None, {}, "held"),
        (None, None, {"page": "null"}, "frame"),
        (None, None, {"answers": "200 redirect"}, "redirect"),
        (None, None, {"answers": "404 404"}, "status"),
        (None, None, {}, "closed"),
        (None, None, {"saw": "silent"}, "silent"),
        (None, None, {"saw": ""}, "closed"),
        (None, None, {"at": "", "answers": ""}, "closed"),
    ],
)
def test_each_fault_is_named_and_logged_once(
    arrival: HttpRequest | None,
    refusal: Refusal | None,
    query: dict[str, str],
    fault: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    check = ConnectionCheck()
    if arrival is not None:
        check.note(arrival, SERVER, refusal)
    found = [answer(check, HOST, **query) for _ in range(2)][-1]
    assert found["title"] == FAULTS[fault].title
    assert len(found["texts"]) == 1
    assert "{" not in found["texts"][0]
    assert len(caplog.records) == 1
    assert "{page}" not in caplog.text
    assert "See docs/serving.md." in caplog.text


def test_a_redirect_names_its_path_and_the_slash() -> None:
    found = answer(ConnectionCheck(), HOST, answers="200 redirect", proxy="nginx")
    assert "The proxy answers /maps with a redirect" in found["texts"][0]
    assert found["lines"]["nginx"][0] == f"location /maps/ {{ proxy_pass http://{SERVER}/; ... }}"


def test_a_websocket_of_the_viewer_is_logged_at_once(caplog: pytest.LogCaptureFixture) -> None:
    check = ConnectionCheck()
    dropped = request("/", HOST, False, origin=PAGE, sec_websocket_key="x")
    assert is_websocket(dropped)
    for _ in range(3):
        check.note(dropped, SERVER, None)
    assert [record.getMessage() for record in caplog.records] == [
        f"A page at {PAGE} cannot connect: its websocket arrived without the header Upgrade, which the proxy must pass (nginx: "
        f"{' '.join(UPGRADE_LINES)}). See docs/serving.md."
    ]
    check.note(request("/", HOST, True, origin=PAGE, sec_websocket_protocol="viser-v1.1.1"), SERVER, None)
    assert len(caplog.records) == 1, "nothing is wrong with it"


def test_the_log_cannot_be_flooded_nor_its_lines_broken(caplog: pytest.LogCaptureFixture) -> None:
    check = ConnectionCheck()
    for number in range(200):
        check.note(
            request("/", SERVER, True, origin=f"https://evil{number}.example\n\x1b[2J" + "x" * 500), SERVER, None
        )
    assert 1 <= len(caplog.records) <= 9
    assert all(record.getMessage().isprintable() and len(record.getMessage()) < 600 for record in caplog.records)


def test_a_question_of_another_site_is_not_logged(caplog: pytest.LogCaptureFixture) -> None:
    asked = request("/connection?page=https://evil.example", SERVER, sec_fetch_site="cross-site")
    ConnectionCheck().answer(asked, SERVER)
    assert not caplog.records


@pytest.mark.parametrize("page", ["", "evil", "http://evil/{folder}", "http://a b"])
def test_what_is_no_page_is_not_logged(page: str, caplog: pytest.LogCaptureFixture) -> None:
    check = ConnectionCheck()
    check.note(socket(SERVER), SERVER, REFUSED)
    answer(check, SERVER, page=page)
    assert not caplog.records


def test_values_from_outside_are_not_filled_in_again() -> None:
    check = ConnectionCheck()
    check.note(socket("{page}" * 20_000), SERVER, Refusal(403, "", ""))
    texts = answer(check, SERVER, page="https://{status}", answers="302 302")["texts"]
    assert any("https://{status}" in text for text in texts)
    assert max(map(len, texts)) < 2000


def test_an_unknown_name_is_logged_for_browsers_only(caplog: pytest.LogCaptureFixture) -> None:
    check = ConnectionCheck()
    check.note_name(request("/", "scanner.example"))
    assert not caplog.records
    for _ in range(2):
        check.note_name(request("/", "explorer", accept="text/html,*/*"))
    (record,) = caplog.records
    assert "asked for by the name explorer" in record.getMessage()
    assert HOST_LINE in record.getMessage()
