"""Descriptors of any model as plain arrays, with a list of their pictures: evaluated and explored without a network.

An array is (N, D), (N, n, D), or (N, D, n), floats of any precision, in one of these files:

    .npy        the array
    .npz        one array; or `query` and `gallery`, so that one file may hold both sides
    .mat        MATLAB 5: query_f, query, gallery_f, gallery, descriptors, or features (extra `train`)

The list (`paths.csv`) has a line for each row of both arrays, those of one side in the order of their rows:

    file,side,label,latitude,longitude
    query/0001.jpg,query,1,30.3201,120.3807
    tiles/0001.png,gallery,1,30.3203,120.3806

`file` is a path below the list's folder; a picture that is not there is drawn as a placeholder. `side` is query or gallery.
`label` is any text, equal for pictures of one place; "7" and "007" are two places. It is empty where it is unknown: such a query
is not counted, and such a gallery picture is true for none. It is -1 for a gallery picture that is dropped from the ranking.
Latitude and longitude, in degrees, may be empty. Only file and side are needed.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from lpn.core.arrays import DAMAGED_ARRAY, AnyArray, BoolArray, Float32Array, UInt8Array
from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.core.views import View
from lpn.datasets import Picture, Truth, matlab
from lpn.datasets.lists import read_rows
from lpn.datasets.geo import Position
from lpn.datasets.listed_paths import FilesBelow, listed_path
from lpn.models.contract import Role
from lpn.retrieval.published_results import PublishedResult
from lpn.retrieval.ranks import JUNK

log = logging.getLogger(__name__)

# The axis of the parts: (N, n, D) or (N, D, n).
Order = Literal["parts-first", "parts-last"]
_COLUMNS = ("file", "side", "label", "latitude", "longitude")
_KEYS = {
    "query": ("query_f", "query", "descriptors", "features"),
    "gallery": ("gallery_f", "gallery", "descriptors", "features"),
}
# Norms of parts that differ by less than this share from 1/sqrt(n) are not worth a warning.
_TOLERANCE = 0.01
_PLACEHOLDER = 256
# Rows of so many numbers are scaled at a time.
_BLOCK = 1 << 18


@dataclass(frozen=True, eq=False)
class PlainArrays:
    """Descriptors of both sides with what the list tells about their pictures.

    Attributes:
        result: descriptors (parts of norm 1/sqrt(n)), labels, and paths.
        root: the folder that paths are relative to.
        queries, gallery: the pictures.
        query_positions, positions: where they were taken; None for those that the list leaves out.
        labelled: the queries whose label tells what is right, (Q,); none where no label of theirs is one of the gallery.
        identity: digest of the descriptors.
    """

    result: PublishedResult
    root: Path
    queries: list[Picture]
    gallery: list[Picture]
    query_positions: list[Position | None]
    positions: list[Position | None]
    labelled: BoolArray
    identity: str

    @property
    def views(self) -> tuple[View, View]:
        """The views of both sides, by folders such as query_drone; drone and satellite where these do not tell."""
        return self.result.views or ("drone", "satellite")

    @property
    def all_positions(self) -> tuple[list[Position], list[Position]] | None:
        """The positions of queries and gallery; None if one is not known."""
        sides = places_of(self.query_positions), places_of(self.positions)
        return None if sides[0] is None or sides[1] is None else (sides[0], sides[1])

    def truth(self) -> list[Truth] | None:
        """The true matches of each query where some queries have no label; None if labels tell everything."""
        if self.labelled.all():
            return None
        junk = np.flatnonzero(self.result.gallery_labels == JUNK)
        return [
            Truth(np.flatnonzero(self.result.gallery_labels == label) if known else junk[:0], junk, bool(known))
            for label, known in zip(self.result.query_labels, self.labelled, strict=True)
        ]


@dataclass(frozen=True)
class _Line:
    file: str
    label: str
    position: Position | None


def load_arrays(
    query: str | Path,
    gallery: str | Path,
    paths: str | Path | None = None,
    n_parts: int | None = None,
    order: Order = "parts-first",
    root: str | Path | None = None,
) -> PlainArrays:
    """Read the descriptors of queries and gallery, and the list of their pictures.

    Args:
        query, gallery: files of arrays, see the module; they may be the same `.npz` or `.mat`.
        paths: the list; without it, rows are numbered, their places are unknown, and pictures are placeholders.
        n_parts: number of parts. Two-dimensional arrays are cut into so many, 1 by default; others must have so many.
        order: "parts-first" for (N, n, D), and for rows that are n parts one after the other; "parts-last" for (N, D, n).
        root: the folder that the list's paths are relative to; by default the list's.

    Raises:
        DataError: if a file is missing, damaged, or does not fit the others.
        InputError: if an array does not consist of that many parts.
    """
    sides: dict[Role, Path] = {"query": Path(query), "gallery": Path(gallery)}
    arrays = {side: _descriptors(_read(file, side), file, n_parts, order) for side, file in sides.items()}
    if arrays["query"].shape[1:] != arrays["gallery"].shape[1:]:
        raise DataError(
            f"{_name(sides['query'])} has rows of {_shape(arrays['query'])}, and {_name(sides['gallery'])} of "
            f"{_shape(arrays['gallery'])} (parts and numbers of a part); expected the same, from one model."
        )
    folder = Path(root) if root is not None else sides["query"].parent if paths is None else Path(paths).parent
    if not folder.is_dir():
        raise DataError(f"There is no folder of pictures at {printable(str(folder))}; check the path.")
    lines = _numbered(arrays) if paths is None else _here(folder, _listed(Path(paths), arrays))
    names = [line.label for side in lines.values() for line in side]
    numbers = _label_numbers(names)
    labels = {side: np.array([numbers[line.label] for line in of], np.int64) for side, of in lines.items()}
    pictures = {
        side: [
            _picture(folder, line, name, int(label))
            for line, name, label in zip(of, _own_names(of), labels[side], strict=True)
        ]
        for side, of in lines.items()
    }
    known = _known(lines)
    listed = {side: tuple(line.file for line in of) for side, of in lines.items()}
    result = PublishedResult(
        _name(sides["query"]),
        arrays["query"],
        labels["query"],
        arrays["gallery"],
        labels["gallery"],
        listed["query"],
        listed["gallery"],
    )
    digest = hashlib.sha256(arrays["query"].data)
    digest.update(b"|")
    digest.update(arrays["gallery"].data)
    positions = {side: [line.position for line in of] for side, of in lines.items()}
    return PlainArrays(
        result,
        folder,
        pictures["query"],
        pictures["gallery"],
        positions["query"],
        positions["gallery"],
        known,
        digest.hexdigest(),
    )


def _known(lines: dict[Role, list[_Line]]) -> BoolArray:
    """Return the queries whose label tells what is right, (Q,): none where no label is in the gallery, as 0001 beside 1."""
    known = np.array([bool(line.label) for line in lines["query"]], bool)
    own = [line.label for line in lines["query"] if line.label]
    told = [line.label for line in lines["gallery"] if line.label not in ("", str(JUNK))]
    if not own or not set(own).isdisjoint(told):
        return known
    if not told:
        log.warning(
            "No picture of the gallery has a label, so those of the queries tell nothing; the truth counts as unknown."
        )
        return np.zeros_like(known)
    found = (
        f"None of the queries has a label of the gallery: the first of their labels are {printable(own[0])[:80]!r} and "
        f"{printable(told[0])[:80]!r}. Labels are compared as texts, so write both sides alike"
    )
    if any(line.position is None for of in lines.values() for line in of):
        raise DataError(f"{found}, or give the positions of all pictures, from which errors in metres follow.")
    log.warning("%s; the truth of all queries counts as unknown, and errors in metres come from the positions.", found)
    return np.zeros_like(known)


def _name(file: Path) -> str:
    return printable(file.name)


def _shape(array: AnyArray) -> str:
    return " x ".join(map(str, array.shape[1:]))


def _read(file: Path, side: Role) -> AnyArray:
    """Return the array of a side as it is in its file."""
    if file.is_dir():
        raise DataError(f"{printable(str(file))} is a folder; give the file of {side} descriptors.")
    if not file.is_file():
        raise DataError(f"There is no file of {side} descriptors at {printable(str(file))}; check the path.")
    readers = {".npy": _read_npy, ".npz": _read_npz, ".mat": _read_mat}
    reader = readers.get(file.suffix.lower())
    if reader is None:
        raise DataError(f"{_name(file)} is no array file; expected one that ends in {', '.join(readers)}.")
    return reader(file, side)


def _read_npy(file: Path, side: Role) -> AnyArray:
    del side
    try:
        array = np.load(file, mmap_mode="r", allow_pickle=False)
        if not isinstance(array, np.ndarray):
            raise ValueError("an archive")
    except DAMAGED_ARRAY as error:
        raise _unreadable(file, "array", error) from error
    return array


def _unreadable(file: Path, what: str, error: Exception) -> DataError:
    if any(words in str(error) for words in ("Object arrays", "Python objects")):
        return DataError(
            f"{_name(file)} holds Python objects, which may run code and are not read; save the numbers alone, as "
            "np.stack(list(x)).astype('float32') makes them."
        )
    return DataError(f"{_name(file)} is no {what} that NumPy saved, or damaged; save it again.")


def _read_npz(file: Path, side: Role) -> AnyArray:
    try:
        with np.load(file, allow_pickle=False) as archive:
            names = list(archive.files)
            chosen = names[0] if len(names) == 1 else next((key for key in _KEYS[side] if key in names), None)
            if chosen is None:
                raise DataError(
                    f"{_name(file)} holds {', '.join(map(printable, names)) or 'nothing'}; expected one array, or {side}."
                )
            return np.asarray(archive[chosen])
    except DataError:
        raise
    except DAMAGED_ARRAY as error:
        raise _unreadable(file, "archive", error) from error


def _read_mat(file: Path, side: Role) -> AnyArray:
    keys = _KEYS[side]
    variables = matlab.load(file, (), f"a MATLAB 5 file with {' or '.join(keys)}", keys, simplify=False)
    chosen = next((key for key in keys if key in variables), None)
    if chosen is None:
        raise DataError(
            f"{_name(file)} has none of the variables {', '.join(keys)}; save the descriptors as one of them."
        )
    return np.asarray(variables[chosen])


def _descriptors(array: AnyArray, file: Path, n_parts: int | None, order: Order) -> Float32Array:
    """Return descriptors (N, n, D) with parts of norm 1/sqrt(n)."""
    name = _name(file)
    if array.ndim not in (2, 3) or not array.size or not np.issubdtype(array.dtype, np.floating):
        raise DataError(
            f"The descriptors in {name} are {array.dtype} of shape {array.shape}; expected floats, (N, D), (N, n, D), or "
            "(N, D, n)."
        )
    if array.ndim == 2:
        count, length = array.shape
        n = n_parts or 1
        if length % n:
            raise InputError(
                f"The rows of {name} have {length} numbers, which are not {n} equal parts; check --n-parts."
            )
        array = array.reshape((count, n, length // n) if order == "parts-first" else (count, length // n, n))
    parts = array if order == "parts-first" else array.transpose(0, 2, 1)
    if n_parts is not None and parts.shape[1] != n_parts:
        raise InputError(
            f"{name} has {parts.shape[1]} parts of {parts.shape[2]} numbers with --order {order}; expected {n_parts} parts, so "
            "check --n-parts and --order."
        )
    return _scaled(parts, name)


def _scaled(parts: AnyArray, name: str) -> Float32Array:
    """Return (N, n, D) with parts of norm 1/sqrt(n); beside the result, it takes the memory of a block of rows."""
    scaled = np.empty(parts.shape, np.float32)
    norms = np.empty(parts.shape[:2])
    step = max(1, _BLOCK // (parts.shape[1] * parts.shape[2]))
    for start in range(0, len(parts), step):
        rows = slice(start, start + step)
        with np.errstate(all="ignore"):
            block = parts[rows].astype(np.float32).astype(np.float64)
            norms[rows] = np.linalg.norm(block, axis=2) * np.sqrt(parts.shape[1])
            scaled[rows] = block / norms[rows, :, None]
    bad = np.flatnonzero(~(np.isfinite(norms) & (norms > 0)).all(axis=1))
    if len(bad):
        raise DataError(
            f"{len(bad)} rows of {name}, the first being row {bad[0] + 1}, have values that are not finite or a part that is "
            "zero; describe these pictures again."
        )
    if not (np.abs(norms - 1) <= _TOLERANCE).all():
        log.warning("The parts in %s do not have norm 1/sqrt(%d); they are scaled to it.", name, parts.shape[1])
    return scaled


def _numbered(arrays: Mapping[Role, Float32Array]) -> dict[Role, list[_Line]]:
    return {
        side: [_Line(f"{side}/{row:0{len(str(len(array)))}d}", "", None) for row in range(1, len(array) + 1)]
        for side, array in arrays.items()
    }


def _listed(file: Path, arrays: Mapping[Role, Float32Array]) -> dict[Role, list[_Line]]:
    """Read the list of pictures."""
    name = _name(file)
    rows = read_rows(file, name)
    _, first = next(rows, (0, []))
    header = [column.strip().lower() for column in first]
    unknown = set(header) - set(_COLUMNS)
    if not {"file", "side"} <= set(header) or unknown or len(set(header)) < len(header):
        raise DataError(
            f"The first line of {name} is {printable(','.join(header)) or 'empty'}; expected file,side and, if known, "
            "label,latitude,longitude."
        )
    lines_of: dict[Role, list[_Line]] = {"query": [], "gallery": []}
    for number, values in rows:
        where = f"Line {number} of {name}"
        if len(values) != len(header):
            raise DataError(f"{where} has {len(values)} values; expected {len(header)}: {','.join(header)}.")
        row = {column: value.strip() for column, value in zip(header, values, strict=True)}
        if row["side"] not in lines_of:
            raise DataError(f"{where} has the side {printable(row['side'])!r}; expected query or gallery.")
        line = _Line(listed_path(row["file"], where), row.get("label", ""), _position(row, where))
        lines_of[row["side"]].append(line)
    for side, lines in lines_of.items():
        if len(lines) != len(arrays[side]):
            raise DataError(
                f"{name} has {len(lines)} lines of the side {side}, and the array {len(arrays[side])} rows; expected as many."
            )
    return lines_of


def _here(folder: Path, lines: dict[Role, list[_Line]]) -> dict[Role, list[_Line]]:
    """Return lines with the files that their paths name below the folder; other paths stay."""
    there = FilesBelow(folder).resolve(line.file for of in lines.values() for line in of)
    return {side: [replace(line, file=there.get(line.file, line.file)) for line in of] for side, of in lines.items()}


def _position(row: Mapping[str, str], where: str) -> Position | None:
    texts = [row.get(name, "") for name in ("latitude", "longitude")]
    if not any(texts):
        return None
    try:
        latitude, longitude = (float(text) for text in texts)
    except ValueError:
        latitude = longitude = float("nan")
    if not (abs(latitude) <= 90 and abs(longitude) <= 180) or latitude == longitude == 0:
        empty = ", both empty where they are unknown" if latitude == longitude == 0 else ""
        raise DataError(
            f"{where} has the position {printable(', '.join(texts))!r}; expected latitude and longitude in degrees{empty}."
        )
    return Position(latitude, longitude)


def _label_numbers(labels: Sequence[str]) -> dict[str, int]:
    """Return a number for each label: its own value if all are distinct whole numbers. Junk has -1, and "" has a free number."""
    distinct = list(dict.fromkeys(label for label in labels if label and label != str(JUNK)))
    whole = all(label.removeprefix("-").isdecimal() and len(label) < 18 for label in distinct)
    values = [int(label) for label in distinct] if whole else []
    if len(set(values)) < len(distinct) or JUNK in values:
        values = list(range(len(distinct)))
    numbers = dict(zip(distinct, values, strict=True))
    return numbers | {str(JUNK): JUNK, "": max([0, *numbers.values()]) + 1}


def _own_names(lines: Sequence[_Line]) -> list[str]:
    """Return the pictures' paths without suffixes, and without the folders that all of them share."""
    paths = [Path(line.file).with_suffix("") for line in lines]
    shared = len(Path(os.path.commonpath([path.parent for path in paths])).parts) if paths else 0
    return [printable(Path(*path.parts[shared:]).as_posix()) for path in paths]


def _picture(root: Path, line: _Line, name: str, label: int) -> Picture:
    path = root / line.file
    if path.is_file():
        return Picture(path, label, name)
    return Picture(path, label, name, note="no picture", cut=_placeholder)


def _placeholder() -> UInt8Array:
    """Draw a grey square with a cross."""
    drawn = np.full((_PLACEHOLDER, _PLACEHOLDER, 3), 96, np.uint8)
    for start, end in (((0, 0), (_PLACEHOLDER, _PLACEHOLDER)), ((0, _PLACEHOLDER), (_PLACEHOLDER, 0))):
        cv2.line(drawn, start, end, (120, 120, 120), 2, cv2.LINE_AA)
    return drawn


def places_of(positions: Sequence[Position | None]) -> list[Position] | None:
    """Return positions if all are known, else None."""
    known = [place for place in positions if place is not None]
    return known if known and len(known) == len(positions) else None
