"""The interface of a data set: pictures by split and view, tasks, and true matches."""

from __future__ import annotations

import csv
import logging
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from lpn.core.arrays import Float64Array, Int64Array, UInt8Array
from lpn.core.csv_cells import decode_text, delimited
from lpn.core.errors import DataError, InputError
from lpn.core.files import first_few, printable
from lpn.core.images import OTHER_SUFFIXES, SUFFIXES, crop, header_error, load_picture, zoom
from lpn.core.tables import Column, number_column, text_column
from lpn.core.views import views_of
from lpn.datasets import geo

log = logging.getLogger(__name__)

# Tasks between two views, the most common first.
TASKS = (
    "drone-to-satellite",
    "satellite-to-drone",
    "street-to-satellite",
    "satellite-to-street",
    "drone-to-street",
    "street-to-drone",
)
# The published evaluations that measure distances: of DenseUAV, of GTA-UAV, and of UAV-VisLoc in Game4Loc's form.
PositionProtocol = Literal["DenseUAV", "GTA-UAV", "UAV-VisLoc"]
# The largest list of pictures (.csv, .txt) that is read, in bytes.
MAX_LIST_BYTES = 100_000_000
# Folders that macOS's archives, Windows, Synology's servers, and Linux add; pictures in them are no pictures of the user.
_ADDED_BY_SYSTEMS = frozenset(("__MACOSX", "$RECYCLE.BIN", "System Volume Information", "@eaDir", "lost+found"))


@dataclass(frozen=True)
class Picture:
    """A picture: a file, or one that is cut out of a larger raster when it is needed.

    Attributes:
        path: the file. With `cut`, it is a unique path at which no file need exist.
        label: number of its place. Pictures of equal label are true matches, unless `Dataset.truth` lists the true
            matches.
        name: name for display. If the data set gives none, it is the place's folder. If the place has several pictures,
            the file is added ("0005/01" for 0005/image-01.jpeg).
        box: the query region (left, top, right, bottom) in pixels, in Oxford5k and Paris6k; else None.
        panorama: True if it shows the full circle with north in the middle column.
        group: the group by which results are split, such as the camera's height in metres; see `Dataset.group_name`.
        note: a remark to display beside the name.
        zoom: the factor by which it is zoomed when it is described, within its box; see `lpn.retrieval.calibration`.
        cut: returns the pixels, (H, W, 3) uint8 RGB; None reads the file.
        caption: what people read in place of `name`; "" for the name itself. Links and files keep the name.
    """

    path: Path
    label: int
    name: str
    box: tuple[float, float, float, float] | None = None
    panorama: bool = False
    group: str = ""
    note: str = field(default="", compare=False)
    zoom: float = 1.0
    cut: Callable[[], UInt8Array] | None = field(default=None, compare=False, repr=False)
    caption: str = field(default="", compare=False)

    @property
    def title(self) -> str:
        """The name that people read: the caption, else the name in files."""
        return self.caption or self.name

    def load(self) -> UInt8Array:
        """Return the picture without regard to box and zoom, (H, W, 3) uint8 RGB; PictureError if it cannot be read."""
        return load_picture(self.path) if self.cut is None else self.cut()

    def load_cropped(self) -> UInt8Array:
        """Return the picture within its box, (H, W, 3) uint8 RGB; errors as for `load`."""
        return crop(self.load(), self.box, self.name)

    def load_zoomed(self) -> UInt8Array:
        """Return the pixels that a model describes, the box at its zoom, (H, W, 3) uint8 RGB; errors as for `load`."""
        return zoom(self.load_cropped(), self.zoom)


def labels_of(pictures: Sequence[Picture]) -> Int64Array:
    """The label of each picture, (N,)."""
    return np.array([picture.label for picture in pictures], np.int64)


