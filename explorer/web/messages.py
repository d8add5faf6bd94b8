"""Decoding of the messages that the page's HTML sends; their values are untrusted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec

_Message = TypeVar("_Message", bound=msgspec.Struct)


def decode(types: Mapping[str, type[_Message]], kind: str, value: Any) -> _Message | None:
    """Return the message that a JSON value holds, None if it holds none of this kind.

    The value of a message of several fields is a list of them, that of a message of one field is the field itself.

    Args:
        types: a class for each kind of message.
    """
    message_type = types[kind]
    count = len(message_type.__struct_fields__)
    try:
        return msgspec.convert(value if count > 1 else [value][:count], message_type)
    except (msgspec.ValidationError, UnicodeEncodeError):
        return None
