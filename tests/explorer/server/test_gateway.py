"""A real server behind its gateway, and hostile clients."""

from __future__ import annotations

import contextlib
import http.client
import logging
import os
import socket
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock
from urllib.parse import urlsplit

import cv2
import msgspec
import pytest
import viser
import viser._messages as viser_messages
import viser.infra._infra as viser_infra
from websockets.exceptions import ConnectionClosed, InvalidStatus

from explorer.app import App, serve_in_background
from explorer.server import gateway
from explorer.server.auth import Authenticator
from explorer.server.picture_route import PREFIX, EncodedPicture, PictureRoute
from explorer.server.rate_limiter import GUESSES, RateLimiter, TokenBucket
from explorer.workspace import Workspace, Workspaces
from lpn.core.errors import DataError, InputError, MissingPackageError
from tests.explorer.conftest import TAB, answered, get
from tools.fixtures import small_worlds
from tools.fixtures.screen_tab import ScreenTab, camera_message, scene_socket
from tools.fixtures.small_proxy import SmallProxy
from tools.fixtures.waiting import TIMEOUT, wait_until

TOKEN = "correct horse battery"


def url(app: App) -> str:
    return f"http://127.0.0.1:{app.server.get_port()}"


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


def test_pictures_have_addresses_that_are_protected_like_the_page(
    picture_source: dict[str, Callable[[], EncodedPicture]], locked: App
) -> None:
    picture_source["tile/0/0/0"] = lambda: EncodedPicture(b"JPEG", "image/jpeg")
    picture_source["broken"] = Mock(side_effect=DataError("The sheet is damaged."))
    cookie = f"lpn-{locked.server.get_port()}={locked.authenticator.cookie_value}"
    assert get(locked, f"{PREFIX}tile/0/0/0")[0] == 401
    assert get(locked, f"{PREFIX}tile/0/0/0", host="evil.example", cookie=cookie)[0] == 421
    status, headers, body = get(locked, f"{PREFIX}tile/0/0/0", cookie=cookie)
    assert (status, body, headers["Content-Type"]) == (200, b"JPEG", "image/jpeg")
    assert headers["Cache-Control"].startswith("private")
    assert headers["X-Content-Type-Options"] == "nosniff"
    for path, expected in (("unknown", 404), ("", 404), ("%2e%2e/etc", 404), ("broken", 500)):
        assert get(locked, PREFIX + path, cookie=cookie)[::2] == (expected, b"")


def refused(app: App, **options: object) -> int:
    """Return the status with which a connection is refused."""
    with pytest.raises(InvalidStatus) as raised:
        ScreenTab(url(app), **options)
    return raised.value.response.status_code


def test_the_page_may_load_from_and_connect_to_its_own_server_only(app: App) -> None:
    status, headers, _ = get(app)
    assert status == 200
    assert "unsafe" not in headers["Content-Security-Policy"].replace("style-src 'self' 'unsafe-inline'", "")
    status, headers, body = get(app, f"/scene/{TAB}/")
    assert status == 200
    assert b"viser" in body.lower()
    rules = dict(rule.strip().split(" ", 1) for rule in headers["Content-Security-Policy"].split(";"))
    host = urlsplit(url(app)).netloc
    assert set(rules["connect-src"].split()) == {"'self'", f"ws://{host}", f"wss://{host}", "data:", "blob:"}
    assert rules["default-src"] == rules["frame-ancestors"] == "'self'"
    assert "http" not in headers["Content-Security-Policy"]


def test_a_page_for_a_notebook_may_be_framed_by_this_machine_and_ends_when_it_is_closed(app: App) -> None:
    page = serve_in_background(Workspaces(lambda: app_workspace(app)))
    with urllib.request.urlopen(page.url, timeout=60) as response:
        policy = response.headers["Content-Security-Policy"]
    assert "frame-ancestors 'self' http://localhost:* http://127.0.0.1:* " in policy
    assert page._repr_html_().startswith(f'<iframe src="{page.url}"')
    with pytest.raises(InputError, match="is in use"):
        serve_in_background(Workspaces(lambda: app_workspace(app)), port=urlsplit(page.url).port or 0)
    page.close()
    with pytest.raises(urllib.error.URLError, match="refused"):
        urllib.request.urlopen(page.url, timeout=60)
    with serve_in_background(
        Workspaces(lambda: app_workspace(app)), authenticator=Authenticator("127.0.0.1", TOKEN)
    ) as other:
        assert "iframe" not in other._repr_html_()


