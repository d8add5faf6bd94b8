"""The filter of messages from viser's page: only the camera of a tab's scene, of bounded size, at a bounded rate.

viser accepts any message of its protocol, sets any attribute of a control, and stores all data that it receives.
"""

from __future__ import annotations

import logging
from typing import Annotated

import msgspec
from msgspec import Meta

log = logging.getLogger(__name__)

# Bytes of a message. The largest is a part of a photo: 512 KB.
MAX_MESSAGE = 1 << 20
# Limits on one browser's messages: tokens per second, and the size of the token bucket. Excess messages are delayed.
# A camera sends 20 a second.
RATE, BURST = 200.0, 400.0

_MAX_NUMBER = 10**12
# The bounds also exclude NaN and infinities.
Number = (
    Annotated[int, Meta(ge=-_MAX_NUMBER, le=_MAX_NUMBER)]
    | Annotated[float, Meta(ge=-float(_MAX_NUMBER), le=float(_MAX_NUMBER))]
)
_NumberTriple = tuple[Number, Number, Number]


class RejectedMessageError(Exception):
    """The browser does not follow viser's protocol; its connection must be closed."""


class CameraMessage(msgspec.Struct, tag_field="type", tag="ViewerCameraMessage", forbid_unknown_fields=True):
    """The camera of a scene; the tag is the name of viser's class."""

    wxyz: tuple[Number, Number, Number, Number]
    position: _NumberTriple
    fov: Number
    near: Number
    far: Number
    image_height: Number
    image_width: Number
    look_at: _NumberTriple
    up_direction: _NumberTriple


class _Other(msgspec.Struct):
    type: str


_MESSAGE, _OTHER = msgspec.msgpack.Decoder(CameraMessage), msgspec.msgpack.Decoder(_Other)
# The fields of the accepted message by the name of viser's class.
FIELDS = {str(CameraMessage.__struct_config__.tag): set(CameraMessage.__struct_fields__)}


def filtered(raw: bytes | str) -> bytes | None:
    """Return a message encoded anew for viser, or None if it is dropped.

    Raises:
        RejectedMessageError: when `raw` is not a message.
    """
    if not isinstance(raw, bytes):
        raise RejectedMessageError("a text frame; expected a binary one")
    try:
        return msgspec.msgpack.encode(_MESSAGE.decode(raw))
    except (ValueError, RecursionError):
        pass
    try:
        kind = _OTHER.decode(raw).type
    except (ValueError, RecursionError) as error:
        raise RejectedMessageError("bytes that are not a message") from error
    log.debug("Dropped a message of kind %.40r and %d bytes", kind, len(raw))
    return None
