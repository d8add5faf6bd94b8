"""The pages before a browser is let in: a refusal or a redirect. They load and run nothing."""

from __future__ import annotations

import functools
import http

from jinja2 import Template
from websockets.datastructures import Headers
from websockets.http11 import Response

from explorer.server.auth import Redirect, Refusal
from lpn.core.templates import environment

_POLICY = "default-src 'none'; style-src 'unsafe-inline'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'"


def refusal_page(refusal: Refusal) -> Response:
    """Return a page with the reason, and a field for the token if a token would help."""
    return _response(refusal.status, title=refusal.title, text=refusal.text, ask_token=refusal.ask_token)


def redirect_page(redirect: Redirect, cookie: str) -> Response:
    """Return a page that leads to another address at once; it sets `cookie` if the browser signed in."""
    response = _response(200, title="LPN Explorer", location=redirect.location)
    if redirect.sign_in:
        response.headers["Set-Cookie"] = cookie
    return response


def _response(status: int, **values: object) -> Response:
    content = _template().render(values).encode("utf-8", "replace")
    headers = Headers(
        {
            "Content-Type": "text/html; charset=utf-8",
            "Content-Length": str(len(content)),
            "Content-Security-Policy": _POLICY,
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cache-Control": "no-store",
            "Connection": "close",
        }
    )
    return Response(status, http.HTTPStatus(status).phrase, headers, content)


@functools.cache
def _template() -> Template:
    return environment("explorer.server").get_template("auth.html")