def test_another_site_reaches_neither_page_nor_websocket(app: App) -> None:
    status, _, body = get(app, host="evil.example")
    assert status == 421
    assert b"--allow-host evil.example" in body
    assert get(app, "/?websocket=ws://evil.example")[0] == 403
    assert get(app, "/?websocket=ws://evil.example", Upgrade="WebSocket")[0] == 426, "no page"
    assert refused(app, origin="https://evil.example") == 403
    assert refused(app, origin="null") == 403
    with ScreenTab(url(app), origin=url(app)) as tab:
        tab.open()


def raw(app: App, data: bytes) -> bytes:
    """Return the first line of the response to bytes that may not be a request."""
    with socket.create_connection(("127.0.0.1", app.server.get_port()), timeout=TIMEOUT) as connection:
        connection.sendall(data)
        return connection.makefile("rb").readline().strip()


def test_proxies_that_ask_by_http_1_0_or_whether_the_server_is_up_are_answered(locked: App) -> None:
    """By default nginx uses HTTP/1.0, and HAProxy checks by OPTIONS without a host; neither got an answer."""
    assert raw(locked, b"OPTIONS / HTTP/1.0\r\n\r\n") == b"HTTP/1.1 204 No Content"
    assert raw(locked, b"GET / HTTP/1.0\r\nHost: localhost\r\n\r\n") == b"HTTP/1.1 401 Unauthorized"
    locked.authenticator.token = None
    assert raw(locked, b"GET / HTTP/1.0\r\nHost: localhost\r\n\r\n") == b"HTTP/1.1 200 OK"
    connection = http.client.HTTPConnection("127.0.0.1", locked.server.get_port(), timeout=TIMEOUT)
    connection.request("HEAD", f"/scene/{TAB}/")
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
    for folder in ("/maps/", "//", "/user/alice/proxy/absolute/8080/"):
        assert get(app, folder)[0] == 200, folder
    assert get(app, "/maps/pictures/tile/0")[::2] == (200, b"JPEG")
    status, _, body = get(app, "/proxy/8080?query=3", accept="text/html")
    assert status == 200
    assert b"url=./8080/?query=3" in body
    for path in ("/maps/x.js", "/favicon.ico", "/maps/pictures/", "/maps"):
        assert get(app, path)[0] == 404, path


def test_a_websocket_that_a_proxy_changes_is_answered_with_the_reason(app: App) -> None:
    key = {"Sec_WebSocket_Key": "AAAAAAAAAAAAAAAAAAAAAA==", "Sec_WebSocket_Version": "13", "Origin": url(app)}
    status, _, body = get(app, **key)
    assert status == 426
    assert b"arrived as a plain request, without the header Upgrade" in body
    status, _, body = get(app, Upgrade="websocket", Connection="Upgrade", **key)
    assert status == 400
    assert b"without the header Sec-WebSocket-Protocol" in body
    check = f"GET / HTTP/1.1\r\nHost: {urlsplit(url(app)).netloc}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    check += "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    assert raw(app, check.encode()) == b"HTTP/1.1 101 Switching Protocols", "as a proxy checks whether websockets open"
    port, protocol = app.server.get_port(), b"Sec-WebSocket-Protocol: viser-v1.1.1\r\n"
    lines = b"".join(f"{name.replace('_', '-')}: {value}\r\n".encode() for name, value in key.items())
    head = f"GET /maps HTTP/1.0\r\nHost: 127.0.0.1:{port}\r\nConnection: upgrade\r\n".encode()
    opened = raw(app, head + b"Upgrade: WebSocket\r\n" + lines + protocol + b"\r\n")
    assert opened == b"HTTP/1.1 101 Switching Protocols", "as Apache's mod_proxy_wstunnel writes it"


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
        with urllib.request.urlopen(proxy.url, timeout=60) as response:
            assert 'id="photo"' in response.read().decode()
        with ScreenTab(proxy.url, origin=f"http://127.0.0.1:{proxy.port}") as tab:
            tab.open()
    assert not caplog.records


