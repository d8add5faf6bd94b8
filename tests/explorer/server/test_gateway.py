"""Who may come in, and what a browser may send: the rules alone, then a real server and clients that mean no good."""

from __future__ import annotations

import contextlib
import gc
import http.client
import logging
import os
import socket
import threading
import time
import types
import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import msgspec
import numpy as np
import pytest
import viser._messages as viser_messages
from websockets.exceptions import InvalidStatus

from explorer import uploads
from explorer.app import App
from explorer.opening import open_model
from explorer.server import gateway, rate_limiter
from explorer.server.auth import Authenticator, HttpRequest, Redirect, Refusal, entry, is_loopback, same_origin
from explorer.server.gateway import Gateway
from explorer.server.message_filter import BURST, FIELDS, RATE, UPLOADS, MessageFilter, RejectedMessageError, strange
from explorer.server.rate_limiter import ALL_WAITING, FIRST, FORGET, KEPT, LONGEST, WAITING, RateLimiter
from explorer.session_state import SessionState, Upload
from explorer.workspace import StateAnalyser, Workspace
from lpn.core.errors import InputError, MissingPackageError, PictureError
from tools.fixtures import small_worlds
from tools.fixtures.websocket_client import Talker

TOKEN = "correct horse battery"


def asked(host: str = "localhost:8080", path: str = "/", upgrade: bool = False, **headers: str) -> HttpRequest:
    named = {name.replace("_", "-"): [value] for name, value in headers.items()}
    return HttpRequest(path, {"host": [host], **named}, upgrade)


def verdict(door: Authenticator, request: HttpRequest) -> int | str | None:
    """The status of a refusal, where it is led on to, or None for in."""
    found = door.check(request, 8080)
    return found.status if isinstance(found, Refusal) else found.location if isinstance(found, Redirect) else None


# The rules.


@pytest.mark.parametrize("name", ["localhost", "127.0.0.1", "[::1]", "LOCALHOST", "localhost."])
def test_on_this_machine_its_own_names_come_in_without_a_token(name: str) -> None:
    assert verdict(Authenticator("127.0.0.1"), asked(f"{name}:8080")) is None


@pytest.mark.parametrize(
    "name", ["evil.example:8080", "127.0.0.1.evil.example", "192.168.1.5", "", "a b", "localhost@evil", "[::2]"]
)
def test_a_name_made_to_point_here_is_refused(name: str) -> None:
    assert verdict(Authenticator("127.0.0.1"), asked(name)) == 421


def test_several_hosts_in_one_request_are_refused() -> None:
    assert verdict(Authenticator("127.0.0.1"), HttpRequest("/", {"host": ["localhost", "evil.example"]})) == 421


def test_allowed_names_and_addresses_of_a_server_that_listens_everywhere() -> None:
    door = Authenticator("0.0.0.0", None, ("Maps.Example.org",))
    for name in ("maps.example.org", "192.168.1.5:8080", "[fe80::1]:8080", f"{socket.gethostname()}:8080"):
        assert verdict(door, asked(name)) is None, name
    assert verdict(door, asked("evil.example")) == 421
    assert verdict(Authenticator("192.168.1.5"), asked("192.168.1.5:8080")) is None
    assert verdict(Authenticator("::1"), asked("[::1]:8080")) is None


@pytest.mark.parametrize("name", ["http://maps.example.org", "maps.example.org:443", "", "a b", "<b>"])
def test_an_allowed_name_that_is_none_is_said(name: str) -> None:
    with pytest.raises(InputError, match="--allow-host"):
        Authenticator("127.0.0.1", None, (name,))


@pytest.mark.parametrize(
    ("origin", "host", "same"),
    [
        ("http://localhost:8080", "localhost:8080", True),
        ("https://maps.example.org", "maps.example.org", True),
        ("https://maps.example.org", "maps.example.org:443", True),
        ("HTTP://LOCALHOST:8080", "localhost:8080", True),
        ("http://[::1]:8080", "[::1]:8080", True),
        ("http://localhost:3000", "localhost:8080", False),
        ("http://127.0.0.1:8080", "localhost:8080", False),
        ("https://evil.example", "localhost:8080", False),
        ("http://localhost:8080.evil.example", "localhost:8080", False),
        ("file://", "localhost:8080", False),
        ("null", "localhost:8080", False),
        ("", "localhost:8080", False),
    ],
)
def test_an_origin_is_compared_with_the_host_that_was_asked_for(origin: str, host: str, same: bool) -> None:
    assert same_origin(origin, host) is same
    assert verdict(
        Authenticator("127.0.0.1", allowed=("maps.example.org",)), asked(host, upgrade=True, origin=origin)
    ) == (None if same else 403)


