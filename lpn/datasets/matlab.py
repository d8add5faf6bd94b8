"""MATLAB files, read by scipy after a check of their structure: on a damaged file its reader can end the whole process."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from lpn.core.errors import DataError
from lpn.core.files import printable

MOST_BYTES = 4_000_000_000
"""The largest file, and the largest content of one when unpacked, that is read."""

_SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8}
_TEXT = {1: 1, 2: 1, 4: 2, 16: 1, 17: 2, 18: 4}
_INT8, _INT32, _UINT32, _MATRIX, _PACKED = 1, 5, 6, 14, 15
_CELL, _STRUCT, _CHAR, _NUMERIC, _OPAQUE = 1, 2, 4, range(6, 16), 17

Element = tuple[int, memoryview]


def load(
    path: Path, names: Sequence[str], expected: str, optional: Sequence[str] = (), simplify: bool = True
) -> dict[str, Any]:
    """The named variables of a MATLAB 5 file as `scipy.io.loadmat` gives them.

    Args:
        expected: what the file should hold, for the sentence that says it does not.
        optional: further variables, which are left out where the file has none of that name.
        simplify: give structs as dicts, and matrices without their sides of one.

    Raises:
        DataError: when the file cannot be read, is not a whole MATLAB 5 file, or lacks one of the variables.
        ModuleNotFoundError: when scipy is not installed.
    """
    from scipy.io import loadmat

    try:
        if path.stat().st_size > MOST_BYTES:
            raise ValueError(f"it has more than {MOST_BYTES // 1_000_000} MB")
        asked = [*names, *optional]
        _check(path.read_bytes(), frozenset(asked))
        values: dict[str, Any] = loadmat(path, simplify_cells=simplify, variable_names=asked)
        if missing := [name for name in names if name not in values]:
            raise ValueError(f"it has no {', '.join(missing)}")
    except Exception as error:  # scipy raises anything on what it does not know
        said = error.strerror or str(error) if isinstance(error, OSError) else str(error).strip().partition("\n")[0]
        raise DataError(
            f"{path.name} cannot be read ({printable(said or type(error).__name__)}); expected {expected}."
        ) from error
    return {name: values[name] for name in asked if name in values}


def _check(data: bytes, names: frozenset[str]) -> None:
    """Refuse what does not hold together: types and sizes of every element, as the format's description has them.

    Of variables that are not asked for, only what comes before their content, which is as far as scipy reads them.
    """
    if len(data) < 128 or data[126:128] != b"IM":
        raise ValueError("it is no MATLAB 5 file of a little-endian machine")
    for kind, body in _elements(memoryview(data)[128:]):
        content = _unpacked(body) if kind == _PACKED else [(kind, body)]
        for inner, matrix in content:
            _require(inner == _MATRIX, "something other than a variable stands where one should")
            _check_matrix(matrix, 0, names)


def _unpacked(body: memoryview) -> Iterator[Element]:
    unpacker = zlib.decompressobj()
    data = unpacker.decompress(body, MOST_BYTES)
    _require(unpacker.eof, "a variable is cut short")
    return _elements(memoryview(data))


def _elements(data: memoryview) -> Iterator[Element]:
    position = 0
    while position < len(data):
        _require(len(data) - position >= 8, "it is cut short")
        kind, size = struct.unpack_from("<II", data, position)
        if kind >> 16:
            kind, size, start, after = kind & 0xFFFF, kind >> 16, position + 4, position + 8
            _require(size <= 4, "the size of a value is wrong")
        else:
            start = position + 8
            # Values are filled up to eight bytes, packed variables are not.
            after = start + size + (0 if kind == _PACKED else -size % 8)
        _require(start + size <= len(data), "it is cut short")
        yield kind, data[start : start + size]
        position = after


def _check_matrix(data: memoryview, depth: int, names: frozenset[str] | None = None) -> None:
    if not len(data):
        return
    _require(depth < 8, "its structs are nested too deep")
    parts = list(_elements(data))
    _require(len(parts) >= 3, "a variable is incomplete")
    (flags_kind, flags), (shape_kind, shape), (name_kind, name) = parts[:3]
    _require((flags_kind, len(flags)) == (_UINT32, 8), "a variable's flags are wrong")
    if flags[0] == _OPAQUE and names is not None:
        return
    _require(shape_kind == _INT32 and 8 <= len(shape) <= 128 and not len(shape) % 4, "a variable's shape is wrong")
    _require(name_kind == _INT8 and len(name) < 64, "a variable's name is wrong")
    sides = struct.unpack(f"<{len(shape) // 4}i", shape)
    _require(min(sides) >= 0, "a variable's shape is wrong")
    if names is not None and bytes(name).decode("latin1") not in names:
        return
    count, kind, complex_too = math.prod(sides), flags[0], bool(flags[1] & 8)
    rest = parts[3:]
    if kind == _STRUCT:
        _require(len(rest) >= 2 and rest[0][0] == _INT32 and len(rest[0][1]) == 4, "a struct is incomplete")
        (length,) = struct.unpack("<i", rest[0][1])
        _require(
            rest[1][0] == _INT8 and 0 < length <= 64 and not len(rest[1][1]) % length, "a struct's fields are wrong"
        )
        count *= len(rest[1][1]) // length
        rest = rest[2:]
    if kind in (_STRUCT, _CELL):
        _require(len(rest) == count and all(inner == _MATRIX for inner, _ in rest), "a struct or cell is incomplete")
        for _, inner_data in rest:
            _check_matrix(inner_data, depth + 1)
        return
    sizes = _TEXT if kind == _CHAR else _SIZES
    _require(kind == _CHAR or kind in _NUMERIC, f"it has a variable of class {kind}, which is neither numbers nor text")
    _require(len(rest) == (2 if complex_too else 1), "a variable is incomplete")
    for inner, values in rest:
        _require(inner in sizes, "a variable's type is wrong")
        # UTF-8 takes one to four bytes a letter.
        most = 4 if inner == 16 else 1
        _require(count * sizes[inner] <= len(values) <= most * count * sizes[inner], "a variable's size is wrong")


def _require(held: bool, said: str) -> None:
    if not held:
        raise ValueError(said)
