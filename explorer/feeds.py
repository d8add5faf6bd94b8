"""Lists and arrays that a page fetches piece by piece, and thumbnails, at addresses of the picture route."""

from __future__ import annotations

import json
import re
import secrets
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from typing import Any, Literal, cast
from weakref import WeakSet

from explorer.server.picture_route import PREFIX, EncodedPicture
from lpn.core.files import TYPED, printable
from lpn.tasks.task import Task

# Entries of a list in one piece.
CHUNK = 100
# Number of served feeds of one owner and name: a page may still fetch pieces of the older one.
_KEPT = 2
# Keys of ended feeds that are remembered.
_ENDED = 1000
_PIECE = re.compile(r"([0-9a-f]{16})/(\d{1,7})", re.ASCII)
_THUMBNAIL = re.compile(r"(thumb|picture)/(\d{1,3})/(query|tile)/(\d{1,10})", re.ASCII)
# JSON escapes control characters below 32; line breaks and tabs stay, like escaped quotes and backslashes.
_CONTROL = re.compile(r'(\\["\\nt])|\\(?:[bfr]|u00[01][0-9a-f])')
# Returns a piece of a feed by its number; None for an unknown number.
Piece = Callable[[int], EncodedPicture | None]
Side = Literal["query", "tile"]
# Returns the JPEG of a query's or a tile's picture by its position in a task: a large one, or a thumbnail.
PictureFile = Callable[[Task, Side, int, bool], bytes]


class Feeds:
    """The feeds of a workspace's browsers, and the pictures of its tasks; thread-safe.

    Attributes:
        address: the folder of all feeds, relative to the page; it differs after each start of the app.
    """

    def __init__(self, tasks: Sequence[Task] = (), picture_file: PictureFile = lambda *_: b"") -> None:
        self._tasks, self._picture_file, self._name = tasks, picture_file, secrets.token_hex(4)
        self.address = f"{PREFIX.lstrip('/')}{self._name}/"
        self._lock = threading.Lock()
        self._feeds: dict[str, Piece] = {}
        self._owned: dict[tuple[object, str], OrderedDict[str, None]] = {}
        self._left: WeakSet[Any] = WeakSet()
        # Keys of ended feeds; a page may still fetch their pieces.
        self._ended: deque[str] = deque(maxlen=_ENDED)
        self._numbers = {task.name: number for number, task in enumerate(tasks)}

    def publish(self, owner: object, name: str, piece: Piece) -> str:
        """Serve a feed until the owner publishes two others of this name, or leaves. An owner that has left publishes nothing.

        Returns:
            The folder of its pieces below `address`.
        """
        key = secrets.token_hex(8)
        with self._lock:
            if owner in self._left:  # the owner's thread may still run
                self._ended.append(key)
                return f"{key}/"
            owned = self._owned.setdefault((owner, name), OrderedDict())
            owned[key] = None
            self._feeds[key] = piece
            while len(owned) > _KEPT:
                self._end(owned.popitem(last=False)[0])
        return f"{key}/"

    def publish_list(self, owner: object, name: str, total: int, entries: Callable[[int, int], Sequence[Any]]) -> str:
        """Serve a list of `total` entries in pieces of `CHUNK` of them, as JSON.

        Args:
            entries: returns the entries from a first position to an end.
        """

        def piece(number: int) -> EncodedPicture | None:
            start = number * CHUNK
            return as_json(entries(start, min(start + CHUNK, total))) if start < total else None

        return self.publish(owner, name, piece)

    def publish_bytes(
        self, owner: object, name: str, make: Callable[[], bytes], media_type: str = "application/octet-stream"
    ) -> str:
        """Serve bytes as the feed's piece 0."""
        return self.publish(owner, name, lambda number: None if number else EncodedPicture(make(), media_type))

    def leave(self, owner: object) -> None:
        """Stop serving an owner's feeds, for good."""
        with self._lock:
            self._left.add(owner)
            for of in [of for of in self._owned if of[0] is owner]:
                for key in self._owned.pop(of):
                    self._end(key)

    def _end(self, key: str) -> None:
        del self._feeds[key]
        self._ended.append(key)

    def thumbnail(self, task: Task, side: Side, index: int) -> str:
        """Return the address of a query's or a tile's thumbnail, relative to the page."""
        return f"{self.thumbnails(task, side)}{index}"

    def thumbnails(self, task: Task, side: Side) -> str:
        """Return the folder of the thumbnails of a task's queries or tiles, relative to the page."""
        return f"{self.address}thumb/{self._numbers[task.name]}/{side}/"

    def pictures(self, task: Task, side: Side) -> str:
        """Return the folder of a task's query or tile pictures, on which parts are drawn, relative to the page."""
        return f"{self.address}picture/{self._numbers[task.name]}/{side}/"

    def find(self, path: str) -> Callable[[], EncodedPicture] | None:
        """Return a function that computes the piece or thumbnail at an untrusted path; None if there is none.

        An ended feed's piece is empty.
        """
        name, _, rest = path.partition("/")
        if name != self._name:
            return None
        if match := _THUMBNAIL.fullmatch(rest):
            return self._find_picture(int(match[2]), cast(Side, match[3]), int(match[4]), match[1] == "picture")
        if not (match := _PIECE.fullmatch(rest)):
            return None
        with self._lock:
            feed = self._feeds.get(match[1])
            if match[1] in self._ended:
                return lambda: EncodedPicture(b"", "application/json")
        number = int(match[2])
        return None if feed is None else lambda: feed(number) or _NOTHING

    def _find_picture(self, number: int, side: Side, index: int, large: bool) -> Callable[[], EncodedPicture] | None:
        if number >= len(self._tasks):
            return None
        task = self._tasks[number]
        if index >= len(task.queries if side == "query" else task.gallery):
            return None
        return lambda: EncodedPicture(self._picture_file(task, side, index, large), "image/jpeg")


_NOTHING = EncodedPicture(b"[]", "application/json")


def as_json(value: Any) -> EncodedPicture:
    """Encode a value as JSON, without control characters in its texts."""
    return EncodedPicture(json_text(value).encode(), "application/json")


def json_text(value: object) -> str:
    """Return a value as JSON, with "?" for each control character in its texts, see `lpn.core.files.printable`.

    Raises:
        TypeError, ValueError: if the value has no form in JSON.
    """
    text = json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return printable(_CONTROL.sub(lambda match: match[1] or "?", text), TYPED)
