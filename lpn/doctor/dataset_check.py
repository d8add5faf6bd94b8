"""The data set check of `lpn doctor`: a folder's contents, and its defects."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from lpn.core.consoles import Console
from lpn.core.errors import DataError
from lpn.core.files import first_few, printable
from lpn.core.progress import report_progress
from lpn.core.text_tables import TextTable
from lpn.core.views import views_of
from lpn.datasets import Dataset, LeftOut, Picture, Size, geo
from lpn.datasets.integrity import check_positions, lists_of, picture_errors
from lpn.training.training_set import trainable


@dataclass(frozen=True)
class Count:
    """The size of one list of pictures, here and in the complete data set (None: unknown)."""

    name: str
    pictures: int
    places: int
    full_pictures: int | None
    full_places: int | None


@dataclass(frozen=True)
class MissingCounterparts:
    """Places that the list `name` lacks, or queries of the task `name` without a true match; `of` is the number of all."""

    name: str
    names: tuple[str, ...]
    of: int

    @property
    def what(self) -> str:
        """The words after the number of `names` in a message."""
        if "/" in self.name:
            return f"of {self.of} places have no picture in {self.name}"
        return f"of {self.of} queries of {self.name} have no true match"


@dataclass(frozen=True)
class DataSetReport:
    """The result of a data set check.

    Attributes:
        kind: the recognised layout.
        title: its name in messages.
        counts: the size of every list of pictures.
        looked_at: number of files read.
        decoded: whether the files were decoded completely.
        broken: pictures that cannot be read.
        left_out: files that the data set itself leaves out: missing, known to be broken, or not read (`Dataset.unread`).
        lacking: places and queries that cannot be used, because they have no counterpart.
        gaps: places that lack one of several counterparts, but are used; the published University-1652 has some.
        duplicates: groups of files of one list with equal content and different labels.
        shared: places in both train and test.
        positions: coverage and source of the positions; None without any.
        gap: the defect of the positions, or None.
    """

    root: str
    kind: str
    title: str
    counts: tuple[Count, ...]
    looked_at: int
    decoded: bool
    broken: tuple[LeftOut, ...]
    left_out: tuple[LeftOut, ...]
    lacking: tuple[MissingCounterparts, ...]
    gaps: tuple[MissingCounterparts, ...]
    duplicates: tuple[tuple[str, ...], ...]
    shared: tuple[int, ...]
    positions: str | None
    gap: str | None

    @property
    def healthy(self) -> bool:
        """True if nothing is broken; a subset, gaps, duplicates, and damage of the published data set do not count."""
        missing = [item for item in self.left_out if not item.published]
        return not (self.broken or missing or self.lacking or self.shared or self.gap)

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of the JSON file."""
        return {"healthy": self.healthy, **asdict(self)}


def check_dataset(dataset: Dataset, decode: bool = True) -> DataSetReport:
    """Check every picture of a data set, and whether its lists fit each other.

    Args:
        decode: decode every picture; else read only its header and end (see `lpn.datasets.integrity`).

    Raises:
        DataError: if a list cannot be read, or nothing can be trained or tested.
    """
    lists = dataset.lists()
    if not dataset.tasks() and not any(name.startswith("train/") for name in lists):
        raise dataset.no_task()
    files = list(dict.fromkeys(picture.path for pictures in lists.values() for picture in pictures))
    errors = picture_errors(files, decode, lambda done: report_progress("Reading pictures", done, len(files)))
    positions, gap = _positions(dataset)
    # If true matches are listed, labels are not places.
    labelled = all(dataset.truth(task) is None for task in dataset.tasks())
    missing = [*_training_places(lists), *_unanswered(dataset)]
    test = "test/query" if dataset.trained_distractors else "test/"
    return DataSetReport(
        root=printable(dataset.root.resolve().name),
        kind=dataset.kind,
        title=dataset.title or f"in {dataset.kind}'s layout",
        counts=tuple(
            Count(name, len(pictures), len(_places({name: pictures}, name)), full.pictures, full.places)
            for name, pictures in lists.items()
            for full in [dataset.published_sizes.get(name, Size(None))]
        ),
        looked_at=len(files),
        decoded=decode,
        broken=tuple(LeftOut(_below(dataset.root, file), why) for file, why in errors.items()),
        left_out=(*dataset.left_out, *dataset.unread()),
        lacking=tuple(item for is_gap, item in missing if not is_gap),
        gaps=tuple(item for is_gap, item in missing if is_gap),
        duplicates=tuple(_duplicates(dataset.root, lists, errors)),
        shared=tuple(sorted(_places(lists, "train/") & _places(lists, test))) if labelled else (),
        positions=positions,
        gap=gap,
    )


def _places(lists: dict[str, list[Picture]], start: str) -> set[int]:
    """Return the labels in the lists whose names begin with `start`."""
    return {picture.label for name, of in lists.items() if name.startswith(start) for picture in of}


