"""viser's page with a cover that says that it is being opened, and why it cannot be, until the page's own script removes it."""

from __future__ import annotations

import gzip
from functools import lru_cache

from websockets.http11 import Response

from lpn.core.templates import environment

_COVER = environment("explorer.server").get_template("loading.html").render().encode()
_BODY = b"<body>"


def with_loading_line(response: Response) -> Response:
    """Put the cover into a response that is a page; any other response is returned as it is."""
    page = response.status_code == 200 and response.headers.get("Content-Type", "").startswith("text/html")
    if page and response.body is not None:
        response.body = _with_cover(bytes(response.body), response.headers.get("Content-Encoding") == "gzip")
        del response.headers["Content-Length"]
        response.headers["Content-Length"] = str(len(response.body))
    return response


@lru_cache(maxsize=4)
def _with_cover(content: bytes, zipped: bool) -> bytes:
    """Return a page with the cover at the beginning of its body; without a body it is returned as it is."""
    before, body, after = (gzip.decompress(content) if zipped else content).partition(_BODY)
    made = before + body + _COVER + after if body else before
    return gzip.compress(made) if zipped else made
