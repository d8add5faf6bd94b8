"""Descriptors saved by other programs.

Plain arrays of any model are (N, D), (N, n, D), or (N, D, n), floats of any precision, in one of these files:

    .npy        the array
    .npz        one array; or `query` and `gallery`, so that one file may hold both sides
    .mat        MATLAB 5: query_f, query, gallery_f, gallery, descriptors, or features (extra `train`)

`pytorch_result.mat` of the published test code also describes its rows:

    gallery_f, query_f            (G, F) and (Q, F): part embeddings (512, n), each part of norm 1/sqrt(n), flattened row by row
    gallery_label, query_label    (1, G) and (1, Q) integers; -1 for a gallery picture that is dropped from the ranking
    gallery_path, query_path      (G,) and (Q,) texts, padded with spaces; may be absent
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from lpn.core.arrays import DAMAGED_ARRAY, AnyArray, Float32Array, Int64Array
from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.core.views import VIEWS, View, views_of
from lpn.datasets import Dataset, Picture, Truth, matlab
from lpn.datasets.listed_paths import plain_path
from lpn.models.contract import Role
from lpn.retrieval.ranks import JUNK

log = logging.getLogger(__name__)

# The axis of the parts: (N, n, D) or (N, D, n).
Order = Literal["parts-first", "parts-last"]
_KEYS = {side: (f"{side}_f", side, "descriptors", "features") for side in ("query", "gallery")}
_PUBLISHED = ("gallery_f", "gallery_label", "query_f", "query_label")
# A part's norm may differ from 1/sqrt(n) by this share without a warning.
_TOLERANCE = 0.01
# Numbers in a block of rows that is scaled at a time.
_BLOCK = 1 << 18


@dataclass(frozen=True, eq=False)
class PublishedResult:
    """The descriptors of a retrieval by another program.

    Attributes:
        name: the file's name.
        query, gallery: descriptors, (Q, n, D) and (G, n, D).
        query_labels, gallery_labels: the place of each, (Q,) and (G,).
        query_paths, gallery_paths: the picture of each, named by the other program; None if the file has no paths.
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
        """The views of queries and gallery, from their folders (query_drone, gallery_satellite); None if unknown."""
        return views_of_paths(self.query_paths or (), self.gallery_paths or ())

    @property
    def task(self) -> str:
        """The task, such as "drone-to-satellite", or "saved" if the paths do not contain it."""
        return "saved" if self.views is None else "-to-".join(self.views)

    def check_norms(self) -> None:
        """Raise InputError unless every part has norm 1/sqrt(n), as the contributions of parts require."""
        for side, descriptors in (("query", self.query), ("gallery", self.gallery)):
            norms = np.linalg.norm(descriptors, axis=2) * np.sqrt(self.n_parts)
            if not (np.abs(norms - 1) <= _TOLERANCE).all():
                raise InputError(
                    f"The {side} descriptors in {self.name} do not consist of {self.n_parts} parts of norm "
                    f"1/sqrt({self.n_parts}); give their number of parts as --n-parts."
                )

    def check_labels(self) -> None:
        """Raise DataError if no query has a true match by labels, because no rank could be computed."""
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


def truth_of_rows(
    dataset: Dataset, task: str, queries: Sequence[Picture], gallery: Sequence[Picture]
) -> list[Truth] | None:
    """Return a task's listed truth for some of its pictures, in any order; None if labels define the truth."""
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
    return in_rows([of_query[picture.path] for picture in queries], row_of)


def in_rows(truth: Sequence[Truth], row_of: Int64Array) -> list[Truth]:
    """Convert gallery positions in each truth to rows of the result; `row_of` has the row of each position, -1 for none."""

    def there(tiles: Int64Array) -> Int64Array:
        rows = row_of[tiles]
        return np.sort(rows[rows >= 0])

    # The queries of a region share an array.
    regions = {id(lists.among): there(lists.among) for lists in truth if lists.among is not None}
    moved = []
    for lists in truth:
        good, junk, semi, overlaps = there(lists.good), there(lists.junk), there(lists.semi), None
        if lists.overlaps is not None:
            of_row = dict(zip(row_of[[*lists.good, *lists.semi]].tolist(), lists.overlaps.tolist(), strict=True))
            overlaps = np.array([of_row[row] for row in (*good.tolist(), *semi.tolist())], np.float64)
        among = regions.get(id(lists.among))
        moved.append(Truth(good, junk, lists.known, lists.trapezoid, semi, overlaps, among))
    return moved


