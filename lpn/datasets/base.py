"""A data set: the rows of a layout, resolved to pictures by split and view, with tasks, true matches, and positions."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from lpn.core.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from lpn.core.errors import DataError, InputError
from lpn.core.files import first_few, printable
from lpn.core.images import OTHER_SUFFIXES, SUFFIXES, crop, load_picture, zoom
from lpn.core.tables import Column, number_column, text_column
from lpn.core.texts import counted
from lpn.core.views import TASKS, VIEWS, views_of
from lpn.datasets import geo
from lpn.datasets.listed_paths import FilesBelow, hidden_name

log = logging.getLogger(__name__)

# The published evaluations that measure distances: of DenseUAV, of GTA-UAV, and of UAV-VisLoc in Game4Loc's form.
PositionProtocol = Literal["DenseUAV", "GTA-UAV", "UAV-VisLoc"]
# The lists of pictures that layouts may have.
_OF_VIEWS = ("train/", "test/", "test/query_", "test/gallery_")
_LISTS = ("pictures", "train/google", *(f"{of}{view}" for of in _OF_VIEWS for view in VIEWS))


@dataclass(frozen=True)
class Picture:
    """A picture: a file, or an area that is cut out of a larger raster when it is needed.

    Attributes:
        path: the file. With `cut`, it is a unique path at which no file need exist.
        label: number of its place. Pictures of equal label are true matches, unless `Dataset.truth` lists the true
            matches.
        name: name for display; by default the place's folder, with the file if the place has several pictures
            ("0005/01" for 0005/image-01.jpeg).
        box: the query region (left, top, right, bottom) in pixels, in Oxford5k and Paris6k; else None.
        panorama: True if it shows the full circle with north in the middle column.
        group: the group by which results are split, such as the camera's height in metres; see `Dataset.group_name`.
        note: a remark to display beside the name.
        zoom: the factor by which it is zoomed for its description, within its box; see `lpn.retrieval.calibration`.
        cut: returns the pixels, (H, W, 3) uint8 RGB; None reads the file.
        caption: the displayed name if it differs from `name`; links and files use `name`.
        missing: a sentence with the reason why the picture is missing, so that `cut` draws a placeholder; else empty.
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
    missing: str = field(default="", compare=False)

    @property
    def title(self) -> str:
        """The displayed name: the caption, else the name."""
        return self.caption or self.name

    def load(self) -> UInt8Array:
        """Return the whole picture without box and zoom, (H, W, 3) uint8 RGB; PictureError if it cannot be read."""
        return load_picture(self.path) if self.cut is None else self.cut()

    def load_cropped(self) -> UInt8Array:
        """Return the picture within its box, (H, W, 3) uint8 RGB; errors as for `load`."""
        return crop(self.load(), self.box, self.name)

    def load_zoomed(self) -> UInt8Array:
        """Return the pixels that a model describes, the box at its zoom, (H, W, 3) uint8 RGB; errors as for `load`."""
        return zoom(self.load_cropped(), self.zoom)


def labels_of(pictures: Sequence[Picture]) -> Int64Array:
    return np.array([picture.label for picture in pictures], np.int64)


