"""Descriptors that other programs saved: evaluated and explored without a network.

Plain arrays of any model are (N, D), (N, n, D), or (N, D, n), floats of any precision, in one of these files:

    .npy        the array
    .npz        one array; or `query` and `gallery`, so that one file may hold both sides
    .mat        MATLAB 5: query_f, query, gallery_f, gallery, descriptors, or features (extra `train`)

Their list (`paths.csv`) has a line for each row of both arrays, those of one side in the order of their rows:

    file,side,label,latitude,longitude
    query/0001.jpg,query,1,30.3201,120.3807
    tiles/0001.png,gallery,1,30.3203,120.3806

`file` is a path below the list's folder; a picture that is not there is drawn as a placeholder. `side` is query or gallery.
`label` is any text, equal for pictures of one place; "7" and "007" are two places. It is empty where it is unknown: such a query
is not counted, and such a gallery picture is true for none. It is -1 for a gallery picture that is dropped from the ranking.
Latitude and longitude, in degrees, may be empty. Only file and side are needed.

`pytorch_result.mat` of the published test code holds its own list:

    gallery_f, query_f            (G, F) and (Q, F): part embeddings (512, n), each part of norm 1/sqrt(n), flattened row by row
    gallery_label, query_label    (1, G) and (1, Q) integers; -1 for a gallery picture that is dropped from the ranking
    gallery_path, query_path      (G,) and (Q,) texts, padded with spaces; may be absent
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import numpy as np

from lpn.core.arrays import DAMAGED_ARRAY, AnyArray, BoolArray, Float32Array, Int64Array, UInt8Array
from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.core.views import VIEWS, View, views_of
from lpn.datasets import Dataset, Picture, Truth, matlab
from lpn.datasets.geo import Position
from lpn.datasets.listed_paths import FilesBelow, listed_path, plain_path
from lpn.datasets.lists import read_text, table
from lpn.models.contract import Role
from lpn.retrieval.ranks import JUNK
from lpn.retrieval.sides import TaskPictures

log = logging.getLogger(__name__)

# The axis of the parts: (N, n, D) or (N, D, n).
Order = Literal["parts-first", "parts-last"]
_COLUMNS = {"file", "side", "label", "latitude", "longitude"}
_KEYS = {side: (f"{side}_f", side, "descriptors", "features") for side in ("query", "gallery")}
_PUBLISHED = ("gallery_f", "gallery_label", "query_f", "query_label")
# Norms of parts that differ by less than this share from 1/sqrt(n) are not worth a warning.
_TOLERANCE = 0.01
# Rows of so many numbers are scaled at a time.
_BLOCK = 1 << 18


@dataclass(frozen=True, eq=False)
class PublishedResult:
    """The descriptors of a retrieval that another program computed.

    Attributes:
        name: the file's name.
        query, gallery: descriptors, (Q, n, D) and (G, n, D).
        query_labels, gallery_labels: the place of each, (Q,) and (G,).
        query_paths, gallery_paths: the picture of each, as the other program named it; None where the file has no paths.
    """

    name: str
    query: Float32Array
    query_labels: Int64Array
    gallery: Float32Array
    gallery_labels: Int64Array
    query_paths: tuple[str, ...] | None
    gallery_paths: tuple[str, ...] | None

    @property
    def n_parts(self) -> int:
        """Number of parts n."""
        return int(self.query.shape[1])

    @property
    def views(self) -> tuple[View, View] | None:
        """The views of queries and gallery, read from their folders (query_drone, gallery_satellite); None when unknown."""
        views = _view(self.query_paths, "query"), _view(self.gallery_paths, "gallery")
        return None if None in views else cast("tuple[View, View]", views)

    @property
    def task(self) -> str:
        """The task, such as "drone-to-satellite", or "saved" when the paths do not tell."""
        return "saved" if self.views is None else "-to-".join(self.views)

    def check_norms(self) -> None:
        """Raise InputError unless every part has norm 1/sqrt(n), as the contributions of parts require."""
        for side, descriptors in (("query", self.query), ("gallery", self.gallery)):
            norms = np.linalg.norm(descriptors, axis=2) * np.sqrt(self.n_parts)
            if not (np.abs(norms - 1) <= _TOLERANCE).all():
                raise InputError(
                    f"The {side} descriptors in {self.name} do not consist of {self.n_parts} parts of norm "
                    f"1/sqrt({self.n_parts}); give the number of parts they were made with as --n-parts."
                )

    def check_labels(self) -> None:
        """Raise DataError where no query has a label of the gallery, so that no rank could be measured by labels."""
        if not np.isin(self.query_labels, self.gallery_labels).any():
            raise DataError(
                f"None of the query labels of {self.name}, such as {self.query_labels[0]}, is a gallery label, such as "
                f"{self.gallery_labels[0]}; number the places of both sides alike."
            )

    def pictures(self, dataset: Dataset) -> tuple[tuple[View, View], list[Picture], list[Picture]]:
        """Find the pictures of the rows, and their views, in a data set's test split.

        Pictures are matched by the last two parts of their paths (place and file). Without paths, they are matched by the order
        of the rows if the labels agree.

        Raises:
            DataError: when no task of the test split has all pictures.
        """
        if not (tasks := dataset.tasks()):
            raise dataset.no_task()
        for task in sorted(tasks, key=lambda task: task != self.task):
            views = views_of(task)
            queries = _pictures_of_rows(self.query_paths, self.query_labels, dataset.queries(views[0]))
            gallery = _pictures_of_rows(self.gallery_paths, self.gallery_labels, dataset.gallery(views[1]))
            if queries is not None and gallery is not None:
                return views, queries, gallery
        by_path = self.query_paths is not None and self.gallery_paths is not None
        how = "by the last two parts of their paths" if by_path else "in the order of their labels"
        example = f", such as {printable(self.query_paths[0])}" if self.query_paths else ""
        raise DataError(
            f"No task of {printable(dataset.root.name)} ({', '.join(tasks)}) has all pictures of {self.name} "
            f"{how}{example}; give the data set that the result was computed on."
        )


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


class _Line(NamedTuple):
    file: str
    label: str = ""
    position: Position | None = None


def published_pictures(saved: PublishedResult, dataset: Dataset) -> tuple[TaskPictures, tuple[Int64Array, Int64Array]]:
    """Return the pictures of a result's rows with their truth, and the labels of queries and gallery, (Q,) and (G,).

    Raises:
        DataError: when no task of the test split has all pictures.
        InputError: when truth is listed, and a gallery picture has two rows.
    """
    views, queries, gallery = saved.pictures(dataset)
    name = "-to-".join(views)
    pictures = TaskPictures(name, queries, gallery, _truth_of_rows(dataset, name, queries, gallery))
    # Where truth is listed, the result's labels name one true tile of several, or are numbered otherwise.
    return pictures, (saved.query_labels, saved.gallery_labels) if pictures.truth is None else pictures.labels


def _truth_of_rows(
    dataset: Dataset, task: str, queries: Sequence[Picture], gallery: Sequence[Picture]
) -> list[Truth] | None:
    """Return the listed truth of a task for its pictures in another order, or some of them; None if labels tell the truth."""
    truth = dataset.truth(task)
    if truth is None:
        return None
    views = views_of(task)
    of_query = {picture.path: lists for picture, lists in zip(dataset.queries(views[0]), truth, strict=True)}
    rows: dict[Path, int] = {}
    for row, picture in enumerate(gallery):
        if rows.setdefault(picture.path, row) != row:
            raise InputError(
                f"The result holds {printable(picture.name)} twice in its gallery; expected one descriptor of each picture."
            )
    row_of = np.array([rows.get(picture.path, -1) for picture in dataset.gallery(views[1])], np.int64)
    return [_in_rows(of_query[picture.path], row_of) for picture in queries]


def _in_rows(lists: Truth, row_of: Int64Array) -> Truth:
    """Return lists of rows; `row_of` has the row of each gallery position, -1 for those without one."""

    def there(tiles: Int64Array) -> Int64Array:
        rows = row_of[tiles]
        return np.sort(rows[rows >= 0])

    good, junk, semi, overlaps = there(lists.good), there(lists.junk), there(lists.semi), None
    if lists.overlaps is not None:
        of_row = dict(zip(row_of[[*lists.good, *lists.semi]].tolist(), lists.overlaps.tolist(), strict=True))
        overlaps = np.array([of_row[row] for row in (*good.tolist(), *semi.tolist())], np.float64)
    among = None if lists.among is None else there(lists.among)
    return Truth(good, junk, lists.known, lists.trapezoid, semi, overlaps, among)


def check_n_parts(n_parts: int | None) -> int:
    """Return the number of parts of a saved result, 1 by default; InputError when it is below 1."""
    if n_parts is not None and n_parts < 1:
        raise InputError(f"The number of parts is {n_parts}; expected 1 or more.")
    return n_parts or 1


def load_saved(path: str | Path, n_parts: int = 1) -> PublishedResult:
    """Read a `pytorch_result.mat`; needs the extra `train`.

    Args:
        n_parts: number of parts of a descriptor. With 1, descriptors are not divided; metrics over all parts are then the same,
            except for averaged queries, since each part of an average is normalised.

    Raises:
        DataError: when the file is missing, is not a MATLAB file, or lacks entries.
        InputError: when its descriptors do not consist of that many parts.
    """
    path = Path(path)
    name = printable(path.name)
    _check_file(path, "saved result", "that the published test code wrote, such as pytorch_result.mat")
    expected = "pytorch_result.mat of the published test code"
    values = matlab.load(path, (), expected, (*_PUBLISHED, "query_path", "gallery_path"), simplify=False)
    if missing := [key for key in _PUBLISHED if key not in values]:
        raise DataError(
            f"{name} has no {', '.join(missing)}; it holds {', '.join(values) or 'none of them'}, and the published test code "
            "writes gallery_f, gallery_label, query_f, and query_label."
        )
    query, gallery = (_published_side(values, side, name, n_parts) for side in ("query", "gallery"))
    if query[0].shape[2] != gallery[0].shape[2]:
        raise DataError(
            f"{name} has query descriptors of {query[0][0].size} numbers and gallery descriptors of {gallery[0][0].size}; "
            "expected equal numbers, so save both with the same model."
        )
    saved = PublishedResult(name, *query[:2], *gallery[:2], query[2], gallery[2])
    if n_parts > 1:
        saved.check_norms()
    _warn_about_order(saved)
    return saved


def _published_side(
    values: Mapping[str, Any], side: str, name: str, n_parts: int
) -> tuple[Float32Array, Int64Array, tuple[str, ...] | None]:
    """Return the descriptors (N, n, D), labels (N,), and paths of a side."""
    array, labels = np.asarray(values[f"{side}_f"]), np.asarray(values[f"{side}_label"]).ravel()
    if array.ndim != 2 or not array.size or not np.issubdtype(array.dtype, np.floating):
        raise DataError(
            f"{side}_f in {name} is {array.dtype} of shape {array.shape}; expected floats, one row for each picture."
        )
    count, length = array.shape
    if n_parts < 1 or length % n_parts:
        raise InputError(
            f"The descriptors in {name} have {length} numbers, which cannot be divided into {n_parts} equal parts; see --n-parts."
        )
    if not np.isfinite(array).all():
        raise DataError(f"{side}_f in {name} holds values that are not finite; save the result again.")
    # MATLAB saves integers as doubles.
    whole = np.issubdtype(labels.dtype, np.number) and bool((labels == np.round(labels)).all())
    if not whole or len(labels) != count:
        raise DataError(
            f"{side}_label in {name} has {len(labels)} entries of type {labels.dtype}; expected one whole number for each of "
            f"{count} descriptors."
        )
    paths: list[str] | None = None
    if f"{side}_path" in values:
        # In a cell array, each text is an array of its own.
        cells = [np.ravel(cell) for cell in np.ravel(values[f"{side}_path"])]
        paths = [plain_path(str(cell[0])) if cell.size else "" for cell in cells]
        if len(paths) != count:
            raise DataError(
                f"{side}_path in {name} has {len(paths)} entries; expected one for each of {count} descriptors."
            )
    parts = array.astype(np.float32, copy=False).reshape(count, length // n_parts, n_parts).transpose(0, 2, 1)
    return np.ascontiguousarray(parts), labels.astype(np.int64), None if paths is None else tuple(paths)


def _warn_about_order(saved: PublishedResult) -> None:
    """Warn where folders of places hold pictures of several labels: the order of the paths is not that of the rows.

    The folders of a side are those of places if none holds more pictures than one label has, whatever their order.
    """
    labels_of: dict[str, Counter[int]] = {}
    for paths, labels in ((saved.query_paths, saved.query_labels), (saved.gallery_paths, saved.gallery_labels)):
        pairs = zip(paths or (), labels.tolist(), strict=paths is not None)
        rows = [(path.split("/")[-2], label) for path, label in pairs if "/" in path and label != JUNK]
        largest = [max(Counter(values).values()) for values in zip(*rows, strict=True)]
        if rows and largest[0] <= largest[1]:
            for folder, label in rows:
                labels_of.setdefault(folder, Counter())[label] += 1
    others = {folder: counts.total() - max(counts.values()) for folder, counts in labels_of.items()}
    if mixed := [folder for folder, other in others.items() if other]:
        log.warning(
            "%d paths in %s lie in a folder of another label, such as %s: if the paths are in another order than the "
            "descriptors, wrong pictures are shown.",
            sum(others.values()), saved.name, printable(mixed[0]),
        )  # fmt: skip


def _pictures_of_rows(
    paths: tuple[str, ...] | None, labels: Int64Array, pictures: list[Picture]
) -> list[Picture] | None:
    """Return the picture of each row, or None if a picture is missing."""
    if paths is None:
        # Code of Sample4Geo's family labels distractors with -1.
        same = len(pictures) == len(labels) and all(
            label in (JUNK, picture.label) for picture, label in zip(pictures, labels, strict=True)
        )
        return pictures if same else None
    named = {"/".join(picture.path.parts[-2:]): picture for picture in pictures}
    of_rows = [named.get("/".join(path.split("/")[-2:])) for path in paths]
    return None if None in of_rows else cast("list[Picture]", of_rows)


def _view(paths: tuple[str, ...] | None, role: str) -> View | None:
    """Read the view from the folder above the place's folder, as in .../query_drone/0001/image-01.jpeg."""
    folders = {"".join(path.split("/")[-3:-2]) for path in paths or ()}
    return next((view for view in VIEWS if folders == {f"{role}_{view}"}), None)


