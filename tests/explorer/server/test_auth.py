"""Access rules: host names, origins, tokens, and cookies."""

from __future__ import annotations

import socket

import pytest

from explorer.cli import Explore
from explorer.server.auth import (
    Authenticator,
    HttpRequest,
    Redirect,
    Refusal,
    is_loopback,
    make_authenticator,
    same_origin,
)
from lpn.cli.parsing import parse
from lpn.core.errors import InputError

TOKEN = "correct horse battery"


def request(host: str = "localhost:8080", path: str = "/", upgrade: bool = False, **headers: str) -> HttpRequest:
    named = {name.replace("_", "-"): [value] for name, value in headers.items()}
    return HttpRequest(path, {"host": [host], **named}, upgrade)


def verdict(rules: Authenticator, request: HttpRequest) -> int | str | None:
    """Return the status of a refusal, the location of a redirect, or None if the request is let in."""
    result = rules.check(request, 8080)
    return result.status if isinstance(result, Refusal) else result.location if isinstance(result, Redirect) else None


@pytest.mark.parametrize("name", ["localhost", "127.0.0.1", "[::1]", "LOCALHOST", "localhost."])
def test_loopback_names_need_no_token(name: str) -> None:
    assert verdict(Authenticator("127.0.0.1"), request(f"{name}:8080")) is None


@pytest.mark.parametrize(
    "name", ["evil.example:8080", "127.0.0.1.evil.example", "192.168.1.5", "", "a b", "localhost@evil", "[::2]"]
)
def test_unknown_host_names_are_refused(name: str) -> None:
    assert verdict(Authenticator("127.0.0.1"), request(name)) == 421


def test_a_repeated_host_header_is_refused() -> None:
    assert verdict(Authenticator("127.0.0.1"), HttpRequest("/", {"host": ["localhost", "evil.example"]})) == 421


def test_a_server_on_all_addresses_accepts_ip_addresses_and_allowed_names() -> None:
    rules = Authenticator("0.0.0.0", None, ("Maps.Example.org",))
    for name in ("maps.example.org", "192.168.1.5:8080", "[fe80::1]:8080", f"{socket.gethostname()}:8080"):
        assert verdict(rules, request(name)) is None, name
    assert verdict(rules, request("evil.example")) == 421
    assert verdict(Authenticator("192.168.1.5"), request("192.168.1.5:8080")) is None
    assert verdict(Authenticator("::1"), request("[::1]:8080")) is None


@pytest.mark.parametrize("name", ["http://maps.example.org", "maps.example.org:443", "", "a b", "<b>"])
def test_an_allowed_host_must_be_a_host_name(name: str) -> None:
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
def test_the_origin_of_a_websocket_must_be_the_host(origin: str, host: str, same: bool) -> None:
    assert same_origin(origin, host) is same
    assert verdict(
        Authenticator("127.0.0.1", allowed_hosts=("maps.example.org",)), request(host, upgrade=True, origin=origin)
    ) == (None if same else 403)


def test_an_address_that_makes_the_page_use_another_server_is_refused() -> None:
    rules = Authenticator("127.0.0.1")
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
        assert verdict(rules, request(path=f"/?{query}")) == 403, query
    assert verdict(rules, request(path="/?websocket=ws://localhost:8080/prefix&query=0005/01")) is None
    assert verdict(rules, request(path="/?query=0005%26more/01&websocketed=1")) is None


def test_every_address_but_loopback_needs_a_token() -> None:
    assert make_authenticator("127.0.0.1", None, False, (), {}).token is None
    assert make_authenticator("localhost", None, False, (), {}).token is None
    assert len(make_authenticator("127.0.0.1", None, True, (), {}).token or "") >= 43
    made = [
        make_authenticator(host, None, False, (), {}).token or ""
        for host in ("0.0.0.0", "192.168.1.5", "::", "maps.example.org")
    ]
    assert len(set(made)) == 4
    assert min(map(len, made)) >= 43
    assert make_authenticator("127.0.0.1", None, False, (), {"LPN_TOKEN": TOKEN}).token == TOKEN
    assert (
        make_authenticator("0.0.0.0", "another one given", False, (), {"LPN_TOKEN": TOKEN}).token == "another one given"
    )
    for bad in ("", "short"):
        with pytest.raises(InputError):
            make_authenticator("127.0.0.1", None, False, (), {"LPN_TOKEN": bad})
    with pytest.raises(InputError, match="12"):
        make_authenticator("0.0.0.0", "short", False, (), {})
    assert not is_loopback("")


