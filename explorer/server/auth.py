"""Who may come in: the host that was asked for, the page that a connection comes from, the token. No viser, no network."""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import os
import re
import secrets
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final
from urllib.parse import parse_qsl, quote, unquote_plus, urlsplit

from lpn.core.errors import InputError

VARIABLE: Final = "LPN_TOKEN"
"""The environment variable a token is read from, where other users of the machine do not see it."""
SHORTEST = 12
"""Characters of a token that somebody chose; random ones have 43."""
_LOOPBACK = frozenset({"localhost", "127.0.0.1", "[::1]"})
_ANY = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}
"""Addresses that stand for all of the machine's, and that by which it reaches itself."""
_HOST = re.compile(r"(\[[0-9a-f:.]+\]|[^\s:\[\]/@?#<>\"'&;,\\]+)(?::([0-9]{1,5}))?")
_PORTS = {"http": "80", "https": "443"}


@dataclass(frozen=True)
class HttpRequest:
    """What is looked at of a request.

    Attributes:
        path: as asked for, query included.
        headers: all values of each header, by lower-case name.
        upgrade: whether it asks for the websocket.
        address: that it comes from.
    """

    path: str
    headers: Mapping[str, Sequence[str]]
    upgrade: bool = False
    address: str = ""

    def one(self, header: str) -> str:
        """The only value of a header, "" where it has none or several."""
        values = self.headers.get(header, ())
        return values[0].strip() if len(values) == 1 else ""


@dataclass(frozen=True)
class Refusal:
    """Why somebody may not come in, as a page says it: plain text.

    Attributes:
        guessed: whether a token was given, and was wrong.
        ask: whether the page has a field for the token.
    """

    status: int
    title: str
    text: str
    guessed: bool = False
    ask: bool = False


@dataclass(frozen=True)
class Redirect:
    """A page that leads to `location` at once, relative to the address asked for.

    A redirect would not do: browsers keep a cookie of the same site to themselves while they follow one from another site.

    Attributes:
        sign_in: whether it brings the cookie.
    """

    location: str
    sign_in: bool


class Authenticator:
    """The rules of one server.

    Args:
        host: address that is listened on.
        token: what is asked for; None for nothing.
        allowed: further names that the server may be asked for by, such as a reverse proxy's.
        told: whether the link shows the token; not one that somebody keeps elsewhere.

    Raises:
        InputError: when a token is too short to be one, or a name is none.
    """

    def __init__(self, host: str, token: str | None = None, allowed: Sequence[str] = (), told: bool = False) -> None:
        if token is not None and len(token) < SHORTEST:
            raise InputError(
                f"The token has {len(token)} characters; expected at least {SHORTEST}, so that it cannot be guessed."
            )
        self.host, self.token, self._told = host, token, told
        self._names = set(_LOOPBACK) | {_name(name) for name in allowed}
        self._anywhere = host in _ANY
        if self._anywhere:
            own = socket.gethostname().lower()
            self._names |= {own, own.partition(".")[0], f"{own.partition('.')[0]}.local"}
        else:
            self._names.add(f"[{host.lower()}]" if ":" in host else host.lower())
        self.pass_key = secrets.token_urlsafe(32)
        """What a browser's cookie must hold: of this run only, and nothing that the token could be guessed from."""

    def check(self, request: HttpRequest, port: int) -> Refusal | Redirect | None:
        """What to answer in place of the page or the websocket; None to let it in.

        Args:
            port: that is listened on, which tells cookies of several servers of one machine apart.
        """
        host = request.one("host").lower()
        if (refused := self._misdirected(host)) is not None:
            return refused
        if request.upgrade and request.headers.get("origin") and not same_origin(request.one("origin"), host):
            return Refusal(
                403,
                "Another web site may not use this server",
                "The connection was asked for by a page of another site. Open the server's own address.",
            )
        query = request.path.partition("?")[2]
        if not request.upgrade and (elsewhere := _elsewhere(query, host)) is not None:
            return Refusal(
                403,
                "This address leads elsewhere",
                f"It asks the page to show what {elsewhere} sends. Open the server's own address, without that part.",
            )
        return None if self.token is None else self._signed_in(request, query, port)

    def guessed_at(self, request: HttpRequest) -> bool:
        """Whether a request gives a token, right or wrong."""
        return self.token is not None and bool(_values(request.path.partition("?")[2], "token"))

    def cookie(self, request: HttpRequest, port: int) -> str:
        """The Set-Cookie header of a browser that brought the token; it holds until the browser is closed."""
        secure = "; Secure" if request.one("x-forwarded-proto").lower() == "https" else ""
        return f"{_cookie(port)}={self.pass_key}; HttpOnly; SameSite=Strict{secure}"

    def link(self, port: int) -> str:
        """The address to open."""
        shown = _ANY.get(self.host) or (f"[{self.host}]" if ":" in self.host else self.host)
        token = "" if self.token is None else quote(self.token, safe="") if self._told else "<yours>"
        return f"http://{shown}:{port}" + (f"/?token={token}" if token else "")

    def _misdirected(self, host: str) -> Refusal | None:
        found = _HOST.fullmatch(host)
        name = found[1].rstrip(".") if found else ""
        if name and (name in self._names or (self._anywhere and _is_address(name))):
            return None
        shown = name or "a name that cannot be read"
        return Refusal(
            421,
            "This server does not go by that name",
            f"It was asked for as {shown}. If that name is right, start it again with --allow-host {name or 'NAME'}.",
        )

    def _signed_in(self, request: HttpRequest, query: str, port: int) -> Refusal | Redirect | None:
        # Every cookie is compared, and both kinds by digests: how long it takes says nothing of how much is right.
        held = [_same(value, self.pass_key) for value in _cookies(request, _cookie(port))]
        given = _values(query, "token")
        if given and _same(given[0], self.token or ""):
            return None if request.upgrade else Redirect(_without_token(request.path), True)
        if any(held):
            return Redirect(_without_token(request.path), False) if given and not request.upgrade else None
        if given:
            return Refusal(403, "Wrong token", _HOW, guessed=True, ask=True)
        if _from_elsewhere(request):
            return Redirect(_without_token(request.path), False)
        return Refusal(401, "A token is needed", _HOW, ask=True)