def test_a_page_that_would_run_another_servers_scripts_is_refused() -> None:
    door = Authenticator("127.0.0.1")
    for query in (
        "websocket=ws://evil.example",
        "websocket=ws%3A%2F%2Fevil.example",
        "playbackPath=//evil.example/x",
        "websocket=x",
        "&".join(["a"] * 3000) + "&playbackPath=data:,x",
        "&" * 3000 + "websocket=ws://evil.example",
        "x=%26playbackPath=data:,x",
        "x=%26websocket%3Dws://evil.example",
        "x=1%26y&playbackPath",
    ):
        assert verdict(door, asked(path=f"/?{query}")) == 403, query
    assert verdict(door, asked(path="/?websocket=ws://localhost:8080/prefix&query=0005/01")) is None
    assert verdict(door, asked(path="/?query=0005%26more/01&websocketed=1")) is None


def test_a_token_is_asked_for_by_what_is_listened_on() -> None:
    assert entry("127.0.0.1", None, False, (), {}).token is None
    assert entry("localhost", None, False, (), {}).token is None
    assert len(entry("127.0.0.1", None, True, (), {}).token or "") >= 43
    made = [
        entry(host, None, False, (), {}).token or "" for host in ("0.0.0.0", "192.168.1.5", "::", "maps.example.org")
    ]
    assert len(set(made)) == 4
    assert min(map(len, made)) >= 43
    assert entry("127.0.0.1", None, False, (), {"LPN_TOKEN": TOKEN}).token == TOKEN
    assert entry("0.0.0.0", "another one given", False, (), {"LPN_TOKEN": TOKEN}).token == "another one given"
    for bad in ("", "short"):
        with pytest.raises(InputError):
            entry("127.0.0.1", None, False, (), {"LPN_TOKEN": bad})
    with pytest.raises(InputError, match="12"):
        entry("0.0.0.0", "short", False, (), {})
    assert not is_loopback("")


def test_the_link_has_the_token_that_was_made_and_not_one_that_was_given() -> None:
    assert entry("127.0.0.1", None, False, (), {}).link(8080) == "http://127.0.0.1:8080"
    assert entry("0.0.0.0", TOKEN, False, (), {}).link(8080).startswith("http://127.0.0.1:8080/")
    assert entry("::", TOKEN, False, (), {}).link(8080).startswith("http://[::1]:8080/"), "no IPv4 is listened on then"
    made = entry("::1", None, True, (), {})
    assert made.link(8080) == f"http://[::1]:8080/?token={made.token}"
    assert TOKEN.split()[0] not in entry("0.0.0.0", TOKEN, False, (), {}).link(8080)


def test_a_token_is_taken_once_and_then_a_cookie() -> None:
    door = Authenticator("127.0.0.1", TOKEN)
    assert verdict(door, asked()) == 401
    assert verdict(door, asked(upgrade=True)) == 401
    assert verdict(door, asked(path="/?token=wrong")) == 403
    assert verdict(door, asked(path="/?token=")) == 403
    right = "token=correct+horse%20battery"
    assert verdict(door, asked(path=f"/?query=0005/01&{right}&why=1")) == "./?query=0005/01&why=1"
    assert verdict(door, asked(path=f"/?{right}")) == "./"
    assert verdict(door, asked(path=f"//evil.example/?{right}")) == "./"
    assert verdict(door, asked(path=f"/?{right}", upgrade=True)) is None
    cookie = door.cookie(asked(), 8080)
    assert {"HttpOnly", "SameSite=Strict"} <= set(cookie.split("; "))
    assert "Secure" not in cookie
    assert door.cookie(asked(x_forwarded_proto="https"), 8080).endswith("; Secure")
    held = cookie.partition(";")[0]
    assert TOKEN.split()[0] not in held
    for request in (asked(cookie=held), asked(cookie=f"a=b; {held}; c"), asked(cookie=held, upgrade=True)):
        assert verdict(door, request) is None
    assert verdict(door, asked(path="/?query=1&token=wrong", cookie=held)) == "./?query=1"
    assert door.check(asked(cookie=held), 8081), "another server's cookie"
    assert verdict(door, asked(cookie=held[:-1])) == 401
    assert verdict(Authenticator("127.0.0.1", TOKEN), asked(cookie=held)) == 401, "a cookie of another run"


