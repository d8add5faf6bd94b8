"""Descriptors saved by the published test code, `pytorch_result.mat`: evaluated and explored without a network.

gallery_f, query_f            (G, F) and (Q, F): part embeddings (512, n), each part of norm 1/sqrt(n), flattened in row-major
                              order
gallery_label, query_label    (1, G) and (1, Q) integers; -1 for a gallery picture that is taken out of the ranking
gallery_path, query_path      (G,) and (Q,) texts, padded with spaces; may be absent
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from lpn.core.arrays import AnyArray, Float32Array, Int64Array
from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.core.views import VIEWS, View, views_of
from lpn.datasets import Dataset, Picture, Truth, matlab
from lpn.datasets.listed_paths import plain_path
from lpn.retrieval.sides import TaskPictures

log = logging.getLogger(__name__)

_NORM_TOLERANCE = 0.01


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
            if not (np.abs(norms - 1) <= _NORM_TOLERANCE).all():
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
            query_view, gallery_view = views_of(task)
            queries = _pictures_of_rows(self.query_paths, self.query_labels, dataset.queries(query_view))
            if queries is not None:
                gallery = _pictures_of_rows(self.gallery_paths, self.gallery_labels, dataset.gallery(gallery_view))
                if gallery is not None:
                    return (query_view, gallery_view), queries, gallery
        by_path = self.query_paths is not None and self.gallery_paths is not None
        how = "by the last two parts of their paths" if by_path else "in the order of their labels"
        example = f", such as {printable(self.query_paths[0])}" if self.query_paths else ""
        raise DataError(
            f"No task of {printable(dataset.root.name)} ({', '.join(tasks)}) has all pictures of {self.name} "
            f"{how}{example}; give the data set that the result was computed on."
        )


def published_pictures(saved: PublishedResult, dataset: Dataset) -> tuple[TaskPictures, tuple[Int64Array, Int64Array]]:
    """Return the pictures of a result's rows with their truth, and the labels of queries and gallery, (Q,) and (G,).

    Raises:
        DataError: when no task of the test split has all pictures.
        InputError: when truth is listed, and a gallery picture has two rows.
    """
    views, queries, gallery = saved.pictures(dataset)
    name = "-to-".join(views)
    pictures = TaskPictures(name, queries, gallery, truth_of_rows(dataset, name, queries, gallery))
    if pictures.truth is None:
        return pictures, (saved.query_labels, saved.gallery_labels)
    return (
        pictures,
        pictures.labels,
    )  # the labels of such a result name one true tile of several, or are numbered otherwise


def truth_of_rows(
    dataset: Dataset, task: str, queries: Sequence[Picture], gallery: Sequence[Picture]
) -> list[Truth] | None:
    """Return the listed truth of a task for its pictures in another order, or some of them; None if labels tell the truth.

    Args:
        queries, gallery: pictures of the task, of which a result has one row each.

    Raises:
        InputError: when a gallery picture has two rows.
    """
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
    good, junk, semi = row_of[lists.good], row_of[lists.junk], row_of[lists.semi]
    overlaps = lists.overlaps
    if overlaps is not None:
        parts = (good, overlaps[: len(good)]), (semi, overlaps[len(good) :])
        overlaps = np.concatenate([values[rows >= 0][np.argsort(rows[rows >= 0])] for rows, values in parts])
    good, junk, semi = (np.sort(rows[rows >= 0]) for rows in (good, junk, semi))
    among = None if lists.among is None else row_of[lists.among]
    among = None if among is None else np.sort(among[among >= 0])
    return Truth(good, junk, lists.known, lists.trapezoid, semi, overlaps, among)


_REQUIRED_KEYS = ("gallery_f", "gallery_label", "query_f", "query_label")


def check_n_parts(n_parts: int | None) -> int:
    """Return the number of parts of a saved result, 1 by default.

    Raises:
        InputError: when it is below 1.
    """
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
    values = _read(path, name)
    missing = [key for key in _REQUIRED_KEYS if key not in values]
    if missing:
        held = ", ".join(values) or "none of them"
        raise DataError(
            f"{name} has no {', '.join(missing)}; it holds {held}, and the published test code writes gallery_f, gallery_label, "
            "query_f, and query_label."
        )
    query, gallery = (_descriptors(values[f"{side}_f"], side, name, n_parts) for side in ("query", "gallery"))
    if query.shape[2] != gallery.shape[2]:
        raise DataError(
            f"{name} has query descriptors of {query[0].size} numbers and gallery descriptors of {gallery[0].size}; expected "
            "equal numbers, so save both with the same model."
        )
    saved = PublishedResult(
        name,
        query,
        _labels(values["query_label"], len(query), "query", name),
        gallery,
        _labels(values["gallery_label"], len(gallery), "gallery", name),
        _paths(values.get("query_path"), len(query), "query", name),
        _paths(values.get("gallery_path"), len(gallery), "gallery", name),
    )
    if n_parts > 1:
        saved.check_norms()
    _tell_other_folders(saved)
    return saved


def _tell_other_folders(saved: PublishedResult) -> None:
    """Warn where folders of places hold pictures of several labels: the order of the paths is not that of the rows.

    The folders of a side are those of places if none holds more pictures than one label has, whatever their order.
    """
    labels_of: dict[str, Counter[int]] = {}
    for paths, labels in ((saved.query_paths, saved.query_labels), (saved.gallery_paths, saved.gallery_labels)):
        rows = [
            (path.split("/")[-2], label)
            for path, label in zip(paths or (), labels.tolist(), strict=paths is not None)
            if "/" in path and label != -1
        ]
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


def _read(path: Path, name: str) -> dict[str, Any]:
    if path.is_dir():
        raise DataError(
            f"{path} is a folder; give the file that the published test code wrote, such as pytorch_result.mat."
        )
    if not path.is_file():
        raise DataError(f"There is no saved result at {path}; check the path.")
    if _first_bytes(path) == b"MATLAB 7.3":
        raise DataError(
            f"{name} is a MATLAB 7.3 file, which is not supported; save it with scipy.io.savemat, as the published code does."
        )
    expected = "pytorch_result.mat of the published test code"
    return matlab.load(path, (), expected, (*_REQUIRED_KEYS, "query_path", "gallery_path"), simplify=False)


def _first_bytes(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(10)


def _descriptors(values: Any, side: str, name: str, n_parts: int) -> Float32Array:
    array: AnyArray = np.asarray(values)
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
    parts = array.astype(np.float32, copy=False).reshape(count, length // n_parts, n_parts).transpose(0, 2, 1)
    return cast(Float32Array, np.ascontiguousarray(parts))


def _labels(values: Any, count: int, side: str, name: str) -> Int64Array:
    array: AnyArray = np.asarray(values).ravel()
    # MATLAB saves integers as doubles.
    whole = np.issubdtype(array.dtype, np.number) and bool((array == np.round(array)).all())
    if not whole or len(array) != count:
        raise DataError(
            f"{side}_label in {name} has {len(array)} entries of type {array.dtype}; expected one whole number for each of "
            f"{count} descriptors."
        )
    return array.astype(np.int64)


def _paths(values: Any, count: int, side: str, name: str) -> tuple[str, ...] | None:
    if values is None:
        return None
    array: AnyArray = np.asarray(values).ravel()
    if len(array) != count:
        raise DataError(
            f"{side}_path in {name} has {len(array)} entries; expected one for each of {count} descriptors."
        )
    # In a cell array, each text is an array of its own.
    texts = [str(np.ravel(value)[0]) if isinstance(value, np.ndarray) and value.size else str(value) for value in array]
    return tuple(plain_path(text) for text in texts)


def _pictures_of_rows(
    paths: tuple[str, ...] | None, labels: Int64Array, pictures: list[Picture]
) -> list[Picture] | None:
    """Return the picture of each row, or None if a picture is missing."""
    if paths is None:
        # Code of Sample4Geo's family labels distractors with -1.
        same = len(pictures) == len(labels) and all(
            label in (-1, picture.label) for picture, label in zip(pictures, labels, strict=True)
        )
        return pictures if same else None
    named = {"/".join(picture.path.parts[-2:]): picture for picture in pictures}
    of_rows = [named.get("/".join(path.split("/")[-2:])) for path in paths]
    return None if None in of_rows else cast("list[Picture]", of_rows)


def _view(paths: tuple[str, ...] | None, role: str) -> View | None:
    """Read the view from the folder above the place's folder, as in .../query_drone/0001/image-01.jpeg."""
    folders = {"".join(path.split("/")[-3:-2]) for path in paths or ()}
    return next((view for view in VIEWS if folders == {f"{role}_{view}"}), None)
