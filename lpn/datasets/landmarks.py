"""Oxford5k and Paris6k (Philbin et al. 2007, 2008): landmark pictures; each query is a region of a picture.

    <anywhere>/<picture>.jpg
    <anywhere>/<landmark>_<k>_query.txt            <picture> <left> <top> <right> <bottom>
    <anywhere>/<landmark>_<k>_{good,ok,junk}.txt   a picture's name a line

Names in the query files of Oxford5k are prefixed with oxc1_. Good and ok are true matches; junk is removed from the ranking.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from lpn.core.arrays import Int64Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.datasets.base import LeftOut, ListedDataset, Picture, Size, Truth, files_below, read_lines, warn_left_out
from lpn.datasets.integrity import picture_errors

PREFIX = "oxc1_"
TASK = "street-to-street"
# The archive of Oxford5k holds one picture more than the paper's 5,062.
FULL = {
    "Oxford5k": {"test/query_street": Size(55, 11), "test/gallery_street": Size(5_063)},
    "Paris6k": {"test/query_street": Size(55, 11), "test/gallery_street": Size(6_392)},
}
# The 20 unreadable pictures of the published archive of Paris6k, as listed by its authors, without .jpg.
_CORRUPT = {
    "louvre": (136, 146),
    "moulinrouge": (422,),
    "museedorsay": (1059,),
    "notredame": (188,),
    "pantheon": (284, 960, 974),
    "pompidou": (195, 196, 201, 467, 640),
    "sacrecoeur": (299, 330, 353),
    "triomphe": (662, 833, 863, 867),
}
CORRUPT = frozenset(f"paris_{landmark}_{number:06d}" for landmark, numbers in _CORRUPT.items() for number in numbers)
_QUERY = re.compile(r"(.+)_(\d{1,6})_query\.txt")


class Landmarks(ListedDataset):
    """Oxford5k, Paris6k, or a data set with the same kind of ground truth; its only task is "street-to-street".

    The label of a true match is its landmark's number; every other picture has a label of its own. Labels are for display;
    `truth` holds the true matches. Unreadable pictures are left out and logged once.

    Raises:
        DataError: if a ground-truth file is missing or malformed, or two pictures have the same name.
    """

    kind = "landmarks"

    def __init__(self, root: Path, query_files: list[Path]) -> None:
        queries = [_Query(root, file) for file in query_files]
        queries.sort(key=lambda query: (query.landmark, query.number))
        if len({query.prefixed for query in queries}) > 1:
            raise DataError(
                f"{root.name} holds ground truth of Oxford5k and of another data set; give the folder of one."
            )
        if queries[0].prefixed:
            self.kind = "Oxford5k"
        elif all(query.picture.startswith("paris_") for query in queries):
            self.kind = "Paris6k"
        files = _by_name(root)
        broken = picture_errors(list(files.values()))
        left_out = [
            LeftOut(file.relative_to(root).as_posix(), why, self.kind == "Paris6k" and file.stem in CORRUPT)
            for file, why in broken.items()
        ]
        readable = {name: file for name, file in files.items() if file not in broken}
        position = {name: index for index, name in enumerate(readable)}
        named = dict.fromkeys(name for query in queries for name in query.names())
        left_out += [LeftOut(f"{name}.jpg", "is not there") for name in named if name not in files]
        landmarks = {name: index for index, name in enumerate(sorted({query.landmark for query in queries}))}
        labels = {name: len(landmarks) + index for name, index in position.items()}
        labels |= {
            name: landmarks[query.landmark] for query in reversed(queries) for name in query.good if name in position
        }
        usable = [query for query in queries if query.picture in position]
        gallery = [Picture(file, labels[name], printable(name)) for name, file in readable.items()]
        query_pictures = [
            Picture(readable[query.picture], landmarks[query.landmark], printable(query.name), query.box)
            for query in usable
        ]
        super().__init__(
            root, {}, {"street": query_pictures}, {"street": gallery}, "pictures named as in the ground truth"
        )
        if not query_pictures:
            raise DataError(f"{root.name} has the picture of none of its {len(queries)} queries; add them as .jpg.")
        self._truth = [Truth(_positions(query.good, position), _positions(query.junk, position)) for query in usable]
        self.left_out = left_out
        self.published_sizes = FULL.get(self.kind, {})
        warn_left_out(self.root.name, self.left_out, "pictures cannot be used", "they are left out")

    def tasks(self) -> list[str]:
        return [TASK]

    def truth(self, task: str) -> list[Truth] | None:
        return list(self._truth) if task == TASK else None


class _Query:
    """The four ground-truth files of one query."""

    def __init__(self, root: Path, file: Path) -> None:
        matched = _QUERY.fullmatch(file.name)
        assert matched is not None
        self.landmark, self.number = matched[1], int(matched[2])
        self.name = f"{self.landmark}_{matched[2]}"
        where = file.relative_to(root).as_posix()
        lines = [line for line in read_lines(file, where) if line.strip()]
        values = lines[0].split() if len(lines) == 1 else []
        try:
            left, top, right, bottom = (float(value) for value in values[1:])
        except ValueError:
            left = top = right = bottom = math.nan
        if not (all(map(math.isfinite, (left, top, right, bottom))) and left < right and top < bottom):
            content = printable(lines[0][:80]) if lines else "nothing"
            raise DataError(
                f"{where} says {content!r} in {len(lines)} lines; expected one line: a picture's name and its box as left, top, "
                "right, bottom in pixels."
            )
        self.box = (left, top, right, bottom)
        self.prefixed = values[0].startswith(PREFIX)
        self.picture = _name(values[0].removeprefix(PREFIX), where, 1)
        good, ok, self.junk = (
            _names(root, file.with_name(f"{self.name}_{kind}.txt")) for kind in ("good", "ok", "junk")
        )
        self.good = list(dict.fromkeys(good + ok))

    def names(self) -> list[str]:
        return [self.picture, *self.good, *self.junk]


def query_files(root: Path) -> list[Path]:
    """Return the ground-truth files below a folder that name a query."""
    return [file for file in files_below(root, ("_query.txt",)) if _QUERY.fullmatch(file.name)]


def _by_name(root: Path) -> dict[str, Path]:
    files: dict[str, Path] = {}
    for file in sorted(files_below(root, (".jpg", ".jpeg")), key=lambda file: (file.stem, file)):
        if file.stem in files:
            both = " and ".join(printable(f.relative_to(root).as_posix()) for f in (files[file.stem], file))
            raise DataError(f"{root.name} has two pictures of one name, {both}; keep one, or give a folder with one.")
        files[file.stem] = file
    return files


def _names(root: Path, file: Path) -> list[str]:
    where = file.relative_to(root).as_posix()
    return [_name(text, where, line) for line, text in enumerate(read_lines(file, where), 1) if text.strip()]


def _name(text: str, where: str, line: int) -> str:
    """Check a picture's name; names are looked up among existing files, never opened as paths."""
    name = text.strip().removesuffix(".jpg")
    if not re.fullmatch(r"[\w.-]{1,200}", name) or name.startswith("."):
        raise DataError(
            f"Line {line} of {where} names {printable(text[:80])!r}; expected a picture's name without a folder."
        )
    return name


def _positions(names: list[str], position: dict[str, int]) -> Int64Array:
    return np.array(sorted(position[name] for name in names if name in position), dtype=np.int64)