def test_a_link_from_another_site_is_opened_once_more_for_its_cookie() -> None:
    door = Authenticator("127.0.0.1", TOKEN)
    followed = {"sec_fetch_site": "cross-site", "sec_fetch_mode": "navigate", "sec_fetch_dest": "document"}
    found = door.check(asked(path="/?query=0005/01", **followed), 8080)
    assert found == Redirect("./?query=0005/01", False)
    assert verdict(door, asked(**{**followed, "sec_fetch_site": "same-origin"})) == 401
    assert verdict(door, asked(**{**followed, "sec_fetch_dest": "iframe"})) == 401


def test_wrong_tokens_wait_longer_and_longer_by_address_and_are_forgotten() -> None:
    now = [0.0]
    slowed = RateLimiter(lambda: now[0])

    def wrong(address: str) -> float:
        seconds = slowed.enter(address)
        slowed.leave(address)
        return seconds

    assert [wrong("1.2.3.4") for _ in range(4)] == [FIRST, 2 * FIRST, 4 * FIRST, 8 * FIRST]
    assert [wrong("1.2.3.4") for _ in range(100)][-1] == LONGEST
    assert wrong("1.2.3.5") == FIRST
    assert wrong("2001:db8::1") == FIRST
    assert wrong("2001:db8::ffff:1") == 2 * FIRST, "the same network"
    now[0] = FORGET + 1
    assert wrong("1.2.3.4") == FIRST
    for number in range(KEPT + 50):
        wrong(f"10.0.{number // 256}.{number % 256}")
    assert len(slowed) == KEPT


def test_few_wrong_tokens_wait_at_a_time() -> None:
    slowed = RateLimiter()
    for _ in range(WAITING):
        assert not slowed.full("1.2.3.4")
        slowed.enter("1.2.3.4")
    assert slowed.full("1.2.3.4")
    assert not slowed.full("1.2.3.5")
    slowed.leave("1.2.3.4")
    assert not slowed.full("1.2.3.4")
    for number in range(ALL_WAITING):
        slowed.enter(f"10.0.0.{number}")
    assert slowed.full("1.2.3.5")


# What a message may be.


def packed(kind: str, **fields: object) -> bytes:
    return msgspec.msgpack.encode({"type": kind, **fields})


class Button:
    """An upload button."""


@pytest.fixture
def button() -> Iterator[Button]:
    """That of "u"; viser takes a file for any control."""
    made = uploads.BUTTONS["u"] = Button()
    yield made
    del uploads.BUTTONS["u"]


def begun(transfer: str, size: int, parts: int, name: str = "a.png", control: str = "u") -> bytes:
    fields = {
        "source_component_uuid": control,
        "transfer_uuid": transfer,
        "filename": name,
        "mime_type": "",
        "part_count": parts,
    }
    return packed("FileTransferStartUpload", **fields, size_bytes=size)


def part(transfer: str, index: int, content: bytes, control: str = "u") -> bytes:
    return packed(
        "FileTransferPart", source_component_uuid=control, transfer_uuid=transfer, part_index=index, content=content
    )


def test_visers_messages_have_the_fields_that_are_looked_at() -> None:
    assert strange(viser_messages) == []
    assert strange(types.SimpleNamespace()) == list(FIELDS)


@pytest.mark.parametrize("value", [True, 3, 0.5, "text", -180])
def test_a_controls_value_passes_as_it_came(value: object) -> None:
    message = packed("GuiUpdateMessage", uuid="u", updates={"value": value})
    assert MessageFilter().read(message) == message


