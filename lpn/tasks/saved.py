"""Descriptors saved by other programs, as tasks: ranking, laboratory, and map without a network.

A result of the published test code describes its rows. Plain arrays have a list (`paths.csv`) with a line for each row of
both arrays, in the order of each side's rows:

    file,side,label,latitude,longitude
    query/0001.jpg,query,1,30.3201,120.3807
    tiles/0001.png,gallery,1,30.3203,120.3806

`file` is a path below the list's folder; a missing picture is a grey placeholder. `side` is query or gallery. `label` is any
text, equal for pictures of one place; "7" and "007" are two places. It is empty if unknown: such a query is not counted, and
such a gallery picture is never a true match. It is -1 for a gallery picture that is dropped from the ranking. Latitude and
longitude, in degrees, may be empty. Only file and side are needed.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lpn.core.arrays import BoolArray, Int64Array, UInt8Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.lists import read_text, table
from lpn.core.views import View
from lpn.datasets import Dataset, Picture, Truth, labels_of
from lpn.datasets.geo import Position
from lpn.datasets.listed_paths import FilesBelow, listed_path
from lpn.models.contract import Contract, Role
from lpn.models.spec import Layout, ModelSpec
from lpn.retrieval.ranks import JUNK
from lpn.retrieval.saved import Order, PublishedResult, load_parts, truth_of_rows, views_of_paths
from lpn.tasks.gallery_geometry import GalleryGeometry
from lpn.tasks.task import Task

log = logging.getLogger(__name__)

# Size of the feature map for drawing rings without a network: a ResNet-50's at 256 pixels.
SAVED_MAP = (16, 16)
_LAYOUT: Layout = "university"
_CLAUSES = ("descriptors as saved",)
_COLUMNS = {"file", "side", "label", "latitude", "longitude"}


def saved_task(saved: PublishedResult, dataset: Dataset | None = None) -> Task:
    """Return the task of a published result, whatever its norms; without a data set, labels define the truth.

    Rings are drawn as in University-1652's LPN, and for panoramas as in the published CVUSA models.

    Raises:
        DataError: when the data set lacks the result's pictures, or without one, no query has a label of the gallery.
    """
    queries, gallery = list[Picture](), list[Picture]()
    labels, truth, layout = (saved.query_labels, saved.gallery_labels), None, _LAYOUT
    views: Sequence[View] = saved.views or ("drone", "satellite")
    if dataset is None:
        saved.check_labels()
    else:
        views, queries, gallery = saved.pictures(dataset)
        layout = "cvusa" if dataset.panoramas else layout
        truth = truth_of_rows(dataset, "-to-".join(views), queries, gallery)
        if truth is not None:  # the result's labels have only one of several true tiles, or other numbers
            labels = labels_of(queries), labels_of(gallery)
    spec = ModelSpec(views=tuple(dict.fromkeys(views)), n_parts=saved.n_parts, layout=layout, shared=False)
    contract, root = spec.contract(), Path(saved.name) if dataset is None else dataset.root
    return Task(
        name=saved.task if dataset is None else "-to-".join(views),
        model=None,
        model_name=saved.name,
        data_name=printable(root.resolve().name),
        root=root,
        contract=contract,
        map_sizes=dict.fromkeys(contract.views, SAVED_MAP),
        queries=queries,
        gallery=gallery,
        query_labels=labels[0],
        gallery_labels=labels[1],
        query_descriptors=saved.query,
        gallery_descriptors=saved.gallery,
        truth=truth,
        columns=() if dataset is None else dataset.columns(queries),
        geometry=None if dataset is None else GalleryGeometry.of_dataset(dataset, queries, gallery),
        clauses=_CLAUSES,
    )


def array_task(
    query: str | Path,
    gallery: str | Path,
    paths: str | Path | None = None,
    n_parts: int | None = None,
    order: Order = "parts-first",
    root: str | Path | None = None,
) -> Task:
    """Read plain arrays of queries and gallery, and the list of their pictures.

    The task has a map if every gallery picture has a position.

    Args:
        query, gallery: files of arrays, see `lpn.retrieval.saved`; they may be the same `.npz` or `.mat`.
        paths: the list; without it, rows are numbered, their places are unknown, and pictures are placeholders.
        n_parts, order: see `load_parts`.
        root: the folder to which the list's paths are relative; by default the folder of the list.

    Raises:
        DataError: if a file is missing, damaged, or does not fit the others.
        InputError: if an array does not consist of that many parts.
    """
    files: dict[Role, Path] = {"query": Path(query), "gallery": Path(gallery)}
    sides = {side: load_parts(file, side, n_parts, order) for side, file in files.items()}
    if sides["query"].shape[1:] != sides["gallery"].shape[1:]:
        rows = [" x ".join(map(str, array.shape[1:])) for array in sides.values()]
        raise DataError(
            f"{printable(files['query'].name)} has rows of {rows[0]}, and {printable(files['gallery'].name)} of {rows[1]} (parts "
            "and numbers of a part); expected the same, from one model."
        )
    folder = Path(root) if root is not None else files["query"].parent if paths is None else Path(paths).parent
    if not folder.is_dir():
        raise DataError(f"There is no folder of pictures at {printable(str(folder))}; check the path.")
    counts = {side: len(array) for side, array in sides.items()}
    lines = _numbered(counts) if paths is None else _listed(Path(paths), counts, FilesBelow(folder))
    numbers = _label_numbers([line.label for of in lines.values() for line in of])
    labels = {side: np.array([numbers[line.label] for line in of], np.int64) for side, of in lines.items()}
    views = views_of_paths(*([line.file for line in of] for of in lines.values())) or ("drone", "satellite")
    n, size = sides["query"].shape[1:]
    contract = Contract(
        method="plain arrays",
        title=f"plain arrays, n = {n}",
        views=tuple(dict.fromkeys(views)),
        input_size=(256, 256),
        n_parts=n,
        embedding=size,
        level="one vector" if n == 1 else "parts only",
        mirror="none",
    )
    tiles = [line.position for line in lines["gallery"] if line.position is not None]
    placed = len(tiles) == counts["gallery"]
    return Task(
        name="-to-".join(views),
        model=None,
        model_name=printable(files["query"].name),
        data_name=folder.resolve().name,
        root=folder,
        contract=contract,
        map_sizes=dict.fromkeys(contract.views, (1, 1)),
        queries=_pictures(folder, lines["query"], labels["query"]),
        gallery=_pictures(folder, lines["gallery"], labels["gallery"]),
        query_labels=labels["query"],
        gallery_labels=labels["gallery"],
        query_descriptors=sides["query"],
        gallery_descriptors=sides["gallery"],
        truth=_truth(labels, _known(lines)),
        geometry=GalleryGeometry.of([line.position for line in lines["query"]], tiles) if placed else None,
        clauses=_CLAUSES,
    )


class _Line(NamedTuple):
    file: str
    label: str = ""
    position: Position | None = None


def _numbered(counts: Mapping[Role, int]) -> dict[Role, list[_Line]]:
    return {
        side: [_Line(f"{side}/{row:0{len(str(count))}d}") for row in range(1, count + 1)]
        for side, count in counts.items()
    }


def _listed(file: Path, counts: Mapping[Role, int], below: FilesBelow) -> dict[Role, list[_Line]]:
    """Read the list of pictures; a path that differs from its file in case alone becomes the path of the file."""
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
                f"{name} has {len(of)} lines of the side {side}, and the array {counts[side]} rows; expected equal numbers."
            )
    positions = [line.position for of in lines.values() for line in of]
    if 0 < (unknown := positions.count(None)) < len(positions):
        text = "%d of %d pictures in %s have no position, so there are no errors in metres."
        log.warning(text, unknown, len(positions), name)
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
    """Return the mask of queries with a known truth, (Q,); all False if queries and gallery share no label."""
    known = np.array([bool(line.label) for line in lines["query"]], bool)
    own = [line.label for line in lines["query"] if line.label]
    told = [line.label for line in lines["gallery"] if line.label not in ("", str(JUNK))]
    if not own or not set(own).isdisjoint(told):
        return known
    if not told:
        log.warning(
            "No picture of the gallery has a label, so the labels of the queries are of no use; the truth counts as unknown."
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


def _truth(labels: Mapping[Role, Int64Array], known: BoolArray) -> list[Truth] | None:
    """Return the true matches of each query if some queries have no label; None if labels define the truth."""
    if known.all():
        return None
    junk = np.flatnonzero(labels["gallery"] == JUNK)
    return [
        Truth(np.flatnonzero(labels["gallery"] == label) if one else junk[:0], junk, bool(one))
        for label, one in zip(labels["query"], known, strict=True)
    ]


def _label_numbers(labels: Sequence[str]) -> dict[str, int]:
    """Return a number for each label: its value if all are distinct whole numbers. Junk has -1, and "" has a free number."""
    distinct = list(dict.fromkeys(label for label in labels if label and label != str(JUNK)))
    whole = all(label.removeprefix("-").isdecimal() and len(label) < 18 for label in distinct)
    values = [int(label) for label in distinct] if whole else []
    if len(set(values)) < len(distinct) or JUNK in values:
        values = list(range(len(distinct)))
    numbers = dict(zip(distinct, values, strict=True))
    return numbers | {str(JUNK): JUNK, "": max([0, *numbers.values()]) + 1}


def _pictures(root: Path, lines: Sequence[_Line], labels: Int64Array) -> list[Picture]:
    """Return the pictures of a side, named without their common folders."""
    paths = [Path(line.file).with_suffix("") for line in lines]
    shared = len(Path(os.path.commonpath([path.parent for path in paths])).parts) if paths else 0
    names = [printable(Path(*path.parts[shared:]).as_posix()) for path in paths]
    return [
        Picture(root / line.file, label, name)
        if (root / line.file).is_file()
        else Picture(root / line.file, label, name, note="no picture", cut=_placeholder)
        for line, label, name in zip(lines, labels.tolist(), names, strict=True)
    ]


def _placeholder() -> UInt8Array:
    return np.full((256, 256, 3), 96, np.uint8)
