"""Pictures that the page loads by their addresses, such as the tiles of a map, computed off the event loop."""

from __future__ import annotations

import asyncio
import logging
import re
from base64 import b64encode
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from websockets.datastructures import Headers
from websockets.http11 import Response

from lpn.core.errors import LPNError

log = logging.getLogger(__name__)

# The folder of all these addresses.
PREFIX = "/pictures/"
# Maximum of computed and waiting pictures, for all browsers and for one address. A page asks for six at a time.
_MAX_WAITING, _MAX_WAITING_FOR_ONE = 64, 32
# Seconds after which a client must ask again. The gateway aborts requests that take longer than 10 s.
_PATIENCE = 8.0
# Maximum of remembered paths of logged failures.
_MAX_LOGGED = 1000
_PATH = re.compile(re.escape(PREFIX) + r"([\w./-]{1,120})", re.ASCII)


@dataclass(frozen=True, eq=False)
class EncodedPicture:
    """The bytes of a picture file, and their MIME type."""

    data: bytes
    mime: str

    @property
    def data_uri(self) -> str:
        """The picture itself in place of an address."""
        return f"data:{self.mime};base64,{b64encode(self.data).decode()}"


# Returns a function that computes the picture of a path below `PREFIX`, None if there is no such picture. It must not block.
PictureSource = Callable[[str], Callable[[], EncodedPicture] | None]


@dataclass(frozen=True, eq=False)
class _Computing:
    """A computed or waiting picture, and the address of the browser that asked first."""

    picture: asyncio.Future[EncodedPicture]
    address: str


class PictureRoute:
    """Answers requests for pictures on two separate threads, so that no browser waits for the tiles of a second one.

    Equal requests share one computation, which goes on when a request times out. A browser may keep a picture for an hour: its
    address must change with its content.
    """

    def __init__(self, source: PictureSource) -> None:
        self._source = source
        self._executor = ThreadPoolExecutor(2, thread_name_prefix="explorer-pictures")
        self._computing: dict[str, _Computing] = {}
        self._logged: set[str] = set()

    async def respond(self, path: str, address: str = "") -> Response:
        """Return the picture, 204 for an empty one, or an error without a body.

        The error is 404 for an unknown picture, 500 if it fails, and 503 if it takes long, too many wait, or the app closes.

        Args:
            address: the browser's IP address.
        """
        match = _PATH.fullmatch(path.partition("?")[0])
        compute = None if match is None else self._source(match[1])
        if compute is None:
            return _empty(404, "Not Found")
        future = self._join(path, address, compute)
        if future is None:
            return _empty(503, "Service Unavailable")
        # `wait` cancels no computation, neither at its timeout nor when the request is aborted.
        await asyncio.wait([future], timeout=_PATIENCE)
        if not future.done() or future.cancelled():
            return _empty(503, "Service Unavailable")
        if future.exception() is not None:
            return _empty(500, "Internal Server Error")
        picture = future.result()
        if not picture.data:
            return _empty(204, "No Content")
        headers = Headers()
        headers["Content-Type"] = picture.mime
        headers["Content-Length"] = str(len(picture.data))
        headers["Cache-Control"] = "private, max-age=3600"
        headers["Connection"] = "close"
        return Response(200, "OK", headers, picture.data)

    def close(self) -> None:
        """Compute no further picture."""
        self._executor.shutdown(wait=False, cancel_futures=True)

    def _join(
        self, path: str, address: str, compute: Callable[[], EncodedPicture]
    ) -> asyncio.Future[EncodedPicture] | None:
        """Return the computation of a path, started if necessary; None if too many wait, or the app closes."""
        if path in self._computing:
            return self._computing[path].picture
        for_one = sum(one.address == address for one in self._computing.values())
        if len(self._computing) >= _MAX_WAITING or for_one >= _MAX_WAITING_FOR_ONE:
            return None
        try:
            future = asyncio.get_running_loop().run_in_executor(self._executor, compute)
        except RuntimeError:  # the executor is shut down
            return None
        self._computing[path] = _Computing(future, address)
        future.add_done_callback(lambda _: self._finish(path, future))
        return future

    def _finish(self, path: str, future: asyncio.Future[EncodedPicture]) -> None:
        del self._computing[path]
        error = None if future.cancelled() else future.exception()
        if error is None:
            self._logged.discard(path)
            return
        if path in self._logged:
            return
        if len(self._logged) >= _MAX_LOGGED:
            self._logged.clear()
        self._logged.add(path)
        if isinstance(error, LPNError):
            log.warning("A picture cannot be shown: %s", error)
        else:
            log.error("A picture cannot be shown", exc_info=error)


def _empty(status: int, reason: str) -> Response:
    headers = Headers()
    headers["Content-Length"] = "0"
    headers["Connection"] = "close"
    return Response(status, reason, headers, b"")