def _no_tiles() -> Int64Array:
    return np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class Truth:
    """The ground truth of one query, as sorted positions in the gallery, int64.

    Attributes:
        good: the true matches, (M,).
        junk: pictures that are removed from the ranking before it is scored, (J,).
        known: False if nobody knows the query's place. It is ranked, but counts neither as found nor as missed.
        trapezoid: True if AP integrates the precision-recall points by the trapezoid rule; False if it is the mean precision at
            the true matches, as GTA-UAV has it.
        semi: half-true matches, which count as false (VIGOR's and GTA-UAV's semi-positives), (S,).
        overlaps: intersection over union of the query's footprint with each of `good`, then each of `semi`, 0 .. 1, (M + S,);
            None where nobody measured it.
    """

    good: Int64Array
    junk: Int64Array
    known: bool = True
    trapezoid: bool = True
    semi: Int64Array = field(default_factory=_no_tiles)
    overlaps: Float64Array | None = None

    def overlap(self, tile: int) -> float:
        """Return the overlap of a tile with the query's footprint, 0 for one that is not listed; NaN without overlaps."""
        if self.overlaps is None:
            return float("nan")
        listed = np.concatenate([self.good, self.semi]) == tile
        return float(self.overlaps[listed].max(initial=0.0))


@dataclass(frozen=True)
class Size:
    """The size of a list of pictures in the complete data set; None if unpublished or disputed."""

    pictures: int | None
    places: int | None = None


@dataclass(frozen=True)
class LeftOut:
    """A file that a data set lists or contains, but that cannot be used.

    Attributes:
        file: its path below the root.
        why: reason as a predicate, such as "is not there".
        published: True if the published data set has the same defect. This copy is intact then.
    """

    file: str
    why: str
    published: bool = False


class Dataset(ABC):
    """A data set's folder.

    Attributes:
        root: the folder.
        kind: the recognised layout, such as "University-1652".
        panoramas: True if street pictures show the full circle with north in the middle column, as in CVUSA and CVACT.
        group_name: the quantity by which pictures are grouped, such as "height" in metres or "city"; empty without groups. The
            results of a group take its queries and gallery pictures, and all pictures without a group.
        mean_of_groups: True if the published figure is the mean of its groups' figures.
        trained_distractors: True if the test gallery holds the places to train on, as published.
        measured_by: the published evaluation that measures distances on it; None if its results are recall and AP alone.
        published_sizes: the size of each of `lists` in the complete data set, if known.
        left_out: files that cannot be used; logged once, when the data set is opened.
    """

    kind: str
    panoramas: bool = False
    group_name: str = ""
    mean_of_groups: bool = False
    trained_distractors: bool = False
    measured_by: PositionProtocol | None = None

    def __init__(self, root: Path) -> None:
        self.root = root
        self.published_sizes: Mapping[str, Size] = {}
        self.left_out: list[LeftOut] = []

    @abstractmethod
    def train(self, folder: str) -> list[Picture]:
        """Return the training pictures of a view (satellite, drone, street) or of "google"; may be empty."""

    @abstractmethod
    def queries(self, view: str) -> list[Picture]:
        """Return the test split's queries of a view.

        Raises:
            DataError: if there are none.
        """

    @abstractmethod
    def gallery(self, view: str) -> list[Picture]:
        """Return the test split's gallery of a view.

        Raises:
            DataError: if there is none.
        """

    @abstractmethod
    def tasks(self) -> list[str]:
        """Return the test split's tasks, such as "drone-to-satellite", the most common first."""

    def why_no_task(self) -> str:
        """Return the reason why `tasks` is empty, as a predicate, and the remedy."""
        return "has no queries of one view with a gallery of another in its test split; lpn doctor lists what it has"

    def lacks_task(self, name: str) -> DataError | InputError:
        """Return the error about a task that is not one of `tasks`: what there is instead, or why there is none."""
        if offered := self.tasks():
            own = printable(self.root.resolve().name)
            return InputError(f"The task is {name!r}; {own} offers {', '.join(offered)} in its test split.")
        return self.no_task()

    def no_task(self) -> DataError:
        """Return the error about a data set without `tasks`."""
        return DataError(f"{printable(self.root.resolve().name)} {self.why_no_task()}.")

    @abstractmethod
    def lists(self) -> dict[str, list[Picture]]:
        """Return every list of pictures by its name, such as "train/satellite" or "test/query_drone"."""

    def unread(self) -> list[LeftOut]:
        """Return the pictures in the folders that are not read because of their name or kind.

        A data set with list files has none, because only listed pictures belong to it. The call walks the folders.
        """
        return []

    def truth(self, task: str) -> list[Truth] | None:
        """Return the ground truth of each query; None if pictures of equal label are the true matches."""
        del task
        return None

    def positions(self) -> geo.Positions | None:
        """Return the positions of the test pictures on the Earth, by default those of its `geo.csv`; None without any.

        Raises:
            DataError: if the file that holds them cannot be read.
        """
        return geo.positions(self.root)

    def coordinates(self, pictures: Sequence[Picture]) -> Float64Array:
        """Return the positions that `measured_by` compares: latitude and longitude in degrees, or metres for GTA-UAV, (N, 2).

        Raises:
            DataError: if a picture has none.
        """
        known = self.positions()
        if known is None:
            raise DataError(f"{self.root.name} has no positions of its pictures; add a {geo.NAME}.")
        return np.array([(place.latitude, place.longitude) for place in known.of(pictures)], np.float64).reshape(-1, 2)

    def columns(self, queries: Sequence[Picture]) -> list[Column]:
        """Return further columns of a table about queries: their groups, if they have any."""
        groups = [picture.group for picture in queries]
        if not any(groups):
            return []
        if all(group.isdecimal() for group in groups):
            return [number_column(self.group_name, [float(group) for group in groups], "m")]
        return [text_column(self.group_name, groups)]


