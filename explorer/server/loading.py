"""viser's page with a line that says that it is being opened, until the page's own script removes it."""

from __future__ import annotations

import gzip
from functools import lru_cache
from pathlib import Path

from websockets.http11 import Response

_LINE = (Path(__file__).parent / "templates" / "loading.html").read_bytes()
_BODY = b"<body>"


def with_loading_line(response: Response) -> Response:
    """Put the line into a response that is a page; any other response is returned as it is."""
    page = response.status_code == 200 and response.headers.get("Content-Type", "").startswith("text/html")
    if page and response.body is not None:
        response.body = _with_line(bytes(response.body), response.headers.get("Content-Encoding") == "gzip")
        del response.headers["Content-Length"]
        response.headers["Content-Length"] = str(len(response.body))
    return response


@lru_cache(maxsize=4)
def _with_line(content: bytes, zipped: bool) -> bytes:
    """Return a page with the line at the beginning of its body; without a body it is returned as it is."""
    before, body, after = (gzip.decompress(content) if zipped else content).partition(_BODY)
    made = before + body + _LINE + after if body else before
    return gzip.compress(made) if zipped else made
