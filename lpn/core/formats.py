"""Versions of our file formats, "kind/number", and the message about a file of a later version."""

from __future__ import annotations

from typing import Any, TypeVar

import msgspec

from lpn.core.errors import LPNError

_Record = TypeVar("_Record")


# The format of world.json in a rendered data set.
WORLD = "lpn-world/1"
UPGRADE = "install the newer version of lpn-explorer"


class _Header(msgspec.Struct):
    format: Any = None


def format_of(data: bytes) -> Any:
    """Return the entry `format` of a JSON file; None without one, or for another file."""
    try:
        return msgspec.json.decode(data, type=_Header).format
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None


def is_newer(stated: Any, ours: str) -> bool:
    """Return whether `stated` is a later version of the format `ours`."""
    if not isinstance(stated, str):
        return False
    kind, _, number = stated.partition("/")
    our_kind, _, our_number = ours.partition("/")
    # int() accepts other scripts' digits too, and refuses thousands of digits.
    plain = number.isascii() and number.isdecimal() and len(number) < 10
    return kind == our_kind and plain and int(number) > int(our_number)


def newer_version(what: object, stated: str, ours: str) -> str:
    """Return the message about a file (`what`, the sentence's subject) of a later version."""
    return f"{what} was written by a later version of lpn ({stated}, and this one knows {ours}); {UPGRADE}."


def decode_json(data: bytes, record: type[_Record], what: object, ours: str, error: type[LPNError]) -> _Record:
    """Decode a JSON file of a versioned format.

    Args:
        record: the msgspec struct of the file.
        what: the file, as the subject of a sentence.
        ours: the format that this version writes.
        error: the class of the error about a later version.

    Raises:
        LPNError: an `error` if a later version of lpn wrote the file.
        ValueError, RecursionError: if the file is damaged or has another format.
    """
    stated = format_of(data)
    if is_newer(stated, ours):
        raise error(newer_version(what, stated, ours))
    if stated != ours:
        raise ValueError("another format")
    return msgspec.json.decode(data, type=record)