@pytest.mark.parametrize(
    "message",
    [
        packed("GuiUpdateMessage", uuid="u", updates={"value": 1, "removed": True}),
        packed("GuiUpdateMessage", uuid="u", updates={"visible": False}),
        packed("GuiUpdateMessage", uuid="u", updates={"value": float("nan")}),
        packed("GuiUpdateMessage", uuid="u", updates={"value": [1]}),
        packed("GuiUpdateMessage", uuid="u", updates={"value": "x" * 60_001}),
        packed("GuiUpdateMessage", uuid="u" * 300, updates={"value": 1}),
        packed("GuiUpdateMessage", uuid="u", updates=[]),
        packed("GuiUpdateMessage", uuid="u"),
        packed("CommandTriggerMessage", uuid="u", more=1),
        packed("ShareUrlRequest"),
        packed("GuiFormDirtyMessage", uuid="u"),
        packed("RunJavascriptMessage", source="alert(1)"),
        packed("SetCameraFovMessage", fov=1),
        packed("NoMessage"),
        part("never begun", 0, b"x"),
    ],
)
def test_a_message_that_no_page_sends_is_dropped(message: bytes) -> None:
    inbox = MessageFilter()
    assert inbox.read(message) is None
    assert inbox.dropped == 1


@pytest.mark.parametrize(
    "message",
    ["text", b"", b"\xc1", os.urandom(999), b"\x91" * 100_000, msgspec.msgpack.encode([1]), msgspec.msgpack.encode({})],
)
def test_what_is_no_message_ends_the_connection(message: bytes | str) -> None:
    with pytest.raises(RejectedMessageError):
        MessageFilter().read(message)


@pytest.mark.usefixtures("button")
def test_uploads_are_bounded_in_bytes_parts_and_number() -> None:
    inbox = MessageFilter()
    assert inbox.read(begun("a", 10, 2)) == begun("a", 10, 2)
    assert inbox.read(begun("a", 10, 2)) is None, "the same again"
    assert inbox.read(part("a", 0, b"x" * 6)) is not None
    assert inbox.read(part("a", 1, b"x" * 6)) is None, "more than was said"
    assert inbox.read(begun("b", 10, 1)) is not None
    assert inbox.read(begun("c", 10, 1)) is None, "a third at a time"
    assert inbox.read(part("a", 1, b"x" * 4)) is not None
    assert inbox.read(part("a", 2, b"")) is None, "it is whole"
    for size, parts in ((uploads.MAX_UPLOAD + 1, 60), (10**12, 1), (1000, 999), (0, 0), (5, 9)):
        emptied = msgspec.msgpack.decode(inbox.read(begun("d", size, parts)) or b"")
        assert (emptied["size_bytes"], emptied["part_count"]) == (0, 0)
    named = msgspec.msgpack.decode(inbox.read(begun("e", 1, 1, "x" * 100_000)) or b"")
    assert len(named["filename"]) == 200


@pytest.mark.usefixtures("button")
def test_a_part_that_viser_would_drop_does_not_end_an_upload() -> None:
    inbox = MessageFilter()
    assert inbox.read(begun("a", 10, 2)) is not None
    assert inbox.read(part("a", 0, b"x" * 9)) is not None
    for index in (0, 2, 1 << 30):
        assert inbox.read(part("a", index, b"")) is None, index
    assert inbox.read(part("a", 1, b"x")) is not None
    assert inbox.read(begun("b", 10, 2)) is not None
    assert inbox.read(part("b", 0, b"x")) is not None
    with pytest.raises(RejectedMessageError, match="size"):
        inbox.read(part("b", 1, b"x"))


@pytest.mark.usefixtures("button")
def test_only_an_upload_button_takes_a_file() -> None:
    inbox = MessageFilter()
    assert inbox.read(begun("a", 1, 1, control="a slider")) is None
    assert inbox.read(begun("a", 1, 1)) is not None
    assert inbox.read(part("a", 0, b"x", "a slider")) is None
    assert inbox.read(part("a", 0, b"x")) is not None