@dataclass(frozen=True, eq=False)
class Truth:
    """The ground truth of one query, as sorted positions in the gallery, int64.

    Attributes:
        good: the true matches, (M,).
        junk: pictures that are removed from the ranking before it is scored, (J,).
        known: False if the query's place is unknown. The query is ranked, but counts neither as found nor as missed.
        trapezoid: True if AP integrates the precision-recall points by the trapezoid rule; False if it is the mean precision at
            the true matches, as in GTA-UAV.
        semi: half-true matches, which count as false (VIGOR's and GTA-UAV's semi-positives), (S,).
        overlaps: intersection over union of the query's footprint with each of `good`, then each of `semi`, 0 .. 1, (M + S,);
            None if it was not measured.
        among: the only ranked pictures, (R,), an array that the queries of a region share; None for the whole gallery.
    """

    good: Int64Array
    junk: Int64Array
    known: bool = True
    trapezoid: bool = True
    semi: Int64Array = field(default_factory=lambda: np.zeros(0, np.int64))
    overlaps: Float64Array | None = None
    among: Int64Array | None = None

    def unranked(self, size: int) -> BoolArray:
        """Return the mask of a gallery's pictures that are removed from the ranking, (G,); `size` is G."""
        unranked = np.full(size, self.among is not None)
        unranked[self.among if self.among is not None else []] = False
        unranked[self.junk] = True
        return unranked

    def overlap(self, tile: int) -> float:
        """Return the overlap of a tile with the query's footprint, 0 for an unlisted tile; NaN without overlaps."""
        if self.overlaps is None:
            return float("nan")
        listed = np.concatenate([self.good, self.semi]) == tile
        return float(self.overlaps[listed].max(initial=0.0))


@dataclass(frozen=True)
class Size:
    """The size of a list of pictures in the complete data set; None if unpublished or disputed."""

    pictures: int | None
    places: int | None = None


def sizes(**lists: Mapping[str, tuple[int | None, int | None]]) -> dict[str, Size]:
    """Return the size of each list by its name, from (pictures, places) by view for `train`, `query`, `gallery`, or `test`."""
    prefixes = {"train": "train/", "query": "test/query_", "gallery": "test/gallery_", "test": "test/"}
    return {prefixes[role] + view: Size(*size) for role, of in lists.items() for view, size in of.items()}


@dataclass(frozen=True)
class LeftOut:
    """A file that a data set lists or contains, but cannot use.

    Attributes:
        file: its path below the root.
        why: reason as a predicate, such as "is not there".
        published: whether this defect is in the published data set, so that it says nothing against this copy.
    """

    file: str
    why: str
    published: bool = False


@dataclass(frozen=True)
class PictureRow:
    """One picture that a layout lists.

    Attributes:
        of: its list, such as "train/drone" or "test/query_drone"; "test/drone" is both queries and gallery.
        file: its listed path below the root, or its path in a folder that was read.
        label, name, group, box: see `Picture`.
        true, semi, junk: the `file` of gallery pictures, see `Truth`; `true` is None if labels are the truth.
        overlaps: of the query's footprint with true and half-true pictures, by `file`; None if they were not measured.
        region: queries of a region are ranked among its pictures alone; "" for the whole gallery.
    """

    of: str
    file: str | Path
    label: int
    name: str
    group: str = ""
    box: tuple[float, float, float, float] | None = None
    true: Collection[str | Path] | None = None
    semi: Collection[str | Path] = ()
    junk: Collection[str | Path] = ()
    overlaps: Mapping[str | Path, float] | None = None
    region: str = ""


