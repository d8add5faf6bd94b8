"""Access rules for HTTP requests: host name, origin, token. They know neither viser nor the network."""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import os
import re
import secrets
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final
from urllib.parse import parse_qsl, quote, unquote_plus, urlsplit

from lpn.core.errors import InputError
from lpn.core.resources import is_loopback

# The environment variable with the token; unlike an option, it is hidden from the machine's other users.
TOKEN_VARIABLE: Final = "LPN_TOKEN"
MIN_TOKEN_LENGTH = 12  # characters of a token that a user chose; random ones have 43
_LOOPBACK = frozenset({"localhost", "127.0.0.1", "[::1]"})
# Addresses that mean all of the machine's addresses, each with its loopback address.
_WILDCARDS = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}
_HOST = re.compile(r"(\[[0-9a-f:.]+\]|[^\s:\[\]/@?#<>\"'&;,\\]+)(?::([0-9]{1,5}))?")
_DEFAULT_PORTS = {"http": "80", "https": "443"}
_HOW_TO_SIGN_IN = (
    "Open the link that the server printed when it started, or enter the token from that link. If this browser is already "
    "signed in, open this address again."
)


@dataclass(frozen=True)
class HttpRequest:
    """The parts of a request that the rules read.

    Attributes:
        path: path and query, as sent.
        headers: all values of each header, by lower-case name.
        upgrade: the request opens the websocket.
        address: the client's IP address.
    """

    path: str
    headers: Mapping[str, Sequence[str]]
    upgrade: bool = False
    address: str = ""

    @property
    def query(self) -> str:
        """The part of the path after "?"."""
        return self.path.partition("?")[2]

    def only(self, header: str) -> str:
        """Return the value of a header, "" if it is absent or repeated."""
        values = self.headers.get(header, ())
        return values[0].strip() if len(values) == 1 else ""


@dataclass(frozen=True)
class Refusal:
    """The reason of a refused request, in plain text.

    Attributes:
        status: HTTP status.
        wrong_token: the request has a token, and it is wrong.
        ask_token: the page has a field for the token.
    """

    status: int
    title: str
    text: str
    wrong_token: bool = False
    ask_token: bool = False


@dataclass(frozen=True)
class Redirect:
    """A page that leads to `location`, relative to the requested address.

    It is a page, since a browser that follows an HTTP redirect from another site does not send a SameSite cookie.

    Attributes:
        sign_in: the page sets the cookie.
    """

    location: str
    sign_in: bool


@dataclass
class Authenticator:
    """The access rules of one server.

    Args:
        host: the address to listen on.
        token: the required token; None if none is required.
        allowed_hosts: further names of the server, such as the name of a reverse proxy.
        show_token: whether `link` contains the token; False for a token that the user keeps elsewhere.

    Attributes:
        cookie_value: the secret in a signed-in browser's cookie; random, and valid until the server ends.

    Raises:
        InputError: when the token is too short, or a name is not a host name.
    """

    host: str
    token: str | None = field(default=None, repr=False)
    allowed_hosts: Sequence[str] = ()
    show_token: bool = False
    cookie_value: str = field(default_factory=lambda: secrets.token_urlsafe(32), init=False, repr=False)

    def __post_init__(self) -> None:
        if self.token is not None and len(self.token) < MIN_TOKEN_LENGTH:
            raise InputError(
                f"The token has {len(self.token)} characters; expected at least {MIN_TOKEN_LENGTH}, so that it cannot be "
                "guessed."
            )
        self._names = {*_LOOPBACK, *(_host_name(name) for name in self.allowed_hosts)}
        self._any_address = self.host in _WILDCARDS
        if self._any_address:
            machine = socket.gethostname().lower()
            short = machine.partition(".")[0]
            self._names |= {machine, short, f"{short}.local"}
        else:
            self._names.add(f"[{self.host.lower()}]" if ":" in self.host else self.host.lower())

    def check(self, request: HttpRequest, port: int) -> Refusal | Redirect | None:
        """Return the response in place of the page or websocket, or None to let the request in.

        Args:
            port: the listening port; it is part of the cookie's name, as browsers share cookies between ports.
        """
        host = request.only("host").lower()
        if (refusal := self._check_host(host)) is not None:
            return refusal
        if request.upgrade:
            if request.headers.get("origin") and not same_origin(request.only("origin"), host):
                return Refusal(
                    403,
                    "Another web site may not use this server",
                    "The connection was requested by a page of another site. Open the server's own address.",
                )
        elif (source := _foreign_source(request.query, host)) is not None:
            return Refusal(
                403,
                "This address leads elsewhere",
                f"It asks the page to load data from {source}. Open the server's own address, without that part.",
            )
        return None if self.token is None else self._check_token(request, self.token, port)

    def has_token(self, request: HttpRequest) -> bool:
        """Return whether a request contains a token, right or wrong."""
        return self.token is not None and bool(_values(request.query, "token"))

    def cookie(self, request: HttpRequest, port: int) -> str:
        """Return the Set-Cookie header for a browser that signed in; it is a session cookie."""
        secure = "; Secure" if request.only("x-forwarded-proto").lower() == "https" else ""
        return f"{_cookie_name(port)}={self.cookie_value}; HttpOnly; SameSite=Strict{secure}"

    def link(self, port: int) -> str:
        """Return the address that the user opens."""
        host = _WILDCARDS.get(self.host) or (f"[{self.host}]" if ":" in self.host else self.host)
        token = "" if self.token is None else quote(self.token, safe="") if self.show_token else "<yours>"
        return f"http://{host}:{port}" + (f"/?token={token}" if token else "")

    def _check_host(self, host: str) -> Refusal | None:
        """Refuse unknown host names: DNS rebinding lets another site's name point to this machine."""
        match = _HOST.fullmatch(host)
        name = match[1].rstrip(".") if match else ""
        if name and (name in self._names or (self._any_address and _ip_address(name.strip("[]")))):
            return None
        return Refusal(
            421,
            "This server does not go by that name",
            f"The request was for {name or 'a name that cannot be read'}. If this page's address has that name, start the server "
            f"again with --allow-host {name or 'NAME'}. If not, the proxy in between must pass Host as the browser sent it; for "
            "nginx, add: proxy_set_header Host $http_host;",
        )

    def _check_token(self, request: HttpRequest, token: str, port: int) -> Refusal | Redirect | None:
        # All cookies are compared, so that the time does not depend on their values.
        matches = [_equal(value, self.cookie_value) for value in _cookies(request, _cookie_name(port))]
        tokens = _values(request.query, "token")
        if tokens and _equal(tokens[0], token):
            return None if request.upgrade else Redirect(_without_token(request.path), sign_in=True)
        if any(matches):
            return Redirect(_without_token(request.path), sign_in=False) if tokens and not request.upgrade else None
        if tokens:
            return Refusal(403, "Wrong token", _HOW_TO_SIGN_IN, wrong_token=True, ask_token=True)
        if _is_cross_site_link(request):
            return Redirect(_without_token(request.path), sign_in=False)
        return Refusal(401, "A token is needed", _HOW_TO_SIGN_IN, ask_token=True)


