"""A flight's folder: `flight.csv` with one row a frame, `flight.json`, and the frames of videos in `frames`.

    name,file,width,height,time,latitude,longitude,height_above_ground,height_above_takeoff,altitude,heading,heading_source,...

`file` is relative to the folder where possible. Unknown values are empty. Text that a spreadsheet would compute is quoted by an
apostrophe, see `lpn.core.csv_cells`.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import msgspec

from lpn.core.csv_cells import csv_bytes, unescape
from lpn.core.errors import DataError, OutputError
from lpn.core.files import first_few, json_bytes, printable, write_together
from lpn.core.formats import decode_json, format_of
from lpn.core.lists import read_rows
from lpn.flight.files.base import Flight, Frame
from lpn.flight.files.lenses import lens_of_text

FORMAT = "lpn-flight/1"
TABLE, HEADER, FRAMES = "flight.csv", "flight.json", "frames"
_COLUMNS = tuple(field.name for field in fields(Frame))
_FIRST_LINE = ",".join(_COLUMNS).encode() + b"\n"


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
    for file in (folder / HEADER, folder / TABLE):
        try:
            data = file.read_bytes() if file.exists() else _FIRST_LINE
        except OSError:
            data = b""
        if not data.startswith(_FIRST_LINE) and not str(format_of(data)).startswith("lpn-flight/"):
            raise OutputError(
                f"{printable(str(file))} was not written by lpn flight and would be replaced; choose another folder for the "
                "flight."
            )


def write_flight(flight: Flight, folder: Path) -> None:
    """Write a flight's table and header; the pictures stay where they are.

    Raises:
        OutputError: if a file cannot be written, or would replace one that `lpn flight` did not write.
    """
    check_folder(folder)
    rows: list[list[object]] = [list(_COLUMNS)]
    for frame in flight.frames:
        lens = None if frame.lens is None else frame.lens.text()
        told = {"file": _relative(frame.file, folder), "lens": lens}
        # msgspec leaves unknown values of a frame to the class, so `vars` would lack them.
        rows.append([told.get(name, getattr(frame, name)) for name in _COLUMNS])
    header = {"format": FORMAT, "name": flight.name, "utc": flight.utc, "notes": flight.notes}
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
    """Return a path relative to a folder, with forward slashes; the full path on another drive."""
    try:
        return Path(os.path.relpath(file.resolve(), folder.resolve())).as_posix()
    except ValueError:
        return file.resolve().as_posix()


def _frame(values: list[str], folder: Path, line: str) -> Frame:
    if len(values) != len(_COLUMNS):
        raise DataError(f"{line} should have {len(_COLUMNS)} values, and has {len(values)}.")
    told: dict[str, Any] = {name: text for name, cell in zip(_COLUMNS, values, strict=True) if (text := unescape(cell))}
    try:
        told |= {"lens": asdict(lens_of_text(told["lens"]))} if "lens" in told else {}
        told |= {"file": os.path.normpath(folder / told["file"])} if "file" in told else {}
        frame = msgspec.convert(told, Frame, strict=False, dec_hook=lambda kind, text: kind(text))
        if "\x00" in told["file"]:
            raise ValueError("Expected a path without NULs")
        if (frame.latitude is None) != (frame.longitude is None):
            raise ValueError("Expected both or none of latitude and longitude")
        if (frame.heading is None) != (frame.heading_source is None):
            raise ValueError("Expected both or none of heading and heading_source")
    except ValueError as error:
        found = printable(str(error))[:120].replace(" - at `$.", " in `")
        raise DataError(f"{line} is not what lpn flight writes ({found}); write the flight again.") from error
    return frame
