"""A check of ONNX files before ONNX Runtime opens them, without the package onnx.

A file is a Protocol Buffers message; the fields that matter here are named by their numbers in onnx.proto.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from pathlib import Path

from lpn.core.errors import ModelFileError
from lpn.core.files import printable

# The largest message of Protocol Buffers in bytes.
MAX_BYTES = 2**31

_FIELDS: dict[str, dict[int, str]] = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "function": {7: "node", 11: "attribute"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
    "tensor": {},
}
_EXTERNAL_DATA, _DATA_LOCATION = 13, 14
_MAX_DEPTH = 30


def check_self_contained(path: Path, remedy: str) -> None:
    """Refuse a model that reads weights from other files, which could be any file on this machine.

    Args:
        remedy: what to do, as the end of a sentence.

    Raises:
        ModelFileError: if it does, or is not an ONNX file, or is truncated.
    """
    size = path.stat().st_size
    damaged = f"{path.name} is not an ONNX model or is truncated; {remedy}."
    if not 0 < size < MAX_BYTES:
        raise ModelFileError(damaged)
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        try:
            external = _has_external_data(data, 0, size, "model", 0)
        except ValueError as error:
            raise ModelFileError(damaged) from error
    if external:
        raise ModelFileError(
            f"{path.name} takes weights from other files, which lpn export never does, so it was not opened; if it is your own, "
            f'put them into one file: python -c "import onnx; onnx.save(onnx.load({printable(str(path))!r}), '
            f'{printable(str(path.with_stem(path.stem + "-whole")))!r})".'
        )


def _has_external_data(data: mmap.mmap, start: int, end: int, message: str, depth: int) -> bool:
    """Return whether a message between two positions has a tensor with external data."""
    if depth > _MAX_DEPTH:
        raise ValueError("it is nested too deep")
    fields = _FIELDS[message]
    for number, kind, first, last in _fields(data, start, end):
        if message == "tensor" and number in (_EXTERNAL_DATA, _DATA_LOCATION):
            if number == _EXTERNAL_DATA or kind != 0 or _varint(data, first, last)[0]:
                return True
        elif number in fields and kind == 2 and _has_external_data(data, first, last, fields[number], depth + 1):
            return True
    return False


def _fields(data: mmap.mmap, position: int, end: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield each field's number and wire type, and the begin and end of its value."""
    while position < end:
        key, position = _varint(data, position, end)
        # Protocol Buffers truncates a key to 32 bits, so it would read another field number than this code.
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
