"""Pictures that the page loads by their addresses, such as the tiles of a map, computed off the event loop."""

from __future__ import annotations

import asyncio
import logging
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from websockets.datastructures import Headers
from websockets.http11 import Response

from lpn.core.errors import LPNError

log = logging.getLogger(__name__)

# The folder of all these addresses.
PREFIX = "/pictures/"
# Pictures that are computed or wait. A page asks for six at a time.
_MAX_WAITING = 64
_PATH = re.compile(re.escape(PREFIX) + r"([\w./-]{1,120})")


@dataclass(frozen=True, eq=False)
class EncodedPicture:
    """The bytes of a picture file, and their MIME type."""

    data: bytes
    mime: str


# Returns what computes the picture of a path below `PREFIX`, None if there is no such picture. It must return at once.
PictureSource = Callable[[str], Callable[[], EncodedPicture] | None]


class PictureRoute:
    """Answers requests for pictures on two threads of its own, so that no browser waits for another's tiles.

    A browser may keep a picture for an hour: its address must change with its content.
    """

    def __init__(self, source: PictureSource) -> None:
        self._source = source
        self._executor = ThreadPoolExecutor(2, thread_name_prefix="explorer-pictures")
        self._waiting = 0

    def serves(self, path: str) -> bool:
        """Return whether a request's path is one of a picture."""
        return path.startswith(PREFIX)

    async def respond(self, path: str) -> Response:
        """Return the picture, or an error without a body: 404 for an unknown one, 503 if too many wait, 500 if it fails."""
        match = _PATH.fullmatch(path.partition("?")[0])
        compute = None if match is None else self._source(match[1])
        if compute is None:
            return _empty(404, "Not Found")
        if self._waiting >= _MAX_WAITING:
            return _empty(503, "Service Unavailable")
        self._waiting += 1
        try:
            picture = await asyncio.get_running_loop().run_in_executor(self._executor, compute)
        except LPNError as error:
            log.warning("A picture cannot be shown: %s", error)
            return _empty(500, "Internal Server Error")
        except Exception:
            log.exception("A picture cannot be shown")
            return _empty(500, "Internal Server Error")
        finally:
            self._waiting -= 1
        headers = Headers()
        headers["Content-Type"] = picture.mime
        headers["Content-Length"] = str(len(picture.data))
        headers["Cache-Control"] = "private, max-age=3600"
        headers["Connection"] = "close"
        return Response(200, "OK", headers, picture.data)

    def close(self) -> None:
        """Compute no further picture."""
        self._executor.shutdown(wait=False, cancel_futures=True)


def _empty(status: int, reason: str) -> Response:
    headers = Headers()
    headers["Content-Length"] = "0"
    headers["Connection"] = "close"
    return Response(status, reason, headers, b"")