def make_authenticator(
    host: str,
    token: str | None,
    ask_token: bool,
    allowed_hosts: Sequence[str],
    environ: Mapping[str, str] = os.environ,
) -> Authenticator:
    """Return the rules for an address; any address but loopback requires a token.

    Args:
        token: None for the token of the environment variable, else for a random token if one is required.
        ask_token: require a token on a loopback address, too.

    Raises:
        InputError: when the token is too short, or a name is not a host name.
    """
    if token is None and (token := environ.get(TOKEN_VARIABLE)) is not None and not token.strip():
        raise InputError(
            f"{TOKEN_VARIABLE} is empty; put a token of at least {MIN_TOKEN_LENGTH} characters into it, or unset it."
        )
    if token is None and (ask_token or not is_loopback(host)):
        return Authenticator(host, secrets.token_urlsafe(32), allowed_hosts, show_token=True)
    return Authenticator(host, token, allowed_hosts)


def same_origin(origin: str, host: str) -> bool:
    """Return whether an origin ("https://name:port") is the requested host ("name:port")."""
    scheme, _, place = origin.lower().partition("://")
    ours, theirs, default = _HOST.fullmatch(host.lower()), _HOST.fullmatch(place), _DEFAULT_PORTS.get(scheme)
    if default is None or ours is None or theirs is None:
        return False
    return (ours[1], ours[2] or default) == (theirs[1], theirs[2] or default)


def _host_name(name: str) -> str:
    match = _HOST.fullmatch(name.strip().lower())
    if match is None or match[2] is not None:
        raise InputError(f"--allow-host {name!r} is not a host name; expected one such as maps.example.org.")
    return match[1].rstrip(".")


def _ip_address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None


def _foreign_source(query: str, host: str) -> str | None:
    """Return the foreign source, a server or a recording, that viser's page would open for a query; None without one.

    The page runs scripts from this source. The page rewrites its address without escapes, so the unescaped query is checked, too.
    """
    query += "&" + "&".join("=".join(pair) for pair in parse_qsl(query, True))
    if _values(query, "playbackPath"):
        return "another file"
    try:
        parts = [urlsplit(address) for address in _values(query, "websocket")]
    except ValueError:
        return "another server"
    own = all(part.scheme in ("ws", "wss") and part.netloc.lower() == host for part in parts)
    return None if own else "another server"


def _is_cross_site_link(request: HttpRequest) -> bool:
    """Return whether the user followed a link on another site, for which the browser withholds its SameSite cookie."""
    context = [request.only(f"sec-fetch-{name}") for name in ("site", "mode", "dest")]
    return not request.upgrade and context == ["cross-site", "navigate", "document"]


def _values(query: str, key: str) -> list[str]:
    return [value for name, value in parse_qsl(query, True) if name == key]


def _without_token(path: str) -> str:
    place, _, query = path.partition("?")
    rest = [pair for pair in query.split("&") if pair and unquote_plus(pair.partition("=")[0]) != "token"]
    return "./" + place.rpartition("/")[2] + ("?" + "&".join(rest) if rest else "")


def _cookie_name(port: int) -> str:
    return f"lpn-{port}"


def _cookies(request: HttpRequest, name: str) -> list[str]:
    pairs = (pair.strip().partition("=") for header in request.headers.get("cookie", ()) for pair in header.split(";"))
    return [value for key, _, value in pairs if key == name][:20]


def _equal(value: str, expected: str) -> bool:
    """Compare digests in constant time, which hides the length, too."""
    digests = (hashlib.sha256(text.encode("utf-8", "surrogatepass")).digest() for text in (value, expected))
    return hmac.compare_digest(*digests)