def test_malformed_requests_are_refused_without_a_traceback(
    app: App, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    head = b"GET / HTTP/1.1\r\nHost: localhost\r\n"
    for data in (b"\x16\x03\x01\r\n", b"POST / HTTP/1.1\r\n\r\n", head + b"Content-Length: 3\r\n\r\nabc"):
        assert raw(app, data) == b""
    for data in (
        head + b"Accept-Encoding: gzip\r\nAccept-Encoding: br\r\n\r\n",
        head + b"Upgrade: websocket\r\nUpgrade: h2c\r\n\r\n",
    ):
        assert raw(app, data).startswith(b"HTTP/1.1 400 "), data
    assert raw(app, head.replace(b"/", b"/" + b"a" * 400, 1) + b"\r\n").startswith(b"HTTP/1.1 404 ")
    assert get(app)[0] == 200
    assert "Traceback" not in capfd.readouterr().err
    assert not [record for record in caplog.records if record.exc_info]


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
        assert (b"An address has up to 20,000 characters" in body) == (status == 414)
    assert get(app, cookie="a=" + "1" * 60_000)[0] == 200, "a proxy with a login adds long cookies"
    with pytest.raises((http.client.HTTPException, ConnectionError)):
        get(app, cookie="a=" + "1" * 70_000)
    with pytest.raises((http.client.HTTPException, ConnectionError)):
        get(app, **{f"x{i}": "1" * 8_000 for i in range(9)})


def test_a_refusal_escapes_the_host_name(app: App) -> None:
    _, headers, body = get(app, host="<img/src=x>")
    assert b"<img" not in body
    assert "script" not in headers["Content-Security-Policy"]


def test_page_and_websocket_need_the_token_or_its_cookie(locked: App) -> None:
    for path in ("/", "/index.html", "/assets/x.js", "/?query=1"):
        status, _, body = get(locked, path)
        assert status == 401
        assert b"viser" not in body.lower()
    assert refused(locked) == 401
    status, headers, body = get(locked, "/?query=0003&token=correct+horse+battery")
    assert status == 200
    assert b"url=./?query=0003" in body
    assert b"correct" not in body
    held = headers["Set-Cookie"].partition(";")[0]
    assert get(locked, cookie=held)[0] == 200
    with ScreenTab(url(locked), additional_headers={"Cookie": held}, origin=url(locked)) as tab:
        tab.open()
    with ScreenTab(url(locked) + "/?token=correct+horse+battery") as tab:
        tab.open()


def test_an_address_that_sends_many_wrong_tokens_is_blocked_until_it_stops(
    locked: App, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr(locked.gateway, "_rate_limiter", RateLimiter(lambda: now[0]))
    statuses = [
        get(locked, "/?token=wrong", X_Forwarded_For=f"10.0.0.{number}")[0] for number in range(int(GUESSES) + 2)
    ]
    assert statuses == [403] * int(GUESSES) + [429] * 2
    held = f"lpn-{locked.server.get_port()}={locked.authenticator.cookie_value}"
    assert get(locked, cookie=held)[0] == 200, "browsers that are signed in stay so"
    assert get(locked, "/?token=correct+horse+battery")[0] == 429, "its tokens are not compared"
    now[0] = 60.0
    assert get(locked, "/?token=correct+horse+battery")[0] == 200


def test_an_unsupported_viser_is_refused(app: App, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        server = Mock()
        patch.setattr(viser, "ViserServer", lambda **_: server)
        with pytest.raises(MissingPackageError, match=r"install viser==1\.1\.1"):
            App(app_workspace(app), "127.0.0.1", 0)
        server.stop.assert_called()
    with monkeypatch.context() as patch:
        patch.delattr(viser_infra, "websockets")
        with pytest.raises(MissingPackageError, match="starts its server"):
            App(app_workspace(app), "127.0.0.1", 0)
    monkeypatch.setattr(viser_messages, "ViewerCameraMessage", object)
    with pytest.raises(MissingPackageError, match="ViewerCameraMessage"):
        App(app_workspace(app), "127.0.0.1", 0)


# Hostile tabs and scenes, beside a tab that must not be affected.


@pytest.fixture
def witness(app: App, capfd: pytest.CaptureFixture[str]) -> Iterator[ScreenTab]:
    """Another browser: nothing is sent to its page, and its next result equals a direct computation."""
    with ScreenTab(url(app), origin=url(app)) as tab:
        tab.open("?query=0005")
        tab.until(lambda last: len(last.get("curve", {"points": []})["points"]) == 24)
        while tab.receive(0.2):
            pass
        yield tab
        assert not tab.receive(0.2), f"it was sent {tab.last}"
        expected = answered(app_workspace(app), "?query=0005", angle=30.0).message()
        result = tab.turn(30)
        assert (result["answer"], result["strip"]) == (expected["answer"], expected["strip"])
        assert result["rows"] == expected["rows"]
        assert "Traceback" not in capfd.readouterr().err


def app_workspace(app: App) -> Workspace:
    (workspace,) = app._workspaces.values()
    return workspace


@pytest.fixture
def hostile(app: App, witness: ScreenTab) -> Iterator[ScreenTab]:  # noqa: ARG001
    """A tab that has been opened."""
    with ScreenTab(url(app)) as tab:
        tab.open("?query=0004")
        yield tab


def works(tab: ScreenTab, angle: float = 45) -> None:
    """Check that the tab still gets results of its photo."""
    assert tab.turn(angle)["state"]["query"] == 2


def test_messages_of_any_shape_change_nothing(hostile: ScreenTab) -> None:
    odd: list[object] = [None, -1, 10**30, "", "x" * 2000, [], [[[]]], {"search": 5}, {"a": {}}, True, ["table", -1]]
    actions = ["open", "step", "random", "upload", "forget", "hover", "pick", "scene", "lab.open", "no such", ""]
    for value in odd:
        hostile.send(value)
        hostile.send({"set": value})
        for action in actions[1:]:
            hostile.send({"do": action, "args": value})
            hostile.send({"do": action, "args": {"by": value, "name": value, "size": value, "part": value, "x": value}})
    hostile.send({"do": "open", "args": {"search": "?query=0004&" + "x" * 9000}})
    hostile.socket.send("[" * 19_000)
    hostile.socket.send("x" * 900_000)
    hostile.set(query=2, own="")
    works(hostile)


def test_a_message_beyond_the_limit_ends_the_connection(hostile: ScreenTab) -> None:
    hostile.socket.send("x" * 2_000_000)
    assert hostile.closed()


def test_photos_beyond_the_limits_are_not_kept(app: App, hostile: ScreenTab, tmp_path: Path) -> None:
    before = set(tmp_path.rglob("*"))
    hostile.act("upload", name="big.png", size=10**11)
    assert "big.png has" in hostile.error()
    hostile.socket.send(b"x" * 1000)  # belongs to nothing
    for _ in range(20):
        hostile.act("upload", name="slow.png", size=9_000_000)
        hostile.socket.send(b"x" * 500_000)
    works(hostile)
    (held,) = [one for session in app._channel.sessions.values() if (one := incoming(session))]
    assert held == 500_000, "of several that were begun, the last one"
    hostile.upload('../../<img src=x onerror="alert(1)">.png', cv2.imencode(".png", small_worlds.place(3))[1].tobytes())
    hostile.until(lambda last: last["result"]["photo"]["own"] or "error" in last)
    assert set(tmp_path.rglob("*")) == before


def incoming(session: object) -> int:
    """The bytes of a photo that a tab's session is receiving."""
    found = [
        value for holder in (session, *vars(session).values()) for value in getattr(holder, "_incoming", None) or ()
    ]
    return max((len(one) for one in found if isinstance(one, bytearray)), default=0)


def test_no_page_can_open_a_public_tunnel(app: App, monkeypatch: pytest.MonkeyPatch) -> None:
    import viser._viser

    asked_for: list[object] = []
    monkeypatch.setattr(viser._viser, "ViserTunnel", lambda *given: asked_for.append(given))
    with scene_socket(url(app), TAB) as scene:
        for kind in ("ShareUrlRequest", "ShareUrlDisconnect"):
            scene.send(msgspec.msgpack.encode({"type": kind}))
        wait_until(lambda: camera_of(app, 0.7))
    assert app.server.request_share_url() is None, "viser would call this"
    assert app.server._share_tunnel is None
    assert not asked_for


def camera_of(app: App, fov: float) -> bool:
    """Return whether a client of viser has a camera of a field of view."""
    return any(abs(client.camera.fov - fov) < 1e-6 for client in app.server.get_clients().values())


@pytest.mark.usefixtures("witness")
def test_a_scene_takes_cameras_alone(app: App) -> None:
    """Messages of all other kinds, and cameras of wrong shapes, are dropped; bytes that are no message end the connection."""
    with scene_socket(url(app), TAB, fov=0.7) as scene:
        wait_until(lambda: camera_of(app, 0.7))
        for kind in dir(viser_messages):
            if kind.endswith("Message") or kind.startswith(("File", "Share", "Gui")):
                scene.send(msgspec.msgpack.encode({"type": kind, "uuid": "x", "name": "/", "updates": {}, "value": 3}))
        wrong: list[dict[str, object]] = [{"position": [0, 0]}, {"wxyz": ["a", None, 1, 2]}, {"fov": 1e300}]
        for changed in [*wrong, {"more": 1}, {"image_height": True}]:
            scene.send(camera_message(fov=0.9) if not changed else camera_message(**{"fov": 0.9, **changed}))
        scene.send(camera_message(near=0.02, fov=0.8))
        wait_until(lambda: camera_of(app, 0.8))
        assert not camera_of(app, 0.9)
    for garbage in ("text", b"", b"\xff" * 1000, os.urandom(4000), b"\x91" * 200_000, msgspec.msgpack.encode({"a": 1})):
        with scene_socket(url(app), TAB) as scene:
            scene.send(garbage)
            with contextlib.suppress(ConnectionClosed):
                while True:
                    scene.recv(TIMEOUT)
            assert scene.close_code == 1007


@pytest.mark.slow
def test_a_flood_of_messages_delays_only_its_sender(hostile: ScreenTab) -> None:
    for number in range(1500):
        hostile.set(angle=number % 180)
    works(hostile, -90)


@pytest.mark.usefixtures("witness")
def test_a_flood_of_small_frames_ends_its_connection(app: App) -> None:
    for small in (b"\x89\x80" + bytes(4), b"\x00\x80" + bytes(4)):
        with ScreenTab(url(app)) as tab:
            tab.open("?query=0004")
            with contextlib.suppress(OSError):
                tab.socket.socket.sendall(b"\x02\x80" + bytes(4))  # the first piece of a message
                for _ in range(50):
                    tab.socket.socket.sendall(small * 100)
            assert tab.closed(), small


def test_the_log_has_neither_token_nor_cookie(locked: App, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    assert get(locked, "/?token=guessed+wrong")[0] == 403
    status, headers, _ = get(locked, "/?token=correct+horse+battery")
    assert status == 200
    held = headers["Set-Cookie"].partition(";")[0]
    with ScreenTab(url(locked), additional_headers={"Cookie": held}) as tab:
        tab.open()
        tab.socket.send("no JSON")
        tab.turn(30)
    said = "\n".join(one.getMessage() for one in caplog.records if one.name != "websockets.client")
    for line in ("A wrong token came from 127.0.0.1", "Refused 127.0.0.1, 403: Wrong token", "no JSON: 7 characters"):
        assert line in said
    assert "horse" not in said
    assert "guessed" not in said
    assert locked.authenticator.cookie_value not in said
