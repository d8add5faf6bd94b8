"""A real server behind its gateway, and hostile clients."""

from __future__ import annotations

import contextlib
import gc
import gzip
import http.client
import logging
import os
import socket
import sys
import threading
import urllib.error
import urllib.request
import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlsplit

import cv2
import msgspec
import pytest
import viser._messages as viser_messages
import viser.infra._infra as viser_infra
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from explorer.app import App, serve_in_background
from explorer.compute.own_photos import CameraPicture
from explorer.opening import open_model
from explorer.panels.upload_control import UploadControl
from explorer.server import gateway, picture_route
from explorer.server.auth import Authenticator
from explorer.server.gateway import Gateway
from explorer.server.message_filter import MAX_UPLOADS
from explorer.server.picture_route import PREFIX, EncodedPicture, PictureRoute
from explorer.server.rate_limiter import GUESSES, RateLimiter, TokenBucket
from explorer.session_state import SessionState
from explorer.workspace import StateAnalyser, Workspace
from lpn.core.errors import DataError, InputError, MissingPackageError
from tools.fixtures import small_worlds
from tools.fixtures.small_proxy import SmallProxy
from tools.fixtures.waiting import TIMEOUT, wait_until
from tools.fixtures.websocket_client import WebSocketClient

T = TypeVar("T")
TOKEN = "correct horse battery"


def picture(size: int = 48) -> bytes:
    return cv2.imencode(".png", cv2.resize(small_worlds.place(3), (size, size)))[1].tobytes()


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory, model_file: Path) -> Iterator[App]:
    """The app on synthetic places, in this process. All queries are ranked, which would draw a page anew."""
    folder = tmp_path_factory.mktemp("gateway")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LPN_CACHE", str(folder / "cache"))
        data = small_worlds.map_dataset(small_worlds.make_dataset(folder / "places", train=1, test=8))
        workspace = open_model(data, model_file)
        for ranking in workspace.rankings.values():
            ranking.wait(workspace, lambda *_: None)
        served = App(workspace, "127.0.0.1", 0)
        yield served
        served.close()


def url(app: App) -> str:
    return f"http://127.0.0.1:{app.server.get_port()}"