_HOW = (
    "Open the link that the server printed when it was started, or give the token that is in it. If this browser has given it "
    "before, open this address again."
)


def entry(
    host: str, token: str | None, ask: bool, allowed: Sequence[str], environ: Mapping[str, str] | None = None
) -> Authenticator:
    """The rules for an address: a token on any but this machine's own, and wherever one is given or asked for.

    Args:
        token: None for that of the environment variable, else for a random one where one is needed.
        ask: for a token, on this machine's own address too.

    Raises:
        InputError: when a token is too short to be one, or a name is none.
    """
    environ = os.environ if environ is None else environ
    if token is None and (found := environ.get(VARIABLE)) is not None:
        if not found.strip():
            raise InputError(
                f"{VARIABLE} is empty; put a token of at least {SHORTEST} characters into it, or unset it."
            )
        token = found
    if token is None and (ask or not is_loopback(host)):
        return Authenticator(host, secrets.token_urlsafe(32), allowed, told=True)
    return Authenticator(host, token, allowed)


def is_loopback(host: str) -> bool:
    """Whether an address to listen on is reached from this machine alone."""
    try:
        return host.lower() == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def same_origin(origin: str, host: str) -> bool:
    """Whether a page's origin ("https://name:port") is the host that was asked for ("name:port")."""
    scheme, _, place = origin.lower().partition("://")
    ours, theirs = _HOST.fullmatch(host.lower()), _HOST.fullmatch(place)
    if scheme not in _PORTS or ours is None or theirs is None:
        return False
    usual = _PORTS[scheme]
    return (ours[1], ours[2] or usual) == (theirs[1], theirs[2] or usual)


def _name(given: str) -> str:
    found = _HOST.fullmatch(given.strip().lower())
    if found is None or found[2] is not None:
        raise InputError(f"--allow-host {given!r} is not a host's name; expected one such as maps.example.org.")
    return found[1].rstrip(".")


def _is_address(name: str) -> bool:
    """Another site can give its own name this machine's address, but no page has an address of numbers that is not its own."""
    try:
        ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        return False
    return True


def _elsewhere(query: str, host: str) -> str | None:
    """viser's page connects to, or plays, whatever its address names; the server whose scripts it would then run, if another.

    It also writes its address anew without escaping it, so what a value would become is looked at, too.
    """
    unescaped = "&".join("=".join(pair) for pair in parse_qsl(query, True))
    if any(_values(asked, "playbackPath") for asked in (query, unescaped)):
        return "another file"
    for place in _values(query, "websocket") + _values(unescaped, "websocket"):
        try:
            parts = urlsplit(place)
        except ValueError:
            return "another server"
        if parts.scheme not in ("ws", "wss") or parts.netloc.lower() != host:
            return "another server"
    return None


def _from_elsewhere(request: HttpRequest) -> bool:
    """Whether a link on another site was followed: the browser keeps its cookie to itself then, once."""
    told = [request.one(f"sec-fetch-{what}") for what in ("site", "mode", "dest")]
    return not request.upgrade and told == ["cross-site", "navigate", "document"]


def _values(query: str, key: str) -> list[str]:
    return [value for name, value in parse_qsl(query, True) if name == key]


def _without_token(path: str) -> str:
    place, _, query = path.partition("?")
    kept = [piece for piece in query.split("&") if piece and unquote_plus(piece.partition("=")[0]) != "token"]
    return "./" + place.rpartition("/")[2] + ("?" + "&".join(kept) if kept else "")


def _cookie(port: int) -> str:
    return f"lpn-{port}"


def _cookies(request: HttpRequest, name: str) -> list[str]:
    pairs = (pair.strip().partition("=") for header in request.headers.get("cookie", ()) for pair in header.split(";"))
    return [value for key, _, value in pairs if key == name][:20]


def _same(given: str, expected: str) -> bool:
    digests = (hashlib.sha256(text.encode("utf-8", "surrogatepass")).digest() for text in (given, expected))
    return hmac.compare_digest(*digests)
