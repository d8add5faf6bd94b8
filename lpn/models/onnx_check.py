"""A check of ONNX files before ONNX Runtime opens them, without the package onnx.

A file is a Protocol Buffers message; its relevant fields are named by their numbers in onnx.proto.
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
    "tensor": {13: "external"},
    "external": {},
}
_MAX_DEPTH = 30


def external_files(path: Path, remedy: str) -> list[Path]:
    """Return the files beside a model that hold its weights, such as `model.onnx.data`.

    Args:
        remedy: the remedy for a damaged file, as the end of a sentence.

    Raises:
        ModelFileError: if one is missing, or lies outside the folder and so could be any file on this machine; or if the model
            is truncated or no ONNX file.
    """
    size = path.stat().st_size
    damaged = f"{path.name} is not an ONNX model or is truncated; {remedy}."
    if not 0 < size < MAX_BYTES:
        raise ModelFileError(damaged)
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        try:
            names = sorted({name.decode() for name in _locations(data, 0, size, "model", 0)})
        except ValueError as error:
            raise ModelFileError(damaged) from error
    for name in names:
        beside = path.with_name(name) if name and Path(name).name == name and "\0" not in name else None
        if beside is None:
            raise ModelFileError(
                f"{path.name} takes weights from {printable(name)[:80]!r}, which is no file beside it, so it was not opened; put "
                "its weights into one file with onnx.save_model."
            )
        if not beside.is_file():
            raise ModelFileError(
                f"{path.name} takes weights from {printable(name)[:80]}, which is missing; copy that file beside it."
            )
    return [path.with_name(name) for name in names]


def _locations(data: mmap.mmap, start: int, end: int, message: str, depth: int) -> Iterator[bytes]:
    """Yield the locations of external data in a message between two positions."""
    if depth > _MAX_DEPTH:
        raise ValueError("it is nested too deep")
    texts: dict[int, bytes] = {}
    for number, kind, first, last in _fields(data, start, end):
        if kind == 2 and number in _FIELDS[message]:
            yield from _locations(data, first, last, _FIELDS[message][number], depth + 1)
        elif kind == 2 and message == "external":
            texts[number] = data[first:last]
    if message == "external" and texts.get(1) == b"location":
        yield texts.get(2, b"")


def _fields(data: mmap.mmap, position: int, end: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield each field's number and wire type, and the begin and end of its value."""
    while position < end:
        key, position = _varint(data, position, end)
        # Protocol Buffers truncates a key to 32 bits, and would then read another field number than this code.
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