def check_n_parts(n_parts: int | None) -> int:
    """Return the number of parts of a saved result, 1 by default; InputError when it is below 1."""
    if n_parts is not None and n_parts < 1:
        raise InputError(f"The number of parts is {n_parts}; expected 1 or more.")
    return n_parts or 1


def load_saved(path: str | Path, n_parts: int = 1) -> PublishedResult:
    """Read a `pytorch_result.mat`; needs the extra `train`.

    Args:
        n_parts: number of parts of a descriptor; 1 keeps the descriptor whole. Metrics do not depend on this number, except for
            averaged queries, because each part of an average is normalised.

    Raises:
        DataError: when the file is missing, is not a MATLAB file, or lacks entries.
        InputError: when its descriptors do not consist of that many parts.
    """
    path = Path(path)
    name = printable(path.name)
    _check_file(path, "saved result", "that the published test code wrote, such as pytorch_result.mat")
    expected = "pytorch_result.mat of the published test code"
    values = matlab.load(path, (*_PUBLISHED, "query_path", "gallery_path"), expected)
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
    parts, count = _parts(array, name, n_parts, "parts-last"), len(array)
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
    return np.ascontiguousarray(parts, np.float32), labels.astype(np.int64), None if paths is None else tuple(paths)


def _pictures_of_rows(
    paths: tuple[str, ...] | None, labels: Int64Array, pictures: list[Picture]
) -> list[Picture] | None:
    """Return the picture of each row, or None if a picture is missing."""
    if paths is None:
        # Sample4Geo and its successors label distractors with -1.
        same = len(pictures) == len(labels) and all(
            label in (JUNK, picture.label) for picture, label in zip(pictures, labels, strict=True)
        )
        return pictures if same else None
    named = {"/".join(picture.path.parts[-2:]): picture for picture in pictures}
    of_rows = [named.get("/".join(path.split("/")[-2:])) for path in paths]
    return None if None in of_rows else cast("list[Picture]", of_rows)


def views_of_paths(queries: Sequence[str], gallery: Sequence[str]) -> tuple[View, View] | None:
    """Return the views of both sides from the second folder above each file, as in .../query_drone/0001/image-01.jpeg."""
    views: list[View | None] = []
    for role, paths in (("query", queries), ("gallery", gallery)):
        folders = {"".join(path.split("/")[-3:-2]) for path in paths}
        views.append(next((view for view in VIEWS if folders == {f"{role}_{view}"}), None))
    return None if None in views else cast("tuple[View, View]", tuple(views))


def load_parts(file: Path, side: Role, n_parts: int | None = None, order: Order = "parts-first") -> Float32Array:
    """Read the plain array of a side, (N, n, D), with parts of norm 1/sqrt(n).

    Args:
        n_parts: number of parts. A two-dimensional array is cut into this many, 1 by default; another array must have this many.
        order: "parts-first" for (N, n, D), and for rows that are n consecutive parts; "parts-last" for (N, D, n).

    Raises:
        DataError: if the file is missing or damaged, or holds other numbers.
        InputError: if the array does not consist of that many parts.
    """
    name = printable(file.name)
    return _scaled(_parts(_read(file, side), name, n_parts, order), name)


def _check_file(file: Path, what: str, expected: str) -> None:
    if file.is_dir():
        raise DataError(f"{printable(str(file))} is a folder; give the file {expected}.")
    if not file.is_file():
        raise DataError(f"There is no {what} at {printable(str(file))}; check the path.")


def _read(file: Path, side: str) -> AnyArray:
    """Return the unchanged array of a side."""
    name, kind, keys = printable(file.name), file.suffix.lower(), _KEYS[side]
    _check_file(file, f"file of {side} descriptors", f"of {side} descriptors")
    if kind not in (".npy", ".npz", ".mat"):
        raise DataError(f"{name} is no array file; expected one that ends in .npy, .npz, .mat.")
    if kind == ".mat":
        variables = matlab.load(file, keys, f"a MATLAB 5 file with {' or '.join(keys)}")
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


def _parts(array: AnyArray, name: str, n_parts: int | None, order: Order) -> AnyArray:
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
    """Return (N, n, D) with parts of norm 1/sqrt(n); beside the result, it needs the memory of a block of rows."""
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
