"""What every data set offers: pictures by split and view, tasks, and what counts as a true match."""

from __future__ import annotations

import csv
import logging
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from lpn.core.arrays import Int64Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.images import SUFFIXES
from lpn.core.views import views_of

log = logging.getLogger(__name__)

TASKS = (
    "drone-to-satellite",
    "satellite-to-drone",
    "street-to-satellite",
    "satellite-to-street",
    "drone-to-street",
    "street-to-drone",
)
"""The tasks between two views, the usual ones first."""
_PLAIN = re.compile(r"\w[\w-]*(\.\w+)?(/\w[\w-]*(\.\w+)?)*")
INDEX_BYTES = 100_000_000
"""The largest list of pictures (.csv, .txt) that is read."""


@dataclass(frozen=True)
class Picture:
    """A picture file.

    Attributes:
        path: the file.
        label: the place it shows; two pictures of one label are a true match where `Dataset.truth` is None.
        name: how it is shown to people: the place's folder, and where a place has several, the file's ("0005/01" for
            0005/image-01.jpeg), or what the data set calls it.
        box: the part of it that is meant, (left, top, right, bottom) in pixels, where a data set marks one (the queries
            of Oxford5k and Paris6k); else None.
        panorama: whether it shows the full circle, north in the middle column.
    """

    path: Path
    label: int
    name: str
    box: tuple[float, float, float, float] | None = None
    panorama: bool = False


@dataclass(frozen=True, eq=False)
class Truth:
    """What counts for one query, as positions in the gallery, sorted, int64.

    Attributes:
        good: the true matches, (M,).
        junk: pictures that are taken out of the ranking before it is scored, (J,).
    """

    good: Int64Array
    junk: Int64Array


@dataclass(frozen=True)
class Size:
    """How large a list of pictures is in the complete data set; None where that is not published or sources differ."""

    pictures: int | None
    places: int | None = None


@dataclass(frozen=True)
class LeftOut:
    """A file that a data set names or holds and that its lists do not contain.

    Attributes:
        file: its path below the root.
        why: such as "is not there".
        published: whether it is so in the published data set, and therefore no damage of this copy.
    """

    file: str
    why: str
    published: bool = False


class Dataset(ABC):
    """A data set's folder.

    Attributes:
        root: the folder.
        kind: what it was recognised as, such as "University-1652".
        panoramas: whether street pictures show the full circle, north in the middle column, as in CVUSA and CVACT.
        full: the size of each of `lists` in the complete data set, as far as it is known.
        left_out: files that were found or named but cannot be used; said once, when the data set is opened.
    """

    kind: str
    panoramas: bool = False

    def __init__(self, root: Path) -> None:
        self.root = root
        self.full: Mapping[str, Size] = {}
        self.left_out: list[LeftOut] = []

    @abstractmethod
    def train(self, folder: str) -> list[Picture]:
        """Training pictures of a view (satellite, drone, street) or of google, empty where there are none."""

    @abstractmethod
    def queries(self, view: str) -> list[Picture]:
        """The test split's queries of a view.

        Raises:
            DataError: when there are none.
        """

    @abstractmethod
    def gallery(self, view: str) -> list[Picture]:
        """The test split's gallery of a view.

        Raises:
            DataError: when there are none.
        """

    @abstractmethod
    def tasks(self) -> list[str]:
        """The retrieval tasks the test split offers, such as "drone-to-satellite", the usual ones first."""

    @abstractmethod
    def lists(self) -> dict[str, list[Picture]]:
        """Every list of pictures there is, by name, such as "train/satellite" or "test/query_drone"."""

    def truth(self, task: str) -> list[Truth] | None:
        """The true matches of each query of a task, or None where they are the gallery's pictures of the same label."""
        del task
        return None


class ListedDataset(Dataset):
    """A data set whose pictures were all listed when it was opened.

    Args:
        train, queries, gallery: pictures by view; queries and gallery may be one and the same mapping.
        expected: what the layout is, for the sentence that says a view is absent.
    """

    def __init__(
        self,
        root: Path,
        train: Mapping[str, list[Picture]],
        queries: Mapping[str, list[Picture]],
        gallery: Mapping[str, list[Picture]],
        expected: str,
    ) -> None:
        super().__init__(root)
        self._train, self._queries, self._gallery = train, queries, gallery
        self._expected = expected

    def train(self, folder: str) -> list[Picture]:
        return list(self._train.get(folder, []))

    def queries(self, view: str) -> list[Picture]:
        return self._of(self._queries, view, "test queries")

    def gallery(self, view: str) -> list[Picture]:
        return self._of(self._gallery, view, "test gallery")

    def tasks(self) -> list[str]:
        return tasks_between([v for v, q in self._queries.items() if q], [v for v, g in self._gallery.items() if g])

    def lists(self) -> dict[str, list[Picture]]:
        found = {f"train/{view}": pictures for view, pictures in self._train.items()}
        if self._queries is self._gallery:
            found |= {f"test/{view}": pictures for view, pictures in self._gallery.items()}
        else:
            found |= {f"test/query_{view}": pictures for view, pictures in self._queries.items()}
            found |= {f"test/gallery_{view}": pictures for view, pictures in self._gallery.items()}
        return {name: list(pictures) for name, pictures in found.items() if pictures}

    def _of(self, lists: Mapping[str, list[Picture]], view: str, said: str) -> list[Picture]:
        if not lists.get(view):
            raise DataError(f"{self.root.name} has no {said} of {view} pictures; expected {self._expected}.")
        return list(lists[view])


