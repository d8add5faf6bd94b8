"""A flight's folder: `flight.csv` with one row a frame, `flight.json`, and the frames of videos in `frames`.

    name,file,width,height,time,latitude,longitude,height_above_ground,height_above_takeoff,altitude,heading,heading_source,...

`file` is relative to the folder where possible. Unknown values are empty. What a spreadsheet would compute has an apostrophe in
front, see `lpn.core.csv_cells`.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args

import msgspec

from lpn.core.csv_cells import csv_bytes, unescape
from lpn.core.errors import DataError, OutputError
from lpn.core.files import first_few, json_bytes, printable, write_together
from lpn.core.formats import decode_json, format_of
from lpn.core.lists import read_rows
from lpn.flight.files.base import Flight, Frame, HeadingSource
from lpn.flight.files.cameras import FOV_RANGE
from lpn.flight.files.lenses import Lens, lens_of_text

FORMAT = "lpn-flight/1"
TABLE, HEADER, FRAMES = "flight.csv", "flight.json", "frames"
_COLUMNS = tuple(field.name for field in fields(Frame))
_FIRST_LINE = ",".join(_COLUMNS).encode() + b"\n"
_NUMBERS = tuple(name for name in _COLUMNS if name not in ("name", "file", "width", "height", "heading_source", "lens"))
_LIMITS: Mapping[str, tuple[float, float]] = {
    "latitude": (-90, 90),
    "longitude": (-180, 180),
    "heading": (0, 360),
    "pitch": (-360, 360),
    "roll": (-180, 180),
    "fov": FOV_RANGE,
}


class _Header(msgspec.Struct, forbid_unknown_fields=True):
    format: str
    name: str
    utc: bool
    notes: list[str]


def is_flight(folder: Path) -> bool:
    """Return whether a folder holds a written flight."""
    return (folder / HEADER).is_file()


def check_folder(folder: Path) -> None:
    """Raise OutputError if the flight would replace a file that `lpn flight` did not write."""
    try:
        header = format_of(file.read_bytes()) if (file := folder / HEADER).exists() else FORMAT
        begin = _FIRST_LINE
        if (file := folder / TABLE).exists():
            with file.open("rb") as table:
                begin = table.readline(len(_FIRST_LINE))
    except OSError as error:
        raise OutputError(f"{printable(str(file))} cannot be read ({error.strerror or error}); check it.") from error
    ours = {
        HEADER: isinstance(header, str) and header.startswith(FORMAT.partition("/")[0] + "/"),
        TABLE: begin == _FIRST_LINE,
    }
    for name, is_ours in ours.items():
        if not is_ours:
            raise OutputError(
                f"{printable(str(folder / name))} was not written by lpn flight and would be replaced; choose another folder for "
                "the flight."
            )


def write_flight(flight: Flight, folder: Path) -> None:
    """Write a flight's table and header; the pictures stay where they are.

    Raises:
        OutputError: if a file cannot be written, or would replace one that `lpn flight` did not write.
    """
    check_folder(folder)
    rows: list[list[object]] = [list(_COLUMNS)]
    for frame in flight.frames:
        values = {name: getattr(frame, name) for name in _COLUMNS} | {
            "file": _relative(frame.file, folder),
            "lens": None if frame.lens is None else frame.lens.text(),
        }
        rows.append(list(values.values()))
    header = msgspec.to_builtins(_Header(FORMAT, flight.name, flight.utc, list(flight.notes)))
    write_together({folder / TABLE: csv_bytes(rows, own=True), folder / HEADER: json_bytes(header, ensure_ascii=False)})


def read_flight(folder: Path) -> Flight:
    """Read a written flight.

    Raises:
        DataError: if a file is missing or damaged; the message names the line.
    """
    path = folder / HEADER
    try:
        header = decode_json(path.read_bytes(), _Header, str(path), FORMAT, DataError)
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror or error}); give a folder of lpn flight.") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is not what lpn flight writes; write the flight again.") from error
    rows = read_rows(folder / TABLE, str(folder / TABLE), "surrogateescape")
    if tuple(next(rows, (0, []))[1]) != _COLUMNS:
        raise DataError(f"The first line of {folder / TABLE} is not {','.join(_COLUMNS)}; write the flight again.")
    frames = tuple(_frame(values, folder, f"Line {line} of {folder / TABLE}") for line, values in rows)
    if twice := [name for name, times in Counter(frame.name for frame in frames).items() if times > 1]:
        raise DataError(f"{folder / TABLE} names {first_few(twice, 3)} twice; names are unique.")
    return Flight(header.name, frames, tuple(header.notes), header.utc)


def _relative(file: Path, folder: Path) -> str:
    """Return a file's path relative to a folder with forward slashes, or its full path if it is on another drive."""
    try:
        return Path(os.path.relpath(file.resolve(), folder.resolve())).as_posix()
    except ValueError:
        return file.resolve().as_posix()


def _frame(values: list[str], folder: Path, line: str) -> Frame:
    if len(values) != len(_COLUMNS):
        raise DataError(f"{line} has {len(values)} values; expected {len(_COLUMNS)}.")
    texts = dict(zip(_COLUMNS, map(unescape, values), strict=True))
    numbers: dict[str, Any] = {name: _number(texts[name], name, line) for name in _NUMBERS}
    source = texts["heading_source"] or None
    if (source is not None and source not in get_args(HeadingSource)) or (source is None) != (
        numbers["heading"] is None
    ):
        raise DataError(
            f"{line} has the heading_source {printable(texts['heading_source'])!r}; expected one of "
            f"{', '.join(get_args(HeadingSource))}, and none without a heading."
        )
    if (numbers["latitude"] is None) != (numbers["longitude"] is None):
        raise DataError(f"{line} has one of latitude and longitude; expected both or none.")
    if not texts["name"] or not texts["file"] or "\x00" in texts["file"]:
        raise DataError(f"{line} has no name or no file; expected both.")
    width, height = (_pixels(texts[name], name, line) for name in ("width", "height"))
    file = Path(os.path.normpath(folder / texts["file"]))
    lens = _lens(texts["lens"], line)
    return Frame(texts["name"], file, width, height, heading_source=source, lens=lens, **numbers)  # type: ignore[arg-type]


def _lens(text: str, line: str) -> Lens | None:
    try:
        return lens_of_text(text) if text.strip() else None
    except ValueError as error:
        raise DataError(
            f"{line} has the lens {printable(text)[:80]!r} ({printable(str(error))[:80]}); expected nine numbers of a lens."
        ) from error


def _number(text: str, name: str, line: str) -> float | None:
    if not text.strip():
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    low, high = _LIMITS.get(name, (-1e12, 1e12))
    if not low <= value <= high:
        raise DataError(f"{line} has the {name} {printable(text)[:80]!r}; expected a number from {low:g} to {high:g}.")
    return value


def _pixels(text: str, name: str, line: str) -> int:
    if not (text.isascii() and text.isdecimal() and 0 < len(text) < 7 and int(text)):
        raise DataError(f"{line} has the {name} {printable(text)[:80]!r}; expected a number of pixels.")
    return int(text)
