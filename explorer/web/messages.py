"""Decoding of the messages that the page sends, tagged unions of msgspec structs; their values are untrusted.

A room derives one class from `Message`, and from that one class for each kind of its messages, tagged with the kind. The page
sends {"kind": ..., "value": ...}: the value of a message of several fields is a list of them, that of a message of one field
is the field itself.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import msgspec

log = logging.getLogger(__name__)


class Message(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    """A message of the page."""


_Message = TypeVar("_Message", bound=Message)


class _Envelope(msgspec.Struct):
    kind: str
    value: Any = None


def kinds(room: type[_Message]) -> dict[str, type[_Message]]:
    """Return the class of each kind of message that is derived from a room's class."""
    classes = [one for derived in room.__subclasses__() for one in (derived, *kinds(derived).values())]
    return {str(tag): one for one in classes if (tag := one.__struct_config__.tag) is not None}


def decode(room: type[_Message], kind: str, value: Any) -> _Message | None:
    """Return the message of a room that a JSON value holds, None if it holds none of this kind."""
    return _convert(kinds(room)[kind], kind, value)


def _convert(message_type: type[_Message], kind: str, value: Any) -> _Message | None:
    count = len(message_type.__struct_fields__)
    values = value if count > 1 else [value][:count]
    try:
        return msgspec.convert([kind, *values], message_type) if isinstance(values, list) else None
    except (msgspec.ValidationError, UnicodeEncodeError):
        return None


class Receivers:
    """The receivers of one page's messages.

    Args:
        receivers: of all messages that are derived from a room's class.

    Attributes:
        kinds: the kinds of messages that have a receiver.
    """

    def __init__(self, receivers: Mapping[type[Any], Callable[[Any], None]]) -> None:
        self._receivers: dict[str, tuple[type[Message], Callable[[Any], None]]] = {
            kind: (message_type, receive)
            for room, receive in receivers.items()
            for kind, message_type in kinds(room).items()
        }
        self.kinds = tuple(self._receivers)

    def take(self, text: str) -> None:
        """Hand on a message as the page sends it; drop anything else."""
        try:
            envelope = msgspec.json.decode(text, type=_Envelope)
        except (msgspec.DecodeError, UnicodeEncodeError, RecursionError):
            log.debug("Dropped a message of %d characters", len(text))
            return
        self.hand_on(envelope.kind, envelope.value)

    def hand_on(self, kind: str, value: Any) -> None:
        """Decode a message, and hand it to its receiver; drop anything else."""
        message_type, receive = self._receivers.get(kind, (None, None))
        message = None if message_type is None else _convert(message_type, kind, value)
        if message is None or receive is None:
            log.debug("Dropped a message of the kind %.40r", kind)
        else:
            receive(message)