def load_arrays(
    query: str | Path,
    gallery: str | Path,
    paths: str | Path | None = None,
    n_parts: int | None = None,
    order: Order = "parts-first",
    root: str | Path | None = None,
) -> PlainArrays:
    """Read plain arrays of queries and gallery, and the list of their pictures.

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
    query, gallery = Path(query), Path(gallery)
    q, g = (
        _scaled(_parts(_read(file, side), file, n_parts, order), printable(file.name))
        for side, file in (("query", query), ("gallery", gallery))
    )
    if q.shape[1:] != g.shape[1:]:
        shapes = [" x ".join(map(str, array.shape[1:])) for array in (q, g)]
        raise DataError(
            f"{printable(query.name)} has rows of {shapes[0]}, and {printable(gallery.name)} of {shapes[1]} (parts and numbers "
            "of a part); expected the same, from one model."
        )
    folder = Path(root) if root is not None else query.parent if paths is None else Path(paths).parent
    if not folder.is_dir():
        raise DataError(f"There is no folder of pictures at {printable(str(folder))}; check the path.")
    counts: dict[Role, int] = {"query": len(q), "gallery": len(g)}
    lines = _numbered(counts) if paths is None else _listed(Path(paths), counts, FilesBelow(folder))
    numbers = _label_numbers([line.label for of in lines.values() for line in of])
    labels = {side: np.array([numbers[line.label] for line in of], np.int64) for side, of in lines.items()}
    files = {side: tuple(line.file for line in of) for side, of in lines.items()}
    positions = {side: [line.position for line in of] for side, of in lines.items()}
    digest = hashlib.sha256(q.data)
    digest.update(b"|")
    digest.update(g.data)
    return PlainArrays(
        PublishedResult(
            *(printable(query.name), q, labels["query"], g, labels["gallery"]), files["query"], files["gallery"]
        ),
        folder,
        _pictures(folder, files["query"], labels["query"]),
        _pictures(folder, files["gallery"], labels["gallery"]),
        positions["query"],
        positions["gallery"],
        _known(lines),
        digest.hexdigest(),
    )


def places_of(positions: Sequence[Position | None]) -> list[Position] | None:
    """Return positions if all are known, else None."""
    known = [place for place in positions if place is not None]
    return known if known and len(known) == len(positions) else None


def _check_file(file: Path, what: str, expected: str) -> None:
    if file.is_dir():
        raise DataError(f"{printable(str(file))} is a folder; give the file {expected}.")
    if not file.is_file():
        raise DataError(f"There is no {what} at {printable(str(file))}; check the path.")


def _read(file: Path, side: str) -> AnyArray:
    """Return the array of a side as it is in its file."""
    name, kind, keys = printable(file.name), file.suffix.lower(), _KEYS[side]
    _check_file(file, f"file of {side} descriptors", f"of {side} descriptors")
    if kind not in (".npy", ".npz", ".mat"):
        raise DataError(f"{name} is no array file; expected one that ends in .npy, .npz, .mat.")
    if kind == ".mat":
        variables = matlab.load(file, (), f"a MATLAB 5 file with {' or '.join(keys)}", keys, simplify=False)
        if not variables:
            raise DataError(f"{name} has none of the variables {', '.join(keys)}; save the descriptors as one of them.")
        return np.asarray(next(variables[key] for key in keys if key in variables))
    try:
        loaded = np.load(file, mmap_mode="r", allow_pickle=False)
        if isinstance(loaded, np.ndarray) != (kind == ".npy"):
            raise ValueError("the other kind of file")
        if isinstance(loaded, np.ndarray):
            return loaded
        with loaded:
            names = list(loaded.files)
            if chosen := names if len(names) == 1 else [key for key in keys if key in names]:
                return np.asarray(loaded[chosen[0]])
    except DAMAGED_ARRAY as error:
        if any(words in str(error) for words in ("Object arrays", "Python objects")):
            raise DataError(
                f"{name} holds Python objects, which may run code and are not read; save the numbers alone, as "
                "np.stack(list(x)).astype('float32') makes them."
            ) from error
        what = "array" if kind == ".npy" else "archive"
        raise DataError(f"{name} is no {what} that NumPy saved, or damaged; save it again.") from error
    raise DataError(f"{name} holds {', '.join(map(printable, names)) or 'nothing'}; expected one array, or {side}.")


def _parts(array: AnyArray, file: Path, n_parts: int | None, order: Order) -> AnyArray:
    """Return descriptors (N, n, D)."""
    name = printable(file.name)
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
    return parts


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


def _numbered(counts: Mapping[Role, int]) -> dict[Role, list[_Line]]:
    return {
        side: [_Line(f"{side}/{row:0{len(str(count))}d}") for row in range(1, count + 1)]
        for side, count in counts.items()
    }


def _listed(file: Path, counts: Mapping[Role, int], below: FilesBelow) -> dict[Role, list[_Line]]:
    """Read the list of pictures, with the files that its paths name; other paths stay."""
    name = printable(file.name)

    def fits(header: list[str]) -> bool:
        return len({*header}) == len(header) and {"file", "side"} <= {*header} <= _COLUMNS

    rows = table(read_text(file, name), name, fits, "file,side and, if known, label,latitude,longitude")[1]
    lines: dict[Role, list[_Line]] = {"query": [], "gallery": []}
    for where, row in rows:
        if row["side"] not in lines:
            raise DataError(f"{where} has the side {printable(row['side'])!r}; expected query or gallery.")
        path = listed_path(row["file"], where)
        lines[row["side"]].append(_Line(below.find(path) or path, row.get("label", ""), _position(row, where)))
    for side, of in lines.items():
        if len(of) != counts[side]:
            raise DataError(
                f"{name} has {len(of)} lines of the side {side}, and the array {counts[side]} rows; expected as many."
            )
    return lines


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


def _known(lines: Mapping[Role, Sequence[_Line]]) -> BoolArray:
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


def _label_numbers(labels: Sequence[str]) -> dict[str, int]:
    """Return a number for each label: its own value if all are distinct whole numbers. Junk has -1, and "" has a free number."""
    distinct = list(dict.fromkeys(label for label in labels if label and label != str(JUNK)))
    whole = all(label.removeprefix("-").isdecimal() and len(label) < 18 for label in distinct)
    values = [int(label) for label in distinct] if whole else []
    if len(set(values)) < len(distinct) or JUNK in values:
        values = list(range(len(distinct)))
    numbers = dict(zip(distinct, values, strict=True))
    return numbers | {str(JUNK): JUNK, "": max([0, *numbers.values()]) + 1}


def _pictures(root: Path, files: Sequence[str], labels: Int64Array) -> list[Picture]:
    """Return the pictures of a side, named without the folders that all of them share."""
    paths = [Path(file).with_suffix("") for file in files]
    shared = len(Path(os.path.commonpath([path.parent for path in paths])).parts) if paths else 0
    names = [printable(Path(*path.parts[shared:]).as_posix()) for path in paths]
    return [
        Picture(root / file, label, name)
        if (root / file).is_file()
        else Picture(root / file, label, name, note="no picture", cut=_placeholder)
        for file, label, name in zip(files, labels.tolist(), names, strict=True)
    ]


def _placeholder() -> UInt8Array:
    return np.full((256, 256, 3), 96, np.uint8)
