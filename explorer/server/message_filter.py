"""The messages that a browser may send over the websocket: few kinds, of bounded size, at a bounded rate.

viser accepts any message of its protocol, sets any attribute of a control, and stores whatever it is sent. The filter lets
through only what the app's page sends. The app still validates every value.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, get_args

import msgspec
from msgspec import Meta

from explorer.server.rate_limiter import TokenBucket

log = logging.getLogger(__name__)

# Bytes of an uploaded picture.
MAX_UPLOAD = 30_000_000
# Characters of a text control. The longest text lists the cells of a region of a large feature map.
MAX_TEXT = 60_000
# Bytes of a message. The page's largest is a part of an upload: 512 KB and its envelope.
MAX_MESSAGE = 1 << 20
# Uploads in progress at a time, and parts of one upload.
MAX_UPLOADS, MAX_PARTS = 2, 200
# Limits on one browser's messages: tokens per second, and the size of the token bucket. Excess messages are delayed.
# A slider sends 20 a second.
RATE, BURST = 200.0, 400.0

_MAX_SHORT_TEXT = 200
_MAX_NUMBER = 10**12

# The bounds also exclude NaN and infinities.
Number = (
    Annotated[int, Meta(ge=-_MAX_NUMBER, le=_MAX_NUMBER)]
    | Annotated[float, Meta(ge=-float(_MAX_NUMBER), le=float(_MAX_NUMBER))]
)
ShortText = Annotated[str, Meta(max_length=_MAX_SHORT_TEXT)]
_Count = Annotated[int, Meta(ge=0, le=1 << 40)]
_NumberTriple = tuple[Number, Number, Number]


class RejectedMessageError(Exception):
    """The browser does not follow viser's protocol; its connection must be closed."""


class ViserMessage(msgspec.Struct, tag_field="type", forbid_unknown_fields=True):
    """A message of viser's protocol; its tag is the name of viser's class."""


class _Camera(ViserMessage, tag="ViewerCameraMessage"):
    wxyz: tuple[Number, Number, Number, Number]
    position: _NumberTriple
    fov: Number
    near: Number
    far: Number
    image_height: Number
    image_width: Number
    look_at: _NumberTriple
    up_direction: _NumberTriple


class _SceneClick(ViserMessage, tag="SceneNodeClickMessage"):
    name: ShortText
    instance_index: _Count | None
    ray_origin: _NumberTriple
    ray_direction: _NumberTriple
    screen_pos: tuple[Number, Number]
    modifier: ShortText | None
    owner: ShortText


class _Value(msgspec.Struct, forbid_unknown_fields=True):  # viser would set any attribute of a control
    value: bool | Number | Annotated[str, Meta(max_length=MAX_TEXT)]


class _ControlUpdate(ViserMessage, tag="GuiUpdateMessage"):
    uuid: ShortText
    updates: _Value


class _Command(ViserMessage, tag="CommandTriggerMessage"):
    uuid: ShortText


class _UploadStart(ViserMessage, tag="FileTransferStartUpload"):
    source_component_uuid: ShortText
    transfer_uuid: ShortText
    filename: str
    mime_type: ShortText
    part_count: _Count
    size_bytes: _Count


class _UploadPart(ViserMessage, tag="FileTransferPart"):
    source_component_uuid: ShortText
    transfer_uuid: ShortText
    part_index: _Count
    content: bytes


class _Other(msgspec.Struct):
    type: str


_ACCEPTED = _Camera | _SceneClick | _ControlUpdate | _Command | _UploadStart | _UploadPart
_MESSAGE = msgspec.msgpack.Decoder(_ACCEPTED)
_OTHER = msgspec.msgpack.Decoder(_Other)
# The fields of each accepted message by the name of viser's class.
FIELDS = {kind.__struct_config__.tag: set(kind.__struct_fields__) for kind in get_args(_ACCEPTED)}


@dataclass
class _Upload:
    """An upload in progress: its button, and the bytes and parts still to come."""

    button: str
    remaining_bytes: int
    remaining_parts: set[int]


class MessageFilter:
    """Reads the messages of one browser. Not thread-safe.

    Args:
        is_upload_button: tells whether a control accepts files.
        clock: returns seconds.

    Attributes:
        number: the browser's number in the log.
    """

    def __init__(self, is_upload_button: Callable[[str], bool], clock: Callable[[], float] = time.monotonic) -> None:
        self._is_upload_button = is_upload_button
        self._bucket = TokenBucket(RATE, BURST, clock)
        self._uploads: dict[str, _Upload] = {}
        self.number = 0

    def delay(self) -> float:
        """Count one message; return the seconds to wait before reading it."""
        return self._bucket.take()

    def read(self, raw: bytes | str) -> bytes | None:
        """Return the message encoded anew for viser, or None if it is dropped.

        Raises:
            RejectedMessageError: when `raw` is not a message, or an upload differs in size from its announcement.
        """
        message = _decode(raw)
        if isinstance(message, _UploadStart):
            accepted = self._start(message)
        elif isinstance(message, _UploadPart):
            accepted = self._continue(message)
        else:
            accepted = not isinstance(message, _Other)
        if accepted:
            return msgspec.msgpack.encode(message)
        kind = message.type if isinstance(message, _Other) else message.__struct_config__.tag
        log.debug("Browser %d: dropped a message of kind %.40r and %d bytes", self.number, kind, len(raw))
        return None

    def _start(self, message: _UploadStart) -> bool:
        """Register an upload. An upload beyond the limits is announced to viser as an empty file; the app then shows an error."""
        name, size, parts = message.transfer_uuid, message.size_bytes, message.part_count
        button = message.source_component_uuid
        if name in self._uploads or len(self._uploads) >= MAX_UPLOADS or not self._is_upload_button(button):
            return False
        if size <= MAX_UPLOAD and 0 < parts <= min(MAX_PARTS, size):
            self._uploads[name] = _Upload(button, size, set(range(parts)))
        else:
            message.size_bytes = message.part_count = 0
        message.filename = message.filename[:_MAX_SHORT_TEXT]
        return True

    def _continue(self, message: _UploadPart) -> bool:
        """Count a part of an upload, or return False to drop it.

        A repeated part is dropped and not counted, because viser ignores it.
        """
        upload = self._uploads.get(message.transfer_uuid)
        if (
            upload is None
            or message.source_component_uuid != upload.button
            or message.part_index not in upload.remaining_parts
            or len(message.content) > upload.remaining_bytes
        ):
            return False
        upload.remaining_bytes -= len(message.content)
        upload.remaining_parts.remove(message.part_index)
        if not upload.remaining_parts:
            if upload.remaining_bytes:
                raise RejectedMessageError("an upload smaller than announced")
            del self._uploads[message.transfer_uuid]
        return True


def _decode(raw: bytes | str) -> ViserMessage | _Other:
    """Return an accepted message, or only the type of any other message."""
    if not isinstance(raw, bytes):
        raise RejectedMessageError("a text frame; expected a binary one")
    try:
        message: ViserMessage = _MESSAGE.decode(raw)
        return message
    except (ValueError, RecursionError):
        pass
    try:
        return _OTHER.decode(raw)
    except (ValueError, RecursionError) as error:
        raise RejectedMessageError("bytes that are not a message") from error