def tasks_between(queries: Collection[str], galleries: Collection[str]) -> list[str]:
    """Every task from a view with queries to another with a gallery, the usual ones first."""
    pairs = (views_of(task) for task in TASKS)
    return [f"{query}-to-{gallery}" for query, gallery in pairs if query in queries and gallery in galleries]


def hidden(path: Path) -> bool:
    """Whether a file or folder is one that systems and editors keep for themselves (.ipynb_checkpoints, ._a.jpg)."""
    return path.name.startswith(".")


def files_below(root: Path, suffixes: tuple[str, ...] = SUFFIXES) -> list[Path]:
    """All files below a folder with one of these endings, in order of path; what is hidden is passed over."""
    found: list[Path] = []
    for folder, folders, names in os.walk(root):
        folders[:] = [name for name in folders if not name.startswith(".")]
        found += [Path(folder, n) for n in names if not n.startswith(".") and n.lower().endswith(suffixes)]
    # A link that leads nowhere is a picture that cannot be read, and is named as such.
    return sorted(file for file in found if file.is_file() or (file.is_symlink() and not file.exists()))


class FileNames:
    """Which files there are below a root, each folder read once: quick for tens of thousands of names."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._folders: dict[str, frozenset[str]] = {}

    def __contains__(self, relative: str) -> bool:
        folder, _, name = relative.rpartition("/")
        if folder not in self._folders:
            try:
                self._folders[folder] = frozenset(os.listdir(self._root / folder))  # noqa: PTH208 (names are enough)
            except OSError:
                self._folders[folder] = frozenset()
        return name in self._folders[folder]


def below(text: str, where: str) -> str:
    """A path as a list of pictures gives it, with forward slashes, checked to stay below the data set's folder.

    Raises:
        DataError: naming `where` it was given, when it is absolute, empty, or climbs out with "..".
    """
    if _PLAIN.fullmatch(text):
        return text
    path = PurePosixPath(text.strip().replace("\\", "/"))
    drive = bool(path.parts) and ":" in path.parts[0]
    if not path.parts or path.is_absolute() or drive or ".." in path.parts or any(ord(c) < 32 for c in text.strip()):
        raise DataError(
            f"{where} names the file {printable(text)!r}; expected a path below the data set's folder, without '..'."
        )
    return path.as_posix()


def read_lines(path: Path, name: str) -> list[str]:
    """The lines of a text file.

    Raises:
        DataError: when it cannot be read, is larger than any such list, or is not UTF-8.
    """
    try:
        if path.stat().st_size > INDEX_BYTES:
            raise DataError(f"{name} has more than {INDEX_BYTES // 1_000_000} MB; expected a list of pictures as text.")
        return path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise DataError(
            f"{name} cannot be read ({error.strerror or error}); check that it is there and readable."
        ) from error
    except UnicodeDecodeError as error:
        raise DataError(f"{name} is not text in UTF-8; expected a list of pictures.") from error


def read_rows(path: Path, name: str) -> Iterator[tuple[int, list[str]]]:
    """The lines of a file of comma-separated values that are not empty, each with its number from 1.

    Raises:
        DataError: when it cannot be read as such.
    """
    lines = csv.reader(read_lines(path, name))
    try:
        for values in lines:
            if any(value.strip() for value in values):
                yield lines.line_num, values
    except csv.Error as error:
        raise DataError(f"Line {lines.line_num} of {name} is not comma-separated values ({error}); mend it.") from error


def say_left_out(dataset: Dataset, what: str, effect: str) -> None:
    """One warning that names the first files a data set leaves out."""
    if dataset.left_out:
        some = ", ".join(f"{printable(item.file)} ({item.why})" for item in dataset.left_out[:3])
        more = f", and {len(dataset.left_out) - 3} more" if len(dataset.left_out) > 3 else ""
        log.warning("%s: %d %s: %s%s; %s.", dataset.root.name, len(dataset.left_out), what, some, more, effect)
