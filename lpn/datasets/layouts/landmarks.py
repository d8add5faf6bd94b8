"""Oxford5k and Paris6k (Philbin et al. 2007, 2008): landmark pictures; each query is a region of a picture.

    <anywhere>/<picture>.jpg
    <anywhere>/<landmark>_<k>_query.txt            <picture> <left> <top> <right> <bottom>
    <anywhere>/<landmark>_<k>_{good,ok,junk}.txt   a picture's name a line

Names in the query files of Oxford5k are prefixed with oxc1_. Good and ok are true matches; junk is removed from the ranking.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.datasets.base import Dataset, PictureRow, Size, files_below
from lpn.datasets.integrity import picture_errors
from lpn.datasets.lists import numbered_lines

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


class Landmarks(Dataset):
    """Oxford5k, Paris6k, or a data set with the same kind of ground truth; its only task is "street-to-street".

    The label of a true match is its landmark's number; every other picture has a label of its own. Labels are for display.
    Unreadable pictures are left out.
    """

    kind = "landmarks"
    title = "a set of landmarks with ground-truth files as in Oxford5k"
    known_by = "*_query.txt (Oxford5k, Paris6k)"
    priority = -2
    deep = True
    unusable = "pictures"
    expected = "pictures named as in the ground truth"

    @classmethod
    def recognises(cls, root: Path) -> bool:
        return bool(_query_files(root))

    def rows(self) -> Iterator[PictureRow]:
        queries = [_Query(self.root, file) for file in _query_files(self.root)]
        queries.sort(key=lambda query: (query.landmark, query.number))
        self.none_whole = f"has the picture of none of its {len(queries)} queries; add them as .jpg"
        if len({query.prefixed for query in queries}) > 1:
            raise DataError(
                f"{self.root.name} holds ground truth of Oxford5k and of another data set; give the folder of one."
            )
        if queries[0].prefixed or all(query.picture.startswith("paris_") for query in queries):
            self.kind, self.title = "Oxford5k" if queries[0].prefixed else "Paris6k", ""
            self.published_sizes = FULL[self.kind]
        files = _by_name(self.root)
        for file, why in picture_errors(list(files.values())).items():
            published = self.kind == "Paris6k" and file.stem in CORRUPT
            self.leave_out(file.relative_to(self.root).as_posix(), why, published)
            del files[file.stem]
        broken = {Path(item.file).stem for item in self.left_out}
        landmarks = {name: index for index, name in enumerate(sorted({query.landmark for query in queries}))}
        of_landmark = {name: landmarks[query.landmark] for query in reversed(queries) for name in query.good}
        for index, (name, file) in enumerate(files.items()):
            yield PictureRow("test/gallery_street", file, of_landmark.get(name, len(landmarks) + index), name)
        for query in queries:
            for name in query.names():
                if name not in files and name not in broken:
                    self.leave_out(f"{name}.jpg")
            good, junk = ([files[name] for name in names if name in files] for names in (query.good, query.junk))
            if (file_of := files.get(query.picture)) is not None:
                label = landmarks[query.landmark]
                yield PictureRow("test/query_street", file_of, label, query.name, box=query.box, true=good, junk=junk)

    def tasks(self) -> list[str]:
        return [TASK]


class _Query:
    """The four ground-truth files of one query."""

    def __init__(self, root: Path, file: Path) -> None:
        matched = _QUERY.fullmatch(file.name)
        assert matched is not None
        self.landmark, self.number = matched[1], int(matched[2])
        self.name = f"{self.landmark}_{matched[2]}"
        where = file.relative_to(root).as_posix()
        lines = [line for _, line in numbered_lines(file, where)]
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
        self.picture = _name(values[0].removeprefix(PREFIX), f"Line 1 of {where}")
        good, ok, self.junk = (
            _names(root, file.with_name(f"{self.name}_{kind}.txt")) for kind in ("good", "ok", "junk")
        )
        self.good = list(dict.fromkeys(good + ok))

    def names(self) -> list[str]:
        return [self.picture, *self.good, *self.junk]


def _query_files(root: Path) -> list[Path]:
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
    return [_name(text, where) for where, text in numbered_lines(file, file.relative_to(root).as_posix())]


def _name(text: str, where: str) -> str:
    """Check a picture's name; names are looked up among existing files, never opened as paths."""
    name = text.strip().removesuffix(".jpg")
    if not re.fullmatch(r"[\w.-]{1,200}", name) or name.startswith("."):
        raise DataError(f"{where} names {printable(text[:80])!r}; expected a picture's name without a folder.")
    return name