class Dataset:
    """A data set's folder; a subclass is a layout with its marks, its `rows`, and its exceptions.

    Args:
        split: one of `splits`; by default the first existing one.

    Raises:
        DataError: if a list is missing or malformed, or none of its pictures exists.

    Attributes:
        root: the folder.
        files: the files below it, for the look-up of listed names.
        split: the split that is read, such as "cross-area"; None for a layout with one.
        kind: the recognised layout, such as "University-1652".
        title: the name of the folder in `lpn doctor`.
        marks: tuples of patterns of paths below the root; a pattern of folders ends in a slash. A folder has this layout if
            all patterns of a tuple match.
        priority: layouts of a higher priority are tried first.
        deep: `recognises` searches the whole folder, so it is called last, and only for the folder to open.
        splits: lists of each split; at least one must exist. The path to open may end in a split's name.
        folders: folders below the root whose pictures are all read.
        expected: the expected layout, for the errors about missing pictures.
        panoramas: True if street pictures show the full circle with north in the middle column, as in CVUSA and CVACT.
        group_name: the quantity by which pictures are grouped, such as "height" in metres or "city"; empty without groups. The
            results of a group are those of its pictures together with all pictures without a group.
        mean_of_groups: whether the published figure is the mean of its groups' figures.
        trained_distractors: True if the published test gallery contains the training places.
        trapezoid: see `Truth`.
        measured_by: the published evaluation that measures distances on it; None if its results are recall and AP alone.
        positions_from: the source of `place`, for messages; "" for a data set with positions in `geo.csv`.
        published_sizes: the size of each of `lists` in the complete data set, if known.
    """

    kind: str
    title: str = ""
    marks: tuple[tuple[str, ...], ...] = ()
    priority: int = 0
    deep: bool = False
    splits: Mapping[str, Sequence[str]] = {}
    folders: Sequence[str] = ()
    expected: str = "the lists of its layout"
    panoramas: bool = False
    group_name: str = ""
    mean_of_groups: bool = False
    trained_distractors: bool = False
    trapezoid: bool = True
    measured_by: PositionProtocol | None = None
    positions_from: str = ""
    published_sizes: Mapping[str, Size] = {}

    def __init__(self, root: Path, split: str | None = None) -> None:
        self.root, self.files = root, FilesBelow(root)
        self._left_out: dict[str, LeftOut] = {}
        self._listed: dict[str, list[tuple[PictureRow, Picture]]] = {}
        self.split = self._chosen(split)
        for row in self.rows():
            if row.of not in _LISTS:
                raise DataError(f"The layout {self.kind} lists {row.of!r}; rename it to one of {', '.join(_LISTS)}.")
            file = row.file
            if isinstance(file, str) and (found := self.files.find(file)) is not None:
                file = root / found
            if isinstance(file, str):
                self.leave_out(file)
                continue
            panorama = self.panoramas and row.of.endswith("street")
            picture = Picture(file, row.label, printable(row.name), row.box, panorama, row.group)
            self._listed.setdefault(row.of, []).append((row, picture))
        if self._left_out and all(name.startswith("test/gallery") for name in self._listed):
            first = printable(next(iter(self._left_out)))
            raise DataError(
                f"{root.name} has no picture that can be used, and the first file left out is {first}; expected {self.expected}."
            )
        warn_left_out(root.name, self.left_out, "listed file")

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """Return whether a folder has this layout: by `marks`, unless a subclass looks deeper."""
        return any(all(_is_there(root, path) for path in paths) for paths in cls.marks)

    def rows(self) -> Iterable[PictureRow]:
        """List the pictures, existing or not. It is called once, when the data set is opened."""
        return ()

    def splits_there(self) -> list[str] | None:
        """Return the splits whose lists exist; None for a data set without splits."""
        there = [split for split, lists in self.splits.items() if any(_is_there(self.root, name) for name in lists)]
        return there if self.splits else None

    def place(self, picture: Picture) -> geo.Position | None:
        """Return the position of a test picture from the lists or its name; see `positions_from`."""
        del picture
        return None

    def leave_out(self, file: str, why: str = "is not there", published: bool = False) -> None:
        """Leave out a file, see `LeftOut`."""
        self._left_out.setdefault(file, LeftOut(file, why, published))

    def together(self, *rows: PictureRow) -> tuple[PictureRow, ...]:
        """Return rows that are useful only together; none of them if one file is missing."""
        missing = [row.file for row in rows if isinstance(row.file, str) and self.files.find(row.file) is None]
        for file in missing:
            self.leave_out(file)
        return () if missing else rows

    @property
    def left_out(self) -> list[LeftOut]:
        """The files that cannot be used; logged once, when the data set is opened."""
        return list(self._left_out.values())

    def pictures(self, name: str) -> list[Picture]:
        """Return the pictures of one of `lists`; empty for another name."""
        return [picture for _, picture in self._listed.get(name, ())]

    def train(self, folder: str) -> list[Picture]:
        """Return the training pictures of a view (satellite, drone, street) or of "google"; may be empty."""
        return self.pictures(f"train/{folder}")

    def queries(self, view: str) -> list[Picture]:
        """Return the test split's queries of a view; DataError if there are none."""
        return self._test("query", view)

    def gallery(self, view: str) -> list[Picture]:
        """Return the test split's gallery of a view; DataError if there is none."""
        return self._test("gallery", view)

    def tasks(self) -> list[str]:
        """Return the test split's tasks, such as "drone-to-satellite", the most common first."""
        pairs = ((task, *views_of(task)) for task in TASKS)
        return [task for task, a, b in pairs if a != b and self.has("query", a) and self.has("gallery", b)]

    def has(self, role: str, view: str) -> bool:
        """Return whether the test split has queries ("query") or a gallery ("gallery") of a view."""
        return f"test/{role}_{view}" in self._listed or f"test/{view}" in self._listed

    def why_no_task(self) -> str:
        """Return the reason why `tasks` is empty, as a predicate, and the remedy."""
        there = [name for name in self.lists() if name.startswith("test/")]
        has = f"only {' and '.join(there)}" if there else "no pictures to test with"
        return f"has {has}; expected queries of one view and a gallery of another, as {self.expected}"

    def lacks_task(self, name: str) -> DataError | InputError:
        """Return the error about a task that is not in `tasks`, with the existing ones or the reason why there are none."""
        if not (offered := self.tasks()):
            return self.no_task()
        own = printable(self.root.resolve().name)
        return InputError(f"The task is {name!r}; {own} offers {', '.join(offered)} in its test split.")

    def no_task(self) -> DataError:
        """Return the error about a data set without `tasks`."""
        return DataError(f"{printable(self.root.resolve().name)} {self.why_no_task()}.")

    def lists(self) -> dict[str, list[Picture]]:
        """Return every list of pictures by its name, such as "train/satellite" or "test/query_drone"."""
        names = sorted(self._listed, key=lambda name: (not name.startswith("train/"), name.startswith("test/gallery")))
        return {name: self.pictures(name) for name in names}

    def unread(self) -> list[LeftOut]:
        """Return the pictures in `folders` of unsupported kinds; the call walks the folders."""
        return unread_below(self.root, self.folders)

    def truth(self, task: str) -> list[Truth] | None:
        """Return the ground truth of each query; None if pictures of equal label are the true matches."""
        query_view, gallery_view = views_of(task)
        queries = [row for row, _ in self._listed.get(f"test/query_{query_view}", ())]
        gallery = [row for row, _ in self._listed.get(f"test/gallery_{gallery_view}", ())]
        if not gallery or all(row.true is None for row in queries):
            return None
        position = {row.file: i for i, row in enumerate(gallery)}
        region = np.array([row.region for row in gallery])
        among = {name: np.flatnonzero(region == name) for name in {row.region for row in gallery} - {""}}

        def tiles(files: Iterable[str | Path]) -> Int64Array:
            return np.array(sorted({position[file] for file in files if file in position}), np.int64)

        def of(row: PictureRow) -> Truth:
            good, semi, overlaps = tiles(row.true or ()), tiles(row.semi), None
            if row.overlaps is not None:
                overlaps = np.array([row.overlaps[gallery[tile].file] for tile in (*good, *semi)], np.float64)
            return Truth(good, tiles(row.junk), True, self.trapezoid, semi, overlaps, among.get(row.region))

        return [of(row) for row in queries]

    def positions(self) -> geo.Positions | None:
        """Return the WGS 84 positions of the test pictures, from `geo.csv` or `place`; None without any.

        Raises:
            DataError: if their file cannot be read, or a picture's name contains no position.
        """
        if not self.positions_from:
            return geo.positions(self.root)
        pictures = [picture for name, of in self.lists().items() if name.startswith("test/") for picture in of]
        places = zip(geo.names_below(self.root, pictures), map(self.place, pictures), strict=True)
        known = {path: place for path, place in places if place is not None}
        return geo.Positions(self.root, known, self.positions_from)

    def coordinates(self, pictures: Sequence[Picture]) -> Float64Array:
        """Return the positions that `measured_by` compares: latitude and longitude in degrees, or metres for GTA-UAV, (N, 2).

        Raises:
            DataError: if a picture has no position.
        """
        known = self.positions()
        if known is None:
            raise DataError(f"{self.root.name} has no positions of its pictures; add a {geo.NAME}.")
        return np.array([(place.latitude, place.longitude) for place in known.of(pictures)], np.float64).reshape(-1, 2)

    def columns(self, queries: Sequence[Picture]) -> list[Column]:
        """Return further columns of a table about queries, such as their groups."""
        groups = [picture.group for picture in queries]
        if not any(groups):
            return []
        if all(group.isdecimal() for group in groups):
            return [number_column(self.group_name, [float(group) for group in groups], "m")]
        return [text_column(self.group_name, groups)]

    def _test(self, role: str, view: str) -> list[Picture]:
        pictures = self.pictures(f"test/{role}_{view}") or self.pictures(f"test/{view}")
        if not pictures:
            what = "test queries" if role == "query" else "test gallery"
            raise DataError(f"{self.root.name} has no {what} of {view} pictures; expected {self.expected}.")
        return pictures

    def _chosen(self, wanted: str | None) -> str | None:
        """Return the wanted split, or by default the first existing one, with a warning about the others."""
        there, name = self.splits_there(), printable(self.root.name)
        if there is None and wanted is None:
            return None
        if not there or (wanted is not None and wanted not in there):
            has, first = " and ".join(there or ()) or "none", next(iter(self.splits.values()), ("another",))[0]
            raise DataError(f"{name} has the lists of {has}; expected {wanted or first}, so unpack it there.")
        if wanted is None and len(there) > 1:
            others, number = [str(self.root / split) for split in there[1:]], {2: "two", 3: "three"}.get(len(there))
            text = "%s has %s splits; this is %s, and %s the other%s."
            log.warning(text, name, number or len(there), there[0], first_few(others, 5), "s" * (len(others) > 1))
        return wanted or there[0]