def _training_places(lists: dict[str, list[Picture]]) -> Iterable[tuple[bool, MissingCounterparts]]:
    """Find the places that training leaves out (False), and places without some views, which are no damage (True)."""
    labels = {name.removeprefix("train/"): _places(lists, name) for name in lists if name.startswith("train/")}
    if "street" not in labels:
        labels.pop("google", None)
    if len(labels) < 2:
        return
    training_places = trainable(labels)
    total = len(training_places.places) + len(training_places.left_out)
    lost = {name: [label for label in training_places.left_out if label not in of] for name, of in labels.items()}
    yield from (
        (False, _places_without(f"train/{name}", of, total)) for name, of in lost.items() if of and name != "google"
    )
    yield from ((True, _places_without(f"train/{name}", of, total)) for name, of in training_places.gaps.items())


def _places_without(name: str, labels: Iterable[int], of: int) -> MissingCounterparts:
    return MissingCounterparts(name, tuple(f"{label:04d}" for label in labels), of)


def _unanswered(dataset: Dataset) -> Iterable[tuple[bool, MissingCounterparts]]:
    """Find queries without a true match, which count as missed.

    True marks street tasks, where this is no damage: not every place has a street picture.
    """
    for task in dataset.tasks():
        query_view, gallery_view = views_of(task)
        queries, truth = dataset.queries(query_view), dataset.truth(task)
        there = {picture.label for picture in dataset.gallery(gallery_view)}
        found = [q.label in there for q in queries] if truth is None else [len(t.good) or not t.known for t in truth]
        if names := tuple(query.name for query, true in zip(queries, found, strict=True) if not true):
            yield query_view != gallery_view == "street", MissingCounterparts(task, names, len(queries))


def _duplicates(root: Path, lists: dict[str, list[Picture]], broken: Collection[Path]) -> Iterable[tuple[str, ...]]:
    """Find equal files of different places; only files of equal size are read."""

    @cache
    def digest(path: Path) -> bytes:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").digest()

    for pictures in lists.values():
        there = [picture for picture in pictures if picture.path not in broken]
        for same_size in _alike(there, lambda picture: picture.path.stat().st_size):
            for equal in _alike(same_size, lambda picture: digest(picture.path)):
                yield tuple(_below(root, picture.path) for picture in equal)


def _alike(pictures: Sequence[Picture], key: Callable[[Picture], object]) -> list[list[Picture]]:
    """Return groups of pictures with equal keys and different places."""
    groups: dict[object, list[Picture]] = defaultdict(list)
    for picture in pictures:
        groups[key(picture)].append(picture)
    return [group for group in groups.values() if len({picture.label for picture in group}) > 1]


def _positions(dataset: Dataset) -> tuple[str | None, str | None]:
    """Return the coverage of the positions, and their defect."""
    try:
        pictures = {picture.path: picture for of in lists_of(dataset, dataset.tasks()).values() for picture in of}
        source = check_positions(dataset, list(pictures.values()))
    except DataError as error:
        return geo.NAME, str(error)
    return (f"Each of the {len(pictures)} test pictures has a position, by {source}.", None) if source else (None, None)


def _below(root: Path, file: Path) -> str:
    return printable(file.relative_to(root).as_posix())


def print_report(report: DataSetReport, console: Console) -> None:
    """Print a report with a few names of each kind; `to_dict` has all names."""
    counts = [(of.name, _of(of.pictures, of.full_pictures), _of(of.places, of.full_places)) for of in report.counts]
    how = "decoded" if report.decoded else "read at both ends"
    lines = [f"{report.looked_at - len(report.broken)} of {report.looked_at} pictures can be read ({how})."]
    lines += _some("cannot be read", [f"{item.file} {item.why}" for item in report.broken])
    lines += _some("are left out", [f"{item.file} {item.why}" for item in report.left_out if not item.published])
    known = [item.file for item in report.left_out if item.published]
    lines += _some("are left out, being broken in the published data set too", known)
    lines += [line for item in report.lacking for line in _some(item.what, item.names)]
    if report.gaps:
        lines.append("Gaps, which are no damage: a place is used in the views that it has.")
        lines += [f"  {line}" for item in report.gaps for line in _some(item.what, item.names, 12)]
    lines += _some("places are in train and in test", [f"{label:04d}" for label in report.shared])
    lines += _some("groups of files in one list are equal", [" = ".join(group) for group in report.duplicates])
    lines += [text for text in (report.gap or report.positions,) if text]
    lines.append("Nothing is broken." if report.healthy else "Something is broken: see above.")
    title, head = f"{report.root} is {report.title}.", ("pictures of", "pictures", "places")
    TextTable(head, counts, title, "\n".join(lines)).print(console)


def _of(count: int, full: int | None) -> str:
    return f"{count:,}" if full is None else f"{count:,} of {full:,}"


def _some(what: str, names: Sequence[str], most: int = 5) -> list[str]:
    return [f"{len(names)} {what}: {first_few(names, most)}."] if names else []
