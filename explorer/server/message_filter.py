"""What a browser may send over the websocket: a few kinds of messages, each in its shape and in bounds. The rest is dropped.

viser takes any message of its protocol, sets any attribute of a control, and keeps what it is sent. What comes through here
is what the page of this app sends when a person uses it; `explorer.session_state` and the panels still trust no value of it.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import msgspec

from explorer.uploads import BUTTONS, MAX_UPLOAD
from explorer.web.bridge import MAX_MESSAGE_LENGTH

log = logging.getLogger(__name__)

MESSAGE_BYTES = 1 << 20
"""Bytes of one message; the largest that a page sends is a part of an upload, 512 KB and its frame."""
UPLOADS, PARTS = 2, 200
"""Uploads under way at a time, and parts of one."""
RATE, BURST = 200.0, 400.0
"""Messages a second that are read of one browser for long, and at once; more wait their turn. A dragged slider sends 20."""

_WORD = 200
_NUMBER = 1e12

Check = Callable[[Any], bool]


class RejectedMessageError(Exception):
    """What came is no message of viser's protocol; the connection is of no use."""


def _number(value: Any) -> bool:
    known = isinstance(value, (int, float)) and not isinstance(value, bool)
    return known and math.isfinite(value) and abs(value) <= _NUMBER


def _numbers(count: int) -> Check:
    return lambda value: isinstance(value, list) and len(value) == count and all(_number(one) for one in value)


def _word(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= _WORD


def _count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= 1 << 40


def _or_none(check: Check) -> Check:
    return lambda value: value is None or check(value)


def _updates(value: Any) -> bool:
    """A control's new value, and no other attribute of it."""
    return isinstance(value, dict) and set(value) == {"value"} and _value(value["value"])


def _value(value: Any) -> bool:
    if isinstance(value, str):
        return len(value) <= MAX_MESSAGE_LENGTH
    return isinstance(value, bool) or _number(value)


FIELDS: Mapping[str, Mapping[str, Check]] = {
    "ViewerCameraMessage": {
        "wxyz": _numbers(4),
        "position": _numbers(3),
        "fov": _number,
        "near": _number,
        "far": _number,
        "image_height": _number,
        "image_width": _number,
        "look_at": _numbers(3),
        "up_direction": _numbers(3),
    },
    "SceneNodeClickMessage": {
        "name": _word,
        "instance_index": _or_none(_count),
        "ray_origin": _numbers(3),
        "ray_direction": _numbers(3),
        "screen_pos": _numbers(2),
        "modifier": _or_none(_word),
        "owner": _word,
    },
    "GuiUpdateMessage": {"uuid": _word, "updates": _updates},
    "CommandTriggerMessage": {"uuid": _word},
    "FileTransferStartUpload": {
        "source_component_uuid": _word,
        "transfer_uuid": _word,
        "filename": lambda value: isinstance(value, str),
        "mime_type": _word,
        "part_count": _count,
        "size_bytes": _count,
    },
    "FileTransferPart": {
        "source_component_uuid": _word,
        "transfer_uuid": _word,
        "part_index": _count,
        "content": lambda value: isinstance(value, bytes),
    },
}
"""The kinds of messages that are read, and what each of their fields must be."""


def strange(messages: object) -> list[str]:
    """Kinds of FIELDS that viser's module of messages does not have, or has with other fields."""
    found = {kind: getattr(messages, kind, None) for kind in FIELDS}
    return [
        kind
        for kind, cls in found.items()
        if not dataclasses.is_dataclass(cls) or {field.name for field in dataclasses.fields(cls)} != set(FIELDS[kind])
    ]


class TokenBucket:
    """So many a second for long, and so many at once."""

    def __init__(self, rate: float, burst: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._burst, self._clock = rate, burst, clock
        self._credit, self._at = burst, clock()

    def take(self) -> float:
        """One more; seconds until it is within the allowance."""
        now = self._clock()
        self._credit = min(self._credit + self._rate * (now - self._at), self._burst) - 1
        self._at = now
        return max(-self._credit / self._rate, 0.0)


@dataclasses.dataclass
class _Upload:
    """An upload under way: the button it is of, the bytes and the parts that are still to come."""

    button: str
    size: int
    parts: set[int]


class MessageFilter:
    """Reads the messages of one browser. Used from one thread.

    Args:
        number: of the browser, for the log.

    Attributes:
        dropped: messages that were not handed on.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, number: int = 0) -> None:
        self._number = number
        self._allowance = TokenBucket(RATE, BURST, clock)
        self._uploads: dict[str, _Upload] = {}
        self.dropped = 0

    def wait(self) -> float:
        """Seconds until the next message is read."""
        return self._allowance.take()

    def read(self, raw: bytes | str) -> bytes | None:
        """The message as viser may have it, or None for one that is dropped.

        Raises:
            RejectedMessageError: when it is no message at all, or the last part of an upload of another size than was said.
        """
        if not isinstance(raw, bytes):
            raise RejectedMessageError("text, where messages are bytes")
        try:
            message = msgspec.msgpack.decode(raw)
        except (ValueError, RecursionError) as error:
            raise RejectedMessageError("bytes that are no message") from error
        if not isinstance(message, dict) or not isinstance(message.get("type"), str):
            raise RejectedMessageError("bytes that are no message")
        kind = message.pop("type")
        fields = FIELDS.get(kind)
        fits = fields is not None and set(message) == set(fields) and all(fields[key](message[key]) for key in fields)
        if fits and kind == "FileTransferStartUpload":
            return self._begun(message)
        if fits and kind == "FileTransferPart":
            fits = self._goes_on(message)
        if fits:
            return raw
        self.dropped += 1
        log.debug("Browser %d: refused a message of kind %.40r and %d bytes", self._number, kind, len(raw))
        return None

    def _begun(self, message: dict[str, Any]) -> bytes | None:
        """An upload that is too large becomes an empty file, of which a person is told, and which takes no room."""
        size, parts, name = message["size_bytes"], message["part_count"], message["transfer_uuid"]
        button = message["source_component_uuid"]
        if button not in BUTTONS or name in self._uploads or len(self._uploads) >= UPLOADS:
            self.dropped += 1
            log.debug("Browser %d: refused an upload, %d being under way", self._number, len(self._uploads))
            return None
        if size > MAX_UPLOAD or not 0 < parts <= PARTS or size < parts:
            log.debug("Browser %d: refused an upload of %d bytes in %d parts", self._number, size, parts)
            message |= {"size_bytes": 0, "part_count": 0}
        else:
            self._uploads[name] = _Upload(button, size, set(range(parts)))
        message["filename"] = message["filename"][:_WORD]
        return msgspec.msgpack.encode({"type": "FileTransferStartUpload", **message})

    def _goes_on(self, message: dict[str, Any]) -> bool:
        """Each part once: viser drops a second one, so an upload would seem whole here and be kept there for good."""
        left = self._uploads.get(message["transfer_uuid"])
        if left is None or message["source_component_uuid"] != left.button or len(message["content"]) > left.size:
            return False
        if message["part_index"] not in left.parts:
            return False
        left.size -= len(message["content"])
        left.parts.remove(message["part_index"])
        if not left.parts:
            if left.size:
                raise RejectedMessageError("an upload of another size than it said")
            del self._uploads[message["transfer_uuid"]]
        return True