def get(app: App, path: str = "/", **headers: str) -> tuple[int, http.client.HTTPMessage, str]:
    connection = http.client.HTTPConnection("127.0.0.1", app.server.get_port(), timeout=TIMEOUT)
    connection.request("GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    answer = connection.getresponse()
    body = answer.read().decode()
    connection.close()
    return answer.status, answer.headers, body


@pytest.fixture
def locked(app: App) -> Iterator[App]:
    """The app while it requires a token."""
    app.authenticator.token = TOKEN
    yield app
    app.authenticator.token = None


@pytest.fixture
def picture_source(app: App, monkeypatch: pytest.MonkeyPatch) -> dict[str, Callable[[], EncodedPicture]]:
    """The pictures below the route's folder, by their paths."""
    found: dict[str, Callable[[], EncodedPicture]] = {}
    monkeypatch.setattr(app.gateway, "_pictures", PictureRoute(found.get))
    return found


def broken_picture() -> EncodedPicture:
    raise DataError("The sheet is damaged.")


def test_pictures_have_addresses_that_are_protected_like_the_page(
    picture_source: dict[str, Callable[[], EncodedPicture]], locked: App
) -> None:
    picture_source["tile/0/0/0"] = lambda: EncodedPicture(b"JPEG", "image/jpeg")
    picture_source["broken"] = broken_picture
    cookie = f"lpn-{locked.server.get_port()}={locked.authenticator.cookie_value}"
    assert get(locked, f"{PREFIX}tile/0/0/0")[0] == 401
    assert get(locked, f"{PREFIX}tile/0/0/0", host="evil.example", cookie=cookie)[0] == 421
    status, headers, body = get(locked, f"{PREFIX}tile/0/0/0", cookie=cookie)
    assert (status, body, headers["Content-Type"]) == (200, "JPEG", "image/jpeg")
    assert headers["Cache-Control"].startswith("private")
    assert headers["X-Content-Type-Options"] == "nosniff"
    for path, expected in (("unknown", 404), ("", 404), ("%2e%2e/etc", 404), ("broken", 500)):
        assert get(locked, PREFIX + path, cookie=cookie)[::2] == (expected, "")


def test_pages_are_answered_while_pictures_are_computed_and_too_many_pictures_are_refused(
    app: App, picture_source: dict[str, Callable[[], EncodedPicture]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(picture_route, "_MAX_WAITING", 3)
    may_end = threading.Event()

    def slow() -> EncodedPicture:
        may_end.wait(60)
        return EncodedPicture(b"late", "image/jpeg")

    picture_source.update({f"slow{i}": slow for i in range(4)})
    statuses: list[int] = []
    clients = [
        threading.Thread(target=lambda path=f"{PREFIX}slow{i}": statuses.append(get(app, path)[0])) for i in range(4)
    ]
    for client in clients:
        client.start()
    # Two are computed, one waits, and the fourth is refused at once.
    wait_until(lambda: statuses == [503])
    assert get(app)[0] == 200
    may_end.set()
    for client in clients:
        client.join(60)
    assert sorted(statuses) == [200, 200, 200, 503]


def refused(app: App, **options: object) -> int:
    """Return the status with which a connection is refused."""
    with pytest.raises(InvalidStatus) as raised:
        WebSocketClient(url(app), **options)
    return raised.value.response.status_code


def test_the_page_may_load_from_and_connect_to_its_own_server_only(app: App) -> None:
    status, headers, body = get(app, "/classic/")
    assert status == 200
    assert "viser" in body.lower()
    assert "unsafe" not in get(app)[1]["Content-Security-Policy"].replace("style-src 'self' 'unsafe-inline'", "")
    rules = dict(rule.strip().split(" ", 1) for rule in headers["Content-Security-Policy"].split(";"))
    host = urlsplit(url(app)).netloc
    assert set(rules["connect-src"].split()) == {"'self'", f"ws://{host}", f"wss://{host}", "data:", "blob:"}
    assert rules["default-src"] == rules["frame-ancestors"] == "'self'"
    assert "http" not in headers["Content-Security-Policy"]


def test_a_page_for_a_notebook_may_be_framed_by_this_machine_and_ends_when_it_is_closed(app: App) -> None:
    page = serve_in_background(lambda: app._first.workspace)
    with urllib.request.urlopen(page.url, timeout=60) as response:
        policy = response.headers["Content-Security-Policy"]
    assert "frame-ancestors 'self' http://localhost:* http://127.0.0.1:* " in policy
    assert page._repr_html_().startswith(f'<iframe src="{page.url}"')
    with pytest.raises(InputError, match="is in use"):
        serve_in_background(lambda: app._first.workspace, port=urlsplit(page.url).port or 0)
    page.close()
    with pytest.raises(urllib.error.URLError, match="refused"):
        urllib.request.urlopen(page.url, timeout=60)
    with serve_in_background(lambda: app._first.workspace, authenticator=Authenticator("127.0.0.1", TOKEN)) as other:
        assert "iframe" not in other._repr_html_()


def test_another_site_reaches_neither_page_nor_websocket(app: App) -> None:
    status, _, body = get(app, host="evil.example")
    assert status == 421
    assert "--allow-host evil.example" in body
    assert get(app, "/?websocket=ws://evil.example")[0] == 403
    assert get(app, "/?websocket=ws://evil.example", Upgrade="WebSocket")[0] == 426, "no page"
    assert refused(app, origin="https://evil.example") == 403
    assert refused(app, origin="null") == 403
    with WebSocketClient(url(app), origin=url(app)):
        pass


def raw(app: App, data: bytes) -> bytes:
    """Return the first line of the response to bytes that may not be a request."""
    with socket.create_connection(("127.0.0.1", app.server.get_port()), timeout=TIMEOUT) as connection:
        connection.sendall(data)
        return connection.makefile("rb").readline().strip()


def test_proxies_that_ask_by_http_1_0_or_whether_the_server_is_up_are_answered(locked: App) -> None:
    """nginx asks by HTTP/1.0 unless it is told otherwise, HAProxy checks by OPTIONS without a host; both had no answer."""
    assert raw(locked, b"OPTIONS / HTTP/1.0\r\n\r\n") == b"HTTP/1.1 204 No Content"
    assert raw(locked, b"GET / HTTP/1.0\r\nHost: localhost\r\n\r\n") == b"HTTP/1.1 401 Unauthorized"
    locked.authenticator.token = None
    assert raw(locked, b"GET / HTTP/1.0\r\nHost: localhost\r\n\r\n") == b"HTTP/1.1 200 OK"
    connection = http.client.HTTPConnection("127.0.0.1", locked.server.get_port(), timeout=TIMEOUT)
    connection.request("HEAD", "/classic/")
    response = connection.getresponse()
    assert (response.status, response.read(), response.headers["Connection"]) == (200, b"", "close")
    assert int(response.headers["Content-Length"]) > 100_000


@pytest.mark.parametrize(
    ("start", "message"),
    [
        (b"\x16\x03\x01\x02\x00\x01", "speaks TLS to this port"),
        (b"PROXY TCP4 192.0.2.1 192.0.2.2 5 6\r\n", "sends the PROXY protocol"),
        (b"\r\n\r\n\0\r\nQUIT\n!", "sends the PROXY protocol"),
        (b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", "speaks HTTP/2 to this port"),
    ],
)
def test_a_connection_that_is_no_request_is_named_on_the_terminal_once(
    app: App, start: bytes, message: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(app.gateway._check, "_logged", set())
    monkeypatch.setattr(app.gateway._check, "_lines", TokenBucket(1, 100))
    for _ in range(2):
        with socket.create_connection(("127.0.0.1", app.server.get_port()), timeout=TIMEOUT) as connection:
            connection.sendall(start)
            connection.shutdown(socket.SHUT_WR)
            assert connection.recv(100) == b""
    assert [message in record.getMessage() for record in caplog.records] == [True]


def test_the_page_is_served_below_any_folder(app: App, picture_source: dict[str, Callable[[], EncodedPicture]]) -> None:
    picture_source["tile/0"] = lambda: EncodedPicture(b"JPEG", "image/jpeg")
    for folder in ("/maps/", "//", "/user/alice/proxy/absolute/8080/", "/a/index.html"):
        assert get(app, folder)[0] == 200, folder
    assert get(app, "/maps/pictures/tile/0")[::2] == (200, "JPEG")
    status, _, body = get(app, "/proxy/8080?query=3", accept="text/html")
    assert status == 200
    assert "url=./8080/?query=3" in body
    for path in ("/maps/x.js", "/favicon.ico", "/maps/pictures/", "/maps"):
        assert get(app, path)[0] == 404, path


def test_a_websocket_that_a_proxy_changes_is_answered_with_the_reason(app: App) -> None:
    key = {"Sec_WebSocket_Key": "AAAAAAAAAAAAAAAAAAAAAA==", "Sec_WebSocket_Version": "13", "Origin": url(app)}
    status, _, body = get(app, **key)
    assert status == 426
    assert "arrived as a plain request, without the header Upgrade" in body
    status, _, body = get(app, Upgrade="websocket", Connection="Upgrade", **key)
    assert status == 400
    assert "without the header Sec-WebSocket-Protocol" in body
    check = f"GET / HTTP/1.1\r\nHost: {urlsplit(url(app)).netloc}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    check += "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    assert raw(app, check.encode()) == b"HTTP/1.1 101 Switching Protocols", "as a proxy checks whether websockets open"
    port, protocol = app.server.get_port(), b"Sec-WebSocket-Protocol: viser-v1.1.1\r\n"
    lines = b"".join(f"{name.replace('_', '-')}: {value}\r\n".encode() for name, value in key.items())
    head = f"GET /maps HTTP/1.0\r\nHost: 127.0.0.1:{port}\r\nConnection: upgrade\r\n".encode()
    opened = raw(app, head + b"Upgrade: WebSocket\r\n" + lines + protocol + b"\r\n")
    assert opened == b"HTTP/1.1 101 Switching Protocols", "as Apache's mod_proxy_wstunnel writes it"


def test_the_pages_own_websocket_is_greeted_and_is_no_browser(app: App) -> None:
    before = len(app.server.get_clients())
    for path in ("/", "/maps/", "/maps"):
        address = f"{url(app)}{path}".replace("http", "ws")
        with connect(address, subprotocols=[Subprotocol("lpn-check")], origin=Origin(url(app))) as checking:
            assert checking.recv(60) == "open"
    assert len(app.server.get_clients()) == before


@dataclass(frozen=True)
class Told:
    """What page and terminal say behind a proxy."""

    options: dict[str, Any]
    status: int
    line: str


@pytest.mark.parametrize(
    "told",
    [
        Told({"host": "localhost"}, 403, "its websocket arrived for localhost, and another web site may not"),
        Told({"host": "127.0.0.1"}, 403, "its proxy must pass Host as the browser sent it"),  # without its port
        Told({"drop": ("upgrade",)}, 426, "without the header Upgrade. "),
        Told({"drop": ("upgrade",), "version": "1.0"}, 426, "without the header Upgrade. "),
        Told({"drop": ("sec-websocket-protocol",)}, 400, "Sec-WebSocket-Protocol"),
    ],
)
def test_the_terminal_names_what_a_proxy_does_wrong(
    app: App, told: Told, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(app.gateway._check, "_logged", set())
    monkeypatch.setattr(app.gateway._check, "_lines", TokenBucket(1, 100))
    with SmallProxy(app.server.get_port(), **told.options) as proxy:
        origin = f"http://127.0.0.1:{proxy.port}"
        for _ in range(3):
            with pytest.raises(InvalidStatus) as raised:
                WebSocketClient(proxy.url, origin=origin)
            assert raised.value.response.status_code == told.status
    (record,) = caplog.records
    assert f"A page at {origin} cannot connect: " in record.getMessage()
    assert told.line in record.getMessage()


@pytest.mark.parametrize(
    "options",
    [
        {},  # a mapped or tunnelled port
        {"folder": "maps"},
        {"folder": "maps", "strip": False},
        {"version": "1.0"},
        {"add": {"X-Forwarded-Host": "maps.example.org", "X-Forwarded-Proto": "https", "X-Forwarded-Port": "443"}},
        {"drop": ("origin",)},
    ],
)
def test_a_proxy_that_passes_the_host_needs_nothing_else(
    app: App, options: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    with SmallProxy(app.server.get_port(), **options) as proxy:
        with urllib.request.urlopen(f"{proxy.url}classic/", timeout=60) as response:
            assert "lpn-loading" in response.read().decode()
        with WebSocketClient(proxy.url, origin=f"http://127.0.0.1:{proxy.port}") as talker:
            talker.greet()
    assert not caplog.records


def answers(app: App) -> bool:
    try:
        return get(app)[0] == 200
    except OSError:
        return False


def test_malformed_requests_are_refused_without_a_traceback(
    app: App, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    head = b"GET / HTTP/1.1\r\nHost: localhost\r\n"
    for data in (b"\x16\x03\x01\r\n", b"POST / HTTP/1.1\r\n\r\n", head + b"Content-Length: 3\r\n\r\nabc"):
        assert raw(app, data) == b""
    for data in (
        head.replace(b"/", b"/" + b"a" * 400, 1) + b"\r\n",
        head + b"Accept-Encoding: gzip\r\nAccept-Encoding: br\r\n\r\n",
        head + b"Upgrade: websocket\r\nUpgrade: h2c\r\n\r\n",
    ):
        assert raw(app, data).startswith(b"HTTP/1.1 400 "), data
    assert get(app)[0] == 200
    assert "Traceback" not in capfd.readouterr().err
    assert not [record for record in caplog.records if record.exc_info]


def test_the_log_has_no_token(locked: App, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    status, headers, _ = get(locked, "/?token=correct+horse+battery")
    assert status == 200
    get(locked, cookie=headers["Set-Cookie"].partition(";")[0])
    assert "horse" not in caplog.text
    assert locked.authenticator.cookie_value not in caplog.text


def test_pending_connections_do_not_exhaust_the_file_descriptors(app: App, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gateway, "MAX_PENDING", 8)
    before = len(list(Path("/proc/self/fd").iterdir()))
    held = [socket.create_connection(("127.0.0.1", app.server.get_port()), timeout=TIMEOUT) for _ in range(30)]
    try:
        for connection in held[:-8]:
            with contextlib.suppress(ConnectionResetError):
                assert connection.recv(1) == b""
        assert len(list(Path("/proc/self/fd").iterdir())) <= before + 30 + 8, "30 of ours"
        assert get(app)[0] == 200, "half-open connections keep no visitor of their address out"
    finally:
        for connection in held:
            connection.close()


def test_an_address_as_long_as_a_page_makes_it_is_answered_and_a_longer_one_refused(app: App) -> None:
    for length, status in ((8_500, 200), (19_900, 200), (20_500, 414)):
        found, _, body = get(app, "/?region=" + "1" * length)
        assert found == status
        assert ("An address has up to 20,000 characters" in body) == (status == 414)
    assert get(app, cookie="a=" + "1" * 60_000)[0] == 200, "a proxy with a login adds long cookies"
    with pytest.raises((http.client.HTTPException, ConnectionError)):
        get(app, cookie="a=" + "1" * 70_000)
    with pytest.raises((http.client.HTTPException, ConnectionError)):
        get(app, **{f"x{i}": "1" * 8_000 for i in range(9)})


def test_a_refusal_escapes_the_host_name(app: App) -> None:
    _, headers, body = get(app, host="<img/src=x>")
    assert "<img" not in body
    assert "script" not in headers["Content-Security-Policy"]


def test_page_and_websocket_need_the_token_or_its_cookie(locked: App) -> None:
    for path in ("/", "/index.html", "/assets/x.js", "/?query=1"):
        status, _, body = get(locked, path)
        assert status == 401
        assert "viser" not in body.lower()
    assert refused(locked) == 401
    status, headers, body = get(locked, "/?query=0003&token=correct+horse+battery")
    assert status == 200
    assert "url=./?query=0003" in body
    assert "correct" not in body
    held = headers["Set-Cookie"].partition(";")[0]
    assert get(locked, cookie=held)[0] == 200
    with WebSocketClient(url(locked), additional_headers={"Cookie": held}, origin=url(locked)) as talker:
        talker.greet()
        assert talker.status("seq")
    with WebSocketClient(url(locked) + "/?token=correct+horse+battery"):
        pass


def test_an_address_that_sends_many_wrong_tokens_is_blocked_until_it_stops(
    locked: App, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr(locked.gateway, "_rate_limiter", RateLimiter(lambda: now[0]))
    statuses = [get(locked, "/?token=wrong")[0] for _ in range(int(GUESSES) + 2)]
    assert statuses == [403] * int(GUESSES) + [429] * 2
    assert get(locked, "/?token=correct+horse+battery")[0] == 429, "its tokens are not compared"
    now[0] = 60.0
    assert get(locked, "/?token=correct+horse+battery")[0] == 200


@pytest.mark.skipif(sys.platform != "linux", reason="other systems answer at 127.0.0.1 alone")
def test_guesses_from_all_addresses_of_this_machine_count_together(
    locked: App, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, compared = [0.0], []
    monkeypatch.setattr(locked.gateway, "_rate_limiter", RateLimiter(lambda: now[0]))
    check = Authenticator.check
    monkeypatch.setattr(
        Authenticator,
        "check",
        lambda rules, request, port: compared.append(request.address) or check(rules, request, port),
    )

    def status(source: str, token: str, **headers: str) -> int:
        connection = http.client.HTTPConnection(
            "127.0.0.1", locked.server.get_port(), timeout=TIMEOUT, source_address=(source, 0)
        )
        connection.request("GET", f"/?token={token}", headers=headers)
        answer = connection.getresponse().status
        connection.close()
        return answer

    sources = [f"127.{i % 3}.{i % 5}.{i + 1}" for i in range(60)]
    statuses = [status(source, "wrong", **{"X-Forwarded-For": f"10.0.0.{i}"}) for i, source in enumerate(sources)]
    assert statuses == [403] * int(GUESSES) + [429] * (60 - int(GUESSES))
    assert compared == sources[: int(GUESSES)]
    held = f"lpn-{locked.server.get_port()}={locked.authenticator.cookie_value}"
    assert get(locked, cookie=held)[0] == 200, "browsers that are signed in stay so"
    now[0] = 2.5
    assert status("127.0.0.1", "correct+horse+battery") == 200, "also for a proxy's visitors"


def test_an_unsupported_viser_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    class Other:
        stopped = False

        def stop(self) -> None:
            self.stopped = True

    other = Other()
    with pytest.raises(MissingPackageError, match=r"install viser==1\.1\.1"):
        Gateway(Authenticator("127.0.0.1")).protect(lambda: other)  # type: ignore[arg-type,return-value]
    assert other.stopped
    with monkeypatch.context() as patch:
        patch.delattr(viser_infra, "websockets")
        with pytest.raises(MissingPackageError, match="starts its server"):
            Gateway(Authenticator("127.0.0.1"))
    monkeypatch.setattr(viser_messages, "FileTransferPart", object)
    with pytest.raises(MissingPackageError, match="FileTransferPart"):
        Gateway(Authenticator("127.0.0.1"))


# A hostile page, and another browser that must not be affected.


@pytest.fixture
def witness(app: App, capfd: pytest.CaptureFixture[str]) -> Iterator[WebSocketClient]:
    """Another browser: its page must not change, and its next answer must equal a direct computation."""
    with WebSocketClient(url(app), origin=url(app)) as talker:
        talker.greet("?query=0005")
        # The last message of its answer: a greeting that is slow to arrive finds an answer of the default query.
        talker.wait(lambda: "0005" in (talker.link or ""))
        before, at = [talker.status(name) for name in ("seq", "name", "angle", "top")], len(talker.kinds)
        yield talker
        shown = [kind for kind in talker.kinds[at:] if not kind.startswith(("Gui", "Set"))]
        assert [talker.status(name) for name in ("seq", "name", "angle", "top")] == before
        assert not shown, "it was sent something"
        talker.set("Rotate", 30)
        talker.wait(lambda: talker.status("angle") == "30")
        workspace = app_workspace(app)
        task = workspace.tasks["drone-to-satellite"]
        state = SessionState(task.name, 4, query=task.query_names.index("0005"), angle=30.0)
        answer = StateAnalyser(workspace).analyse(state, 10)
        assert talker.status("top") == str(answer.matches[0].index)
        assert "Traceback" not in capfd.readouterr().err


def app_workspace(app: App) -> Workspace:
    return next(iter(app._sessions.values()))._workspace


@pytest.fixture
def hostile(app: App, witness: WebSocketClient) -> Iterator[WebSocketClient]:  # noqa: ARG001
    """A client that completed the page's handshake."""
    with WebSocketClient(url(app)) as talker:
        yield talker.greet("?query=0004")


def works(talker: WebSocketClient, angle: int = 45) -> None:
    """Check that the client still gets answers."""
    talker.set("Rotate", angle)
    talker.wait(lambda: talker.status("angle") == str(angle))


def test_values_are_clamped_to_their_range(hostile: WebSocketClient) -> None:
    for sent, shown in ((99999, "180"), (-1e9, "-180"), (True, "1")):
        hostile.set("Rotate", sent)
        hostile.wait(lambda shown=shown: hostile.status("angle") == shown)
        works(hostile)


def test_values_of_wrong_types_are_dropped(hostile: WebSocketClient) -> None:
    for value in ("abc", None, [1, 2], {"a": 1}, float("nan"), float("inf"), 1e300, b"x"):
        for label in ("Rotate", "Zoom", "Weight 1 centre", "Rings", "Opacity"):
            hostile.set(label, value)
    works(hostile)
    assert hostile.status("name") == "0004"


def test_unknown_options_are_ignored(hostile: WebSocketClient) -> None:
    for label in ("Heat of", "Heat type", "Go to"):
        for option in ("../../etc", "", "<b>", "x" * 50_000, 7):
            hostile.set(label, option)
    works(hostile)
    assert hostile.status("name") == "0004"


def test_long_texts_are_truncated_or_end_the_connection(hostile: WebSocketClient) -> None:
    hostile.set("Find name", "x" * 59_000)
    hostile.set("page", "[" * 59_000)
    hostile.set("Find name", "y" * 500_000)
    works(hostile)
    assert "x" * 201 not in hostile.html()
    hostile.set("Find name", "z" * 2_000_000)
    assert hostile.gone()


def test_uploads_beyond_the_limits_are_not_stored(app: App, hostile: WebSocketClient) -> None:
    client = max(app.server.get_clients().items())[1]
    hostile.upload("big.png", b"x" * 1000, size=10**11, transfer="huge")
    hostile.wait(lambda: "big.png is empty, or has more than 30 MB" in str(hostile.controls))
    for number in range(20):
        hostile.upload("slow.png", b"", size=9_000_000, transfer=f"t{number}")
        hostile.send(
            "FileTransferStartUpload",
            source_component_uuid=hostile.find("Use my own picture"),
            transfer_uuid=f"s{number}",
            filename="slow.png",
            mime_type="",
            part_count=100,
            size_bytes=9_000_000,
        )
        hostile.part(0, b"x" * 500_000, f"s{number}")
    works(hostile)
    states = client.gui._current_file_upload_states
    assert len(states) <= 2
    assert sum(len(piece) for state in states.values() for piece in state["parts"].values()) <= 1_000_000


def test_files_for_other_controls_are_not_stored_and_incomplete_uploads_are_bounded(
    app: App, hostile: WebSocketClient
) -> None:
    client = max(app.server.get_clients().items())[1]
    button = hostile.find("Use my own picture")
    for label in ("Rotate", "Zoom", "Find name"):
        fields = {"source_component_uuid": hostile.find(label), "transfer_uuid": label}
        start = {"filename": "a", "mime_type": "", "part_count": 1, "size_bytes": 9}
        hostile.send("FileTransferStartUpload", **fields, **start)
        hostile.send("FileTransferPart", **fields, part_index=0, content=b"x" * 9)
    for number in range(4):
        fields = {"source_component_uuid": button, "transfer_uuid": f"twice {number}"}
        start = {"filename": "a", "mime_type": "", "part_count": 2, "size_bytes": 1000}
        hostile.send("FileTransferStartUpload", **fields, **start)
        for _ in range(3):
            hostile.send("FileTransferPart", **fields, part_index=0, content=b"x" * 500)
    works(hostile)
    assert len(client.gui._current_file_upload_states) == MAX_UPLOADS
    for handle in client.gui._gui_input_handle_from_uuid.values():
        assert not getattr(handle._impl.value, "content", b"")


def test_an_uploads_name_is_shown_escaped_and_without_folders(hostile: WebSocketClient, tmp_path: Path) -> None:
    before = set(tmp_path.rglob("*"))
    hostile.upload('../../<img src=x onerror="alert(1)">.png', picture())
    hostile.wait(lambda: "onerror" in (hostile.status("name") or ""))
    assert "<img src=x" not in hostile.html()
    assert "../" not in (hostile.status("name") or "")
    assert set(tmp_path.rglob("*")) == before


def test_attributes_of_controls_cannot_be_set(app: App, hostile: WebSocketClient) -> None:
    client = max(app.server.get_clients().items())[1]
    before = {uuid: dict(vars(handle._impl)) for uuid, handle in client.gui._gui_input_handle_from_uuid.items()}
    for prop in (
        "removed",
        "sync_cb",
        "update_cb",
        "gui_api",
        "props",
        "label",
        "visible",
        "uuid",
        "is_button",
        "__class__",
    ):
        hostile.set("Rotate", "x", prop)
        hostile.set("Use my own picture", "x", prop)
    works(hostile, 0)
    for uuid, handle in client.gui._gui_input_handle_from_uuid.items():
        found = vars(handle._impl)
        kept = [name for name in before[uuid] if name not in ("value", "update_timestamp")]
        assert all(found[name] is before[uuid][name] for name in kept)


def test_no_page_can_open_a_public_tunnel(app: App, hostile: WebSocketClient, monkeypatch: pytest.MonkeyPatch) -> None:
    import viser._viser

    asked_for: list[object] = []
    monkeypatch.setattr(viser._viser, "ViserTunnel", lambda *given: asked_for.append(given))
    hostile.send("ShareUrlRequest")
    hostile.send("ShareUrlDisconnect")
    works(hostile)
    assert app.server.request_share_url() is None, "viser would call this"
    assert app.server._share_tunnel is None
    assert not asked_for
    assert "ShareUrlUpdated" not in hostile.kinds


@pytest.mark.usefixtures("witness")
def test_a_garbage_frame_ends_its_own_connection(app: App) -> None:
    garbage = b"\xff" * 1000, os.urandom(4000), b"\x91" * 200_000, msgspec.msgpack.encode({"a": 1})
    for frame in ("text", b"", *garbage):
        with WebSocketClient(url(app)) as talker:
            talker.greet("?query=0004").raw(frame)
            assert talker.gone(), frame[:40]


def test_messages_of_wrong_shapes_are_dropped(hostile: WebSocketClient) -> None:
    for kind in dir(viser_messages):
        if kind.endswith("Message") or kind.startswith(("File", "Share", "Gui")):
            hostile.send(kind)
            hostile.send(kind, uuid="x", name="/", updates={}, value=3)
    hostile.camera(position=[0, 0])
    hostile.camera(wxyz=["a", None, 1, 2], image_height=-1)
    hostile.camera(fov=float("nan"))
    works(hostile)


def test_another_browsers_controls_cannot_be_changed(witness: WebSocketClient, hostile: WebSocketClient) -> None:
    for uuid in list(witness.controls):
        hostile.send("GuiUpdateMessage", uuid=uuid, updates={"value": 77})
        hostile.send("GuiUpdateMessage", uuid=uuid, updates={"value": "satellite-to-drone"})
        hostile.send("CommandTriggerMessage", uuid=uuid)
        hostile.send("GuiFormDirtyMessage", uuid=uuid)
        hostile.send("GuiFormSubmitMessage", uuid=uuid)
    works(hostile)


def test_messages_of_the_pages_script_may_contain_anything(app: App, hostile: WebSocketClient) -> None:
    session = app._sessions[max(app._sessions)]
    odd = [
        None,
        -1,
        10**30,
        "",
        "x" * 2000,
        "../../etc",
        [],
        [[[]]],
        [1, 2, 3, 4],
        {"search": 5},
        {"a": {}},
        True,
        "<b>",
        ["table", -1],
    ]
    for kind in [*session.views.bridge._receivers.kinds, "no such kind", ""]:
        for value in odd:
            hostile.tell(kind, value)
            session.views.bridge.receive(msgspec.json.encode({"kind": kind, "value": value}).decode())
    session.change(lambda state: replace(state, why=False, lab=False))
    works(hostile)


@pytest.mark.slow
def test_a_flood_of_messages_delays_only_its_sender(hostile: WebSocketClient) -> None:
    uuid = hostile.find("Rotate")
    for number in range(1500):
        hostile.send("GuiUpdateMessage", uuid=uuid, updates={"value": number % 180})
    works(hostile, -90)


@pytest.mark.usefixtures("witness")
def test_a_flood_of_small_frames_ends_its_connection(app: App) -> None:
    for small in (b"\x89\x80" + bytes(4), b"\x00\x80" + bytes(4)):
        with WebSocketClient(url(app)) as talker:
            raw_socket = talker.greet("?query=0004")._socket.socket
            with contextlib.suppress(OSError):
                raw_socket.sendall(b"\x02\x80" + bytes(4))  # the first piece of a message
                for _ in range(50):
                    raw_socket.sendall(small * 100)
            assert talker.gone(), small


def test_an_upload_is_freed_when_its_browser_leaves(app: App) -> None:
    workers_before = threads_of("explorer-worker")
    with WebSocketClient(url(app)) as talker:
        talker.greet()
        session = weakref.ref(app._sessions[max(app._sessions)])
        handle = weakref.ref(session().client)  # type: ignore[union-attr]
        talker.upload("mine.png", picture(600))
        talker.wait(lambda: talker.status("name") == "mine.png")
        assert sum(one.picture.size > 0 for one in alive(CameraPicture)) == 1  # the list of own pictures has no pixels
        contents = [control._button.value.content for control in alive(UploadControl)]
        assert set(contents) == {b""}, "viser's own copy of the bytes"
    wait_until(
        lambda: not alive(CameraPicture) and session() is None and handle() is None,
        lambda: (alive(CameraPicture), session()),
    )
    wait_until(lambda: threads_of("explorer-worker") <= workers_before)


def alive(kind: type[T]) -> list[T]:
    gc.collect()
    return [one for one in gc.get_objects() if type(one) is kind]


def threads_of(name: str) -> int:
    return sum(thread.name.startswith(name) for thread in threading.enumerate())


@pytest.mark.parametrize("encoding", ["identity", "gzip"])
def test_the_page_says_that_it_is_being_opened_until_its_script_comes(app: App, encoding: str) -> None:
    request = urllib.request.Request(f"{url(app)}/classic/", headers={"Accept-Encoding": encoding})
    with urllib.request.urlopen(request, timeout=60) as response:
        content = response.read()
    assert response.headers["Content-Length"] == str(len(content))
    assert response.headers["Content-Encoding"] == encoding
    page = (gzip.decompress(content) if encoding == "gzip" else content).decode()
    _, body, shown = page.partition("<body>")
    assert body
    assert shown.startswith('<div id="lpn-loading"')
    assert "Opening LPN Explorer" in shown.partition('<div id="root"')[0]
