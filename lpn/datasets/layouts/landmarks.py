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
from typing import NamedTuple

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.lists import numbered_lines
from lpn.core.texts import counted
from lpn.datasets.base import Dataset, PictureRow, Size, files_below
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
_QUERY = re.compile(r".+_\d{1,6}_query\.txt")


class Landmarks(Dataset):
    """Oxford5k, Paris6k, or a data set with such ground truth; its only task is "street-to-street".

    The label of a true match is its landmark's number; each further picture has a distinct label. Labels are for display.
    Unreadable pictures are left out.
    """

    kind = "landmarks"
    title = "a set of landmarks with ground-truth files as in Oxford5k"
    priority = -2
    deep = True
    expected = "pictures named as in the ground truth, as .jpg"

    @classmethod
    def recognises(cls, root: Path) -> bool:
        return bool(_query_files(root))

    def rows(self) -> Iterator[PictureRow]:
        queries = sorted((_query(self.root, file) for file in _query_files(self.root)), key=lambda one: one[:2])
        if queries[0].prefixed or all(query.picture.startswith("paris_") for query in queries):
            self.kind, self.title = "Oxford5k" if queries[0].prefixed else "Paris6k", ""
            self.published_sizes = FULL[self.kind]
        files = _by_name(self.root)
        broken = {file.stem: why for file, why in picture_errors(list(files.values())).items()}
        for name, why in broken.items():
            published = self.kind == "Paris6k" and name in CORRUPT
            self.leave_out(files.pop(name).relative_to(self.root).as_posix(), why, published)
        landmarks = {name: index for index, name in enumerate(sorted({query.landmark for query in queries}))}
        of_landmark = {name: landmarks[query.landmark] for query in reversed(queries) for name in query.good}
        for index, (name, file) in enumerate(files.items()):
            yield PictureRow("test/gallery_street", file, of_landmark.get(name, len(landmarks) + index), name)
        for query in queries:
            for name in (query.picture, *query.good, *query.junk):
                if name not in files and name not in broken:
                    self.leave_out(f"{name}.jpg")
            good, junk = ([files[name] for name in names if name in files] for names in (query.good, query.junk))
            if (shown := files.get(query.picture)) is not None:
                label, name = landmarks[query.landmark], f"{query.landmark}_{query.number}"
                yield PictureRow("test/query_street", shown, label, name, box=query.box, true=good, junk=junk)

    def tasks(self) -> list[str]:
        return [TASK]


class _Query(NamedTuple):
    landmark: str
    number: int
    prefixed: bool
    picture: str
    box: tuple[float, float, float, float]
    good: list[str]
    junk: list[str]


def _query(root: Path, file: Path) -> _Query:
    """Read the four ground-truth files of one query; pictures are looked up by name, never opened as paths."""
    where, stem = file.relative_to(root).as_posix(), file.name.removesuffix("_query.txt")
    lines = [line for _, line in numbered_lines(file, where)]
    try:
        ((picture, *numbers),) = map(str.split, lines)
        left, top, right, bottom = map(float, numbers)
        if not (math.isfinite(left + top + right + bottom) and left < right and top < bottom):
            raise ValueError
    except ValueError as error:
        content = printable(lines[0][:80]) if lines else "nothing"
        raise DataError(
            f"{where} says {content!r} in {counted(len(lines), 'line')}; expected one line: a picture's name and its box as "
            "left, top, right, bottom in pixels."
        ) from error
    listed = (file.with_name(f"{stem}_{kind}.txt") for kind in ("good", "ok", "junk"))
    good, ok, junk = (
        [line.strip().removesuffix(".jpg") for _, line in numbered_lines(one, one.relative_to(root).as_posix())]
        for one in listed
    )
    landmark, _, number = stem.rpartition("_")
    prefixed, name = picture.startswith(PREFIX), picture.removeprefix(PREFIX).removesuffix(".jpg")
    return _Query(
        landmark, int(number), prefixed, name, (left, top, right, bottom), list(dict.fromkeys(good + ok)), junk
    )


def _query_files(root: Path) -> list[Path]:
    """Return the ground-truth files below a folder that name a query."""
    return [file for file in files_below(root, ("_query.txt",)) if _QUERY.fullmatch(file.name)]


def _by_name(root: Path) -> dict[str, Path]:
    files: dict[str, Path] = {}
    for file in sorted(files_below(root, (".jpg", ".jpeg")), key=lambda file: (file.stem, file)):
        if (other := files.setdefault(file.stem, file)) != file:
            both = " and ".join(printable(f.relative_to(root).as_posix()) for f in (other, file))
            raise DataError(f"{root.name} has two pictures of one name, {both}; keep one, or give a folder with one.")
    return files
