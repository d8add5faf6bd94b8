"""What an ONNX file holds, found without onnx and before ONNX Runtime opens it.

The file is a Protocol Buffers message; only the fields that are followed here are named, by their numbers in onnx.proto.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from pathlib import Path

from lpn.core.errors import ModelFileError

LARGEST = 2**31
"""Bytes that Protocol Buffers can read."""

_INSIDE: dict[str, dict[int, str]] = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "function": {7: "node", 11: "attribute"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
    "tensor": {},
}
_DATA_ELSEWHERE, _LOCATION = 13, 14
_DEEPEST = 30


def check_self_contained(path: Path, remedy: str) -> None:
    """Refuse a model that takes weights from other files, which it could name anywhere on this machine.

    Args:
        remedy: what to do, as the end of a sentence.

    Raises:
        ModelFileError: when it does, or is no ONNX file, or cut short.
    """
    size = path.stat().st_size
    damaged = f"{path.name} is not an ONNX model or is truncated; {remedy}."
    if not 0 < size < LARGEST:
        raise ModelFileError(damaged)
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        try:
            elsewhere = _elsewhere(data, 0, size, "model", 0)
        except ValueError as error:
            raise ModelFileError(damaged) from error
    if elsewhere:
        raise ModelFileError(
            f"{path.name} takes weights from other files, which lpn export never does, so it was not opened; {remedy}."
        )


def _elsewhere(data: mmap.mmap, start: int, end: int, message: str, depth: int) -> bool:
    """Whether a message between two positions has a tensor whose values are in another file."""
    if depth > _DEEPEST:
        raise ValueError("it is nested too deep")
    inside = _INSIDE[message]
    for number, kind, first, last in _fields(data, start, end):
        if message == "tensor" and number in (_DATA_ELSEWHERE, _LOCATION):
            if number == _DATA_ELSEWHERE or kind != 0 or _varint(data, first, last)[0]:
                return True
        elif number in inside and kind == 2 and _elsewhere(data, first, last, inside[number], depth + 1):
            return True
    return False


def _fields(data: mmap.mmap, position: int, end: int) -> Iterator[tuple[int, int, int, int]]:
    """Number and wire type of each field, and where its value begins and ends."""
    while position < end:
        key, position = _varint(data, position, end)
        # Protocol Buffers cuts a key to 32 bits, and so would see another field in it than is seen here.
        if not 8 <= key < 2**32:
            raise ValueError("it has a field of no number")
        kind = key & 7
        start = position
        if kind == 0:
            _, position = _varint(data, position, end)
        elif kind in (1, 5):
            position += 8 if kind == 1 else 4
        elif kind == 2:
            length, start = _varint(data, position, end)
            position = start + length
        else:
            raise ValueError("it has a field of no known kind")
        if position > end:
            raise ValueError("it is cut short")
        yield key >> 3, kind, start, position


def _varint(data: mmap.mmap, position: int, end: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if position >= end:
            raise ValueError("it is cut short")
        byte = data[position]
        position += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, position
    raise ValueError("a number in it does not end")
