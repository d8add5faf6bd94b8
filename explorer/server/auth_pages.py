"""The pages of somebody who is not in yet: a refusal, or a way on. No script, nothing loaded, everything shown as text."""

from __future__ import annotations

import http
from html import escape

from websockets.datastructures import Headers
from websockets.http11 import Response

from explorer.server.auth import Redirect, Refusal

_BARE = "form-action 'self'; frame-ancestors 'none'; base-uri 'none'"
_STYLE = (
    "body{font:16px/1.5 system-ui,sans-serif;max-width:34em;margin:12vh auto;padding:0 1em;color:#222;background:#fff}"
    "h1{font-size:1.3em}input,button{font:inherit;padding:.3em .6em}"
    "@media(prefers-color-scheme:dark){body{color:#ddd;background:#1a1b1e}a{color:#56b4e9}}"
)


def refused(refusal: Refusal) -> Response:
    """Why somebody may not come in, and a field for the token where it would help."""
    form = (
        "<form method=get action=./><input name=token type=password aria-label=Token placeholder=Token autofocus> "
        "<button>Open</button></form><p><a href=./>Open again</a></p>"
    )
    body = f"<h1>{escape(refusal.title)}</h1><p>{escape(refusal.text)}</p>{form if refusal.ask else ''}"
    return _html(refusal.status, refusal.title, body)


def led_on(onward: Redirect, cookie: str) -> Response:
    """A page that goes on by itself.

    Args:
        cookie: the Set-Cookie header it brings, where the browser is signed in.
    """
    location = escape(onward.location)
    body = f'<meta http-equiv=refresh content="0;url={location}"><p><a href="{location}">Go on</a></p>'
    answer = _html(200, "LPN Explorer", body)
    if onward.sign_in:
        answer.headers["Set-Cookie"] = cookie
    return answer


def _html(status: int, title: str, body: str) -> Response:
    head = f'<meta charset=utf-8><meta name=viewport content="width=device-width"><title>{title}</title>'
    content = f"<!doctype html><html lang=en>{head}<style>{_STYLE}</style>{body}</html>".encode("utf-8", "replace")
    headers = Headers(
        {
            "Content-Type": "text/html; charset=utf-8",
            "Content-Length": str(len(content)),
            "Content-Security-Policy": f"default-src 'none'; style-src 'unsafe-inline'; {_BARE}",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cache-Control": "no-store",
            "Connection": "close",
        }
    )
    return Response(status, http.HTTPStatus(status).phrase, headers, content)