def test_messages_beyond_a_rate_wait_their_turn() -> None:
    now = [0.0]
    inbox = MessageFilter(lambda: now[0])
    assert [inbox.wait() for _ in range(int(BURST))] == [0] * int(BURST)
    assert [inbox.wait() for _ in range(3)] == pytest.approx([1 / RATE, 2 / RATE, 3 / RATE])
    now[0] = 10.0
    assert inbox.wait() == 0


# A picture that is sent.


def picture(size: int = 48, suffix: str = ".png") -> bytes:
    return cv2.imencode(suffix, cv2.resize(small_worlds.place(3), (size, size)))[1].tobytes()


@pytest.mark.parametrize(
    "name", ["../../etc/passwd.png", "C:\\x\\passwd.png", "/passwd.png", "\u202epasswd.png", "a" * 5000]
)
def test_of_an_uploads_name_the_last_part_is_kept_to_be_shown(name: str) -> None:
    taken = uploads.read(name, picture())
    assert not set("/\\\u202e") & set(taken.name)
    assert len(taken.name) <= 80


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
def test_a_picture_is_shrunk_to_a_size_that_can_be_turned(suffix: str) -> None:
    wide = cv2.imencode(suffix, np.zeros((8, 3200, 3), np.uint8))[1].tobytes()
    assert uploads.read("a", wide).picture.shape == (4, 1600, 3)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "empty"),
        (b"x", "JPEG, PNG, or WebP"),
        (b"<svg xmlns='http://www.w3.org/2000/svg'/>", "JPEG, PNG, or WebP"),
        (bytes(uploads.MAX_UPLOAD + 1), "30 MB"),
        (b"\x89PNG\r\n\x1a\n" + bytes(99), "cannot be read|can be read"),
        (picture(suffix=".jpg") + b"\xff\xda" * 500, "passes"),
        (picture(suffix=".bmp"), "JPEG, PNG, or WebP"),
    ],
)
def test_what_is_no_picture_in_bounds_is_not_decoded(content: bytes, said: str) -> None:
    with pytest.raises(PictureError, match=said):
        uploads.read("a.png", content)


# A real server.


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory, model_file: Path) -> Iterator[App]:
    """The app on drawn places, in this process."""
    folder = tmp_path_factory.mktemp("guard")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LPN_CACHE", str(folder / "cache"))
        data = small_worlds.map_dataset(small_worlds.make_dataset(folder / "places", train=1, test=8))
        served = App(open_model(data, model_file), "127.0.0.1", 0)
        yield served
        served.close()


def url(app: App) -> str:
    return f"http://127.0.0.1:{app.server.get_port()}"