def test_the_link_shows_a_random_token_but_not_a_chosen_one() -> None:
    assert make_authenticator("127.0.0.1", None, False, (), {}).link(8080) == "http://127.0.0.1:8080"
    assert make_authenticator("0.0.0.0", TOKEN, False, (), {}).link(8080).startswith("http://127.0.0.1:8080/")
    assert make_authenticator("::", TOKEN, False, (), {}).link(8080).startswith("http://[::1]:8080/"), (
        "no IPv4 is listened on then"
    )
    made = make_authenticator("::1", None, True, (), {})
    assert made.link(8080) == f"http://[::1]:8080/?token={made.token}"
    assert TOKEN.split()[0] not in make_authenticator("0.0.0.0", TOKEN, False, (), {}).link(8080)


def test_a_token_is_exchanged_for_a_cookie() -> None:
    rules = Authenticator("127.0.0.1", TOKEN)
    assert verdict(rules, request()) == 401
    assert verdict(rules, request(upgrade=True)) == 401
    assert verdict(rules, request(path="/?token=wrong")) == 403
    assert verdict(rules, request(path="/?token=")) == 403
    right = "token=correct+horse%20battery"
    assert verdict(rules, request(path=f"/?query=0005/01&{right}&why=1")) == "./?query=0005/01&why=1"
    assert verdict(rules, request(path=f"/?{right}")) == "./"
    assert verdict(rules, request(path=f"//evil.example/?{right}")) == "./"
    assert verdict(rules, request(path=f"/?{right}", upgrade=True)) is None
    cookie = rules.cookie(request(), 8080)
    assert {"HttpOnly", "SameSite=Strict"} <= set(cookie.split("; "))
    assert "Secure" not in cookie
    assert rules.cookie(request(x_forwarded_proto="https"), 8080).endswith("; Secure")
    held = cookie.partition(";")[0]
    assert TOKEN.split()[0] not in held
    for signed_in in (request(cookie=held), request(cookie=f"a=b; {held}; c"), request(cookie=held, upgrade=True)):
        assert verdict(rules, signed_in) is None
    assert verdict(rules, request(path="/?query=1&token=wrong", cookie=held)) == "./?query=1"
    assert rules.check(request(cookie=held), 8081), "another server's cookie"
    assert verdict(rules, request(cookie=held[:-1])) == 401
    assert verdict(Authenticator("127.0.0.1", TOKEN), request(cookie=held)) == 401, "a cookie of another run"


def test_a_link_on_another_site_is_opened_again_with_the_cookie() -> None:
    rules = Authenticator("127.0.0.1", TOKEN)
    followed = {"sec_fetch_site": "cross-site", "sec_fetch_mode": "navigate", "sec_fetch_dest": "document"}
    found = rules.check(request(path="/?query=0005/01", **followed), 8080)
    assert found == Redirect("./?query=0005/01", False)
    assert verdict(rules, request(**{**followed, "sec_fetch_site": "same-origin"})) == 401
    assert verdict(rules, request(**{**followed, "sec_fetch_dest": "iframe"})) == 401


def test_no_text_of_the_rules_shows_a_secret() -> None:
    rules = Authenticator("127.0.0.1", "a token of a user")
    assert rules.token is not None
    assert rules.token not in repr(rules)
    assert rules.cookie_value not in repr(rules)


def test_each_allow_host_adds_a_name() -> None:
    options = parse(Explore, ["--allow-host", "a.example", "--allow-host", "b.example"], "lpn explore")
    assert options.allow_host == ("a.example", "b.example")