class Folder(Dataset):
    """Pictures below a folder, each with a place of its own."""

    kind = "folder"
    title = "a plain folder of pictures"
    folders = ("",)
    expected = "a data set with queries and a gallery, since this is a folder of pictures"

    def rows(self) -> Iterable[PictureRow]:
        for index, file in enumerate(files_below(self.root)):
            yield PictureRow("pictures", file, index, file.relative_to(self.root).with_suffix("").as_posix())

    def why_no_task(self) -> str:
        return (
            "is a folder of pictures, and nothing says which of them show the same place; name the pairs in a pairs.csv (columns "
            "satellite, drone, and perhaps split), or make one numbered folder for each place: train/drone/<number>/* and "
            "train/satellite/<number>/* to train on, test/query_drone/<number>/* and test/gallery_satellite/<number>/* to test "
            "with"
        )


def _is_there(root: Path, pattern: str) -> bool:
    """Return whether a pattern of `Dataset.marks` matches; called for thousands of folders."""
    if "*" in pattern:
        return any(root.glob(pattern))
    path = os.path.join(root, pattern)  # noqa: PTH118 (a string is quicker)
    return os.path.isdir(path) if pattern.endswith("/") else os.path.isfile(path)  # noqa: PTH112, PTH113


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
    """Return the pictures of unsupported kinds in some folders below a root, without hidden ones."""
    files = sorted(file for folder in folders for file in files_below(root / folder, OTHER_SUFFIXES))
    why = "is of a kind that is not read; save it as JPEG"
    return [LeftOut(file.relative_to(root).as_posix(), why) for file in files]


def warn_left_out(name: str, files: Sequence[LeftOut], noun: str) -> None:
    """Log one warning about the files of a folder that are left out, if there are any."""
    if files:
        some = first_few([f"{printable(item.file)} ({item.why})" for item in files], 3)
        log.warning("Left out of %s: %s, %s.", printable(name), counted(len(files), noun), some)