class ListedDataset(Dataset):
    """A data set whose pictures are all listed when it is opened.

    Args:
        train, queries, gallery: pictures by view; queries and gallery may be the same mapping.
        expected: the expected layout, for the error about a missing view.
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
        return self._list(self._queries, view, "test queries")

    def gallery(self, view: str) -> list[Picture]:
        return self._list(self._gallery, view, "test gallery")

    def tasks(self) -> list[str]:
        return tasks_between([v for v, q in self._queries.items() if q], [v for v, g in self._gallery.items() if g])

    def lists(self) -> dict[str, list[Picture]]:
        lists = {f"train/{view}": pictures for view, pictures in self._train.items()}
        if self._queries is self._gallery:
            lists |= {f"test/{view}": pictures for view, pictures in self._gallery.items()}
        else:
            lists |= {f"test/query_{view}": pictures for view, pictures in self._queries.items()}
            lists |= {f"test/gallery_{view}": pictures for view, pictures in self._gallery.items()}
        return {name: list(pictures) for name, pictures in lists.items() if pictures}

    def _list(self, lists: Mapping[str, list[Picture]], view: str, name: str) -> list[Picture]:
        if not lists.get(view):
            raise DataError(f"{self.root.name} has no {name} of {view} pictures; expected {self._expected}.")
        return list(lists[view])


def tasks_between(queries: Collection[str], galleries: Collection[str]) -> list[str]:
    """Return every task from a view with queries to a view with a gallery, the most common first."""
    pairs = (views_of(task) for task in TASKS)
    return [f"{query}-to-{gallery}" for query, gallery in pairs if query in queries and gallery in galleries]


def hidden(path: Path) -> bool:
    """Return whether a file or folder is hidden, or is one that a system leaves beside those of the user."""
    return hidden_name(path.name)


def hidden_name(name: str) -> bool:
    """Return whether a name is hidden (.ipynb_checkpoints, ._a.jpg, .DS_Store), or one that a system adds (__MACOSX)."""
    return name.startswith(".") or name in _ADDED_BY_SYSTEMS


def files_below(root: Path, suffixes: tuple[str, ...] = SUFFIXES) -> list[Path]:
    """Return the files below a folder whose names end in one of `suffixes`, sorted by path.

    Hidden files and folders are skipped.
    """
    files: list[Path] = []
    for folder, folders, names in os.walk(root):
        folders[:] = [name for name in folders if not hidden_name(name)]
        files += [Path(folder, n) for n in names if not n.startswith(".") and n.lower().endswith(suffixes)]
    # A broken link counts as a picture, so that it is reported as unreadable.
    return sorted(file for file in files if file.is_file() or (file.is_symlink() and not file.exists()))


def unread_below(root: Path, folders: Sequence[str] = ("",)) -> list[LeftOut]:
    """Return the files in some folders below a root that are pictures, and that `files_below` skips; hidden folders are skipped.

    Files without an ending are recognised by their first bytes.
    """
    left_out: list[LeftOut] = []
    for top in folders:
        for folder, inside, names in os.walk(root / top):
            inside[:] = sorted(name for name in inside if not hidden_name(name))
            files = {file: _unread(file) for file in (Path(folder, name) for name in sorted(names))}
            left_out += [
                LeftOut(file.relative_to(root).as_posix(), why) for file, why in files.items() if why is not None
            ]
    return left_out


def _unread(file: Path) -> str | None:
    """Return why a picture is not read; None for a file that is read, or is no picture."""
    suffix = file.suffix.lower()
    if file.name.startswith("."):
        # macOS keeps a file's attributes in one of the same name after "._".
        return None if file.name.startswith("._") or suffix not in (*SUFFIXES, *OTHER_SUFFIXES) else "is hidden"
    if suffix in OTHER_SUFFIXES:
        return "is of a kind that is not read; save it as JPEG"
    if suffix:
        return None
    try:
        with file.open("rb") as opened:
            return None if header_error(opened) is not None else "has no ending such as .jpg; rename it"
    except OSError:
        return None


def read_lines(path: Path, name: str) -> list[str]:
    """Return the lines of a text file.

    Raises:
        DataError: if the file cannot be read, is too large, or is neither UTF-8 nor UTF-16.
    """
    return read_text(path, name).splitlines()


def read_text(path: Path, name: str, errors: str = "strict") -> str:
    """Return the text of a file; errors as for `read_lines`."""
    try:
        if path.stat().st_size > MAX_LIST_BYTES:
            raise DataError(
                f"{name} has more than {MAX_LIST_BYTES // 1_000_000} MB; expected a list of pictures as text."
            )
        return decode_text(path.read_bytes(), errors)
    except OSError as error:
        raise DataError(
            f"{name} cannot be read ({error.strerror or error}); check that it is there and readable."
        ) from error
    except UnicodeDecodeError as error:
        raise DataError(f"{name} is not text in UTF-8 or UTF-16; expected a list of pictures.") from error


def read_rows(path: Path, name: str, errors: str = "strict") -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a CSV file that are not blank, each with its line number from 1.

    Values are separated as `lpn.core.csv_cells.delimited` finds out.

    Args:
        errors: of the decoding; "surrogateescape" keeps the bytes of a file name that is not UTF-8.

    Raises:
        DataError: if it is not a CSV file.
    """
    rows = delimited(read_text(path, name, errors)).rows
    line = 0
    try:
        for line, values in rows:
            yield line, values
    except csv.Error as error:
        raise DataError(f"Line {line + 1} of {name} is not comma-separated values ({error}); correct it.") from error


def warn_left_out(name: str, files: Sequence[LeftOut], what: str, effect: str) -> None:
    """Log one warning about the files that are left out of a folder, if there are any.

    The warning reads "<name>: <number> <what>: <files>; <effect>."
    """
    if files:
        some = first_few([f"{printable(item.file)} ({item.why})" for item in files], 3)
        log.warning("%s: %d %s: %s; %s.", printable(name), len(files), what, some, effect)