def get(app: App, path: str = "/", **headers: str) -> tuple[int, http.client.HTTPMessage, str]:
    connection = http.client.HTTPConnection("127.0.0.1", app.server.get_port(), timeout=20)
    connection.request("GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    answer = connection.getresponse()
    body = answer.read().decode()
    connection.close()
    return answer.status, answer.headers, body


@pytest.fixture
def locked(app: App) -> Iterator[App]:
    """The same, asking for a token."""
    app.door.token = TOKEN
    yield app
    app.door.token = None


def refused(app: App, **options: object) -> int:
    """The status that a connection is refused with."""
    with pytest.raises(InvalidStatus) as raised:
        Talker(url(app), **options)
    return raised.value.response.status_code


def test_the_page_is_served_and_may_load_from_and_connect_to_its_server_alone(app: App) -> None:
    status, headers, body = get(app)
    assert status == 200
    assert "viser" in body.lower()
    rules = dict(rule.strip().split(" ", 1) for rule in headers["Content-Security-Policy"].split(";"))
    host = urlsplit(url(app)).netloc
    assert set(rules["connect-src"].split()) == {"'self'", f"ws://{host}", f"wss://{host}", "data:", "blob:"}
    assert rules["default-src"] == rules["frame-ancestors"] == "'self'"
    assert "http" not in headers["Content-Security-Policy"]


def test_another_site_reaches_neither_page_nor_websocket(app: App) -> None:
    status, _, body = get(app, host="evil.example")
    assert status == 421
    assert "--allow-host evil.example" in body
    assert get(app, "/?websocket=ws://evil.example")[0] == 403
    assert refused(app, origin="https://evil.example") == 403
    assert refused(app, origin="null") == 403
    with Talker(url(app), origin=url(app)):
        pass


def raw(app: App, data: bytes) -> bytes:
    """The first line of the answer to bytes that may be no request."""
    with socket.create_connection(("127.0.0.1", app.server.get_port()), timeout=20) as connection:
        connection.sendall(data)
        return connection.makefile("rb").readline().strip()


def test_what_is_no_request_is_refused_without_a_traceback(
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


def test_a_token_is_not_written_to_the_log(locked: App, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    status, headers, _ = get(locked, "/?token=correct+horse+battery")
    assert status == 200
    get(locked, cookie=headers["Set-Cookie"].partition(";")[0])
    assert "horse" not in caplog.text
    assert locked.door.pass_key not in caplog.text


def test_connections_that_ask_for_nothing_do_not_use_up_the_files(app: App, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gateway, "HALF_OPEN", 8)
    before = len(list(Path("/proc/self/fd").iterdir()))
    held = [socket.create_connection(("127.0.0.1", app.server.get_port()), timeout=20) for _ in range(30)]
    try:
        for connection in held[8:]:
            with contextlib.suppress(ConnectionResetError):
                assert connection.recv(1) == b""
        assert len(list(Path("/proc/self/fd").iterdir())) <= before + 30 + 8, "30 of ours"
        held.pop(0).close()
        time.sleep(0.2)
        assert get(app)[0] == 200
    finally:
        for connection in held:
            connection.close()


def test_a_refusal_shows_what_was_sent_as_text(app: App) -> None:
    _, headers, body = get(app, host="<img/src=x>")
    assert "<img" not in body
    assert "script" not in headers["Content-Security-Policy"]


def test_without_the_token_nothing_answers_and_with_it_everything_does(locked: App) -> None:
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
    with Talker(url(locked), additional_headers={"Cookie": held}, origin=url(locked)) as talker:
        talker.greet()
        assert talker.status("seq")
    with Talker(url(locked) + "/?token=correct+horse+battery"):
        pass


def test_a_wrong_token_waits_and_a_right_one_does_not(locked: App, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rate_limiter, "LONGEST", 2.0)
    waited: list[tuple[int, float]] = []

    def wrong() -> None:
        began = time.monotonic()
        waited.append((get(locked, "/?token=wrong")[0], time.monotonic() - began))

    for _ in range(3):
        wrong()
    assert [status for status, _ in waited] == [403] * 3
    assert waited[2][1] >= 4 * FIRST
    threads = [threading.Thread(target=wrong) for _ in range(3)]
    for thread in threads:
        thread.start()
    time.sleep(0.3)
    assert get(locked, "/?token=correct+horse+battery")[0] == 200
    assert any(thread.is_alive() for thread in threads), "the wrong ones still wait"
    for thread in threads:
        thread.join()
    many = [threading.Thread(target=wrong) for _ in range(7)]
    for thread in many:
        thread.start()
    for thread in many:
        thread.join()
    assert 429 in {status for status, _ in waited}


def test_a_viser_that_does_not_take_the_guard_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    class Other:
        stopped = False

        def stop(self) -> None:
            self.stopped = True

    other = Other()
    with pytest.raises(MissingPackageError, match=r"install viser==1\.1\.1"):
        Gateway(Authenticator("127.0.0.1")).before(lambda: other)  # type: ignore[arg-type,return-value]
    assert other.stopped
    monkeypatch.setattr(viser_messages, "FileTransferPart", object)
    with pytest.raises(MissingPackageError, match="FileTransferPart"):
        Gateway(Authenticator("127.0.0.1"))


# A page that means no good, and another browser that must not notice.


@pytest.fixture
def witness(app: App, capfd: pytest.CaptureFixture[str]) -> Iterator[Talker]:
    """Another browser: what it shows stays, and its next answer is what a computation of its own says."""
    with Talker(url(app), origin=url(app)) as talker:
        talker.greet("?query=0005")
        time.sleep(0.2)
        before, at = [talker.status(name) for name in ("seq", "name", "angle", "top")], len(talker.kinds)
        yield talker
        shown = [kind for kind in talker.kinds[at:] if not kind.startswith(("Gui", "Set"))]
        assert [talker.status(name) for name in ("seq", "name", "angle", "top")] == before
        assert not shown, "it was sent something"
        talker.set("Rotate", 30)
        talker.wait(lambda: talker.status("angle") == "30")
        workspace = app_workspace(app)
        task = workspace.tasks["drone-to-satellite"]
        state = SessionState(task.name, 4, query=task.names.index("0005"), angle=30.0)
        answer = StateAnalyser(workspace).analyse(state, 10)
        assert talker.status("top") == str(answer.matches[0].index)
        assert "Traceback" not in capfd.readouterr().err


def app_workspace(app: App) -> Workspace:
    return next(iter(app._visitors.values()))._workspace


@pytest.fixture
def hostile(app: App, witness: Talker) -> Iterator[Talker]:  # noqa: ARG001
    """A page that was taken for one of the app's own."""
    with Talker(url(app)) as talker:
        yield talker.greet("?query=0004")


def works(talker: Talker, angle: int = 45) -> None:
    """It is still answered."""
    talker.set("Rotate", angle)
    talker.wait(lambda: talker.status("angle") == str(angle))


@pytest.mark.parametrize(("sent", "shown"), [(99999, "180"), (-1e9, "-180"), (True, "1")])
def test_values_out_of_range_are_brought_into_it(hostile: Talker, sent: float, shown: str) -> None:
    hostile.set("Rotate", sent)
    hostile.wait(lambda: hostile.status("angle") == shown)
    works(hostile)


def test_values_that_are_none_are_dropped(hostile: Talker) -> None:
    for value in ("abc", None, [1, 2], {"a": 1}, float("nan"), float("inf"), 1e300, b"x"):
        for label in ("Rotate", "Zoom", "Weight 1 centre", "Rings", "Opacity"):
            hostile.set(label, value)
    works(hostile)
    assert hostile.status("name") == "0004"


def test_unknown_options_are_ignored(hostile: Talker) -> None:
    for label in ("Task", "Heat of", "Shows", "Go to"):
        for option in ("../../etc", "", "<b>", "x" * 50_000, 7):
            hostile.set(label, option)
    works(hostile)
    assert hostile.status("name") == "0004"


def test_huge_texts_are_cut_or_end_the_connection(hostile: Talker) -> None:
    hostile.set("Find name", "x" * 59_000)
    hostile.set("page", "[" * 59_000)
    hostile.set("Find name", "y" * 500_000)
    works(hostile)
    assert "x" * 201 not in hostile.html()
    hostile.set("Find name", "z" * 2_000_000)
    assert hostile.gone()


def test_uploads_beyond_the_limits_take_no_room(app: App, hostile: Talker) -> None:
    client = max(app.server.get_clients().items())[1]
    hostile.upload("big.png", b"x" * 1000, size=10**11, transfer="huge")
    hostile.wait(lambda: "big.png is empty, or too large" in str(hostile.controls))
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


def test_a_file_for_a_slider_is_not_kept_and_an_upload_is_not_left_behind(app: App, hostile: Talker) -> None:
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
    assert len(client.gui._current_file_upload_states) == UPLOADS
    for handle in client.gui._gui_input_handle_from_uuid.values():
        assert not getattr(handle._impl.value, "content", b"")


def test_an_uploads_name_is_shown_as_its_last_part_and_as_text(hostile: Talker, tmp_path: Path) -> None:
    before = set(tmp_path.rglob("*"))
    hostile.upload('../../<img src=x onerror="alert(1)">.png', picture())
    hostile.wait(lambda: "onerror" in (hostile.status("name") or ""))
    assert "<img src=x" not in hostile.html()
    assert "../" not in (hostile.status("name") or "")
    assert set(tmp_path.rglob("*")) == before


def test_attributes_of_controls_cannot_be_set(app: App, hostile: Talker) -> None:
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


def test_no_page_can_ask_for_a_public_tunnel(app: App, hostile: Talker, monkeypatch: pytest.MonkeyPatch) -> None:
    import viser._viser

    asked_for: list[object] = []
    monkeypatch.setattr(viser._viser, "ViserTunnel", lambda *given: asked_for.append(given))
    hostile.send("ShareUrlRequest")
    hostile.send("ShareUrlDisconnect")
    works(hostile)
    assert app.server.request_share_url() is None, "what viser itself would call"
    assert app.server._share_tunnel is None
    assert not asked_for
    assert "ShareUrlUpdated" not in hostile.kinds


@pytest.mark.parametrize(
    "frame", ["text", b"", b"\xff" * 1000, os.urandom(4000), b"\x91" * 200_000, msgspec.msgpack.encode({"a": 1})]
)
def test_a_frame_that_is_garbage_ends_its_own_connection(hostile: Talker, frame: bytes | str) -> None:
    hostile.raw(frame)
    assert hostile.gone()


def test_messages_in_the_wrong_shape_are_dropped(hostile: Talker) -> None:
    for kind in dir(viser_messages):
        if kind.endswith("Message") or kind.startswith(("File", "Share", "Gui")):
            hostile.send(kind)
            hostile.send(kind, uuid="x", name="/", updates={}, value=3)
    hostile.camera(position=[0, 0])
    hostile.camera(wxyz=["a", None, 1, 2], image_height=-1)
    hostile.camera(fov=float("nan"))
    works(hostile)


def test_another_browsers_controls_cannot_be_moved(witness: Talker, hostile: Talker) -> None:
    for uuid in list(witness.controls):
        hostile.send("GuiUpdateMessage", uuid=uuid, updates={"value": 77})
        hostile.send("GuiUpdateMessage", uuid=uuid, updates={"value": "satellite-to-drone"})
        hostile.send("CommandTriggerMessage", uuid=uuid)
        hostile.send("GuiFormDirtyMessage", uuid=uuid)
        hostile.send("GuiFormSubmitMessage", uuid=uuid)
    works(hostile)


def test_the_pages_own_messages_may_hold_anything(app: App, hostile: Talker) -> None:
    visitor = app._visitors[max(app._visitors)]
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
    for kind in [*visitor._bridge._handlers, "no such kind", ""]:
        for value in odd:
            hostile.tell(kind, value)
            visitor._bridge.receive(msgspec.json.encode({"kind": kind, "value": value}).decode())
    visitor.change(lambda state: replace(state, why=False, lab=False))
    works(hostile)


@pytest.mark.slow
def test_a_flood_of_messages_is_the_floods_own_trouble(hostile: Talker) -> None:
    uuid = hostile.find("Rotate")
    for number in range(1500):
        hostile.send("GuiUpdateMessage", uuid=uuid, updates={"value": number % 180})
    works(hostile, -90)


@pytest.mark.parametrize("small", [b"\x89\x80" + bytes(4), b"\x00\x80" + bytes(4)])
def test_a_flood_of_frames_without_a_message_ends_its_connection(hostile: Talker, small: bytes) -> None:
    raw_socket = hostile._socket.socket
    with contextlib.suppress(OSError):
        raw_socket.sendall(b"\x02\x80" + bytes(4))  # the first piece of a message
        for _ in range(50):
            raw_socket.sendall(small * 100)
    assert hostile.gone()


def test_what_a_browser_sent_goes_with_it(app: App) -> None:
    gone = threads_of("explorer-worker")
    with Talker(url(app)) as talker:
        talker.greet()
        visitor = weakref.ref(app._visitors[max(app._visitors)])
        handle = weakref.ref(visitor()._client)  # type: ignore[union-attr]
        talker.upload("mine.png", picture(600))
        talker.wait(lambda: talker.status("name") == "mine.png")
        assert len(alive(Upload)) == 1
        held = visitor()._panels.query._upload._button  # type: ignore[union-attr]
        assert held.value.content == b"", "viser's own copy of the bytes"
        del held
    for _ in range(20):
        if not alive(Upload) and visitor() is None and handle() is None and threads_of("explorer-worker") <= gone:
            return
        time.sleep(0.3)
    raise AssertionError(f"left: {alive(Upload)}, {visitor()}, {handle()}, {threads_of('explorer-worker')}")


def alive(kind: type) -> list[object]:
    gc.collect()
    return [one for one in gc.get_objects() if type(one) is kind]


def threads_of(name: str) -> int:
    return sum(thread.name.startswith(name) for thread in threading.enumerate())
